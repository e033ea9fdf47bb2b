"""Nosé-Hoover chains on the constraints in OpenMM."""

import copy

import numpy as np
import pytest
from ensemble_runs import run
from openmm import unit
from openmm_systems import alanine, dumbbell, field, loose_alanine, particles, state_of

from kcons.errors import ConvergenceError, InputError, NonFiniteError, OverdeterminedError, UnsupportedError
from kcons.openmm import NoseHoover, NoseHooverMiddle, ProjectedIntegrator, hold, positions_of

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque", "ignore:total momentum")


def test_a_chain_in_the_middle_is_the_same_chain_in_small_steps():
    """The link's velocity of both differs by the square of the time step."""
    system, x, v = alanine("HBonds")
    apart = []
    for n in (100, 200):
        links = []
        for ensemble in (NoseHoover(300.0, 20.0), NoseHooverMiddle(300.0, 20.0)):
            integrator = ProjectedIntegrator(0.05 / n, ensemble=ensemble, tolerance=1e-12)
            context = run(system, integrator, x, 1.2 * v, n)
            links.append(integrator.getGlobalVariableByName("link1"))
            del context
        apart.append(abs(links[0] - links[1]))
        assert abs(links[0]) > 5 * apart[-1]
    assert np.log2(apart[0] / apart[1]) == pytest.approx(2, abs=0.3)


def test_a_chain_in_the_middle_is_time_reversible():
    """With velocities and links turned round, 50 steps of 4 fs lead back; without the links they do not."""
    system, x, v = alanine("AllBonds")
    for turned, limit in ((-1.0, 1e-9), (1.0, None)):
        integrator = ProjectedIntegrator(4e-3, ensemble=NoseHooverMiddle(300.0, 20.0), tolerance=1e-14)
        context = run(system, integrator, x, v, 20)
        start = state_of(context)
        integrator.step(50)
        assert np.abs(positions_of(context) - start[0]).max() > 0.01
        context.setVelocities(-state_of(context)[1])
        for k in (1, 2, 3):
            link = f"link{k}"
            integrator.setGlobalVariableByName(link, turned * integrator.getGlobalVariableByName(link))
        integrator.step(50)
        off = np.abs(positions_of(context) - start[0]).max()
        assert off <= limit if limit else off > 1e-4


def test_a_chain_in_the_middle_stays_itself_and_may_have_a_relaxation_time():
    ensemble = NoseHooverMiddle(300.0, 20.0, length=2)
    assert ensemble != NoseHoover(300.0, 20.0, length=2)
    warmer = ensemble.replaced(temperature=310.0)
    assert type(warmer) is NoseHooverMiddle and repr(warmer) == "NoseHooverMiddle(310 K, 20/ps, length=2)"
    assert NoseHoover(300, 20) == NoseHoover(300 * unit.kelvin, 50 * unit.femtosecond)
    assert NoseHoover(300, 20).frequency == pytest.approx(NoseHoover(300, 0.02 / unit.femtosecond).frequency)


@pytest.mark.usefixtures("without_device")
def test_a_step_that_fails_leaves_the_chain_where_it_was():
    system, x, v = loose_alanine()
    part = hold(system, [], positions=x, take="all")
    integrator = ProjectedIntegrator(1e-3, parts=[part], ensemble=NoseHoover(300.0, 20.0))
    context = run(system, integrator, x, v, 20)
    r, u = state_of(context)
    before = integrator.program.remembered()
    assert all(abs(value) > 1e-3 for value in before.values())
    context.setVelocities(30 * u)
    with pytest.raises(ConvergenceError):
        integrator.step(1)
    assert integrator.program.remembered() == before and np.array_equal(positions_of(context), r)


@pytest.mark.usefixtures("without_device")
def test_a_nan_leaves_the_chain_of_the_last_check():
    system, x, v = alanine()
    mine = copy.deepcopy(system)
    mine.addForce(field("select(step(x-edge), sqrt(edge-x), 0)", 1, edge=1e6))
    integrator = ProjectedIntegrator(1e-3, check_every=10, ensemble=NoseHoover(300.0, 20.0))
    context = run(mine, integrator, x, v, 10)
    before, good = integrator.program.remembered(), state_of(context)
    context.setParameter("edge", -1e6)
    with pytest.raises(NonFiniteError):
        integrator.step(10)
    assert integrator.program.remembered() == before
    assert np.array_equal(state_of(context), good)
    assert context.getStepCount() == 10 and context.getTime()._value == pytest.approx(0.01)
    context.setParameter("edge", 1e6)
    integrator.step(5)
    assert np.isfinite(state_of(context)[1]).all()


def test_what_cannot_be_thermostatted_is_refused():
    for scheme in ("suzuki4", "blanes-moan6", "isokinetic4", "geodesic"):
        for kind in (NoseHoover, NoseHooverMiddle) if scheme != "geodesic" else (NoseHooverMiddle,):
            with pytest.raises(UnsupportedError, match=r"order|another form"):
                ProjectedIntegrator(1e-3, scheme, ensemble=kind(300.0, 20.0))
    system, x, v = dumbbell()
    with pytest.raises(InputError, match="take a frequency of at most 100/ps"):
        run(system, ProjectedIntegrator(1e-3, ensemble=NoseHoover(300.0, 5000.0)), x, v, 1)
    with pytest.raises(OverdeterminedError, match="no degree of freedom"):
        run(particles([1.0]), ProjectedIntegrator(1e-3, ensemble=NoseHoover(300, 20)), np.eye(1, 3), np.eye(1, 3), 1)


def test_step_sizes_that_the_chain_cannot_follow_are_refused_in_a_run():
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-4, ensemble=NoseHoover(300.0, 1000.0))
    context = run(system, integrator, x, v, 1)
    with pytest.raises(InputError, match=r"take a frequency of at most 50/ps, or a time step of at most 0.0001 ps"):
        integrator.setStepSize(2 * unit.femtosecond)
    assert integrator.getStepSize() == 1e-4 * unit.picosecond
    integrator.setStepSize(1.3e-3)
    integrator.step(1)
    assert context.getStepCount() == 2
