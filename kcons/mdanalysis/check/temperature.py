"""Masses, degrees of freedom and temperature of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from MDAnalysis.exceptions import NoDataError

from kcons.constraints import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.findings import Part
from kcons.mdanalysis.check.result import fitted
from kcons.mdanalysis.topology import masses_guessed, topology_of

#: Boltzmann's constant in amu Å²/(ps² K).
BOLTZMANN = 0.831446261815324
#: Part of the kinetic energy that the centre of mass may have where its motion is removed.
STILL = 1e-2


def masses_of(universe: Any, given: Sequence[Constraint], labels: AtomNames) -> tuple[FloatArray | None, str]:
    """Masses; or None where they cannot be used, and why.

    Raises
    ------
    InputError
        Constraints on atoms that do not exist, or that need masses.
    """
    used = np.unique(np.concatenate([item.atoms.ravel() for item in given]))
    if len(used) and used[-1] >= len(universe.atoms):
        raise InputError(
            f"there is no atom {used[-1]}; the topology has atoms 0 to {len(universe.atoms) - 1}",
            item="constraints",
            atoms=[int(used[-1])],
        )
    try:
        masses: FloatArray = np.asarray(universe.atoms.masses, dtype=np.float64)
        if masses_guessed(universe):
            masses = topology_of(universe).masses
    except (NoDataError, AttributeError):
        reason = "the topology has no masses"
    else:
        bad = used[~(np.isfinite(masses[used]) & (masses[used] > 0))]
        if not len(bad):
            return masses, ""
        reason = f"{labels.atom(int(bad[0]))} has mass {masses[bad[0]]:g}"
    reason += "; give a topology with masses, such as PSF, PRMTOP or TPR"
    needing = next((item for item in given if item.uses_masses), None)
    if needing is not None:
        raise InputError(f"{needing!r} needs masses, but {reason}", item="masses")
    return None, reason


def temperature_of(
    part: Part, rank: int, masses: FloatArray, removed: int | None
) -> tuple[int, dict[str, float] | None, list[str]]:
    """Degrees of freedom, temperature where there are velocities and masses, and what to say about them.

    Parameters
    ----------
    part : Part
        All frames.
    rank : int
        Of the constraints.
    masses : ndarray, shape (n_atoms,)
    removed : int, optional
        Degrees of freedom that the engine took away; found from the total momentum by default.
    """
    freedom = 3 * int(np.count_nonzero(masses > 0)) - rank
    twice = part.twice_kinetic
    has = np.isfinite(twice)
    if not has.any():
        return max(freedom - (removed or 0), 0), None, []
    remarks = []
    if removed is None:
        centre = np.einsum("ij,ij->i", part.momentum[has], part.momentum[has]) / masses.sum()
        still = float(centre.mean()) < STILL * 3 / max(freedom, 1) * float(twice[has].mean())
        removed = 3 if still and freedom > 3 else 0
        what = "at rest: 3 degrees of freedom less" if removed else "not at rest: it counts"
        remarks.append(f"the centre of mass is {what}")
    freedom -= removed
    if freedom <= 0:
        return 0, None, [*remarks, "no temperature: the constraints leave no degree of freedom"]
    kelvin = twice / (BOLTZMANN * freedom)
    line = fitted(part.times, kelvin)
    temperature = {
        "mean": float(np.nanmean(kelvin)),
        "deviation": float(np.nanstd(kelvin)),
        "frames": float(has.sum()),
        "slope": line.slope if line else float("nan"),
        "slope_error": line.error if line else float("nan"),
    }
    return freedom, temperature, remarks
