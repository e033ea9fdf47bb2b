"""Particles that come to rest at the least energy known; friction is solved exactly, and a half on each side."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import compare, methods, scenes
from kcons.errors import InputError
from kcons.scenes.fekete import FRICTION, OPTIMA
from kcons.scenes.friction import Damped
from kcons.steppers import BlanesMoan4, Rattle, State, System

#: Thomson's problem, as everyone has it.
PUBLISHED = {4: 3.674234614, 6: 9.985281374, 12: 49.165253058, 20: 150.881568334}


def test_optima_are_the_published_ones():
    assert set(OPTIMA) == set(PUBLISHED)
    for size, energy in PUBLISHED.items():
        assert OPTIMA[size] == pytest.approx(energy, abs=6e-10)


@pytest.mark.parametrize("size", OPTIMA)
def test_every_size_finds_its_optimum(size):
    scene = scenes.build("fekete", size)
    found = compare.compare(scene.with_time_steps([0.16]), methods=["rattle"])
    (m,) = found.of("rattle")
    assert m.error < 1e-8
    assert found.reference["how"].startswith("the least energy known")
    assert scene.deviation(scene.positions, scene.positions) > 0.01  # energy, not distance


def test_sizes_without_a_known_optimum_are_refused():
    with pytest.raises(InputError, match="4, 6, 12, 20"):
        scenes.build("fekete", 5)


def test_friction_on_a_great_circle_is_exact_in_speed_and_of_order_two_in_place():
    scene = scenes.build("sphere", 1)
    system, start = System(scene.motion, scene.potential.forces), State(scene.positions, scene.velocities)
    speed = np.linalg.norm(scene.velocities)
    time, errors = 2.0, []
    for count in (10, 20, 40):
        state = start
        for _ in range(count):
            state = Damped(Rattle(), FRICTION).step(system, state, time / count)
        assert np.linalg.norm(state.velocities) == pytest.approx(speed * np.exp(-FRICTION * time), rel=1e-3)
        way = speed / FRICTION * (1 - np.exp(-FRICTION * time))
        n = scene.positions[0]
        there = np.cos(way) * n + np.sin(way) * scene.velocities[0] / speed
        errors.append(np.linalg.norm(state.positions[0] - there))
    np.testing.assert_allclose(np.diff(np.log2(errors)), -2.0, atol=0.1)


def test_a_damped_step_can_be_taken_back():
    scene = scenes.build("fekete", 12)
    system, damped = System(scene.motion, scene.potential.forces), Damped(BlanesMoan4(), 0.3)
    start = State(scene.positions, scene.velocities)
    back = damped.step(system, damped.step(system, start, 0.1), -0.1)
    np.testing.assert_allclose(back.positions, start.positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(back.velocities, start.velocities, rtol=0, atol=1e-12)


def test_methods_without_friction_refuse():
    scene = scenes.build("fekete")
    for name in ("ase-kcons", "shake-1e-8", "openmm-verlet"):
        assert "friction" in methods.METHODS[name].refuses(scene)
    for name in ("rattle", "kahan-li6", "dop853"):
        assert methods.METHODS[name].refuses(scene) is None
