"""What every family owes: derivatives that agree, selections, copies, plain data. All families at once."""

from __future__ import annotations

import copy
import json
import pickle

import numpy as np
import pytest
from constraint_cases import CASES, MASSES, N_ATOMS, TIME, scattered

from kcons import Motion
from kcons.constraints import Constraint, Distance, MovingTarget, from_dict
from kcons.constraints.constraint import FAMILIES, constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, UnsupportedError

STEPS = 2.0 ** -np.arange(5, 9)


def made(name: str):
    item = CASES[name]()
    return item.with_masses(MASSES[item.atoms])


def slopes(remainder: np.ndarray, round_off: float) -> np.ndarray:
    """Order in the step of each column; infinite where nothing is left but round-off."""
    found = [np.polyfit(np.log(STEPS), np.log(np.maximum(column, 1e-300)), 1)[0] for column in remainder.T]
    return np.where(remainder.max(axis=0) < round_off, np.inf, found)


def test_cases_cover_every_family():
    assert {CASES[name]().family for name in CASES} == {
        name for name, family in FAMILIES.items() if family.__module__.startswith("kcons.")
    }


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_gradient_and_curvature_by_taylor_remainder(name, seed):
    """Halving the step divides the odd remainder by 8 after the gradient, the even one by 16 after the curvature.

    The even and odd parts of f(h) = q(r + h v, t + h) keep the orders apart, so that slopes show from
    moderate steps on. Velocity rows: f(h) = a(r + h v, t + h) . v, and the curvature is f'(0).
    """
    item = made(name)
    r = scattered(seed)[item.atoms]
    v = np.random.default_rng(seed + 100).normal(size=(N_ATOMS, 3))[item.atoms]

    def f(h):
        if item.holonomic:
            return item.measure(r + h * v, TIME + h)
        return np.einsum("kai,kai->k", item.gradient(r + h * v, TIME + h), v)

    def change(h):
        difference = f(h) - f(0.0)
        return difference if item.period is None else difference - item.period * np.round(difference / item.period)

    ahead, behind = (np.array([change(sign * h) for h in STEPS]) for sign in (1, -1))
    step = STEPS[:, None]
    rate, second = item.time_terms(r, v, TIME)
    curvature = item.curvature(r, v, TIME) + second
    slope = np.einsum("kai,kai->k", item.gradient(r, TIME), v) + rate if item.holonomic else curvature
    assert np.all(slopes(np.abs((ahead - behind) / 2 - step * slope), 1e-12) > 2.9)
    if item.holonomic:
        assert np.all(slopes(np.abs((ahead + behind) / 2 - step**2 / 2 * curvature), 1e-12) > 3.8)


@pytest.mark.parametrize("name", CASES)
def test_selected_and_renumbered_rows_behave_like_the_rows(name):
    item, new_index, x, v = made(name), np.random.default_rng(3).permutation(N_ATOMS), scattered(1), scattered(2)
    rows = np.arange(item.n_rows)[::-1][: max(1, item.n_rows - 1)]
    part, full = item.select(rows), x[item.atoms]
    other, moved = part.renumbered(new_index), x[np.argsort(new_index)]
    assert np.array_equal(part.atoms, item.atoms[rows])
    assert np.array_equal(other.measure(moved[other.atoms], TIME), part.measure(x[part.atoms], TIME))
    some, u = x[part.atoms], v[part.atoms]
    assert np.allclose(part.measure(some, TIME), item.measure(full, TIME)[rows], rtol=1e-15, atol=1e-15)
    assert np.allclose(part.gradient(some, TIME), item.gradient(full, TIME)[rows], rtol=1e-14, atol=1e-15)
    curvature = item.curvature(full, v[item.atoms], TIME)[rows]
    assert np.allclose(part.curvature(some, u, TIME), curvature, rtol=1e-9, atol=1e-11)
    assert np.array_equal(part.parameters(), item.parameters()[rows])
    assert item.target is None or np.array_equal(part.target_at(TIME), item.target_at(TIME)[rows])
    assert np.array_equal(item.atoms, CASES[name]().atoms), "the original must stay as it was"


@pytest.mark.parametrize("name", CASES)
def test_plain_data_round_trip(name):
    item = made(name)
    if isinstance(item.target, MovingTarget) or any(getattr(item, f) is not None for f in item.functions):
        with pytest.raises(InputError, match=r"cannot be written to a file.*attach it again"):
            item.todict()
        return
    x = scattered(1)
    held = ConstraintSet([item], x, MASSES, time=TIME).constraints[0]
    again = from_dict(json.loads(json.dumps(held.todict()))).with_masses(MASSES[held.atoms])
    r = x[held.atoms]
    assert type(again) is type(held)
    assert np.array_equal(again.atoms, held.atoms)
    assert np.array_equal(again.target, held.target)
    assert np.array_equal(again.measure(r, TIME), held.measure(r, TIME))
    assert np.array_equal(again.gradient(r, TIME), held.gradient(r, TIME))
    assert (again.kind, again.translation_invariant) == (held.kind, held.translation_invariant)
    assert again.todict() == held.todict()


