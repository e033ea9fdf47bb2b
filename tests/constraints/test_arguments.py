"""Arrays from outside: what is refused, wherever it comes in, and what functions of the user can do to those lent."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from kcons.constraints import (
    Custom,
    Distance,
    Ellipsoid,
    FixedAtoms,
    Line,
    LinearCombination,
    LinearRelation,
    Plane,
    Sphere,
)
from kcons.constraints.arguments import (
    as_array,
    as_float_array,
    check_call,
    finite_number,
    generator_of,
    positive,
    read_only_view,
    seed_from,
    whole_number,
)
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.motion import Motion
from kcons.steppers import BlanesMoan6, BlanesMoan6a, Geodesic, Rattle, State, Suzuki4, System, run
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain, thermal_velocities

X = np.array([[0.9, 0.0, -0.4], [1.5, 0.0, 0.1], [2.0, 0.3, -0.2]])
MASSES = np.array([1.0, 0.7, 2.0])
PULL = np.outer(MASSES, [0.0, 0.0, -1.0])


def spoilt(values) -> dict[str, object]:
    """The same numbers as they must not come in."""
    array = np.asarray(values, dtype=float)
    return {
        "complex": array + 0j,
        "object": array.astype(object),
        "masked": np.ma.masked_array(array, np.zeros(array.shape, dtype=bool)),
        "masked rows": [np.ma.masked_array(row, np.zeros(row.shape, dtype=bool)) for row in np.atleast_2d(array)],
        "text": array.astype(str),
    }


KINDS = list(spoilt(X))
SAID = {"complex": "has complex numbers", "masked": "masked", "masked rows": "masked"}


def held(rows=None) -> Motion:
    rows = [Sphere(0, np.zeros(3)), Distance([[0, 1], [1, 2]])] if rows is None else rows
    return Motion(ConstraintSet(rows, X, MASSES), X)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return held()


def test_real_numbers_come_in_as_float64_and_only_copied_where_kernels_need_it() -> None:
    for values in (X.tolist(), X.astype(np.float32), (10 * X).astype(int), np.asfortranarray(X), X[::-1]):
        array = as_array(values, X.shape, "places")
        assert array.dtype == np.float64 and array.flags.carray
        np.testing.assert_array_equal(array, np.asarray(values))
    assert as_array(X, X.shape, "places") is X and as_float_array(X, "places") is X
    assert as_array(read_only_view(X), X.shape, "places").flags.writeable  # or Numba would compile for it once more


WAYS = {
    "positions of a set": lambda m, bad: ConstraintSet([Distance([0, 1])], bad, MASSES),
    "masses": lambda m, bad: ConstraintSet([Distance([0, 1])], X, bad),
    "cell": lambda m, bad: ConstraintSet([Distance([0, 1])], X, MASSES, cell=bad),
    "value of a set": lambda m, bad: m.constraint_set.value(bad),
    "jacobian of a set": lambda m, bad: m.constraint_set.jacobian(bad),
    "positions of an engine": lambda m, bad: Motion(m.constraint_set, bad),
    "project_positions": lambda m, bad: m.project_positions(bad, X),
    "project_positions, reference": lambda m, bad: m.project_positions(X, bad),
    "restore_positions": lambda m, bad: m.restore_positions(bad),
    "project_velocities": lambda m, bad: m.project_velocities(X, bad),
    "acceleration": lambda m, bad: m.acceleration(X, X, bad),
    "project_forces": lambda m, bad: m.project_forces(X, bad),
    "report": lambda m, bad: m.report(bad),
    "initial_state, positions": lambda m, bad: System(m).initial_state(bad),
    "initial_state, velocities": lambda m, bad: System(m).initial_state(X, bad, project=True),
    "forces": lambda m, bad: Rattle().step(System(m, lambda x, t: bad), State(X, 0 * X), 0.01),
    "forces of v": lambda m, bad: Rattle().step(
        System(m, lambda x, v, t: bad, velocity_dependent=True), State(X, 0 * X), 0.01
    ),
    "positions of a state": lambda m, bad: run(System(m, lambda x, t: PULL), State(bad, 0 * X), 0.01, 1),
    "velocities of a state": lambda m, bad: run(System(m, lambda x, t: PULL), State(X, bad), 0.01, 1),
    "thermal_velocities": lambda m, bad: thermal_velocities(System(m), bad, 1.0, 1),
    "targets of fixed atoms": lambda m, bad: FixedAtoms([0, 1, 2], bad),
    "a moving target": lambda m, bad: FixedAtoms([0, 1, 2], lambda t: bad).target_at(0.0),
    "normals": lambda m, bad: Plane([0, 1, 2], bad),
    "points": lambda m, bad: Line([0, 1, 2], bad, [0, 0, 1]),
    "centers": lambda m, bad: Sphere([0, 1, 2], bad),
    "semi-axes": lambda m, bad: Ellipsoid([0, 1, 2], np.zeros(3), bad),
    "coefficients": lambda m, bad: LinearCombination([0, 1, 2], bad),
    "weights": lambda m, bad: LinearRelation([3], [0, 1, 2], bad if isinstance(bad, list) else bad[0]),
    "a gradient": lambda m, bad: held([Custom([0, 1, 2], lambda r: 1.0, lambda r: bad)]),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", WAYS)
def test_every_way_in_refuses_them(way: str, kind: str, motion: Motion) -> None:
    with pytest.raises(InputError, match=SAID.get(kind, "no array of numbers")):
        WAYS[way](motion, spoilt(X)[kind])


STEPPERS = [
    Rattle(),
    Geodesic(),
    Suzuki4(),
    BlanesMoan6(),
    BlanesMoan6a(),
    Langevin(0.1, 0.5, 1),
    NoseHooverChain(0.1, 5.0),
    Isokinetic(),
]


# -- what is lent -----------------------------------------------------------------------------------


def careless(y, *rest) -> np.ndarray:
    force = PULL - 0.3 * y
    y += 0.01
    return force


@pytest.mark.parametrize("far", [False, True], ids=["near", "far"])
@pytest.mark.parametrize("chains", [False, True], ids=["compiled", "engine"])
@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_forces_cannot_move_the_atoms(stepper, chains: bool, far: bool) -> None:
    """Every way a step takes: many at once, one, piece by piece, relative to an atom."""
    rows = [Distance([[0, 1], [1, 2]])] if not chains or far else [Sphere(0, np.zeros(3)), Distance([[0, 1], [1, 2]])]
    x = X + 1e6 * far
    motion = Motion(ConstraintSet(rows, x, MASSES), x)
    v = motion.project_velocities(x, X[::-1])
    start = System(motion).initial_state(x, v)
    with pytest.raises(ValueError, match="read-only"):
        run(System(motion, careless), start, 0.001, 3, stepper=stepper)


def of_velocities(motion, force, stepper) -> None:
    run(System(motion, force, velocity_dependent=True), State(X, 0 * X), 0.01, 3, stepper=stepper)


#: What calls a function of the user with arrays of the engine.
CALLS = {
    "potential": lambda m, f: System(m, lambda x, t: PULL, potential=f).total_energy(State(X, 0 * X)),
    **{f"force of v, {each!r}": partial(of_velocities, stepper=each) for each in (Rattle(), Suzuki4(), Geodesic(3))},
    "Custom": lambda m, f: held([Custom([0], f)]),
    "Custom, gradient": lambda m, f: held([Custom([0], lambda r: r[0, 0], f)]),
}


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("call", CALLS)
def test_other_functions_cannot_change_what_they_see(call: str, which: int, motion: Motion) -> None:
    def tampering(x, *others):
        (x, *others)[which if others and np.ndim(others[0]) else 0][:] = 0.0

    with pytest.raises(ValueError, match="read-only"):
        CALLS[call](motion, tampering)


@pytest.mark.parametrize("stepper", [Rattle(), BlanesMoan6a(), Langevin(0.1, 0.5, 1)], ids=repr)
@pytest.mark.parametrize("name", ["positions", "velocities", "forces", "thermostat"])
def test_observers_cannot_change_states(name: str, stepper, motion: Motion) -> None:
    def tampering(state: State) -> None:
        array = getattr(state, name)
        if array is None:
            raise ValueError("read-only, and not there")
        array[:] += 0.01

    system = System(motion, lambda x, t: PULL - 0.3 * x)
    with pytest.raises(ValueError, match="read-only"):
        run(system, system.with_forces(State(X, 0 * X)), 0.01, 3, stepper=stepper, observers=[tampering])


class NoArray:
    """Says that it is an array, and is none."""

    def __array__(self, *_, **__):
        raise RuntimeError("not here")


#: Rules, what they say, and what they refuse besides what none takes.
RULES = {
    "a whole number from 1 to 9": (partial(whole_number, least=1, most=9), ["3", 2.5, True, -1, 0, [2]]),
    "a finite number": (finite_number, ["0.5", b"1", [1.0], {}, 1j]),
    "a positive number": (positive, [0, -1.0, True, [1.0, 2.0]]),
}
NONE_TAKES = [None, "x", np.nan, np.inf, 10**400, NoArray()]


@pytest.mark.parametrize("words", RULES)
def test_numbers(words):
    rule, refused = RULES[words]
    for value in [*NONE_TAKES, *refused]:
        with pytest.raises(InputError, match=f"^length is .*; give {words}") as caught:
            rule(value, "length")
        assert caught.value.item == "length"
    assert [rule(good, "length") for good in (3, 3.0, np.int32(3), np.float32(3))] == [3] * 4


def test_what_may_be_called_so_or_does_not_say_is_accepted():
    for given in (lambda *a: 1, lambda x, t=0: 1, np.add, dict, None):
        check_call("force", given, ("x", "t"))


@pytest.mark.parametrize("rng", ["x", -1, 2.5])
def test_what_is_neither_a_seed_nor_a_generator(rng):
    for asked in (seed_from, generator_of):
        with pytest.raises(InputError):
            asked(rng)
    with pytest.raises(InputError, match="0 to"):
        seed_from(2**64)
    drawn = [seed_from(np.random.default_rng(3)) for _ in range(2)]
    assert drawn[0] == drawn[1] and seed_from(None) != seed_from(None) and seed_from(7) == 7
