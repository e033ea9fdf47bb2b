"""How fast `kcons check` reads a long trajectory, beside the reader alone, and how much memory it takes.

    python examples/studies/check_speed.py --quick --out DIR     files of 0.2 MB, seconds
    python examples/studies/check_speed.py --out DIR             files of 0.2 GB, some minutes

The files are made in a temporary folder and deleted: rigid water that tumbles and wanders through a periodic cell, all
three distances of each molecule held. DIR/trajectory_check.csv has a row for each format, number of atoms and kind of
work ('reader', 1, 2: processes that check): seconds of processor time, of all processes together, those that setting up
takes besides, and the peak of memory in MB. Each is the best of three, in a process of its own, in turns.
"""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent))

import harness

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import MDAnalysis as mda

from kcons.constraints import Distance
from kcons.mdanalysis import ConstraintCheck

#: Format and number of molecules.
CASES, SMALL = [("dcd", 33_000), ("xtc", 33_000), ("dcd", 3_000)], [("xtc", 1_000)]
OXYGEN_HYDROGEN, ANGLE = 0.9572, np.radians(104.52)
SHAPE = OXYGEN_HYDROGEN * np.array(
    [[0, 0, 0], [np.sin(ANGLE / 2), np.cos(ANGLE / 2), 0], [-np.sin(ANGLE / 2), np.cos(ANGLE / 2), 0]]
)


def make(path: Path, molecules: int, size: float) -> None:
    """Write frames until the file has `size` bytes."""
    rng = np.random.default_rng(2)
    side = (molecules / 0.0334) ** (1 / 3)
    turns, _ = np.linalg.qr(rng.normal(size=(molecules, 3, 3)))
    centers = rng.random((molecules, 1, 3)) * side
    universe = mda.Universe.empty(3 * molecules, trajectory=True)
    universe.dimensions = [side, side, side, 90, 90, 90]
    with mda.Writer(str(path), 3 * molecules) as writer:
        while not path.exists() or path.stat().st_size < size:
            centers = (centers + rng.normal(size=centers.shape) * 0.3) % side
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            universe.atoms.positions = (centers + SHAPE @ turns @ turn).reshape(-1, 3)
            writer.write(universe.atoms)


def measured(path: str, molecules: int, work: str) -> dict[str, Any]:
    """One reading of a file by this process."""
    import resource

    universe = mda.Universe.empty(3 * molecules, trajectory=False)
    # Without the format, MDAnalysis imports OpenMM and its platforms, which may take 80 MB.
    universe.load_new(path, format=Path(path).suffix[1:])
    setup = 0.0

    def clock() -> float:
        return sum(os.times()[:4])

    if work == "reader":
        start = clock()
        for _ in universe.trajectory:
            pass
        seconds = clock() - start
    else:
        pairs = (3 * np.arange(molecules)[:, None, None] + [[0, 1], [0, 2], [1, 2]]).reshape(-1, 2)
        lengths = np.linalg.norm(SHAPE[[0, 0, 1]] - SHAPE[[1, 2, 2]], axis=1)
        check = ConstraintCheck(universe, Distance(pairs, np.tile(lengths, molecules)))
        check.run(stop=1)  # compiles
        start = clock()
        check.run(stop=1)
        setup, start = clock() - start, clock()
        check.run(**({"backend": "multiprocessing", "n_workers": 2} if work == "2" else {}))
        seconds = clock() - start - setup
        assert check.check.status == "kept"
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return {"frames": universe.trajectory.n_frames, "seconds": seconds, "setup": setup, "peak": peak / 1024}


def case(ending: str, molecules: int, size: float, turns: int) -> Iterator[dict[str, Any]]:
    best: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"water.{ending}"
        make(path, molecules, size)
        for _ in range(turns):
            for work in ("reader", "1", "2"):
                command = [sys.executable, "-W", "ignore", __file__, "--measure", str(path), str(molecules), work]
                found = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
                if work not in best or found["seconds"] < best[work]["seconds"]:
                    best[work] = found
        for work, found in best.items():
            yield {"format": ending, "atoms": 3 * molecules, "bytes": os.path.getsize(path), "work": work, **found}


def tables(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """For the page."""
    lines = []
    for (_, ending, atoms), some in rows.groupby(["piece", "format", "atoms"], sort=False):
        of = some.assign(work=some["work"].astype(str)).set_index("work")
        reader, one, two = (of.loc[work] for work in ("reader", "1", "2"))
        lines.append(
            {
                "file": f"{ending.upper()}, {one.frames} frames of {atoms:,} atoms",
                "reader alone": f"{reader.seconds:.2f} s",
                "check": f"{one.seconds:.2f} s",
                "setting up": f"{one.setup:.2f} s",
                "two processes together": f"{two.seconds:.2f} s",
                "peak memory": f"{one.peak:.0f} MB",
            }
        )
    return {"speed": pd.DataFrame(lines)}


def main() -> None:
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measured(sys.argv[2], int(sys.argv[3]), sys.argv[4])))
        return
    chosen = harness.options(__doc__, "trajectory_check").parse_args()
    size, turns = (2e5, 1) if chosen.quick else (2e8, 3)
    pieces = {
        f"{ending}-{n}": partial(case, ending, n, size, turns) for ending, n in (SMALL if chosen.quick else CASES)
    }
    rows = harness.run(chosen.out / "trajectory_check.csv", pieces, size=size)
    print(tables(rows)["speed"].to_string(index=False))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
