"""Distances, angles and dihedrals: values, singular geometries, agreement with independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kcons.constraints import Angle, Dihedral, Distance, from_dict
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, SingularGeometryError

POINTS = arrays(np.float64, (4, 3), elements=st.floats(-5, 5, allow_subnormal=False, width=32))


def bent(degrees: float, first: float = 1.0, last: float = 1.0) -> np.ndarray:
    """Three atoms with the vertex at the origin, shape (1, 3, 3)."""
    theta = np.radians(degrees)
    return np.array([[[first, 0, 0], [0, 0, 0], [last * np.cos(theta), last * np.sin(theta), 0]]])


def twisted(degrees: float) -> np.ndarray:
    phi = np.radians(degrees)
    return np.array([[[1.0, 0, -0.3], [0, 0, 0], [0, 0, 1.0], [np.cos(phi), np.sin(phi), 1.4]]])


def well_shaped(x: np.ndarray) -> bool:
    d = np.diff(x, axis=0)
    length = np.linalg.norm(d, axis=1)
    if length.min() < 0.1:
        return False
    sines = np.linalg.norm(np.cross(d[1:], d[:-1]), axis=1) / (length[1:] * length[:-1])
    return bool(sines.min() > 0.05)


def check_second_order(item, r, v):
    """Gradient and curvature against eighth-order differences of the value."""
    h = 0.004 / max(np.abs(v).max(), 1.0)
    start = item.measure(r, 0.0)

    def rise(s):
        change = item.measure(r + s * v, 0.0) - start
        return change - (0 if item.period is None else item.period * np.round(change / item.period))

    first = sum(c * (rise(k * h) - rise(-k * h)) for k, c in ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))) / h
    second = (
        sum(c * (rise(k * h) + rise(-k * h)) for k, c in ((1, 8 / 5), (2, -1 / 5), (3, 8 / 315), (4, -1 / 560))) / h**2
    )
    slope = np.einsum("kai,kai->k", item.gradient(r, 0.0), v)
    curvature = item.curvature(r, v, 0.0)
    size = np.abs(v).max()
    assert np.allclose(slope, first, rtol=1e-7, atol=1e-7 * max(size, 1))
    assert np.allclose(curvature, second, rtol=1e-5, atol=1e-5 * max(size, 1) ** 2)


@given(x=POINTS, v=POINTS)
def test_derivatives_at_random_positions(x, v):
    assume(well_shaped(x))
    check_second_order(Distance([[0, 1]]), x[None, :2], v[None, :2])
    check_second_order(Angle([[0, 1, 2]]), x[None, :3], v[None, :3])
    check_second_order(Dihedral([[0, 1, 2, 3]]), x[None], v[None])


@given(
    x=POINTS,
    turn=arrays(np.float64, 3, elements=st.floats(-3, 3)),
    shift=arrays(np.float64, 3, elements=st.floats(-9, 9)),
)
def test_rigid_motion_changes_nothing(x, turn, shift):
    assume(well_shaped(x))
    skew = np.cross(np.eye(3), turn)
    q, _ = np.linalg.qr(np.eye(3) + skew)
    rotation = q * np.sign(np.linalg.det(q))
    y = x @ rotation.T + shift
    for item, width in ((Distance([[0, 1]]), 2), (Angle([[0, 1, 2]]), 3), (Dihedral([[0, 1, 2, 3]]), 4)):
        change = item.measure(y[None, :width], 0.0) - item.measure(x[None, :width], 0.0)
        if item.period is not None:
            change -= item.period * np.round(change / item.period)
        assert np.abs(change).max() < 1e-11
        # Forces along the gradient exert neither force nor torque.
        g = item.gradient(x[None, :width], 0.0)[0]
        assert np.abs(g.sum(axis=0)).max() < 1e-11 * max(np.abs(g).max(), 1)
        assert np.abs(np.cross(x[:width], g).sum(axis=0)).max() < 1e-10 * max(np.abs(g).max(), 1)


@pytest.mark.parametrize("degrees", [0.001, 20.0, 90.0, 109.5, 170.0, 179.0, 179.9, 179.9999])
def test_angle_value_and_row_norm(degrees):
    r = bent(degrees)
    item = Angle([[0, 1, 2]])
    assert item.measure(r, 0.0)[0] == pytest.approx(np.radians(degrees), abs=1e-15, rel=1e-13)
    assert np.linalg.norm(item.gradient(r, 0.0)) == pytest.approx(
        np.sqrt(4 - 2 * np.cos(np.radians(degrees))), rel=1e-9
    )


def test_angle_row_norm_stays_of_order_one_where_the_cosine_vanishes():
    for degrees in (179.0, 179.9, 179.9999):
        norm = np.linalg.norm(Angle([[0, 1, 2]]).gradient(bent(degrees), 0.0))
        assert norm == pytest.approx(2.449, abs=5e-4)


@pytest.mark.parametrize("degrees", [60.0, 179.0, 179.9, 179.9999])
def test_in_plane_curvature_of_an_angle_near_180_degrees(degrees):
    """Against the arms' polar angles, which have no singularity in the plane."""
    r = bent(degrees, 1.3, 0.7)
    v = np.array([[[0.3, -0.4, 0], [0.1, 0.2, 0], [-0.5, 0.6, 0]]])
    expected = 0.0
    for end, sign in ((0, -1), (2, 1)):
        d, w = r[0, end] - r[0, 1], v[0, end] - v[0, 1]
        expected += sign * -2 * (d @ w) * (d[0] * w[1] - d[1] * w[0]) / (d @ d) ** 2
    assert Angle([[0, 1, 2]]).curvature(r, v, 0.0)[0] == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("degrees", [180.0, 0.0])
