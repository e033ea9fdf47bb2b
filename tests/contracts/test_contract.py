"""What kcons promises, for every family of constraints in every host: arrays, ASE, OpenMM.

Rows are fulfilled, velocities are tangent, errors fall with the order of the stepper towards the solution that the
dense oracle gives, runs go back to where they came from, and a restart is the same to the last bit.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from constraint_cases import CASES, MASSES
from hosts import HOSTS, Phase, Problem, Run, problem
from scipy.integrate import solve_ivp

TIME, COARSE = 0.32, 16
in_every_host = pytest.mark.parametrize("host", HOSTS)
every_family = pytest.mark.parametrize("name", CASES, ids=lambda name: name.replace(" ", "-"))
#: No digit is asked for beyond these, in units of the positions: what hosts round, and DOP853 leaves.
ROUNDING = 2e-11


@cache
def after(host: str, name: str, scheme: str, steps: int) -> Phase:
    made: Run = HOSTS[host](problem(name), TIME / steps, scheme)
    made.advance(steps)
    return made.observe()


@cache
def exact(name: str) -> Phase:
    """The motion by the dense oracle, whatever solves the rows elsewhere."""
    p: Problem = problem(name)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y.reshape(2, *p.x.shape)
        return np.concatenate([y[y.size // 2 :], p.dense(x, v, t).ravel()])

    start = np.concatenate([p.x.ravel(), p.v.ravel()])
    found = solve_ivp(rate, (0.0, TIME), start, method="DOP853", rtol=1e-12, atol=1e-13)
    assert found.success
    x, v = found.y[:, -1].reshape(2, *p.x.shape)
    return x, v


def off(phase: Phase, name: str) -> float:
    return max(float(np.abs(a - b).max()) for a, b in zip(phase, exact(name), strict=True))


@in_every_host
@every_family
@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
def test_rows_are_fulfilled_and_velocities_tangent(host: str, name: str, scheme: str) -> None:
    held = problem(name).held
    x, v = after(host, name, scheme, COARSE)
    assert np.abs(x - problem(name).x).max() > 0.01
    positions = held.holonomic
    miss = np.abs(held.value(x, TIME))[positions] / held.scale[positions]
    assert miss.max(initial=0.0) <= 1e-12
    A = held.jacobian(x, TIME).toarray()
    speed = np.sqrt(np.einsum("ij,ij->i", A, A)) * np.abs(v).max()
    assert np.abs(A @ v.ravel() - held.velocity_target(x, TIME)).max() <= 1e-11 * speed.max()


@every_family
@pytest.mark.parametrize(("scheme", "order"), [("rattle", 2), ("suzuki4", 4)])
def test_errors_against_the_oracle_fall_with_the_order(name: str, scheme: str, order: int) -> None:
    """On arrays; what other hosts do is the same, as the next test shows."""
    coarse, fine = (off(after("arrays", name, scheme, n), name) for n in (COARSE, 2 * COARSE))
    assert fine < 1e-3
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.4) or coarse < ROUNDING * 2**order


@pytest.mark.parametrize("host", [host for host in HOSTS if host != "arrays"])
@every_family
def test_steps_are_the_same_in_every_host(host: str, name: str) -> None:
    for scheme in ("rattle", "suzuki4"):
        for a, b in zip(after(host, name, scheme, COARSE), after("arrays", name, scheme, COARSE), strict=True):
            assert np.abs(a - b).max() <= ROUNDING


#: In OpenMM the time goes on where velocities are reversed. A composition goes back as its parts do.
BACK = [
    *((host, name, "rattle") for host in HOSTS for name in CASES if host != "OpenMM" or not CASES[name]().moving),
    *((host, name, "suzuki4") for host in HOSTS for name in ("Distance", "Angle", "Ellipsoid", "blade")),
]


@pytest.mark.parametrize(("host", "name", "scheme"), BACK)
def test_runs_go_back(host: str, name: str, scheme: str) -> None:
    p = problem(name)
    made = HOSTS[host](p, TIME / COARSE, scheme)
    made.advance(COARSE)
    made.back(COARSE)
    x, v = made.observe()
    assert np.abs(x - p.x).max() <= ROUNDING and np.abs(v - p.v).max() <= 10 * ROUNDING


@in_every_host
@every_family
def test_a_restart_is_the_same_to_the_last_bit(host: str, name: str) -> None:
    whole = HOSTS[host](problem(name), TIME / COARSE, "rattle")
    whole.advance(5)
    resume = whole.save()
    whole.advance(7)
    part = resume()
    part.advance(7)
    for a, b in zip(whole.observe(), part.observe(), strict=True):
        assert np.array_equal(a, b)


@every_family
def test_reactions_do_no_more_than_they_must(name: str) -> None:
    """Gauss: of all accelerations that the rows allow, the true one is nearest to the free one in the mass metric."""
    p = problem(name)
    a = p.motion.acceleration(p.x, p.v, np.zeros_like(p.x), 0.0)
    A, b = p.held.jacobian(p.x, 0.0).toarray(), p.held.acceleration_target(p.x, p.v, 0.0)
    assert np.abs(A @ a.ravel() - b).max() <= 1e-10 * max(np.abs(b).max(), 1.0)
    least = (MASSES[:, None] * a * a).sum()
    rng = np.random.default_rng(3)
    for _ in range(5):
        other = (
            a
            + p.motion.project_velocities(p.x, rng.normal(size=a.shape), time=0.0)
            - p.motion.project_velocities(p.x, np.zeros_like(a), time=0.0)
        )
        assert (MASSES[:, None] * other * other).sum() >= least * (1 - 1e-12)
