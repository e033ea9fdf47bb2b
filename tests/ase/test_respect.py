"""Dynamics that move atoms past their constraints are found; those that do not are left alone."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from ase.build import molecule
from ase.md.langevinbaoab import LangevinBAOAB
from ase.md.melchionna import MelchionnaNPT
from ase.md.nose_hoover_chain import NoseHooverChainNVT
from ase.md.npt import NPT
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase_systems import FS, TEMPERATURE, dumbbells, off, random

from kcons import ConstraintSet
from kcons.ase import constrain
from kcons.ase.respect import require_on_surface
from kcons.constraints import Distance
from kcons.errors import InputError, UnsupportedError

#: Classes that do not go through the constraints: our error, in how many steps, and what it says.
REFUSED = {
    "LangevinBAOAB": (lambda a: LangevinBAOAB(a, FS, temperature_K=TEMPERATURE, T_tau=100 * FS, rng=1), 1, "off row"),
    "NoseHooverChainNVT": (lambda a: NoseHooverChainNVT(a, FS, TEMPERATURE, 100 * FS), 2, "asks again"),
    "MelchionnaNPT": (
        lambda a: MelchionnaNPT(a, FS, temperature_K=TEMPERATURE, externalstress=0.0, ttime=50 * FS),
        60,
        "3 steps in a row",
    ),
    "NPT": (lambda a: NPT(a, FS, temperature_K=TEMPERATURE, externalstress=0.0, ttime=50 * FS), 60, "3 steps in a row"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_classes_that_move_atoms_past_constraints_are_found(name):
    make, steps, message = REFUSED[name]
    atoms, held = dumbbells(10)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ASE's own advice about its class
        with pytest.raises(UnsupportedError, match=f"{message}.*ConstrainedDynamics.*Langevin") as caught:
            make(atoms).run(steps)
    assert name in str(caught.value) or name in ("NPT",)
    # The object still works once the atoms are put right.
    held.restore(atoms)
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, FS).run(3)
    assert off(atoms, held) <= 1e-12


def test_honest_dynamics_raise_no_alarm():
    # Positions set again and again between momenta, velocities drawn anew, long steps.
    atoms, held = dumbbells(6)
    raw = atoms.positions + random().normal(scale=0.02, size=atoms.positions.shape)
    for _ in range(4):
        atoms.set_positions(raw)
        thermalize_momenta(atoms, 900, rng=random())
    atoms.set_positions(raw)
    for _ in range(4):
        VelocityVerlet(atoms, 8 * FS).run(20)
        thermalize_momenta(atoms, 900, rng=random())
    assert off(atoms, held) <= 1e-12


def test_atoms_at_rest_ask_for_the_same_positions():
    """A kick along the bond is the same in each step, but for rounding."""
    atoms = molecule("CO")
    held = constrain(atoms, Distance([0, 1]))
    start = atoms.get_positions()
    apart = np.outer(1 / atoms.get_masses(), start[0] - start[1]) * [[1], [-1]]
    for pull in (0.1, 0.1, 0.11, 0.11, 0.1, 0.1, 0.1):
        atoms.set_positions(start + pull * apart)
        atoms.set_momenta(np.zeros((2, 3)))
    assert off(atoms, held) <= 1e-14
    assert atoms.positions == pytest.approx(start, abs=1e-14)


def test_positions_that_are_not_finite_are_named():
    held = ConstraintSet(Distance([[0, 1]]), [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [1.0, 1.0])
    with pytest.raises(InputError, match="position of atom 1 is not finite"):
        require_on_surface(held, np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
