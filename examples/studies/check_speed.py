"""How fast `kcons check` reads a long trajectory, beside the reader alone, and how much memory it takes.

    python check_speed.py                 # small, seconds
    python check_speed.py --full --out docs/results/trajectory_check.json     # 1 GB files
    python check_speed.py --full --cold --out docs/results/trajectory_check.json    # memory, into the same

The files are made in a temporary folder and deleted: rigid water that tumbles and wanders through a periodic cell.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import MDAnalysis as mda

from kcons.comparison import environment
from kcons.constraints import Distance
from kcons.mdanalysis import ConstraintCheck
from kcons.steppers.files import text

OXYGEN_HYDROGEN, ANGLE = 0.9572, np.radians(104.52)
READ = """
import sys, time, resource, json, warnings
warnings.simplefilter("ignore")
import MDAnalysis as mda
u = mda.Universe.empty(int(sys.argv[2]))
u.load_new(sys.argv[1], format=sys.argv[3])
for ts in u.trajectory[:3]: pass
cpu, wall = time.process_time(), time.perf_counter()
for ts in u.trajectory: pass
print(json.dumps({"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall,
                  "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))
"""


def water(n: int) -> np.ndarray:
    """Offsets of the atoms of one molecule, turned in n ways, shape (n, 3, 3)."""
    rng = np.random.default_rng(1)
    half = 0.5 * ANGLE
    flat = OXYGEN_HYDROGEN * np.array([[0, 0, 0], [np.sin(half), np.cos(half), 0], [-np.sin(half), np.cos(half), 0]])
    turns, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    return np.einsum("ai,nij->naj", flat, turns)


def make(path: str, molecules: int, size: float) -> int:
    """Write frames until the file has `size` bytes; their number."""
    rng = np.random.default_rng(2)
    side = (molecules / 0.0334) ** (1 / 3)
    shapes = [water(molecules)]
    centres = rng.random((molecules, 1, 3)) * side
    universe = mda.Universe.empty(3 * molecules, trajectory=True)
    universe.dimensions = [side, side, side, 90, 90, 90]
    frames = 0
    with mda.Writer(path, 3 * molecules) as writer:
        while frames < 4 or os.path.getsize(path) < size:
            centres = (centres + rng.normal(size=centres.shape) * 0.3) % side
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            universe.atoms.positions = (centres + shapes[0] @ turn).reshape(-1, 3)
            writer.write(universe.atoms)
            frames += 1
    return frames


def rows(molecules: int) -> Distance:
    """All three distances of every molecule."""
    o = 3 * np.arange(molecules)
    pairs = np.stack([o, o + 1, o, o + 2, o + 1, o + 2], axis=1).reshape(-1, 2)
    return Distance(pairs, np.tile([OXYGEN_HYDROGEN] * 2 + [2 * OXYGEN_HYDROGEN * np.sin(ANGLE / 2)], molecules))


def reading(path: str, atoms: int) -> dict[str, float]:
    """The reader alone, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", READ, path, str(atoms), Path(path).suffix[1:]],
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(json.loads(done.stdout))


def checking(path: str, molecules: int, workers: int, cache: str | None = None) -> dict[str, float]:
    """The check, in a process of its own; with a folder of its own for compiled kernels where one is given."""
    command = [sys.executable, __file__, "--check", path, str(molecules), str(workers)]
    variables = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": cache})
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=variables)
    return dict(json.loads(done.stdout))


def commanding(path: str, topology: str, workers: int, cache: str, folder: str) -> float:
    """Memory of `kcons check` in MB: of the largest of its processes."""
    words = ["check", path, "--topology", topology, "--workers", str(workers), "--out", folder]
    command = [sys.executable, "-c", "import sys; from kcons.cli.main import main; sys.exit(main())", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"NUMBA_CACHE_DIR": cache})
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"kcons check {path} ended with {process.returncode}")
    return used.ru_maxrss / 1024


def first_checks(path: str, molecules: int, frames: int) -> list[dict[str, object]]:
    """Memory of a check on a machine where nothing is compiled yet, with one worker and with two."""
    folder = Path(path).parent
    named = mda.Universe.empty(
        3 * molecules, n_residues=molecules, atom_resindex=np.repeat(np.arange(molecules), 3), trajectory=False
    )
    named.add_TopologyAttr("names", ["OW", "HW1", "HW2"] * molecules)
    named.add_TopologyAttr("resnames", ["SOL"] * molecules)
    named.add_TopologyAttr("resids", np.arange(1, molecules + 1))
    named.load_new(path)
    topology = str(folder / "water.gro")
    named.atoms.write(topology)
    found: list[dict[str, object]] = []
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
            measured = checking(path, molecules, workers, one)
            found.append(
                {
                    "format": Path(path).suffix[1:],
                    "atoms": 3 * molecules,
                    "frames": frames,
                    "bytes": os.path.getsize(path),
                    "workers": workers,
                    "peak": measured["peak"],
                    "peak_of_others": measured["peak_worker"],
                    "peak_of_command": commanding(path, topology, workers, other, str(folder / "report")),
                }
            )
        print(
            f"{found[-1]['format']}, {3 * molecules} atoms, workers: {workers}, nothing compiled: peak "
            f"{measured['peak']:.0f} MB, other processes up to {measured['peak_worker']:.0f} MB, "
            f"kcons check {found[-1]['peak_of_command']:.0f} MB",
            flush=True,
        )
    return found


