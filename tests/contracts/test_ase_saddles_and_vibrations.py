"""Saddle searches and vibrations on the constraints."""

from __future__ import annotations

import ase.mep
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import fcc100, molecule
from ase.calculators.emt import EMT
from ase.constraints import FixAtoms
from ase.mep import NEB, DimerControl, MinModeAtoms, MinModeTranslate
from ase.optimize import BFGS
from ase.optimize.optimize import Dynamics
from ase.vibrations import Vibrations
from ase_systems import classes_in, off

from kcons.ase import ConstrainedCalculator, Constraints, constrain
from kcons.constraints import Angle, Distance, FixedAtoms

# -- saddles ----------------------------------------------------------------------------------------


def adatom(hop: bool) -> Atoms:
    slab = fcc100("Al", (3, 3, 2), vacuum=8.0)
    top = slab.positions[9]
    slab += Atoms("Au", positions=[np.add(top, [1.43, 1.43, 1.7])])
    if hop:
        slab.positions[-1, 0] += slab.cell[0, 0] / 3
    slab.calc = EMT()
    return slab


def ends(hold) -> list[Atoms]:
    result = []
    for hop in (False, True):
        atoms = adatom(hop)
        hold(atoms)
        BFGS(atoms, logfile=None).run(fmax=0.02)
        result.append(atoms)
    return result


def path(hold) -> list[Atoms]:
    first, last = ends(hold)
    images = [first, first.copy(), first.copy(), first.copy(), last]
    for image in images[1:-1]:
        image.calc = EMT()
    band = NEB(images, climb=True, method="improvedtangent")
    band.interpolate(apply_constraint=True)
    assert BFGS(band, logfile=None).run(fmax=0.03, steps=200)
    return images


def barrier(images) -> float:
    energies = [image.get_potential_energy() for image in images]
    return max(energies) - energies[0]


def test_neb_agrees_with_fix_atoms():
    ours = path(lambda a: constrain(a, FixedAtoms(np.arange(9))))
    ases = path(lambda a: a.set_constraint(FixAtoms(np.arange(9))))
    assert barrier(ours) == pytest.approx(barrier(ases), abs=1e-6)
    assert 0.05 < barrier(ours) < 1.0


HELD = [FixedAtoms(np.arange(9)), Distance([[9, 10], [12, 13]])]


@pytest.fixture(scope="module")
def rigid_path():
    return path(lambda a: constrain(a, HELD))


def test_neb_keeps_lengths_in_all_images(rigid_path):
    for image in rigid_path:
        assert off(image, image.constraints[0]) <= 1e-12
    assert barrier(rigid_path) > 0.05


def test_no_search_is_forgotten():
    assert set(classes_in(ase.mep, Dynamics)) == {"MinModeTranslate", "DimerTranslate", "NEBOptimizer"}


@pytest.mark.parametrize("calculator", [False, True])
def test_dimer_finds_the_same_saddle(rigid_path, calculator):
    start = max(rigid_path, key=lambda a: a.get_potential_energy()).copy()
    held = start.constraints[0]
    displacement = np.zeros((len(start), 3))
    displacement[-1] = [0.15, 0.02, 0.0]
    if calculator:
        start.calc = ConstrainedCalculator(EMT(), held)
        start.set_constraint(FixAtoms(np.arange(9)))
    else:
        start.calc = EMT()
    with DimerControl(
        initial_eigenmode_method="displacement",
        displacement_method="vector",
        mask=[False] * (len(start) - 1) + [True],
        logfile=None,
        eigenmode_logfile=None,
    ) as control:
        search = MinModeAtoms(start, control)
        search.displace(displacement_vector=displacement)
        with MinModeTranslate(search, logfile=None) as translate:
            assert translate.run(fmax=0.02, steps=200)
    assert search.get_curvature() < 0
    saddle = rigid_path[0].get_potential_energy() + barrier(rigid_path)
    assert start.get_potential_energy() == pytest.approx(saddle, abs=5e-3)
    if not calculator:
        assert off(start, held) <= 1e-12


# -- finite differences -----------------------------------------------------------------------------


def bent_water() -> tuple[Atoms, list[Distance]]:
    """Water whose O-H lengths are held away from their minimum, at the angle of least energy."""
    atoms = molecule("H2O")
    atoms.calc = EMT()
    rows = [Distance([[0, 1], [0, 2]], [1.05, 1.1])]
    constrain(atoms, rows, project=True)
    BFGS(atoms, logfile=None).run(fmax=1e-7, steps=200)
    return atoms, rows


def test_vibrations_see_the_constrained_hessian(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    atoms, rows = bent_water()
    held = atoms.constraints[0]
    assert np.abs(atoms.get_forces(apply_constraint=False)).max() > 1  # so that the rows' curvature counts
    energies = []
    angle = atoms.get_angle(1, 0, 2)
    h = 0.2  # degrees
    for shift in (-h, 0, h):
        bent = atoms.copy()
        bent.set_constraint()
        bent.calc = EMT()
        constrain(bent, [*rows, Angle([1, 0, 2], np.radians(angle + shift))], project=True)
        energies.append(bent.get_potential_energy())
    second = (energies[0] - 2 * energies[1] + energies[2]) / np.radians(h) ** 2
    whole = Constraints([*rows, Angle([1, 0, 2])]).engine(atoms).constraint_set.jacobian(atoms.positions).toarray()
    gram = whole / np.repeat(atoms.get_masses(), 3) @ whole.T
    frequency = units._hbar * np.sqrt(second / np.linalg.inv(gram)[2, 2] * units._e / units._amu) * 1e10 / units._e

    atoms.set_constraint()
    atoms.calc = ConstrainedCalculator(EMT(), held)
    vibrations = Vibrations(atoms, delta=0.002)
    vibrations.run()
    found = np.sort(np.abs(vibrations.get_energies()))
    assert found[-1] == pytest.approx(frequency, rel=1e-3)
    assert found[-2] < 0.05 * frequency  # all the rest: translation, rotation and held directions
