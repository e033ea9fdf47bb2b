"""Systems whose cell can change, and what moves as one."""

from __future__ import annotations

import numpy as np
import pytest
from pressure_systems import METHANE, gas, no_force, placed

from kcons.constraints import CenterOfMass, Distance, DistanceDifference, FixedAtoms, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.thermostats import CellSystem
from kcons.thermostats.cells import find_pieces, require_periodic


def test_functions_see_the_present_cell_which_set_cell_alone_changes():
    system, x = gas(n=3, force=lambda x, t, h: x * h[0, 0], potential=lambda x, t, h: h[2, 2], stress=lambda x, t, h: h)
    assert system.forces(x, x, 0.0, 0) == pytest.approx(12 * x)
    cell = np.diag([11.0, 12, 13])
    cell[1, 0] = 2.0
    system.set_cell(cell, x)
    assert np.array_equal(system.motion.lattice[0], cell)
    assert np.array_equal(system.cell, cell)
    assert system.forces(x, x, 0.0, 0) == pytest.approx(11 * x)
    assert system.energy(x, 0.0, 0) == 13
    assert system.stress(x, 0.0)[0, 1] == system.stress(x, 0.0)[1, 0] == 1.0
    with pytest.raises(InputError, match="half the box"):
        system.set_cell(np.eye(3) * 1.5, x)
    assert np.array_equal(system.cell, cell) and np.array_equal(system.motion.lattice[0], cell)
    with pytest.raises(ValueError, match="read-only"):
        system.cell[0, 0] = 3.0


def test_a_pressure_is_an_energy_over_an_area_in_a_slab():
    """Whatever length the vector has that is not periodic."""
    x = np.array([[0.0, 0, 0], [1, 0, 0]])
    held = ConstraintSet(Distance([[0, 1]]), x, [1.0, 1.0], cell=[10.0, 10, 30], pbc=[True, True, False])
    system = CellSystem(Motion(held, x))
    state = system.initial_state(x)
    assert system.volume == pytest.approx(100)
    system.set_cell(np.diag([11.0, 10, 30]), x)
    assert system.volume == pytest.approx(110)
    system.enter(state)
    assert system.volume == pytest.approx(100)


@pytest.mark.parametrize("energy", [-np.inf, np.nan])
def test_an_energy_that_is_none(energy):
    system, x = gas(n=2, force=no_force, potential=lambda x, t, h: energy)
    with pytest.raises(NonFiniteError, match=f"{energy} at step 3") as caught:
        system.energy(x, 0.0, 3)
    assert caught.value.step == 3


ALL = np.ones(3, bool)


def system_of(rows, x, cell=12.0, pbc=True):
    held = ConstraintSet(rows, x, np.arange(1.0, len(x) + 1), cell=np.eye(3) * cell, pbc=pbc)
    return CellSystem(Motion(held, x))


def test_pieces_move_by_their_centers_and_keep_their_shape():
    """Wherever their atoms are stored."""
    system, x = gas(METHANE, 8)
    pieces = find_pieces(system, x, ALL)
    assert pieces.label.tolist() == np.repeat(np.arange(8), 5).tolist()
    assert pieces.moving.tolist() == [8, 8, 8]
    change = 0.1 * np.random.default_rng(1).standard_normal((3, 3))
    lattice = system.lattice
    y = x + pieces.moved(x, change, lattice)
    system.set_cell(lattice[0] @ (np.eye(3) + change), y)
    assert system.motion.constraint_set.value(y, 0.0) == pytest.approx(np.zeros(80), abs=1e-13)
    # Differences of centers scale, up to cell vectors.
    before, after = pieces.whole(x, lattice), pieces.whole(y, system.lattice)
    d = pieces.centers(after) - pieces.centers(before) @ (np.eye(3) + change)
    assert d == pytest.approx(np.zeros((8, 3)), abs=1e-13)
    m = system.masses.reshape(8, 5, 1)
    assert pieces.centers(before) == pytest.approx((m * before.reshape(8, 5, 3)).sum(1) / m.sum(1), abs=1e-13)
    assert pieces.mass == pytest.approx(m.sum((1, 2)))


def test_images_shift_with_the_cell():
    """An atom stored 3 cells away is so afterwards."""
    system, x = gas(n=4)
    far = x + np.array([3, -2, 0]) * 12.0 * (np.arange(8) % 3 == 0)[:, None]
    pieces = find_pieces(system, x, ALL)
    change = np.diag([0.05, -0.02, 0.01])
    lattice = system.lattice
    moved = far + pieces.moved(far, change, lattice) - x - pieces.moved(x, change, lattice)
    cells = moved @ np.linalg.inv(lattice[0] @ (np.eye(3) + change))
    assert cells == pytest.approx(np.round(cells), abs=1e-12)


def test_what_stays_is_not_stored_across_a_face_that_moves():
    """Its image would move, and with it what the row means."""
    x = METHANE + 3.0
    system = system_of([FixedAtoms([0]), Distance([[0, 1]])], x)
    x[1] += [0.0, 12.0, 0.0]
    pieces = find_pieces(system, x, ALL, held="stay")
    with pytest.raises(UnsupportedError, match="atom 1 is held in its place across a face of the cell"):
        pieces.moved(x, 0.1 * np.eye(3), system.lattice)
    assert not pieces.moved(x, np.diag([0.1, 0.0, 0.1]), system.lattice)[:2].any()


