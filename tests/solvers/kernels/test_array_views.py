"""Views of arrays that kernels do not count: the same numbers, at the same place."""

import numpy as np
from numba import njit

from kcons.solvers.kernels.array_views import bits, flat, piece


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
