"""The interpreter: steps in kernels and by the engine, one by one and many at once, their times, forces and errors."""

from __future__ import annotations

import copy
import functools
import pickle
from dataclasses import replace

import numpy as np
import pytest
import thermostat_systems
from constraint_cases import blade
from stepper_systems import SYMMETRIC, assert_same, system_of
from thermostat_systems import SHAPE, distance, springs

from kcons import ConstraintSet, Motion
from kcons.constraints import (
    Angle,
    CenterDistance,
    Custom,
    Dihedral,
    Distance,
    Ellipsoid,
    FixedAtoms,
    MovingTarget,
    Plane,
    Sphere,
)
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError
from kcons.solvers.addressable_solvers import packed_positions, packed_tangents
from kcons.solvers.tolerances import MANY_ITERATIONS
from kcons.steppers import BlanesMoan4, BlanesMoan6, Rattle, ReversibilityCheck, Splitting, State, Suzuki4, System, run
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Evaluate, Kick, Program, Project, drifts_of
from kcons.steppers.packed_system import MOST_ROWS
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain

PAIRS = thermostat_systems.ROWS["triangles"]


def homing(x, t):
    return -0.1 * (x - x.mean(axis=0))


def started(rows, x, masses, force, rng, *, piecewise=False, away=0.0, **options) -> tuple[System, State]:
    """A system and where it begins; with `piecewise` its rows are left to the engine, with `away` atoms are moved."""
    system = System(Motion(ConstraintSet(rows, x, masses, **options), x), force)
    assert system.packed is not None
    if piecewise:
        system.packed = None
    return system, system.initial_state(x + away, 0.3 * rng.normal(size=x.shape), project=True)


def triangles(*, piecewise: bool = False, **options) -> tuple[System, State]:
    """Rigid triangles that turn, and free atoms after them; 11 fill one group of lanes and part of a second."""
    system, state = thermostat_systems.molecules("triangles", **options)
    if piecewise:
        system.packed = None
    return system, state


#: Pairs and masses of one molecule of each kind.
KINDS = {
    "dumbbells": ([[0, 1]], [1.0, 2.0]),
    "methylene": ([[0, 1], [0, 2]], [12.0, 1.0, 1.0]),
    "methyl": ([[0, 1], [0, 2], [0, 3]], [12.0, 1.0, 1.0, 1.0]),
    "chain": ([[k, k + 1] for k in range(9)], [14.0] * 10),
    "long": ([[k, k + 1] for k in range(59)], [14.0] * 60),
    "longer": ([[k, k + 1] for k in range(149)], [14.0] * 150),
    "ring": ([[k, (k + 1) % 6] for k in range(6)] + [[0, 6]], [12.0] * 6 + [1.0]),
    "tetrahedron": ([[i, j] for i in range(4) for j in range(i)], [1.0, 2.0, 3.0, 4.0]),
    "triangles": (PAIRS, [16.0, 1.0, 1.0]),
}


def molecules(
    *names: str, ions: int = 2, fixed: tuple[int, ...] = (), at=0.0, force=springs, scatter: bool = False, **options
) -> tuple[System, State]:
    """Molecules of some kinds one after another, in places of their own, and free atoms after them."""
    rng = np.random.default_rng(7)
    x, pairs, masses = [], [], []
    for number, name in enumerate(names):
        rows, m = KINDS[name]
        pairs.append(np.array(rows) + sum(map(len, masses)))
        masses.append(m)
        k = np.arange(len(m))
        shape = np.stack([np.cos(k), np.sin(k), 0.1 * k], axis=1)
        if name not in ("chain", "long", "longer"):
            shape = rng.normal(size=(len(m), 3))
        x.append(shape + 0.2 * number)
    x = np.concatenate([*x, rng.normal(size=(ions, 3))]) + at
    if scatter:
        x = x + rng.integers(-1, 2, size=x.shape) * np.diag(options["cell"])
    rows = ([Distance(np.concatenate(pairs))] if pairs else []) + ([FixedAtoms(list(fixed))] if fixed else [])
    return started(rows, x, np.concatenate([*masses, np.full(ions, 23.0)]), force, rng, **options)


