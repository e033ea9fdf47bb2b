"""Equilibria found from many starts, and their names."""

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.models.flows import Flow, Kind, Pendulum, Stability, equilibrium_at, find_equilibria
from kcons.models.growth import Hypercycle, Logistic, LotkaVolterra


def test_pendulum_alternates_between_stable_and_unstable():
    pendulum = Pendulum(1.3)
    found = find_equilibria(pendulum, [[-7.0, 7.0], [-2.0, 2.0]])
    assert [e.position[0] for e in found] == pytest.approx(np.pi * np.arange(-2, 3), abs=1e-10)
    for k, e in zip(range(-2, 3), found, strict=True):
        assert e.position == pytest.approx(pendulum.stationary_point(k), abs=1e-10)
        assert e.classification.kind is (Kind.CENTRE if k % 2 == 0 else Kind.SADDLE)
        wanted = [1.3j, -1.3j] if k % 2 == 0 else [1.3, -1.3]
        assert sorted(e.classification.eigenvalues, key=lambda z: (-z.real, -z.imag)) == pytest.approx(wanted, abs=1e-9)
        # The linear flow does not decide about a centre.
        assert e.classification.hyperbolic == (k % 2 == 1)


def test_lotka_volterra():
    model = LotkaVolterra(1.1, 0.4, 0.1, 0.4)
    found = find_equilibria(Flow(model.velocity, 2, model.jacobian), [[-1.0, 10.0], [-1.0, 10.0]])
    assert [e.position.tolist() for e in found] == [
        pytest.approx([0.0, 0.0], abs=1e-10),
        pytest.approx(model.equilibrium.tolist(), rel=1e-10),
    ]
    assert found[0].classification.kind is Kind.SADDLE
    assert sorted(found[0].classification.eigenvalues.real) == pytest.approx([-0.4, 1.1])
    assert found[1].classification.kind is Kind.CENTRE
    assert sorted(found[1].classification.eigenvalues.imag) == pytest.approx([-np.sqrt(0.44), np.sqrt(0.44)])


def test_logistic():
    model = Logistic(1.5, 0.75)
    found = find_equilibria(Flow(model.velocity, 1, model.jacobian), [[-1.0, 5.0]])
    assert [e.position[0] for e in found] == pytest.approx([0.0, 2.0], abs=1e-10)
    assert [e.classification.stability for e in found] == [Stability.UNSTABLE, Stability.ASYMPTOTIC]
    assert [e.classification.eigenvalues[0].real for e in found] == pytest.approx([1.5, -1.5])


def test_hypercycle_turns_unstable_with_five_species():
    system = Hypercycle(5).with_fixed_total()
    e = equilibrium_at(Flow(system.velocity, 5), np.full(5, 0.2))
    assert e.residual < 1e-15
    assert e.classification.stability is Stability.UNSTABLE
    wanted = Hypercycle(5).interior_eigenvalues()
    off = [min(abs(e.classification.eigenvalues - w)) for w in wanted]
    assert max(off) < 1e-9


def test_many_roots_by_differences():
    flow = Flow(lambda t, X: [np.sin(X[0]) * np.cos(X[1]), np.sin(X[1])], 2)
    found = find_equilibria(flow, [[-4.0, 4.0], [-4.0, 4.0]], starts=200)
    assert len(found) == 9
    assert max(e.residual for e in found) < 1e-12
    assert {e.classification.kind for e in found} == {Kind.NODE, Kind.SADDLE}


def test_none_where_there_is_none():
    assert find_equilibria(Flow(lambda t, X: [1.0 + X[0] ** 2], 1), [[-3.0, 3.0]]) == []


def test_root_of_higher_order():
    found = find_equilibria(Flow(lambda t, X: [X[0] ** 2], 1), [[-1.0, 1.0]], tolerance=1e-8)
    assert found
    assert all(abs(e.position[0]) < 1e-3 for e in found)
    assert found[0].classification.kind in (Kind.DEGENERATE, Kind.NODE)


@pytest.mark.parametrize(("box", "starts"), [([[0.0, 1.0]], 10), ([[1.0, 0.0], [0.0, 1.0]], 10), ([[0.0, 1.0]] * 2, 0)])
def test_bad_input_is_refused(box, starts):
    with pytest.raises(InputError):
        find_equilibria(Pendulum(), box, starts=starts)
