"""Test systems of the comparison at small sizes."""

from importlib.util import find_spec

import beads as beads  # test systems of the tests alone

from kcons.comparison import test_systems
from kcons.steppers import State, System, run

#: Test systems that are stored reference cases, solved with 45 digits in minimal coordinates or closed form.
STORED = {
    "butane": "A07_butane_bonds_angles_fixed",
    "dumbbells": "A05_two_dumbbells_lj",
    "rotor": "A06_asymmetric_top4",
    "tennis-racket": "A06_tennis_racket4",
    "pendulum": "A03_planar_pendulum_179p9deg",
    "double-pendulum": "A04_double_pendulum",
    "triple-pendulum": "A04_triple_pendulum",
    "bead-ellipse": "A08_bead_vertical_ellipse",
    "bead-rotating": "A08_bead_rotating_ellipse",
    "bead-torus": "A08_torus_geodesic",
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
