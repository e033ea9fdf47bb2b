"""The constraint object under hooks of ASE: targets, changes of the atoms; the calculator on the constraints."""

from __future__ import annotations

import ase_systems
import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.calculators.calculator import PropertyNotImplementedError
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.md.verlet import VelocityVerlet
from ase_systems import FS, Free, copper, off, rigid, slip

from kcons.ase import ConstrainedCalculator, Constraints, constrain
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, LinearRelation
from kcons.errors import InfeasibleError, InputError

# -- dynamics and optimization ----------------------------------------------------------------------


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


@pytest.mark.parametrize("rows", [Distance([0, 1]), Distance([[0, 1], [0, 2]])])
def test_integers_are_not_cut(rows):
    """ASE hands on the array that it was given, and would keep 0.6 as 0."""
    atoms = molecule("H2O")
    held = constrain(atoms, rows)
    whole = np.array([[0, 3, 1], [0, -3, 2], [1, 1, 1]])
    with pytest.raises(InputError, match=r"momenta are integers .*give floats"):
        atoms.set_momenta(whole)
    assert "momenta" not in atoms.arrays
    with pytest.raises(InputError, match=r"forces are integers .*give floats"):
        held.adjust_forces(atoms, whole)
    with pytest.raises(InputError, match=r"positions are integers .*give floats"):
        held.adjust_positions(atoms, whole)
    atoms.set_momenta(whole.astype(float))
    assert slip(atoms, held) <= 1e-14
    atoms.set_momenta(np.zeros((3, 3), dtype=int))
    assert not atoms.get_momenta().any()


def test_forces_off_the_surface_use_the_rows_there():
    atoms, held = rigid(1, temperature=None)
    atoms.positions[1] += [0.05, 0.02, 0.0]
    forces = np.random.default_rng(1).normal(size=(3, 3))
    held.adjust_forces(atoms, forces)
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ (forces / atoms.get_masses()[:, None]).ravel()).max() <= 1e-14


@pytest.mark.parametrize("degrees", [0, 40, 77])
def test_momenta_of_which_nothing_is_left(degrees):
    """Along a bond: what the projection leaves is rounding, at which no certificate may be taken by its own size."""
    atoms = molecule("CO")
    atoms.rotate(degrees, [1, 2, 3])
    along = atoms.positions[1] - atoms.positions[0]
    constrain(atoms, Distance([0, 1]))
    atoms.set_momenta([along, -along])
    assert np.abs(atoms.get_momenta()).max() <= 1e-15


# -- targets ----------------------------------------------------------------------------------------


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


# -- changes of the atoms ---------------------------------------------------------------------------


def test_what_is_known_of_one_image_says_nothing_of_another():
    """The second is off the length that the first gave: dynamics would move it there, unasked."""
    first, second = (Atoms("CO", positions=[[0, 0, 0], [d, 0, 0]], calculator=Free()) for d in (1.15, 1.2))
    held = constrain(first, Distance([0, 1]))
    for atoms in (first, second):
        atoms.set_momenta([[0, 1.0, 0], [0, -1.0, 0]], apply_constraint=False)
        atoms.set_constraint(held)
    VelocityVerlet(first, FS).run(2)
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.05"):
        VelocityVerlet(second, FS).run(2)
    assert second.get_distance(0, 1) == 1.2
    VelocityVerlet(first, FS).run(2)
    assert off(first, held) <= 1e-14


# -- `constrain(project=True)` and `Constraints.restore` with far targets: whole groups move, bonds stay --


def test_momenta_go_along_and_the_rank_is_that_of_the_end() -> None:
    atoms = molecule("CH3CH2OH")
    atoms.set_momenta(np.random.default_rng(0).normal(size=(9, 3)))
    held = Constraints([Dihedral([[3, 2, 1, 0]], 0.3), Distance([[0, 1]])])
    atoms.set_constraint(held)
    held.restore(atoms)
    assert slip(atoms, held) < 1e-13
    bent = molecule("CO2")
    bent.positions[1, 0] += 0.02
    constrain(bent, [Distance([[0, 1], [0, 2]], 1.18), LinearRelation(0, [1, 2], [0.5, 0.5])], project=True)
    assert bent.get_number_of_degrees_of_freedom() == 5  # where it is straight, one of five rows depends on others


