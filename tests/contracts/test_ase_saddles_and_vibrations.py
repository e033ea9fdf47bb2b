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


HELD = [FixedAtoms(np.arange(9)), Distance([[9, 10], [12, 13]])]


@pytest.fixture(scope="module")
def images() -> list[Atoms]:
    """Gold hops on aluminum, some of which is held: a band from one hollow to the next."""
    ends = []
    for hop in (0, 1):
        slab = fcc100("Al", (3, 3, 2), vacuum=8.0)
        slab += Atoms("Au", positions=[slab.positions[9] + [1.43 + hop * slab.cell[0, 0] / 3, 1.43, 1.7]])
        slab.calc = EMT()
        constrain(slab, HELD)
        BFGS(slab, logfile=None).run(fmax=0.02)
        ends.append(slab)
    found = [ends[0], *(ends[0].copy() for _ in range(3)), ends[1]]
    for image in found[1:-1]:
        image.calc = EMT()
    band = NEB(found, climb=True, method="improvedtangent")
    band.interpolate(apply_constraint=True)
    assert BFGS(band, logfile=None).run(fmax=0.03, steps=200)
    return found


def highest(images) -> Atoms:
    return max(images, key=lambda image: image.get_potential_energy())


def test_a_band_keeps_lengths_in_all_images(images):
    assert all(off(image, image.constraints[0]) <= 1e-12 for image in images)
    assert 0.05 < highest(images).get_potential_energy() - images[0].get_potential_energy() < 1.0


def test_no_search_is_forgotten():
    assert set(classes_in(ase.mep, Dynamics)) == {"MinModeTranslate", "DimerTranslate", "NEBOptimizer"}


@pytest.mark.parametrize("calculator", [False, True])
def test_dimer_finds_the_same_saddle(images, calculator):
    start = highest(images).copy()
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
    assert start.get_potential_energy() == pytest.approx(highest(images).get_potential_energy(), abs=5e-3)
    if not calculator:
        assert off(start, held) <= 1e-12


# -- finite differences -----------------------------------------------------------------------------


def test_vibrations_see_the_constrained_hessian(tmp_path, monkeypatch):
    """Of water whose O-H lengths are held away from their minimum, at the angle of least energy."""
    monkeypatch.chdir(tmp_path)
    atoms, rows = molecule("H2O"), [Distance([[0, 1], [0, 2]], [1.05, 1.1])]
    atoms.calc = EMT()
    held = constrain(atoms, rows, project=True)
    BFGS(atoms, logfile=None).run(fmax=1e-7, steps=200)
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
