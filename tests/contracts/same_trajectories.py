"""Short trajectories of everything that can be held and every way to run it, as hashes of the states they end in.

A change that is not meant to change what is computed must leave every one of them as it was::

    python tests/contracts/same_trajectories.py --against HEAD

runs this file here and on a clean checkout of a commit, prints what differs, and exits with 1 if anything does. The
checkout stays in the folder for temporary files, with the kernels that were compiled there: the first comparison with a
commit takes minutes, later ones one. Another processor gives other hashes, so that none are kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path

# Sums by several threads may be taken in another order.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENMM_CPU_THREADS", "1")

sys.path.append(str(Path(__file__).resolve().parents[1] / "systems"))

import numpy as np
from cell_oracle import stepper_of
from cell_worlds import world
from constraint_cases import CASES
from hosts import HOSTS, problem
from test_listings import ALL

import kcons
from kcons import ConstraintSet, Motion, State, System, run
from kcons.comparison import METHODS, test_systems
from kcons.errors import KconsError
from kcons.thermostats import thermal_velocities

ROOT = Path(__file__).resolve().parents[2]
#: Test systems by size: each solver of distances, alone and beside others, and rows of other families.
SIZES = {"water": 27, "chain": 9, "chain-free": 150, "chain-straight": 60, "sphere": 5, "slab": 2}
ALONE = ("ethanol", "butane", "rotor", "dumbbells", "double-pendulum")
#: Random molecules of all families in random cells.
WORLDS = 200

Trail = list[tuple[np.ndarray, np.ndarray]]


def by_methods() -> Iterator[tuple[str, Trail]]:
    """Every method of kcons' own in `kcons compare`: a step by itself, and more at once."""
    for name in (*SIZES, *ALONE):
        options = {"forces": {"water": "ase", "ethanol": "emt"}[name]} if name in ("water", "ethanol") else {}
        system = test_systems.build(name, SIZES.get(name), **options)
        for method in METHODS.values():
            if method.refusal(system) is None and (method.engine == "arrays" or "kcons" in method.title):
                setting = 1e-11 if method.adaptive else method.settings(system)[-1]
                moving = method.start(system, setting)
                moving.advance()
                seen = [moving.observe()]
                moving.advance(4)
                yield f"{name}: {method.name}", [*seen, moving.observe()]


def by_steppers() -> Iterator[tuple[str, Trail]]:
    """Every stepper and thermostat."""
    for name in ("chain", "chain-free", "water", "slab"):
        made = test_systems.build(name, SIZES[name], **({"forces": "ase"} if name == "water" else {}))
        system = System(made.motion, made.potential.forces, potential=made.potential.energy)
        v = thermal_velocities(system, made.positions, made.thermal_energy, 11)
        for number, stepper in enumerate(ALL):
            start, dt = State(made.positions, v), made.time_steps[-1]
            try:
                end = run(system, start, dt, 5, stepper=stepper)
                if stepper.reversible:
                    end = run(system, end, -dt, 2, stepper=stepper)
            except KconsError:
                continue  # not for such systems
            yield f"{name}: {number} {stepper!r}", [(end.positions, end.velocities)]


def in_random_cells() -> Iterator[tuple[str, Trail]]:
    for seed in range(WORLDS):
        w = world(seed)
        try:
            held = ConstraintSet(w.constraints(), w.stored(), w.masses, cell=w.cell, pbc=w.pbc)
            motion = Motion(held, w.stored())
            anchors = w.stored(w.anchors)
            system = System(motion, lambda x, t, k=w.springs, at=anchors: -k * (x - at))
            end = run(system, State(w.stored(), w.v), w.dt, w.steps, stepper=stepper_of(w.stepper))
            back = motion.restore_positions(end.positions + 0.01 * np.sin(np.arange(end.positions.size)).reshape(-1, 3))
            yield f"world {seed}", [(end.positions, end.velocities), (back, back)]
        except KconsError as error:
            yield f"world {seed}: {type(error).__name__}", []


def in_hosts() -> Iterator[tuple[str, Trail]]:
    """Every family of constraints on arrays, in ASE and in OpenMM."""
    for host, begin in HOSTS.items():
        for name in CASES:
            moving = begin(problem(name), 0.02, "suzuki4" if name == "Distance" else "rattle")
            with suppress(KconsError):  # not on the device
                moving.advance(5)
                yield f"{host}: {name}", [moving.observe()]


def hashes() -> dict[str, str]:
    """Name and hash of every trajectory."""
    found: dict[str, str] = {}
    for part in (by_methods, by_steppers, in_random_cells, in_hosts):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", UserWarning)  # some of the systems sample no temperature
            for name, states in part():
                total = hashlib.sha256()
                for values in (array for state in states for array in state):
                    total.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
                found[name] = total.hexdigest()
    return found


def run_on(folder: Path) -> dict[str, str]:
    """The hashes of the package in `folder`, by this file and an interpreter of its own."""
    with tempfile.TemporaryDirectory() as kept:
        out = Path(kept) / "hashes.json"
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        subprocess.run([sys.executable, __file__, "--write", str(out)], env=environment, cwd=kept, check=True)
        found = dict(json.loads(out.read_text()))
    if Path(found.pop("package")) != folder / "kcons":
        raise SystemExit(f"another kcons than that in {folder} was run")
    return found


def checkout(commit: str) -> Path:
    """A clean checkout of `commit` in the folder for temporary files; made once."""
    whole = subprocess.run(
        ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()
    folder = Path(tempfile.gettempdir()) / f"kcons-{whole[:12]}"
    if not (folder / "whole").exists():
        archive = subprocess.run(["git", "archive", whole], cwd=ROOT, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=BytesIO(archive)) as opened:
            opened.extractall(folder, filter="data")
        (folder / "whole").touch()
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="COMMIT", required=True, help="status 1 if anything differs from it")
    if "--write" in sys.argv:
        package = str(Path(kcons.__file__).resolve().parent)
        Path(sys.argv[-1]).write_text(json.dumps({"package": package, **hashes()}, indent=1))
        return 0
    commit = parser.parse_args().against
    here, there = run_on(ROOT), run_on(checkout(commit))
    different = sorted(name for name in here.keys() | there.keys() if here.get(name) != there.get(name))
    print("\n".join(f"differs: {name}" for name in different))
    print(f"{len(here) - len(different)} of {len(here)} trajectories are those of {commit}, bit for bit")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