BUTANE = np.array([[0.0, 0, 0], [1.5, 0, 0], [2.0, 1.4, 0], [3.5, 1.4, 0.5]])
BONDS = [[0, 1], [1, 2], [2, 3]]
#: Name -> rows on a chain of four atoms and two atoms apart, fixed atoms among them, and further options.
MIXED = {
    "cylinder": ([Ellipsoid([4], [0.0, 0, 0], [1.0, 1.0, np.inf], target=None)], {}),
    "two surfaces": ([Ellipsoid([4], [0, 0, 0], [1.0, 2, 3], target=None), Plane([5], [0, 0.6, 0.8])], {}),
    "angles": ([Distance(BONDS), Angle([[0, 1, 2], [1, 2, 3]])], {}),
    "dihedral and a surface": ([Distance(BONDS), Dihedral([[0, 1, 2, 3]]), Sphere([4], [0.0, 0, 0])], {}),
    "distances apart": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {}),
    "rigid triangles, and a plane": ([Distance([[0, 1], [0, 2], [1, 2]]), Plane([5], [0, 0.6, 0.8])], {}),
    "a blade": ([Distance([4, 5]), blade([4, 5], [0, 0.1, 1.0], 0.1)], {}),
    "centers": ([CenterDistance([[0, 1], [2, 3]], [[4], [5]])], {}),
    "rows beside fixed atoms": (
        [Distance(BONDS), Angle([[0, 1, 2]]), Sphere([4], [0.0, 0, 0]), FixedAtoms([0, 5])],
        {},
    ),
    "few rows among many": ([Distance([[4, 5]]), Sphere([4], [0.0, 0, 0])], {"ions": 30}),
    "angles in a cell": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {"cell": np.diag([9.0, 8.0, 7.0])}),
    "far, with an angle": ([Distance(BONDS), Angle([[0, 1, 2]])], {"at": 1e5, "force": homing}),
}


def mixed(name: str, *, ions: int = 0, at: float = 0.0, force=springs, **options) -> tuple[System, State]:
    rng = np.random.default_rng(7)
    x = np.concatenate([BUTANE, [[0.3, 0.2, 4.0], [1.0, 1.0, 5.0]], rng.normal(size=(ions, 3))]) + at
    m = np.concatenate([[12.0, 14.0, 1.0, 16.0, 2.0, 3.0], np.full(ions, 23.0)])
    away = rng.integers(-1, 2, size=x.shape) @ options["cell"] if "cell" in options else 0.0
    return started(MIXED[name][0], x, m, force, rng, away=away, **options)


GROUPS = ["methyl", "methylene", "dumbbells", "methyl", "dumbbells"]
CELL = np.diag([19.0, 18.0, 17.0])
SKEWED = np.array([[19.0, 0, 0], [2.0, 18.0, 0], [1.0, -3.0, 17.0]])
MOLECULES = {
    "many dumbbells": (["dumbbells"] * 30, {}),
    "hydrogens": (GROUPS, {}),
    "chains": (["chain", "long", "dumbbells"], {}),
    "long chains": (["longer", "long", "chain"], {"ions": 0}),
    "long chains, and more": (["longer", "chain", *["triangles"] * 9, *GROUPS], {"fixed": (180,)}),
    "long chains among many": (["longer", "methyl"], {"ions": 300}),
    "far long chains": (["longer"], {"at": 1e5, "force": None}),
    "rings": (["ring", "tetrahedron"], {}),
    "few held among many": (["methyl", "triangles"], {"ions": 30}),
    "fixed atoms": (["chain", "methyl", "triangles", "dumbbells"], {"fixed": (0, 3, 10, 11, 14, 20)}),
    "fixed and nothing else": ([], {"fixed": (1,), "ions": 4}),
    "nothing": ([], {"ions": 4}),
    "periodic": ([*GROUPS, "triangles"], {"cell": CELL, "pbc": True, "scatter": True}),
    "skewed": ([*GROUPS, "triangles"], {"cell": SKEWED, "pbc": True}),
    "far": (GROUPS, {"at": 1e5, "force": None}),
    "far, forced": ([*GROUPS, "triangles"], {"at": 1e4, "force": homing}),
}
TRIANGLES = {
    "water and ions": {"ions": 5},
    "water in a cell": {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True},
    "water far away": {"at": 1e6, "force": None},
}
NAMES = [*MOLECULES, *TRIANGLES, *MIXED]


