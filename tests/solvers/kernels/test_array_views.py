"""Views of arrays that kernels do not count: the same numbers, at the same place."""

import numpy as np
from numba import njit

from kcons.solvers.kernels.array_views import bits, flat, halves, integers, lattice_piece, octets, piece


@njit
def write(room, header, k, value):
    part = piece(room, header, k)
    part[:] = value
    return len(part)


@njit
def numbers_and_bits(array):
    flat(array)[0] = 2.0
    return flat(array).sum(), bits(array)[0], len(bits(array))


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


def test_without_a_compiler_they_are_numpys():
    array = np.arange(6.0).reshape(2, 3)
    assert np.array_equal(flat(array), array.ravel())
    assert np.array_equal(bits(array), array.ravel().view(np.int64))


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
