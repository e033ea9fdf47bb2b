"""What is done to a Context behind its integrator's back: what is noticed, and what is refused."""

from __future__ import annotations

import logging

import numpy as np
import openmm
import pytest
from ensemble_runs import run, twice_kinetic
from openmm_systems import potential_energy, started, state_of, with_and_without_device
from tied_cluster import ON_DEVICE, X, carried_at, cluster, row_at, thermostatted

from kcons.errors import CertificateError, InputError, KconsError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator
from kcons.openmm.quantities import GAS_CONSTANT

parts = pytest.mark.parametrize("make", [row_at, carried_at], ids=["collective", "carried"])
everywhere = pytest.mark.parametrize(
    "make", [row_at, carried_at, ON_DEVICE["device, carried"]], ids=["collective", "carried", "device"]
)


# -- the System is read again ---------------------------------------------------------------------------


@with_and_without_device
@pytest.mark.parametrize("preserved", [True, False])
def test_rows_after_reinitialize(preserved, device):
    system, integrator = cluster(), ProjectedIntegrator(0.002, device=device)
    context = run(system, integrator, X, 0 * X, 3)
    free = integrator.degrees_of_freedom()
    x, v = state_of(context)
    system.addConstraint(0, 1, 1.01 * float(np.linalg.norm(x[0] - x[1])))
    context.reinitialize(preserveState=preserved)
    if not preserved:
        context.setPositions(x)
        context.setVelocities(v)
    integrator.step(3)
    assert integrator.degrees_of_freedom() == free - 1
    x = state_of(context)[0]
    assert np.linalg.norm(x[0] - x[1]) == pytest.approx(system.getConstraintParameters(0)[2]._value, rel=1e-9)
    system.removeConstraint(0)
    context.reinitialize(preserveState=True)
    integrator.step(50)
    assert abs(np.linalg.norm(np.subtract(*state_of(context)[0][:2])) - np.linalg.norm(x[0] - x[1])) > 1e-4
    system.addConstraint(0, 1, 0.3)
    system.setConstraintParameters(0, 0, 1, 3.0)
    context.reinitialize(preserveState=True)
    integrator.attach(context)  # lengths are read again where somebody says so
    with pytest.raises(InputError, match="constraint 0 of the System"):
        integrator.step(1)


@with_and_without_device
def test_masses_and_lengths_after_reinitialize(device):
    system, integrator = cluster(), ProjectedIntegrator(0.002, device=device)
    length = float(np.linalg.norm(X[0] - X[1]))
    system.addConstraint(0, 1, length)
    context = run(system, integrator, X, np.sin(np.arange(X.size)).reshape(X.shape), 3)
    system.setParticleMass(2, 50.0)
    system.setConstraintParameters(0, 0, 1, 1.002 * length)
    context.reinitialize(preserveState=True)
    integrator.applyConstraints()
    integrator.applyVelocityConstraints()
    kinetic = context.getState(energy=True).getKineticEnergy()._value
    assert integrator.kinetic_energy()._value == pytest.approx(kinetic, rel=1e-6)
    integrator.step(3)
    integrator.check()
    x = state_of(context)[0]
    assert np.linalg.norm(x[0] - x[1]) == pytest.approx(1.002 * length, rel=1e-9)


@with_and_without_device
@pytest.mark.parametrize("ensemble", [Isokinetic(300, momentum="free"), Langevin(300, 1.0)], ids=repr)
@pytest.mark.parametrize("begun", [True, False])
def test_particles_that_lose_their_mass_take_no_heat(begun, ensemble, device):
    system = cluster()
    context = started(system, integrator := ProjectedIntegrator(0.002, ensemble=ensemble, device=device), X, X)
    assert integrator.degrees_of_freedom() == 24
    if begun:
        integrator.step(3)
    system.setParticleMass(2, 0.0)
    context.reinitialize(preserveState=True)
    integrator.step(100 if begun else 1)  # a check, or the first step, notices
    integrator.step(1)
    assert integrator.degrees_of_freedom() == 21
    if isinstance(ensemble, Isokinetic):
        assert twice_kinetic(system, state_of(context)[1]) == pytest.approx(20 * GAS_CONSTANT * 300, rel=1e-9)


# -- forces change --------------------------------------------------------------------------------------


