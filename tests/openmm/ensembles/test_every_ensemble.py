"""Every ensemble beside rows that parts hold; a barostat of another temperature is told of.

That it has its temperature: tests/contracts/test_openmm_replay.py.
"""

from __future__ import annotations

import copy
import warnings
from itertools import cycle

import numpy as np
import pytest
from ensemble_runs import in_calls_of_any_length, on_their_rows, run, twice_kinetic, two_parts, warm
from openmm import unit
from openmm_ensembles import ENSEMBLES
from openmm_systems import BAROSTATS, dumbbell, loose_alanine, masses_of, started, state_of, water_box

from kcons import ConstraintSet, Motion, State, System, thermostats
from kcons import run as steps_of
from kcons.constraints import Distance
from kcons.openmm import Isokinetic, NoseHoover, ProjectedIntegrator, hold
from kcons.openmm.quantities import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque", "ignore:total momentum")
#: Noise differs between programs.
WITHOUT_NOISE = [name for name, make in ENSEMBLES.items() if not make(300).noisy]


#: Of each: the ensemble, its stepper on arrays, the scheme, and how close both are after so many steps.
ROUNDING = ((1, 1e-12), (1, 1e-12), (48, 1e-12), (250, 2e-11))
ON_ARRAYS = {
    **{
        f"isokinetic, order {order}": (
            Isokinetic(momentum="free"),
            thermostats.Isokinetic(order=order, momentum="free"),
            scheme,
            # Order 6 has 90 drifts a step, whose velocities are differences of positions.
            ROUNDING if order < 6 else ((50, 2e-11),),
        )
        for order, scheme in ((2, "rattle"), (4, "isokinetic4"), (6, "isokinetic6"))
    },
    **{
        f"chain of {n}": (
            NoseHoover(300 * unit.kelvin, 20.0, length=n),
            thermostats.NoseHooverChain(300 * GAS_CONSTANT, np.pi / 10, momentum="free", length=n),
            "rattle",
            ((1, 1e-12), (1, 1e-12), (48, 1e-12), (250, 1e-12)),
        )
        for n in (1, 10)
    },
}


@pytest.mark.parametrize("name", ON_ARRAYS)
def test_one_bond_as_the_stepper_on_arrays(name):
    """The same motion of atoms and chain, to rounding, in calls of any length."""
    ensemble, stepper, scheme, calls = ON_ARRAYS[name]
    system, x, v = dumbbell()
    dt, k, c = 0.5e-3, 50.0, 500.0
    motion = Motion(ConstraintSet([Distance([[0, 1]], 0.1)], x, masses_of(system)), x)
    v = motion.project_velocities(x, v)
    integrator = ProjectedIntegrator(dt, scheme, tolerance=1e-14, ensemble=ensemble)
    assert integrator.operations() == stepper.operations()
    assert all(f"  {operation}\n" in integrator.listing() for operation in stepper.operations())
    context = started(system, integrator, x, v)

    def force(r, t):
        x, y, z = r.T
        return -np.stack([2 * k * x + c * y**3, 2.6 * k * y + 3 * c * x * y**2, 1.4 * k * z], axis=1)

    def potential(r, t):
        x, y, z = r.T
        return float(np.sum(k * (x**2 + 1.3 * y**2 + 0.7 * z**2) + c * x * y**3))

    core, state = System(motion, force, potential=potential), State(x, v)
    for steps, limit in calls:
        state = steps_of(core, state, dt, steps, stepper=stepper)
        integrator.step(steps)
        r, u = state_of(context)
        assert np.abs(r - state.positions).max() <= limit
        assert np.abs(u - state.velocities).max() <= 100 * limit
        if name.startswith("chain"):
            n, near, kept = ensemble.length, 1e3 * limit, state.thermostat
            links = [integrator.getGlobalVariableByName(f"link{i + 1}") for i in range(n)]
            np.testing.assert_allclose(links, kept[n : 2 * n], rtol=near, atol=near)
            place = kept[2 * n] * kept[0] + kept[1:n].sum()
            assert integrator.getGlobalVariableByName("chain_place") == pytest.approx(place, rel=near)
            wanted = stepper.conserved_energy(core, state)
            assert ensemble.conserved_energy(integrator) == pytest.approx(wanted, rel=1e-11)