@functools.cache
def held_system(name: str, **more) -> tuple[System, State]:
    """The system of a name, and where it begins."""
    if name in MOLECULES:
        kinds, options = MOLECULES[name]
        return molecules(*kinds, **{**options, **more})
    if name in TRIANGLES:
        return triangles(**{**TRIANGLES[name], **more})
    return mixed(name, **{**MIXED[name][1], **more})


def one_by_one(stepper, system: System, state: State, dt: float, steps: int) -> State:
    for _ in range(steps):
        state = stepper.step(system, state, dt)
    return state


ALL = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)
PIECEWISE = pytest.mark.parametrize("piecewise", [False, True], ids=["kernels", "engine"])


# -- what is made -----------------------------------------------------------------------------------


@ALL
@pytest.mark.parametrize("name", NAMES)
def test_steps_in_kernels_are_those_of_the_engine(stepper, name, monkeypatch) -> None:
    """Without a call of the engine; one by one and many at once to the last bit."""
    (system, state), (other, _) = held_system(name), held_system(name, piecewise=True)
    assert system.packed is not None and other.packed is None
    calls = []
    for call in ("project_positions", "project_velocities"):
        monkeypatch.setattr(system.motion, call, calls.append)
    rounding = float(np.spacing(np.abs(state.positions).max()))
    assert (state.remainder is not None) == ("far" in name)
    for dt in (0.02, -0.01, 0.015):
        following, expected = stepper.step(system, state, dt), stepper.step(other, state, dt)
        assert distance(following, expected) <= 2e-14 + 8 * rounding
        assert distance(following, state) > 1e-4
        assert (following.remainder is None) == (expected.remainder is None) == ("far" not in name)
        assert (following.forces is None) == (expected.forces is None)
        if following.forces is not None:
            np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=1e-13 + 8 * rounding)
        if following.remainder is not None:
            there, here = (each.positions - state.positions + each.remainder for each in (following, expected))
            assert np.abs(there - here).max() <= 2e-14
        state = following
    for dt, steps in ((0.02, 7), (-0.01, 2), (0.1 / 3, 11)):
        expected = one_by_one(stepper, system, state, dt, steps)
        found = stepper.march(system, state, dt, steps)
        assert_same(found, expected)
        assert found.step == state.step + steps
        state = found
    held = system.motion.constraint_set
    if not held.n_rows:
        return
    assert not calls
    x = state.positions
    if state.remainder is not None:
        x = x - x[0] + state.remainder
    # Atoms of long chains are so far from the origin that the rounding of their positions is more.
    assert np.all(np.abs(held.value(x)) <= np.maximum(held.tolerance(x, 0.0), 1e-14 * held.scale))
    rates = held.jacobian(x) @ state.velocities.ravel()
    assert np.abs(rates).max() <= 1e-13 * np.abs(state.velocities).max()
    assert not state.velocities[system.motion.fixed_atoms].any()


def test_what_is_left_to_the_engine() -> None:
    def packed(*rows, x=SHAPE[:3] + 0.0, m=(16.0, 1.0, 1.0)):
        return System(Motion(ConstraintSet(rows, x, np.array(m)), x)).packed is not None

    lengths = np.linalg.norm(SHAPE[[0, 0, 1]] - SHAPE[[1, 2, 2]], axis=1)
    moving = MovingTarget(lambda t: lengths + 0.1 * t)
    assert packed() and packed(Distance(PAIRS)) and packed(Distance(PAIRS[:2])) and not packed(Distance(PAIRS, moving))
    assert packed(Distance(PAIRS[:2]), FixedAtoms([0])) and packed(Distance([[0, 1]]), Angle([[1, 0, 2]]))
    assert packed(Distance([[0, 1]]), Plane(2, [0, 0, 1.0]))
    assert not packed(Distance([[0, 1]]), Plane(2, [0, 0, 1.0], MovingTarget(lambda t: 0.1 * t)))
    many = np.arange(6.0 * (MOST_ROWS + 1)).reshape(-1, 3)
    pairs, particles = np.arange(2 * MOST_ROWS + 2).reshape(-1, 2), np.arange(MOST_ROWS + 1)
    for begin, known in ((0, False), (1, True)):
        assert packed(Distance(pairs[begin:]), x=many, m=np.ones(len(many))) == known
        assert packed(Sphere(particles[begin:], [0, 0, -9.0]), x=many, m=np.ones(len(many))) == known


