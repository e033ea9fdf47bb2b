"""What is held on a TorchSim state: the object that its states carry and its optimizers call, by name, and a report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import Constraint as TorchSimConstraint
from torch_sim.constraints import SystemConstraint
from torch_sim.integrators import MDState
from torch_sim.io import state_to_atoms

from kcons.ase.constraints_object import constrain
from kcons.ase.topology import constraints_of as rows_by_name
from kcons.batched import Batch
from kcons.constraints import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.topology.rows_by_name import Options
from kcons.topology.topology import require_kind

#: How far masses and cells may be from those that rows were made for, relative: what single precision leaves.
SAME = 1e-5
AGAIN = "set state.constraints = [] and hold again"
_OWN = (
    "this integrator does not keep momenta on constraints: TorchSim's own correct positions and do not tell momenta, "
    "which cools the system. Give torch_sim.integrate one of kcons, integrator=kcons.torchsim.nve, langevin or "
    "nose_hoover; at constant pressure there is none"
)


class Constraints(SystemConstraint):
    """Everything that is held on a state, made by `kcons.torchsim.hold`: an engine for each system that has rows.

    Optimizers of TorchSim end on the constraints; its integrators and cell filters are refused.
    """

    def __init__(self, motions: Sequence[Motion], system_idx: torch.Tensor) -> None:
        super().__init__(system_idx)
        self.motions = tuple(motions)
        #: Tensors that the batch was made for, with their versions, and the batch.
        self._made: tuple[list[tuple[torch.Tensor, int]], Batch] | None = None
        #: Positions that the last step ended with, and their version.
        self.left: tuple[torch.Tensor, int] | None = None

    def batch(self, state: SimState) -> Batch:
        """The engine for all systems of a state, also those that have no rows; failures wait for its `check`.

        Refuses a state with other masses or cells than the rows were made for.
        """
        # TorchSim sets another system_idx where it reorders systems; masses and cells can be edited in a run.
        watched = self.system_idx, state.masses, state.cell, state.pbc
        if torch.is_inference_mode_enabled() or any(each.is_inference() for each in (state.positions, *watched)):
            raise UnsupportedError("tensors of torch.inference_mode() do not tell of edits; use torch.no_grad()")
        seen = [(each, each._version) for each in watched]
        if self._made is None or any(a is not b or n != m for (a, n), (b, m) in zip(self._made[0], seen, strict=True)):
            held = dict(zip(self.system_idx.tolist(), self.motions, strict=True))
            masses = state.masses.split(state.n_atoms_per_system.tolist())
            cells = state.row_vector_cell * state.pbc[:, None]
            motions = [held[k] if k in held else _unheld(array_of(each)) for k, each in enumerate(masses)]
            for k, motion in enumerate(motions):
                part, lattice = array_of(masses[k]), motion.lattice
                same = part.shape == motion.masses.shape and np.allclose(part, motion.masses, SAME)
                if lattice is not None:
                    there = lattice[0] * lattice[1].any(axis=0)[:, None]  # rows without periodicity are unit vectors
                    same &= np.abs(array_of(cells[k]) - there).max() <= SAME * np.abs(there).max()
                if not same:
                    raise InputError(f"system {k} has masses, cell or pbc its rows are not for; {AGAIN}", item="state")
            self._made = seen, Batch(motions, device=state.device, dtype=state.dtype, check_every=sys.maxsize)
        return self._made[1]

    def get_removed_dof(self, state: SimState) -> torch.Tensor:
        """The rank of the rows of each system, which may be less than their number."""
        ranks = torch.tensor([motion.rank for motion in self.motions], device=state.device)
        return torch.zeros(state.n_systems, dtype=torch.long, device=state.device).index_add(0, self.system_idx, ranks)

    def adjust_positions(self, state: SimState, new_positions: torch.Tensor) -> None:
        """Bring positions that an optimizer asks for onto the constraints, in place."""
        if isinstance(state, MDState):
            raise UnsupportedError(_OWN)
        batch = self.batch(state)
        found = batch.project_positions(new_positions, state.positions)
        batch.check()
        new_positions.copy_(found)

    def adjust_momenta(self, state: SimState, momenta: torch.Tensor) -> None:
        """Refuse integrators of TorchSim, before they move positions."""
        raise UnsupportedError(_OWN)

    def adjust_forces(self, state: SimState, forces: torch.Tensor) -> None:
        """Remove the part of forces that leaves the constraints, in place: what is left vanishes at a minimum."""
        masses = state.masses[:, None]
        forces.copy_(masses * self.batch(state).project_velocities(state.positions, forces / masses))

    def adjust_stress(self, state: SimState, stress: torch.Tensor) -> None:
        """Refuse cell filters, which do not know the stress of held rows."""
        raise UnsupportedError("cells are not relaxed with held rows; relax positions alone, or the cell in kcons.ase")

    # TorchSim puts systems into the order that was asked for after `select_constraint`.

    def select_constraint(self, atom_mask: torch.Tensor, system_mask: torch.Tensor) -> Constraints | None:
        """What is held of the systems that stay."""
        kept, numbers = system_mask[self.system_idx], (torch.cumsum(system_mask, 0) - 1)[self.system_idx]
        motions = [self.motions[k] for k in kept.nonzero().ravel().tolist()]
        return Constraints(motions, numbers[kept]) if motions else None

    def select_sub_constraint(self, atom_idx: torch.Tensor, sys_idx: int) -> Constraints | None:
        """What is held of one system."""
        systems = torch.arange(int(self.system_idx.max()) + 1, device=self.system_idx.device)
        return self.select_constraint(atom_idx, systems == sys_idx)

    def reindex(self, atom_offset: int, system_offset: int) -> Constraints:
        """The same where systems are numbered from `system_offset`."""
        return Constraints(self.motions, self.system_idx + system_offset)

    @classmethod
    def merge(cls, constraints: Sequence[Any]) -> Constraints:
        """One object for states that are joined."""
        motions = [motion for item in constraints for motion in item.motions]
        return cls(motions, torch.cat([item.system_idx for item in constraints]))

    def to(self, device: torch.device | None = None, dtype: torch.dtype | None = None) -> Constraints:
        """The same on another device."""
        return Constraints(self.motions, self.system_idx.to(device=device))

    def __deepcopy__(self, memo: dict[int, Any]) -> Constraints:
        return Constraints(self.motions, self.system_idx.clone())


def hold(
    state: SimState,
    constraints: str | Constraint | Sequence[str | Constraint] = "hbonds",
    *,
    project: bool = False,
    **options: Unpack[Options],
) -> Constraints:
    """Hold the same constraints in each system of a TorchSim state from now on, checked at once.

    Where systems are to be held differently, call it on each and join them by `torch_sim.concatenate_states`.

    Parameters
    ----------
    state : torch_sim.SimState
        Its ``constraints`` are set.
    constraints : str, Constraint, or sequence of them
        Names, as in "water, hbonds": ``water`` is rigid water; 'hbonds', 'allbonds', 'hangles' and 'allangles' are
        those of `kcons.topology.Holding`, and mean rigid water too; bonds are guessed from distances. Objects of
        `kcons.constraints` number the atoms of a system from 0; targets that are left open are taken from each system.
    project : bool
        Whether to move atoms that are off explicit targets onto them instead of raising.
    **options
        rigid_water, water_geometry, rigid_bodies, select, ...: see `kcons.topology.Holding`.

    Returns
    -------
    Constraints
        The object that is now in ``state.constraints``.

    Raises
    ------
    InputError
        Positions off an explicit target while `project` is False; unknown names and atoms. The state is unchanged.
    UnsupportedError
        Targets that move with time, constraints on velocities, constraints that are there already.
    """
    require_kind(state, SimState, "state", "a torch_sim.SimState")
    refuse_others(state.constraints)
    given = [constraints] if isinstance(constraints, str | Constraint) else list(constraints)
    objects = [item for item in given if not isinstance(item, str)]
    words = [word.strip().lower() for text in given if isinstance(text, str) for word in text.split(",")]
    kind = ", ".join(word for word in words if word != "water") or "none"
    if options and not words:
        said = f"{', '.join(options)}: options of names, of which there are none"
        raise InputError(f"{said}; give 'none' beside the objects", item="constraints")
    options.setdefault("guess_bonds", True)  # a state has none
    known: dict[tuple[bytes, ...], tuple[Motion, Any]] = {}
    found = []
    for k, atoms in enumerate(state_to_atoms(state)):
        atoms.set_masses(array_of(state.masses[state.system_idx == k]))
        parts = atoms.cell.array, atoms.positions, atoms.get_masses(), atoms.numbers
        # Copies of one system share its engine.
        key = tuple(part.tobytes() for part in parts)
        if key not in known:
            try:
                rows = [*(rows_by_name(atoms, kind, **options) if words else []), *objects]
                known[key] = constrain(atoms, rows, project=project).engine(atoms), atoms.positions
            except KconsError as error:
                error.add_note(f"In system {k} of the state, whose atoms are numbered from 0; project= is one of hold")
                raise
        found.append(known[key])
    if not any(motion.constraint_set.n_rows for motion, _ in found):
        raise InputError("nothing is to be held; give names or constraints", item="constraints")
    if project:
        moved = np.concatenate([x for _, x in found])
        state.positions = torch.as_tensor(moved, dtype=state.dtype, device=state.device)
    held = Constraints([motion for motion, _ in found], torch.arange(len(found), device=state.device))
    state.constraints = [held]
    return held


def report(state: SimState) -> list[Report]:
    """What the engine of each system reports: residuals of positions, and of momenta where there are any, rank."""
    batch = constraints_of(state).batch(state)
    return batch.report(state.positions, state.velocities if isinstance(state, MDState) else None)


def _unheld(masses: FloatArray) -> Motion:
    """An engine without rows."""
    x = np.zeros((len(masses), 3))
    return Motion(ConstraintSet([], x, masses), x)


def constraints_of(state: SimState) -> Constraints:
    """The one object of kcons on a state; refuses a state without, and other constraints beside it."""
    own = next((item for item in state.constraints if isinstance(item, Constraints)), None)
    if own is None:
        raise InputError("nothing is held on this state; call kcons.torchsim.hold(state, ...) before", item="state")
    refuse_others([item for item in state.constraints if item is not own])
    return own


def refuse_others(constraints: Sequence[TorchSimConstraint]) -> None:
    """Refuse constraints that would undo the work of those of kcons."""
    for item in constraints:
        said = f"{type(item).__name__} on the state would undo the work of the constraints of kcons"
        raise UnsupportedError(f"{said}: {AGAIN}, all by one call of hold, FixAtoms as kcons' FixedAtoms")


def array_of(values: torch.Tensor) -> Any:
    """A contiguous copy in double precision."""
    return values.detach().to("cpu", torch.float64, copy=True).contiguous().numpy()
