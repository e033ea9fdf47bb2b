"""Test systems start on their constraints, know their solution, and offer every MD engine the same forces."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from ase import units
from scipy.integrate import solve_ivp

from kcons import projection
from kcons.comparison import test_systems
from kcons.comparison.test_systems import chain, dumbbells, molecule, water
from kcons.comparison.test_systems.minimal import COARSER, FINEST
from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.sphere import swing
from kcons.comparison.test_systems.system import converged, thermal_velocities
from kcons.errors import InputError
from kcons.motion import Motion
from kcons.steppers import State, System, run
from tests.contracts.test_reference_orders import EPS, sensitivities
from tests.reference import cases

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

SMALL = {"water": 8, "chain": 5, "chain-straight": 5, "chain-175": 5, "chain-free": 5, "sphere": 2, "ethanol": 1}
SMALL.update({"sphere-pendulum": 2, "sphere-pendulum-top": 2, "fekete": 12})
SMALL.update(dict.fromkeys(STORED, 1), dumbbells=2, slab=1)
if find_spec("openmm") is not None:
    SMALL["alanine"] = 1
#: Molecules with forces of OpenMM, see test_structure.
MOLECULES = {"alanine", "dhfr", "dhfr-water", "villin"}


def small(name, **options):
    if name in ("water", "ethanol"):
        # Forces that come with ASE: these tests do not need the extras.
        options = {"forces": {"water": "ase", "ethanol": "emt"}[name], **options}
    return test_systems.build(name, SMALL[name], **options)


def end(scene, dt):
    system = System(scene.motion, scene.potential.forces)
    return run(system, State(scene.positions, scene.velocities), dt, round(scene.horizon / dt))


def test_every_scene_is_covered_here():
    assert set(SMALL) | MOLECULES == set(test_systems.SYSTEMS)


@pytest.mark.parametrize("name", SMALL)
def test_start_is_on_the_constraints(name):
    scene = small(name)
    sigma, tangency = scene.residuals(scene.positions, scene.velocities)
    assert np.all(
        np.abs(scene.constraint_set.value(scene.positions)) <= scene.constraint_set.tolerance(scene.positions)
    )
    assert sigma < 1e-13
    assert tangency < 1e-14


@pytest.mark.parametrize("name", SMALL)
def test_forces_are_the_gradient_of_the_energy(name):
    scene = small(name)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(scene.positions.shape)
    energy = [scene.potential.energy(scene.positions + h * direction) for h in (-1e-4, 1e-4)]
    slope = (energy[1] - energy[0]) / 2e-4
    work = -np.sum(scene.potential.forces(scene.positions) * direction)
    assert slope == pytest.approx(work, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("name", SMALL)
def test_time_steps_divide_the_horizon(name):
    scene = small(name)
    for dt in (*scene.time_steps, *scene.shortened(2).time_steps):
        assert scene.horizon / dt == pytest.approx(round(scene.horizon / dt), abs=1e-9)


@pytest.mark.parametrize("name", [n for n in SMALL if n not in ("water", "fekete")])
def test_rattle_reaches_the_reference_with_order_two(name):
    scene = small(name)
    reference = scene.reference()
    errors = [scene.deviation(end(scene, dt).positions, reference.positions) for dt in scene.time_steps[1:]]
    slope = np.polyfit(np.log(scene.time_steps[1:]), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)
    assert reference.error < 0.01 * errors[-1]


@pytest.mark.parametrize(
    ("name", "size"), [("chain", 5), ("chain-free", 5), ("ethanol", 1), ("dumbbells", 8), ("slab", 1)]
)
def test_converged_reference_against_an_independent_integrator(name, size):
    # Eq. (105) with the dense oracle in DOP853: other equations, other code, other integrator.
    scene = test_systems.build(name, size, **({"forces": "emt"} if name == "ethanol" else {}))
    if name == "dumbbells":
        scene = scene.shortened(4)
    held, masses, shape = scene.constraint_set, scene.masses, scene.positions.shape

    def rate(_, y):
        x, v = y.reshape(2, *shape)
        f = scene.potential.forces(x)
        a = projection.acceleration(held.jacobian(x).toarray(), masses, f.ravel(), held.acceleration_target(x, v))
        return np.concatenate([v.ravel(), a])

    start = np.concatenate([scene.positions.ravel(), scene.velocities.ravel()])
    y = solve_ivp(rate, (0, scene.horizon), start, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    reference = scene.reference()
    assert scene.deviation(y.reshape(2, *shape)[0], reference.positions) < 1e-7


@pytest.mark.parametrize("name", STORED)
def test_scene_is_the_stored_case(name):
    scene, case = small(name), cases.load(STORED[name])
    x, v = case.initial.positions, case.initial.velocities
    np.testing.assert_allclose(scene.positions, x, rtol=0, atol=5e-16)
    np.testing.assert_allclose(scene.velocities, v, rtol=0, atol=5e-16)
    np.testing.assert_array_equal(scene.masses, case.masses)
    forces = scene.potential.forces(x)
    np.testing.assert_allclose(forces, case.force(x, v), rtol=1e-13, atol=1e-13)
    # The same accelerations: the same constraints.
    for s in case.snapshots:
        a = scene.motion.acceleration(s.positions, s.velocities, scene.potential.forces(s.positions), s.time)
        np.testing.assert_allclose(a, s.accelerations, rtol=0, atol=2e-10 * max(1.0, np.abs(s.accelerations).max()))


@pytest.mark.parametrize("name", STORED)
def test_solution_meets_the_stored_one(name):
    # What is wrong at the start, or on the way, grows as the stored case is sensitive to its start. The start is wrong
    # by rounding, and a step by its tolerance at most; those of many steps do not add up, as they have either sign.
    scene, case = small(name), cases.load(STORED[name])
    known = [(s, grown) for s, grown in zip(case.solution, sensitivities(STORED[name]), strict=True)]
    known = [(s, grown) for s, grown in known if s.time <= scene.horizon]
    assert known
    for s, grown in known:
        found = scene.solution(s.time)
        off = scene.deviation(found.positions, s.positions)
        assert off < 4 * FINEST * grown
        assert found.error < 4 * (FINEST + COARSER) * grown
        assert off < 5 * found.error + 4 * EPS * grown  # the estimate is honest


@pytest.mark.parametrize("name", STORED)
def test_solution_stays_on_the_constraints(name):
    scene = small(name)
    for time in (0.0, 0.3 * scene.horizon, scene.horizon):
        x = scene.solution(time).positions
        np.testing.assert_allclose(scene.constraint_set.value(x, time), 0.0, rtol=0, atol=2e-14)
        if time == 0.0:
            np.testing.assert_allclose(x, scene.positions, rtol=0, atol=1e-14)


def test_moving_constraint_is_followed_in_time():
    scene = small("bead-rotating")
    state = end(scene, scene.time_steps[-1])
    assert scene.residuals(state.positions, state.velocities, scene.horizon) < (1e-12, 1e-12)
    assert scene.residuals(state.positions, state.velocities)[0] > 0.1


@pytest.mark.parametrize("size", [8, 20])
def test_box_of_dumbbells(size):
    scene = test_systems.build("dumbbells", size, seed=3)
    assert scene.n_atoms == 2 * size
    assert scene.motion.rank == size
    sigma, tangency = scene.residuals(scene.positions, scene.velocities)
    assert sigma < 1e-14
    assert tangency < 1e-14
    d = scene.positions[:, None] - scene.positions
    d -= scene.cell * np.round(d / scene.cell)
    other = np.arange(2 * size)[:, None] // 2 != np.arange(2 * size) // 2
    assert np.linalg.norm(d, axis=2)[other].min() > 1.0  # no overlaps
    x, direction = scene.positions, np.random.default_rng(1).standard_normal(scene.positions.shape)
    slope = (scene.potential.energy(x + 1e-6 * direction) - scene.potential.energy(x - 1e-6 * direction)) / 2e-6
    assert slope == pytest.approx(-np.sum(scene.potential.forces(x) * direction), rel=1e-6)
    # Forces do not see where the box begins, nor by which image an atom is given.
    moved = x + scene.cell * np.array([0.3, 2.0, -1.0])
    np.testing.assert_allclose(scene.potential.forces(moved), scene.potential.forces(x), atol=1e-11)
    reference = scene.reference()
    errors = [scene.deviation(end(scene, dt).positions, reference.positions) for dt in scene.time_steps[1:]]
    np.testing.assert_allclose(np.diff(np.log2(errors)), -2.0, atol=0.1)
    assert reference.error < 1e-4 * errors[-1]


def test_forces_of_dumbbells_vanish_smoothly_at_the_cutoff():
    evaluate = dumbbells._with_cutoff(13.0, 2.5)
    for r, share in ((1.6, 1.0), (2.125, 0.5), (2.5 - 1e-3, 0.0), (2.5 + 1e-3, 0.0)):
        # Partners of both atoms out of reach; the pair meets through the boundary.
        x = np.array([[12.0, 0, 0], [12.0, 6, 0], [12.0 + r, 0, 0], [12.0 + r, 0, 6]])
        energy, forces = evaluate(x)
        assert energy == pytest.approx(share * 4 * (r**-12 - r**-6), abs=1e-13)
        if share == 1.0:
            assert forces[2, 0] == pytest.approx(24 * (2 * r**-13 - r**-7), rel=1e-13)
        elif share == 0.0:
            assert np.abs(forces).max() < 1e-9
        np.testing.assert_array_equal(forces[0], -forces[2])
        assert not forces[[1, 3]].any()


@pytest.mark.parametrize("size", [1, 3])
def test_slab_is_periodic_and_its_lower_layers_are_fixed(size):
    scene = test_systems.build("slab", size)
    symbols = np.array(scene.symbols)
    assert list(symbols[-2 * size :]) == ["C", "O"] * size
    metal = np.flatnonzero(symbols == "Cu")
    heights = scene.positions[:, 2]
    assert heights[scene.fixed].max() < np.delete(heights, scene.fixed).min()
    assert len(scene.fixed) == len(metal) // 2
    assert scene.motion.rank == size + 3 * len(scene.fixed)
    assert not scene.velocities[scene.fixed].any()
    assert scene.atoms().pbc.all()
    # Of the molecule, carbon is the closer one, above an atom of the top layer.
    for carbon, oxygen in scene.bonds:
        assert 1.5 < heights[carbon] - heights[metal].max() < 2.1
        assert heights[oxygen] > heights[carbon] + 1.0
    state = end(scene, scene.time_steps[0])
    assert np.array_equal(state.positions[scene.fixed], scene.positions[scene.fixed])


def test_error_estimate_of_the_converged_reference_is_honest():
    scene = small("chain")
    fine = converged(scene, min(scene.time_steps) / 4)
    assert fine.error < 1e-12
    for dt in (4 * max(scene.time_steps), 2 * max(scene.time_steps)):
        coarse = converged(scene, dt)
        assert 0.05 * coarse.error < scene.deviation(coarse.positions, fine.positions) < coarse.error
        assert coarse.error > 100 * fine.error


def test_error_estimate_of_the_converged_reference_sees_noisy_forces():
    scene = small("chain")
    rng = np.random.default_rng(4)

    def noisy(x):
        energy, forces = scene.potential.energy(x), scene.potential.forces(x)
        return energy, forces * (1 + 1e-6 * rng.standard_normal(forces.shape))

    right = scene.reference()
    found = replace(scene, potential=Potential(noisy, "noisy")).reference()
    off = scene.deviation(found.positions, right.positions)
    assert off > 1e3 * right.error
    assert 0.2 * off < found.error < 20 * off


def test_swing_meets_the_reference_pendulum():
    # 45-digit solution in spherical angles.
    case = json.loads((Path(__file__).parents[2] / "reference/data/A02_spherical_pendulum_generic.json").read_text())
    start = {key: np.array(case["initial"][key], dtype=float)[0] for key in ("positions", "velocities")}
    (gravity,) = (force["g"] for force in case["forces"] if force["type"] == "uniform_acceleration")
    assert gravity[:2] == [0, 0]
    (point,) = (np.array(c.get("point"), float) for c in case["constraints"] if c["type"] == "distance_to_point")
    for time, wanted in list(zip(case["times"], case["reference"]["positions"], strict=True))[1:4]:
        found = swing(start["positions"] - point, start["velocities"], -gravity[2], time)
        np.testing.assert_allclose(found + point, np.array(wanted, dtype=float)[0], atol=1e-11 * np.exp(0.3 * time))


def test_free_particles_stay_on_their_great_circles():
    scene = test_systems.build("sphere", 3, seed=5)
    center = np.array([0.0, 0.0, 0.0])
    reference = scene.reference().positions[0] - center
    normal = np.cross(scene.positions[0], scene.velocities[0])
    assert np.linalg.norm(reference) == pytest.approx(1.0, abs=1e-14)
    assert reference @ normal == pytest.approx(0.0, abs=1e-14)
    # The angle covered is speed times time.
    speed = np.linalg.norm(scene.velocities[0])
    angle = np.arccos(np.clip(reference @ scene.positions[0], -1, 1))
    assert np.cos(angle) == pytest.approx(np.cos(speed * scene.horizon), abs=1e-13)


# -- geometry ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "angle"), [("zigzag", 112.0), ("175", 175.0), ("straight", 180.0)])
def test_chain_shapes(shape, angle):
    x = chain.positions(7, shape)
    bonds = np.diff(x, axis=0)
    np.testing.assert_allclose(np.linalg.norm(bonds, axis=1), chain.BOND, rtol=1e-14)
    cosine = np.sum(bonds[1:] * bonds[:-1], axis=1) / chain.BOND**2
    np.testing.assert_allclose(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 180.0 - angle, atol=1e-5)


@pytest.mark.parametrize("size", [64, 216, 512])
def test_equilibrated_water_needs_no_relaxation(size):
    x, box, equilibrated = water._molecules(size)
    assert equilibrated
    assert x.shape == (3 * size, 3)
    assert size / box**3 * 18.0154 / 0.602214 == pytest.approx(0.98, abs=0.005)  # g/cm3
    oxygen = x[::3]
    d = oxygen[:, None] - oxygen
    d -= box * np.round(d / box)
    distance = np.linalg.norm(d, axis=2)[np.triu_indices(size, 1)]
    assert 2.3 < distance.min() < 2.7
    # First shell: four to five neighbours within 3.3 Å.
    assert 4.0 < 2 * np.sum(distance < 3.3) / size < 5.5


def test_cut_water_has_no_overlaps():
    scene = test_systems.build("water", 20, forces="ase")
    d = scene.positions[::3][:, None] - scene.positions[::3]
    d -= scene.cell * np.round(d / scene.cell)
    assert np.linalg.norm(d, axis=2)[np.triu_indices(20, 1)].min() > 2.2
    assert scene.potential.energy(scene.positions) / 20 < -0.2  # eV a molecule; ice is near -0.6


@pytest.mark.skipif(find_spec("openmm") is None, reason="openmm is an extra")
def test_openmm_forces_of_water_agree_with_ewald_in_double_precision():
    from kcons.comparison.test_systems import openmm_potential

    scene = test_systems.build("water", 27, forces="openmm")
    import openmm

    # Two molecules far apart in a large box without periodicity: Coulomb's law and Lennard-Jones by hand.
    system = openmm.System()
    force = openmm.NonbondedForce()
    for q in (0.4, -0.4):
        system.addParticle(1.0)
        force.addParticle(q, 0.3, 0.5)
    system.addForce(force)
    pair = openmm_potential.of_system(system, platform="Reference")
    r = 4.0
    x = np.array([[0.0, 0, 0], [r, 0, 0]])
    epsilon, s6 = 0.5 * units.kJ / units.mol, (3.0 / r) ** 6
    coulomb = -0.16 * units.Hartree * units.Bohr / r
    assert pair.energy(x) == pytest.approx(coulomb + 4 * epsilon * (s6**2 - s6), rel=1e-6)
    pull = coulomb / r + 4 * epsilon * (12 * s6**2 - 6 * s6) / r
    assert pair.forces(x)[1, 0] == pytest.approx(pull, rel=1e-6)
    # No constraint of OpenMM's own is left in the box.
    assert scene.potential.name.startswith("PME, OpenMM")
    assert np.abs(scene.potential.forces(scene.positions).sum(axis=0)).max() < 1e-2


def test_ethanol_topology():
    scene = small("ethanol")
    bonds = scene.angle_bonds
    assert len(bonds) == 8
    assert len(scene.angles) == 13
    symbols = np.array(scene.symbols)
    assert sorted("".join(sorted(symbols[pair])) for pair in bonds) == ["CC"] + ["CH"] * 5 + ["CO"] + ["HO"]
    assert scene.motion.rank == 19
    assert scene.motion.degrees_of_freedom == 8
    # The same set by distances alone.
    assert Motion(scene.constraint_set, scene.positions).rank == 19
    assert len(scene.bonds) == 21


@pytest.mark.skipif(find_spec("tblite") is None, reason="tblite is an extra")
def test_ethanol_prefers_xtb():
    assert "xTB" in molecule.build().potential.name


def test_thermal_velocities():
    scene = small("water")
    v = thermal_velocities(scene.motion, scene.positions, 300.0, seed=3)
    masses = scene.masses[:, None]
    assert np.abs(np.sum(masses * v, axis=0)).max() < 1e-12
    kinetic = 0.5 * np.sum(masses * v**2)
    assert kinetic == pytest.approx(0.5 * (6 * 8 - 3) * units.kB * 300.0, rel=1e-12)
    again = thermal_velocities(scene.motion, scene.positions, 300.0, seed=3)
    assert np.array_equal(v, again)
    assert not np.allclose(v, thermal_velocities(scene.motion, scene.positions, 300.0, seed=4))


# -- potentials and MD engines ---------------------------------------------------------------------------


def test_potential_counts_points_not_calls():
    scene = small("chain")
    scene.potential.forget()
    x = scene.positions
    scene.potential.forces(x)
    scene.potential.energy(x)
    scene.potential.forces(x.copy())
    assert scene.potential.evaluations == 1
    scene.potential.forces(x + 0.1)
    assert scene.potential.evaluations == 2


def test_potential_hands_out_copies():
    scene = small("chain")
    first = scene.potential.forces(scene.positions)
    first[:] = 0.0
    assert np.abs(scene.potential.forces(scene.positions)).max() > 0


@pytest.mark.parametrize("name", SMALL)
def test_atoms_carry_the_scene(name):
    scene = small(name)
    atoms = scene.atoms()
    assert not atoms.constraints
    np.testing.assert_array_equal(atoms.positions, scene.positions)
    np.testing.assert_allclose(atoms.get_velocities(), scene.velocities, rtol=1e-14, atol=1e-300)
    np.testing.assert_array_equal(atoms.get_forces(), scene.potential.forces(scene.positions))
    assert atoms.get_potential_energy() == scene.potential.energy(scene.positions)
    np.testing.assert_array_equal(atoms.get_masses(), scene.masses)


# -- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "options", "text"),
    [
        ("waters", None, {}, "there is no test system 'waters'; there are water"),
        ("water", 3, {}, "too small"),
        ("water", 8, {"forces": "x"}, "no forces 'x' for water"),
        ("chain", 0, {}, "at least one bond"),
        ("sphere", 0, {}, "at least one particle"),
        ("ethanol", 2, {}, "cannot be built at size 2"),
        ("rotor", 2, {}, "rotor is one rigid body; it cannot be built at size 2"),
        ("triple-pendulum", 0, {}, "triple-pendulum is a single system"),
        ("butane", 3, {}, "one molecule"),
        ("bead-torus", 2, {}, "one bead"),
        ("bead-ellipse", 1, {"on": "cone"}, "no curve 'cone'"),
        ("dumbbells", 3, {}, "or at least 8"),
        ("slab", 0, {}, "at least one molecule"),
        ("ethanol", 1, {"forces": "x"}, "no forces 'x' for ethanol"),
    ],
)
def test_bad_scene(name, size, options, text):
    with pytest.raises(InputError, match=text):
        test_systems.build(name, size, **options)


def test_unknown_chain_shape():
    with pytest.raises(InputError, match="no chain shape 'bent'"):
        chain.build(4, shape="bent")


@pytest.mark.parametrize(
    ("dt", "text"), [(0.0, "positive step"), (-1.0, "positive"), (1e9, "positive"), (3.0, "does not divide")]
)
def test_bad_time_step(dt, text):
    with pytest.raises(InputError, match=text):
        small("chain").with_time_steps([dt])


def test_time_steps_are_sorted_coarse_first():
    scene = small("chain").with_time_steps([2.5, 10.0, 5.0, 5.0])
    np.testing.assert_allclose(np.array(scene.time_steps) / units.fs, [10.0, 5.0, 2.5])


@pytest.mark.parametrize("name", ["sphere", "sphere-pendulum", "rotor", "bead-rotating"])
def test_shortened_scene_has_its_solution_at_its_own_horizon(name):
    scene = small(name)
    half = scene.shortened(2)
    assert half.horizon == scene.horizon / 2
    system = System(half.motion, half.potential.forces)
    end = run(system, State(half.positions, half.velocities), half.horizon / 800, 800)
    assert half.deviation(end.positions, half.reference().positions) < 1e-4
