"""Steppers on every reference case: their order by slope, and the bound on round-off of those of order six.

The slope is fitted where the error is 30 times above the bound max(1e-11, 100 cond eps) or more, cond being the
sensitivity of the solution to its start. Isokinetic cases are run with the thermostat as a force that depends on
the velocities, (f.v / v.m v) m v.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import pytest
from reference import cases
from reference.cases import Case, Snapshot

from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.steppers import BlanesMoan4, BlanesMoan6, Geodesic, KahanLi6, State, Stepper, Suzuki4, System, run
from kcons.steppers.splitting import SCHEMES

EPS = float(np.finfo(float).eps)
#: But RATTLE, whose error `test_reference_cases` extrapolates to nothing, and order 6, whose errors are at the bound.
STEPPERS: list[Stepper] = [make() for name, make in SCHEMES.items() if name != "rattle" and make().order < 6]
#: The others run as validation.
USUAL = (Geodesic, Suzuki4, BlanesMoan4)
#: Slopes are measured from this error (or 8 times the lowest allowed one) down: small enough for the leading term.
START = {2: 3e-4, 4: 4e-9}
#: From there on to so many times as many steps, the first where all errors are above the bound.
FINER = (1.4, 1.25)
#: Surfaces without compiled solvers: a projection takes a millisecond.
SURFACES = frozenset(name for name in cases.NAMES if name.startswith("A08"))
#: Cases on which `BlanesMoan4` takes seconds, and is left to `Suzuki4`.
LONG = {
    *("A02_spherical_pendulum_near_top", "A02_spherical_pendulum_near_top_Lz", "A04_double_pendulum"),
    *("A04_double_spherical_pendulum", "A04_triple_pendulum", "A05_two_dumbbells_lj", "A06_water_free3"),
    *("A09_hanging_chain5_3d", "A09_ring6_planar"),
}
#: Nothing is left of the error where atoms fly along great circles and no forces act.
EXACT = {("A01_sphere_free", s) for s in ("Geodesic(substeps=8)", "BlanesMoan4()")}
#: Later times take minutes.
SLOW_AT_THE_BOUND = SURFACES | {"A04_triple_pendulum", "A05_two_dumbbells_lj", "A06_water_free3"}
#: Steps with which the bound is reached, and the stepper for it; 0.05 and BlanesMoan6 otherwise.
FLOOR_STEPS = {
    "A02_spherical_pendulum_near_top": 0.025,
    "A02_spherical_pendulum_near_top_Lz": 0.025,
    "A03_planar_pendulum_179deg": 0.03,
    "A03_planar_pendulum_179p9deg": 0.03,
    "A04_double_pendulum": 0.012,
    "A04_double_spherical_pendulum": 0.03,
    "A04_triple_pendulum": 0.008,
    "A05_rotor_free": 0.03,
    "A05_rotor_gravity": 0.03,
    "A05_two_dumbbells_lj": 0.0045,
    "A06_water_free3": 0.0025,
    "A07_angle_only_flexible_bonds": 0.02,
    "A07_butane_bonds_angles_fixed": 0.025,
    "A08_bead_rotating_ellipse": 0.008,
    "A08_bead_rotating_hoop": 0.015,
    "A08_bead_vertical_ellipse": 0.02,
    "A08_torus_geodesic": 0.015,
    "A08_torus_inner_equator": 0.02,
    "A09_catenary_relax": 0.012,
    "A09_hanging_chain5_3d": 0.012,
    "A09_ring6_planar": 0.02,
    "A10_isokinetic_constant_force": 0.025,
    "A10_isokinetic_dumbbell_quartic": 0.015,
    "A10_isokinetic_harmonic2d": 0.01,
    "A10_isokinetic_lj4": 0.0015,
}


def depends_on_velocities(case: Case) -> bool:
    return case.isokinetic or case.velocity_dependent


@functools.cache
def system(name: str) -> System:
    case = cases.load(name)
    held = ConstraintSet(case.constraints, case.initial.positions, case.masses, time=case.initial.time)
    motion = Motion(held, case.initial.positions, time=case.initial.time)
    if case.isokinetic:

        def thermostatted(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
            f, p = case.force(x, v), case.masses[:, None] * v
            return f - np.sum(f * v) / np.sum(p * v) * p

        return System(motion, thermostatted, velocity_dependent=True)
    if case.velocity_dependent:
        return System(motion, lambda x, v, t: case.force(x, v), velocity_dependent=True)
    nothing = np.zeros((len(case.masses), 3))
    return System(motion, lambda x, t: case.force(x, nothing))


def start(name: str) -> State:
    first = cases.load(name).initial
    return system(name).initial_state(first.positions, first.velocities, time=first.time)


@functools.cache
def sensitivities(name: str) -> tuple[float, ...]:
    """Of the solution at each stored time to its start.

    By differences where the file has none, to the state at earlier stored times as well, since rounding on the way
    counts as that at the start does, and may count more: a pendulum near the top, a body about its middle axis.
    """
    case = cases.load(name)
    known = [s.condition for s in case.solution]
    if np.isfinite(known).all():
        return tuple(float(c) for c in known)
    setting, size, dt = system(name), 1e-6, min(0.1, 4 * FLOOR_STEPS.get(name, 0.05))
    largest = np.nan_to_num(known, nan=1.0)
    snapshots = [case.initial, *case.solution]
    for j, s in enumerate(snapshots[:-1]):
        starts = [(s.positions, s.velocities), *disturbed(s, size)]
        states = [setting.initial_state(y, u, time=s.time, project=True) for y, u in starts]
        for k in range(j, len(known)):
            length = snapshots[k + 1].time - states[0].time
            n = int(np.ceil(length / dt))
            states = [run(setting, state, length / n, n, stepper=KahanLi6()) for state in states]
            flat = np.array([np.concatenate([e.positions.ravel(), e.velocities.ravel()]) for e in states])
            largest[k] = max(largest[k], np.linalg.norm(flat[1:] - flat[0]) / size)
    return tuple(largest.tolist())


def disturbed(snapshot: Snapshot, size: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities that differ from these by `size` along each axis of the tangent space, or at random."""
    x, v = snapshot.positions, snapshot.velocities
    if len(x) == 1:
        along = np.cross([0.0, 1.0, 0.0], x)  # in the plane of the pendulum
        return [(x * np.cos(size) + along * np.sin(size), v), (x, v + size * along)]
    # Of a matrix J, the mean of |J g|^2 over normal deviates g is |J|^2.
    some = np.random.default_rng(0).standard_normal((6, 2, *x.shape)) * size / np.sqrt(6)
    return [(x + a, v + b) for a, b in some]