def test_forces_that_depend_on_velocities() -> None:
    """In kernels and by the engine; drifts first: two steps of half the length, whichever comes first."""

    def force(x, v, t):
        return springs(x, t) - 0.1 * v

    (plain, state), (other, _) = molecules(*GROUPS), molecules(*GROUPS, piecewise=True)
    system, by_engine = (System(each.motion, force, velocity_dependent=True) for each in (plain, other))
    by_engine.packed = None
    for stepper in (Rattle(), Suzuki4()):
        assert distance(stepper.step(system, state, 0.05), stepper.step(by_engine, state, 0.05)) <= 1e-14
    halves = run(system, state, 0.01, 8)
    for splitting in (Splitting((1.0,), (0.5, 0.5)), Splitting((0.25, 0.5, 0.25), (0.5, 0.5))):
        end = run(system, state, 0.02, 4, stepper=splitting)
        np.testing.assert_allclose(end.positions, halves.positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(end.velocities, halves.velocities, rtol=0, atol=1e-13)
        assert np.array_equal(end.forces, system.forces(end.positions, end.velocities, end.time, 0))


def test_reports_show_iterations_and_two_systems_of_one_motion_do_not_share_rooms() -> None:
    system, state = triangles()
    end, other = Rattle().step(system, state, 0.05), System(system.motion, springs)
    found = system.motion.report(end.positions, condition=False)
    assert all(3 <= kind.iterations <= MANY_ITERATIONS for kind in found.kinds)
    assert not np.shares_memory(system.packed.tables, other.packed.tables)
    assert distance(end, Rattle().step(other, state, 0.05)) == 0.0


# -- programs ---------------------------------------------------------------------------------------


def pair_and_atom(at: float) -> tuple[System, State]:
    x = np.array([[0.0, 0.0, 0.0], [1.0 / 3.0, 0.2, 0.1], [2.0, 0.7, 0.3]]) + at
    system = system_of([Distance([[1, 2]])], x, np.ones(3))
    return system, system.initial_state(x, np.zeros_like(x))


@PIECEWISE
def test_times_within_a_step_are_exact(piecewise) -> None:
    system, state = pair_and_atom(0.0)
    if piecewise:
        system.packed = None
    seen: list[float] = []
    system.force = lambda x, t: seen.append(t) or np.zeros_like(x)
    state = State(state.positions, state.velocities, 1e8, time_remainder=3e-9)
    begin = system.with_forces(state)
    half = state.later(1e-7)
    then = State(state.positions, state.velocities, half[0], time_remainder=half[1])
    middle, last = (s.time + (0.5e-7 + s.time_remainder) for s in (state, then))
    first, second = drifts_of((0.5, 0.5))
    program = [first, Evaluate(), second, Evaluate()]
    for simple in (True, False):  # by the short way, and by the method
        seen.clear()
        kind = type("Steps", (Interpreter,), {"simple": simple})
        end = kind(system, begin, 1e-7, Program(program), 2).through()
        assert seen == [middle, half[0], last, then.later(1e-7)[0]] and seen[0] > 1e8
        assert (end.time, end.time_remainder) == then.later(1e-7)


@PIECEWISE
def test_kicks_in_succession_and_before_other_operations(piecewise) -> None:
    """Each is taken once, whatever comes after it."""
    system, state = molecules(*GROUPS, piecewise=piecewise)
    start = system.with_forces(state)
    (drift,) = drifts_of((1.0,))
    listed = [Kick(0.25), Kick(0.25), drift, Evaluate(), Kick(0.2), Evaluate(), Kick(0.3), Project()]
    for steps in (1, 4):
        end = Interpreter(system, start, 0.02, Program(listed), steps).through()
        expected = one_by_one(Rattle(), system, start, 0.02, steps)
        np.testing.assert_allclose(end.positions, expected.positions, rtol=0, atol=1e-14)
        np.testing.assert_allclose(end.velocities, expected.velocities, rtol=0, atol=1e-13)
    last = Interpreter(system, start, 0.02, Program([Project(), Kick(0.5)])).through()
    push = 0.01 * start.forces * system.inverse_masses
    np.testing.assert_allclose(last.velocities, state.velocities + push, rtol=0, atol=1e-15)


# -- many steps at once -----------------------------------------------------------------------------


def test_a_march_ends_where_remainders_begin() -> None:
    system, state = molecules(*GROUPS, force=None)
    start = system.with_forces(State(state.positions, state.velocities + 40.0))
    steps = Rattle().begun(system, start, 0.02, 400)
    end = steps.through()
    assert 0 < steps.made < 400 and end.step == steps.made and end.remainder is not None
    assert np.all(np.abs(end.remainder) <= np.spacing(np.abs(end.positions)))
    assert_same(end, one_by_one(Rattle(), system, start, 0.02, steps.made))
    assert one_by_one(Rattle(), system, start, 0.02, steps.made - 1).remainder is None
    for stepper in (Rattle(), Suzuki4()):
        assert_same(stepper.march(system, start, 0.02, 400), one_by_one(stepper, system, start, 0.02, 400))


@ALL
def test_forces_that_know_the_time_and_reuse_their_array(stepper) -> None:
    """What they were shown is never written to, nor is what they returned part of a state."""
    seen: list[tuple[float, np.ndarray, np.ndarray]] = []
    room = np.empty(molecules(*GROUPS)[1].positions.shape)

    def force(x, t):
        seen.append((t, x, x.copy()))
        room[:] = springs(x, t) * (1.0 + 0.5 * np.sin(7.0 * t))
        return room

    system, state = molecules(*GROUPS, force=force)
    state = State(state.positions, state.velocities, time=0.3)
    expected = one_by_one(stepper, system, state, 0.02, 5)
    times = [t for t, *_ in seen]
    assert all(np.array_equal(x, copied) for _, x, copied in seen)
    seen.clear()
    found = stepper.march(system, state, 0.02, 5)
    assert_same(found, expected)
    assert [t for t, *_ in seen] == times and all(np.array_equal(x, copied) for _, x, copied in seen)
    assert found.forces is None or not np.shares_memory(found.forces, room)


@pytest.mark.parametrize("kind", [np.float32, np.asfortranarray, lambda a: a[::-1].copy()[::-1]])
@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4()], ids=repr)
def test_starts_of_other_kinds_of_arrays(stepper, kind) -> None:
    system, state = molecules(*GROUPS)
    x, v = kind(state.positions), kind(state.velocities)
    plain = system.with_forces(State(np.array(x, dtype=float, order="C"), np.array(v, dtype=float, order="C")))
    strange = State(x, v, forces=kind(np.array(plain.forces)))
    plain = replace(plain, forces=np.array(strange.forces, dtype=float, order="C"))
    for march in (stepper.march, lambda *run: one_by_one(stepper, *run)):
        assert_same(march(system, strange, 0.02, 5), march(system, plain, 0.02, 5))


