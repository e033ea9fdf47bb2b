"""The constraint object for TorchSim: what its states carry, and what its optimizers call."""

from __future__ import annotations

import sys
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

    Optimizers of TorchSim end on the constraints; its integrators and cell filters are refused.
    """

    def __init__(self, motions: Sequence[Motion], system_idx: torch.Tensor) -> None:
        super().__init__(system_idx)
        self.motions = tuple(motions)
        #: Tensors that the engine was made for, with their versions, the engine, and its atoms.
        self._made: tuple[list[tuple[torch.Tensor, int]], Batch, torch.Tensor] | None = None

    def batch(self, state: SimState) -> tuple[Batch, torch.Tensor]:
        """The engine for all systems of a state that have rows, and the numbers of their atoms."""
        # TorchSim sets another system_idx where it reorders systems; masses and cells can be edited in a run.
        seen = [(each, each._version) for each in (self.system_idx, state.masses, state.cell)]
        if self._made is None or any(a is not b or n != m for (a, n), (b, m) in zip(self._made[0], seen, strict=True)):
            self.check_fits(state)
            motions = [self.motions[k] for k in torch.argsort(self.system_idx).tolist()]
            batch = Batch(motions, device=state.device, dtype=state.dtype, check_every=sys.maxsize)
            self._made = seen, batch, torch.isin(state.system_idx, self.system_idx).nonzero().ravel()
        return self._made[1:]

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

    def move(self, state: SimState, new: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions `new` on the constraints, along the gradients at ``state.positions``, and the correction.

        Failures are kept until `check` looks for them.
        """
        batch, atoms = self.batch(state)
        positions, push, _ = batch.solve_positions(new[atoms], state.positions[atoms])
        return new.index_copy(0, atoms, positions), torch.zeros_like(new).index_copy(0, atoms, push)

    def check(self, state: SimState) -> None:
        """Raise `ConvergenceError` where rows were not met since the last look, which waits for the device."""
        self.batch(state)[0].check()

    def tangent(self, state: SimState, velocities: torch.Tensor) -> torch.Tensor:
        """The part of velocities that stays on the constraints."""
        batch, atoms = self.batch(state)
        return velocities.index_copy(0, atoms, batch.project_velocities(state.positions[atoms], velocities[atoms]))

    def get_removed_dof(self, state: SimState) -> torch.Tensor:
        """The rank of the rows of each system, which may be less than their number."""
        ranks = torch.tensor([motion.rank for motion in self.motions], device=state.device)
        return torch.zeros(state.n_systems, dtype=torch.long, device=state.device).index_add(0, self.system_idx, ranks)

    def adjust_positions(self, state: SimState, new_positions: torch.Tensor) -> None:
        """Bring positions that an optimizer asks for onto the constraints, in place."""
        if isinstance(state, MDState):
            raise UnsupportedError(_OWN)
        new_positions.copy_(self.move(state, new_positions)[0])
        self.check(state)

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

    # TorchSim puts systems into the order that was asked for after `select_constraint`.

    def select_constraint(self, atom_mask: torch.Tensor, system_mask: torch.Tensor) -> Constraints | None:
        """What is held of the systems that stay."""
        kept = system_mask[self.system_idx].nonzero().ravel()
        return self._part(kept, (torch.cumsum(system_mask, 0) - 1)[self.system_idx[kept]])

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
        return Constraints(self.motions, self.system_idx.clone())

    def __repr__(self) -> str:
        rows = sum(motion.constraint_set.n_rows for motion in self.motions)
        return f"<Constraints of kcons: {rows} rows in {len(self.motions)} systems>"


def constraints_of(state: SimState) -> Constraints:
    """The one object of kcons on a state; refuses a state without, and other constraints beside it."""
    own = next((item for item in state.constraints if isinstance(item, Constraints)), None)
    if own is None:
        raise InputError("nothing is held on this state; call kcons.torchsim.hold(state, ...) before", item="state")
    refuse_others([item for item in state.constraints if item is not own])
    return own


def refuse_others(constraints: Sequence[Constraint]) -> None:
    """Refuse constraints of TorchSim, which would undo the work of those of kcons."""
    for item in constraints:
        raise UnsupportedError(f"{type(item).__name__} would undo the work of the constraints of kcons; leave it out")


def array_of(values: torch.Tensor) -> Any:
    """A contiguous copy in double precision."""
    return values.detach().to("cpu", torch.float64, copy=True).contiguous().numpy()
