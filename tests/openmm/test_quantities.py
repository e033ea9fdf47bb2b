"""Quantities wherever an OpenMM user writes them."""

import numpy as np
import openmm
import pytest
from collective_cases import bond, with_variable
from openmm import unit
from openmm_systems import dumbbell, particles, started, state_of

from kcons.constraints import Distance
from kcons.errors import InputError
from kcons.openmm import (
    CollectiveRows,
    Isokinetic,
    Langevin,
    LangevinRespa,
    NoseHoover,
    ProjectedIntegrator,
    Row,
    constraints_of,
    hold,
)
from kcons.openmm.quantities import array, number

nm, ps, angstrom, kelvin = unit.nanometer, unit.picosecond, unit.angstrom, unit.kelvin
X = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.15, 0.1, 0], [0.3, 0.1, 0.2]])


def atoms():
    return particles(range(12, 16))


def test_numbers_and_arrays():
    assert number(3 * angstrom, nm, "x") == pytest.approx(0.3)
    assert number(3, nm, "x") == 3.0
    np.testing.assert_allclose(array([1 * nm, 5 * angstrom], nm, "x"), [1, 0.5])
    np.testing.assert_allclose(array([openmm.Vec3(1, 2, 3) * angstrom], nm, "x"), [[0.1, 0.2, 0.3]])
    for value in (3 * kelvin, "much", "2", None):
        with pytest.raises(InputError, match=r"length is .*give"):
            number(value, nm, "length")
    with pytest.raises(InputError, match="positions is 1 K; give it in nm"):
        array([1 * kelvin], nm, "positions")


def test_collective_variables_of_composite_units():
    """A product of two distances, and a spring's energy times a length: OpenMM does not tell their units."""
    system = atoms()
    product = with_variable("a*b", a=bond(0, 1), b=bond(2, 3, "50*r^2"))
    e = unit.kilojoule_per_mole
    rows = CollectiveRows(system, [Row(product, 2.0 * e * angstrom, rate=3 * e * angstrom / unit.nanosecond)])
    assert rows._targets == [pytest.approx(0.2)] and rows._rates == [pytest.approx(3e-4)]
    for wrong in (300 * kelvin, 3 * ps, 2 * nm / ps):
        with pytest.raises(InputError, match="of another kind"):
            CollectiveRows(atoms(), [Row(product, wrong)])


# -- arguments that are refused ---------------------------------------------------------------------

TWO = {0: 1, 1: 4}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ProjectedIntegrator(1 * kelvin), "timestep is 1 K; give it in ps"),
        (lambda: ProjectedIntegrator(1 * nm), "timestep is 1 nm; give it in ps"),
        (lambda: ProjectedIntegrator("soon"), "timestep is 'soon'; give a number of ps, or a Quantity"),
        *((lambda dt=dt: ProjectedIntegrator(dt), "positive") for dt in (np.nan, np.inf, -1 * ps)),
        (lambda: ProjectedIntegrator(1e-3, "rattel"), "no scheme 'rattel'; known: rattle, geodesic"),
        *(
            (lambda e=e: ProjectedIntegrator(1e-3, ensemble=e), "ensemble is .*; give one of kcons.openmm, such as")
            for e in ("langevin", 300, Isokinetic)
        ),
        *(
            (lambda p=p: ProjectedIntegrator(1e-3, parts=p), r"no part of an integrator; kcons\.openmm\.hold")
            for p in (Distance([[0, 1]]), [Distance([[0, 1]])])
        ),
        (lambda: Langevin(1 * nm, 1.0), "temperature is 1 nm; give it in K"),
        (lambda: Langevin([300], 1.0), "temperature is"),
        (lambda: Langevin(np.nan, 1), "temperature"),
        (lambda: Langevin(300, 1 * nm), "friction is 1 nm; give it in 1/ps"),
        (lambda: LangevinRespa(300, -1.0, TWO), "friction"),
        (lambda: LangevinRespa(300, 1.0, 4), "steps must name each force group"),
        (lambda: LangevinRespa(300, 1.0, {0: 1}), "give two or more"),
        (lambda: LangevinRespa(300, 1.0, {0: 1, 32: 4}), "force group 32 is no number from 0 to 31"),
        (lambda: LangevinRespa(300, 1.0, {0: 1, "fast": 4}), "force group 'fast' is no number"),
        (lambda: LangevinRespa(300, 1.0, {0: 1, 1: 0}), "steps is 0"),
        (lambda: LangevinRespa(300, 1.0, {**TWO, 2: 6}), "does not divide"),
        (lambda: LangevinRespa(300, 1.0, {0: 1, 1: 3}, "middle"), "no middle"),
        (lambda: NoseHoover(0.0, 1.0), "temperature"),
        (lambda: NoseHoover(1 * nm, 1.0), "give it in K"),
        (lambda: NoseHoover(300, 1 * nm), "frequency is 1 nm; give it in 1/ps"),
        (lambda: NoseHoover(300, 1.0, length=0), "length is 0"),
        (lambda: NoseHoover(300, 1.0, momentum="maybe"), "momentum"),
        (lambda: ProjectedIntegrator(2e-3, ensemble=Isokinetic(300)).setTemperature(0), "temperature"),
        *(
            (lambda g=g: ProjectedIntegrator(1e-3).setIntegrationForceGroups(g), "group")
            for g in ({40}, [0.5], "0", 1.5, None)
        ),
    ],
)
def test_arguments_of_integrators_and_ensembles(make, words):
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.parametrize(
    ("call", "given", "words"),
    [
        ("setStepSize", [1 * nm], "timestep is 1 nm"),
        ("setStepSize", [-0.001], "positive"),
        ("setTemperature", [1 * nm], "temperature is 1 nm"),
        ("setFriction", [1 * nm], "friction is 1 nm"),
        *(("setConstraintTolerance", [t], "tolerance") for t in ("small", None, np.nan, 0.0, 1 * nm)),
        *(("setVelocitiesToTemperature", [..., t], "temperature is") for t in (1 * nm, -5, np.nan)),
        *(("setVelocitiesToTemperature", [..., 300, rng], "rng is") for rng in (2.7, 2**31)),
        *(("minimizeEnergy", [..., tolerance], "tolerance is") for tolerance in (1 * nm, np.nan, -1)),
        ("minimizeEnergy", [..., 10.0, 2.5], "maxIterations"),
        ("applyConstraints", [..., -1], "tolerance is"),
        ("applyVelocityConstraints", [..., "small"], "tolerance is"),
    ],
)
def test_arguments_of_methods(call, given, words):
    """... stands for the Context, where nothing changes."""
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1))
    context = started(system, integrator, x, v)
    with pytest.raises(InputError, match=words):
        getattr(integrator, call)(*(context if each is ... else each for each in given))
    np.testing.assert_array_equal(state_of(context), (x, v))


def test_positions_of_the_wrong_kind():
    for call in (
        lambda: hold(atoms(), [Distance([[0, 1]])], positions=X * kelvin),
        lambda: constraints_of(openmm.app.Topology(), X[:0] * kelvin),
    ):
        with pytest.raises(InputError, match=r"positions .*give it in nm"):
            call()
    with pytest.raises(InputError, match="time is 1 nm; give it in ps"):
        hold(atoms(), [Distance([[0, 1]])], positions=X, time=1 * nm)
