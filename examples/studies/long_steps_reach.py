"""How far must the fast forces of rigid water reach for long steps? 216 waters, whose box lets them reach 9 angstrom.

    python long_steps_reach.py                   seconds: some steps of 27 waters
    python long_steps_reach.py --full FOLDER     runs with several splittings, hours; goes on
    python long_steps_reach.py --collect FOLDER  what its runs have shown so far, into docs/results
    python long_steps_reach.py --beyond FOLDER   steps beyond 64 fs, after that, into docs/results; goes on
    python long_steps_reach.py --show FILE       the table of a file of results

Methods, forces and averages are those of studies/long_steps_water.py.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
from ase import units

from kcons import run
from kcons.comparison import environment, json_files
from kcons.thermostats import slow_share

spec = importlib.util.spec_from_file_location("long_steps_water", Path(__file__).with_name("long_steps_water.py"))
assert spec is not None and spec.loader is not None
water = sys.modules["long_steps_water"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(water)


@numba.njit(nogil=True)
def wave_forces(x, box, damp, most, coulomb, charges):  # type: ignore[no-untyped-def]
    """The reciprocal part of an Ewald sum, of the waves h with h.h <= `most` only."""
    n, reach, unit = len(x), int(math.sqrt(most)), 2 * math.pi / box
    f = np.zeros_like(x)
    powers = np.ones((3, 2 * reach + 1, n), np.complex128)
    for k in range(3):
        for i in range(n):
            turn = np.exp(1j * unit * x[i, k])
            for p in range(1, reach + 1):
                powers[k, reach + p, i] = powers[k, reach + p - 1, i] * turn
                powers[k, reach - p, i] = np.conj(powers[k, reach + p, i])
    wave = np.empty(n, np.complex128)
    for a in range(reach + 1):
        for b in range(-reach, reach + 1):
            for c in range(-reach, reach + 1):
                square = a * a + b * b + c * c
                # One of each pair h, -h.
                if square > most or (a, b, c) <= (0, 0, 0):
                    continue
                kk = unit * unit * square
                strength = 8 * math.pi * coulomb / box**3 * math.exp(-kk / (4 * damp * damp)) / kk
                total = 0j
                for i in range(n):
                    wave[i] = powers[0, a + reach, i] * powers[1, b + reach, i] * powers[2, c + reach, i]
                    total += charges[i] * wave[i]
                for i in range(n):
                    push = strength * unit * charges[i] * (wave[i] * total.conjugate()).imag
                    f[i, 0] += a * push
                    f[i, 1] += b * push
                    f[i, 2] += c * push
    return f


@dataclass(frozen=True)
class Method(water.Method):  # type: ignore[name-defined,misc]
    """With `waves`, the longest waves of an Ewald sum are fast, too, up to this square of their whole numbers."""

    waters: int = 216
    waves: int = 0
    NAMED: ClassVar = (*water.Method.NAMED, "waves")

    def near(self, box: float) -> Callable[[np.ndarray, float], np.ndarray]:
        near, charges = super().near(box), np.tile(water.CHARGES, self.waters)
        if not self.waves:
            return near
        given = (box, self.damp, self.waves, water.COULOMB, charges)
        return lambda x, time: near(x, time) + wave_forces(np.array(x), *given)


#: What is fast, by splitting: near pairs as they are, with a reaction field, as in the direct part of an Ewald sum,
#: and this with the longest waves of the rest.
SPLITTINGS: dict[str, dict[str, Any]] = {
    "pairs to 6 A": {"switch": (4.0, 6.0)},
    "pairs to 9 A": {"switch": (7.0, 9.0)},
    "reaction field to 9 A": {"switch": (7.0, 9.0), "screen": True},
    "direct part to 9 A": {"switch": (7.0, 9.0), "damp": 0.35},
    "pairs to 6 A, long waves": {"switch": (4.0, 6.0), "damp": 0.4, "waves": 30},
    "pairs to 7 A, long waves": {"switch": (5.0, 7.0), "damp": 0.35, "waves": 20},
    "pairs to 9 A, long waves": {"switch": (7.0, 9.0), "damp": 0.3, "waves": 14},
}
#: What is run with each, looked at halfway: bath, friction in 1/ps, step in fs, auxiliary variables, seed, inner step.
RUNS: dict[str, tuple[tuple[Any, ...], ...]] = {
    "pairs to 6 A": (("langevin", 20, 24),),
    "pairs to 9 A": (("langevin", 20, 24),),
    "reaction field to 9 A": (
        *(("langevin", friction, 16) for friction in (2, 5, 20)),
        *(("langevin", friction, 24) for friction in (5, 20)),
        ("split", 5, 32),
        ("split", 20, 32, 0),
    ),
    "direct part to 9 A": (("langevin", 20, 24),),
    "pairs to 6 A, long waves": (("langevin", 20, 24),),
    "pairs to 7 A, long waves": (
        *(("langevin", 5, step) for step in (24, 32, 48)),
        ("langevin", 10, 32),
        *(("split", 5, step) for step in (48, 64)),
        *(("split", 20, step, 0) for step in (24, 32, 64)),
        *(("langevin", 5, step, 1, 2) for step in (24, 32)),
        *(("split", 5, step, 1, 2) for step in (48, 64)),
        ("split", 20, 64, 0, 2),
        *(("langevin", 5, step, 1, 1, 2) for step in (24, 32)),
        *(("split", 5, step, 1, 1, 2) for step in (32, 48, 64)),
        *(("split", 20, 24, 0, seed, 2) for seed in (1, 2, 3, 4)),
    ),
    "pairs to 9 A, long waves": (
        ("langevin", 5, 32),
        ("langevin", 5, 64),
        ("split", 5, 64),
        ("langevin", 5, 64, 1, 1, 2),
        ("split", 5, 64, 1, 1, 2),
        *(("split", 20, 24, 0, seed, 2) for seed in (1, 2, 3, 4)),
        *(("split", 20, 32, 0, seed, 2) for seed in (1, 2)),
        *(("split", 5, 64, 1, seed, 2) for seed in (2, 3)),
        ("split", 5, 24, 1, 1, 2),
    ),
}
REFERENCE = Method("plain", 5, 2)
METHODS = {
    label: tuple(
        Method(
            *given[:3],
            halfway=True,
            **dict(zip(("auxiliary", "seed", "inner"), given[3:], strict=False)),
            **SPLITTINGS[label],
        )
        for given in runs
    )
    for label, runs in RUNS.items()
}


#: Beyond 64 fs, with the splitting that leaves least to the slow forces: bath, friction, step, seeds.
FAR_STEPS = (
    ("langevin", 5, 96, (1, 2)),
    ("langevin", 5, 128, (1, 2)),
    ("langevin", 5, 192, (1, 2)),
    ("langevin", 10, 192, (1,)),
    ("langevin", 10, 384, (1,)),
    ("langevin", 20, 384, (1,)),
    ("split", 5, 96, (1,)),
    ("split", 5, 192, (1, 2)),
    ("split", 5, 384, (1, 2, 3)),
)
FAR = "pairs to 9 A, long waves"


def short_name(method: Method) -> str:
    """Without what the splitting says."""
    bare = water.Method(method.bath, method.friction, method.outer, auxiliary=method.auxiliary, seed=method.seed)
    return replace(bare, halfway=method.halfway, inner=method.inner).name


def collect(folder: Path, samples: int) -> dict[str, Any]:
    """What the runs have shown, and the share of the stiffness that is slow, on ten frames of the reference."""
    flat = (REFERENCE, *(method for methods in METHODS.values() for method in methods))
    rows = {row.pop("name"): row for row in water.collect(folder, samples, flat)}
    frames = np.load(folder / f"{REFERENCE.file}.frames.npz")["x"][100:300:20]
    result: dict[str, Any] = {"reference": rows[REFERENCE.name] | {"name": REFERENCE.name}, "splittings": []}
    for label, methods in METHODS.items():
        box = water.Water(Method("langevin", 5, 16, **SPLITTINGS[label]))
        share = slow_share(box.system, [box.motion.restore_positions(x.astype(float)) for x in frames])
        found = [rows[m.name] | {"name": short_name(m)} for m in methods if m.name in rows]
        result["splittings"].append({"name": label, **SPLITTINGS[label], "share": share, "water": found})
    return result | {"environment": environment()}


def beyond(folder: Path, samples: int) -> dict[str, Any]:
    """Runs with still longer steps, beside the reference that is there."""
    folder.mkdir(parents=True, exist_ok=True)
    known, doubt = json_files.read(water.RESULT)["reach"]["reference"]["energy"]
    rows = []
    for bath, friction, step, seeds in FAR_STEPS:
        for seed in seeds:
            method = Method(bath, friction, step, halfway=True, inner=2, seed=seed, **SPLITTINGS[FAR])
            if not (folder / f"{method.file}.frames.npz").exists():
                water.advance(method, folder)
            row = water.summary(method, folder, samples)
            if row is None:
                print(f"{short_name(method)}: no result, see {folder}")
                continue
            value, error = row["energy"]
            row["bias"] = [100 * (value - known) / abs(known), 100 * math.hypot(error, doubt) / abs(known)]
            rows.append(row | {"name": short_name(method)})
    return {"splitting": FAR, "water": rows, "environment": environment()}


def mean(values: list[list[float]]) -> tuple[float, float]:
    """Of values with errors, and its error."""
    return sum(value for value, _ in values) / len(values), math.hypot(*(error for _, error in values)) / len(values)


def over_seeds(rows: list[dict[str, Any]], reference: dict[str, Any]) -> list[dict[str, Any]]:
    """Means of methods that ran with several seeds, and their errors: how far the energy is off, and temperatures."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["name"].replace(f", seed {row['seed']}", ""), []).append(row)
    found = []
    known, doubt = reference["energy"]
    for name, same in by_name.items():
        if len(same) > 1:
            means = {key: mean([row[key] for row in same]) for key in ("energy", "shift", "turn")}
            value, error = means["energy"]
            # Positive where the energy is too high.
            means["bias"] = (100 * (value - known) / abs(known), 100 * math.hypot(error, doubt) / abs(known))
            found.append({"name": name, "seeds": len(same), **means})
    return found