def test_steps_of_a_subclass_and_steppers_without_march() -> None:
    class Halved(Rattle):
        def step(self, system, state, dt):
            return super().step(system, state, 0.5 * dt)

    system, state = molecules(*GROUPS)
    assert_same(run(system, state, 0.02, 6, stepper=Halved()), run(system, state, 0.01, 6))
    checked = run(system, state, 0.02, 5, stepper=ReversibilityCheck(Rattle()))
    assert_same(checked, run(system, state, 0.02, 5))
    assert run(system, state, 0.0, 5).step == 5 and run(system, state, 0.02, 0) is state


BATHS = [NoseHooverChain(0.1, 2.0, momentum="free"), Isokinetic(0.1, momentum="free"), Langevin(0.1, 0.3, 5)]


@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4(), *BATHS], ids=lambda each: type(each).__name__)
def test_steps_that_go_on_are_those_that_begin_anew(stepper) -> None:
    """From the state that the last one ended in all is ready, as long as nothing has changed since."""
    system, state = molecules(*GROUPS, "triangles")
    again, stepper = copy.deepcopy(stepper), copy.deepcopy(stepper)
    begun, first = [], stepper.begun
    stepper.begun = lambda *given: begun.append(1) or first(*given)
    one = other = state
    for _ in range(4):
        one = stepper.step(system, one, 0.02)
        other = again.step(molecules(*GROUPS, "triangles")[0], replace(other, origin=None), 0.02)
        assert_same(one, other)
    assert len(begun) == 1
    # Another time step, a state that was changed, a force that fails on the way: all begin anew.
    assert stepper.step(system, one, 0.01).time == pytest.approx(one.time + 0.01)
    moved = replace(one, velocities=2 * one.velocities)
    assert not np.array_equal(stepper.step(system, moved, 0.01).velocities, stepper.step(system, one, 0.01).velocities)
    force, last = system.force, stepper.step(system, one, 0.02)
    system.force = lambda x, t: np.full_like(x, np.nan)
    with pytest.raises(NonFiniteError):
        stepper.step(system, last, 0.02)
    system.force = force
    assert_same(stepper.step(system, last, 0.02), stepper.step(system, last, 0.02))


