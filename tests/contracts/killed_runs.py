"""Windows and relaxed scans that are killed (SIGKILL) at random times, against runs that nobody disturbed.

    python tests/contracts/killed_runs.py           30 kills each, into docs/results/killed_runs.json
    python tests/contracts/killed_runs.py KIND      of one kind
    python tests/contracts/killed_runs.py KIND DIR  one run, begun or gone on with

After each kill what was finished must still be there, byte for byte; at the end the result must be that of the run
that was not killed, to the last bit, and nothing that was finished may have been done again.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from ase.build import molecule
from ase.calculators.emt import EMT

from kcons.comparison import environment
from kcons.constraints import Angle, Dihedral
from kcons.free_energy import AseWindows, Settings, Windows, scan
from kcons.steppers.files import text

RESULT = Path(__file__).parents[2] / "docs" / "results" / "killed_runs.json"
TORSION = Dihedral([[2, 0, 1, 3]])
#: Seconds after its first note within which a run is killed.
LATEST = 0.2


def windows(folder: Path) -> dict[str, object]:
    """40 windows of the torsion of H2O2 with EMT, from both sides; every run of 150 steps is noted when it is done."""

    class Noted(AseWindows):
        def sample(self, window, settings, file):
            super().sample(window, settings, file)
            note(folder, window.name)

    sampler = Noted(molecule("H2O2"), EMT, {"torsion": TORSION}, [Angle([[2, 0, 1], [0, 1, 3]])])
    settings = Settings(timestep=0.5, relax=5, pull=20, equilibration=30, production=100, every=2)
    windows = Windows(sampler, folder / "out", settings, executor=ThreadPoolExecutor(1))
    found = windows.run(np.radians(np.linspace(60, 300, 40)))
    assert not found.failed, found.failed
    return found.numbers()


def relaxed(folder: Path) -> dict[str, object]:
    """121 points of the same torsion relaxed, from both neighbors; relaxations that are there are noted."""
    atoms = molecule("H2O2")
    atoms.calc = EMT()

    def progress(done: int, points: int, line: str) -> None:
        note(folder, "done")

    values = np.radians(np.linspace(60, 300, 121))
    found = scan(atoms, TORSION, values, folder=folder / "out", fmax=0.002, progress=progress)
    assert not found.failed, found.failed
    positions = [found.best[point].positions.tolist() for point in sorted(found.best)]
    return {"energies": found.energies.tolist(), "positions": positions, "relaxations": len(found.attempts)}


KINDS = {"windows": windows, "scan": relaxed}


def note(folder: Path, name: str) -> None:
    with (folder / "diary").open("a") as diary:
        diary.write(name + "\n")


def finished(folder: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in (folder / "out").rglob("*.npz")}


def once(kind: str, folder: Path, after: float | None) -> bool:
    """A run in a process of its own, killed so many seconds after it began to work; whether it ended by itself."""
    folder.mkdir(exist_ok=True)
    diary = folder / "diary"
    seen = diary.stat().st_size if diary.exists() else 0
    command = [sys.executable, "-W", "ignore", str(Path(__file__).resolve()), kind, str(folder)]
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"})
    while after is not None and process.poll() is None:
        if diary.exists() and diary.stat().st_size > seen:
            time.sleep(after)
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.005)
    status = process.wait(timeout=300)
    assert status in (0, -signal.SIGKILL), status
    return status == 0


def killed(kind: str, folder: Path, kills: int) -> dict[str, object]:
    """What became of `kills` kills; raises AssertionError where something finished was lost, or the result differs."""
    whole, broken = folder / f"{kind}-whole", folder / f"{kind}-killed"
    assert once(kind, whole, None)
    rng, before, counts, begun = np.random.default_rng(5), {}, [], 0
    while begun < kills:
        if once(kind, broken, rng.uniform(0, LATEST)):
            break  # all done before the last kill
        begun += 1
        now = finished(broken)
        lost = [name for name, content in before.items() if now.get(name) != content]
        assert not lost, lost
        before = now
        counts.append(len(now))
    assert once(kind, broken, None)
    now = finished(broken)
    assert all(now[name] == content for name, content in before.items())
    one, other = ((f / "result.json").read_text() for f in (whole, broken))
    assert one == other
    # Windows are noted once they are done, relaxations whenever they are there.
    noted = len((broken / "diary").read_text().split())
    return {
        "kills": begun,
        "finished after each": counts,
        "in all": len(now),
        "lost": 0,
        "noted": noted,
        "result": "identical",
    }


def main(arguments: list[str]) -> None:
    if len(arguments) == 2:
        kind, folder = arguments[0], Path(arguments[1])
        found = KINDS[kind](folder)
        (folder / "result.json").write_text(json.dumps(found))
        return
    for kind in arguments or KINDS:
        with tempfile.TemporaryDirectory() as folder:
            row = killed(kind, Path(folder), 30)
        print(kind, row)
        known = json.loads(RESULT.read_text()) if RESULT.exists() else {}
        RESULT.write_text(text(known | {kind: row, "machine": environment()}, 1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
