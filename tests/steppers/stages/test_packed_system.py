"""Compiled steps: the same as by the engine operation by operation, and the engine where they cannot."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from kcons.constraints import (
    Angle,
    CenterDistance,
    Custom,
    Cylinder,
    Dihedral,
    Distance,
    Ellipsoid,
    FixedAtoms,
    Formula,
    ImplicitSurface,
    MovingTarget,
    Plane,
    Sphere,
)
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError
from kcons.motion.motion import Motion
from kcons.solvers.tolerances import MANY_ITERATIONS
from kcons.steppers import (
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoan6a,
    Geodesic,
    KahanLi6,
    Rattle,
    State,
    Suzuki4,
    System,
    run,
)
from kcons.steppers.stages.packed_system import MOST_ROWS

STEPPERS = [Rattle(), Geodesic(4), Suzuki4(), KahanLi6(), BlanesMoan4(), BlanesMoan6(), BlanesMoan6a()]
PAIRS = [[0, 1], [0, 2], [1, 2]]
SHAPE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]])


def springs(x, t):
    """Each atom in a harmonic well of its own strength, and an attraction of neighbouring molecules."""
    return -np.linspace(0.1, 0.3, len(x))[:, None] * x - 0.05 * (x - np.roll(x, 3, axis=0))


def triangles(
    n: int = 11, *, ions: int = 0, at: float = 0.0, force=springs, piecewise: bool = False, **options
) -> tuple[System, State]:
    """Rigid triangles that turn, and free atoms after them; 11 fill one group of lanes and part of a second."""
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    x = (np.einsum("ak,nkj->naj", SHAPE, turn) + 3.0 * np.arange(n)[:, None, None] / n).reshape(-1, 3)
    x = np.concatenate([x, rng.normal(size=(ions, 3))]) + at
    masses = np.concatenate([np.tile([16.0, 1.0, 1.0], n), np.full(ions, 23.0)])
    rows = Distance((3 * np.arange(n)[:, None, None] + np.array(PAIRS)).reshape(-1, 2))
    system = System(Motion(ConstraintSet([rows], x, masses, **options), x), force)
    assert system.packed is not None
    if piecewise:
        system.packed = None
    return system, system.initial_state(x, 0.3 * rng.normal(size=x.shape), project=True)


#: Pairs and masses of one molecule of each kind, and where its atoms are.
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
    "heavy triangles": (PAIRS, [16.0, 2.0, 2.0]),
}


def molecules(
    *names: str,
    ions: int = 2,
    fixed: tuple[int, ...] = (),
    at: float = 0.0,
    force=springs,
    piecewise: bool = False,
    scatter: bool = False,
    **options,
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
    x.append(rng.normal(size=(ions, 3)))
    x = np.concatenate(x) + at
    if scatter:
        x = x + rng.integers(-1, 2, size=x.shape) * np.diag(options["cell"])
    m = np.concatenate([*masses, np.full(ions, 23.0)])
    rows = [Distance(np.concatenate(pairs))] if pairs else []
    if fixed:
        rows.append(FixedAtoms(list(fixed)))
    system = System(Motion(ConstraintSet(rows, x, m, **options), x), force)
    if piecewise:
        system.packed = None
    return system, system.initial_state(x, 0.3 * rng.normal(size=x.shape), project=True)


GROUPS = ["methyl", "methylene", "dumbbells", "methyl", "dumbbells"]
SYSTEMS = {
    "dumbbells": (["dumbbells"] * 2, {"ions": 0}),
    "many dumbbells": (["dumbbells"] * 30, {}),
    "hydrogens": (GROUPS, {}),
    "chains": (["chain", "long", "dumbbells"], {}),
    "long chains": (["longer", "long", "chain"], {"ions": 0}),
    "long chains, and more": (["longer", "chain", *["triangles"] * 9, *GROUPS], {"fixed": (180,)}),
    "long chains among many": (["longer", "methyl"], {"ions": 300}),
    "long chains in a cell": (
        ["longer", "methyl"],
        {"cell": np.diag([19.0, 18.0, 17.0]), "pbc": True, "scatter": True},
    ),
    "far long chains": (["longer"], {"at": 1e5, "force": None}),
    "rings": (["ring", "tetrahedron"], {}),
    "water in two kinds, and more": ([*["triangles"] * 9, "heavy triangles", "methyl", "chain"], {}),
    "few held among many": (["methyl", "triangles"], {"ions": 30}),
    "fixed atoms": (["chain", "methyl", "triangles", "dumbbells"], {"fixed": (0, 3, 10, 11, 14, 20)}),
    "fixed among many": (["dumbbells", "methyl"], {"fixed": (0, 9), "ions": 30}),
    "fixed and nothing else": ([], {"fixed": (1,), "ions": 4}),
    "nothing": ([], {"ions": 4}),
    "no force": (GROUPS, {"force": None}),
    "periodic": ([*GROUPS, "triangles"], {"cell": np.diag([19.0, 18.0, 17.0]), "pbc": True, "scatter": True}),
    "skewed": (
        [*GROUPS, "triangles"],
        {"cell": np.array([[19.0, 0, 0], [2.0, 18.0, 0], [1.0, -3.0, 17.0]]), "pbc": True},
    ),
    "far": (GROUPS, {"at": 1e5, "force": None}),
    "far, forced": ([*GROUPS, "triangles"], {"at": 1e4, "force": lambda x, t: -0.1 * (x - x.mean(axis=0))}),
}


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("name", SYSTEMS)
def test_few_rows_of_any_shape(stepper, name) -> None:
    names, options = SYSTEMS[name]
    (system, state), (other, _) = molecules(*names, **options), molecules(*names, piecewise=True, **options)
    assert system.packed is not None and other.packed is None
    calls = []
    for call in ("project_positions", "project_velocities"):
        setattr(system.motion, call, calls.append)
    rounding = float(np.spacing(np.abs(state.positions).max()))
    assert (state.remainder is not None) == ("far" in name)
    for dt in (0.02, -0.01, 0.015):
        following, expected = stepper.step(system, state, dt), stepper.step(other, state, dt)
        assert distance(following, expected) <= 2e-14 + 8 * rounding
        assert distance(following, state) > 1e-4
        assert (following.remainder is None) == (expected.remainder is None)
        if following.remainder is not None:
            there, here = (each.positions - state.positions + each.remainder for each in (following, expected))
            assert np.abs(there - here).max() <= 2e-14
        state = following
    if not system.motion.constraint_set.n_rows:
        return
    assert not calls
    shift = state.positions[0] if state.remainder is not None and "far" in name else np.zeros(3)
    x = state.positions - shift + (0.0 if state.remainder is None else state.remainder)
    held = system.motion.constraint_set
    # Atoms of long chains are so far from the origin that the rounding of their positions is more.
    allowed = held.tolerance(x, 0.0) if "longer" in names else 1e-14 * held.scale
    assert np.all(np.abs(held.value(x)) <= allowed)
    rates = held.jacobian(x) @ state.velocities.ravel()
    assert np.abs(rates).max() <= 1e-14 * np.abs(state.velocities).max()
    fixed = list(options.get("fixed", ()))
    assert not state.velocities[fixed].any()


@pytest.mark.parametrize("names", [GROUPS, ["chain"], ["longer"], ["triangles", "methyl"]], ids="-".join)
def test_steps_without_solution_are_the_engines(names) -> None:
    """The same error, for the same row, after which a usual step is what it would have been."""
    taken = failed = 0
    pair = [molecules(*names, force=None, piecewise=p) for p in (False, True)]
    for stepper in STEPPERS:
        for dt in [0.5, 20.0] if names == ["longer"] else np.geomspace(0.5, 20.0, 6):
            outcomes = []
            for system, state in pair:
                before = state.positions.copy(), state.velocities.copy()
                try:
                    outcomes.append(stepper.step(system, state, float(dt)))
                except KconsError as error:
                    outcomes.append(error)
                assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])
            one, two = outcomes
            if isinstance(two, State) and isinstance(one, State):
                held = pair[0][0].motion.constraint_set
                assert np.abs(held.value(one.positions)).max() <= 1e-13
                taken += 1
            elif isinstance(one, KconsError) and isinstance(two, KconsError):
                assert type(one) is type(two) and one.row == two.row and one.atoms == two.atoms and one.step == 1
                failed += 1
            (system, state), (other, _) = pair
            assert distance(stepper.step(system, state, 0.02), stepper.step(other, state, 0.02)) <= 2e-14
    assert taken >= 5 and failed >= 5


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_the_first_force_of_all_is_not_finite(bad) -> None:
    for stepper in STEPPERS:
        system, state = molecules(*GROUPS)
        forces = np.zeros_like(state.positions)
        forces[2, 1] = bad
        state = State(state.positions, state.velocities, forces=forces)
        with pytest.raises(NonFiniteError, match="non-finite force at step 1 on atom 2"):
            if stepper.kick_first:
                stepper.step(system, state, 0.01)
            else:
                system.force = lambda x, t, forces=forces: forces
                stepper.step(system, state, 0.01)


def test_wrong_forces_are_refused() -> None:
    system, state = molecules(*GROUPS)
    for wrong, message in (
        (lambda x, t: np.zeros(3), "returned shape \\(3,\\) at step 1"),
        (lambda x, t: "none", "at step 1: forces is no array of numbers"),
    ):
        start = system.with_forces(state)
        system.force = wrong
        with pytest.raises(InputError, match=message):
            Rattle().step(system, start, 0.01)
        system.force = springs


@pytest.mark.parametrize(
    "made",
    [lambda f: f.tolist(), lambda f: f.astype(np.float32), lambda f: np.asfortranarray(f), lambda f: f[::-1][::-1]],
    ids=["list", "single", "columns", "reversed"],
)
def test_forces_of_other_kinds(made) -> None:
    system, state = molecules(*GROUPS)
    other, _ = molecules(*GROUPS)
    other.force = lambda x, t: made(springs(x, t))
    system.force = lambda x, t: np.array(made(springs(x, t)), dtype=float)
    for stepper in STEPPERS:
        one, two = stepper.step(system, state, 0.02), stepper.step(other, state, 0.02)
        assert distance(one, two) == 0.0


def test_what_a_force_function_reuses_is_copied() -> None:
    room = None

    def force(x, t):
        nonlocal room
        room = np.empty_like(x) if room is None else room
        room[:] = springs(x, t)
        return room

    system, state = molecules(*GROUPS, force=force)
    one = Rattle().step(system, state, 0.02)
    kept = one.forces.copy()
    Rattle().step(system, one, 0.02)
    assert np.array_equal(one.forces, kept)


def test_a_state_that_moves_far_away() -> None:
    system, state = molecules(*GROUPS, force=None)
    state = State(state.positions, state.velocities + 1e5)
    for stepper in (Rattle(), Suzuki4()):
        end = stepper.step(system, state, 0.02)
        assert end.remainder is not None
        assert np.all(np.abs(end.remainder) <= np.spacing(np.abs(end.positions)))


def distance(a: State, b: State) -> float:
    return max(float(np.abs(a.positions - b.positions).max()), float(np.abs(a.velocities - b.velocities).max()))


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize(
    "options",
    [{}, {"ions": 5}, {"force": None}, {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True}],
    ids=["plain", "ions", "free", "periodic"],
)
def test_steps_are_those_made_piece_by_piece(stepper, options) -> None:
    (system, state), (other, _) = triangles(**options), triangles(**options, piecewise=True)
    for dt in (0.05, -0.02, 0.03):
        following, expected = stepper.step(system, state, dt), stepper.step(other, state, dt)
        assert distance(following, expected) <= 1e-14
        assert distance(following, state) > 1e-3
        assert (following.forces is None) == (expected.forces is None)
        if following.forces is not None:
            np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=1e-13)
        state = following
    held = system.motion.constraint_set
    assert np.abs(held.value(state.positions)).max() <= 1e-14


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_far_from_the_origin(stepper) -> None:
    system, state = triangles(at=1e6, force=None)
    assert state.remainder is not None
    end = run(system, state, 0.05, 50, stepper=stepper)
    assert end.remainder is not None and not np.shares_memory(end.remainder, state.remainder)
    assert system.kinetic_energy(end.velocities) == pytest.approx(system.kinetic_energy(state.velocities), rel=1e-13)


def test_friction_takes_compiled_drifts() -> None:
    def force(x, v, t):
        return springs(x, t) - 0.1 * v

    (system, state), (other, _) = triangles(), triangles(piecewise=True)
    for each in (system, other):
        each.force, each.velocity_dependent = force, True
    for stepper in (Rattle(), Suzuki4()):
        assert distance(stepper.step(system, state, 0.05), stepper.step(other, state, 0.05)) <= 1e-14


def test_what_came_in_stays_as_it_was() -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def force(x, t):
        seen.append((x, x.copy()))
        return springs(x, t)

    system, state = triangles(force=force)
    state = system.with_forces(state)
    arrays = (state.positions, state.velocities, state.forces)
    before = [a.copy() for a in arrays]
    for array in arrays:
        array.flags.writeable = False
    for stepper in STEPPERS:
        stepper.step(system, state, 0.05)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))
    assert len(seen) == 1 + sum(stepper.force_evaluations for stepper in STEPPERS)
    assert all(np.array_equal(a, b) for a, b in seen)


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("at_call", [1, 2, 3])
def test_a_force_that_is_not_finite(stepper, bad, at_call) -> None:
    calls = 0

    def force(x, t):
        nonlocal calls
        calls += 1
        f = springs(x, t)
        if calls == at_call:
            f[7, 1] = bad
        return f

    system, state = triangles(force=force)
    system.force = springs
    state = run(system, state, 0.01, 4, stepper=stepper)
    system.force = force
    before = state.positions.copy(), state.velocities.copy()
    with pytest.raises(NonFiniteError, match="non-finite force at step 5 on atom 7") as caught:
        for _ in range(3):
            state_5 = stepper.step(system, state, 0.01)
            assert state_5.step == 5
    assert caught.value.step == 5
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])


@pytest.mark.parametrize("piecewise", [False, True])
def test_numbers_that_overflow(piecewise) -> None:
    alone = (np.arange(34) == 33)[:, None]  # the free atom, of which the engine knows nothing
    system, state = triangles(ions=1, force=None, piecewise=piecewise)
    for stepper in (Rattle(), BlanesMoan6()):
        with pytest.raises(NonFiniteError, match="non-finite position at step 1 on atom 33"):
            stepper.step(system, State(state.positions, alone * np.full(3, 1.7e308)), 10.0)

    system, state = triangles(ions=1, force=lambda x, t: alone * np.full(3, 1e308), piecewise=piecewise)
    start = State(state.positions, alone * np.full(3, 1.797e308), forces=np.zeros((34, 3)))
    with pytest.raises(NonFiniteError, match="non-finite velocity at step 1 on atom 33"):
        Rattle().step(system, start, 1.0)


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_a_step_without_solution_names_row_and_step(stepper) -> None:
    errors = []
    for piecewise in (False, True):
        system, state = triangles(piecewise=piecewise)
        with pytest.raises(ConvergenceError) as caught:
            run(system, state, 30.0, 3, stepper=stepper)
        errors.append(caught.value)
    assert errors[0].step == errors[1].step and errors[0].step is not None
    assert errors[0].row == errors[1].row and errors[0].row is not None
    assert "time step too large" in str(errors[0])


def test_the_engine_takes_over_in_the_middle_of_a_stage() -> None:
    """Steps so long that some flights take many iterations or a rescue, and some have no solution."""
    taken = failed = 0
    (system, state), (other, _) = triangles(force=None), triangles(force=None, piecewise=True)
    engine, calls = system.motion.project_positions, []

    def counted(*args, **kwargs):
        calls.append(kwargs["dt"])
        return engine(*args, **kwargs)

    system.motion.project_positions = counted
    for stepper in STEPPERS:
        for dt in np.geomspace(0.5, 8.0, 20):
            calls.clear()
            outcomes = []
            for each in (system, other):
                try:
                    outcomes.append(stepper.step(each, state, float(dt)))
                except KconsError as error:
                    outcomes.append(error)
            one, two = outcomes
            if isinstance(two, State):
                assert isinstance(one, State)
                assert distance(one, two) <= 1e-10
                assert np.abs(system.motion.constraint_set.value(one.positions)).max() <= 1e-13
                taken += bool(calls)
            else:
                assert type(one) is type(two) and one.row == two.row
                failed += 1
    assert taken >= 5 and failed >= 5


def test_what_is_left_to_the_engine() -> None:
    x = SHAPE + 0.0
    m = np.array([16.0, 1.0, 1.0])

    def packed(*rows, x=x, m=m):
        return System(Motion(ConstraintSet(rows, x, m), x)).packed

    assert packed(Distance(PAIRS)) is not None
    assert packed(Distance(PAIRS[:2])) is not None
    assert packed(Distance(PAIRS[:2]), FixedAtoms([0])) is not None
    assert packed() is not None
    lengths = np.linalg.norm(x[[0, 0, 1]] - x[[1, 2, 2]], axis=1)
    moving = MovingTarget(lambda t: lengths + 0.1 * t)
    assert packed(Distance(PAIRS, moving)) is None
    assert packed(Distance([[0, 1]]), Angle([[1, 0, 2]])) is not None
    assert packed(Distance([[0, 1]]), Plane(2, [0, 0, 1.0])) is not None
    assert packed(Distance([[0, 1]]), Plane(2, [0, 0, 1.0], MovingTarget(lambda t: 0.1 * t))) is None
    assert (
        packed(ImplicitSurface([0, 2], lambda r: r[:, 2] ** 3 + r[:, 2], lambda r: (3 * r**2 + 1) * [0, 0, 1.0]))
        is None
    )
    many = np.arange(6.0 * (MOST_ROWS + 1)).reshape(-1, 3)
    pairs = np.arange(2 * MOST_ROWS + 2).reshape(-1, 2)
    assert packed(Distance(pairs), x=many, m=np.ones(len(many))) is None
    assert packed(Distance(pairs[1:]), x=many, m=np.ones(len(many))) is not None
    particles = np.arange(MOST_ROWS + 1)
    assert packed(Sphere(particles, [0, 0, -9.0]), x=many, m=np.ones(len(many))) is None
    assert packed(Sphere(particles[1:], [0, 0, -9.0]), x=many, m=np.ones(len(many))) is not None


def test_a_new_cell_is_seen() -> None:
    cell = np.diag([9.0, 8.0, 7.0])
    (system, state), (other, _) = (triangles(cell=cell, pbc=True, piecewise=p) for p in (False, True))
    for each in (system, other):
        each.motion.set_cell(1.05 * cell, True)
    # Molecules whose atoms are in different cells.
    rng = np.random.default_rng(0)
    x = state.positions + rng.integers(-1, 2, size=state.positions.shape) * 1.05 * np.diag(cell)
    state = State(x, state.velocities)
    assert distance(BlanesMoan4().step(system, state, 0.05), BlanesMoan4().step(other, state, 0.05)) <= 1e-13


def test_reports_show_iterations() -> None:
    system, state = triangles()
    end = Rattle().step(system, state, 0.05)
    found = system.motion.report(end.positions, condition=False)
    assert all(3 <= kind.iterations <= MANY_ITERATIONS for kind in found.kinds)


# -- rows of mixed kinds ----------------------------------------------------------------------------

BUTANE = np.array([[0.0, 0, 0], [1.5, 0, 0], [2.0, 1.4, 0], [3.5, 1.4, 0.5]])
BONDS = [[0, 1], [1, 2], [2, 3]]
#: Name -> rows on a chain of four atoms and two atoms apart, fixed atoms among them, and further options.
MIXED = {
    "cylinder": ([Cylinder([4], [0.0, 0, 0], [0, 0, 1.0])], {}),
    "two surfaces": ([Ellipsoid([4], [0, 0, 0], [1.0, 2, 3], target=None), Plane([5], [0, 0.6, 0.8])], {}),
    "formula": ([Formula("x1**2 + y1**4 + z1**2", [4], target=None)], {}),
    "angles": ([Distance(BONDS), Angle([[0, 1, 2], [1, 2, 3]])], {}),
    "dihedral and a surface": ([Distance(BONDS), Dihedral([[0, 1, 2, 3]]), Sphere([4], [0.0, 0, 0])], {}),
    "distances apart": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {}),
    "rigid triangles, and more": ([Distance([[0, 1], [0, 2], [1, 2]]), Plane([5], [0, 0.6, 0.8])], {}),
    "centres": ([CenterDistance([[0, 1], [2, 3]], [[4], [5]])], {}),
    "fixed atoms": ([Distance(BONDS), Angle([[0, 1, 2]]), Sphere([4], [0.0, 0, 0]), FixedAtoms([0, 5])], {}),
    "few among many": ([Distance([[4, 5]]), Sphere([4], [0.0, 0, 0])], {"ions": 30}),
    "periodic": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {"cell": np.diag([9.0, 8.0, 7.0])}),
    "far": ([Distance(BONDS), Angle([[0, 1, 2]])], {"at": 1e5, "force": lambda x, t: -0.1 * (x - x.mean(axis=0))}),
    "no force": ([Distance(BONDS), Angle([[0, 1, 2]])], {"force": None}),
}


def mixed(name: str, *, force=springs, piecewise: bool = False) -> tuple[System, State]:
    rows, given = MIXED[name]
    options = dict(given)
    ions, at, force = options.pop("ions", 0), options.pop("at", 0.0), options.pop("force", force)
    rng = np.random.default_rng(7)
    x = np.concatenate([BUTANE, [[0.3, 0.2, 4.0], [1.0, 1.0, 5.0]], rng.normal(size=(ions, 3))]) + at
    m = np.concatenate([[12.0, 14.0, 1.0, 16.0, 2.0, 3.0], np.full(ions, 23.0)])
    motion = Motion(ConstraintSet(rows, x, m, **options), x)
    if "cell" in options:
        x = x + rng.integers(-1, 2, size=x.shape) @ options["cell"]
    system = System(motion, force)
    assert system.packed is not None
    if piecewise:
        system.packed = None
    return system, system.initial_state(x, 0.3 * rng.normal(size=x.shape), project=True)


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("name", MIXED)
def test_mixed_rows_are_those_made_piece_by_piece(stepper, name) -> None:
    (system, state), (other, _) = mixed(name), mixed(name, piecewise=True)
    calls = []
    for call in ("project_positions", "project_velocities"):
        setattr(system.motion, call, calls.append)
    rounding = float(np.spacing(np.abs(state.positions).max()))
    for dt in (0.02, -0.01, 0.015):
        following, expected = stepper.step(system, state, dt), stepper.step(other, state, dt)
        assert distance(following, expected) <= 2e-14 + 8 * rounding
        assert distance(following, state) > 1e-4
        assert (following.remainder is None) == (expected.remainder is None) == (name != "far")
        state = following
    assert not calls
    del system.motion.project_positions, system.motion.project_velocities
    one, two = (run(each, state, 0.01, 30, stepper=stepper) for each in (system, other))
    assert distance(one, two) <= 1e-12 + 100 * rounding
    assert one.step == two.step and one.time == two.time


@pytest.mark.parametrize("name", ["two surfaces", "angles", "dihedral and a surface", "distances apart"])
def test_mixed_steps_without_solution_are_the_engines(name) -> None:
    """The same error, for the same row, after which a usual step is what it would have been."""
    taken = failed = 0
    pair = [mixed(name, force=None, piecewise=p) for p in (False, True)]
    for stepper in (Rattle(), Suzuki4(), BlanesMoan4()):
        for dt in np.geomspace(0.5, 20.0, 6):
            outcomes = []
            for system, state in pair:
                before = state.positions.copy(), state.velocities.copy()
                try:
                    outcomes.append(stepper.step(system, state, float(dt)))
                except KconsError as error:
                    outcomes.append(error)
                assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])
            one, two = outcomes
            if isinstance(two, State) and isinstance(one, State):
                held = pair[0][0].motion.constraint_set
                assert np.all(np.abs(held.value(one.positions)) <= held.tolerance(one.positions, 0.0))
                taken += 1
            else:
                assert isinstance(one, KconsError) and isinstance(two, KconsError)
                assert type(one) is type(two) and one.row == two.row and one.atoms == two.atoms and one.step == 1
                failed += 1
            (system, state), (other, _) = pair
            assert distance(stepper.step(system, state, 0.02), stepper.step(other, state, 0.02)) <= 2e-14
    assert taken >= 3 and failed >= 3


def test_what_a_python_row_raises_comes_out_of_a_step() -> None:
    broken = []

    def function(r):
        if broken:
            raise ZeroDivisionError("of its own")
        return float(r[0] @ r[0])

    x = np.array([[1.0, 0.2, 0.1]])
    system = System(Motion(ConstraintSet(Custom([[0]], function, lambda r: 2 * r), x, [1.0]), x), springs)
    assert system.packed is not None
    state = run(system, system.initial_state(x, [[0.0, 0.1, 0.0]], project=True), 0.01, 5)
    kept = state.copied()
    broken.append(True)
    with pytest.raises(ZeroDivisionError, match="of its own"):
        Rattle().step(system, state, 0.01)
    assert distance(state, kept) == 0.0
    broken.clear()
    assert np.abs(system.motion.constraint_set.value(Rattle().step(system, state, 0.01).positions)).max() < 1e-13


@pytest.mark.parametrize("stepper", [Rattle(), BlanesMoan4()], ids=repr)
@pytest.mark.parametrize("march", [False, True], ids=["steps", "march"])
def test_what_a_python_row_raises_once_is_not_lost(stepper, march) -> None:
    """An interrupt comes in any call, of positions or velocities, and the next one would go well."""
    left = 0

    def function(r):
        nonlocal left
        left -= 1
        if left == 0:
            raise KeyboardInterrupt
        return float(r[0] @ r[0])

    x = np.array([[1.0, 0.2, 0.1]])
    system = System(Motion(ConstraintSet(Custom([[0]], function, lambda r: 2 * r), x, [1.0]), x), springs)
    state = system.initial_state(x, [[0.0, 0.1, 0.0]], project=True)
    for calls in range(1, 40, 3):
        left, kept = calls, state.copied()
        with pytest.raises(KeyboardInterrupt):
            if march:
                stepper.march(system, state, 0.01, 12)
            else:
                run(system, state, 0.01, 12, stepper=stepper)
        assert distance(state, kept) == 0.0


def test_copies_of_a_system_have_solvers_of_their_own() -> None:
    """What kernels are called by is an address: that of the copy's rows, which live as long as the copy."""
    system, state = mixed("dihedral and a surface")
    end = run(system, state, 0.01, 3)
    others = [copy.deepcopy(system), pickle.loads(pickle.dumps(system))]
    del system
    for other in others:
        assert other.packed is not None
        assert distance(run(other, state, 0.01, 3), end) == 0.0


def test_two_systems_of_one_motion_do_not_share_rooms() -> None:
    system, state = mixed("angles")
    other = System(system.motion, springs)
    assert not np.shares_memory(system.packed.tables, other.packed.tables)
    assert distance(Rattle().step(system, state, 0.02), Rattle().step(other, state, 0.02)) == 0.0
