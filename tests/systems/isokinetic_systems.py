"""A system whose kinetic energy is kept in the tests, and the orders of the thermostat that keeps it."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Distance

ORDERS = pytest.mark.parametrize("order", [2, 4, 6])


def water_and_more():
    x = np.array([[0.0, 0, 0], [0.96, 0, 0], [-0.24, 0.93, 0], [1.5, 1.2, 0.7], [2.4, 1.4, 0.2]])
    rows = [Distance([[0, 1], [0, 2], [1, 2], [3, 4], [4, 3]])]
    return rows, x, [16.0, 1.0, 1.0, 3.0, 2.0]