@pytest.mark.parametrize("bath", WITHOUT_NOISE)
@pytest.mark.usefixtures("without_device")
def test_rows_that_are_carried_move_as_those_of_the_system(bath):
    """The same bonds held by OpenMM and by kcons: one trajectory of atoms and bath, although others move x."""
    system, x, v = loose_alanine()
    other = copy.deepcopy(system)
    carried = hold(other, [], positions=x, take="all")
    ends = []
    for this, parts in ((system, ()), (other, (carried,))):
        integrator = ProjectedIntegrator(
            1e-3, parts=parts, tolerance=1e-13, ensemble=ENSEMBLES[bath](300.0, 20.0, momentum="free")
        )
        context = run(this, integrator, x, v, 10)
        r, u = state_of(context)
        context.setPositions(r + 0.7)
        context.setVelocities(u)
        integrator.step(10)
        ends.append((*state_of(context), integrator.program.remembered()))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=3e-12)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=3e-9)
    assert ends[0][2] == pytest.approx(ends[1][2], rel=1e-7)


@pytest.mark.parametrize("bath", WITHOUT_NOISE)
def test_calls_of_any_length_make_the_same_motion(bath):
    """Within a call two half kicks at one place are a whole one, and so are halves of a chain: nobody looks at K."""
    in_calls_of_any_length(lambda: ENSEMBLES[bath](300.0, 20.0))


@pytest.mark.parametrize("bath", ["Isokinetic", "NoseHoover"])
def test_parts_keep_their_rows(bath):
    system, x, parts = two_parts()
    ensemble = ENSEMBLES[bath](300.0)
    integrator = ProjectedIntegrator(1e-3, parts=parts, ensemble=ensemble)
    context = warm(system, integrator, x, 4)
    values = []
    for block in range(20):
        integrator.step(10)
        integrator.check()
        values.append(ensemble.conserved_energy(integrator))
        r, u = on_their_rows(*state_of(context))
        # 18 coordinates, three rows; the sphere stands in space, so that momentum is not conserved.
        if bath == "Isokinetic":
            assert abs(twice_kinetic(system, u) / ((18 - 3 - 1) * GAS_CONSTANT * 300) - 1) <= 1e-13
        if block == 1:  # somebody moves x between steps
            context.setPositions(r + 0.0)
            integrator.applyConstraints(context)
    assert ensemble.count(integrator) == 15
    if bath == "NoseHoover":
        assert np.ptp(values) < 0.05 < abs(integrator.getGlobalVariableByName("chain_place"))


# -- barostats ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ensemble", "barostat"), list(zip(ENSEMBLES.values(), cycle(BAROSTATS.values()))))
def test_a_barostat_of_another_temperature(ensemble, barostat):
    """Without a temperature of the integrator there is nothing to compare."""
    system, x = water_box(27)
    system.addForce(barostat(310))
    run(system, ProjectedIntegrator(1e-3, ensemble=Isokinetic(momentum="free")), x, np.sin(x), 1)
    integrator = ProjectedIntegrator(1e-3, ensemble=ensemble(300, momentum="free"))
    context = warm(system, integrator, x, 1)
    with pytest.warns(UserWarning, match=r"temperature of 310 K, and the integrator one of 300 K") as told:
        integrator.step(1)
    assert told[0].filename == __file__
    name = str(told[0].message).split("'")[1]
    context.setParameter(name, 300)
    with warnings.catch_warnings(action="error"):
        integrator.step(1)
        integrator.setTemperature(300)
    with pytest.warns(UserWarning, match=r"temperature of 300 K, and the integrator one of 350 K") as told:
        integrator.setTemperature(350)
    assert told[0].filename == __file__
