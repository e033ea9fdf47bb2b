"""Samples of one compiled call are those of the general formulas, and what is unusual goes to these."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from kcons import ConstraintSet
from kcons.constraints import Angle, Dihedral, Distance, Formula, MovingTarget, Plane
from kcons.errors import NonFiniteError, SingularGeometryError
from kcons.free_energy import HeldCoordinates, compiled_samples

CHAIN = np.array(
    [[0.0, 0.1, 0.2], [1.1, 0.0, -0.1], [1.6, 1.2, 0.1], [2.7, 1.3, 0.9], [3.1, 0.4, 1.9], [2.2, -0.5, 2.4]]
)
MASSES = np.array([1.0, 12.0, 14.0, 16.0, 12.0, 1.5])
CELL = np.array([[9.0, 0.3, 0.0], [0.0, 8.5, -0.4], [0.2, 0.0, 9.5]])
BONDS = Distance([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]])

CASES = {
    "a distance alone": ({"r": Distance([[0, 3]])}, []),
    "a distance beside bonds": ({"r": Distance([[0, 3]])}, [BONDS]),
    "an angle beside bonds": ({"bend": Angle([[0, 1, 2]])}, [BONDS]),
    "a torsion beside bonds and angles": ({"turn": Dihedral([[1, 2, 3, 4]])}, [BONDS, Angle([[1, 2, 3], [2, 3, 4]])]),
    "three at once": (
        {"far": Distance([[5, 1]]), "turn": Dihedral([[0, 1, 2, 3]]), "bend": Angle([[2, 3, 4]])},
        [BONDS, Angle([[1, 2, 3]])],
    ),
    "targets that move": (
        {
            "turn": Dihedral([[0, 1, 2, 3]], MovingTarget(lambda t: 0.3 * t + 0.2 * t * t)),
            "bend": Angle([[1, 2, 3]]),
        },
        [Distance([[0, 1], [1, 2]]), Distance([[3, 4]], MovingTarget(lambda t: 1.2 + 0.1 * np.sin(t)))],
    ),
}


@cache
def coordinates(name: str, periodic: bool) -> HeldCoordinates:
    named, others = CASES[name]
    rows = ConstraintSet([*others, *named.values()], CHAIN, MASSES, cell=CELL if periodic else None)
    return HeldCoordinates(rows, named, CHAIN)


def both(held: HeldCoordinates, *arrays: np.ndarray, time: float = 0.7):
    """The sample, and the one by the general formulas."""
    kernel = held._compiled
    assert kernel is not None and kernel.sample(arrays, time, held._source.lattice) is not None
    sample = held.sample(*arrays, time)
    held._compiled = None
    try:
        return sample, held.sample(*arrays, time)
    finally:
        held._compiled = kernel


#: A distance that moves may become longer than half a box, which the kernel does not know.
IN_A_BOX = [name for name in CASES if name != "targets that move"]


@pytest.mark.parametrize(
    ("name", "periodic"), [*((name, False) for name in CASES), *((name, True) for name in IN_A_BOX)]
)
def test_the_same_as_the_general_formulas(name, periodic):
    rng = np.random.default_rng(3)
    held = coordinates(name, periodic)
    x = CHAIN + 0.02 * rng.standard_normal(CHAIN.shape)
    if periodic:
        x = x + rng.integers(-2, 3, (len(x), 3)) @ CELL
    v, f = rng.standard_normal((2, *x.shape))
    sample, known = both(held, x, v, f)
    # Images cost digits of the positions, which are some 40 long; nothing else here is larger than 50.
    for field in ("value", "multiplier", "kinetic", "log_det_z", "gradient", "off"):
        np.testing.assert_allclose(
            getattr(sample, field), getattr(known, field), rtol=0, atol=2e-12 if periodic else 1e-13, err_msg=field
        )
    assert max(abs(known.multiplier).max(), abs(known.kinetic).max(), abs(known.gradient).max()) < 50
    assert abs(known.kinetic).max() > 0.1 and known.off > 1e-4
    assert np.isnan(sample.mean_kinetic).all() == (name == "targets that move") and np.isnan(known.mean_kinetic).all()


def test_only_distances_angles_and_torsions_are_compiled():
    square = Formula("(x1-x2)**2 + (y1-y2)**2 + (z1-z2)**2", [[0, 4]], target=None)
    for coordinate, others in ((square, []), (Distance([[0, 3]]), [Plane([0], [0.0, 0.0, 1.0])])):
        rows = ConstraintSet([*others, coordinate], CHAIN, MASSES)
        held = HeldCoordinates(rows, {"q": coordinate}, CHAIN)
        assert held._compiled is None
        assert np.isfinite(held.sample(CHAIN, np.ones((6, 3)), np.ones((6, 3))).multiplier).all()
    assert coordinates("targets that move", True)._compiled is None


def test_many_rows_are_left_to_the_sparse_solver(monkeypatch):
    monkeypatch.setattr(compiled_samples, "MOST_ROWS", len(BONDS.atoms) - 1)
    rows = ConstraintSet([BONDS, Angle([[0, 1, 2]])], CHAIN, MASSES)
    assert HeldCoordinates(rows, {"bend": Angle([[0, 1, 2]])}, CHAIN)._compiled is None


def test_rows_beside_it_that_depend_on_each_other():
    """Two bonds, the angle between them and its opposite side: the kernel leaves it, and the sample is there."""
    beside = [Distance([[0, 1], [1, 2], [0, 2]]), Angle([[0, 1, 2]])]
    turn = Dihedral([[0, 1, 2, 3]])
    rng = np.random.default_rng(5)
    arrays = (CHAIN, *rng.standard_normal((2, *CHAIN.shape)))
    held = HeldCoordinates(ConstraintSet([*beside, turn], CHAIN, MASSES), {"turn": turn}, CHAIN)
    assert held._compiled.sample(arrays, 0.0, None) is None
    fewer = HeldCoordinates(ConstraintSet([beside[0], turn], CHAIN, MASSES), {"turn": turn}, CHAIN)
    assert held.sample(*arrays).log_det_z == pytest.approx(fewer.sample(*arrays).log_det_z, abs=1e-12)


def test_what_has_gone_wrong_is_said():
    held = coordinates("a torsion beside bonds and angles", False)
    lost = CHAIN.copy()
    lost[2, 1] = np.nan
    with pytest.raises(NonFiniteError, match="velocities of atom 2"):
        held.sample(CHAIN, lost, CHAIN)
    two = {"bend": Angle([[0, 1, 2]]), "side": Distance([[0, 2]])}
    free = HeldCoordinates(ConstraintSet([*two.values()], CHAIN, MASSES), two, CHAIN)
    flat = CHAIN.copy()
    flat[0] = 2 * flat[1] - flat[2] + [0.0, 0.0, 1e-9]  # straight: the side no longer tells the angle from the arms
    beside = ConstraintSet([Distance([[0, 1], [1, 2]]), Distance([[0, 2]])], CHAIN, MASSES)
    with pytest.raises(SingularGeometryError, match="side depends on the other"):
        HeldCoordinates(beside, {"side": Distance([[0, 2]])}, CHAIN).sample(flat, CHAIN, CHAIN)
    assert np.isfinite(free.sample(CHAIN, CHAIN, CHAIN).multiplier).all()
