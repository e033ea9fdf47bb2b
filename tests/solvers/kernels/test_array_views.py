"""Views of arrays that kernels do not count: the same numbers, at the same place."""

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from kcons.solvers.kernels.array_views import (
    at_first,
    at_piece,
    bits,
    flat,
    halves,
    integers,
    lattice_piece,
    none_of,
    octets,
    table_array,
)
from kcons.solvers.kernels.two_and_four_wide import load_double, store_double


@njit
def write(room, header, k, value):
    part = table_array(room, header, k)
    part[:] = value
    return len(part)


@njit
def numbers_and_bits(array):
    flat(array)[0] = 2.0
    return flat(array).sum(), bits(array)[0], len(bits(array))


@njit
def total_of(array):
    return flat(array).sum()


def test_pieces_of_a_room_are_written_in_place():
    room, header = np.zeros(10), np.array([1, 4, 4, 4, 6, 9])
    assert [write(room, header, k, 1.0 + k) for k in range(3)] == [3, 0, 3]
    assert room.tolist() == [0, 1, 1, 1, 0, 0, 3, 3, 3, 0]


def test_all_numbers_of_an_array_of_any_shape():
    array = np.arange(12.0).reshape(3, 4)
    total, first, count = numbers_and_bits(array)
    assert array[0, 0] == 2.0 and total == array.sum() and count == 12
    assert first == np.float64(2.0).view(np.int64)
    assert numbers_and_bits(np.ones((2, 3, 2)))[0] == 13.0


@njit
def beginnings(room, header, k):
    piece_of_room = at_piece(room, header, k)
    store_double(piece_of_room, 1, -1.0)
    return at_first(room)[0], piece_of_room[0], load_double(piece_of_room, 2), none_of(room).size


def test_where_arrays_and_their_pieces_begin():
    room, header = np.arange(10.0), np.array([1, 4, 4, 4, 6, 9])
    assert beginnings(room, header, 2) == (0.0, 6.0, 8.0, 0)
    assert room[7] == -1.0


@pytest.mark.parametrize("array", [np.arange(12.0).reshape(3, 4).T, np.arange(12.0).reshape(4, 3)[::2]])
def test_numbers_that_are_not_one_after_the_other_are_copied(array):
    before = array.copy()
    total, first, count = numbers_and_bits(array)
    assert total == before.sum() and count == array.size
    assert first == before[0, 0].view(np.int64) and np.array_equal(array, before)


def test_what_must_not_be_written_to_is_read():
    array = np.arange(3.0)
    array.flags.writeable = False
    assert total_of(array) == 3.0
    with pytest.raises(TypingError, match="readonly"):
        numbers_and_bits(array)


@njit
def memory(array):
    return integers(array), halves(array), octets(array)


@njit
def as_lattice(room, header, k):
    found = lattice_piece(room, header, k)
    found[1, 2, 0] += 100.0
    return found.sum()


def test_memory_as_integers_of_other_sizes():
    array = np.arange(5.0)
    for found, dtype in zip(memory(array), (np.int64, np.uint32, np.uint8), strict=True):
        assert found.dtype == dtype and np.array_equal(found, array.view(dtype))
        assert np.shares_memory(found, array)


def test_a_piece_as_a_lattice():
    room, header = np.arange(30.0), np.array([0, 4, 6, 24])
    assert as_lattice(room, header, 1) == np.arange(6.0, 24.0).sum() + 100.0
    assert room[6 + 9 + 6] == 121.0