def test_straight_angle_is_refused_with_the_remedy(degrees):
    r = bent(degrees, 1.2, 0.9)[0]
    sentence = f"angle constraint singular at {degrees:g} deg, use a linear constraint.*row 0, Angle\\(0, 1, 2\\)"
    with pytest.raises(SingularGeometryError, match=sentence):
        ConstraintSet([Angle([[0, 1, 2]])], r, np.ones(3))
    with pytest.raises(SingularGeometryError, match=sentence):
        ConstraintSet([Angle([[0, 1, 2]], np.radians(degrees))], bent(100.0)[0], np.ones(3))


def test_almost_straight_angle_is_accepted():
    held = ConstraintSet([Angle([[0, 1, 2]])], bent(179.9999)[0], np.ones(3))
    assert held.target()[0] == pytest.approx(np.radians(179.9999), rel=1e-14)


def test_angle_in_degrees_is_refused():
    with pytest.raises(InputError, match=r"target 109.5 is no angle between 0 and pi; targets are in radian"):
        ConstraintSet([Angle([[0, 1, 2]], 109.5)], bent(100.0)[0], np.ones(3))


@pytest.mark.parametrize("target", [60.0, -60.0])
def test_dihedral_in_degrees_is_refused(target):
    item = Dihedral([[0, 1, 2, 3]], target)
    with pytest.raises(InputError, match=rf"{target:g} is over three turns, and in radian; give np\.radians"):
        ConstraintSet([item], twisted(30.0)[0], np.ones(4))
    ConstraintSet([Dihedral([[0, 1, 2, 3]], lambda t: target + t)], twisted(30.0)[0], np.ones(4))


@pytest.mark.parametrize("degrees", [-179.99, -90.0, -1e-3, 0.0, 30.0, 180.0])
def test_dihedral_has_the_sign_of_iupac(degrees):
    found = np.degrees(Dihedral([[0, 1, 2, 3]]).measure(twisted(degrees), 0.0)[0])
    assert (found - degrees + 180) % 360 - 180 == pytest.approx(0, abs=1e-12)


