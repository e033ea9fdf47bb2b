"""Putting constraints on a TorchSim state, and how well it keeps them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal, Unpack

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import FixAtoms
from torch_sim.integrators import MDState

from kcons.batched import BatchReport
from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.arguments import check_pairs
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.topology.holding import Holding, Options
from kcons.topology.rows_by_name import rows_of
from kcons.topology.topology import Snapshot, Topology, require_kind, selected_numbers, sorted_pairs
from kcons.torchsim.constraints_object import Constraints, array_of, constraints_of, starts_of

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
    degenerate: Literal["convert", "raise"] = "convert",
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
    degenerate : {'convert', 'raise'}
        What to do about rows that are singular to first order, see `kcons.Motion`.
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
    fixed = _fixed_atoms(state)
    given = [constraints] if isinstance(constraints, str | Constraint) else list(constraints)
    objects = [item for item in given if not isinstance(item, str)]
    for item in objects:
        require_kind(item, Constraint, "constraints", "names, and constraints of kcons.constraints")
        if item.moving or not item.holonomic:
            what = "moves with time" if item.holonomic else "constrains velocities"
            raise UnsupportedError(f"{item!r} {what}, and TorchSim tells no time; use kcons.steppers")
    if bonds is None:
        options.setdefault("guess_bonds", True)  # a state has none
    holding = _holding([item for item in given if isinstance(item, str)], options)
    if holding is None and not objects and not any(map(len, fixed)):
        raise InputError("nothing is to be held; give names or constraints", item="constraints")
    known: dict[tuple[Any, ...], tuple[Motion, FloatArray]] = {}
    motions, positions = [], []
    for k, pinned in enumerate(fixed):
        snapshot = _snapshot(state, k, bonds)
        cell = None if snapshot.cell is None else snapshot.cell.tobytes()
        parts = snapshot.positions, snapshot.topology.masses, snapshot.topology.elements, pinned
        # Copies of one system share its engine.
        key = (cell, *(part.tobytes() for part in parts))
        if key not in known:
            try:
                numbers = partial(selected_numbers, n=snapshot.topology.n_atoms)
                rows = [] if holding is None else list(rows_of(snapshot, holding, numbers, "pass bonds= of all atoms"))
                rows += [*objects, *([FixedAtoms(pinned)] if len(pinned) else [])]
                known[key] = _bound(rows, snapshot, project, degenerate, state.dtype)
            except KconsError as error:
                error.add_note(f"In system {k} of the state, whose atoms are numbered from 0")
                raise
        motions.append(known[key][0])
        positions.append(known[key][1])
    held = Constraints(motions, torch.arange(len(motions), device=state.device))
    if project:
        state.positions = torch.as_tensor(np.concatenate(positions), dtype=state.dtype, device=state.device)
    state.constraints = [held]
    return held


def report(state: SimState) -> BatchReport:
    """How well a state keeps what is held: residuals of positions, and of momenta where there are any, by system.

    Raises
    ------
    InputError
        Nothing is held on the state.
    """
    batch, atoms = constraints_of(state).batch(state)
    part = slice(None) if atoms is None else atoms
    return batch.report(state.positions[part], state.velocities[part] if isinstance(state, MDState) else None)


def _fixed_atoms(state: SimState) -> list[IntArray]:
    """Atoms that TorchSim's FixAtoms holds, of each system numbered from 0; refuses other constraints."""
    marked = np.zeros(state.n_atoms, dtype=bool)
    for item in state.constraints:
        if isinstance(item, Constraints):
            raise InputError(
                "the state has constraints of kcons; set state.constraints = [] and give all that is held in one call",
                item="state",
            )
        if not isinstance(item, FixAtoms):
            raise UnsupportedError(f"{type(item).__name__} would undo the work of kcons' constraints; leave it out")
        marked[item.atom_idx.cpu().numpy()] = True
    return [np.flatnonzero(marked[start:end]) for start, end in pairwise(starts_of(state))]


def _holding(named: Iterable[str], options: Any) -> Holding | None:
    """What names mean; None without any."""
    words = [word.strip().lower() for text in named for word in text.split(",")]
    kinds = [word for word in words if word != "water"]
    if len(kinds) > 1:
        raise InputError(f"{kinds[0]} and {kinds[1]} are two names of bonds; give one of them", item="constraints")
    return Holding(kinds[0] if kinds else "none", **options) if words else None


def _snapshot(state: SimState, system: int, bonds: Any) -> Snapshot:
    """Topology and positions of one system in double precision."""
    start, end = starts_of(state)[system : system + 2].tolist()
    n, none = end - start, np.array([""])
    symbols = np.array(SYMBOLS.split())[state.atomic_numbers[start:end].cpu().numpy()]
    elements = np.where(symbols == "X", "", symbols)
    pairs = sorted_pairs(np.zeros((0, 2), np.int64) if bonds is None else check_pairs(bonds, n))
    masses = array_of(state.masses[start:end])
    topology = Topology(
        symbols, elements, masses, np.zeros(n, np.int64), none, np.array(["1"]), none, pairs, residues_known=False
    )
    pbc = state.pbc.cpu().numpy()
    cell = array_of(state.row_vector_cell[system]) if pbc.any() else None
    return Snapshot(topology, array_of(state.positions[start:end]), 1.0, cell, pbc, host="TorchSim state")


def _bound(
    rows: Sequence[Constraint],
    snapshot: Snapshot,
    project: bool,
    degenerate: Literal["convert", "raise"],
    dtype: torch.dtype,
) -> tuple[Motion, FloatArray]:
    """The engine for one system, and its positions on the rows."""
    x = snapshot.positions
    held = ConstraintSet(rows, x, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist())
    motion = Motion(held, x, degenerate=degenerate)
    found = held.residuals(x)
    rounding = torch.finfo(dtype).eps / torch.finfo(torch.float64).eps
    excess = np.abs(found.sigma) / np.maximum(START_TOLERANCE * held.scale, rounding * found.allowed)
    row = int(np.argmax(excess))
    if project:
        return motion, motion.restore_positions(x)
    if excess[row] <= 1:
        return motion, x
    raise InputError(
        f"positions are off {held.row_name(row)} by {abs(found.sigma[row]):.6g}; pass project=True to bring them there",
        item="positions",
        atoms=held.row_atoms(row),
    )
