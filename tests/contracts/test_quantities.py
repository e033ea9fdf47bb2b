"""Quantities in every argument of every family: the same numbers, remembered, and refused where units are unknown."""

import inspect
import pickle

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.emt import EMT
from constraint_cases import scattered
from openmm import Vec3, unit

from kcons import ConstraintSet, Motion, State, System, run
from kcons.ase import ConstrainedDynamics, ConstrainedLangevin, constrain, draw_velocities
from kcons.constraints import FAMILIES, CustomVelocity, Distance, from_dict
from kcons.constraints.arguments import ANGLE, ANY, DIRECTION, HELD, LENGTH, MD_UNITS, NUMBER, TIME, rules_of
from kcons.errors import InputError

nm, angstrom, fs = unit.nanometer, unit.angstrom, unit.femtosecond


def height(r):
    return r[0, 2] if r.ndim == 2 else None


def up(r):
    return np.array([[0.0, 0.0, 1.0]])


def heights(r):
    return r[:, 2]


def ups(r):
    return np.tile([0.0, 0.0, 1.0], (len(r), 1))


#: Arguments of each family, in nm, ps, radian.
MADE = {
    "Distance": {"pairs": [[0, 1], [2, 3]], "target": [0.3, 0.4]},
    "DistanceDifference": {"pairs": [[0, 1], [1, 2]], "target": -0.1, "weights": [1.0, -0.5]},
    "Angle": {"triples": [[0, 1, 2]], "target": 1.9},
    "Dihedral": {"quads": [[0, 1, 2, 3]], "target": 0.5},
    "FixedAtoms": {"atoms": [0, 1], "target": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]},
    "LinearCombination": {"atoms": [0, 1], "coefficients": [[0, 0, 1.0], [0, 0, -1.0]], "target": 0.1},
    "LinearRelation": {"atoms": 0, "bases": [1, 2], "weights": [0.5, 0.5], "target": [[0.1, 0.2, 0.3]]},
    "CenterOfMass": {"groups": [0, 1], "axes": (0, 1, 2), "target": [[0.1, 0.2, 0.3]]},
    "CenterDistance": {"group_a": [0, 1], "group_b": [2, 3], "target": 0.3},
    "RadiusOfGyration": {"atoms": [0, 1, 2], "target": 0.2, "mass_weighted": True},
    "Sphere": {"atoms": [0, 1], "center": [0.1, 0.2, 0.3], "radius": 0.5},
    "Cylinder": {"atoms": [0], "point": [0.1, 0.2, 0.3], "axis": [0.0, 1.0, 1.0], "radius": 0.5},
    "Torus": {
        **{"atoms": [0], "center": [0.1, 0.2, 0.3], "axis": [0.0, 1.0, 1.0]},
        **{"major_radius": 0.9, "minor_radius": 0.2},
    },
    "Ellipsoid": {
        **{"atoms": [0], "center": [0.1, 0.2, 0.3], "semi_axes": [0.2, 0.3, 0.4], "rotation": np.eye(3)},
        **{"target": 0.01},
    },
    "Plane": {"atoms": [0], "normal": [1.0, 0.0, 1.0], "offset": 0.3},
    "Line": {"atoms": [0], "point": [0.1, 0.2, 0.3], "direction": [1.0, 0.0, 1.0]},
    "ImplicitSurface": {
        **{"atoms": [0, 1], "function": heights, "gradient": ups, "target": 0.3},
        **{"time_dependent": False, "length": 0.5, "time_step": 0.1},
    },
    "Custom": {
        **{"atoms": [[0]], "function": height, "gradient": up, "target": 0.3},
        **{"time_dependent": False, "translation_invariant": False, "period": 2.0},
        **{"length": 0.5, "time_step": 0.1},
    },
    "Formula": {
        **{"formula": "z1 - a*x1", "atoms": [0], "parameters": {"a": 2.0}, "target": 0.3, "period": 2.0},
    },
    "VelocityFormula": {"formula": "vz1 - a*x1*vx1", "atoms": [0], "parameters": {"a": 2.0}, "target": 0.3},
    "CustomVelocity": {
        **{"atoms": [[0]], "coefficients": up, "target": 0.1, "time_dependent": False},
        **{"translation_invariant": False, "length": 0.5, "time_step": 0.1},
    },
}
#: Arguments that are no measured numbers: atoms, functions, flags.
OTHERS = {
    *("self", "pairs", "triples", "quads", "atoms", "bases", "groups", "axes", "group_a", "group_b"),
    *("function", "gradient", "formula", "parameters"),
    *("mass_weighted", "time_dependent", "translation_invariant"),
}
#: How a number of each kind is written with a unit: what it is multiplied with, and the unit.
WRITTEN = {
    LENGTH: (10.0, angstrom),
    ANGLE: (180 / np.pi, unit.degree),
    TIME: (1e3, fs),
    NUMBER: (1.0, unit.dimensionless),
    DIRECTION: (10.0, angstrom),
    ANY: (10.0, angstrom),
}
WRONG = {LENGTH: unit.kelvin, ANGLE: nm, TIME: nm, NUMBER: nm}


