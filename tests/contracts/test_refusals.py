"""Refusals: the call, the type of the error, and the argument that it names.

No array that was given changes.
"""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import openmm
import pytest
from ase.build import molecule
from ase.calculators.emt import EMT

import kcons.ase
import kcons.constraints.projection
import kcons.mdanalysis
import kcons.motion
import kcons.openmm
import kcons.steppers
import kcons.thermostats
from kcons.errors import (
    ConstraintError,
    ContradictionError,
    InfeasibleError,
    InputError,
    KconsError,
    NonFiniteError,
    SingularGeometryError,
    UnsupportedError,
)

X = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0], [0.3, 1.0, 1.0]])
MASSES = [1.0, 2.0, 3.0, 4.0]
UNITS = ("length", "time", "energy")


def force(x: np.ndarray, t: float) -> np.ndarray:
    return -x


def openmm_system() -> openmm.System:
    system = openmm.System()
    for mass in MASSES:
        system.addParticle(mass)
    return system


def names() -> dict[str, Any]:
    """What calls are made of; the thermostats of arrays go before those of OpenMM with the same names."""
    found: dict[str, Any] = {}
    for room in (kcons.constraints, kcons.motion, kcons.openmm, kcons.steppers, kcons.thermostats, kcons.ase, kcons):
        found |= {name: getattr(room, name) for name in room.__all__}
    held = kcons.ConstraintSet(kcons.constraints.Distance([0, 1]), X, MASSES)
    motion = kcons.Motion(held, X)
    system = kcons.System(motion, force)
    groups = kcons.thermostats.ForceGroups({"fast": force, "slow": lambda x, t: -2 * x})
    moving = kcons.Motion(kcons.ConstraintSet(kcons.constraints.Distance([0, 1], lambda t: 1.0 + t), X, MASSES), X)
    atoms = molecule("H2O")
    atoms.calc = EMT()
    return found | {
        "kcons": kcons,
        "np": np,
        "ORACLE": kcons.constraints.projection,
        "X": X,
        "LINE": np.arange(4.0)[:, None] * [1.0, 0.0, 0.0],
        "V": np.zeros_like(X),
        "F": X,
        "M": MASSES,
        "inf": inf,
        "nan": nan,
        "force": force,
        "HELD": held,
        "MOTION": motion,
        "SYSTEM": system,
        "CELL": kcons.Motion(kcons.ConstraintSet([], X, MASSES, cell=[9.0] * 3), X),
        "GROUPED": kcons.System(motion, groups),
        "MOVING": kcons.System(moving, force),
        "TWO": {"temperature_K": 300, "friction": 0.1, "fast_steps": 4},
        "STATE": system.initial_state(X),
        "ATOMS": atoms,
        "openmm_system": openmm_system,
    }


