"""Quantities are refused where units are not known."""

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.emt import EMT
from constraint_cases import scattered
from openmm import Vec3, unit

from kcons import ConstraintSet, Motion, State, System, run
from kcons.ase import ConstrainedDynamics, ConstrainedLangevin, constrain, draw_velocities
from kcons.constraints import Angle, Custom, Distance, Ellipsoid, FixedAtoms, Formula, Plane, Sphere
from kcons.errors import InputError

nm, angstrom, fs = unit.nanometer, unit.angstrom, unit.femtosecond


WITH_UNITS = {
    "target": lambda: Distance([[0, 1]], 1 * angstrom),
    "an angle": lambda: Angle([0, 1, 2], 109.5 * unit.degree),
    "targets in a list": lambda: Distance([[0, 1], [1, 2]], [1 * angstrom, 2 * angstrom]),
    "places": lambda: FixedAtoms([0], [Vec3(0, 0, 1) * nm]),
    "center": lambda: Sphere(0, [0, 0, 0] * nm),
    "semi-axes": lambda: Ellipsoid(0, [0, 0, 0], [1, 2, 3] * nm),
    "normal": lambda: Plane(0, [0, 0, 1] * nm),
    "parameter": lambda: Formula("x1 - a", 0, {"a": 1 * nm}),
    "length": lambda: Custom([0], lambda r: r[0, 2], length=1 * nm),
    "another target": lambda: Distance([[0, 1]]).with_target(1 * angstrom),
    "what a function returns": lambda: Distance([[0, 1]], lambda t: (3 + t) * angstrom).target_at(0.0),
}


@pytest.mark.parametrize("make", WITH_UNITS.values(), ids=WITH_UNITS)
def test_constraints_take_plain_numbers(make):
    with pytest.raises(InputError, match=r"has units \(.*give plain numbers|give a positive number"):
        make()


def test_positions_masses_and_the_like_are_refused_with_units():
    x = scattered(3)
    ones = np.ones(8)
    for positions, masses in ((x * nm, ones), (x, ones * unit.dalton), ([Vec3(*r) * nm for r in x], ones)):
        with pytest.raises(InputError, match="has units"):
            ConstraintSet([Distance([[0, 1]])], positions, masses)
    motion = Motion(ConstraintSet([Distance([[0, 1]])], x, np.ones(8)), x)
    for call in (
        lambda: motion.project_velocities(x * nm, x),
        lambda: motion.project_velocities(x, x * nm / unit.picosecond),
        lambda: run(System(motion), State(x * nm, x), 0.1, 1),
        lambda: run(System(motion), State(x, x), 1 * fs, 1),
        lambda: run(System(motion, lambda x, t: x * nm), State(x, motion.project_velocities(x, x)), 0.1, 1),
    ):
        with pytest.raises(InputError, match="has units"):
            call()


def test_dynamics_in_ase_take_plain_numbers():
    atoms = Atoms("H2", positions=[[0, 0, 0], [1.0, 0, 0]], calculator=EMT())
    constrain(atoms, [Distance([[0, 1]])])
    for call, item in (
        (lambda: ConstrainedDynamics(atoms, 1 * fs), "timestep"),
        (lambda: ConstrainedLangevin(atoms, 1.0, 300, 0.1 / fs), "friction"),
        (lambda: ConstrainedLangevin(atoms, 1.0, 300 * unit.kelvin, 0.1), "temperature_K"),
        (lambda: draw_velocities(atoms, 300 * unit.kelvin), "temperature_K"),
    ):
        with pytest.raises(InputError, match=item):
            call()