def kind_of(family, name):
    kind = rules_of(family.__init__.__wrapped__)[name].kind
    return family.held if kind is HELD else kind


def measured(family):
    return [n for n in inspect.signature(family.__init__).parameters if n not in OTHERS and not callable_at(family, n)]


def callable_at(family, name):
    return family is CustomVelocity and name == "coefficients"


OWN = {name: family for name, family in FAMILIES.items() if family.__module__.startswith("kcons.")}
EACH = [(f, n) for f in FAMILIES.values() if f.family in MADE for n in measured(f)]


def same(a, b):
    assert a.__dict__.keys() - {"units"} == b.__dict__.keys() - {"units"}
    for name in a.__dict__.keys() - {"units"}:
        one, other = getattr(a, name), getattr(b, name)
        if isinstance(one, np.ndarray | float):
            np.testing.assert_allclose(one, other, rtol=1e-14, err_msg=name)
        else:
            assert one == other, name


def test_every_family_and_every_argument_is_here():
    assert {name for name, family in OWN.items() if set(measured(family)) - {"target"}} <= set(MADE)
    for name, family in ((name, FAMILIES[name]) for name in MADE):
        known = set(inspect.signature(family.__init__).parameters) - {"self"}
        assert set(MADE[name]) >= known - {"point" if name == "Plane" else "", "self"}
        assert all(kind_of(family, argument) in WRITTEN for argument in measured(family))


@pytest.mark.parametrize(("family", "name"), EACH, ids=lambda x: getattr(x, "family", x))
def test_a_quantity_is_the_same_number(family, name):
    arguments = dict(MADE[family.family])
    if (family.family, name) == ("Plane", "point"):
        arguments.pop("offset")
        arguments["point"] = [0.1, 0.2, 0.3]
    plain = family(**arguments)
    kind = kind_of(family, name)
    factor, of = WRITTEN[kind]
    value = np.asarray(arguments[name], dtype=float) * factor
    forms = [value.tolist() * of, value * of if value.ndim else float(value) * of]
    if value.ndim == 1:
        forms.append([part * of for part in value.tolist()])
    if value.ndim == 2:
        forms.append([[part * of for part in row] for row in value.tolist()])
    if value.shape == (3,):
        forms.append(Vec3(*value) * of)
    for form in forms:
        made = family(**{**arguments, name: form})
        same(made, plain)
        assert made.units == (None if kind in (ANGLE, NUMBER, DIRECTION) else MD_UNITS)
    assert plain.units is None
    if kind in WRONG:
        with pytest.raises(InputError, match=f"{family.family}: {name} is .* give it in") as caught:
            family(**{**arguments, name: value.tolist() * WRONG[kind]})
        assert kind.words in str(caught.value) and name in caught.value.item


def test_what_is_in_nm_is_refused_where_nobody_knows_units():
    x, masses = scattered(3), np.ones(8)
    with pytest.raises(InputError, match="was given Quantities and is in nm"):
        ConstraintSet([Distance([[0, 1]], 1 * angstrom)], x, masses)
    kept = from_dict(Distance([[0, 1]], 1 * angstrom).todict())
    assert kept.units == MD_UNITS and kept.target == pytest.approx([0.1])
    assert pickle.loads(pickle.dumps(kept)).select([0]).renumbered(np.array([1, 0])).units == MD_UNITS
    moving = Distance([[0, 1]], lambda t: (3 + t) * angstrom)
    with pytest.raises(InputError, match="target has units"):
        ConstraintSet([moving], x, masses)


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


def test_units_of_other_libraries_are_refused():
    class Other(np.ndarray):
        unit = "km"

    with pytest.raises(InputError, match=r"units that are not those of openmm\.unit"):
        Distance([[0, 1]], np.ones(1).view(Other))


def test_ase_refuses_what_is_in_nm():
    atoms = Atoms("H2", positions=[[0, 0, 0], [1.0, 0, 0]], calculator=EMT())
    with pytest.raises(InputError, match="was given Quantities"):
        constrain(atoms, [Distance([[0, 1]], 1 * angstrom)])
    constrain(atoms, [Distance([[0, 1]])])
    for call, item in (
        (lambda: ConstrainedDynamics(atoms, 1 * fs), "timestep"),
        (lambda: ConstrainedLangevin(atoms, 1.0, 300, 0.1 / fs), "friction"),
        (lambda: ConstrainedLangevin(atoms, 1.0, 300 * unit.kelvin, 0.1), "temperature_K"),
        (lambda: draw_velocities(atoms, 300 * unit.kelvin), "temperature_K"),
    ):
        with pytest.raises(InputError, match=item):
            call()