@pytest.mark.parametrize("make", [lambda: Langevin(0.1, 0.3, 5), lambda: NoseHooverChain(0.1, 2.0, momentum="free")])
def test_a_temperature_that_is_changed_between_steps_counts_at_once(make) -> None:
    system, state = molecules(*GROUPS)
    one, other = make(), make()
    state = one.step(system, state, 0.02)
    kept = state.copied()
    one.thermal_energy = other.thermal_energy = 0.3
    assert_same(one.step(system, state, 0.02), other.step(system, replace(kept, origin=None), 0.02))


def test_copies_of_a_system_begin_anew() -> None:
    """What kernels are called by is an address: that of the copy's rows, which live as long as the copy."""
    system, state = mixed("dihedral and a surface")
    state = run(system, state, 0.01, 3)
    end = Rattle().step(system, state, 0.02)
    others = [copy.deepcopy((system, state)), pickle.loads(pickle.dumps((system, state)))]
    del system
    for other, there in others:
        assert other.going is None and other.packed is not None
        assert_same(Rattle().step(other, there, 0.02), end)


# -- cells that change ------------------------------------------------------------------------------


#: Ways in which a force function may change the cell: that of the engine, of the set it was given, of the one it holds.
WAYS = {
    "engine": lambda motion, cell: motion.set_cell(cell),
    "given": lambda motion, cell: motion.sources[0].with_cell(cell),
    "held": lambda motion, cell: motion.sources[1].with_cell(cell),
}


@pytest.mark.parametrize("way", WAYS)
@ALL
def test_a_cell_that_the_force_function_changes(stepper, way) -> None:
    """One by one and all at once, compiled and by the engine, with atoms of a molecule in different cells."""
    ends = []
    for together, piecewise in ((True, False), (False, False), (False, True)):
        system, state = molecules(*GROUPS, "triangles", cell=CELL, pbc=True, scatter=True, piecewise=piecewise)
        force = system.force

        def press(x, t, force=force, motion=system.motion):
            WAYS[way](motion, (1.0 - 1e-3 * min(t, 0.05)) * CELL)  # the last steps see one cell
            return force(x, t)

        system.force = press
        march = stepper.march if together else lambda *run: one_by_one(stepper, *run)
        ends.append(march(system, state, 0.02, 6))
        held = system.motion.constraint_set
        assert np.all(np.abs(held.value(ends[-1].positions)) <= 1e-13) and held.lattice[0, 0, 0] < 19.0
    assert_same(*ends[:2])
    np.testing.assert_allclose(ends[2].positions, ends[0].positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[2].velocities, ends[0].velocities, rtol=0, atol=1e-11)


# -- errors -----------------------------------------------------------------------------------------


def outcome(stepper, system, state, dt):
    """The state after a step, or its error, with the start as it was."""
    before = state.positions.copy(), state.velocities.copy()
    try:
        return stepper.step(system, state, float(dt))
    except KconsError as error:
        return error
    finally:
        assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])