def test_dihedral_agrees_with_ase():
    from ase import Atoms

    x = np.random.default_rng(0).normal(size=(4, 3))
    ours = np.degrees(Dihedral([[0, 1, 2, 3]]).measure(x[None], 0.0)[0]) % 360
    assert ours == pytest.approx(Atoms("H4", x).get_dihedral(0, 1, 2, 3), abs=1e-10)


def test_dihedral_is_smooth_through_180_degrees():
    item = Dihedral([[0, 1, 2, 3]], np.radians(179.9))
    held = ConstraintSet([item], twisted(-179.9)[0], np.ones(4))
    assert held.value(twisted(-179.9)[0])[0] == pytest.approx(np.radians(0.2), rel=1e-10)
    assert held.value(twisted(179.8)[0])[0] == pytest.approx(np.radians(-0.1), rel=1e-10)


def test_dihedral_target_counts_modulo_two_pi():
    item = Dihedral([[0, 1, 2, 3]], np.radians(30.0) + 4 * np.pi)
    assert ConstraintSet([item], twisted(30.0)[0], np.ones(4)).value(twisted(30.0)[0])[0] == pytest.approx(0, abs=1e-13)


@pytest.mark.parametrize("three", [(0, 1, 2), (1, 2, 3)])
def test_dihedral_over_collinear_atoms_is_refused(three):
    x = twisted(50.0)[0]
    x[three[0] if three[0] == 0 else 3] = 2 * x[three[1]] - x[three[2]] if three[0] == 0 else 2 * x[2] - x[1]
    with pytest.raises(SingularGeometryError, match=r"atoms {}, {}, {} of row 0, Dihedral.*collinear".format(*three)):
        ConstraintSet([Dihedral([[0, 1, 2, 3]])], x, np.ones(4))


def test_coincident_atoms_are_named():
    x = np.array([[1.0, 2, 3], [1, 2, 3], [0, 0, 1], [0, 1, 0]])
    with pytest.raises(SingularGeometryError, match=r"atoms 0 and 1 coincide: distance gradient undefined \(row 1"):
        ConstraintSet([Distance([[2, 3], [0, 1]])], x, np.ones(4))
    with pytest.raises(SingularGeometryError, match="atoms 0 and 1 coincide: gradient of row 0, Angle"):
        ConstraintSet([Angle([[0, 1, 2]])], x, np.ones(4))
    with pytest.raises(SingularGeometryError, match="atoms 0 and 1 coincide: gradient of row 0, Dihedral"):
        ConstraintSet([Dihedral([[2, 0, 1, 3]])], x, np.ones(4))


@pytest.mark.parametrize("target", [0.0, -1.0])
def test_lengths_must_be_positive(target):
    x = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(InputError, match=rf"row 1, Distance\(2, 3\): target {target:g} is not positive") as caught:
        ConstraintSet([Distance([[0, 1], [2, 3]], [1.0, target])], x, np.ones(4))
    assert caught.value.atoms == (2, 3)
    with pytest.raises(InputError, match="is not positive"):
        ConstraintSet([Distance([[0, 1]], lambda t: target)], x, np.ones(4))


@pytest.mark.parametrize("target", [np.nan, np.inf])
def test_targets_must_be_finite(target):
    with pytest.raises(InputError, match="target of row 1 is not finite"):
        Distance([[0, 1], [2, 3]], [1.0, target])


def test_distance_curvature_far_from_the_origin_loses_only_what_rounding_takes():
    r = np.array([[[1e6, 0.0, 0.0], [1e6 + 1.0, 0.0, 0.0]]])
    v = np.array([[[0.0, 3.0, 0.0], [0.0, 0.0, 4.0]]])
    assert Distance([[0, 1]]).curvature(r, v, 0.0)[0] == pytest.approx(25.0, rel=1e-15)


def test_one_row_may_be_given_flat():
    assert Distance([3, 4]).atoms.tolist() == [[3, 4]]
    assert from_dict(Distance([3, 4], 1.5).todict()).target.tolist() == [1.5]
