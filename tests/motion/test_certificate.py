"""States are certified by the set: what a solver gets wrong without knowing raises, and names the last good state."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.md.verlet import VelocityVerlet
from ase_systems import Free

from kcons import ConstraintSet, Motion, State, System, run
from kcons.ase import ConstrainedDynamics, constrain
from kcons.comparison.projected_equation import ProjectedEquation
from kcons.constraints import Angle, Distance, Sphere
from kcons.errors import CertificateError
from kcons.solvers.cluster_solver import Outcome
from kcons.steppers import Suzuki4

X = np.array([[0.9, 0, -0.4], [1.5, 0, 0.1], [2.0, 0.3, -0.2]])
V = np.array([[0.1, 0.5, 0.2], [-0.3, 0.1, 0.4], [0.2, 0.3, -0.5]])
MASSES = np.array([1.0, 0.7, 2.0])


def system() -> tuple[System, State]:
    motion = Motion(ConstraintSet([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], X, MASSES), X)
    return System(motion, lambda x, t: -0.3 * x), State(X, motion.project_velocities(X, V))


class Careless:
    """A solver that claims to have converged; from its `good`-th call on it does nothing."""

    def __init__(self, solver, what, good=0):
        self.solver, self.what, self.left = solver, what, good

    def __getattr__(self, name):
        if name == self.what:
            self.left -= 1
            if self.left < 0:
                return lambda *args: Outcome(True, 0.0, 1, 0)
        return getattr(self.solver, name)


@pytest.mark.parametrize(("what", "named"), [("positions", "sigma"), ("tangents", "A v - c")])
def test_a_solver_that_is_wrong_without_knowing_is_found_in_the_first_step(what, named):
    careless, start = system()
    careless.motion.plan.solvers[0] = Careless(careless.motion.plan.solvers[0], what)
    with pytest.raises(CertificateError, match=named) as caught:
        run(careless, start, 0.05, 10, stepper=Suzuki4())
    assert caught.value.step == 1
    assert caught.value.state is None
    assert caught.value.row in (0, 1, 2)


def test_a_later_error_comes_with_the_last_certified_state():
    careless, start = system()
    right, _ = system()
    careless.motion.plan.solvers[0] = Careless(careless.motion.plan.solvers[0], "positions", good=25)
    with pytest.raises(CertificateError) as caught:
        run(careless, start, 0.05, 100, check_every=10)
    good = caught.value.state
    assert isinstance(good, State)
    assert (good.step, caught.value.step) == (21, 31)
    assert np.array_equal(good.positions, run(right, start, 0.05, 21).positions)


def test_the_count_goes_on_from_run_to_run():
    held, start = system()
    seen = []
    certify = held.motion.certify
    held.motion.certify = lambda x, v, t: (seen.append(t), certify(x, v, t))  # type: ignore[method-assign]
    state = start
    for _ in range(45):
        state = run(held, state, 0.01, 1, check_every=20)
    assert np.allclose(seen, [0.01, 0.21, 0.41])


def test_steppers_that_let_constraints_drift_are_not_certified():
    held, start = system()
    end = run(held, start, 0.05, 50, stepper=ProjectedEquation(), check_every=1)
    assert np.abs(held.motion.constraint_set.value(end.positions)).max() > 1e-9
    run(system()[0], State(end.positions * 1.001, end.velocities), 0.05, 1, stepper=ProjectedEquation())
    run(held, start, 0.05, 50, stepper=ProjectedEquation(project=True), check_every=1)


def test_what_is_allowed_scales_with_rounding():
    far = X + 1e7
    motion = Motion(ConstraintSet(Distance([[0, 1], [1, 2]]), far, MASSES), far)
    motion.certify(far, motion.project_velocities(far, V))
    with pytest.raises(CertificateError, match=r"Distance\(0, 1\)"):
        motion.certify(far + np.array([[1e-06, 0, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(CertificateError):
        motion.certify(np.full_like(X, np.nan))
    on = np.array([[1.0, 0, 0]])
    ball = Motion(ConstraintSet(Sphere(0, [0.0, 0, 0], 1.0), on, [1.0]), on)
    ball.certify(on * (1 + 5e-11))
    with pytest.raises(CertificateError):
        ball.certify(on * (1 + 2e-10))


def test_rows_that_were_converted_are_looked_at_as_they_were_given():
    x = np.array([[-1.0, 0, 0], [0, 0, 0], [1.0, 0, 0]])
    motion = Motion(ConstraintSet(Distance([[0, 1], [1, 2], [0, 2]]), x, np.ones(3)), x)
    motion.certify(x)
    motion._given = ConstraintSet(Distance([[0, 1], [1, 2], [0, 2]], [1.1, 1.0, 2.0]), x, np.ones(3))
    with pytest.raises(CertificateError, match=r"Distance\(0, 1\)"):
        motion.certify(x)


@pytest.mark.parametrize("what", ["positions", "tangents"])
@pytest.mark.parametrize("dynamics", [VelocityVerlet, ConstrainedDynamics])
def test_ase_hooks_and_dynamics_are_certified(dynamics, what):
    atoms = Atoms("OCO", positions=X, calculator=Free())
    held = constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])])
    atoms.set_velocities(V)
    driver = dynamics(atoms, 0.05)
    motion = driver.motion if dynamics is ConstrainedDynamics else held.engine(atoms)
    motion.plan.solvers[0] = Careless(motion.plan.solvers[0], what)
    held._accepted.momenta_due = 0
    before, momenta = atoms.positions.copy(), atoms.get_momenta()
    with pytest.raises(CertificateError):
        driver.run(5)
    if dynamics is ConstrainedDynamics or what == "positions":
        assert np.array_equal(atoms.positions, before)
    if dynamics is ConstrainedDynamics:
        assert np.array_equal(atoms.get_momenta(), momenta)
