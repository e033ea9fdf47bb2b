"""What keeps its geometry while groups move: bonds, as given or as found."""

from __future__ import annotations

import tracemalloc
from itertools import combinations

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.neighborlist import natural_cutoffs, neighbor_list

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.motion.restoring.kept_geometry import bonds_of
from kcons.topology.guessed_bonds import bonds_without_elements


def bond_table(atoms: Atoms) -> list[tuple[int, int]]:
    """Bonds by ASE's own neighbor list."""
    i, j = neighbor_list("ij", atoms, natural_cutoffs(atoms, mult=1.2))
    return [(int(a), int(b)) for a, b in zip(i, j, strict=True) if a < b]


def engine(atoms: Atoms, rows: list[held.Constraint], masses: np.ndarray | None = None) -> Motion:
    masses = atoms.get_masses() if masses is None else masses
    cell = atoms.cell.array if atoms.pbc.any() else None
    return Motion(ConstraintSet(rows, atoms.positions, masses, cell=cell), atoms.positions)


@pytest.mark.parametrize("name", ["CH3CH2OH", "C6H6", "PH3", "NF3", "CH2SCH2", "Si2H6", "CH3SH", "C2Cl4", "H2CCO"])
@pytest.mark.parametrize("unit", [1.0, 0.1, 1.8897])
def test_bonds_by_distances_alone_are_those_by_elements(name: str, unit: float) -> None:
    atoms = molecule(name)
    every = np.arange(len(atoms))
    found = bonds_without_elements(unit * atoms.positions, None, every, every >= 0)
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(atoms))


def test_bonds_in_a_cell_do_not_hang_on_where_atoms_are_stored() -> None:
    """With the nearest neighbors as they are stored, 60 cells away, images of the whole cell took 24 GB."""
    atoms = molecule("CH3CH2OH")
    every = np.arange(len(atoms))
    cell = np.array([[7.0, 0, 0], [1.0, 6.5, 0], [-0.8, 1.0, 7.5]])
    lattice = np.stack([cell, np.linalg.inv(cell)])
    shifts = np.random.default_rng(2).integers(-60, 61, (len(atoms), 3)) @ cell
    tracemalloc.start()
    found = bonds_without_elements(atoms.positions + shifts, lattice, every, every >= 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(atoms))
    assert peak < 5e5  # 0.1 MB; with atoms as they are stored 1.7, without the bound of a cell vector 24 GB
    # Two atoms in a flat cell: nothing is nearer than images of the atom itself.
    flat = np.diag([1.0, 90.0, 90.0])
    two = np.array([[0.0, 0, 0], [0.2, 44.0, 44.0]])
    assert len(bonds_without_elements(two, np.stack([flat, np.linalg.inv(flat)]), every[:2], every[:2] >= 0)) == 0


def test_no_bonds_are_guessed_where_there_are_no_molecules() -> None:
    every = np.arange(60)
    scattered = np.random.default_rng(0).uniform(0, 4, (60, 3))
    cubic = np.stack(np.meshgrid(*3 * [np.arange(5.0)]), axis=-1).reshape(-1, 3)
    faces = cubic[cubic.sum(axis=1) % 2 == 0][:60]
    for x in (scattered, 3.8 * faces):
        assert len(bonds_without_elements(x, None, every, every >= 0)) == 0


def test_held_distances_that_are_no_bonds() -> None:
    """The third side of water, and the ends of a chain."""
    atoms = molecule("H2O")
    motion = engine(atoms, [held.Distance([[0, 1], [0, 2], [1, 2]])])
    assert bonds_of(motion.constraint_set, atoms.positions, 0.0, None).tolist() == [[0, 1], [0, 2]]
    chain = molecule("trans-butane")
    carbons = np.flatnonzero(chain.numbers == 6)
    ends = max(combinations(carbons.tolist(), 2), key=lambda pair: chain.get_distance(*pair))
    motion = engine(chain, [held.Distance([ends])])
    found = bonds_of(motion.constraint_set, chain.positions, 0.0, None)
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(chain))
