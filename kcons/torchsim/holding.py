"""Putting constraints on a TorchSim state."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Literal, Unpack

import numpy as np
import torch
from torch_sim import SimState
from torch_sim.constraints import FixAtoms
from torch_sim.integrators import MDState

from kcons.batched import BatchReport
from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.topology.holding import Holding, Options
from kcons.topology.rows_by_name import rows_of
from kcons.topology.topology import Snapshot, require_kind, selected_numbers
from kcons.torchsim.constraints_object import Constraints, constraints_of
from kcons.torchsim.topology import array_of, snapshot_of, starts_of

__all__ = ["hold", "report"]

#: How far positions may be off explicit targets, relative to the scale of a row, beside what their precision leaves.
START_TOLERANCE = 1e-6
_REMEDY = "pass bonds=, pairs of atoms of one system, or guess_bonds=True"


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
        Names in a text with commas, as in "water, hbonds": ``water`` is rigid water, the others are 'hbonds', 'allbonds',
        'hangles' and 'allangles' (with rigid water, too, unless ``rigid_water=False``). Objects of `kcons.constraints`
        number the atoms of a system from 0; targets left open are taken from each system.
    bonds : array_like of int, shape (n, 2), optional
        Bonds of a system; states have none, so that they are guessed otherwise, with a warning if ``guess_bonds`` is not
        True.
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
        Positions off an explicit target while `project` is False; unknown names and atoms; constraints of kcons that are
        there already. The state is unchanged.
    UnsupportedError
        Targets that move with time, constraints on velocities, other constraints of TorchSim.
    """
    require_kind(state, SimState, "state", "a torch_sim.SimState")
    fixed = _taken_over(state)
    given = [constraints] if isinstance(constraints, str | Constraint) else list(constraints)
    named = [item for item in given if isinstance(item, str)]
    objects = [item for item in given if not isinstance(item, str)]
    for item in objects:
        require_kind(item, Constraint, "constraints", "names, and constraints of kcons.constraints")
        if item.moving or not item.holonomic:
            what = "moves with time" if item.holonomic else "constrains velocities"
            raise UnsupportedError(f"{item!r} {what}, and TorchSim tells no time; use kcons.steppers")
    holding = _holding(named, options)
    guessed, known = 0, {}
    motions: list[Motion] = []
    positions = []
    for k in range(state.n_systems):
        snapshot = snapshot_of(state, k, bonds)
        rows = [FixedAtoms(fixed[k])] if len(fixed[k]) else []
        # Copies of one system share its engine.
        key = b"".join(part.tobytes() for part in _content(snapshot, fixed[k]))
        if key not in known:
            try:
                found, count = _named_rows(snapshot, holding)
                known[key] = _bound([*found, *objects, *rows], snapshot, project, degenerate, state.dtype)
            except KconsError as error:
                error.add_note(f"In system {k} of the state, whose atoms are numbered from 0")
                raise
            guessed += count
        motion, x = known[key]
        motions.append(motion)
        positions.append(x)
    held = Constraints(motions, torch.arange(state.n_systems, device=state.device))
    if project:
        state.positions = torch.as_tensor(np.concatenate(positions), dtype=state.dtype, device=state.device)
    state.constraints = [held]
    if guessed and holding is not None and holding.guess_bonds == "missing":
        warnings.warn(
            f"{guessed} bonds were guessed from distances and covalent radii; {_REMEDY} where they are right",
            UserWarning,
            stacklevel=2,
        )
    return held


def report(state: SimState) -> BatchReport:
    """How well a state keeps what is held: residuals of positions, and of momenta where there are any, for each system.

    Raises
    ------
    InputError
        Nothing is held on the state.
    """
    batch, atoms = constraints_of(state).batch(state)
    x = state.positions if atoms is None else state.positions[atoms]
    if not isinstance(state, MDState):
        return batch.report(x)
    return batch.report(x, state.velocities if atoms is None else state.velocities[atoms])


def _taken_over(state: SimState) -> list[Any]:
    """Atoms that TorchSim's FixAtoms holds, of each system numbered from 0."""
    starts = starts_of(state)
    marked = np.zeros(state.n_atoms, dtype=bool)
    for item in state.constraints:
        if isinstance(item, Constraints):
            raise InputError(
                "the state has constraints of kcons; set state.constraints = [] and give all that is held in one call",
                item="state",
            )
        if not isinstance(item, FixAtoms):
            raise UnsupportedError(
                f"{type(item).__name__} of TorchSim would undo the work of the constraints of kcons; leave it out"
            )
        marked[item.atom_idx.cpu().numpy()] = True
    return [np.flatnonzero(marked[a:b]) for a, b in zip(starts[:-1], starts[1:], strict=True)]


def _holding(named: Iterable[str], options: Any) -> Holding | None:
    """Names, and what they mean; None without any."""
    words = [word.strip().lower() for text in named for word in text.split(",")]
    kinds = [word for word in words if word != "water"]
    if len(kinds) > 1:
        raise InputError(
            f"two names of bonds, {kinds[0]} and {kinds[1]}; give the one that holds more", item="constraints"
        )
    if not words:
        if options:
            raise InputError(
                f"{next(iter(options))}= belongs to a name, such as 'hbonds'; give one", item="constraints"
            )
        return None
    return Holding(kinds[0] if kinds else "none", **options)


def _content(snapshot: Snapshot, fixed: Any) -> list[Any]:
    """What an engine is made from beside the rows that are given."""
    topology = snapshot.topology
    cell = np.zeros(0) if snapshot.cell is None else snapshot.cell
    return [topology.elements, topology.masses, snapshot.positions, cell, np.asarray(fixed)]


def _named_rows(snapshot: Snapshot, holding: Holding | None) -> tuple[list[Constraint], int]:
    """Rows by name, and how many bonds were guessed for them."""
    if holding is None:
        return [], 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"\d+ bonds were guessed")
        found = rows_of(snapshot, holding, partial(selected_numbers, n=snapshot.topology.n_atoms), _REMEDY)
    return list(found), found.bonds_guessed


def _bound(
    rows: Sequence[Constraint],
    snapshot: Snapshot,
    project: bool,
    degenerate: Literal["convert", "raise"],
    dtype: torch.dtype,
) -> tuple[Motion, FloatArray]:
    """The engine for one system, and its positions, which are on the rows."""
    x = snapshot.positions
    held = ConstraintSet(rows, x, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist())
    motion = Motion(held, x, degenerate=degenerate)
    found = held.residuals(x)
    rounding = float(torch.finfo(dtype).eps / np.finfo(float).eps)
    allowed = np.maximum(START_TOLERANCE * held.scale, rounding * found.allowed)
    miss = np.abs(found.sigma)
    if np.all(miss <= allowed):
        return motion, x
    if not project:
        row = int(np.argmax(miss / allowed))
        raise InputError(
            f"positions are off {held.row_name(row)} by {miss[row]:.6g}; pass project=True to bring them onto the rows",
            item="positions",
            atoms=held.row_atoms(row),
        )
    return motion, motion.restore_positions(x)
