"""Rows whose Forces are internal coordinates, as constraints of kcons: what far targets are reached with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm
from numpy.typing import ArrayLike

from kcons.constraints import Angle, CenterDistance, Dihedral, Distance
from kcons.constraints.constraint import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import KconsError
from kcons.motion.motion import Motion
from kcons.openmm.integrator.guard import positions_of
from kcons.openmm.integrator.system_checks import SystemRows

#: Two values of one coordinate, by OpenMM and by kcons, differ by less.
SAME = 1e-5
#: Expressions over the points of one term, and what they are.
_OF_POINTS: dict[str, type[Constraint]] = {
    "distance(p1,p2)": Distance,
    "angle(p1,p2,p3)": Angle,
    "dihedral(p1,p2,p3,p4)": Dihedral,
}
_OF_TERMS: dict[str, tuple[str, str, int, type[Constraint]]] = {
    "CustomBondForce": ("r", "Bond", 2, Distance),
    "CustomAngleForce": ("theta", "Angle", 3, Angle),
    "CustomTorsionForce": ("theta", "Torsion", 4, Dihedral),
}


def as_constraint(force: openmm.Force, target: float) -> Constraint | None:
    """The constraint of kcons that a Force of one term is; None where it is none of the plain ones.

    Parameters
    ----------
    force : openmm.Force
    target : float
        In nm or radian.
    """
    expression = force.getEnergyFunction().replace(" ", "") if hasattr(force, "getEnergyFunction") else ""
    if isinstance(force, openmm.CustomCVForce):
        names = [force.getCollectiveVariableName(k) for k in range(force.getNumCollectiveVariables())]
        if expression not in names:
            return None
        return as_constraint(force.getCollectiveVariable(names.index(expression)), target)
    if isinstance(force, openmm.CustomCompoundBondForce):
        if force.getNumBonds() != 1 or expression not in _OF_POINTS:
            return None
        return _OF_POINTS[expression](list(force.getBondParameters(0)[0]), target)
    if isinstance(force, openmm.CustomCentroidBondForce):
        if force.getNumBonds() != 1 or expression != "distance(g1,g2)":
            return None
        groups = [force.getGroupParameters(g) for g in force.getBondParameters(0)[0]]
        if any(weights for _, weights in groups):  # by mass without them, as in kcons
            return None
        (first, _), (second, _) = groups
        return CenterDistance(list(first), list(second), target)
    plain, term, width, kind = _OF_TERMS.get(type(force).__name__, ("", "", 0, Distance))
    if not width or expression != plain or getattr(force, f"getNum{term}s")() != 1:
        return None
    return kind(list(getattr(force, f"get{term}Parameters")(0)[:width]), target)


def near_targets(
    context: openmm.Context,
    forces: Sequence[openmm.Force | None],
    off: FloatArray,
    targets: FloatArray,
    bonds: ArrayLike,
) -> FloatArray | None:
    """Positions on far targets and on the System's constraints, groups moved whole; None where rows are not plain.

    Parameters
    ----------
    context : openmm.Context
    forces : sequence
        The Force of each row, None where there are several.
    off, targets : ndarray, shape (n_rows,)
        By how much rows are off, by their Forces, and what they are to be.
    bonds : array_like of int, shape (n, 2)
        See `Motion.restore_positions`.

    Raises
    ------
    InfeasibleError
        There is no way, or other bonds and angles would change.
    """
    system = context.getSystem()
    plain = [None if f is None else as_constraint(f, float(t)) for f, t in zip(forces, targets, strict=True)]
    rows = [row for row in plain if row is not None]
    if len(rows) < len(plain):
        return None
    x = positions_of(context)
    held = SystemRows.of(system)
    if held.n_rows:
        rows.append(Distance(held.pairs, held.lengths))
    try:
        motion = Motion(ConstraintSet(rows, x, held.masses), x)
    except KconsError:
        # Rows that contradict each other or massless particles: what is wrong Newton's method is to say.
        return None
    ours = motion.sources[0].residuals(x, None, 0.0).sigma[: len(off)]
    if not np.all(np.abs(ours - off) < SAME * np.maximum(1.0, np.abs(targets))):  # other images of particles
        return None
    return motion.restore_positions(x, bonds=bonds)
