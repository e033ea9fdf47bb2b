"""Chains: their angles, and shapes that are not known."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison.test_systems import chain
from kcons.errors import InputError


@pytest.mark.parametrize(("shape", "angle"), [("zigzag", 112.0), ("175", 175.0), ("straight", 180.0)])
def test_chain_shapes(shape, angle):
    x = chain.positions(7, shape)
    bonds = np.diff(x, axis=0)
    np.testing.assert_allclose(np.linalg.norm(bonds, axis=1), chain.BOND, rtol=1e-14)
    cosine = np.sum(bonds[1:] * bonds[:-1], axis=1) / chain.BOND**2
    np.testing.assert_allclose(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 180.0 - angle, atol=1e-5)


def test_unknown_chain_shape():
    with pytest.raises(InputError, match="no chain shape 'bent'"):
        chain.build(4, shape="bent")
