"""Chains with a force field of their own, whose relaxed energies are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes

from kcons.constraints import Angle, Dihedral, Distance

LENGTH, ANGLE = 1.4, np.radians(110.0)


class ChainField(Calculator):
    """Harmonic bonds and angles, and `of_turns(phi)` -> (energy, slopes) of the dihedrals, which are independent."""

    implemented_properties = ["energy", "forces"]

    def __init__(self, n_atoms, of_turns, fails=None):
        super().__init__()
        chain = np.arange(n_atoms)
        self.rows = [Distance(list(pairwise(chain))), Angle(list(zip(chain, chain[1:], chain[2:], strict=False)))]
        self.turns = Dihedral(list(zip(chain, chain[1:], chain[2:], chain[3:], strict=False)))
        self.of_turns = of_turns
        self.fails = fails or (lambda phi: None)
        self.calls = 0

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.calls += 1
        x = self.atoms.positions
        slopes, energy = np.zeros_like(x), 0.0
        for item, place, k in zip(self.rows, (LENGTH, ANGLE), (30.0, 5.0), strict=True):
            off = item.measure(x[item.atoms], 0.0) - place
            energy += 0.5 * k * float(off @ off)
            np.add.at(slopes, item.atoms, k * off[:, None, None] * item.gradient(x[item.atoms], 0.0))
        phi = self.turns.measure(x[self.turns.atoms], 0.0)
        wrong = self.fails(phi)
        if isinstance(wrong, Exception):
            raise wrong
        more, slope = self.of_turns(phi)
        np.add.at(slopes, self.turns.atoms, slope[:, None, None] * self.turns.gradient(x[self.turns.atoms], 0.0))
        self.results = {"energy": energy + more, "forces": -slopes}
        if wrong is not None:
            self.results["forces"] = slopes + wrong


def chain(n_atoms, of_turns, fails=None, turns=None):
    """A zigzag of carbon, off its bonds and angles, with a `ChainField`."""
    from kcons import ConstraintSet, Motion

    x = np.zeros((n_atoms, 3))
    x[:, 0] = 1.15 * np.arange(n_atoms)
    x[1::2, 1] = 0.85
    x += 0.02 * np.random.default_rng(7).normal(size=x.shape)
    atoms = Atoms(f"C{n_atoms}", positions=x)
    if turns is not None:
        rows = Dihedral([range(n, n + 4) for n in range(n_atoms - 3)], turns)
        motion = Motion(ConstraintSet([rows], x, atoms.get_masses()), x)
        atoms.positions[:] = motion.restore_positions(x, bonds=list(pairwise(range(n_atoms))))
    atoms.calc = ChainField(n_atoms, of_turns, fails)
    return atoms


def threefold(phi):
    """0.2 (1 + cos 3 phi) eV of each dihedral."""
    return float(np.sum(0.2 * (1 + np.cos(3 * phi)))), -0.6 * np.sin(3 * phi)


def two_wells(phi):
    """The second dihedral has wells near 0 and 180 degrees; the first one makes one the lower, and takes it away.

    V = 0.1 (1 - cos 2 psi) + 0.6 sin(phi) cos(psi - 0.4)
    """
    a, b = phi
    energy = 0.1 * (1 - np.cos(2 * b)) + 0.6 * np.sin(a) * np.cos(b - 0.4)
    slope = 0.2 * np.sin(2 * b) - 0.6 * np.sin(a) * np.sin(b - 0.4)
    return float(energy), np.array([0.6 * np.cos(a) * np.cos(b - 0.4), slope])
