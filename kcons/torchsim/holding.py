"""Putting constraints on a TorchSim state, and how well it keeps them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Unpack

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import FixAtoms
from torch_sim.integrators import MDState

from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.arguments import check_pairs
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.topology.holding import Holding, Options
from kcons.topology.rows_by_name import rows_of
from kcons.topology.topology import Snapshot, Topology, require_kind, selected_numbers, sorted_pairs
from kcons.torchsim.constraints_object import Constraints, array_of, constraints_of, refuse_others

__all__ = ["hold", "report"]

#: How far positions may be off explicit targets, relative to the scale of a row, beside what their precision leaves.
START_TOLERANCE = 1e-6
#: By atomic number.
SYMBOLS = """
    X H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb
    Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg
    Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og
"""


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
    if holding is None and not objects and not marked.any():
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
    """What the engine of each held system reports: residuals of positions, and of momenta where there are any, rank."""
    batch, atoms = constraints_of(state).batch(state)
    return batch.report(state.positions[atoms], state.velocities[atoms] if isinstance(state, MDState) else None)


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
    row = int(np.argmax(excess))
    if excess[row] > 1:
        raise InputError(
            f"positions are off {held.row_name(row)} by {abs(found.sigma[row]):.6g}; pass project=True to bring them "
            "there",
            item="positions",
            atoms=held.row_atoms(row),
        )
    return motion, x