#: Name -> system; the first four have Distances alone.
WITHOUT_SOLUTION = {
    "groups": (molecules, *GROUPS),
    "chain": (molecules, "chain"),
    "longer": (molecules, "longer"),
    "triangle and more": (molecules, "triangles", "methyl"),
    "triangles": (triangles,),
    **{name: (mixed, name) for name in ("two surfaces", "angles", "dihedral and a surface", "distances apart")},
}


@pytest.mark.parametrize("name", WITHOUT_SOLUTION)
def test_steps_without_solution_are_the_engines(name) -> None:
    """The same error, for the same row, after which a usual step is what it would have been."""
    taken = failed = 0
    make, *given = WITHOUT_SOLUTION[name]
    (system, state), (other, _) = (make(*given, force=None, piecewise=p) for p in (False, True))
    held, engine, calls = system.motion.constraint_set, system.motion.project_positions, []
    system.motion.project_positions = lambda *a, **k: calls.append(1) or engine(*a, **k)
    many = make is triangles
    steps = np.geomspace(0.5, 8.0, 20) if many else [0.5, 20.0] if name == "longer" else np.geomspace(0.5, 20.0, 6)
    few = make is mixed or name == "longer"
    for k, stepper in enumerate((Rattle(), Suzuki4(), BlanesMoan4()) if few else SYMMETRIC):
        for dt in steps if few else steps[k % 3 :: 3]:  # each with each stepper or with a third of them
            calls.clear()
            one, two = outcome(stepper, system, state, dt), outcome(stepper, other, state, dt)
            if isinstance(two, State) and isinstance(one, State):
                allowed = np.maximum(held.tolerance(one.positions, 0.0), 1e-13)
                assert np.all(np.abs(held.value(one.positions)) <= allowed)
                assert not many or distance(one, two) <= 1e-10
                taken += bool(calls) if many else 1
            elif isinstance(one, KconsError) and isinstance(two, KconsError):
                assert type(one) is type(two) and one.row == two.row and one.atoms == two.atoms and one.step == 1
                assert f"step 1: time step too large (dt = {dt:g})" in str(one)
                failed += 1
            else:
                assert not many
            assert distance(stepper.step(system, state, 0.02), stepper.step(other, state, 0.02)) <= 2e-14
    assert taken >= 3 and failed >= 3


@pytest.mark.parametrize(
    ("others", "ions", "bad"),
    [([], 0, 50), ([*["triangles"] * 11, *["methyl"] * 3], 0, 50), (["methyl"] * 2, 300, 50), (["long"], 0, 200)],
)
def test_nothing_changes_where_a_chain_has_no_solution(others, ions, bad) -> None:
    """Also not what was solved before it: the kernel of chains writes at once."""
    system, state = molecules("longer", *others, ions=ions)
    packed, x, rng = system.packed, state.positions.copy(), np.random.default_rng(4)
    assert packed.called[-1].name == "Chains"
    for wrong in (40.0, np.nan):
        ends, v = x + 0.01 * rng.normal(size=x.shape), rng.normal(size=x.shape)
        ends[bad] += wrong
        there, speed = ends.copy(), v.copy()
        assert packed_positions(there, x, speed, 10.0, packed.tables) == -1
        assert np.array_equal(there, ends, equal_nan=True) and np.array_equal(speed, v)
    v[bad] = np.nan
    speed = v.copy()
    assert not packed_tangents(x, speed, packed.tables)
    assert np.array_equal(speed, v, equal_nan=True)


@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4(), Langevin(0.1, 0.3, 5)], ids=lambda each: type(each).__name__)
def test_a_step_that_fails_in_a_march_leaves_the_start_and_names_row_and_step(stepper) -> None:
    """A push in one step that leads too far in the next."""

    def force(x, t):
        return 1e7 * (x - x.mean(axis=0)) if 0.085 < t < 0.095 else np.zeros_like(x)

    errors = []
    for piecewise in (False, True):
        system, state = molecules("chain", force=force, piecewise=piecewise)
        kept, seen = state.copied(), []
        marches = (
            lambda: stepper.march(system, state, 0.01, 30),  # noqa: B023
            lambda: one_by_one(stepper, system, state, 0.01, 30),  # noqa: B023
            lambda: run(system, state, 0.01, 30, stepper=stepper, observers=[seen.append], every=4),  # noqa: B023
        )
        for march in marches:
            with pytest.raises(ConvergenceError, match="time step too large") as caught:
                march()
            errors.append((caught.value.step, caught.value.row))
            assert_same(state, kept)
        assert [s.step for s in seen] == list(range(0, errors[-1][0], 4))
    assert len(set(errors)) == 1 and errors[0][0] > 8 and errors[0][1] is not None


