"""What solvers are asked, and how they go on from where they ended."""

import numpy as np
import pytest

from kcons.solvers.cluster_solver import Outcome, Request, resume


def solver(found, converged):
    """A solver that finds the same multipliers each time."""

    def positions(request, multipliers):
        request.changed[:] += 1.0
        if multipliers is not None:
            multipliers[:] = found
        return Outcome(converged, 0.0, 1, -1)

    return positions


@pytest.mark.parametrize("converged", [True, False])
def test_multipliers_of_another_round_add_up_where_it_converged(converged):
    request, total = Request(np.zeros((1, 3)), np.zeros((1, 3))), np.array([1.0, 2.0])
    assert resume(solver([0.5, -0.25], converged), request, total) == converged
    np.testing.assert_array_equal(total, [1.5, 1.75] if converged else [1.0, 2.0])
    np.testing.assert_array_equal(request.changed, 1.0)


def test_nobody_needs_to_ask_for_multipliers():
    assert resume(solver(0.0, True), Request(np.zeros((1, 3)), np.zeros((1, 3))), None)
