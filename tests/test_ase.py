"""The ASE constraint object: dynamics, degrees of freedom, copies and files, bad company, bad input."""

from __future__ import annotations

import copy
import pickle
import re
import runpy
from pathlib import Path

import ase.constraints
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule, sort
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.emt import EMT
from ase.calculators.tip3p import TIP3P
from ase.constraints import (
    FixAtoms,
    FixBondLengths,
    FixCartesian,
    FixCom,
    FixedPlane,
    Hookean,
    dict2constraint,
)
from ase.db import connect
from ase.io import read, write
from ase.io.trajectory import Trajectory
from ase.md.langevin import Langevin
from ase.md.verlet import VelocityVerlet
from ase.optimize import BFGS

from kcons.ase import Constraints, constrain, rigid_water
from kcons.constraints import (
    Angle,
    Dihedral,
    Distance,
    FixedAtoms,
    ImplicitSurface,
    LinearCombination,
    LinearVelocity,
    Sphere,
)
from kcons.errors import (
    ContradictionError,
    ConvergenceError,
    InfeasibleError,
    InputError,
    KconsError,
    SingularGeometryError,
    UnsupportedError,
)

ROOT = Path(__file__).parents[1]


class Free(Calculator):
    """No forces."""

    implemented_properties = ("energy", "forces")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results = {"energy": 0.0, "forces": np.zeros((len(atoms), 3))}


def waters(n=2, seed=0, spacing=3.1) -> Atoms:
    """n TIP3P waters in random orientations on a line of a grid, not periodic."""
    rng = np.random.default_rng(seed)
    atoms = Atoms()
    for k in range(n):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        one.translate(spacing * np.array(np.unravel_index(k, (2, 2, -(-n // 4)))))
        atoms += one
    return atoms


def rigid(n=2, seed=0, temperature=300.0) -> tuple[Atoms, Constraints]:
    atoms = waters(n, seed)
    held = constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    if temperature:
        thermalize(atoms, temperature, seed)
    atoms.calc = TIP3P(rc=6.0)
    return atoms, held


def thermalize(atoms, temperature, seed=0) -> None:
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(units.kB * temperature * atoms.get_masses())[:, None]
    atoms.set_momenta(sigma * rng.normal(size=(len(atoms), 3)))


def off(atoms, held) -> float:
    return float(np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max())


def slip(atoms, held) -> float:
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    return float(np.abs(rows @ atoms.get_velocities().ravel()).max())


def dumbbells(n, seed=0) -> Atoms:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3))
    axis *= 1.1 / np.linalg.norm(axis, axis=1)[:, None]
    positions = np.empty((2 * n, 3))
    positions[0::2] = 5.0 * np.arange(n)[:, None] * [1, 0, 0]
    positions[1::2] = positions[0::2] + axis
    return Atoms("CO" * n, positions=positions, calculator=Free())


# -- dynamics and optimisation ----------------------------------------------------------------------


def test_velocity_verlet_on_rigid_water():
    atoms, held = rigid(8)
    energies = []
    dyn = VelocityVerlet(atoms, 1 * units.fs)
    dyn.attach(lambda: energies.append(atoms.get_total_energy()))
    dyn.run(150)
    assert off(atoms, held) <= 1e-13
    assert slip(atoms, held) <= 1e-13
    slope = np.polyfit(np.arange(len(energies)), energies, 1)[0]  # eV a step
    assert abs(slope) * 150 <= 2e-4 * atoms.get_kinetic_energy()
    assert np.ptp(energies) <= 5e-3 * atoms.get_kinetic_energy()


def test_agrees_with_fix_bond_lengths():
    atoms, _ = rigid(2)
    peer = atoms.copy()
    peer.set_constraint(FixBondLengths(rigid_water(peer).atoms))
    peer.calc = TIP3P(rc=6.0)
    for a in (atoms, peer):
        VelocityVerlet(a, 1 * units.fs).run(50)
    assert np.abs(atoms.positions - peer.positions).max() <= 1e-9
    assert np.abs(atoms.get_velocities() - peer.get_velocities()).max() <= 1e-9


def test_free_dumbbells_keep_energy_momentum_and_angular_momentum():
    atoms = dumbbells(3)
    held = constrain(atoms, Distance([[0, 1], [2, 3], [4, 5]]))
    thermalize(atoms, 300)
    before = (atoms.get_kinetic_energy(), atoms.get_momenta().sum(axis=0), atoms.get_angular_momentum())
    VelocityVerlet(atoms, 2 * units.fs).run(100)
    after = (atoms.get_kinetic_energy(), atoms.get_momenta().sum(axis=0), atoms.get_angular_momentum())
    for a, b in zip(before, after, strict=True):
        assert a == pytest.approx(b, rel=1e-10, abs=1e-10)
    assert off(atoms, held) <= 1e-14


def test_langevin_reaches_the_right_temperature():
    atoms = dumbbells(60)
    pairs = np.arange(120).reshape(-1, 2)
    # Every row twice: counting rows instead of the rank would show 5/4 of the temperature.
    held = constrain(atoms, [Distance(pairs), Distance(pairs)])
    thermalize(atoms, 300, seed=4)
    rng = np.random.default_rng(7)
    dyn = Langevin(atoms, 2 * units.fs, temperature_K=300, friction=0.05 / units.fs, fixcm=False, rng=rng)
    seen = []
    dyn.attach(lambda: seen.append(atoms.get_temperature()))
    dyn.run(1200)
    blocks = np.array(seen[1:]).reshape(12, -1).mean(axis=1)
    assert abs(blocks.mean() - 300) <= 4 * blocks.std(ddof=1) / np.sqrt(len(blocks))
    assert blocks.std(ddof=1) / np.sqrt(len(blocks)) < 5
    assert off(atoms, held) <= 1e-13


def test_optimiser_keeps_bonds_and_angles():
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    rows = [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2], [1, 0, 3]])]
    held = constrain(atoms, rows)
    start = held.engine(atoms).constraint_set.measure(atoms.positions)
    energy = atoms.get_potential_energy()
    BFGS(atoms, logfile=None).run(fmax=0.02, steps=200)
    assert np.abs(atoms.get_forces()).max() <= 0.02
    assert atoms.get_potential_energy() < energy - 0.1
    assert np.abs(held.engine(atoms).constraint_set.measure(atoms.positions) - start).max() <= 1e-13