def check(path: str, molecules: int, workers: int) -> None:
    import resource

    universe = mda.Universe.empty(3 * molecules, trajectory=False)
    universe.add_TopologyAttr("masses", np.tile([15.999, 1.008, 1.008], molecules))
    # Without the format, MDAnalysis imports OpenMM and its platforms, which may take 80 MB.
    universe.load_new(path, format=Path(path).suffix[1:])
    job = ConstraintCheck(universe, rows(molecules))
    job.run(stop=3)  # compile
    start = time.perf_counter()
    parallel = {"n_workers": workers} if workers > 1 else {}
    setup = time.process_time(), time.perf_counter()
    job._bind(0)
    setup = time.process_time() - setup[0], time.perf_counter() - setup[1]
    cpu, start = time.process_time(), time.perf_counter()
    job.run(**parallel)
    result = job.check
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found = {
        "cpu": time.process_time() - cpu - setup[0],
        "wall": time.perf_counter() - start - setup[1],
        "setup": setup[0],
        "peak": peak,
        "peak_worker": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
        "cpu_workers": sum(os.times()[2:4]),
        "status": result.status,
        "largest": result.units[0].largest,
    }
    print(json.dumps(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="files of 1 GB")
    parser.add_argument("--size", type=float, default=1.0, help="with --full: size of the files in GB")
    parser.add_argument("--cold", action="store_true", help="only the memory of a first check, nothing compiled yet")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--check", nargs=3, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    if chosen.check:
        check(chosen.check[0], int(chosen.check[1]), int(chosen.check[2]))
        return
    size, repeats = (1e9 * chosen.size, 3) if chosen.full else (2e6, 1)
    cases = (("dcd", 33_000), ("xtc", 33_000), ("dcd", 3_000)) if chosen.full else (("xtc", 1_000),)
    results: list[dict[str, object]] = []
    if chosen.cold:
        for ending, molecules in cases:
            with tempfile.TemporaryDirectory() as place:
                path = str(Path(place) / f"water.{ending}")
                results += first_checks(path, molecules, make(path, molecules, size))
        if chosen.out:
            data = json.loads(chosen.out.read_text()) if chosen.out.exists() else {}
            data["cold"] = {"environment": environment() | {"mdanalysis": mda.__version__}, "cases": results}
            chosen.out.write_text(text(data, 1) + "\n")
        return
    for ending, molecules in cases:
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / f"water.{ending}")
            frames = make(path, molecules, size)
            best: dict[str, dict[str, float]] = {}
            for _ in range(repeats):
                # In turns, so that other work on the machine meets all of them.
                for name, measured in (
                    ("reader", reading(path, 3 * molecules)),
                    ("check", checking(path, molecules, 1)),
                    ("two workers", checking(path, molecules, 2)),
                ):
                    key = "wall" if name == "two workers" else "cpu"
                    if name not in best or measured[key] < best[name][key]:
                        best[name] = measured
            ratio = best["reader"]["cpu"] / best["check"]["cpu"]
            gain = best["check"]["wall"] / best["two workers"]["wall"]
            results.append(
                {
                    "format": ending,
                    "atoms": 3 * molecules,
                    "frames": frames,
                    "bytes": os.path.getsize(path),
                    "speed_of_reader": ratio,
                    "gain_of_two_workers": gain,
                    **best,
                }
            )
        alone, one = best["reader"], best["check"]
        print(
            f"{ending}: {frames} frames of {3 * molecules} atoms; reader {alone['cpu']:.2f} s, "
            f"check {one['cpu']:.2f} s of CPU time ({ratio:.0%} of the reader's speed) + {one['setup']:.2f} s; "
            f"peak {one['peak']:.0f} MB; two workers {gain:.2f} times as fast; {one['status']}"
        )
    if chosen.out:
        machine = environment() | {"mdanalysis": mda.__version__, "load": os.getloadavg()[0]}
        chosen.out.parent.mkdir(parents=True, exist_ok=True)
        data = {"environment": machine, "cases": results}
        if chosen.out.exists():
            # Memory of first checks is measured by itself.
            data |= {key: value for key, value in json.loads(chosen.out.read_text()).items() if key == "cold"}
        chosen.out.write_text(text(data, 1) + "\n")
        print(f"wrote {chosen.out}")


if __name__ == "__main__":
    main()
