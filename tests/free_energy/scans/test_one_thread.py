"""BLAS has one thread in what scans compute, and in nothing else."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest
from scan_systems import chain, threefold
from threadpoolctl import threadpool_info, threadpool_limits

from kcons import ConstraintSet, Motion
from kcons.constraints import Dihedral
from kcons.free_energy.scans import relaxation
from kcons.free_energy.scans.model_hessian import Internals
from kcons.free_energy.scans.one_thread import one_thread


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        assert threads() == {2}
        yield


def test_calculators_keep_their_threads_and_matrices_have_one(two_threads, monkeypatch):
    atoms = chain(5, threefold, turns=[1.0, 1.0])
    x = atoms.positions.copy()
    motion = Motion(ConstraintSet([Dihedral([[0, 1, 2, 3]], 0.9)], x, atoms.get_masses()), x)
    seen, eigh = {"calculator": set(), "matrices": set()}, np.linalg.eigh

    def evaluate(y):
        seen["calculator"] |= threads()
        atoms.positions[:] = y
        return atoms.get_potential_energy(), atoms.get_forces()

    def counted(*given, **named):
        seen["matrices"] |= threads()
        return eigh(*given, **named)

    monkeypatch.setattr(relaxation.np.linalg, "eigh", counted)
    start = motion.restore_positions(x)
    relaxation.relax(motion, evaluate, Internals(atoms.numbers, x), start, fmax=0.05)
    assert seen == {"calculator": {2}, "matrices": {1}} and threads() == {2}


def test_the_last_that_leaves_puts_the_numbers_back(two_threads):
    outer, other = one_thread(), one_thread()
    outer.__enter__()
    thread = Thread(target=other.__enter__)
    thread.start()
    thread.join()
    with one_thread():
        pass
    outer.__exit__(None, None, None)
    assert threads() == {1}  # the other has not left
    other.__exit__(None, None, None)
    assert threads() == {2}
    with pytest.raises(ZeroDivisionError), one_thread():
        _ = 1 / 0
    assert threads() == {2}
