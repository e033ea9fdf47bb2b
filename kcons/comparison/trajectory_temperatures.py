"""Temperatures of configurations along a trajectory of any engine, with forces that the user names."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ase.units import kB
from scipy.sparse.csgraph import connected_components

from kcons.comparison import test_systems
from kcons.constraints.periodic.one_piece import make_whole, spanning_tree
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import System
from kcons.thermostats import Estimate, SplitTemperatures, TemperatureSplit

#: Fewest frames.
MIN_FRAMES = 32
#: Standard errors up to which no difference is seen, and the relative error for which the number of frames is stated.
DOUBT, GOAL = 3.0, 0.01
#: Change of the box, relative, above which the forces are those of another system.
CHANGED = 1e-3
#: Spread of a length, relative, below which something may hold it: at 300 K bonds vibrate by 2 %, and XTC files round
#: by 0.3 %.
STIFF = 5e-3


def along(
    trajectory: Path | str, topology: Path | str, forces: str, frames: Sequence[int], **options: Any
) -> SplitTemperatures:
    """Temperatures of these frames of a trajectory that MDAnalysis reads, each brought onto the constraints; kT in eV.

    `forces` and options (constrain, select, force_field, platform) are those of `test_systems.from_file`.
    """
    if len(frames) < MIN_FRAMES:
        raise InputError(f"{len(frames)} frames are too few for temperatures; give {MIN_FRAMES} or more", item="frames")
    from kcons.mdanalysis import open_universe

    where: dict[str, Any] = {"coordinates": trajectory, "frame": frames[0]}  # whose box the forces have
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*bonds were guessed", category=UserWarning)  # the check says so
        test_system = test_systems.from_file(topology, forces=forces, **where, **options)
    motion, potential, lattice = test_system.motion, test_system.potential, test_system.constraint_set.lattice
    given = {name: value for name, value in options.items() if name not in ("force_field", "platform")}
    described = test_systems.plan(topology, angles="distances", **where, **given).rows.snapshot.topology
    bonds = described.bonds
    joins = test_system.constraint_set.incidence.astype(int)
    cluster = connected_components(joins.T @ joins, directed=False)[1]
    free = bonds[cluster[bonds[:, 0]] != cluster[bonds[:, 1]]]
    sums = np.zeros((2, len(free)))
    tree = spanning_tree(bonds, len(test_system.positions))
    split = TemperatureSplit(System(motion, potential.forces))
    universe = open_universe(topology, trajectory)
    first = None
    for number in frames:
        ts = universe.trajectory[number]
        first = ts._unitcell.copy() if first is None else first  # zeros where there is none
        if not np.allclose(ts._unitcell, first, rtol=CHANGED):
            raise UnsupportedError(
                f"the box of frame {number} is another one than that of the first frame: its forces are not those of "
                "this system. Temperatures of configurations need a run at constant volume"
            )
        x = make_whole(np.array(ts.positions, dtype=np.float64), *tree, lattice)
        split.add(motion.restore_positions(x))
        lengths = np.linalg.norm(x[free[:, 0]] - x[free[:, 1]], axis=1)
        sums += lengths, lengths**2
    mean, squares = sums / len(frames)
    stiff = free[squares - mean**2 < (STIFF * mean) ** 2]
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        found = split.result()
    told = [*found.left_out, *dict.fromkeys(str(doubt.message) for doubt in doubts)]
    for i, j in stiff[:1].tolist():
        told.append(
            f"{len(stiff)} bonds that nothing was said to hold keep their length within {STIFF:.1%}, the first of them "
            f"from {described.atom_name(i)} to {described.atom_name(j)}: if the run held them, these temperatures are "
            "too low; name all that it held (--constrain)"
        )
    return replace(found, left_out=tuple(told))


def sentences(found: SplitTemperatures, asked: float | None = None) -> list[str]:
    """The same in kelvin, for a person; with `asked`, the temperature of the thermostat, whether it is the same."""
    kinds: tuple[tuple[str, Estimate | None], ...] = (
        ("shifts of whole clusters", found.shift),
        ("turns of whole clusters", found.turn),
        ("all other motions", found.internal),
    )
    told = [f"{what} {e.value / kB:.1f} ± {e.error / kB:.1f} K" for what, e in kinds if e is not None]
    lines = [f"temperatures of the configurations, of {found.samples} frames: {', '.join(told)}"]
    if asked is not None:
        lines.append(_beside(asked, [(what, e) for what, e in kinds if e is not None]))
    unknown = max((e.error / abs(e.value) for _, e in kinds if e is not None), default=0.0)
    if GOAL < unknown < math.inf:
        frames = float(f"{found.samples * (unknown / GOAL) ** 2:.1g}")
        lines.append(f"errors of {GOAL:.0%} take some {frames:,.0f} frames as far apart as these")
    return [*lines, *found.left_out]


def _beside(asked: float, found: list[tuple[str, Estimate]]) -> str:
    """Whether temperatures are the one that was asked for, in kelvin."""
    off = [(what, e.value / kB / asked - 1, e.off(kB * asked)) for what, e in found]
    wrong = [
        f"{what} {abs(part):.1%} too {'warm' if part > 0 else 'cold'} ({abs(errors):.1f} standard errors)"
        for what, part, errors in off
        if abs(errors) > DOUBT
    ]
    if not wrong:
        return f"none can be told from {asked:g} K: all are within {DOUBT:g} standard errors"
    causes = "the step is too long, the run is not yet in equilibrium, or the thermostat keeps another temperature"
    return f"not {asked:g} K: {', '.join(wrong)}; {causes}"