def test_periodic_wrap_changes_nothing():
    cell = np.array([[7.0, 0, 0], [2.0, 6.5, 0], [-1.0, 1.5, 6.0]])
    whole = molecule("H2O")
    whole.set_cell(cell)
    whole.pbc = True
    whole.positions += cell.sum(axis=0) - whole.positions[0]  # the oxygen sits on the corner
    whole.calc = Free()
    thermalize(whole, 800, seed=3)
    wrapped = whole.copy()
    wrapped.calc = Free()
    for a in (whole, wrapped):
        constrain(a, rigid_water(a))
    dyn = VelocityVerlet(wrapped, 2 * units.fs)
    dyn.attach(wrapped.wrap)
    dyn.run(300)
    VelocityVerlet(whole, 2 * units.fs).run(300)
    cells = (wrapped.positions - whole.positions) @ np.linalg.inv(cell)
    assert np.abs(cells - np.round(cells)).max() <= 1e-11
    assert np.ptp(np.round(cells), axis=0).max() > 0  # the molecule was really cut


def test_pendulum_of_fixed_atom_and_bond():
    atoms = Atoms("CO", positions=[[0, 0, 0], [1.1, 0, 0]], calculator=Free())
    held = constrain(atoms, [Distance([0, 1]), FixedAtoms([0])])
    atoms.set_momenta([[3.0, 0, 0], [1.0, 2.0, 0]])
    VelocityVerlet(atoms, 1 * units.fs).run(100)
    assert np.array_equal(atoms.positions[0], [0, 0, 0])
    assert np.array_equal(atoms.get_momenta()[0], [0, 0, 0])
    assert off(atoms, held) <= 1e-14
    assert atoms.get_kinetic_energy() == pytest.approx(0.5 * 2.0**2 / atoms.get_masses()[1], rel=1e-10)