def test_bonds_tie_what_constraints_do_not():
    x = placed(METHANE, 2, 12.0, 3)
    system = system_of(Distance([[0, 1]]), x)
    assert len(find_pieces(system, x, ALL)) == 9
    bonds = [[0, 2], [0, 3], [0, 4], [5, 6]]
    pieces = find_pieces(system, x, ALL, bonds)
    assert len(pieces) == 5
    assert len(set(pieces.label[:5].tolist())) == 1
    with pytest.raises(InputError, match="molecules name atom 99"):
        find_pieces(system, x, ALL, [[0, 99]])


def test_lengths_of_a_difference_tie_their_own_atoms():
    """Two bonds whose lengths alone are compared move apart."""
    x = placed(METHANE, 2, 12.0, 3)
    label = find_pieces(system_of(DistanceDifference([[0, 1], [5, 6]]), x), x, ALL).label
    assert label[0] == label[1] != label[5] == label[6]
    assert len(set(label.tolist())) == 8
    assert len(find_pieces(system_of(DistanceDifference([[0, 1], [1, 5]]), x), x, ALL)) == 8


def test_planes_are_open_in_the_plane():
    x = placed(METHANE, 2, 12.0, 3)
    system = system_of([Plane([0, 6], [0, 0, 1]), Distance([[0, 1]])], x)
    with pytest.raises(UnsupportedError, match=r"Plane.* holds atom 0 in space along z"):
        find_pieces(system, x, ALL)
    pieces = find_pieces(system, x, np.array([True, True, False]))
    assert pieces.moving.tolist() == [9, 9, 7]
    assert find_pieces(system, x, ALL, held="stay").moving.tolist() == [9, 9, 7]
    oblique = system_of(Plane([0], [0, 1, 1]), x)
    assert find_pieces(oblique, x, ALL, held="stay").moving.tolist() == [10, 9, 9]


@pytest.mark.parametrize("row", [FixedAtoms([0]), Sphere([0], [50.0, 0, 0], 4.0), CenterOfMass([[0, 1, 2]])])
def test_what_is_held_in_space_is_refused_or_stays(row):
    x = np.concatenate([METHANE + 3.0, METHANE + 8.0])
    if isinstance(row, Sphere):
        x += [51.0, -3, -3]
        x[1] = x[0] + [0, 0.5, 1.0]
    system = system_of([row, Distance([[0, 1]])], x)
    with pytest.raises(UnsupportedError, match=r"holds atom 0 in space along x.*held='stay'"):
        find_pieces(system, x, ALL)
    pieces = find_pieces(system, x, ALL, held="stay")
    left = 7 if isinstance(row, CenterOfMass) else 8
    assert pieces.moving.tolist() == [left] * 3
    d = pieces.moved(x, 0.1 * np.eye(3), system.lattice)
    assert not d[0].any()
    assert d[5].any()


def test_nothing_is_left_to_move():
    x = placed(METHANE, 1, 12.0, 3)
    system = system_of(FixedAtoms(np.arange(5)), x)
    with pytest.raises(UnsupportedError, match="no piece"):
        find_pieces(system, x, ALL, held="stay")
    none = np.zeros((0, 3))
    empty = CellSystem(Motion(ConstraintSet([], none, np.zeros(0), cell=[5, 5, 5]), none))
    with pytest.raises(UnsupportedError, match="no atoms"):
        find_pieces(empty, none, ALL)


def test_a_framework_through_the_cell_is_refused():
    x = np.array([[1.0 + 3 * k, 6 + 0.9 * (k % 2), 5.0] for k in range(4)])
    ring = [[0, 1], [1, 2], [2, 3], [3, 0]]
    with pytest.raises(UnsupportedError, match=r"closes upon itself through the cell between atoms \d and \d"):
        find_pieces(system_of(Distance(ring), x), x, ALL)
    open_chain = system_of(Distance(ring[:3]), x)
    assert len(find_pieces(open_chain, x, ALL)) == 1
    with pytest.raises(UnsupportedError, match="closes upon itself"):
        find_pieces(open_chain, x, ALL, ring)


@pytest.mark.parametrize(
    ("cell", "pbc", "fits"),
    [
        ([[0, 0, 9.0], [9, 0, 0], [0, 9, 0]], (True, True, False), False),
        ([[0, 0, 9.0], [9, 0, 0], [0, 9, 0]], (False, True, True), True),
        ([[9.0, 0, 0], [2, 9, 0], [1, 3, 9]], (True, True, False), True),
        ([[9.0, 0, 1], [0, 9, 0], [0, 0, 9]], (True, True, False), False),
        ([[9.0, 0, 1], [0, 9, 0], [0, 0, 9]], True, True),
    ],
    ids=["turned", "turned, z open", "skewed", "tilted", "tilted, periodic"],
)
def test_what_is_periodic_along_an_axis_of_space(cell, pbc, fits):
    """Cells change along axes of space, whichever vectors lie there."""
    x = np.zeros((1, 3))
    system = CellSystem(Motion(ConstraintSet([], x, np.ones(1), cell=cell, pbc=pbc), x))
    axes = np.array([True, True, False])
    if fits:
        require_periodic(system, axes, "lateral")
    else:
        with pytest.raises(InputError, match="not periodic"):
            require_periodic(system, axes, "lateral")