def show_beyond(result: dict[str, Any], reference: dict[str, Any]) -> str:
    """Averages at steps beyond 64 fs, and the means of several seeds."""
    rows = [row | {"name": row["name"].removesuffix(", halfway")} for row in result["water"]]
    lines = [f"fast: {result['splitting']}; beyond 64 fs", *water.show_water({"water": rows}).split("\n")]
    lines += ["", MEANS, *(mean_line(row) for row in over_seeds(rows, reference))]
    return "\n".join(lines)


MEANS = f"{'means over seeds':52s}{'seeds':>6s}{'U off, %':>14s}{'T shift, K':>14s}{'T turn, K':>14s}"


def mean_line(row: dict[str, Any]) -> str:
    cells = f"{row['name'].removesuffix(', halfway'):52s}{row['seeds']:6d}{row['bias'][0]:+8.2f}({row['bias'][1]:.2f})"
    return cells + "".join(f"{300 * row[k][0]:9.1f}({300 * row[k][1]:.1f})" for k in ("shift", "turn"))


def show(result: dict[str, Any]) -> str:
    """Averages by splitting, all but the reference looked at halfway; then the means of several seeds."""
    head, first = water.show_water({"water": [result["reference"]]}).split("\n")
    lines = [head, first]
    for part in result["splittings"]:
        rows = [row | {"name": row["name"].removesuffix(", halfway")} for row in part["water"]]
        lines += [f"fast: {part['name']}; slow forces have {part['share']:.3f} of the stiffness"]
        lines += water.show_water({"water": rows}).split("\n")[1:]
    lines += ["", MEANS]
    for part in result["splittings"]:
        means = over_seeds(part["water"], result["reference"])
        lines += [f"fast: {part['name']}"] * bool(means)
        lines += [mean_line(row) for row in means]
    return "\n".join(lines)


