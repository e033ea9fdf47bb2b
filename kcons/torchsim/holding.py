"""What is held on a TorchSim state: the object that its states carry and its optimizers call, by name, and a report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Unpack

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import Constraint as TorchSimConstraint
from torch_sim.constraints import FixAtoms, SystemConstraint
from torch_sim.integrators import MDState

from kcons.batched import Batch
from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.arguments import check_pairs
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.topology.rows_by_name import Holding, Options, rows_of
from kcons.topology.topology import Snapshot, Topology, require_kind, selected_numbers, sorted_pairs

__all__ = ["Constraints", "hold", "report"]

#: How far masses and cells may be from those that rows were made for, relative: what single precision leaves.
SAME = 1e-5
_OWN = (
    "this integrator does not keep momenta on constraints: TorchSim's own correct positions and do not tell momenta, "
    "which cools the system. Give torch_sim.integrate one of kcons, integrator=kcons.torchsim.nve, langevin or "
    "nose_hoover; at constant pressure there is none"
)
_CELL = "cells are not relaxed with held rows; relax positions alone, or the cell in ASE with kcons.ase.constrain"
#: How far positions may be off explicit targets, relative to the scale of a row, beside what their precision leaves.
START_TOLERANCE = 1e-6
#: By atomic number.
SYMBOLS = """
    X H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb
    Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg
    Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og