def test_a_target_that_bonds_stand_against_is_reached_without_them():
    """Guessed, or given: two waters that are said to be bonded. The message says how, and it can be done in ASE."""
    ethanol, pair = molecule("CH3CH2OH"), molecule("H2O") + molecule("H2O")
    pair.positions[3:] += [0.0, 0.0, 3.0]
    pair.info["bonds"] = [[0, 1], [0, 2], [3, 4], [3, 5], [0, 3]]
    for atoms, pull in (
        (ethanol, CenterDistance([2], [6, 7, 8], 2.9)),
        (pair, CenterDistance([0, 1, 2], [3, 4, 5], 6.0)),
    ):
        start = atoms.positions.copy()
        with pytest.raises(InfeasibleError, match=r"restore\(atoms, bonds=\[\]\)"):
            constrain(atoms, pull, project=True)
        np.testing.assert_array_equal(atoms.positions, start)
        assert not atoms.constraints
        held = Constraints(pull)
        held.restore(atoms, bonds=[])
        assert held.report(atoms).residual < 1e-12


# -- the calculator on the constraints ----------------------------------------------------------------


ROWS = [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2], [1, 0, 3]])]


class Counting(EMT):
    calls = 0

    def calculate(self, *args, **kwargs):
        self.calls += 1
        super().calculate(*args, **kwargs)
        assert not self.atoms.constraints  # calculators of other programs would write them into their input


def ethanol() -> tuple[Atoms, ConstrainedCalculator]:
    atoms = molecule("CH3CH2OH")
    atoms.calc = ConstrainedCalculator(Counting(), ROWS)
    return atoms, atoms.calc


def test_on_the_constraints_forces_are_f_plus_z():
    atoms, _ = ethanol()
    peer, held = ase_systems.ethanol()
    energy, forces = peer.get_potential_energy(), peer.get_forces(apply_constraint=False)
    assert atoms.get_potential_energy() == energy
    assert np.array_equal(atoms.get_forces(), held.engine(peer).project_forces(peer.positions, forces))
    assert np.abs(atoms.get_forces() - peer.get_forces()).max() <= 1e-14
    rows = held.engine(peer).constraint_set.jacobian(peer.positions)
    assert np.abs(rows @ (atoms.get_forces() / atoms.get_masses()[:, None]).ravel()).max() <= 1e-13


def test_new_masses_and_settings_are_noticed():
    """Masses share out what the constraints take; ASE compares only what a calculator of free atoms reads."""

    def fresh(inner, masses):
        peer = molecule("CH3CH2OH")
        peer.rattle(0.05, seed=1)
        peer.set_masses(masses)
        peer.calc = ConstrainedCalculator(inner, held)
        return peer.get_forces()

    held = Constraints(ROWS)
    held.engine(molecule("CH3CH2OH"))
    atoms = molecule("CH3CH2OH")
    atoms.rattle(0.05, seed=1)
    calculator = atoms.calc = ConstrainedCalculator(LennardJones(sigma=1.0, rc=5.0), held)
    seen = [atoms.get_forces()]
    masses = atoms.get_masses() * np.linspace(1, 3, 9)
    for change, inner in (
        (lambda: atoms.set_masses(masses), LennardJones(sigma=1.0, rc=5.0)),
        (lambda: (calculator.inner.set(sigma=1.1), calculator.inner.reset()), LennardJones(sigma=1.1, rc=5.0)),
        (lambda: setattr(calculator, "inner", LennardJones(sigma=1.2, rc=5.0)), LennardJones(sigma=1.2, rc=5.0)),
    ):
        change()
        assert not np.array_equal(atoms.get_forces(), seen[-1])
        seen.append(atoms.get_forces())
        assert np.array_equal(seen[-1], fresh(inner, masses))


def test_stress_is_that_of_the_constraint_object():
    atoms = copper()
    del atoms.arrays["momenta"]  # with which it is the full pressure
    (held,), stress = atoms.constraints, atoms.get_stress()
    plain = atoms.get_stress(apply_constraint=False)
    assert np.abs(stress - plain).max() > 1e-5
    atoms.calc = ConstrainedCalculator(EMT(), held)
    assert np.abs(atoms.get_stress() - stress).max() <= 1e-12  # not counted twice
    atoms.set_constraint()
    assert np.abs(atoms.get_stress() - stress).max() <= 1e-12


def test_results_are_kept_and_other_properties_are_passed_on():
    atoms, calculator = ethanol()
    atoms.get_potential_energy()
    atoms.get_forces()
    atoms.get_forces()
    assert calculator.inner.calls == 1
    atoms.rattle(0.001, rng=np.random.default_rng(0))
    atoms.get_forces()
    energy = atoms.get_potential_energy()
    assert atoms.get_potential_energy(force_consistent=True) == energy  # asked of what is known
    assert calculator.inner.calls == 2
    forces = atoms.get_forces()
    forces += 1.0  # a copy
    assert atoms.get_potential_energy() == energy
    assert np.abs(atoms.get_forces() - forces).min() == pytest.approx(1.0)
    assert calculator.inner.calls == 2
    assert calculator.implemented_properties == EMT.implemented_properties
    assert atoms.get_potential_energies().shape == (9,)
    with pytest.raises(PropertyNotImplementedError):
        atoms.get_dipole_moment()