def test_float32_forces():
    class Single(EMT):
        def get_forces(self, atoms=None):
            return super().get_forces(atoms).astype(np.float32)

    atoms = molecule("CH3CH2OH")
    atoms.calc = Single()
    held = constrain(atoms, Distance([[0, 1], [1, 2]]))
    forces = atoms.get_forces()
    exact = held.engine(atoms).project_forces(atoms.positions, atoms.get_forces(apply_constraint=False))
    assert forces.dtype == np.float32
    assert np.abs(forces - exact).max() <= 1e-5
    VelocityVerlet(atoms, 1 * units.fs).run(20)
    assert off(atoms, held) <= 1e-13


def test_arrays_that_are_not_contiguous():
    atoms, held = rigid(2)
    new = atoms.positions + 0.01
    new[0] += 0.05
    plain = new.copy()
    held.adjust_positions(atoms, plain)
    transposed = np.asfortranarray(new)
    held.adjust_positions(atoms, transposed)
    assert np.array_equal(plain, transposed)
    whole = np.array([[3, 0, 0]] * 6)
    held.adjust_momenta(atoms, np.asfortranarray(whole.astype(float)))


# -- degrees of freedom, momenta --------------------------------------------------------------------


def test_dof_counts_the_rank():
    atoms = waters(2)
    rows = rigid_water(atoms)
    atoms.set_constraint(Constraints([rows, rows, Distance([0, 1])]))
    assert atoms.get_number_of_degrees_of_freedom() == 12
    atoms.set_constraint(Constraints([rows]))
    assert atoms.get_number_of_degrees_of_freedom() == 12


def test_temperature_uses_the_rank():
    atoms, _ = rigid(2)
    assert atoms.get_temperature() == pytest.approx(2 * atoms.get_kinetic_energy() / (12 * units.kB))


def test_momenta_are_projected_once():
    atoms, held = rigid(2, temperature=None)
    rng = np.random.default_rng(2)
    raw = rng.normal(size=(6, 3))
    masses = atoms.get_masses()[:, None]
    kinetic = 0.5 * (raw**2 / masses).sum()
    atoms.set_momenta(raw)
    assert slip(atoms, held) <= 1e-14
    assert atoms.get_kinetic_energy() < kinetic
    assert atoms.get_momenta().sum(axis=0) == pytest.approx(raw.sum(axis=0), abs=1e-13)
    once = atoms.get_momenta()
    atoms.set_momenta(once)
    assert np.abs(atoms.get_momenta() - once).max() <= 1e-14


def test_constrain_projects_momenta_that_are_there():
    atoms = molecule("H2O")
    atoms.set_momenta(np.random.default_rng(0).normal(size=(3, 3)))
    assert slip(atoms, constrain(atoms, rigid_water(atoms))) <= 1e-14


def test_no_hook_that_would_act_twice():
    # Its presence would make ASE apply adjust_forces to the forces of dynamics.
    assert not hasattr(Constraints, "adjust_potential_energy")


def test_forces_off_the_surface_use_the_rows_there():
    atoms, held = rigid(1, temperature=None)
    atoms.positions[1] += [0.05, 0.02, 0.0]
    forces = np.random.default_rng(1).normal(size=(3, 3))
    held.adjust_forces(atoms, forces)
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ (forces / atoms.get_masses()[:, None]).ravel()).max() <= 1e-14


# -- targets ----------------------------------------------------------------------------------------


def test_targets_are_taken_at_first_use_and_kept():
    atoms = molecule("H2O")
    atoms.set_constraint(Constraints(Distance([0, 1])))
    length = atoms.get_distance(0, 1)
    atoms.set_positions(atoms.positions + np.random.default_rng(0).normal(scale=0.05, size=(3, 3)))
    assert atoms.get_distance(0, 1) == pytest.approx(length, abs=1e-15)


def test_explicit_target_off_is_refused_with_its_size():
    atoms = molecule("H2O")
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.031.*project=True"):
        constrain(atoms, Distance([0, 1], 1.0))
    assert atoms.constraints == []
    atoms.set_constraint(Constraints(Distance([0, 1], 1.0)))
    before = atoms.positions.copy()
    with pytest.raises(InputError, match="restore"):
        atoms.set_positions(before + 0.01)
    assert np.array_equal(atoms.positions, before)


