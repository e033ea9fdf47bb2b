"""Refusals, a line each: the call, the type of the error, and the argument that it names.

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
import kcons.constraints
import kcons.motion
import kcons.openmm
import kcons.steppers
import kcons.thermostats
from kcons.errors import (
    ContradictionError,
    InfeasibleError,
    InputError,
    KconsError,
    SingularGeometryError,
    UnsupportedError,
)

X = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0], [0.3, 1.0, 1.0]])
MASSES = [1.0, 2.0, 3.0, 4.0]


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
    atoms = molecule("H2O")
    atoms.calc = EMT()
    return found | {
        "kcons": kcons,
        "X": X,
        "V": np.zeros_like(X),
        "F": X,
        "M": MASSES,
        "inf": inf,
        "nan": nan,
        "force": force,
        "HELD": held,
        "MOTION": motion,
        "SYSTEM": system,
        "STATE": system.initial_state(X),
        "ATOMS": atoms,
        "openmm_system": openmm_system,
    }


REFUSED: list[tuple[str, type[KconsError], str | None]] = [
    ("Distance([0])", InputError, "atoms"),
    ("Distance([0, 0])", InputError, "atoms"),
    ("Distance([0, -1])", InputError, "atoms"),
    ("Distance([0.5, 1])", InputError, "atoms"),
    ('Distance("ab")', InputError, "atoms"),
    ("Distance([0, 1], nan)", InputError, "target"),
    ("Distance([0, 1], [1.0, 2.0])", InputError, "target"),
    ('Distance([0, 1], "long")', InputError, "target"),
    ("Distance([0, 1], 1 + 2j)", InputError, "target"),
    ("Distance([0, 1], 1e200)", InputError, "target"),
    ("DistanceDifference([[0, 1]])", InputError, "weights"),
    ("DistanceDifference([[0, 1], [1, 2]], weights=[1.0])", InputError, "weights"),
    ("DistanceDifference([[0, 1], [1, 2]], weights=[1.0, nan])", InputError, "weights"),
    ("DistanceDifference([[0, 1], [1, 2]], weights=[0.0, 0.0])", InputError, "weights"),
    ("Angle([0, 1])", InputError, "atoms"),
    ("Angle([0, 1, 0])", InputError, "atoms"),
    ("Angle([0, 1, 2], inf)", InputError, "target"),
    ("Dihedral([0, 1, 2])", InputError, "atoms"),
    ("Dihedral([0, 1, 2, 3], nan)", InputError, "target"),
    ("CenterDistance([0, 1], [1, 2])", InputError, "atoms"),
    ("CenterDistance([], [1, 2])", InputError, "atoms"),
    ("CenterOfMass([0, 1], axes=(0, 3))", InputError, "axes"),
    ("CenterOfMass([0, 1], axes=())", InputError, "axes"),
    ("Sphere(0, [0, 0])", InputError, "center"),
    ("Sphere(0, [0, 0, nan])", InputError, "center"),
    ("Cylinder(0, [0, 0, 0], [0, 0, 0])", InputError, "axis"),
    ("Torus(0, [0, 0, 0], [0, 0, 1], -1.0)", InputError, "major_radius"),
    ("Torus(0, [0, 0, 0], [0, 0, 1], 1.0, nan)", InputError, "target"),
    ("Ellipsoid(0, [0, 0, 0], [1, 0, 1])", InputError, "semi_axes"),
    ("Ellipsoid(0, [0, 0, 0], [1, 1, 1], [[1, 0, 0], [0, 2, 0], [0, 0, 1]])", InputError, "rotation"),
    ("Plane(0, [0, 0, 0])", InputError, "normal"),
    ("Plane(0, [0, 0, 1], 0.1, point=[0, 0, 1])", InputError, "point"),
    ("Line(0, None, [0, 0, 0])", InputError, "direction"),
    ("Line(0, [0, nan, 0], [0, 0, 1])", InputError, "point"),
    ("LinearCombination([0, 1], [[0, 0, 0], [0, 0, 0]])", InputError, "coefficients"),
    ("FixedAtoms([0, 0])", InputError, "atoms"),
    ("FixedAtoms([-1])", InputError, "atoms"),
    ('Custom([0, 1], "x")', InputError, "function"),
    ("Custom([0, 1], len, 3)", InputError, "gradient"),
    ("Custom([0, 1], len, period=-1.0)", InputError, "period"),
    ("ImplicitSurface(0, 3)", InputError, "function"),
    ("ImplicitSurface(0, len, length=-1.0)", InputError, "length"),
    ("CustomVelocity([0, 1], None)", InputError, "coefficients"),
    ("CustomVelocity([0, 1], len, time_step=0.0)", InputError, "time_step"),
    ('Formula("x1 +", 0)', InputError, "formula"),
    ('Formula("x9", 0)', InputError, "formula"),
    ('Formula("foo(x1)", 0)', InputError, "foo"),
    ('Formula("x1*9**9**9", 0)', InputError, "formula"),
    ('Formula("a*x1", 0)', InputError, "a"),
    ('Formula("1", 0)', InputError, "formula"),
    ('VelocityFormula("x1", 0)', InputError, "formula"),
    ('VelocityFormula("vx1**2", 0)', InputError, "formula"),
    ("KnifeEdge(0, 0, [0, 0, 1])", InputError, "atoms"),
    ("KnifeEdge(0, 1, [0, 0, 0])", InputError, "normal"),
    ("Rolling(0, 1, -1.0, [1, 0, 0])", InputError, "radius"),
    ("Rolling(0, 1, 1.0, [0, 0, 1])", InputError, "heading"),
    ("MovingTarget(3.0)", InputError, "the target"),
    ("MovingTarget(abs, time_step=0.0)", InputError, "the time_step of the target"),
    ("from_dict({})", InputError, "family"),
    ('from_dict({"family": "Distanz"})', InputError, "family"),
    ("from_dict(3)", InputError, "family"),
    ("ConstraintSet(Distance([0, 1]), X[:1], [1.0])", InputError, "atoms"),
    ("ConstraintSet(Distance([0, 9]), X, M)", InputError, "atoms"),
    ("ConstraintSet(Distance([0, 1]), X[:, :2], M)", InputError, "positions"),
    ("ConstraintSet(Distance([0, 1]), X, M[:2])", InputError, "masses"),
    ("ConstraintSet(Distance([0, 1]), X, [1.0, -1.0, 1.0, 1.0])", InputError, "masses"),
    ("ConstraintSet(Distance([0, 1]), X * nan, M)", InputError, "positions"),
    ("ConstraintSet(Distance([0, 1]), X, M, cell=[1.0, 1.0])", InputError, "cell"),
    ("ConstraintSet(Distance([0, 1]), X, M, cell=[9.0, 9.0, 0.0])", InputError, "cell"),
    ("ConstraintSet(Distance([0, 1]), X, M, cell=[9.0, 9.0, 9.0], pbc=[True, True])", InputError, "pbc"),
    ("ConstraintSet(Distance([0, 1]), X, M, time=nan)", InputError, "time"),
    ('ConstraintSet("Distance", X, M)', InputError, "constraints"),
    ("ConstraintSet([Distance([0, 1], 1.0), Distance([1, 0], 2.0)], X, M)", ContradictionError, None),
    ("ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]], [1.0, 1.0, 3.0])], X, M)", InfeasibleError, None),
    ("Motion(3, X)", InputError, "constraint_set"),
    ("Motion(HELD, X[:2])", InputError, "positions"),
    ('Motion(HELD, X, degenerate="maybe")', InputError, "degenerate"),
    ("MOTION.project_positions(X[:2], X)", InputError, "x_new"),
    ("MOTION.project_positions(X.ravel(), X)", InputError, "x_new"),
    ("MOTION.project_positions([[1.0, 2], [3]], X)", InputError, "x_new"),
    ('MOTION.project_positions("positions", X)', InputError, "x_new"),
    ("MOTION.project_positions([[{}] * 3] * 4, X)", InputError, "x_new"),
    ("MOTION.project_positions(X, X[:, :2])", InputError, "x_ref"),
    ("MOTION.project_positions(X, X, velocities=X.copy())", InputError, "dt"),
    ("MOTION.project_positions(X, X, velocities=X.copy(), dt=0.0)", InputError, "dt"),
    ("MOTION.project_positions(X, X, velocities=X.copy(), dt=inf)", InputError, "dt"),
    ("MOTION.project_velocities(X[:2], V)", InputError, "positions"),
    ("MOTION.project_forces(X, X[:2])", InputError, "forces"),
    ("MOTION.acceleration(X, V, X[:2])", InputError, "forces"),
    ("MOTION.multipliers(X, V, X.ravel())", InputError, "forces"),
    ("MOTION.constraint_force(X, V, X[:2])", InputError, "forces"),
    ("MOTION.restore_positions(X[:2])", InputError, "positions"),
    ("MOTION.report(X[:2])", InputError, "positions"),
    ("MOTION.project_positions(X * nan, X)", InputError, "x_new"),
    ("MOTION.project_positions(X, X, time=nan)", InputError, "time"),
    ("MOTION.project_velocities(X, X[:2])", InputError, "velocities"),
    ("MOTION.project_forces(X, F[:, :2])", InputError, "forces"),
    ("MOTION.set_cell([9.0, 9.0])", InputError, "cell"),
    ("System(3)", InputError, "motion"),
    ('System(MOTION, "force")', InputError, "force"),
    ("System(MOTION, force, potential=3)", InputError, "potential"),
    ("System(MOTION, force, friction=-1.0)", InputError, "friction"),
    ("System(MOTION, force, friction=[1.0])", InputError, "friction"),
    ("System(MOTION, force, far=-1.0)", InputError, "far"),
    ("SYSTEM.initial_state(X[:2], V)", InputError, "positions"),
    ("SYSTEM.initial_state(X, V[:2])", InputError, "velocities"),
    ("SYSTEM.initial_state(X * nan, V)", InputError, "positions"),
    ("SYSTEM.initial_state(X * 1.5, V)", InputError, "positions"),
    ("SYSTEM.initial_state(X, V, time=nan)", InputError, "time"),
    ("run(3, STATE, 0.01, 1)", InputError, "system"),
    ("run(SYSTEM, 3, 0.01, 1)", InputError, "state"),
    ("run(SYSTEM, STATE, nan, 1)", InputError, "dt"),
    ('run(SYSTEM, STATE, "short", 1)', InputError, "dt"),
    ("run(SYSTEM, STATE, 0.01, -1)", InputError, "steps"),
    ("run(SYSTEM, STATE, 0.01, 1.5)", InputError, "steps"),
    ("run(SYSTEM, STATE, 0.01, 1, stepper=3)", InputError, "stepper"),
    ("run(SYSTEM, STATE, 0.01, 1, every=0)", InputError, "every"),
    ("run(SYSTEM, STATE, 0.01, 1, check_every=-1)", InputError, "check_every"),
    ("run(SYSTEM, STATE, 0.01, 1, record=0)", InputError, "record"),
    ("run(SYSTEM, STATE, 0.01, 1, observers=[3])", InputError, "observers"),
    ("Geodesic(0)", InputError, "substeps"),
    ("Geodesic(1.5)", InputError, "substeps"),
    ("Composition([0.5, 0.4], 2)", InputError, "fractions"),
    ("RungeKuttaNystrom([0.5, 0.5], [1.1])", InputError, "drifts"),
    ("Extrapolation(-1.0)", InputError, "tolerance"),
    ("Extrapolation(base=3)", InputError, "base"),
    ("ReversibilityCheck(Rattle(), -1.0)", InputError, "tolerance"),
    ("ReversibilityCheck(3)", InputError, "stepper"),
    ("Baumgarte(-1.0)", InputError, "rate"),
    ("Langevin(-1.0, 1.0, 1)", InputError, "thermal_energy"),
    ("Langevin(1.0, -1.0, 1)", InputError, "friction"),
    ("Langevin(1.0, 1.0, 1.5)", InputError, "rng"),
    ("Langevin(1.0, 1.0, 1, substeps=0)", InputError, "substeps"),
    ('LangevinRespa(1.0, 1.0, 1, steps={"fast": 0})', InputError, "steps"),
    ("LangevinRespa(1.0, 1.0, 1, order=3)", InputError, "order"),
    ("Isokinetic(0.0)", InputError, "thermal_energy"),
    ("Isokinetic(nan)", InputError, "thermal_energy"),
    ('Isokinetic("warm")', InputError, "thermal_energy"),
    ("Isokinetic(kinetic_energy=-1.0)", InputError, "kinetic_energy"),
    ("Isokinetic(kinetic_energy=inf)", InputError, "kinetic_energy"),
    ("Isokinetic(1.0, order=3)", InputError, "order"),
    ('Isokinetic(1.0, convention="mean")', InputError, "convention"),
    ("Isokinetic(1.0, kinetic_energy=1.0)", InputError, "thermal_energy"),
    ('IsokineticSpheres(1.0, 1.0, 1, spheres="many")', InputError, "spheres"),
    ("IsokineticSpheres(1.0, 1.0, 1, auxiliary=-1)", InputError, "auxiliary"),
    ("NoseHooverChain(1.0, 0.0)", InputError, "period"),
    ("NoseHooverChain(1.0, 1.0, length=0)", InputError, "length"),
    ("NoseHooverChain(1.0, 1.0, chain_order=3)", InputError, "chain_order"),
    ("HamiltonianMonteCarlo(1.0, 0, 1)", InputError, "steps"),
    ("HamiltonianMonteCarlo(1.0, 10, 1, keep=1.5)", InputError, "keep"),
    ("HamiltonianMonteCarlo(1.0, 10, 1, stepper=Baumgarte(1.0))", UnsupportedError, None),
    ("ForceGroups({})", InputError, "groups"),
    ('ForceGroups({"fast": 3})', InputError, "the force of group 'fast'"),
    ("Barostat(1.0, every=0)", InputError, "every"),
    ("CellRescaling(1.0, -1.0, 1.0)", InputError, "tau"),
    ('CellRescaling(1.0, 1.0, 1.0, kind="round")', InputError, "kind"),
    ("MonteCarloBarostat(nan)", InputError, "pressure"),
    ("ConstantPressure(Langevin(1.0, 1.0, 1), 3)", InputError, "barostat"),
    ("mean([1.0, 2.0])", InputError, "values"),
    ("mean([nan] * 40)", InputError, "values"),
    ("autocorrelation_time([1.0])", InputError, "values"),
    ("configurational_temperature([1.0] * 40, [1.0] * 39)", InputError, "curvatures"),
    ("thermal_velocities(SYSTEM, X, -1.0, 1)", InputError, "thermal_energy"),
    ('thermal_velocities(SYSTEM, X, 1.0, "seed")', InputError, "rng"),
    ("exchange([STATE], [1.0], 1, 0)", InputError, "states"),
    ("TemperatureSplit(SYSTEM, displacement=0.0)", InputError, "displacement"),
    ("TemperatureSplit(SYSTEM, directions=0)", InputError, "directions"),
    ("tune(SYSTEM, STATE, -0.1, HamiltonianMonteCarlo(1.0, 5, 1))", InputError, "dt"),
    ("constrain(3, Distance([0, 1]))", InputError, "atoms"),
    ('constrain(ATOMS.copy(), "bonds")', InputError, "constrain"),
    ("constrain(ATOMS.copy(), 3)", InputError, "constraints"),
    ("constrain(ATOMS.copy(), Distance([0, 9]))", InputError, "atoms"),
    ("constrain(ATOMS.copy(), Distance([0, 1], 2.0))", InputError, "positions"),
    ('constrain(ATOMS.copy(), Distance([0, 1]), degenerate="maybe")', InputError, "degenerate"),
    ('constraints_of(ATOMS, "bond")', InputError, "constrain"),
    ("constraints_of(ATOMS, 3)", InputError, "constrain"),
    ("rigid_water(3)", InputError, "atoms"),
    ('rigid_water(ATOMS, "tip9p")', InputError, "water_geometry"),
    ("from_ase_constraints(3)", InputError, "atoms"),
    ('to_ase_constraints(ATOMS, missing="drop")', InputError, "missing"),
    ("attach(3)", InputError, "atoms"),
    ("Constraints(3)", InputError, "constraints"),
    ("ConstrainedDynamics(3, 1.0)", InputError, "atoms"),
    ("ConstrainedDynamics(ATOMS.copy(), nan)", InputError, "timestep"),
    ('ConstrainedDynamics(ATOMS.copy(), "1 fs")', InputError, "timestep"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, 3)", InputError, "stepper"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, forces=[[0.0]])", InputError, "forces"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, state=3)", InputError, "state"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, friction=-1.0)", InputError, "friction"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, -300, 0.01)", InputError, "temperature_K"),
    ("ConstrainedLangevin(ATOMS.copy(), 0.1, 300, -0.01)", InputError, "friction"),
    ("ConstrainedNoseHoover(ATOMS.copy(), 0.1, 300, 0.0)", InputError, "tdamp"),
    ("IsokineticDynamics(ATOMS.copy(), 0.1, 0)", InputError, "temperature_K"),
    ("ConstrainedMonteCarlo(ATOMS.copy(), 0.1, 300, 0)", InputError, "steps"),
    ("draw_velocities(ATOMS.copy(), -1)", InputError, "temperature_K"),
    ("repartition_hydrogen_mass(ATOMS.copy(), 0)", InputError, "mass"),
    ("ProjectedIntegrator(0.0)", InputError, "timestep"),
    ("ProjectedIntegrator(-0.001)", InputError, "timestep"),
    ('ProjectedIntegrator("fast")', InputError, "timestep"),
    ('ProjectedIntegrator(0.001, "rattles")', InputError, "scheme"),
    ("ProjectedIntegrator(0.001, tolerance=2.0)", InputError, "tolerance"),
    ("ProjectedIntegrator(0.001, parts=[3])", InputError, "parts"),
    ("ProjectedIntegrator(0.001, check_every=-1)", InputError, "check_every"),
    ("ProjectedIntegrator(0.001, ensemble=3)", InputError, "ensemble"),
    ("kcons.openmm.Langevin(-300, 1.0)", InputError, "temperature"),
    ("kcons.openmm.Langevin(300, -1.0)", InputError, "friction"),
    ("kcons.openmm.Isokinetic(0)", InputError, "temperature"),
    ("kcons.openmm.NoseHoover(300, 0)", InputError, "frequency"),
    ("RattleIntegrator(0.0)", InputError, "timestep"),
    ("SurfaceIntegrator(0.001, [])", InputError, "surfaces"),
    ("hold(3, Distance([0, 1]), X)", InputError, "system"),
    ("hold(openmm_system(), Distance([0, 9]), X)", InputError, "atoms"),
    ("hold(openmm_system(), Distance([0, 1]), X[:2])", InputError, "positions"),
    ('hold(openmm_system(), Distance([0, 1]), X, take="some")', InputError, "which"),
    ("ConstraintSet(Distance([0, 1], -1.0), X, M)", InputError, "target"),
    ("ConstraintSet(Distance([0, 1], 0.0), X, M)", InputError, "target"),
    ("ConstraintSet(Angle([0, 1, 2], 4.0), X, M)", InputError, "target"),
    ("ConstraintSet(CenterDistance([0], [1], -1.0), X, M)", InputError, "target"),
    ("ConstraintSet(RadiusOfGyration([0]), X, M)", SingularGeometryError, None),
    ("ConstraintSet(RadiusOfGyration([0, 1], -1.0), X, M)", InputError, "target"),
    ("ConstraintSet(Sphere(0, [0, 0, 0], -1.0), X, M)", SingularGeometryError, None),
    ("ConstraintSet(Sphere(0, X[0]), X, M)", SingularGeometryError, None),
    ("Motion(ConstraintSet([FixedAtoms([0, 1]), Distance([0, 1], 9.0)], X, M), X)", ContradictionError, None),
    ("ConstraintSet(Angle([0, 1, 2]), X * 0, M)", SingularGeometryError, None),
    ("constrain(ATOMS.copy(), KnifeEdge(0, 1, [0, 0, 1]))", UnsupportedError, None),
    ("constrain(ATOMS.copy(), Distance([0, 1], lambda t: 1.0 + t))", UnsupportedError, None),
    ("constrain(ATOMS.copy(), FixedAtoms([0, 0]))", InputError, "atoms"),
    ('Constraints([Distance([0, 1])], degenerate="maybe")', InputError, "degenerate"),
    ("NoseHooverChain(1.0, 1.0, stepper=3)", InputError, "stepper"),
    ("HamiltonianMonteCarlo(1.0, 5, 1, stepper=3)", InputError, "stepper"),
    ("ConstantPressure(3, MonteCarloBarostat(1.0))", InputError, "stepper"),
    ("Composition([0.5, 0.5], 4)", InputError, "fractions"),
    ("Splitting([0.5, 0.4], [1.0])", InputError, "kicks"),
    ("Splitting([1.0], [0.5, 0.4, 0.1])", InputError, "drifts"),
    ("Splitting([1.0], [1.0])", InputError, "kicks"),
    ("ConstrainedDynamics(ATOMS.copy(), 0.1, Rattle)", InputError, "stepper"),
    ("MOTION.acceleration(X, V, X / 0)", InputError, "force"),
]


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    return names()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("call", "kind", "item"), REFUSED, ids=[call for call, _, _ in REFUSED])
def test_refused(call: str, kind: type[KconsError], item: str | None, given: dict[str, Any]) -> None:
    before, atoms = X.copy(), given["ATOMS"].positions.copy()
    with pytest.raises(kind) as caught:
        eval(call, dict(given))
    assert type(caught.value) is kind
    assert getattr(caught.value, "item", None) == item
    assert len(str(caught.value)) >= 20
    assert np.array_equal(X, before) and np.array_equal(given["ATOMS"].positions, atoms)
