"""Test systems of the comparison at small sizes."""

from importlib.util import find_spec

import numpy as np

from kcons import ConstraintSet
from kcons.comparison import add_system, test_systems
from kcons.comparison.test_systems.potential import Potential, uniform_field
from kcons.comparison.test_systems.system import BARE, TestSystem
from kcons.constraints import MovingTarget, Sphere
from kcons.steppers import State, System, run


def breathing(size, rng):
    """A spherical pendulum whose length breathes: what moves by itself."""
    swing = MovingTarget(lambda t: 1 + 0.2 * np.sin(t), lambda t: 0.2 * np.cos(t), lambda t: -0.2 * np.sin(t))
    x, masses = np.array([[0.6, 0.0, -0.8]]), np.ones(1)
    return TestSystem(
        name="breathing",
        title="spherical pendulum whose length breathes",
        constraint_set=ConstraintSet(Sphere(0, np.zeros(3), swing), x, masses),
        positions=x,
        velocities=np.array([[0.12, 0.9, -0.16]]),
        potential=Potential(uniform_field(masses), "uniform field"),
        symbols=["X"],
        horizon=4.0,
        time_steps=(0.1, 0.05, 0.025, 0.0125),
        tolerances=(1e-3, 1e-6, 1e-9),
        units=BARE,
    )


add_system("breathing", breathing, "a pendulum whose length breathes", unit="pendulum", only=True)

#: Test systems that are stored reference cases, solved with 45 digits in minimal coordinates or closed form.
STORED = {
    "butane": "A07_butane_bonds_angles_fixed",
    "dumbbells": "A05_two_dumbbells_lj",
    "rotor": "A06_asymmetric_top4",
    "pendulum": "A03_planar_pendulum_179p9deg",
    "double-pendulum": "A04_double_pendulum",
    "triple-pendulum": "A04_triple_pendulum",
}

#: Molecules with forces of OpenMM that are too large, see tests/comparison/test_files.py.
LARGE = {"dhfr", "dhfr-water", "villin", *(() if find_spec("openmm") else ("alanine",))}
#: All others, those that a user or a test has added included.
SMALL = {
    name: 5 if name.startswith("chain") else entry.quick_size
    for name, entry in test_systems.SYSTEMS.items()
    if name not in LARGE
}


def small(name, **options):
    if name in ("water", "ethanol"):
        # Forces that come with ASE: these tests do not need the extras.
        options = {"forces": {"water": "ase", "ethanol": "emt"}[name], **options}
    return test_systems.build(name, SMALL[name], **options)


def end(test_system, dt):
    system = System(test_system.motion, test_system.potential.forces)
    return run(system, State(test_system.positions, test_system.velocities), dt, round(test_system.horizon / dt))