@everywhere
def test_a_state_of_other_forces_does_not_bring_them(make):
    """The State of a run carries the forces that its program has kept."""
    soft, stiff, plain = make(strength=200.0), make(strength=5000.0), make(strength=5000.0)
    soft.run(5)
    stiff.context.setState(soft.context.getState(positions=True, velocities=True, integratorParameters=True))
    plain.context.setState(soft.context.getState(positions=True, velocities=True))
    stiff.run(1)
    plain.run(1)
    np.testing.assert_allclose(state_of(stiff.context), state_of(plain.context), rtol=0, atol=1e-12)


# -- positions and velocities change ----------------------------------------------------------------------


def length_of(context):
    x = state_of(context)[0]
    return np.linalg.norm(x[0] - x[7])


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
@everywhere
def test_positions_off_the_rows_are_not_pulled_back_in_silence(make, scheme, caplog):
    """Near ones are brought back with a note in the log, far ones refused."""
    made = make(scheme=scheme)
    made.run(5)
    wanted = length_of(made.context)
    x, v = state_of(made.context)
    moved = x.copy()
    moved[0] += 0.5 * (x[7] - x[0]) + 0.05
    made.context.setPositions(moved)
    with pytest.raises(KconsError, match="apply"):
        made.run(1)
    np.testing.assert_array_equal(state_of(made.context), [moved, v])
    made.integrator.applyConstraints(made.context)
    made.run(3)
    assert length_of(made.context) == pytest.approx(wanted, abs=1e-12)
    x, _ = state_of(made.context)
    x[0] += 0.01
    made.context.setPositions(x)
    with caplog.at_level(logging.WARNING, "kcons"):
        made.run(1)
    assert "put right" in caplog.text and length_of(made.context) == pytest.approx(wanted, abs=1e-12)


@everywhere
def test_the_minimizer_of_openmm_does_not_know_rows(make):
    made = make(0.5)
    made.run(1)
    x, _ = state_of(made.context)
    openmm.LocalEnergyMinimizer.minimize(made.context)
    with pytest.raises(KconsError, match=r"OpenMM.s minimizer is one: take integrator\.minimizeEnergy"):
        made.run(1)
    made.context.setPositions(x)
    before = potential_energy(made.context)
    made.integrator.minimizeEnergy(made.context, maxIterations=5)
    assert potential_energy(made.context) < before
    assert length_of(made.context) == pytest.approx(0.5, abs=1e-12)
    made.run(3)


# -- parts that were forgotten ------------------------------------------------------------------------------


@everywhere
def test_forgotten_parts_are_refused(make):
    made = make()  # which has the System
    context = started(made.context.getSystem(), integrator := ProjectedIntegrator(1e-3), X)
    with pytest.raises(InputError, match=r"parts=\[rows\]"):
        integrator.step(1)
    del context


# -- the certificate --------------------------------------------------------------------------------------------


@parts
def test_solvers_that_lie_are_found(make):
    """The program holds another target than the rows say: at the next check, back to the last that was right."""
    made = make()
    made.integrator.check_every = 10
    made.run(20)
    good = state_of(made.context)
    _lie(make, made)
    with pytest.raises(CertificateError, match=r"positions are off row .* back at step 20") as caught:
        made.run(15)
    assert caught.value.step == 30 and caught.value.residual > 1e-6
    assert caught.value.state.getStepCount() == made.context.getStepCount() == 20
    np.testing.assert_array_equal(state_of(made.context), good)


def _lie(make, made):
    """Let the solver believe in a target that is 1e-5 nm off."""
    if make is row_at:
        made.integrator.program.set("tolerance1", 1e-3)
    else:
        solve = made.part.motion.project_positions

        def astray(*arguments, **options):
            result = solve(*arguments, **options)
            options["velocities"][0] += 1e-5
            return result

        made.part.motion.project_positions = astray


@pytest.mark.parametrize(
    ("make", "atom", "error", "words"),
    [
        (row_at, 0, KconsError, "velocit"),
        (carried_at, 0, KconsError, "velocit"),
        (thermostatted(None), 6, CertificateError, "velocities are off row constraint 0 of the System"),
    ],
)
def test_velocities_are_certified(make, atom, error, words):
    made = make()
    made.run(5)
    v = state_of(made.context)[1].copy()
    v[atom] += 1e-4
    made.context.setVelocities(v)
    with pytest.raises(error, match=words):
        made.integrator.check(made.context)
