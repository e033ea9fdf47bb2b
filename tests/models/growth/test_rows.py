"""Rows: their gradients, rates, targets, and what they refuse."""

import numpy as np
import pytest

from kcons.errors import ConstraintError, InputError
from kcons.models.growth import (
    ConstrainedGrowth,
    GrowthModel,
    HolonomicRow,
    LinearRow,
    Populations,
    TotalPopulation,
    VelocityRow,
    solve,
)
from kcons.models.growth.rows import relative_differences

P = Populations.from_values(0.3, [0.5, 1.5, 2.5])
MANY = Populations.from_values(np.array([0.3, 0.7]), [[0.5, 1.0], [1.5, 2.0], [2.5, 0.2]])


def product(t, x):
    return x[0] * x[1] ** 2 * np.exp(-t) + np.sin(x[2])


def product_gradient(t, x):
    return np.array([x[1] ** 2 * np.exp(-t), 2 * x[0] * x[1] * np.exp(-t), np.cos(x[2])])


def test_differences_agree_with_the_gradient():
    row = HolonomicRow(product)
    assert row.gradient(P) == pytest.approx(product_gradient(0.3, P.x), rel=1e-12)
    assert relative_differences(row.measure, MANY)[:, 1] == pytest.approx(
        product_gradient(0.7, MANY.x[:, 1]), rel=1e-12
    )


def test_gradient_by_its_taylor_remainder():
    row = HolonomicRow(product, product_gradient)
    direction = np.array([0.3, -0.2, 0.5])
    slope = row.gradient(P) @ direction
    left = [
        row.measure(Populations.from_values(0.3, P.x + h * direction)) - row.measure(P) - h * slope
        for h in (1e-3, 5e-4)
    ]
    assert left[0] / left[1] == pytest.approx(4.0, rel=1e-2)


def test_rate_is_minus_the_time_derivative():
    row = HolonomicRow(product, product_gradient, lambda t, x: -x[0] * x[1] ** 2 * np.exp(-t))
    assert row.rate(P) == pytest.approx(0.5 * 1.5**2 * np.exp(-0.3))
    assert HolonomicRow(product).rate(P) == 0.0


def test_target_is_what_the_start_gives():
    row = HolonomicRow(product, None, lambda t, x: -x[0] * x[1] ** 2 * np.exp(-t)).bind(P)
    assert row.value(P) == 0.0
    with pytest.raises(ConstraintError, match="no target"):
        HolonomicRow(product).value(P)
    many = TotalPopulation(3).bind(MANY)
    assert many.target.tolist() == pytest.approx([4.5, 3.2])
    assert many.take(np.array([1])).target.tolist() == pytest.approx([3.2])


def test_moving_target():
    row = LinearRow([1.0, 2.0, 0.0], lambda t: (3.0 + t, 1.0))
    assert row.value(P) == pytest.approx(3.5 - 3.3)
    assert row.rate(P) == 1.0
    assert row.rate(MANY).tolist() == [1.0, 1.0]


def test_velocity_row():
    row = VelocityRow(lambda t, x: [t, x[0], 1.0], lambda t, x: x[1])
    assert row.gradient(MANY).T.tolist() == [[0.3, 0.5, 1.0], [0.7, 1.0, 1.0]]
    assert row.rate(MANY).tolist() == [1.5, 2.0]
    assert VelocityRow([1.0, 0.0, 2.0], 0.5).gradient(MANY)[:, 1].tolist() == [1.0, 0.0, 2.0]


def test_start_off_a_row_is_refused():
    model = GrowthModel(lambda t, x: x, n=3)
    system = ConstrainedGrowth(model, [TotalPopulation(3), LinearRow([1.0, 0.0, 0.0], 0.7)])
    with pytest.raises(ConstraintError, match=r"off row 1 \(linear row\)") as caught:
        solve(system, (0.0, 1.0), [0.5, 0.3, 0.2])
    assert caught.value.rows == (1,)


