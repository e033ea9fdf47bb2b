"""Windows in ASE: placed by turning groups, pulled, sampled."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.calculators.lj import LennardJones
from ase.constraints import FixAtoms

from kcons.constraints import Dihedral, Distance
from kcons.free_energy import AseWindows, Series, Settings, Window, Windows

CALCULATOR = partial(LennardJones, sigma=1.0, epsilon=0.02, rc=6.0)
TURN = Dihedral([[2, 0, 1, 3]])
#: Methanol as two rigid pieces that turn about the C-O bond.
PIECES = Distance([[0, 1], [1, 3], [0, 3], [0, 2], [0, 4], [0, 5], [2, 4], [4, 5], [2, 5], [1, 2], [1, 4], [1, 5]])
SHORT = Settings(pull=20, equilibration=20, production=320, every=10, relax=3)


def sampler(atoms=None, calculator=CALCULATOR, held=(PIECES,)):
    return AseWindows(molecule("CH3OH") if atoms is None else atoms, calculator, {"turn": TURN}, held)


@pytest.mark.filterwarnings("ignore:the forces exert no torque")  # about the fixed atom
def test_a_window_far_from_the_structure(tmp_path):
    """From 180 to 60 degrees in one go; the same file whenever it is made."""
    start, periods = sampler().start, sampler().periods
    assert start == pytest.approx([np.pi]) and periods == pytest.approx([2 * np.pi])
    window = Window("up", (1.0,), (np.pi / 3,), 5)
    atoms = molecule("CH3OH")
    atoms.set_constraint(FixAtoms([0]))
    held = pickle.loads(pickle.dumps(sampler(atoms)))
    for name in ("one", "two"):
        held.sample(window, SHORT, tmp_path / name)
    series = Series.load(tmp_path / "one")
    assert len(series) == 32 and series.off.max() < 1e-12
    np.testing.assert_allclose(series.value, np.pi / 3, atol=1e-12)
    assert np.array_equal(series.multiplier, Series.load(tmp_path / "two").multiplier)


def test_atoms_that_are_changed_later_change_no_windows():
    atoms = molecule("CH3OH", cell=[20.0] * 3, pbc=True)
    windows = sampler(atoms, held=PIECES)  # one constraint, as elsewhere
    before = windows.placed([1.0])[1]
    atoms.set_cell([2.0] * 3)
    atoms.rattle(0.1)
    assert np.array_equal(windows.placed([1.0])[1], before)


def test_a_window_without_a_pull(tmp_path):
    how = {"both_sides": False, "executor": ThreadPoolExecutor(1)}
    result = Windows(sampler(), tmp_path, replace(SHORT, pull=0), **how).run([np.pi / 3])
    assert result.failed == {} and len(result.windows) == 1


@pytest.mark.parametrize(
    ("four", "said"),
    [
        ([0, 1, 2, 3], None),
        ([4, 0, 1, 2], None),
        ([2, 0, 1, 3], "2-0, 1-3 are no bonds"),
        ([0, 1, 2, 13], None),
        ([0, 1, 3, 8], "1-3 is no bond"),
        ([6, 0, 1, 4], None),  # improper torsions: all bonded to atom 0
        ([6, 4, 0, 7], None),
    ],
)
def test_torsions_over_atoms_that_are_not_bonded(four, said):
    """Of butane, whose chain is 0-1-2-3."""
    match = f"turn is a torsion over .* and {said}; give the atoms in the order"
    with pytest.warns(UserWarning, match=match) if said else nullcontext():
        AseWindows(molecule("trans-butane"), CALCULATOR, {"turn": Dihedral([four])})


def test_torsions_over_atoms_that_form_no_bonds():
    """Nobody knows which order of metal atoms is meant."""
    AseWindows(molecule("Si2H6"), CALCULATOR, {"turn": Dihedral([[2, 0, 1, 5]])})
    copper = Atoms("Cu4", [[0, 0, 0], [2.5, 0, 0], [2.5, 2.5, 0], [2.5, 2.5, 2.5]])
    AseWindows(copper, CALCULATOR, {"turn": Dihedral([[0, 1, 2, 3]])})


def test_a_pull_begins_in_equilibrium_and_is_recorded_at_each_step(tmp_path):
    sampler().pull(Window("forward", (2.0,), (2.4,), 5), replace(SHORT, pull=200), tmp_path / "pull.npz")
    series = Series.load(tmp_path / "pull.npz")
    assert len(series) == 201
    np.testing.assert_allclose(series.value[:, 0], np.linspace(2.0, 2.4, 201), atol=1e-9)
    assert series.work[0] == 0 and np.isfinite(series.work[-1])


def test_what_a_folder_belongs_to():
    """The same in another process; another or changed calculator, or other constraints, are something else."""
    assert sampler().digest == sampler().digest == pickle.loads(pickle.dumps(sampler())).digest
    lj = LennardJones(epsilon=0.01)

    def made(epsilon):
        """Functions of the same name, without arguments."""
        return lambda: LennardJones(epsilon=epsilon)

    calculators = (partial(LennardJones, sigma=1.1), made(0.01), made(0.02), lambda: lj)
    others = [sampler(calculator=each) for each in calculators]
    first = others[-1].digest
    assert len({sampler().digest, sampler(held=[]).digest, *(other.digest for other in others)}) == 6
    for epsilon in (0.02, 0.01):
        lj.set(epsilon=epsilon)
        assert (others[-1].digest == first) == (epsilon == 0.01)
