"""Relaxations on constraints: the minimum, its cost, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from ase.build import molecule
from scan_systems import chain, threefold
from threadpoolctl import threadpool_info, threadpool_limits

from kcons import ConstraintSet, Motion
from kcons.constraints import Dihedral
from kcons.constraints.periodic.one_piece import lattice_of
from kcons.errors import ConvergenceError
from kcons.free_energy.scans import relaxation
from kcons.free_energy.scans.relaxation import Descent, Internals


def setting(n=5):
    """A chain with a torsion held: what relaxes it from its structure, and its energy and forces."""
    atoms = chain(n, threefold, turns=[1.0] * (n - 3))
    x = atoms.positions.copy()
    motion = Motion(ConstraintSet([Dihedral([[0, 1, 2, 3]], 0.9)], x, atoms.get_masses()), x)
    x = motion.restore_positions(x)
    internals = Internals(atoms.numbers, x)

    def forces(y):
        atoms.positions[:] = y
        return atoms.get_potential_energy(), atoms.get_forces()

    def relax(evaluate=forces, start=x, fmax=1e-3, memory=(), evaluations=200):
        return Descent(motion, evaluate, internals, memory).relaxed(start, fmax, evaluations)

    return relax, x, forces


def test_what_was_learned_goes_along():
    relax, _, _ = setting(n=6)
    first = relax()
    assert first.memory.shape == (first.evaluations - 1, 2, len(first.terms))
    assert relax(memory=first.memory).evaluations < first.evaluations


def test_what_ends_no_relaxation_is_told():
    relax, x, forces = setting()
    with pytest.raises(ConvergenceError, match="forces are not its gradient") as raised:
        relax(lambda y: (forces(y)[0], -forces(y)[1]), fmax=1e-5, evaluations=500)
    assert raised.value.positions.shape == x.shape
    with pytest.raises(ConvergenceError, match="3 evaluations; allow more"):
        relax(fmax=1e-5, evaluations=3)
    met = x.copy()
    met[4] = met[3]
    with pytest.raises(ConvergenceError, match="two atoms met"):
        relax(lambda y: (0.0, np.ones_like(y)), met)


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_calculators_keep_their_threads_and_matrices_have_one(monkeypatch):
    relax, _, forces = setting()
    seen, eigh = {"calculator": set(), "matrices": set()}, np.linalg.eigh

    def evaluate(y):
        seen["calculator"] |= threads()
        return forces(y)

    def counted(*given, **named):
        seen["matrices"] |= threads()
        return eigh(*given, **named)

    monkeypatch.setattr(relaxation.np.linalg, "eigh", counted)
    with threadpool_limits(2, user_api="blas"):
        relax(evaluate, fmax=0.05)
        assert seen == {"calculator": {2}, "matrices": {1}} and threads() == {2}


# -- internal coordinates --


@pytest.mark.parametrize("name", ["CH3CH2OH", "C2H2", "CH3SiH3", "2-butyne", "H2O"])
def test_gradients_are_those_of_the_values(name):
    atoms = molecule(name)
    rng = np.random.default_rng(1)
    x, d = atoms.positions, rng.normal(size=atoms.positions.shape)
    internals = Internals(atoms.numbers, x)
    h = 1e-5
    slope = internals.change(internals.values(x + h * d), internals.values(x - h * d)) / (2 * h)
    np.testing.assert_allclose(internals.jacobian(x) @ d.ravel(), slope, atol=1e-7)
    assert len(internals.terms) == len(internals.constants) == len(slope)


def test_terms_keep_their_images():
    """Two atoms half a cell apart: the other image is as near, and nearer after a small move."""
    x = np.array([[0.0, 0, 0], [1.25, 0, 0]])
    internals = Internals([6, 6], x, lattice_of(np.diag([2.5, 9.0, 9.0]), True))
    for d in (-1e-3, 1e-3):
        change = internals.change(internals.values(x + np.array([[0, 0, 0], [d, 0, 0]])), internals.values(x))
        assert abs(change) == pytest.approx([1e-3])
        assert np.sign(change) == np.sign(d) * np.sign(internals.jacobian(x)[0, 3])
