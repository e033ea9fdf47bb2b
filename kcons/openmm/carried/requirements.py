"""What a System must be like for rows of kcons to be carried in it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import openmm

from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.precision import Precision

#: Rounding of positions, relative to the shortest row, that a run begins to show.
COARSE = 1e-11


def with_massless_atoms(given: tuple[Constraint, ...], masses: FloatArray) -> tuple[Constraint, ...]:
    """The constraints, with `FixedAtoms` for particles without mass, which OpenMM does not move."""
    if not all(isinstance(item, Constraint) for item in given):
        return given  # ConstraintSet says what is wrong
    used = [item.atoms.ravel() for item in given]
    touched = np.unique(np.concatenate(used))
    still = touched[touched < len(masses)]
    still = still[masses[still] == 0]
    fixed = [item.atoms.ravel() for item in given if item.family == "FixedAtoms"]
    still = np.setdiff1d(still, np.concatenate([*fixed, np.zeros(0, np.int64)]))
    return (*given, FixedAtoms(still)) if len(still) else given


def free_groups(system: openmm.System, count: int) -> list[int]:
    taken = {force.getForceGroup() for force in system.getForces()}
    free = [g for g in reversed(range(32)) if g not in taken]
    if len(free) < count:
        raise UnsupportedError(f"rows need {count} force groups, and {len(free)} are free; use fewer groups for forces")
    return free[:count]


def refuse_virtual_sites(system: openmm.System, atoms: IntArray, masses: FloatArray) -> None:
    """Refuse virtual sites among `atoms`, and what is no particle of the System."""
    if atoms.max(initial=0) >= len(masses):
        raise InputError(f"there is no atom {atoms.max()}; the System has {len(masses)} particles", item="atoms")
    for atom in atoms[masses[atoms] == 0].tolist():
        if system.isVirtualSite(atom):
            raise UnsupportedError(f"atom {atom} is a virtual site; hold the atoms that it is placed by")


def refuse_single_precision(precision: Precision) -> None:
    """Refuse single precision: GPUs hand positions to PythonForces in the precision in which they store them."""
    if precision.name == "single":
        raise UnsupportedError(
            f"{precision} hands positions to rows of kcons' constraint objects that are too coarse for them; make the "
            "Context with {'Precision': 'mixed'}, or hold the rows by CollectiveRows, which the platform computes"
        )


def refuse_some_particles(force: openmm.PythonForce, precision: Precision) -> None:
    """Refuse forces on some particles in mixed precision: OpenMM hands over their positions in single precision."""
    if precision.name == "mixed" and force.getParticles():
        raise UnsupportedError(
            f"the forces that carry the rows were made where no GPU was, and {precision} would hand over positions "
            "that are too coarse; read the System by CarriedConstraints.of(system) before the Context is made"
        )


def refuse_shared_atoms(system: openmm.System, touched: set[int]) -> None:
    """Constraints of the System are solved by OpenMM, and must not share atoms with the rows."""
    for k in range(system.getNumConstraints()):
        i, j, _ = system.getConstraintParameters(k)
        if touched & {i, j}:
            raise UnsupportedError(
                f"constraint {k} of the System, between atoms {i} and {j}, shares an atom with the rows; let "
                "kcons hold it too: hold(system, ...) moves such constraints, or add take_constraints(system)"
            )


def warned_of_rounding(reach: float, grain: float, scale: float) -> bool:
    """Warn of coordinates so large that their rounding adds noise to the velocities."""
    if grain <= COARSE * scale:
        return False
    warnings.warn(
        f"held particles are {reach:.3g} nm from the origin, where OpenMM rounds positions to {grain:.1g} nm; each "
        "step turns this into velocity, and the energy wanders. Move the origin nearer",
        stacklevel=4,
    )
    return True


def refuse_agents(system: openmm.System, held: ConstraintSet, molecules: Callable[[], Any]) -> None:
    """Refuse barostats and other forces that move particles off the rows between steps."""
    bound = next((item for item in held.constraints if not item.translation_invariant), None)
    for force in system.getForces():
        name = type(force).__name__
        if isinstance(force, openmm.CMMotionRemover) and bound is not None:
            raise UnsupportedError(
                f"{name} shifts all velocities, but {bound!r} ties atoms to a place, and momentum is not conserved; "
                "remove that force (createSystem(..., removeCMMotion=False))"
            )
        if "Barostat" not in name:
            continue
        if bound is not None:
            raise UnsupportedError(
                f"{name} moves molecules, but {bound!r} ties atoms to a place; run at constant volume, or hold "
                "differences of positions only"
            )
        rigid = getattr(force, "getScaleMoleculesAsRigid", None)
        if rigid is not None and not rigid():
            raise UnsupportedError(f"{name} scales atoms one by one; call setScaleMoleculesAsRigid(True)")
        row = _row_between(held, molecules())
        if row is not None:
            raise UnsupportedError(
                f"{name} moves molecules apart, but row {held.row_name(row)} holds atoms of two of them; let them "
                "count as one molecule by hold(system, ..., join=True), or run at constant volume"
            )


def _row_between(held: ConstraintSet, molecules: Any) -> int | None:
    """A row with atoms of several molecules."""
    label = np.zeros(held.n_atoms, dtype=np.int64)
    for k, atoms in enumerate(molecules):
        label[list(atoms)] = k
    for item, start in zip(held.constraints, held.starts, strict=False):
        of = label[item.atoms]
        apart = (of != of[:, :1]).any(axis=1)
        if apart.any():
            return int(start + np.argmax(apart))
    return None