"""


class Constraints(SystemConstraint):
    """Everything that is held on a state, made by `kcons.torchsim.hold`: an engine for each system that has rows.

    Optimizers of TorchSim end on the constraints; its integrators and cell filters are refused.
    """

    def __init__(self, motions: Sequence[Motion], system_idx: torch.Tensor) -> None:
        super().__init__(system_idx)
        self.motions = tuple(motions)
        #: Tensors that the engine was made for, with their versions, and the engine.
        self._made: tuple[list[tuple[torch.Tensor, int]], Batch] | None = None
        #: Positions that the last step ended with, and their version.
        self.left: tuple[torch.Tensor, int] | None = None

    def batch(self, state: SimState) -> Batch:
        """The engine for all systems of a state, also those that have no rows; failures wait for its `check`."""
        # TorchSim sets another system_idx where it reorders systems; masses and cells can be edited in a run.
        seen = [(each, each._version) for each in (self.system_idx, state.masses, state.cell)]
        if self._made is None or any(a is not b or n != m for (a, n), (b, m) in zip(self._made[0], seen, strict=True)):
            self.check_fits(state)
            held = dict(zip(self.system_idx.tolist(), self.motions, strict=True))
            motions = [held[k] if k in held else _unheld(state, k) for k in range(state.n_systems)]
            self._made = seen, Batch(motions, device=state.device, dtype=state.dtype, check_every=sys.maxsize)
        return self._made[1]

    def check_fits(self, state: SimState) -> None:
        """Refuse a state with other atoms, masses or cells than the rows were made for."""
        masses, cells = state.masses.split(state.n_atoms_per_system.tolist()), state.row_vector_cell
        for motion, k in zip(self.motions, self.system_idx.tolist(), strict=True):
            part, lattice = array_of(masses[k]), motion.lattice
            wrong = "" if part.shape == motion.masses.shape and np.allclose(part, motion.masses, SAME) else "masses"
            if lattice is not None and np.abs(array_of(cells[k]) - lattice[0]).max() > SAME * np.abs(lattice[0]).max():
                wrong = "a cell"
            if wrong:
                raise InputError(
                    f"system {k} has {wrong} its rows were not made for; set state.constraints = [] and hold again",
                    item="state",
                )

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
        raise UnsupportedError(_CELL)

    # TorchSim puts systems into the order that was asked for after `select_constraint`.

    def select_constraint(self, atom_mask: torch.Tensor, system_mask: torch.Tensor) -> Constraints | None:
        """What is held of the systems that stay."""
        return self._part(system_mask[self.system_idx], (torch.cumsum(system_mask, 0) - 1)[self.system_idx])

    def select_sub_constraint(self, atom_idx: torch.Tensor, sys_idx: int) -> Constraints | None:
        """What is held of one system."""
        return self._part(self.system_idx == sys_idx, torch.zeros_like(self.system_idx))

    def _part(self, kept: torch.Tensor, numbers: torch.Tensor) -> Constraints | None:
        motions = [self.motions[k] for k in kept.nonzero().ravel().tolist()]
        return Constraints(motions, numbers[kept]) if motions else None

    def reindex(self, atom_offset: int, system_offset: int) -> Constraints:
        """The same where systems are numbered from `system_offset`."""
        return Constraints(self.motions, self.system_idx + system_offset)

    @classmethod
    def merge(cls, constraints: Sequence[TorchSimConstraint]) -> Constraints:
        """One object for states that are joined."""
        own = [item for item in constraints if isinstance(item, Constraints)]
        motions = [motion for item in own for motion in item.motions]
        return cls(motions, torch.cat([item.system_idx for item in own]))

    def to(self, device: torch.device | None = None, dtype: torch.dtype | None = None) -> Constraints:
        """The same on another device."""
        return Constraints(self.motions, self.system_idx.to(device=device))

    def __deepcopy__(self, memo: dict[int, Any]) -> Constraints:
        return Constraints(self.motions, self.system_idx.clone())

    def __repr__(self) -> str:
        rows = sum(motion.constraint_set.n_rows for motion in self.motions)
        return f"<Constraints of kcons: {rows} rows in {len(self.motions)} systems>"


def hold(
    state: SimState,
    constraints: str | Constraint | Sequence[str | Constraint] = "hbonds",
    *,
    bonds: Any = None,
    project: bool = False,
    **options: Unpack[Options],
) -> Constraints:
    """Hold the same constraints in each system of a TorchSim state from now on, checked at once.

    Where systems are to be held differently, call it on each and join them by `torch_sim.concatenate_states`.

    Parameters
    ----------
    state : torch_sim.SimState
        Its ``constraints`` are set. Of those that it has, FixAtoms is taken over.
    constraints : str, Constraint, or sequence of them
        Names, as in "water, hbonds": ``water`` is rigid water; 'hbonds', 'allbonds', 'hangles' and 'allangles' are
        those of `kcons.topology.Holding`, and mean rigid water too. Objects of `kcons.constraints` number the atoms of
        a system from 0; targets that are left open are taken from each system.
    bonds : array_like of int, shape (n, 2), optional
        Bonds of a system; without them all are guessed from distances.
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
        Positions off an explicit target while `project` is False; unknown names and atoms; constraints of kcons that
        are there already. The state is unchanged.
    UnsupportedError
        Targets that move with time, constraints on velocities, other constraints of TorchSim.
    """
    require_kind(state, SimState, "state", "a torch_sim.SimState")
    given = [constraints] if isinstance(constraints, str | Constraint) else list(constraints)
    objects = [item for item in given if not isinstance(item, str)]
    for item in objects:
        require_kind(item, Constraint, "constraints", "names, and constraints of kcons.constraints")
        if item.moving or not item.holonomic:
            what = "moves with time" if item.holonomic else "constrains velocities"
            raise UnsupportedError(f"{item!r} {what}, and TorchSim tells no time; use kcons.steppers")
    words = [word.strip().lower() for text in given if isinstance(text, str) for word in text.split(",")]
    kinds = [word for word in words if word != "water"] or ["none"]
    if len(kinds) > 1:
        raise InputError(f"{kinds[0]} and {kinds[1]} are two names of bonds; give one of them", item="constraints")
    if bonds is None:
        options.setdefault("guess_bonds", True)  # a state has none
    holding = Holding(kinds[0], **options) if words else None
    marked = _fixed_atoms(state)
    if holding is None and not any(item.n_rows for item in objects) and not marked.any():
        raise InputError("nothing is to be held; give names or constraints", item="constraints")
    known: dict[tuple[bytes, ...], tuple[Motion, FloatArray]] = {}
    found = []
    ends = torch.cumsum(state.n_atoms_per_system, 0).tolist()
    for k, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
        snapshot, fixed = _snapshot(state, k, slice(start, end), bonds), np.flatnonzero(marked[start:end])
        cell = np.zeros(0) if snapshot.cell is None else snapshot.cell
        parts = cell, snapshot.positions, snapshot.topology.masses, snapshot.topology.elements, fixed
        # Copies of one system share its engine.
        key = tuple(part.tobytes() for part in parts)
        if key not in known:
            try:
                numbers = partial(selected_numbers, n=end - start)
                rows = [] if holding is None else list(rows_of(snapshot, holding, numbers, "pass bonds= of all atoms"))
                rows += [*objects, *([FixedAtoms(fixed)] if len(fixed) else [])]
                known[key] = _bound(rows, snapshot, project, torch.finfo(state.dtype).eps)
            except KconsError as error:
                error.add_note(f"In system {k} of the state, whose atoms are numbered from 0")
                raise
        found.append(known[key])
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


def _unheld(state: SimState, system: int) -> Motion:
    """An engine without rows."""
    x, masses = (array_of(each[state.system_idx == system]) for each in (state.positions, state.masses))
    return Motion(ConstraintSet([], x, masses), x)


def _fixed_atoms(state: SimState) -> Any:
    """Atoms that TorchSim's FixAtoms holds, as a mask; refuses other constraints."""
    marked = np.zeros(state.n_atoms, dtype=bool)
    for item in state.constraints:
        if isinstance(item, Constraints):
            raise InputError(
                "the state has constraints of kcons; set state.constraints = [] and give all that is held in one call",
                item="state",
            )
        if not isinstance(item, FixAtoms):
            refuse_others([item])
        marked[item.atom_idx.cpu().numpy()] = True
    return marked


