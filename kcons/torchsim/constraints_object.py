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
from kcons.constraints.constraint import IntArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion

__all__ = ["Constraints"]

#: How far masses and cells may be from those that rows were made for, relative: what single precision leaves.
SAME = 1e-5
_OWN = (
    "this integrator does not keep momenta on constraints: TorchSim's own correct positions and do not tell momenta, "
    "which cools the system. Give torch_sim.integrate one of kcons, integrator=kcons.torchsim.nve, langevin or "
    "nose_hoover; at constant pressure there is none"
)
_CELL = "cells are not relaxed with held rows; relax positions alone, or the cell in ASE with kcons.ase.constrain"


class Constraints(SystemConstraint):
    """Everything that is held on a state, made by `kcons.torchsim.hold`: an engine for each system that has rows.

    TorchSim takes it along where states are sliced, split, joined and moved. Its optimizers end on the constraints; its
    integrators are refused.

    Parameters
    ----------
    motions : sequence of Motion
        Engines; equal systems may share one.
    system_idx : torch.Tensor of int, shape (len(motions),)
        The systems that they belong to.
    """

    def __init__(self, motions: Sequence[Motion], system_idx: torch.Tensor) -> None:
        super().__init__(system_idx)
        self.motions = tuple(motions)
        self._made: tuple[torch.Tensor, Batch, torch.Tensor | None] | None = None

    # -- the engine -----------------------------------------------------------------------------

    def batch(self, state: SimState) -> tuple[Batch, torch.Tensor | None]:
        """The engine for all systems of a state, and its atoms, None if these are all.

        Raises
        ------
        InputError
            The state has other atoms, masses or cells than the rows were made for.
        """
        # TorchSim sets another system_idx where it reorders systems.
        if self._made is None or self._made[0] is not self.system_idx or self._made[1].dtype != state.dtype:
            self.check_fits(state)
            motions = [self.motions[k] for k in torch.argsort(self.system_idx).tolist()]
            batch = Batch(motions, device=state.device, dtype=state.dtype, check_every=1)
            part = torch.isin(state.system_idx, self.system_idx)
            self._made = self.system_idx, batch, None if bool(part.all()) else part.nonzero().ravel()
        return self._made[1:]

    def check_fits(self, state: SimState) -> None:
        """Refuse a state with other atoms, masses or cells than the rows were made for."""
        starts, masses, cells = starts_of(state), array_of(state.masses), array_of(state.row_vector_cell)
        for motion, k in zip(self.motions, self.system_idx.tolist(), strict=True):
            part, lattice = masses[starts[k] : starts[k + 1]], motion.lattice
            wrong = ""
            if part.shape != motion.masses.shape or not np.allclose(part, motion.masses, rtol=SAME, atol=0.0):
                wrong = "atoms or masses"
            elif lattice is not None and np.abs(cells[k] - lattice[0]).max() > SAME * np.abs(lattice[0]).max():
                wrong = "a cell"
            if wrong:
                raise InputError(
                    f"system {k} has {wrong} its rows were not made for; set state.constraints = [] and hold again",
                    item="state",
                )

    def move(self, state: SimState, new: torch.Tensor) -> tuple[Any, Any]:
        """Positions `new` on the constraints, along the gradients at ``state.positions``, and the correction.

        Raises
        ------
        ConvergenceError
            There is no solution near enough; system and row are named.
        """
        batch, atoms = self.batch(state)
        if atoms is None:
            return batch.solve_positions(new, state.positions)[:2]
        solved = batch.solve_positions(new[atoms], state.positions[atoms])
        push = torch.zeros_like(new).index_copy(0, atoms, solved.push)
        return new.index_copy(0, atoms, solved.positions), push

    def tangent(self, state: SimState, velocities: torch.Tensor) -> torch.Tensor:
        """The part of velocities that stays on the constraints."""
        batch, atoms = self.batch(state)
        if atoms is None:
            return batch.project_velocities(state.positions, velocities)
        part = batch.project_velocities(state.positions[atoms], velocities[atoms])
        return velocities.index_copy(0, atoms, part)

    # -- what TorchSim calls --------------------------------------------------------------------

    def get_removed_dof(self, state: SimState) -> torch.Tensor:
        """The rank of the rows of each system, which may be less than their number."""
        ranks = torch.tensor([motion.rank for motion in self.motions], device=state.device)
        return torch.zeros(state.n_systems, dtype=torch.long, device=state.device).index_add(0, self.system_idx, ranks)

    def adjust_positions(self, state: SimState, new_positions: torch.Tensor) -> None:
        """Bring positions that an optimizer asks for onto the constraints, in place."""
        if isinstance(state, MDState):
            self.adjust_momenta(state, state.momenta)
        new_positions.copy_(self.move(state, new_positions)[0])

    def adjust_momenta(self, state: SimState, momenta: torch.Tensor) -> None:
        """Refuse integrators of TorchSim, before they move positions."""
        raise UnsupportedError(_OWN)

    def adjust_forces(self, state: SimState, forces: torch.Tensor) -> None:
        """Remove the part of forces that leaves the constraints, in place: what is left vanishes at a minimum."""
        masses = state.masses[:, None]
        forces.copy_(masses * self.tangent(state, forces / masses))

    def adjust_stress(self, state: SimState, stress: torch.Tensor) -> None:
        """Refuse cell filters, which do not know the stress of held rows."""
        raise UnsupportedError(_CELL)

    # -- slices, joins, copies ------------------------------------------------------------------

    def select_constraint(self, atom_mask: torch.Tensor, system_mask: torch.Tensor) -> Constraints | None:
        """What is held of the systems that stay, numbered in ascending order; TorchSim then reorders."""
        kept = system_mask[self.system_idx].nonzero().ravel()
        number = torch.cumsum(system_mask, 0) - 1
        return self._part(kept, number[self.system_idx[kept]])

    def select_sub_constraint(self, atom_idx: torch.Tensor, sys_idx: int) -> Constraints | None:
        """What is held of one system."""
        kept = (self.system_idx == sys_idx).nonzero().ravel()
        return self._part(kept, torch.zeros_like(kept))

    def _part(self, kept: torch.Tensor, numbers: torch.Tensor) -> Constraints | None:
        return Constraints([self.motions[k] for k in kept.tolist()], numbers) if len(kept) else None

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
        There is none.
    UnsupportedError
        Another constraint is beside it.
    """
    own = next((item for item in state.constraints if isinstance(item, Constraints)), None)
    if own is None:
        raise InputError("nothing is held on this state; call kcons.torchsim.hold(state, ...) before", item="state")
    for item in state.constraints:
        if item is not own:
            raise UnsupportedError(
                f"{type(item).__name__} is beside the constraints of kcons, and each would undo the work of the other; "
                "leave it out"
            )
    return own


def starts_of(state: SimState) -> IntArray:
    """The first atom of each system, and the number of all atoms, shape (n_systems + 1,)."""
    return np.concatenate([[0], np.cumsum(state.n_atoms_per_system.cpu().numpy())]).astype(np.int64)


def array_of(values: torch.Tensor) -> Any:
    """A contiguous copy in double precision."""
    return values.detach().to("cpu", torch.float64, copy=True).contiguous().numpy()