@pytest.mark.parametrize(
    "make",
    [
        lambda: LinearRow([0.0, 0.0]),
        lambda: LinearRow([1.0, np.nan]),
        lambda: LinearRow([[1.0]]),
        lambda: LinearRow([1.0], np.inf),
        lambda: TotalPopulation(0),
        lambda: VelocityRow([1.0], np.nan),
        lambda: HolonomicRow(product, target="x"),
        lambda: TotalPopulation(2).gradient(P),
        lambda: VelocityRow([1.0]).gradient(P),
    ],
)
def test_bad_rows_are_refused(make):
    with pytest.raises(InputError):
        make()


@pytest.mark.parametrize("p", [P, MANY])
def test_derivatives_that_contradict_their_function_are_refused(p):
    def rate(t, x):
        return -x[0] * x[1] ** 2 * np.exp(-t)

    HolonomicRow(product, product_gradient, rate, vectorized=True).bind(p)
    for gradient, given, said in (
        (lambda t, x: 1.1 * product_gradient(t, x), rate, "gradient of holonomic row: 1.83"),
        (product_gradient, None, "depends on time, but has no time_derivative"),
        (product_gradient, lambda t, x: -rate(t, x), "another time_derivative"),
    ):
        with pytest.raises(InputError, match=said):
            HolonomicRow(product, gradient, given, vectorized=True).bind(p)
    LinearRow([1, 1, 1], lambda t: (1 + 0.1 * t, 0.1)).bind(p)
    with pytest.raises(InputError, match="another rate of its target"):
        LinearRow([1, 1, 1], lambda t: (1 + 0.1 * t, -5.0)).bind(p)
    with pytest.raises(InputError, match=r"give \(value, rate\)"):
        LinearRow([1, 1, 1], lambda t: 1 + 0.1 * t).bind(p)


def hill(power: int, *, given: bool = False) -> HolonomicRow:
    gradient = lambda t, x: [power * x[0] ** (power - 1) / (1 + x[0] ** power) ** 2, 1.0]  # noqa: E731
    return HolonomicRow(lambda t, x: x[0] ** power / (1 + x[0] ** power) + x[1], gradient if given else None)


@pytest.mark.parametrize("power", [20, 60, 100])
def test_differences_of_what_changes_fast_keep_their_digits(power: int) -> None:
    p = Populations.from_values(0.0, [1.02, 0.3])
    found, exact = (hill(power, given=given).gradient(p) for given in (False, True))
    np.testing.assert_allclose(found, exact, rtol=2e-7)


def test_differences_that_cannot_serve_are_refused() -> None:
    """And derivatives that are right are not, only since differences are too coarse for them."""
    p = Populations.from_values(0.0, [1.02, 0.3])
    with pytest.raises(InputError, match="changes too fast with species 0"):
        hill(400).bind(p)
    hill(400, given=True).bind(p)
    fast = TotalPopulation(2, lambda t: (1.32 + 1e-3 * np.sin(1e5 * t), 1e2 * np.cos(1e5 * t)))
    fast.bind(p)
    with pytest.raises(InputError, match="another rate of its target"):
        TotalPopulation(2, lambda t: (1.32 + 1e-3 * np.sin(1e5 * t), 2e2 * np.cos(1e5 * t))).bind(p)


def test_functions_of_rows_are_looked_at_early() -> None:
    for make in (
        lambda: VelocityRow(lambda x: x),
        lambda: VelocityRow([1.0, 0.0], lambda: 0.0),
        lambda: TotalPopulation(2, lambda: (1.0, 0.0)),
    ):
        with pytest.raises(InputError, match="is called with"):
            make()
    with pytest.raises(InputError, match="target is no array of numbers"):
        TotalPopulation(2, lambda t: ("a", "b")).bind(Populations.from_values(0.0, [0.5, 0.5]))