def test_project_moves_to_the_nearest_point():
    atoms = molecule("H2O")
    centre = atoms.get_center_of_mass()
    held = constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    assert off(atoms, held) <= 1e-15
    assert atoms.get_center_of_mass() == pytest.approx(centre, abs=1e-14)
    assert atoms.get_distance(0, 1) == pytest.approx(0.9572, abs=1e-14)
    assert atoms.get_angle(1, 0, 2) == pytest.approx(104.52, abs=1e-11)


def test_restore_after_an_edit():
    atoms, held = rigid(2)
    atoms.rattle(0.1, rng=np.random.default_rng(0))
    atoms.positions += np.random.default_rng(0).normal(scale=0.1, size=(6, 3))
    assert off(atoms, held) > 1e-2
    held.restore(atoms)
    assert off(atoms, held) <= 1e-14
    assert slip(atoms, held) <= 1e-14


def test_impossible_restore_changes_nothing():
    atoms = Atoms("H3", positions=[[0, 0, 0], [1, 0, 0], [0.4, 0.9, 0]])
    before = atoms.positions.copy()
    with pytest.raises((InfeasibleError, ContradictionError)):
        constrain(atoms, Distance([[0, 1], [1, 2], [0, 2]], [1.0, 1.0, 3.0]), project=True)
    assert np.array_equal(atoms.positions, before)
    assert atoms.constraints == []


# -- changes of the atoms ---------------------------------------------------------------------------


def test_new_masses_are_noticed():
    atoms, held = rigid(1, temperature=None)
    raw = np.random.default_rng(2).normal(size=(3, 3))
    atoms.set_masses([16.0, 2.0, 1.0])
    atoms.set_momenta(raw)
    assert slip(atoms, held) <= 1e-14
    atoms.set_masses([16.0, 1.0, 7.0])  # ASE writes into the same array
    atoms.set_momenta(raw)
    assert slip(atoms, held) <= 1e-14
    atoms.numbers[1] = 8
    assert np.array_equal(held.engine(atoms).masses, atoms.get_masses())


def test_masses_of_other_atoms_do_not_rebuild_the_engine():
    atoms = waters(2)
    held = constrain(atoms, Distance([0, 1]))
    engine = held.engine(atoms)
    masses = atoms.get_masses()
    atoms.set_masses(masses)
    engine = held.engine(atoms)
    masses[5] = 3.0
    atoms.set_masses(masses)
    assert held.engine(atoms) is engine
    masses[0] = 3.0
    atoms.set_masses(masses)
    assert held.engine(atoms) is not engine


def test_new_cell_is_noticed_and_targets_stay():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    lengths = held.engine(atoms).constraint_set.target()
    atoms.set_cell([5, 5, 5])
    atoms.positions[1] += [5, 0, 0]
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(2.5)
    assert np.array_equal(held.engine(atoms).constraint_set.target(), lengths)
    assert off(atoms, held) <= 1e-14
    atoms.pbc = False
    assert off(atoms, held) > 1


def test_a_new_cell_does_not_rebuild_the_engine():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    engine = held.engine(atoms)
    peer = atoms.copy()
    atoms.set_cell([6.1, 6, 5.9], scale_atoms=True)
    assert held.engine(atoms) is engine
    # A copy with another cell gets the engine with its own.
    assert peer.constraints[0].engine(peer).constraint_set.half_width == pytest.approx(3)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(2.95)


def test_a_cell_too_small_is_refused_before_it_is_set():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    x = atoms.get_positions()
    with pytest.raises(InputError, match=r"Distance.*half the box"):
        atoms.set_cell([6, 3, 6], scale_atoms=True)
    assert atoms.cell.lengths().tolist() == [6, 6, 6]
    assert np.array_equal(atoms.positions, x)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(3)


def test_appended_atoms_are_free():
    atoms, held = rigid(1)
    atoms.extend(Atoms("Ar", positions=[[5, 5, 5]]))
    atoms.calc = Free()
    VelocityVerlet(atoms, 1 * units.fs).run(5)
    assert atoms.get_number_of_degrees_of_freedom() == 12 - 3
    assert off(atoms, held) <= 1e-14


