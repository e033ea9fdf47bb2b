"""Pairs and quads: rows of a matrix and points, against NumPy."""

import numpy as np
from numba import njit

from kcons.solvers.kernels import two_and_four_wide as narrow
from kcons.solvers.kernels.any_width import FLAGS


@njit(fastmath=set(FLAGS))
def small_things(a, table, out):
    p = narrow.pair(narrow.load_double(a, 0), narrow.load_double(a, 1))
    q = narrow.load_quad(a, 1)
    narrow.store_pair(out, 0, narrow.swapped(p))
    narrow.store_quad(out, 2, narrow.settled(p))
    narrow.store_double(out, 6, narrow.extract(q, 2))
    narrow.store_double(out, 7, narrow.dot(q, narrow.quad(2.0, 3.0, 4.0, np.nan)))
    return narrow.load_index(table, 1)


def test_pairs_and_quads():
    a, out = np.array([1.0, 2.0, 3.0, 5.0, 7.0]), np.full(9, -1.0)
    assert small_things(a, np.array([3, 4_000_000_000], np.uint32), out) == 4_000_000_000
    assert out.tolist() == [2.0, 1.0, 1.0, 2.0, 0.0, 0.0, 5.0, 2 * 2.0 + 3 * 3.0 + 4 * 5.0, -1.0]


@njit(fastmath=set(FLAGS))
def move(points, offset, by):
    before = narrow.load_point(points, offset)
    narrow.add_to_point(points, offset, before * 0.0 + narrow.load_quad(by, 0))
    return narrow.extract(before, 0), narrow.extract(before, 2), narrow.extract(before, 3)


def test_the_last_point_of_an_array():
    """Only its three numbers are read and written: the one behind it stays what it is."""
    room = np.append(np.arange(6.0), np.nan)
    points = room[:6].reshape(2, 3)
    assert move(points, 3, np.array([10.0, 20.0, 30.0, np.inf])) == (3.0, 5.0, 0.0)
    assert room[:6].tolist() == [0.0, 1.0, 2.0, 13.0, 24.0, 35.0] and np.isnan(room[6])


@njit(fastmath=set(FLAGS))
def write_lines(a, lines, out):
    r, s, t = narrow.load_quad(a, 0), narrow.load_quad(a, 4), narrow.load_quad(a, 8)
    narrow.store_line(lines, 0, r, s, narrow.pair(100.0, 200.0))
    narrow.store_line(lines, 8, r, s, narrow.pair(100.0, 200.0))
    narrow.store_first(lines, 8, t, narrow.pair(300.0, 400.0))
    narrow.store_quad(out, 0, narrow.first_vector(lines, 8))
    narrow.store_quad(out, 4, narrow.second_vector(lines, 8))


def test_lines_of_rows():
    """r0 s0 r1 s1 r2 s2 a b; r and the two numbers behind may be replaced."""
    a, lines, out = np.arange(12.0), np.zeros(16), np.full(8, -1.0)
    write_lines(a, lines, out)
    assert lines.tolist() == [0, 4, 1, 5, 2, 6, 100, 200, 8, 4, 9, 5, 10, 6, 300, 400]
    assert out.tolist() == [8, 9, 10, 0, 4, 5, 6, 0]