#: A call, the argument that its `InputError` names, and what stands for ? in it.
REFUSED: list[tuple[str, ...]] = [
    ("Distance(?)", "atoms", "[0]", "[0, 0]", "[0, -1]", "[0.5, 1]", '"ab"', "[[0, 1], [2]]"),
    ("Distance([0, 1], ?)", "target", "nan", "[1.0, 2.0]", '"long"', "1 + 2j", "1e200"),
    ("DistanceDifference([[0, 1]])", "weights"),
    ("DistanceDifference([[0, 1], [1, 2]], weights=?)", "weights", "[1.0]", "[1.0, nan]", "[0.0, 0.0]"),
    ("DistanceDifference(?)", "pairs", "[0, 1, 2]", "[[0.0, 1.0], [1.0, 2.0]]", "[]", "[[0, 1], [2, 2]]"),
    ("DistanceDifference(?)", "pairs", "[[0, 1], [1, 0]]", "[[[0, 1], [1, 2]], [[3, 4], [5, 6]]]"),
    ("Angle(?)", "atoms", "[0, 1]", "[0, 1, 0]"),
    ("Angle([0, 1, 2], inf)", "target"),
    ("Dihedral([0, 1, 2])", "atoms"),
    ("Dihedral([0, 1, 2, 3], nan)", "target"),
    ("CenterDistance(?, [1, 2])", "atoms", "[0, 1]", "[]"),
    ("CenterDistance([0, 1], X[:1, :0].astype(int))", "groups"),
    ("CenterOfMass([0, 1], axes=?)", "axes", "(0, 3)", "()", "0", "(0.0, 1.0)", "(0, 0)"),
    ("CenterOfMass([0, 1]).measure(X[None, :2], 0.0)", "masses"),
    ("Sphere(0, ?)", "center", "[0, 0]", "[0, 0, nan]"),
    ("Cylinder(0, [0, 0, 0], [0, 0, 0])", "axis"),
    ("Torus(0, [0, 0, 0], [0, 0, 1], -1.0)", "major_radius"),
    ("Torus(0, [0, 0, 0], [0, 0, 1], 1.0, nan)", "target"),
    ("Ellipsoid(0, [0, 0, 0], ?)", "semi_axes", "[1, 0, 1]", "[inf] * 3"),
    ("Ellipsoid(0, [0, 0, 0], [1, 1, 1], [[1, 0, 0], [0, 2, 0], [0, 0, 1]])", "rotation"),
    ("Plane(0, ?)", "normal", "[0, 0, 0]", "[0, nan, 0]"),
    ("Plane(0, [0, 0, 1], 0.1, point=[0, 0, 1])", "point"),
    ("Line(0, None, [0, 0, 0])", "direction"),
    ("Line(0, ?, [0, 0, 1])", "point", "[0, nan, 0]", "[[0, 0, 0]] * 3"),
    ("LinearRelation(0, [1, 2], [0.5, 0.3, 0.2])", "weights"),
    ("LinearCombination([0, 1], [[0, 0, 0], [0, 0, 0]])", "coefficients"),
    ("FixedAtoms(?)", "atoms", "[0, 0]", "[-1]", "[[0, 1]]", "[True, False]"),
    ('Custom([0, 1], "x")', "function"),
    ("Custom([0, 1], lambda r, t: 1.0)", "function"),
    ("Custom([0, 1], len, ?)", "gradient", "3", "lambda: 1.0"),
    ("Custom([0, 1], len, period=-1.0)", "period"),
    ("ImplicitSurface(0, 3)", "function"),
    ("ImplicitSurface(0, len, length=-1.0)", "length"),
    ("CustomVelocity([0, 1], ?)", "coefficients", "None", "lambda r, v: r"),
    ("CustomVelocity([0, 1], len, time_step=0.0)", "time_step"),
    ("Formula(?, 0)", "formula", '"x1 +"', '"x9"', '"x1*9**9**9"', '"1"', '"x1^2"', '"z1 = x1**2"', '"3*t + pi"'),
    ("Formula(?, 0)", "formula", '"x1 if x2 else 0"', '"x1.real"', "\"x1*'a'\"", "\"__import__('os').getcwd()\""),
    ('Formula("?", 0)', "foo", "foo(x1)", "x1 - foo"),
    ('Formula("atan2(x1)", 0)', "atan2"),
    ('Formula("a*x1", 0)', "a"),
    ('Formula("x1 - vx1", 0)', "vx1"),
    ('Formula("x1 - x2", [[0, 1, 2]])', "atoms"),
    ('Formula("x1 - y1", [[0, 1]])', "atoms"),
    ('Formula("a*x1", [0, 1], {"a": [1.0, 2.0, 3.0]})', "a"),
    ('Formula("a*x1", 0, ?)', "parameters", "2.0", "{3: 1.0}"),
    ('Formula("x1", 0, {"x7": 1.0})', "x7"),
    *((f'Formula("x1", 0, {{"{name}": 1.0}})', name) for name in ("sin", "lambda", "copysign")),
    ('Formula("x1", 0, period=?)', "period", "0.0", "nan"),
    ("VelocityFormula(?, 0)", "formula", '"x1 - y1"', '"vx1**2"', '"vx1 - x1*t"'),
    ("KnifeEdge(?, [0, 0, 1])", "atoms", "0, 0", "[0, 1], [2]"),
    ("KnifeEdge(0, 1, [0, 0, 0])", "normal"),
    ("Rolling(0, 1, -1.0, [1, 0, 0])", "radius"),
    ("Rolling(0, 1, 1.0, [0, 0, 1])", "heading"),
    ("MovingTarget(3.0)", "the target"),
    ("MovingTarget(abs, lambda x, t: 1.0)", "the rate of the target"),
    ("?(0.0, 2)", "target", "MovingTarget(abs, acceleration=abs).rate_at", "MovingTarget(lambda t: nan).at"),
    ("MovingTarget(lambda t: [1.0, 2.0, 3.0]).at(0.0, 2)", "target"),
    ("MovingTarget(abs, time_step=0.0)", "the time_step of the target"),
    ("from_dict(Sphere([0, 1], [0, 0, 0], 1.0).todict() | ?)", "center", '{"center": [[0, 0]]}'),
    ("from_dict(Sphere([0, 1], [0, 0, 0], 1.0).todict() | ?)", "center", '{"center": [[0, 0, 0], [0, nan, 0]]}'),
    ("from_dict(Sphere([0, 1], [0, 0, 0], 1.0).todict() | ?)", "radius", '{"radius": 2.0}'),
    ("from_dict(Torus(0, [0, 0, 0], [0, 0, 1], 2.0).todict() | ?)", "axis", '{"axis": [[0, 3.0, 4.0]]}'),
    ("from_dict(Torus(0, [0, 0, 0], [0, 0, 1], 2.0).todict() | ?)", "major_radius", '{"major_radius": [-2.0]}'),
    ("from_dict(?)", "family", "{}", '{"family": "Distanz"}', "3", '{"family": ["Distance"]}'),
    ("from_dict(RadiusOfGyration([0, 1]).todict() | {'mass_weighted': 'no'})", "mass_weighted"),
    ("from_dict(DistanceDifference([[0, 1], [1, 2]]).todict() | {?})", "slots", "'slots': 3", "'weights': 'a'"),
    ("from_dict(DistanceDifference([[0, 1], [1, 2]]).todict() | {'slots': [[0, 1], [1, 3]]})", "slots"),
    ("ConstraintSet(Distance([0, 1]), X[:1], [1.0])", "atoms"),
    ("ConstraintSet(Distance([0, 9]), X, M)", "atoms"),
    ("ConstraintSet(Distance([0, 1]), ?, M)", "positions", "X[:, :2]", "X * nan"),
    ("ConstraintSet(Distance([0, 1]), X, ?)", "masses", "M[:2]", "[1.0, -1.0, 1.0, 1.0]"),
    ("System(Motion(ConstraintSet([], X, [1.0, 1.0, 1.0, ?]), X))", "masses", "0.0", "-1.0", "nan", "inf"),
    ("ConstraintSet(?, X, [0.0, 0.0, 1.0, 1.0])", "masses", "LinearCombination([0, 2], [[0, 0, 1], [0, 0, -1]])"),
    *(
        ("ConstraintSet([FixedAtoms([0, 1]), ?], X, [0.0, 0.0, 1.0, 1.0])", "masses", row)
        for row in ("CenterOfMass([0, 1])", "CenterDistance([2], [0, 1])", "RadiusOfGyration([0, 1])")
    ),
    ("ConstraintSet(RadiusOfGyration([1, 3]), X, M, cell=[3.0] * 3)", "positions"),
    ("ConstraintSet(Distance([[0, 1], [1, 2], [2, 3], [3, 0]]), LINE, M, cell=[5.0, 9.0, 9.0])", "target"),
    ("HELD.value(X[:2])", "positions"),
    ("HELD.?", "time", "target(nan)", "measure(X, nan)", "value(X, nan)", "jacobian(X, nan)", "residuals(X, V, nan)"),
    ("HELD.?", "time", "velocity_target(X, nan)", "acceleration_target(X, V, nan)", "tolerance(X, nan)"),
    ("HELD.?", "time", "target('1')", "target(1j)", "target([1.0])"),
    ("HELD.acceleration_target(X, X[:2], 0.0)", "velocities"),
    ("ConstraintSet(Distance([0, 1]), X, M, cell=?)", "cell", "[1.0, 1.0]", "[9.0, 9.0, 0.0]"),
    ("ConstraintSet(Distance([0, 1]), X, M, cell=[9.0, 9.0, 9.0], pbc=[True, True])", "pbc"),
    ("ConstraintSet(Distance([0, 1]), X, M, time=nan)", "time"),
    ('ConstraintSet("Distance", X, M)', "constraints"),
    ("Motion(3, X)", "constraint_set"),
    ("Motion(HELD, X[:2])", "positions"),
    ("Motion(HELD, X, time=nan)", "time"),
    ("MOTION.?, time=nan)", "time", "project_positions(X, X", "project_velocities(X, V", "restore_positions(X"),
    ("MOTION.?, time=nan)", "time", "acceleration(X, V, F", "multipliers(X, V, F", "constraint_force(X, V, F"),
    ("MOTION.?, time=nan)", "time", "project_forces(X, F", "certify(X", "report(X"),
    ("MOTION.project_positions(X, X, reference_time=nan)", "reference_time"),
    ("MOTION.project_positions(?, X)", "x_new", "X[:2]", "X.ravel()", "[[1.0, 2], [3]]", '"positions"'),
    ("MOTION.project_positions(?, X)", "x_new", "[[{}] * 3] * 4", "X * nan"),
    ("MOTION.project_positions(X, X[:, :2])", "x_ref"),
    ("MOTION.project_positions(X, X, velocities=X.copy())", "dt"),
    ("MOTION.project_positions(X, X, velocities=X.copy(), dt=?)", "dt", "0.0", "inf"),
    ("MOTION.project_velocities(X[:2], V)", "positions"),
    ("MOTION.project_forces(X, ?)", "forces", "X[:2]", "F[:, :2]"),
    ("MOTION.acceleration(X, V, X[:2])", "forces"),
    ("MOTION.multipliers(X, V, X.ravel())", "forces"),
    ("MOTION.constraint_force(X, V, X[:2])", "forces"),
    ("MOTION.restore_positions(X[:2])", "positions"),
    ("MOTION.report(X[:2])", "positions"),
    ("MOTION.project_velocities(X, X[:2])", "velocities"),
    ("MOTION.set_cell(?)", "cell", "[9.0, 9.0]", "[9.0, 0.0, 9.0]", "[9.0, 9.0, nan]"),
    ("System(3)", "motion"),
    ('System(MOTION, "force")', "force"),
    ("System(MOTION, force, potential=?)", "potential", "3", "lambda x: 0.0"),
    ("System(MOTION, ?)", "force", "lambda x, v, t: -v", "force, velocity_dependent=True"),
    (
        "ORACLE.acceleration([[1.0] * 6], ?, X[:2], [0.0])",
        "masses",
        "[1.0, 0.0]",
        "[1.0, -1.0]",
        "[1.0, nan]",
        "[1.0, inf]",
    ),
    ("ORACLE.acceleration(?, [0.0])", "masses", "[[0.0] * 6], [1.0], [0.0] * 6", "[[0.0] * 6], [1.0] * 5, [0.0] * 6"),
    ("ORACLE.bott_duffin([[1.0, 1.0]], ?, [0.0, 0.0], [0.0])", "masses", "[[1, 0.5], [0.4, 1]]", "[[nan, 0], [0, 1]]"),
    ("ORACLE.pseudo_inverse(?)", "matrix", "[1.0]", "[['a', 'b']]", "[[1.0], [1.0, 2.0]]", "X / 0"),
    ("ORACLE.pseudo_inverse(np.ma.masked_array(X, X == 1.0))", "matrix"),
    ("ORACLE.multipliers(X[:1], [1.0], [0.0] * 5, [0.0])", "f"),
    ("ORACLE.constraint_force(X[:1], [1.0], [0.0] * 3, [0.0, 0.0])", "b"),
    ("ORACLE.penrose_residuals(X, X)", "inverse"),
    ("minimize(MOTION, lambda y: y, X, tolerance=1.0, longest=1.0)", "force"),
    ("CellSystem(CELL, lambda x, t, cell: x, lambda x, t, cell: 0.0, force)", "stress"),
    ("System(MOTION, force, far=?)", "far", "0.0", "-1.0", "nan", '"far"'),
    ("SYSTEM.initial_state(?, V)", "positions", "X[:2]", "X * nan", "X * 1.5"),
    ("SYSTEM.initial_state(X, V[:2])", "velocities"),
    ("SYSTEM.total_energy(STATE)", "potential"),
    ("SYSTEM.initial_state(X, V, time=nan)", "time"),
    ("run(3, STATE, 0.01, 1)", "system"),
    ("run(SYSTEM, 3, 0.01, 1)", "state"),
    ("run(SYSTEM, STATE, ?, 1)", "dt", "nan", '"short"'),
    ("run(SYSTEM, STATE, 0.01, ?)", "steps", "-1", "1.5"),
    ("run(SYSTEM, STATE, 0.01, 1, stepper=3)", "stepper"),
    ("run(SYSTEM, STATE, 0.01, 1, every=0)", "every"),
    ("run(SYSTEM, STATE, 0.01, 1, check_every=-1)", "check_every"),
    ("run(SYSTEM, STATE, 0.01, 1, record=0)", "record"),
    ("run(SYSTEM, STATE, 0.01, 1, observers=[?])", "observers", "3", "lambda: None"),
    ("run(SYSTEM, State(X, V, nan), 0.01, 1)", "time"),
    ("Geodesic(?)", "substeps", "0", "1.5"),
    ("Composition([0.5, 0.4], 2)", "fractions"),
    ("RungeKuttaNystrom([0.5, 0.5], [1.1])", "drifts"),
    ("ReversibilityCheck(Rattle(), -1.0)", "tolerance"),
    ("ReversibilityCheck(3)", "stepper"),
    ("Langevin(?, 1.0, 1)", "thermal_energy", "-1.0", "None"),
    ("Langevin(1.0, ?, 1)", "friction", "-1.0", "[1.0, 2.0]", "inf"),
    ("Langevin(1.0, 1.0, ?)", "rng", "1.5", "-1", "2**64"),
    ("Langevin(1.0, 1.0, 1, substeps=?)", "substeps", "0", "1.5"),
    ("LangevinRespa(1.0, 1.0, 1, steps=?)", "steps", '{"fast": 0}', "{}", "4", '{"slow": 1, "fast": 2.5}'),
    ("LangevinRespa(1.0, 1.0, 1, steps=?)", "steps", '{"slow": 1, "fast": nan}', '{"slow": 1, "fast": True}'),
    ("LangevinRespa(1.0, 1.0, 1, steps=?)", "steps", '{"slow": 2, "fast": 4}', '{"slow": 1, "fast": 1}'),
    ("LangevinRespa(1.0, 1.0, 1, steps=?)", "steps", '{"slow": 1, "medium": 4, "fast": 6}'),
    ('LangevinRespa(1.0, 1.0, 1, steps={"slow": 1, "fast": 4}, slow_kicks="start")', "slow_kicks"),
    ('LangevinRespa(1.0, 1.0, 1, steps={"slow": 1, "fast": 3}, slow_kicks="middle")', "slow_kicks"),
    ('LangevinRespa(1.0, 1.0, 1, slow_kicks="middle")', "slow_kicks"),
    ("Isokinetic(?)", "thermal_energy", "0.0", "nan", '"warm"'),
    ("Isokinetic(1.0, order=3)", "order"),
    ('Isokinetic(1.0, convention="mean")', "convention"),
    ('IsokineticSpheres(1.0, 1.0, 1, spheres="many")', "spheres"),
    ("IsokineticSpheres(1.0, 1.0, 1, auxiliary=?)", "auxiliary", "-1", "1.5"),
    ("IsokineticSpheres(1.0, 0.0, 1)", "friction"),
    ("NoseHooverChain(1.0, 0.0)", "period"),
    ("NoseHooverChain(1.0, 1.0, length=0)", "length"),
    ("HamiltonianMonteCarlo(1.0, ?, 1)", "steps", "0", "2.5", "(4, 2)"),
    ("HamiltonianMonteCarlo(1.0, 10, 1, keep=?)", "keep", "nan", "1.5"),
    ("HamiltonianMonteCarlo(1.0, 10, 1, tolerance=0.0)", "tolerance"),
    ("ForceGroups(?)", "groups", "{}", "[force]", '{"": force}'),
    ('ForceGroups({"fast": ?})', "the force of group 'fast'", "3", "lambda x: x"),
    ('ForceGroups({"fast": force, "slow": force})', "slow"),
    ("Barostat(1.0, every=?)", "every", "0", "None"),
    ("Barostat(1.0, rng=-1)", "rng"),
    ('Barostat(1.0, kind=["normal"])', "kind"),
    ("Barostat(1.0, tension=?)", "tension", "nan", "1.0"),
    ("Barostat(1.0, cutoff=?)", "cutoff", "inf", "-3.0"),
    ("Barostat(1.0, molecules=[[0, 1], [2]])", "molecules"),
    ('Barostat(1.0, held="maybe")', "held"),
    ('Barostat([1.0, 1.0, 2.0], kind="anisotropic")', "pressure"),
    ("MonteCarloBarostat(1.0, width=0.0)", "width"),
    ("CellRescaling(1.0, -1.0, 1.0)", "tau"),
    ("CellRescaling(1.0, 1.0, nan)", "compressibility"),
    ('CellRescaling(1.0, 1.0, 1.0, kind="round")', "kind"),
    ("MonteCarloBarostat(nan)", "pressure"),
    ("ConstantPressure(Langevin(1.0, 1.0, 1), ?)", "barostat", "3", "None", "MonteCarloBarostat"),
    ("mean(?)", "values", "[1.0, 2.0]", "[nan] * 40", "[[0.0, 1.0]] * 40", "[1.0, 2.0, 3.0, nan] * 10"),
    ("thermal_velocities(SYSTEM, X, ?, 1)", "thermal_energy", "-1.0", "None"),
    ('thermal_velocities(SYSTEM, X, 1.0, "seed")', "rng"),
    ("exchange(?, [1.0], 1, 0)", "states", "[STATE]", "[STATE, STATE]"),
    ("exchange([STATE, STATE], [1.0, 0.0], 1, 0)", "thermal_energies"),
    ("exchange([STATE, STATE], [1.0, 2.0], 1, -1)", "number"),
    ("exchange(?, [1.0, 2.0], 1, 0)", "states", "[STATE, STATE]", "None", "[None, None]"),
    ('freedom(SYSTEM, STATE, F, momentum="maybe")', "momentum"),
    ("tune(SYSTEM, STATE, 0.1, HamiltonianMonteCarlo(1.0, 5, 1))", "potential"),
    ("TemperatureSplit(None)", "system"),
    ('TemperatureSplit(SYSTEM, rng="x")', "rng"),
    ("TemperatureSplit(SYSTEM, displacement=0.0)", "displacement"),
    ("tune(SYSTEM, STATE, -0.1, HamiltonianMonteCarlo(1.0, 5, 1))", "dt"),
    ("tune(SYSTEM, STATE, 0.1, HamiltonianMonteCarlo(1.0, 5, 1), wanted=1.0)", "wanted"),
    ("tune(SYSTEM, STATE, 0.1, HamiltonianMonteCarlo(1.0, 5, 1), proposals=10)", "proposals"),
    ("constrain(3, Distance([0, 1]))", "atoms"),
    ('constrain(ATOMS.copy(), "bonds")', "constrain"),
    ("constrain(ATOMS.copy(), 3)", "constraints"),
    ("constrain(ATOMS.copy(), ?)", "atoms", "Distance([0, 9])", "FixedAtoms([0, 0])"),
    ("constrain(ATOMS.copy(), Distance([0, 1], 2.0))", "positions"),
    ("constraints_of(ATOMS, ?)", "constrain", '"bond"', "3", '"none", rigid_water=False', "select=[0]"),
    ('constraints_of(ATOMS[1:], "none", guess_bonds=True)', "constrain"),
    ("constraints_of(ATOMS, on=?)", "on", '{"protein": "CenterOfMass"}', '[("protein", None)]', '["protein"]', "[1]"),
    ('constraints_of(ATOMS, angles="cosines")', "angles"),
    ("constraints_of(ATOMS, rigid_bodies=?)", "rigid_bodies", "[[0]]", "[[0, 9]]", "[[0, 1, 0]]"),
    ('constraints_of(ATOMS, guess_bonds=True, rigid_residues="BNZ")', "rigid_residues"),
    ("ConstraintLogger(None, ATOMS, ?)", "coordinates", "None, [Distance([0, 1])]", 'None, {"a": Distance([0, 1])}'),
    ('ConstraintLogger(None, ATOMS, None, {"a": [Distance([0, 1])]})', "coordinates['a']"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, 300, 0.01, barostat=?)", "barostat", '"MC"', "MonteCarloBarostat", "1.0"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, 300, 0.01, barostat=MonteCarloBarostat(0.0))", "cell"),
    ("rigid_water(?)", "atoms", "3", "ATOMS[:2]"),
    ("rigid_water(ATOMS, ?)", "water_geometry", '"tip9p"', "(1.0, 200.0)", "1.0"),
    ("from_ase_constraints(3)", "atoms"),
    ("attach(3)", "atoms"),
    ("Constraints(?)", "constraints", "3", "None", '"hbonds"'),
    ("ConstrainedDynamics(3, 1.0)", "atoms"),
    ("ConstrainedDynamics(ATOMS.copy(), ?)", "timestep", "nan", '"1 fs"', '"fast"'),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, ?)", "stepper", "3", "Rattle"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, state=3)", "state"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, -300, 0.01)", "temperature_K"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, 300, -0.01)", "friction"),
    ("ConstrainedNoseHoover(ATOMS.copy(), 0.1, 300, ?)", "tdamp", "0.0", "0"),
    ("IsokineticDynamics(ATOMS.copy(), 0.1, ?)", "temperature_K", "0", '"hot"'),
    ("ConstrainedMonteCarlo(ATOMS.copy(), 0.1, 300, 0)", "steps"),
    ("draw_velocities(ATOMS.copy(), -1)", "temperature_K"),
    ("repartition_hydrogen_mass(ATOMS.copy(), ?)", "mass", "0", "-1", "nan", '"3"'),
    ("repartition_hydrogen_mass([ATOMS])", "atoms"),
    ("ProjectedIntegrator(?)", "timestep", "0.0", "-0.001", '"fast"'),
    ('ProjectedIntegrator(0.001, "rattles")', "scheme"),
    ("ProjectedIntegrator(0.001, tolerance=2.0)", "tolerance"),
    ("ProjectedIntegrator(0.001, parts=[3])", "parts"),
    ("ProjectedIntegrator(0.001, check_every=-1)", "check_every"),
    ("ProjectedIntegrator(0.001, ensemble=3)", "ensemble"),
    ("kcons.openmm.Langevin(-300, 1.0)", "temperature"),
    ("kcons.openmm.Langevin(300, -1.0)", "friction"),
    ("kcons.openmm.Isokinetic(0)", "temperature"),
    ("kcons.openmm.NoseHoover(300, 0)", "frequency"),
    ("kcons.openmm.IsokineticSpheres(300.0, 0.0)", "friction"),
    ("SurfaceIntegrator(0.001, surfaces=[], system=openmm_system())", "surfaces"),
    ("hold(3, Distance([0, 1]), X)", "system"),
    ("hold(openmm_system(), Distance([0, 9]), X)", "atoms"),
    ("hold(openmm_system(), Distance([0, 1]), X[:2])", "positions"),
    ('hold(openmm_system(), Distance([0, 1]), X, take="some")', "take"),
    ("ConstraintSet(?, X, M)", "target", "Distance([0, 1], -1.0)", "Distance([0, 1], 0.0)", "Angle([0, 1, 2], 4.0)"),
    ("ConstraintSet(?, X, M)", "target", "CenterDistance([0], [1], -1.0)", "RadiusOfGyration([0, 1], -1.0)"),
    ("ConstraintSet(?, X, M)", "target", "Dihedral([0, 1, 2, 3], 60.0)", "Dihedral([0, 1, 2, 3], -60.0)"),
    ("ConstraintSet(?, X, M)", "target", "DistanceDifference([[0, 1], [1, 2]], -1.0, weights=[1, 1])"),
    ("ConstraintSet(?, X, M)", "target", "Ellipsoid(0, [9, 9, 9], [1, 1, 1], target=-1.5)"),
    ("ConstraintSet(Sphere([0, 1], [9, 9, 9], [1.0, -1.0]), X, M)", "radius"),
    ("HamiltonianMonteCarlo(1.0, 5, 1, stepper=3)", "stepper"),
    ("ConstantPressure(3, MonteCarloBarostat(1.0))", "stepper"),
    ("Composition([0.5, 0.5], 4)", "fractions"),
    ("Splitting(?, [1.0])", "kicks", "[0.5, 0.4]", "[1.0]"),
    ("Splitting([1.0], [0.5, 0.4, 0.1])", "drifts"),
    ("MOTION.acceleration(X, V, X / 0)", "force"),
    ("TemperatureSplit(SYSTEM).add(X[:2])", "positions"),
    ("TemperatureSplit(SYSTEM).add(X, X[:2])", "forces"),
    ("TemperatureSplit(SYSTEM).add(X * nan)", ""),
    ("TemperatureSplit(SYSTEM).result()", "samples"),
    ('slow_share(GROUPED, [X], "medium")', "group"),
    ("slow_share(GROUPED, X)", "frames"),
    ("slow_share(GROUPED, ?)", "positions", "X[None, :3]", "X[None, ::-1]"),
    ("slow_share(GROUPED, X[None], displacement=0.0)", "displacement"),
    ("ForceGroups.difference(?, ?)", "slow", "force", "GROUPED.force.__call__"),
    ('ForceGroups({"fast": GROUPED.force.__call__, "slow": GROUPED.force.__call__})', "slow"),
    ("LangevinRespa(1.0, 1.0, 1, steps=?).check(GROUPED)", "steps", '{"fast": 1}', '{"slow": 1, "mid": 2, "fast": 4}'),
    ("ForceGroups.difference(lambda x, t: x[:2], force)(X, 0.0)", "fast"),
    ('ForceGroups({"fast": force, "slow": lambda x, t: x[:2]})(X, 0.0)', "slow"),
    ("ConstrainedMonteCarlo(ATOMS.copy(), 0.1, 300, 3, keep=1.5)", "keep"),
    ("MultipleTimeSteps(ATOMS.copy(), 0.1, fast=ATOMS.calc, slow=?, **TWO)", "slow", "ATOMS.calc", "3"),
    ('MultipleTimeSteps(ATOMS.copy(), 0.1, fast=ATOMS.calc, slow=3, **{**TWO, "fast_steps": 1})', "steps"),
    ('MultipleTimeSteps(ATOMS.copy(), 0.1, fast=ATOMS.calc, slow=3, bath="hot", **TWO)', "bath"),
    ("MultipleTimeSteps([ATOMS], 0.1, fast=ATOMS.calc, slow=3, **TWO)", "atoms"),
    ("MultipleTimeSteps(ATOMS.copy(), 0.1, fast=ATOMS.calc, slow=3, auxiliary=2, **TWO)", "auxiliary"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, time=nan)", "time"),
    ('ConstrainedDynamics(ATOMS.copy(), 0.1, constraints="hbonds")', "constraints"),
    ("constraints_of([ATOMS])", "atoms"),
    ("constraints_of(ATOMS, water_geometry=(-1, 100))", "water_geometry"),
    ("draw_velocities([ATOMS], 300)", "atoms"),
    ("PressureReporter(None)", "dynamics"),
    ('PressureReporter(None, virial="mol")', "virial"),
    ('PressureReporter(None, virial="atomic", temperature_K=300)', "thermal_energy"),
    *((f"kcons.mdanalysis.RunUnits({name}=?)", name, "0.0", "-1.0", "nan", "inf") for name in UNITS),
    # Before the folder is looked for: nothing would be written.
    ('kcons.mdanalysis.TrajectoryWriter("nowhere/a.trr", -1)', "n_atoms"),
    ('kcons.mdanalysis.OpenMMReporter("nowhere/a.trr", 0)', "interval"),
]
#: Errors of other types.
OTHERS: list[tuple[str, type[KconsError], str | None]] = [
    ("Distance([0, 1]).target_at(0.0)", ConstraintError, None),
    ("ConstraintSet([Distance([0, 1], 1.0), Distance([1, 0], 2.0)], X, M)", ContradictionError, None),
    ("ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]], [1.0, 1.0, 3.0])], X, M)", InfeasibleError, None),
    ("HamiltonianMonteCarlo(1.0, 10, 1, stepper=Langevin(1.0, 1.0, 1))", UnsupportedError, None),
    ("constrain(ATOMS.copy(), [Distance([0, 1], 0.9), Distance([1, 0], 1.0)])", ContradictionError, None),
    ("ConstraintSet(RadiusOfGyration([0]), X, M)", SingularGeometryError, None),
    ("ConstraintSet(Sphere(0, [0, 0, 0], -1.0), X, M)", SingularGeometryError, None),
    ("ConstraintSet(Sphere(0, X[0]), X, M)", SingularGeometryError, None),
    ("Motion(ConstraintSet([FixedAtoms([0, 1]), Distance([0, 1], 9.0)], X, M), X)", ContradictionError, None),
    ("ConstraintSet(Angle([0, 1, 2]), X * 0, M)", SingularGeometryError, None),
    ("constrain(ATOMS.copy(), KnifeEdge(0, 1, [0, 0, 1]))", UnsupportedError, None),
    ("constrain(ATOMS.copy(), Distance([0, 1], lambda t: 1.0 + t))", UnsupportedError, None),
    ("TemperatureSplit(SYSTEM).add(X, X * nan)", NonFiniteError, "force"),
    ("TemperatureSplit(MOVING)", UnsupportedError, None),
    ("slow_share(SYSTEM, X[None])", UnsupportedError, None),
    ('LangevinRespa(1.0, 1.0, 1, steps={"slow": 1, "fast": 4}).check(SYSTEM)', UnsupportedError, None),
    ("slow_share(System(MOVING.motion, GROUPED.force), X[None])", UnsupportedError, None),
    ("NoseHooverChain(1.0, 1.0).check(MOVING)", UnsupportedError, None),
    ("Isokinetic(1.0).check(MOVING)", UnsupportedError, None),
    ("IsokineticSpheres(1.0, 1.0, 3).check(MOVING)", UnsupportedError, None),
    ('kcons.openmm.IsokineticSpheres(300.0, 1.0, spheres="global")', UnsupportedError, None),
    ("ProjectedIntegrator(0.01, ensemble=kcons.openmm.IsokineticSpheres(9, 1), device=False)", UnsupportedError, None),
]


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    return names()


CALLS = [
    *((call.replace("?", bad), InputError, item) for call, item, *bads in REFUSED for bad in bads or [""]),
    *OTHERS,
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("call", "kind", "item"), CALLS, ids=[call for call, _, _ in CALLS])
def test_refused(call: str, kind: type[KconsError], item: str | None, given: dict[str, Any]) -> None:
    before, atoms = X.copy(), given["ATOMS"].positions.copy()
    with pytest.raises(kind) as caught:
        eval(call, dict(given))
    assert type(caught.value) is kind
    assert getattr(caught.value, "item", None) == item
    assert len(str(caught.value)) >= 20
    assert np.array_equal(X, before) and np.array_equal(given["ATOMS"].positions, atoms)