def test_same_object_on_several_images():
    atoms, held = rigid(1)
    other = Atoms(atoms.symbols, positions=atoms.positions, constraint=held)
    new = other.positions + np.random.default_rng(0).normal(scale=0.02, size=(3, 3))
    other.set_positions(new)
    atoms.set_positions(new)
    assert np.array_equal(other.positions, atoms.positions)


# -- copies, slices, files --------------------------------------------------------------------------


def targets(atoms) -> np.ndarray:
    (held,) = atoms.constraints
    assert isinstance(held, Constraints)
    return held.engine(atoms).constraint_set.target()


def sample() -> Atoms:
    """Several families with targets that are not those of the present positions to the last bit."""
    atoms = molecule("CH3CH2OH")
    rows = [
        Distance([[0, 1], [1, 2]], [1.5, 1.4]),
        Angle([0, 1, 2], 1.9),
        Dihedral([3, 0, 1, 2], 1.1),
        LinearCombination([4, 5], [[0, 0, 1], [0, 0, -1]]),
        FixedAtoms([8]),
    ]
    constrain(atoms, rows, project=True)
    atoms.positions[0] += 1e-9
    return atoms


COPIES = {
    "copy": lambda atoms, folder: atoms.copy(),
    "constructor": lambda atoms, folder: Atoms(atoms),
    "deepcopy": lambda atoms, folder: copy.deepcopy(atoms),
    "pickle": lambda atoms, folder: pickle.loads(pickle.dumps(atoms)),
    "todict": lambda atoms, folder: Atoms.fromdict(
        {**atoms.todict(), "constraints": [c.todict() for c in atoms.constraints]}
    ),
    "traj": lambda atoms, folder: _through(atoms, folder / "a.traj"),
    "json": lambda atoms, folder: _through(atoms, folder / "a.json"),
    "db": lambda atoms, folder: _through_db(atoms, folder / "a.db"),
    "whole slice": lambda atoms, folder: atoms[:],
}


def _through(atoms, path) -> Atoms:
    write(path, atoms)
    return read(path)


def _through_db(atoms, path) -> Atoms:
    with connect(path) as db:
        db.write(atoms)
    return connect(path).get_atoms(1)


@pytest.mark.parametrize("way", COPIES)
def test_round_trip_keeps_rows_and_targets(way, tmp_path):
    atoms = sample()
    again = COPIES[way](atoms, tmp_path)
    assert again.constraints[0] is not atoms.constraints[0]
    assert np.array_equal(targets(again), targets(atoms))
    assert [c.family for c in again.constraints[0].constraints] == [c.family for c in atoms.constraints[0].constraints]
    assert again.get_number_of_degrees_of_freedom() == atoms.get_number_of_degrees_of_freedom()
    momenta = np.random.default_rng(0).normal(size=(9, 3))
    for a in (atoms, again):
        a.set_momenta(momenta)
    assert np.array_equal(atoms.get_momenta(), again.get_momenta())


def test_extxyz_drops_the_constraints(tmp_path):
    atoms = sample()
    again = _through(atoms, tmp_path / "a.extxyz")
    assert [type(c).__name__ for c in again.constraints] in ([], ["FixAtoms"])
    # Targets that were explicit can be given again; positions have 8 digits there.
    constrain(again, Distance([[0, 1], [1, 2]], [1.5, 1.4]), project=True)
    assert again.get_distance(0, 1) == pytest.approx(1.5, abs=1e-14)


def test_constraint_object_round_trip():
    held = sample().constraints[0]
    data = held.todict()
    assert data["name"] in ase.constraints.__all__
    again = dict2constraint(data)
    assert isinstance(again, Constraints)
    assert again.todict() == data
    assert held.copy().todict() == data


def test_copies_are_independent():
    atoms, _ = rigid(2)
    part = atoms.copy()
    part.constraints[0].index_shuffle(part, [0, 1, 2])
    assert len(atoms.constraints[0].constraints[0].atoms) == 6


def test_trajectory_written_during_dynamics(tmp_path):
    atoms, _ = rigid(2)
    with Trajectory(tmp_path / "md.traj", "w", atoms) as file:
        dyn = VelocityVerlet(atoms, 1 * units.fs)
        dyn.attach(file.write, interval=5)
        dyn.run(10)
    frames = read(tmp_path / "md.traj", index=":")
    assert len(frames) == 3
    assert np.array_equal(targets(frames[-1]), targets(atoms))


