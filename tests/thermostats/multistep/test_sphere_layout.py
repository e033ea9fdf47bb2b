"""Which velocities share a sphere, and with how many degrees of freedom."""

from __future__ import annotations

import numpy as np
import pytest
from thermostat_systems import METHANE, TEN, molecules, system

from kcons.constraints import CenterOfMass, Distance, FixedAtoms, LinearRelation, LinearVelocity, Plane, Sphere
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.thermostats.multistep.spheres import SphereLayout, refuse_driven

X = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.0, 1.2, 0], [6.0, 0.5, 0.2]])
MASSES = np.array([1.0, 2.0, 3.0, 4.0, 5.0])


def freedom(rows, kind="split", x=X, masses=MASSES):
    held = system(rows, x, masses)
    return SphereLayout.of(held, x, kind).freedom.tolist()


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [("split", [3, 2, 3, 2, 3]), ("axes", [1, 1, 1, 2] * 2 + [1, 1, 1]), ("cluster", [5, 5, 3]), ("global", [13])],
)
def test_two_dumbbells_and_a_free_atom(kind, wanted):
    assert freedom([Distance([[0, 1], [2, 3]])], kind) == wanted


@pytest.mark.parametrize("kind", ["split", "axes", "cluster", "global"])
def test_spheres_share_out_all_degrees_of_freedom(kind):
    for name in ("bent", "triangles", "tetrahedra"):
        held, state = molecules(name, 3, ions=2)
        layout = SphereLayout.of(held, state.positions, kind)
        assert layout.freedom.sum() == held.motion.degrees_of_freedom
        assert layout.totals.sum() == pytest.approx(held.masses.sum())


def test_dependent_rows_count_by_rank():
    """Ten distances of five atoms hold nine; beside an independent cluster and few constrained atoms among many."""
    x = np.vstack([METHANE, METHANE[:3] + 4.0, 9.0 + np.arange(60.0).reshape(20, 3)])
    rows = np.array([*TEN, (5, 6), (6, 7)])
    held = system([Distance(rows)], x, np.ones(len(x)))
    layout = SphereLayout.of(held, x, "cluster")
    assert sorted(layout.freedom.tolist()) == [3] * 20 + [6, 7]


def test_a_cluster_that_is_tied_to_space_has_one_sphere():
    assert freedom([Plane([0], [0, 0, 1.0]), Distance([[0, 1]])]) == [4, 3, 3, 3]
    assert freedom([Sphere([2], [3.0, 0, 1.0], 1.0)], "axes") == [2] + [1] * 12


def test_fixed_atoms_have_none_and_tie():
    rows = [FixedAtoms([0]), Distance([[0, 1], [2, 3]])]
    held = system(rows, X, MASSES)
    layout = SphereLayout.of(held, X, "split")
    assert layout.freedom.tolist() == [2, 3, 2, 3]
    assert layout.cluster[0] == -1 and layout.masses[0] == 0


def test_rows_that_join_clusters_make_them_one():
    joined = [Distance([[0, 1], [2, 3]]), CenterOfMass([0, 1, 2, 3])]
    assert freedom(joined) == [3 * 4 - 2 - 3, 3]
    assert freedom([Distance([[0, 1], [2, 3], [1, 2]])]) == [3, 6, 3]


def test_the_motion_about_the_center_may_be_held_whole():
    """Without a degree of freedom about it a cluster has the sphere of its center only."""
    assert freedom([LinearRelation(0, [1], [1.0], None)]) == [3, 3, 3, 3]


def test_nothing_moves():
    with pytest.raises(OverdeterminedError, match="no degree of freedom is left"):
        freedom([FixedAtoms(range(5))])


def test_radii_and_the_sphere_without_one():
    held = system([Distance([[0, 1], [2, 3]])], X, MASSES)
    layout = SphereLayout.of(held, X, "split")
    np.testing.assert_allclose(layout.squares(0.5, 2), 0.5 * np.array([4, 3, 4, 3, 4]))
    axes = SphereLayout.of(held, X, "axes")
    with pytest.raises(InputError, match="9 spheres of one degree of freedom and no auxiliary"):
        axes.squares(0.5, 0)


def test_driven_rows_are_refused():
    held = system([Distance([[0, 1]], lambda t: 1 + 0.1 * t)], X, MASSES)
    with pytest.raises(UnsupportedError, match="Distance has a target that moves"):
        SphereLayout.of(held, X, "split")
    rolling = system([LinearVelocity([0], [[1.0, 0, 0]])], X, MASSES)
    with pytest.raises(UnsupportedError, match="LinearVelocity holds velocities"):
        refuse_driven(rolling)