@pytest.mark.parametrize("name", CASES)
def test_common_shift_changes_only_rows_that_say_so(name):
    item = made(name)
    r = scattered(1)[item.atoms]
    shifted = r + np.array([0.3, -0.2, 0.5])
    unchanged = np.allclose(item.gradient(shifted, TIME), item.gradient(r, TIME), atol=1e-12)
    if item.holonomic:
        unchanged = unchanged and np.allclose(item.measure(shifted, TIME), item.measure(r, TIME), atol=1e-12)
    if item.translation_invariant:
        assert unchanged
    elif item.holonomic:
        assert not unchanged


def test_one_constraint_or_several():
    row = Distance([[0, 1]])
    assert constraints_in(row, "held") == [row] == constraints_in(iter([row]), "held")
    with pytest.raises(InputError, match=r"held has None, which is no kcons constraint"):
        constraints_in([row, None], "held")


@pytest.mark.parametrize("name", CASES)
def test_arrays_cannot_be_changed(name):
    """Engines have copies of what stands in them, and would not notice."""
    item = made(name)
    others = [item, item.select([0]), item.renumbered(np.arange(N_ATOMS)), item.with_target(None), copy.deepcopy(item)]
    try:
        others += [from_dict(item.todict()), pickle.loads(pickle.dumps(item))]
    except (InputError, AttributeError, TypeError, pickle.PicklingError):
        assert item.functions or item.moving  # they hold functions of Python
    for each in others:
        arrays = {name: value for name, value in vars(each).items() if isinstance(value, np.ndarray)}
        assert {"atoms", *item.per_row} <= set(arrays)
        assert not [name for name, value in arrays.items() if value.flags.writeable]
    with pytest.raises(ValueError, match="read-only"):
        item.atoms[0, 0] = 1


class Height(Constraint):
    """A family of a user's own, in three lines: its data are what `row` finds in p."""

    row_width = 1
    per_row = {"factor": ()}

    @staticmethod
    def row(r, p, t, out):
        out[0], out[1], out[2], out[3] = p[0] * r[2] * r[2], 0.0 * r[0], 0.0 * r[0], 2.0 * p[0] * r[2]


def test_a_family_of_ones_own_is_compiled_and_kept_in_files():
    x = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 2.0]])
    motion = Motion(ConstraintSet(Height([[0], [1]], factor=[1.0, 0.5]), x, np.ones(2)), x)
    assert motion.constraint_set.target().tolist() == [9.0, 2.0]
    assert motion.project_positions(x + 0.1, x)[:, 2] == pytest.approx([3.0, 2.0], abs=1e-14)
    assert motion.acceleration(x, np.ones((2, 3)), np.zeros((2, 3)))[:, 2] == pytest.approx([-1 / 3, -1 / 2], abs=1e-14)
    assert type(from_dict(Height([[0]], 4.0, factor=1.0).todict())) is Height


@pytest.mark.parametrize(("slope", "speed", "item"), [(1.5, -2.0, "row"), (2.0, None, "rate"), (2.0, -1.0, "rate")])
def test_wrong_derivatives_of_a_family_of_ones_own_are_refused(slope, speed, item):
    def row(r, p, t, out):
        out[0], out[1], out[2], out[3] = r[2] * r[2] - 2.0 * t, 0.0 * r[0], 0.0 * r[0], slope * r[2]

    own = {"row": staticmethod(row), "rate": speed and staticmethod(lambda r, p, t, out: out.fill(speed))}
    with pytest.raises(InputError, match=f"a derivative of `{item}` gives"):
        ConstraintSet(type("Raised", (Constraint,), own)([[0]]), np.ones((1, 3)), [1.0], time=0.3)


# -- in another unit of length ----------------------------------------------------------------------

#: The power with which lengths stand in what is held, of the cases for which it is known.
POWERS = {name: int(item.held == "length") for name, make in CASES.items() if (item := make()).held and not item.moving}


@pytest.mark.parametrize("name", POWERS)
def test_the_same_points_fulfil_it(name):
    x = scattered(0)
    bound = ConstraintSet(CASES[name]().with_target(None), x, MASSES).constraints[0]
    scaled = bound.rescaled(0.1)
    held = ConstraintSet(scaled, x / 10, MASSES)
    assert np.abs(held.value(x / 10)).max() < 1e-15
    # Elsewhere both are off, by lengths that scale and angles that do not.
    y = x + 0.1 * np.random.default_rng(2).normal(size=x.shape)
    off = ConstraintSet(bound, x, MASSES).value(y)
    assert np.abs(off).max() > 1e-3
    np.testing.assert_allclose(held.value(y / 10), 0.1 ** POWERS[name] * off, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("name", sorted(CASES.keys() - POWERS))
def test_what_has_no_known_units_is_refused(name):
    item = CASES[name]()
    with pytest.raises(UnsupportedError, match="target that moves" if item.moving else "unit of its own"):
        item.rescaled(0.1)