def test_function_rows_are_left_out_of_files_with_a_warning(tmp_path):
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    surface = ImplicitSurface([0], lambda r: (r**2).sum(axis=1) - 1, lambda r: 2 * r)
    constrain(atoms, [surface, Distance([0, 1])])
    with pytest.warns(UserWarning, match="left out of the file: ImplicitSurface"):
        write(tmp_path / "a.traj", atoms)
    assert np.array_equal(read(tmp_path / "a.traj").positions, atoms.positions)
    with pytest.warns(UserWarning, match="left out"):
        assert not hasattr(atoms.constraints[0], "todict")
    assert len(atoms.copy().constraints[0].constraints) == 2


def test_slicing_keeps_whole_rows_only():
    atoms, _ = rigid(3)
    part = atoms[3:8]
    assert targets(part).shape == (4,)  # one whole water, and one O-H bond of the next
    assert np.array_equal(part.constraints[0].constraints[0].atoms, [[0, 1], [0, 2], [1, 2], [3, 4]])
    assert atoms[[0, 3, 6]].constraints == []
    assert np.array_equal(targets(atoms[np.arange(9) < 3]), targets(atoms)[:3])
    assert np.array_equal(targets(atoms[[2, 1, 0]]), targets(atoms)[:3])


def test_sort_renumbers():
    atoms, held = rigid(2)
    ordered = sort(atoms)
    assert off(ordered, ordered.constraints[0]) <= 1e-14
    assert np.array_equal(np.sort(targets(ordered)), np.sort(held.engine(atoms).constraint_set.target()))


def test_slice_of_an_unused_object_is_taken_along():
    atoms = waters(2)
    atoms.set_constraint(Constraints(rigid_water(atoms)))
    assert atoms[3:].get_number_of_degrees_of_freedom() == 6


@pytest.mark.parametrize("used", [True, False])
def test_repeat(used):
    atoms = waters(1)
    atoms.set_cell([4.0, 5.0, 6.0])
    atoms.pbc = True
    atoms.set_constraint(Constraints([rigid_water(atoms), FixedAtoms([0])]))
    if used:
        atoms.get_number_of_degrees_of_freedom()
    large = atoms.repeat((2, 1, 3))
    assert large.get_number_of_degrees_of_freedom() == 6 * (9 - 6)
    assert off(large, large.constraints[0]) <= 1e-14
    assert len(large.constraints[0].get_indices()) == 18


@pytest.mark.parametrize("used", [True, False])
@pytest.mark.parametrize("through_file", [False, True])
def test_repeat_across_the_boundary(used, through_file, tmp_path):
    cell = np.array([[5.0, 0, 0], [1.0, 5.5, 0], [-0.5, 0.7, 6.0]])
    atoms = molecule("H2O")
    atoms.set_cell(cell)
    atoms.pbc = True
    atoms.positions -= atoms.positions[0] + [0.1, 0.1, 0.1]
    atoms.wrap()
    lengths = atoms.get_all_distances(mic=True)[[0, 0, 1], [1, 2, 2]]
    assert np.abs(np.diff(atoms.get_scaled_positions(), axis=0)).max() > 0.5
    atoms.set_constraint(Constraints(rigid_water(atoms)))
    if used:
        atoms.get_number_of_degrees_of_freedom()
    large = atoms.repeat((2, 3, 2))
    if through_file:
        large = _through(large, tmp_path / "large.json")
    assert targets(large) == pytest.approx(np.tile(lengths, 12), abs=1e-12)
    assert off(large, large.constraints[0]) <= 1e-13
    assert large.get_number_of_degrees_of_freedom() == 12 * 6
    rows = large.constraints[0].constraints[0].atoms
    assert len(np.unique(np.sort(rows, axis=1), axis=0)) == 36


def test_repeat_of_a_surface_is_refused():
    atoms = Atoms("H", positions=[[1, 0, 0]], cell=[4, 4, 4], pbc=True)
    constrain(atoms, Sphere([0], [0, 0, 0]))
    with pytest.raises(UnsupportedError, match="place in space"):
        atoms.repeat(2)


def test_repr():
    atoms, held = rigid(2)
    assert repr(held) == "Constraints(6 rows on 6 atoms)"
    assert "Constraints(" in repr(atoms)


