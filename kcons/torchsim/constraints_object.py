"""The constraint object for TorchSim: what its states carry, and what its optimizers call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import Constraint, SystemConstraint
from torch_sim.integrators import MDState

from kcons.batched import Batch
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.torchsim.topology import array_of, starts_of

__all__ = ["Constraints"]

#: How far masses and cells may be from those that rows were made for, relative: what single precision leaves.
SAME = 1e-5
_OWN = (
    "give torch_sim.integrate one of kcons: integrator=kcons.torchsim.nve, langevin or nose_hoover (TorchSim's own move "
    "positions onto constraints without telling momenta, which cools the system; at constant pressure there is none)"
)
_CELL = "cells are not relaxed with held rows in TorchSim; relax positions alone, or the cell in ASE with kcons.ase.constrain"


class Constraints(SystemConstraint):
    """Everything that is held on a state: for each system an engine.

    One object for all systems of a state, made by `kcons.torchsim.hold`. TorchSim takes it along where states are sliced,
    split, joined and moved to a device. Its optimizers step along forces, so that for them positions and forces are
    projected with equal weights of all atoms; momenta with the masses.

    Parameters
    ----------
    motions : sequence of Motion
        Engines of the systems; equal ones may be one object.
    system_idx : torch.Tensor of int, shape (len(motions),)
        The systems that are held.
    """

    def __init__(self, motions: Sequence[Motion], system_idx: torch.Tensor) -> None:
        super().__init__(system_idx)
        self.motions = tuple(motions)
        self._made: tuple[Any, ...] | None = None

    # -- the engine -----------------------------------------------------------------------------

    def batch(self, state: SimState) -> tuple[Batch, torch.Tensor | None]:
        """The engine for the state's device and precision, and its atoms; None if these are all.

        Raises
        ------
        InputError
            The state has other atoms, masses or cells than the rows were made for.
        """
        # TorchSim gives the attribute system_idx another value where it reorders systems.
        key = (state.device, state.dtype, self.system_idx)
        made = self._made
        if made is None or made[0][:2] != key[:2] or made[0][2] is not key[2]:
            self.check_fits(state)
            order = torch.argsort(self.system_idx)
            motions = [self.motions[k] for k in order.tolist()]
            batch = Batch(motions, device=state.device, dtype=state.dtype, check_every=1)
            whole = len(motions) == state.n_systems
            atoms = None if whole else torch.isin(state.system_idx, self.system_idx).nonzero().ravel()
            made = self._made = (key, batch, atoms)
        return made[1], made[2]

    def check_fits(self, state: SimState) -> None:
        """Refuse a state with other atoms, masses or cells than the rows were made for."""
        starts, masses = starts_of(state), array_of(state.masses)
        cells, periodic = array_of(state.row_vector_cell), bool(state.pbc.any())
        for motion, k in zip(self.motions, self.system_idx.tolist(), strict=True):
            wrong = ""
            part = masses[starts[k] : starts[k + 1]]
            lattice = motion.lattice
            if len(part) != motion.n_atoms:
                wrong = f"{len(part)} atoms, and its rows were made for {motion.n_atoms}"
            elif not np.allclose(part, motion.masses, rtol=SAME, atol=0.0):
                atom = int(np.argmax(np.abs(part - motion.masses)))
                wrong = f"another mass of atom {atom} ({part[atom]:.6g}) than its rows were made for"
            elif periodic != (lattice is not None):
                wrong = "other periodic directions than its rows were made for"
            elif lattice is not None and not np.allclose(
                cells[k], lattice[0], rtol=SAME, atol=SAME * np.ptp(lattice[0])
            ):
                wrong = "another cell than its rows were made for"
            if wrong:
                raise InputError(
                    f"system {k} has {wrong}; set state.constraints = [] and call kcons.torchsim.hold again",
                    item="state",
                )

    def move(self, state: SimState, new: torch.Tensor, masses: torch.Tensor | None = None) -> tuple[Any, Any]:
        """Positions `new` of all atoms on the constraints, along the gradients at ``state.positions``, and the correction.

        With the state's masses, or others. The correction comes from the multipliers and not from rounded positions.

        Raises
        ------
        ConvergenceError
            A system and a row that find no solution, named.
        """
        batch, atoms = self.batch(state)
        old = state.positions
        if atoms is None:
            solved = batch.solve_positions(new, old, masses=masses)
            return solved.positions, solved.push
        masses = None if masses is None else masses[atoms]
        solved = batch.solve_positions(new[atoms], old[atoms], masses=masses)
        push = torch.zeros_like(new).index_copy(0, atoms, solved.push)
        return new.index_copy(0, atoms, solved.positions), push

    def tangent(
        self, state: SimState, vectors: torch.Tensor, at: torch.Tensor | None = None, masses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """The part of velocities (of forces, with equal masses) that stays on the constraints, `at` the state's positions."""
        batch, atoms = self.batch(state)
        x = state.positions if at is None else at
        if atoms is None:
            return batch.project_velocities(x, vectors, masses=masses)
        masses = None if masses is None else masses[atoms]
        part = batch.project_velocities(x[atoms], vectors[atoms], masses=masses)
        return vectors.index_copy(0, atoms, part)

    # -- what TorchSim calls --------------------------------------------------------------------

    def get_removed_dof(self, state: SimState) -> torch.Tensor:
        """The rank of the rows of each system, which may be less than their number, shape (n_systems,)."""
        ranks = torch.tensor([motion.rank for motion in self.motions], device=state.device)
        return torch.zeros(state.n_systems, dtype=torch.long, device=state.device).index_add(0, self.system_idx, ranks)

    def adjust_positions(self, state: SimState, new_positions: torch.Tensor) -> None:
        """Bring positions that an optimizer asks for onto the constraints, in place.

        Raises
        ------
        UnsupportedError
            Called by an integrator of TorchSim.
        """
        if isinstance(state, MDState):
            raise UnsupportedError(f"this integrator does not keep momenta on constraints: {_OWN}")
        new_positions.copy_(self.move(state, new_positions, torch.ones_like(state.masses))[0])

    def adjust_momenta(self, state: SimState, momenta: torch.Tensor) -> None:
        """Remove the part of momenta that leaves the constraints, in place."""
        masses = state.masses[:, None]
        momenta.copy_(masses * self.tangent(state, momenta / masses))

    def adjust_forces(self, state: SimState, forces: torch.Tensor) -> None:
        """Remove the part of forces that leaves the constraints, in place: what is left vanishes at a minimum."""
        forces.copy_(self.tangent(state, forces, masses=torch.ones_like(state.masses)))

    def adjust_stress(self, state: SimState, stress: torch.Tensor) -> None:
        """Refuse: the stress of held rows is not known to cell filters."""
        raise UnsupportedError(_CELL)

    def adjust_cell(self, state: SimState, cell: torch.Tensor) -> None:
        """Refuse: rows belong to the cell that they were made in."""
        raise UnsupportedError(_CELL)

    # -- slices, joins, copies ------------------------------------------------------------------

    def select_constraint(self, atom_mask: torch.Tensor, system_mask: torch.Tensor) -> Constraints | None:
        """What is held of the systems that stay, renumbered in ascending order; TorchSim then reorders."""
        kept = system_mask[self.system_idx]
        if not bool(kept.any()):
            return None
        number = torch.cumsum(system_mask, 0) - 1
        motions = [motion for motion, stays in zip(self.motions, kept.tolist(), strict=True) if stays]
        return Constraints(motions, number[self.system_idx[kept]])

    def select_sub_constraint(self, atom_idx: torch.Tensor, sys_idx: int) -> Constraints | None:
        """What is held of one system, alone."""
        place = (self.system_idx == sys_idx).nonzero().ravel()
        if not len(place):
            return None
        return Constraints([self.motions[int(place[0])]], torch.zeros_like(place))

    def reindex(self, atom_offset: int, system_offset: int) -> Constraints:
        """The same where systems are numbered from `system_offset`."""
        return Constraints(self.motions, self.system_idx + system_offset)

    @classmethod
    def merge(cls, constraints: Sequence[Constraint]) -> Constraints:
        """One object for states that are joined."""
        own = [item for item in constraints if isinstance(item, Constraints)]
        motions = [motion for item in own for motion in item.motions]
        return cls(motions, torch.cat([item.system_idx for item in own]))

    def to(self, device: torch.device | None = None, dtype: torch.dtype | None = None) -> Constraints:
        """The same on another device."""
        return Constraints(self.motions, self.system_idx.to(device=device))

    def __deepcopy__(self, memo: dict[int, Any]) -> Constraints:
        """Rows never change: a copy shares the engines."""
        return Constraints(self.motions, self.system_idx.clone())

    def __repr__(self) -> str:
        rows = sum(motion.constraint_set.n_rows for motion in self.motions)
        return f"<Constraints of kcons: {rows} rows in {len(self.motions)} systems>"


def constraints_of(state: SimState) -> Constraints:
    """The one object of kcons on a state.

    Raises
    ------
    InputError
        There is none, or more than one.
    UnsupportedError
        Another constraint is beside it, which would undo its work.
    """
    found = [item for item in state.constraints if isinstance(item, Constraints)]
    if len(found) != 1:
        what = "nothing is" if not found else f"{len(found)} objects of kcons are"
        raise InputError(
            f"{what} on this state; call kcons.torchsim.hold(state, ...) once, with all that is held", item="state"
        )
    for item in state.constraints:
        if item is not found[0]:
            raise UnsupportedError(
                f"{type(item).__name__} of TorchSim is beside the constraints of kcons, and each would undo the work of "
                "the other; leave it out (hold takes FixAtoms over where it is on the state before)"
            )
    return found[0]