def _snapshot(state: SimState, system: int, atoms: slice, bonds: Any) -> Snapshot:
    """Topology and positions of one system in double precision."""
    symbols = np.array(SYMBOLS.split())[state.atomic_numbers[atoms].cpu().numpy()]
    elements, n, none = np.where(symbols == "X", "", symbols), len(symbols), np.array([""])
    pairs = sorted_pairs(np.zeros((0, 2), np.int64) if bonds is None else check_pairs(bonds, n))
    masses, pbc = array_of(state.masses[atoms]), state.pbc.cpu().numpy()
    topology = Topology(symbols, elements, masses, np.zeros(n, np.int64), none, none, none, pairs, residues_known=False)
    cell = array_of(state.row_vector_cell[system]) if pbc.any() else None
    return Snapshot(topology, array_of(state.positions[atoms]), 1.0, cell, pbc, host="TorchSim state")


def _bound(rows: Sequence[Constraint], snapshot: Snapshot, project: bool, eps: float) -> tuple[Motion, FloatArray]:
    """The engine for one system, and its positions on the rows."""
    x = snapshot.positions
    held = ConstraintSet(rows, x, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist())
    motion = Motion(held, x)
    if project:
        return motion, motion.restore_positions(x)
    found = held.residuals(x)
    excess = np.abs(found.sigma) / np.maximum(START_TOLERANCE * held.scale, eps / np.finfo(float).eps * found.allowed)
    if excess.max(initial=0.0) > 1:
        row = int(np.argmax(excess))
        raise InputError(
            f"positions are off {held.row_name(row)} by {abs(found.sigma[row]):.6g}; pass project=True to bring them "
            "there",
            item="positions",
            atoms=held.row_atoms(row),
        )
    return motion, x


def constraints_of(state: SimState) -> Constraints:
    """The one object of kcons on a state; refuses a state without, and other constraints beside it."""
    own = next((item for item in state.constraints if isinstance(item, Constraints)), None)
    if own is None:
        raise InputError("nothing is held on this state; call kcons.torchsim.hold(state, ...) before", item="state")
    refuse_others([item for item in state.constraints if item is not own])
    return own


def refuse_others(constraints: Sequence[TorchSimConstraint]) -> None:
    """Refuse constraints of TorchSim, which would undo the work of those of kcons."""
    for item in constraints:
        raise UnsupportedError(f"{type(item).__name__} would undo the work of the constraints of kcons; leave it out")


def array_of(values: torch.Tensor) -> Any:
    """A contiguous copy in double precision."""
    return values.detach().to("cpu", torch.float64, copy=True).contiguous().numpy()