# -- company ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("other", "hint"),
    [
        (FixAtoms([0]), "FixedAtoms"),
        (FixBondLengths([[0, 4]]), "Distance"),
        (FixedPlane([1], (0, 0, 1)), "Plane"),
        (FixCartesian([2]), "LinearCombination"),
        (Constraints(Distance([2, 4])), ""),
    ],
    ids=lambda v: type(v).__name__,
)
@pytest.mark.parametrize("first", [True, False])
def test_company_on_the_same_atoms_is_refused(other, hint, first):
    atoms, held = rigid(2)
    held.restore(atoms)
    atoms.set_constraint([held, other] if first else [other, held])
    before = atoms.positions.copy()
    with pytest.raises(UnsupportedError, match=f"{type(other).__name__} acts on atom.*one Constraints object.*{hint}"):
        atoms.set_positions(before + np.random.default_rng(0).normal(scale=0.01, size=(6, 3)))
    assert np.array_equal(atoms.positions, before)
    with pytest.raises(UnsupportedError):
        atoms.get_forces()


def test_constrain_beside_something_else():
    atoms = waters(2)
    atoms.set_constraint(FixAtoms([4]))
    held = constrain(atoms, Distance([0, 1]))
    assert [type(c).__name__ for c in atoms.constraints] == ["FixAtoms", "Constraints"]
    assert atoms.get_number_of_degrees_of_freedom() == 18 - 3 - 1
    new = atoms.positions + np.random.default_rng(0).normal(scale=0.01, size=(6, 3))
    fixed = atoms.positions[4].copy()
    atoms.set_positions(new)
    assert np.array_equal(atoms.positions[4], fixed) and off(atoms, held) <= 1e-14
    with pytest.raises(UnsupportedError, match="FixAtoms acts on atom 4"):
        constrain(atoms, Distance([4, 5]))
    assert len(atoms.constraints) == 2


def test_forces_only_company_is_welcome():
    atoms, held = rigid(2)
    atoms.set_constraint([held, Hookean(a1=0, a2=3, rt=2.5, k=1.0), FixCom()])
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, 1 * units.fs).run(10)
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 12 - 3


def test_fix_com_beside_a_surface_is_refused():
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    held = constrain(atoms, Sphere([0], [0, 0, 0]))
    atoms.set_constraint([FixCom(), held])
    with pytest.raises(UnsupportedError, match=r"FixCom acts on atom 0.*CenterOfMass"):
        atoms.set_momenta(np.ones((2, 3)))


@pytest.mark.parametrize(
    ("row", "what"),
    [
        (Distance([0, 1], lambda t: 1.0 + t), "moves with time"),
        (LinearVelocity(0, [[1, 0, 0]]), "constrains velocities"),
    ],
)
def test_rows_that_need_the_time_are_refused(row, what):
    with pytest.raises(UnsupportedError, match=what):
        constrain(molecule("H2O"), row)


# -- bad input --------------------------------------------------------------------------------------


def nan_at(atom):
    atoms = molecule("H2O")
    atoms.positions[atom, 1] = np.nan
    return atoms


def with_masses(masses):
    atoms = molecule("H2O")
    atoms.set_masses(masses)
    return atoms


def boxed(length):
    atoms = molecule("H2O")
    atoms.set_cell([length] * 3)
    atoms.pbc = True
    return atoms


def coincident():
    atoms = molecule("H2O")
    atoms.positions[1] = atoms.positions[0]
    return atoms