def quick() -> None:
    """Some steps."""
    method = replace(METHODS["pairs to 6 A, long waves"][0], waters=27, switch=(3.5, 4.5))
    box = water.Water(method)
    end = run(box.system, box.start, method.outer * units.fs, 4, stepper=method.stepper())
    print(f"{method.name}: {end.step} steps, evaluations {box.system.force.evaluations}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", type=Path, metavar="FOLDER")
    parser.add_argument("--collect", type=Path, metavar="FOLDER")
    parser.add_argument("--beyond", type=Path, metavar="FOLDER")
    parser.add_argument("--show", type=Path, metavar="FILE")
    parser.add_argument("--hours", type=float, default=2.0, help="with --full: when to stop")
    parser.add_argument("--samples", type=int, default=250, help="with --collect: frames for temperatures")
    given = parser.parse_args()
    if given.show:
        result = json_files.read(given.show)
        print(show(result["reach"]))
        print(show_beyond(result["beyond"], result["reach"]["reference"]))
    elif given.full:
        water.full(given.full, (REFERENCE, *(m for methods in METHODS.values() for m in methods)), given.hours)
    elif given.collect:
        result = json_files.read(water.RESULT) | {"reach": collect(given.collect, given.samples)}
        json_files.write(water.RESULT, result)
        print(show(result["reach"]))
    elif given.beyond:
        result = json_files.read(water.RESULT) | {"beyond": beyond(given.beyond, given.samples)}
        json_files.write(water.RESULT, result)
        print(show_beyond(result["beyond"], result["reach"]["reference"]))
    else:
        quick()


if __name__ == "__main__":
    main()
