"""Errors: caught as the built-in that fits, and carrying their data in plain numbers."""

from __future__ import annotations

import inspect
import pickle

import numpy as np
import pytest

from kcons import errors
from kcons.errors import (
    BudgetError,
    CertificateError,
    ConvergenceError,
    ImageError,
    InputError,
    KconsError,
    SingularGeometryError,
)

KINDS = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_one_root_beside_a_built_in(kind):
    assert issubclass(kind, KconsError)
    assert kind is KconsError or issubclass(kind, ValueError | RuntimeError | FloatingPointError)
    assert inspect.getdoc(kind)
    needed = {"budget": 1.0, "consistent": 1.0, "time": 1.0} if kind is BudgetError else {}
    error = kind("what, and what to do", **needed)
    assert str(error) == "what, and what to do"


def test_data_are_plain_numbers():
    error = InputError("no", item="masses", atoms=np.array([3, 4]))
    assert error.item == "masses" and error.atoms == (3, 4) and type(error.atoms[0]) is int
    error = SingularGeometryError("no", rows=np.array([2]), atoms=(np.int64(1),))
    assert error.rows == (2,) and error.atoms == (1,) and type(error.rows[0]) is int
    assert ImageError("no", atoms=np.arange(2)).atoms == (0, 1)
    error = CertificateError("no", row=3, residual=1e-3, atoms=[7])
    assert (error.row, error.residual, error.atoms, error.step, error.state) == (3, 1e-3, (7,), None, None)


def test_what_is_not_known_has_a_value_that_says_so():
    error = ConvergenceError("no")
    assert np.isnan(error.residual) and np.isnan(error.tolerance)
    assert (error.row, error.cluster, error.atoms, error.step, error.singular) == (-1, -1, (), None, False)
    assert InputError("no").item == "" and InputError("no").atoms == ()


def test_a_budget_says_what_the_start_allows():
    error = BudgetError("no", budget=2.0, consistent=1.5, time=7.0)
    assert (error.budget, error.consistent, error.time) == (2.0, 1.5, 7.0)


def test_errors_come_back_from_other_processes():
    error = pickle.loads(pickle.dumps(ConvergenceError("no", row=4, atoms=[1, 2], step=9)))
    assert str(error) == "no" and (error.row, error.atoms, error.step) == (4, (1, 2), 9)