BAD = {
    "nan position": (nan_at(1), Distance([0, 1]), InputError, "position of atom 1 is not finite"),
    "unknown atom": (molecule("H2O"), Distance([0, 7]), InputError, "no atom 7"),
    "zero mass": (with_masses([16, 0, 1]), Distance([0, 1]), InputError, "atom 1 has mass 0"),
    "negative mass": (with_masses([-16, 1, 1]), Distance([0, 1]), InputError, "atom 0 has mass -16"),
    "nan mass": (with_masses([16, np.nan, 1]), Distance([0, 1]), InputError, "atom 1 has mass nan"),
    "coincident": (coincident(), Distance([0, 1]), SingularGeometryError, "atoms 0 and 1 coincide"),
    "two lengths": (
        molecule("H2O"),
        [Distance([0, 1], 0.9), Distance([1, 0], 1.0)],
        ContradictionError,
        "different targets",
    ),
    "half the box": (boxed(2.5), Distance([1, 2], 1.5264), InputError, "half the box"),
    "zero cell": (boxed(0.0), Distance([0, 1]), InputError, "cell"),
    "not ours": (molecule("H2O"), [FixAtoms([0])], InputError, "from_ase_constraints"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    atoms, rows, error, message = BAD[case]
    with pytest.raises(error, match=message):
        constrain(atoms, rows)
    assert atoms.constraints == []


@pytest.mark.parametrize("rows", [[[0, 0]], [[-1, 0]], [[0.5, 1.5]], [[0, 1, 2]]])
def test_bad_rows_are_refused_at_once(rows):
    with pytest.raises(InputError):
        Distance(rows)


def test_bad_degenerate_option():
    with pytest.raises(InputError, match="'convert' or 'raise'"):
        Constraints(Distance([0, 1]), degenerate="ignore")


def failing_positions():
    turned = molecule("H2O")
    turned.rotate(90, "x")
    turned.rotate(90, "y")
    nan = molecule("H2O").positions
    nan[2, 0] = np.nan
    inf = molecule("H2O").positions
    inf[0, 0] = np.inf
    apart = turned.positions + np.array([[0, 0, 3], [0, 0, -3], [0, 0, 0]])
    return {"a step too large": apart, "nan": nan, "inf": inf}


@pytest.mark.parametrize("case", failing_positions())
def test_failing_position_hook_changes_nothing(case):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    new = failing_positions()[case]
    asked, before = new.copy(), atoms.positions.copy()
    with pytest.raises(KconsError) as caught:
        held.adjust_positions(atoms, new)
    assert np.array_equal(new, asked, equal_nan=True)
    with pytest.raises(KconsError):
        atoms.set_positions(new)
    assert np.array_equal(atoms.positions, before)
    if case == "a step too large":
        assert isinstance(caught.value, ConvergenceError)
        assert any("smaller timestep" in note for note in caught.value.__notes__)
    # and the object still works
    atoms.set_positions(before + 0.01)


@pytest.mark.parametrize("hook", ["adjust_momenta", "adjust_forces"])
def test_failing_covector_hooks_change_nothing(hook):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    values = np.ones((3, 3))
    values[1, 1] = np.nan
    asked = values.copy()
    with pytest.raises(KconsError):
        getattr(held, hook)(atoms, values)
    assert np.array_equal(values, asked, equal_nan=True)


@pytest.mark.parametrize("hook", ["adjust_positions", "adjust_momenta", "adjust_forces"])
def test_wrong_shapes(hook):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    with pytest.raises(InputError, match=r"shape \(3, 3\)"):
        getattr(held, hook)(atoms, np.zeros((4, 3)))


def test_time_step_too_large_in_dynamics():
    atoms, held = rigid(2, temperature=3000)
    atoms.calc = Free()
    with pytest.raises(ConvergenceError, match="smaller"):
        VelocityVerlet(atoms, 60 * units.fs).run(50)
    assert off(atoms, held) <= 1e-13
    assert np.isfinite(atoms.get_momenta()).all()


def test_nan_force_in_dynamics_is_an_error():
    class Bad(Free):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"][0, 0] = np.nan

    atoms, _ = rigid(1)
    atoms.calc = Bad()
    before = atoms.positions.copy()
    with pytest.raises(KconsError, match="not finite"):
        VelocityVerlet(atoms, 1 * units.fs).run(1)
    assert np.array_equal(atoms.positions, before)


# -- documents --------------------------------------------------------------------------------------


def test_documentation_runs(capsys):
    text = (ROOT / "docs" / "ase.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 7
    exec(compile("\n".join(blocks), "docs/ase.md", "exec"), {})
    assert "degrees of freedom" in capsys.readouterr().out


def test_example_runs(capsys):
    example = runpy.run_path(str(ROOT / "examples" / "01_rigid_water_ase.py"))
    example["main"](steps=10)
    assert "temperature/K" in capsys.readouterr().out
