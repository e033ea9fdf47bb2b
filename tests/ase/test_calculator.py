"""The calculator on the constraints: forces, energies, caching, stress, optimizers without a constraint object."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.calculators.calculator import PropertyNotImplementedError
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.optimize import BFGS, FIRE
from ase_systems import copper

from kcons.ase import ConstrainedCalculator, Constraints, constrain
from kcons.constraints import Angle, Distance

ROWS = [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2], [1, 0, 3]])]


class Counting(EMT):
    calls = 0

    def calculate(self, *args, **kwargs):
        self.calls += 1
        super().calculate(*args, **kwargs)


def ethanol(inner=None) -> tuple[Atoms, ConstrainedCalculator]:
    atoms = molecule("CH3CH2OH")
    calculator = ConstrainedCalculator(Counting() if inner is None else inner, ROWS)
    atoms.calc = calculator
    return atoms, calculator


def test_on_the_constraints_forces_are_f_plus_z():
    atoms, _ = ethanol()
    peer = molecule("CH3CH2OH")
    peer.calc = EMT()
    energy, forces = peer.get_potential_energy(), peer.get_forces()
    held = constrain(peer, ROWS)
    assert atoms.get_potential_energy() == energy
    assert np.array_equal(atoms.get_forces(), held.engine(peer).project_forces(peer.positions, forces))
    assert np.abs(atoms.get_forces() - peer.get_forces()).max() <= 1e-14
    rows = held.engine(peer).constraint_set.jacobian(peer.positions)
    assert np.abs(rows @ (atoms.get_forces() / atoms.get_masses()[:, None]).ravel()).max() <= 1e-13


def test_caching():
    atoms, calculator = ethanol()
    atoms.get_potential_energy()
    atoms.get_forces()
    atoms.get_forces()
    assert calculator.inner.calls == 1
    atoms.rattle(0.001, rng=np.random.default_rng(0))
    atoms.get_forces()
    energy = atoms.get_potential_energy()
    assert calculator.inner.calls == 2
    forces = atoms.get_forces()
    forces += 1.0  # a copy
    assert atoms.get_potential_energy() == energy
    assert np.abs(atoms.get_forces() - forces).min() == pytest.approx(1.0)
    assert calculator.inner.calls == 2


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


@pytest.mark.parametrize("optimizer", [BFGS, FIRE])
def test_optimizer_without_a_constraint_object(optimizer):
    peer = molecule("CH3CH2OH")
    peer.calc = EMT()
    held = constrain(peer, ROWS)
    optimizer(peer, logfile=None).run(fmax=0.01, steps=300)

    atoms, calculator = ethanol()
    assert optimizer(atoms, logfile=None).run(fmax=0.01, steps=300)
    assert atoms.get_potential_energy() == pytest.approx(peer.get_potential_energy(), abs=1e-3)
    energy = atoms.get_potential_energy()
    calculator.restore(atoms)
    assert np.abs(held.engine(peer).constraint_set.value(atoms.positions)).max() <= 1e-12
    assert atoms.get_potential_energy() == pytest.approx(energy, abs=1e-10)


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


def test_other_properties_are_passed_on():
    atoms, calculator = ethanol()
    assert calculator.implemented_properties == EMT.implemented_properties
    assert atoms.get_potential_energies().shape == (9,)
    with pytest.raises(PropertyNotImplementedError):
        atoms.get_dipole_moment()


class Unnamed(EMT):
    """Has a free energy in its results that it does not list, as tblite does."""

    implemented_properties = ["energy", "forces"]


def test_a_result_that_the_inner_calculator_does_not_list():
    atoms, calculator = ethanol(Unnamed())
    BFGS(atoms, logfile=None).run(fmax=0.05, steps=3)
    calculator.restore(atoms)
    assert "free_energy" in calculator.inner.results
    assert calculator.results["energy"] == calculator.inner.results["energy"]
