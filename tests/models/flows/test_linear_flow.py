"""exp(At), defective and stiff matrices included."""

import numpy as np
import pytest
from flow_reference import case

from kcons.models.flows import Kind, LinearFlow, Stability, jordan_block, jordan_block_propagator

CASES = ["A12_linear_generic", "A12_linear_jordan3", "A12_linear_nilpotent", "A12_linear_stiff"]


@pytest.mark.parametrize("name", CASES)
def test_reference(name):
    given = case(name)
    found = LinearFlow(given["A"]).exact(given["times"], given["initial"]["x"])
    wanted = np.array(given["reference"]["x"])
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert abs(found - wanted).max() < 1e-10 * size.max()
    assert np.all(abs(found - wanted) < 1e-10 * size)


def test_structure_of_the_reference():
    blocks = LinearFlow(case("A12_linear_jordan3")["A"]).jordan_blocks()
    assert [b.sizes for b in blocks] == [(3,)]
    assert LinearFlow(case("A12_linear_nilpotent")["A"]).jordan_blocks()[0].sizes == (3,)
    assert LinearFlow(case("A12_linear_nilpotent")["A"]).classification().stability is Stability.UNSTABLE
    assert LinearFlow(case("A12_linear_generic")["A"]).classification().kind is Kind.SADDLE
    assert LinearFlow(case("A12_linear_stiff")["A"]).classification().stability is Stability.ASYMPTOTIC


@pytest.mark.parametrize("size", [1, 2, 4])
def test_one_block_in_closed_form(size):
    J = jordan_block(-0.3, size)
    assert LinearFlow(J).propagator(2.5) == pytest.approx(jordan_block_propagator(-0.3, size, 2.5), rel=1e-13)


def test_series_and_group_property():
    A = np.random.default_rng(2).normal(size=(3, 3))
    flow = LinearFlow(A)
    series, term = np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ A * 0.7 / k
        series = series + term
    assert flow.propagator(0.7) == pytest.approx(series, rel=1e-13)
    assert flow.propagator(0.3) @ flow.propagator(0.4) == pytest.approx(series, rel=1e-12)
    assert flow.propagator(0.7) @ flow.propagator(-0.7) == pytest.approx(np.eye(3), abs=1e-13)


def test_integration_agrees():
    flow = LinearFlow(case("A12_linear_generic")["A"])
    X0 = np.array(case("A12_linear_generic")["initial"]["x"])
    assert flow.solve((0.0, 5.0), X0).y[:, -1] == pytest.approx(flow.exact(5.0, X0), rel=1e-8)
    assert flow.divergence(0.0, X0) == pytest.approx(np.trace(flow.matrix))
