"""Relaxations in files: whole or not at all, and only of the same scan."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ase.calculators.lj import LennardJones
from scan_systems import chain, threefold

from kcons.constraints import Custom, Dihedral
from kcons.errors import InputError, OccupiedError, UnreadableError
from kcons.free_energy.scans.attempts import PLACE, PLAN, Attempt, Attempts
from kcons.free_energy.scans.grid import Grid


def made(folder, settings=None):
    atoms = chain(4, threefold)
    return begun(folder, atoms, Grid([Dihedral([[0, 1, 2, 3]])], [[0.1, 0.2]]), [], settings or {"fmax": 0.01})


def begun(*arguments):
    """Attempts whose folder is there."""
    attempts = Attempts(*arguments)
    with attempts.taken():
        return attempts


def test_an_attempt_comes_back(tmp_path):
    rng = np.random.default_rng(1)
    attempt = Attempt(3, (1,), 2, memory=rng.normal(size=(2, 2, 3)), terms=[(0, 1), (0, 1, 2), (1, 2, 3, -1, 0)])
    attempt.fill(rng.normal(size=(4, 3)), -1.5, 0.003, 7)
    made(tmp_path).keep(attempt)
    again = made(tmp_path).kept(3, (1,), 2)
    assert np.array_equal(again.positions, attempt.positions) and np.array_equal(again.memory, attempt.memory)
    assert (again.energy, again.largest, again.evaluations, again.error) == (-1.5, 0.003, 7, None)
    assert again.terms == attempt.terms
    assert made(tmp_path).kept(4, (1,), 2) is None
    failed = Attempt(5, (0,), None, error="no")
    made(tmp_path).keep(failed)
    assert made(tmp_path).kept(5, (0,), None).error == "no"


def test_nothing_half_written_is_read(tmp_path):
    attempts = made(tmp_path)
    (tmp_path / PLACE / "00000.npz.unfinished").write_bytes(b"PK\x03\x04")
    assert attempts.kept(0, (0,), None) is None
    (tmp_path / PLACE / "00000.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(UnreadableError, match=r"00000\.npz cannot be read .*; remove it"):
        attempts.kept(0, (0,), None)


def test_an_attempt_of_another_scan_is_refused(tmp_path):
    made(tmp_path).keep(Attempt(0, (0,), None))
    with pytest.raises(UnreadableError, match="of another scan"):
        made(tmp_path).kept(0, (1,), None)


def test_the_plan_has_to_be_the_same(tmp_path):
    made(tmp_path)
    with pytest.raises(OccupiedError, match=r"has a scan of other settings; give another folder \(--out\)"):
        made(tmp_path, {"fmax": 0.02})
    plan = json.loads((tmp_path / PLAN).read_text())
    (tmp_path / PLAN).write_text(json.dumps({**plan, "colour": 1}))
    with pytest.raises(OccupiedError, match="a scan of other colour"):
        made(tmp_path)
    for content in ("{", "[]"):
        (tmp_path / PLAN).write_text(content)
        with pytest.raises(OccupiedError, match=r"other files called plan\.json"):
            made(tmp_path)


def test_without_a_folder_nothing_is_kept():
    attempts = made(None)
    attempts.keep(Attempt(0, (0,), None))
    assert attempts.kept(0, (0,), None) is None


def test_python_functions_need_no_folder(tmp_path):
    row = Custom([[0]], lambda r: r[0, 0], lambda r: np.array([[1.0, 0, 0]]))
    grid = Grid([row], [[0.1]])
    Attempts(None, chain(4, threefold), grid, [], {})
    with pytest.raises(InputError, match="Python function"):
        Attempts(tmp_path / "new", chain(4, threefold), grid, [], {})
    assert not (tmp_path / "new").exists()


def test_the_calculator_has_to_be_the_same(tmp_path):
    """Not only of the same kind."""
    atoms = chain(4, threefold)
    grid = Grid([Dihedral([[0, 1, 2, 3]])], [[0.1, 0.2]])
    for epsilon in (0.1, 0.1, 0.2):
        atoms.calc = LennardJones(epsilon=epsilon)
        if epsilon == 0.2:
            with pytest.raises(OccupiedError, match=r"of other calculator;"):
                begun(tmp_path, atoms, grid, [], {})
        else:
            begun(tmp_path, atoms, grid, [], {})