def bound_of(name: str, index: int) -> float:
    return max(1e-11, 100 * sensitivities(name)[index] * EPS)


def telling_time(name: str, latest: float = 20.0) -> int:
    """Where errors stand highest above the bound: once the sensitivity sets it, or as late as can be."""
    times = [s.time for s in cases.load(name).solution]
    for k, sensitivity in enumerate(sensitivities(name)):
        if 100 * sensitivity * EPS >= 1e-11:
            return k
    return max(k for k, t in enumerate(times) if t <= latest)


def error(name: str, stepper: Stepper, reference: Snapshot, n: int) -> float:
    first = start(name)
    end = run(system(name), first, (reference.time - first.time) / n, n, stepper=stepper)
    return float(np.hypot(*deviations(end, reference)))


def deviations(end: State, reference: Snapshot) -> tuple[float, float]:
    """Of positions and velocities: norms, relative to the largest component where that is more than 1."""
    return tuple(
        float(np.linalg.norm(a - b)) / max(1.0, float(np.abs(b).max()))
        for a, b in ((end.positions, reference.positions), (end.velocities, reference.velocities))
    )


def slope(name: str, stepper: Stepper, index: int) -> tuple[float, Sequence[tuple[int, float]]]:
    """Observed order at one stored time, and the numbers of steps and errors it was fitted to."""
    reference, lowest = cases.load(name).solution[index], 30 * bound_of(name, index)
    first = max(START[stepper.order], 8 * lowest)
    errors: dict[int, float] = {}

    def at(n: int) -> float:
        if n not in errors:
            try:
                errors[n] = error(name, stepper, reference, n)
            except (ConvergenceError, NonFiniteError):
                errors[n] = np.inf  # the step is too large
        return errors[n]

    n = 1
    while at(n) > first:
        assert n < 1e6, "the error does not go down"
        # Half the step, or what the order says where that is less.
        n = max(n + 1, round(n * min(2.0, 1.01 * (at(n) / first) ** (1 / stepper.order))))
    base = n * max(0.5, (at(n) / first) ** (1 / stepper.order))
    base = n if n < 1.04 * base else base
    for most in FINER:
        counts = sorted({round(base * factor) for factor in (1.0, most**0.5, most)})
        points = [(n, at(n)) for n in counts if lowest <= at(n) < np.inf]
        if len(points) == 3:
            break
    assert len(points) == 3, f"too few points above {lowest:.1e}: {points}"
    logarithms = np.log(points).T
    return -float(np.polyfit(*logarithms, 1)[0]), points


def is_quick(name: str, stepper: Stepper) -> bool:
    if stepper.order == 2:
        return True
    slow = name in SURFACES or name.startswith("A07") or name == "A10_isokinetic_lj4"
    return not slow and not (isinstance(stepper, BlanesMoan4) and name in LONG)


@pytest.mark.parametrize(
    ("name", "stepper"),
    [
        pytest.param(name, stepper, marks=() if isinstance(stepper, USUAL) else pytest.mark.validation)
        for name in cases.NAMES
        for stepper in STEPPERS
        if is_quick(name, stepper)
    ],
    ids=lambda p: p if isinstance(p, str) else repr(p),
)
def test_order(name: str, stepper: Stepper) -> None:
    if isinstance(stepper, BlanesMoan4) and depends_on_velocities(cases.load(name)):
        with pytest.raises(UnsupportedError, match="use Suzuki4 or KahanLi6"):
            stepper.step(system(name), start(name), 0.01)
        return
    index = telling_time(name, 5.0) if isinstance(stepper, BlanesMoan4) else 0
    if (name, repr(stepper)) in EXACT:
        assert error(name, stepper, cases.load(name).solution[index], 3) <= bound_of(name, index)
        return
    measured, points = slope(name, stepper, index)
    assert measured == pytest.approx(stepper.order, abs=0.15), points


@pytest.mark.parametrize("name", cases.NAMES)
def test_round_off_bound(name: str) -> None:
    case, setting, state = cases.load(name), system(name), start(name)
    latest = 1.0 if name in SLOW_AT_THE_BOUND or depends_on_velocities(case) else 5.0
    stepper: Stepper = KahanLi6() if name in SURFACES or depends_on_velocities(case) else BlanesMoan6()
    for k, reference in enumerate(case.solution):
        if k and reference.time > latest:
            return
        n = int(np.ceil((reference.time - state.time) / FLOOR_STEPS.get(name, 0.05)))
        state = run(setting, state, (reference.time - state.time) / n, n, stepper=stepper)
        allowed = bound_of(name, k)
        for item, off in zip(("positions", "velocities"), deviations(state, reference), strict=True):
            assert off <= allowed, f"{item} at t = {reference.time}: {off:.1e}, allowed {allowed:.1e}"
