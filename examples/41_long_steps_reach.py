"""How far must the fast forces of rigid water reach for long steps? 216 waters, whose box lets them reach 9 angstrom.

    python examples/41_long_steps_reach.py                   seconds: some steps of 27 waters
    python examples/41_long_steps_reach.py --full FOLDER     runs with several splittings, hours; goes on
    python examples/41_long_steps_reach.py --collect FOLDER  what its runs have shown so far, into docs/results
    python examples/41_long_steps_reach.py --show FILE       the table of a file of results

Methods, forces and averages are those of 39_long_steps_water.py.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numba
import numpy as np
from ase import units

from kcons import run
from kcons.comparison import environment, json_files

spec = importlib.util.spec_from_file_location("long_steps_water", Path(__file__).with_name("39_long_steps_water.py"))
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


#: Splittings: near pairs as they are, with a reaction field, and damped as in an Ewald sum.
NEAR = {"switch": (4.0, 6.0)}
PLAIN, FIELD = {"switch": (7.0, 9.0)}, {"switch": (7.0, 9.0), "screen": True}
EWALD = {"switch": (7.0, 9.0), "damp": 0.35}
#: The same with the longest waves of the rest.
WAVES, SHORT = ({"switch": (5.0, 7.0), "damp": 0.35, "waves": 20}, {"switch": (4.0, 6.0), "damp": 0.4, "waves": 30})
#: What is run; the first is the reference.
METHODS = (
    Method("plain", 5, 2),
    *(Method("langevin", g, dt, halfway=True, **FIELD) for dt in (16, 24, 32) for g in (2, 5, 20)),
    *(Method("split", g, dt, halfway=True, **FIELD) for dt in (24, 32, 48, 64) for g in (5, 20)),
    *(Method("split", 20, dt, halfway=True, auxiliary=0, **FIELD) for dt in (24, 32, 48, 64)),
    *(Method("langevin", g, 24, **FIELD) for g in (5, 20)),
    *(Method("split", 5, dt, **FIELD) for dt in (24, 32)),
    *(Method("split", 20, dt, auxiliary=0, **FIELD) for dt in (24, 32, 48, 64)),
    *(
        method
        for other in (PLAIN, WAVES, SHORT, EWALD, NEAR)
        for method in (
            Method("langevin", 5, 16, halfway=True, **other),
            Method("langevin", 20, 24, halfway=True, **other),
            Method("split", 20, 32, halfway=True, auxiliary=0, **other),
        )
    ),
)


def quick() -> None:
    """Some steps on spheres."""
    method = replace(METHODS[-1], waters=27, switch=(3.5, 4.5))
    box = water.Water(method)
    end = run(box.system, box.start, method.outer * units.fs, 4, stepper=method.stepper())
    print(f"{method.name}: {end.step} steps, evaluations {box.system.force.evaluations}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", type=Path, metavar="FOLDER")
    parser.add_argument("--collect", type=Path, metavar="FOLDER")
    parser.add_argument("--show", type=Path, metavar="FILE")
    parser.add_argument("--only", default="", metavar="TEXT", help="with --full: methods whose names have it")
    parser.add_argument("--hours", type=float, default=2.0, help="with --full: when to stop")
    parser.add_argument("--samples", type=int, default=1000, help="with --collect: frames for temperatures")
    given = parser.parse_args()
    if given.show:
        print(water.show_water(json_files.read(given.show)["reach"]))
    elif given.full:
        water.full(given.full, tuple(m for m in METHODS if given.only in m.name), given.hours)
    elif given.collect:
        rows = water.collect(given.collect, given.samples, METHODS)
        result = json_files.read(water.RESULT)
        result["reach"] = {"water": rows, "environment": environment()}
        json_files.write(water.RESULT, result)
        print(water.show_water(result["reach"]))
    else:
        quick()


if __name__ == "__main__":
    main()
