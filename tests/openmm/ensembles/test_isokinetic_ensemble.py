"""Isokinetic motion in OpenMM: trajectories, constants, and what is held."""

import numpy as np
import openmm
import pytest
from ensemble_runs import in_calls_of_any_length, run, twice_kinetic, warm
from openmm_systems import alanine, dumbbell, field, masses_of, on_gpus, particles, started, state_of, water_box

from kcons.errors import ConvergenceError, NonFiniteError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


def waters():
    """Rigid waters at rest as a whole: system, x, v."""
    system, x = water_box(8)
    context = warm(system, ProjectedIntegrator(1e-3, tolerance=1e-13), x, 2)
    x, v = state_of(context)
    return system, x, v - masses_of(system) @ v / masses_of(system).sum()


@pytest.mark.usefixtures("without_device")
def test_rigid_bodies_take_two_sums_and_make_the_same_motion():
    """Drifts keep the 2K of rigid bodies: what a sum would find is known before."""
    integrator = in_calls_of_any_length(lambda: Isokinetic(300.0), waters)
    assert integrator.getGlobalVariableByName("exact") == 0
    assert integrator.getGlobalVariableByName("ww") == pytest.approx(
        integrator.getGlobalVariableByName("two_k"), rel=1e-13
    )


@pytest.mark.filterwarnings("ignore:total momentum")
def test_strong_kicks_keep_the_kinetic_energy():
    """c h of 2 to 10^6 in one kick, without overflow; velocities end along the force."""
    for strength in (1.0, 1e3, 1e6, 1e12):
        system = particles([16.0, 16.0], field("-a*x", 2, a=16.0 * strength))
        integrator = ProjectedIntegrator(1e-3, ensemble=Isokinetic())
        v = np.array([[0.0, 0.3, 0.4], [-0.1, 0.2, 0.5]])
        context = run(system, integrator, np.zeros((2, 3)), v, 1)
        u = state_of(context)[1]
        assert abs(twice_kinetic(system, u) / twice_kinetic(system, v) - 1) <= 4e-15
        if strength >= 1e6:
            np.testing.assert_allclose(u[:, 0], np.sqrt(np.sum(v**2) / 2), rtol=1e-9)


@pytest.mark.filterwarnings("ignore:total momentum")
def test_velocities_straight_against_a_strong_force():
    system = particles([16.0], field("-a*x", 1, a=1e9))
    integrator = ProjectedIntegrator(1e-3, ensemble=Isokinetic(), check_every=1)
    context = started(system, integrator, np.zeros((1, 3)), np.array([[-1.0, 0, 0]]))
    with pytest.raises(ConvergenceError, match="turned"):
        integrator.step(1)
    assert np.array_equal(state_of(context)[1], [[-1.0, 0, 0]])


@pytest.mark.parametrize("platform", ["Reference", *on_gpus("mixed")])
def test_of_velocities_set_between_calls_only_the_direction_counts(platform):
    """K is brought back before the kick that follows, not by it."""
    system, x, v = waters()
    integrator = ProjectedIntegrator(1e-3, ensemble=Isokinetic(300.0))
    context = run(system, integrator, x, v, 1, platform)

    def end(factor, start=x):
        context.setPositions(start)
        context.setVelocities(factor * v)
        integrator.step(20)
        return state_of(context)[0]

    usual, allowed = end(1.0), 1e-12 if platform == "Reference" else 1e-10
    if "single" in platform:  # a few times what the last digit of the positions does
        last = np.random.default_rng(0).choice([-1, 1], x.shape) * 2.0**-23
        allowed = 4 * np.abs(end(1.0, x * (1 + last)) - usual).max()
        assert allowed < 1e-5
    for factor in (3.0, 0.2):
        assert np.abs(end(factor) - usual).max() < allowed


@pytest.mark.parametrize("remover", [False, True])
@pytest.mark.usefixtures("without_device")
def test_a_run_does_not_go_on_from_rest(remover):
    """There is no direction to scale: the Context goes back to where it was checked last."""
    system, x, v = dumbbell()
    if remover:
        system.addForce(openmm.CMMotionRemover())
    integrator = ProjectedIntegrator(1e-4, ensemble=Isokinetic(300.0, momentum="free"))
    context = run(system, integrator, x, v, 5)
    context.setVelocities(np.full((2, 3), 0.5 * remover))
    with pytest.raises((ConvergenceError, NonFiniteError), match="back at step 0"):
        integrator.step(5)
    np.testing.assert_allclose(state_of(context)[0], x, rtol=0, atol=1e-9)
    integrator.step(5)
    assert context.getStepCount() == 5
    assert twice_kinetic(system, state_of(context)[1]) == pytest.approx(4 * GAS_CONSTANT * 300, rel=1e-12)


def unlike(dt):
    """How far a picosecond's tenth of unseen steps of two sums leads from those of three; w.M.w/2K - 1 at the end."""
    system, x, v = alanine()
    ends = []
    for exact in (1.0, 0.0):
        integrator = ProjectedIntegrator(dt, tolerance=1e-13, ensemble=Isokinetic(300.0))
        context = run(system, integrator, x, v, 1)
        integrator.program.set("exact", exact)
        integrator.step(round(0.1 / dt) - 1)
        off = abs(integrator.getGlobalVariableByName("ww") / integrator.getGlobalVariableByName("two_k") - 1)
        ends.append(state_of(context)[0])
        assert twice_kinetic(system, state_of(context)[1]) == pytest.approx(41 * GAS_CONSTANT * 300, rel=1e-13)
    return np.abs(ends[1] - ends[0]).max(), off


@pytest.mark.usefixtures("without_device")
def test_two_sums_do_where_velocities_are_not_read():
    """What drifts change of K, of third order here, does not add up, and moves nothing in second order."""
    coarse, off = unlike(2e-3)
    fine, _ = unlike(1e-3)
    assert 0 < off < 1e-6
    assert 0 < fine < coarse / 8 < 1e-7


@pytest.mark.filterwarnings("ignore:total momentum is not zero")
@pytest.mark.parametrize("ensemble", [Isokinetic(), Langevin(300.0, 0.0)])
@pytest.mark.parametrize("platform", on_gpus("single"))
def test_weak_forces_are_not_lost_in_single_precision(platform, ensemble):
    """Heavy particles far from the origin: a kick is less than the rounding of x in a step."""
    system = particles([1000.0] * 20, field("-30*x", 20))
    rng = np.random.default_rng(0)
    x, v = 4.5 + 2.5 * rng.random((20, 3)), 0.05 * rng.normal(size=(20, 3))
    made = [(ProjectedIntegrator(2e-3, ensemble=ensemble), place) for place in ("Reference", platform)]
    ends = [state_of(run(system, integrator, x, v, 1000, place))[1] for integrator, place in made]
    assert ends[0][:, 0].mean() > v[:, 0].mean() + 0.02
    assert np.abs(ends[1] - ends[0]).max() < 1e-4