@ALL
@pytest.mark.parametrize(
    ("wrong", "kind", "message"),
    [
        (np.nan, NonFiniteError, "non-finite force at step 4 on atom 2"),
        (np.inf, NonFiniteError, "non-finite force at step 4 on atom 2"),
        (None, InputError, r"returned shape \(3,\) at step 4"),
    ],
)
def test_errors_name_the_step(stepper, wrong, kind, message) -> None:
    def force(x, t):
        f = springs(x, t)
        # In the fourth step for all steppers, also those that ask for forces a third of a step beyond its end.
        if t > 3.4 * 0.02:
            if wrong is None:
                return np.zeros(3)
            f[2, 1] = wrong
        return f

    texts = []
    for piecewise in (False, True):
        system, state = molecules(*GROUPS, force=force, piecewise=piecewise)
        before = state.positions.copy(), state.velocities.copy()
        for march in (stepper.march, lambda *run: one_by_one(stepper, *run)):
            with pytest.raises(kind, match=message) as raised:
                march(system, state, 0.02, 9)
            texts.append(str(raised.value))
        assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])
    assert len(set(texts)) == 1


@PIECEWISE
def test_numbers_that_overflow_and_forces_of_a_state_that_are_not_finite(piecewise) -> None:
    alone = (np.arange(34) == 33)[:, None]  # the free atom, of which the engine knows nothing
    system, state = triangles(ions=1, force=None, piecewise=piecewise)
    for stepper in (Rattle(), BlanesMoan6()):
        with pytest.raises(NonFiniteError, match="non-finite position at step 1 on atom 33"):
            stepper.step(system, State(state.positions, alone * np.full(3, 1.7e308)), 10.0)
    system, state = triangles(ions=1, force=lambda x, t: alone * np.full(3, 1e308), piecewise=piecewise)
    bad = State(state.positions, state.velocities, forces=np.where(np.roll(alone, 3), [0.0, np.inf, 0.0], 0.0))
    for stepper in (Rattle(), Suzuki4()):
        with pytest.raises(NonFiniteError, match="non-finite force at step 1 on atom 2"):
            stepper.step(system, bad, 0.01)
    start = State(state.positions, alone * np.full(3, 1.797e308), forces=np.zeros((34, 3)))
    with pytest.raises(NonFiniteError, match="non-finite velocity at step 1 on atom 33"):
        Rattle().step(system, start, 1.0)


@pytest.mark.parametrize("stepper", [Rattle(), BlanesMoan4()], ids=repr)
@pytest.mark.parametrize("march", [False, True], ids=["steps", "march"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_what_a_python_row_raises_once_is_not_lost(stepper, march, error) -> None:
    """An interrupt comes in any call, of positions or velocities, and the next one would go well."""
    left = 0

    def function(r):
        nonlocal left
        left -= 1
        if left == 0:
            raise error
        return float(r[0] @ r[0])

    x = np.array([[1.0, 0.2, 0.1]])
    system = System(Motion(ConstraintSet(Custom([[0]], function, lambda r: 2 * r), x, [1.0]), x), springs)
    assert system.packed is not None
    state = system.initial_state(x, [[0.0, 0.1, 0.0]], project=True)
    for calls in range(1, 40, 3):
        left, kept = calls, state.copied()
        with pytest.raises(error):
            if march:
                stepper.march(system, state, 0.01, 12)
            else:
                run(system, state, 0.01, 12, stepper=stepper)
        assert distance(state, kept) == 0.0
    assert np.abs(system.motion.constraint_set.value(stepper.step(system, state, 0.01).positions)).max() < 1e-13
