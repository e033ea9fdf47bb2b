"""Long runs: what must not drift does not."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_systems import SYMMETRIC, planar_pendulum, system_of

from kcons.constraints import Distance
from kcons.steppers import BlanesMoan6, KahanLi6, Rattle, State, System, run

SHAPES = {
    "dumbbell": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.1]],
    "water": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.25, 0.97, 0.0]],
    "tetrahedron": [[0.0, 0.0, 0.0], [1.3, 0.0, 0.0], [0.2, 0.9, 0.0], [0.1, 0.3, 1.6]],
}
MASSES = np.array([16.0, 1.0, 1.5, 2.0])


def body(shape: str) -> tuple[System, State]:
    """A rigid body that tumbles, its center flying off at a speed of 0.4."""
    x = np.array(SHAPES[shape])
    pairs = [[i, j] for i in range(len(x)) for j in range(i + 1, len(x))]
    system = system_of([Distance(pairs)], x, MASSES[: len(x)])
    v = np.random.default_rng(11).normal(size=x.shape)
    v += [0.4, 0.0, 0.0] - MASSES[: len(x)] @ v / MASSES[: len(x)].sum()
    return system, system.initial_state(x, v, project=True)


def invariants(system: System, state: State) -> list[np.ndarray]:
    """Kinetic energy, momentum, and angular momentum about the center."""
    x, v, m = state.positions, state.velocities, system.masses[:, None]
    if state.remainder is not None:
        x = (x - x[0]) + state.remainder
    arm = x - (m * x).sum(axis=0) / m.sum()
    return [np.array(system.kinetic_energy(v)), np.sum(m * v, axis=0), np.sum(np.cross(arm, m * v), axis=0)]


#: Time steps, by order.
FREE = {2: 0.02, 4: 0.02, 6: 0.04}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("stepper", "steps"), [(Rattle(), 10_000), (KahanLi6(), 5_000), (BlanesMoan6(), 500)], ids=repr
)
def test_free_flight_keeps_energy_and_momenta(shape, stepper, steps) -> None:
    """The largest deviations, each relative to the largest component, at a thousand times along the way.

    A free body in RATTLE is that of Moser and Veselov: not only its momenta but also its energy are kept exactly,
    whatever the step (McLachlan and Zanna, Found. Comput. Math. 5, 87 (2005)).
    """
    system, state = body(shape)
    first = invariants(system, state)

    def watch(now: State) -> None:
        for what, value, then in zip(("energy", "momentum", "spin"), invariants(system, now), first, strict=True):
            off = float(np.abs(value - then).max() / np.abs(then).max())
            assert off <= 1e-10, f"{what} after {now.step} steps: {off:.1e}"

    every = max(1, steps // 1000)
    assert run(system, state, FREE[stepper.order], steps, stepper=stepper, observers=[watch], every=every).step == steps


#: Enough for the window to take out what oscillates.
STEPS = {2: 20_000, 4: 4_000, 6: 2_000}


@pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)
def test_energy_has_no_slope(stepper) -> None:
    """Per unit time, of the pendulum released at 2 rad: a fit under a window that takes out the oscillation."""
    system, state = planar_pendulum(2.0)
    energies: list[float] = []
    watch = lambda s: energies.append(system.total_energy(s))  # noqa: E731
    run(system, state, 0.01, STEPS[stepper.order], stepper=stepper, observers=[watch])
    time = 0.01 * np.arange(len(energies))
    u = 2 * time / time[-1] - 1
    window = np.cos(0.5 * np.pi * u) ** 8
    center = np.sum(window * u) / np.sum(window)
    spread = np.sum(window * (u - center) ** 2)
    assert abs(np.sum(window * (u - center) * np.array(energies)) / spread * 2 / time[-1]) <= 1e-9
