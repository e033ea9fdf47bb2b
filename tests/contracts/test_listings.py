"""What steps consist of: the fractions of every stepper and thermostat, and that what is listed is what is done."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest

from kcons import steppers, thermostats
from kcons.constraints import Distance, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import (
    BlanesMoan4,
    Composition,
    Geodesic,
    Rattle,
    ReversibilityCheck,
    RungeKuttaNystrom,
    Splitting,
    Suzuki4,
    System,
)
from kcons.steppers.interpreter import Interpreted
from kcons.steppers.operations import Fly, Operation, Settle, Timed
from kcons.steppers.splitting import SCHEMES
from kcons.steppers.stepper import Listed
from kcons.thermostats import (
    ConstantPressure,
    Isokinetic,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    MonteCarloBarostat,
    NoseHooverChain,
)

ALL = [
    *(make() for make in SCHEMES.values()),
    *(Composition((0.25, 0.5, 0.25), 2), RungeKuttaNystrom((1.0,), (0.5, 0.5)), Splitting((1.0,), (0.5, 0.5))),
    *(Langevin(1.0, 0.5, 1), Langevin(1.0, 0.5, 1, substeps=1), ReversibilityCheck(Suzuki4())),
    *(Isokinetic(1.0), Isokinetic(1.0, order=4), Isokinetic(1.0, order=6)),
    *(LangevinRespa(1.0, 0.5, 1, steps={"slow": 1, "fast": 3}), LangevinRespa(1.0, 0.5, 1)),
    LangevinRespa(1.0, 0.5, 1, steps={"slow": 1, "fast": 2}, slow_kicks="middle"),
    *(IsokineticSpheres(1.0, 0.5, 1, steps={"a": 1, "b": 2, "c": 4}), IsokineticSpheres(1.0, 0.5, 1)),
    ConstantPressure(Langevin(1.0, 0.5, 1), MonteCarloBarostat(1.0)),
    *(NoseHooverChain(1.0, 9.0),),
]
LISTED = [stepper for stepper in ALL if isinstance(stepper, Listed)]
STEPPERS = pytest.mark.parametrize("stepper", LISTED, ids=repr)
#: Kicks of all kinds share the step among themselves, and so do drifts, and each kind of bath.
SHARING = [("kick", "settle", "turn"), ("fly",), ("exchange",), ("chain",)]


def systems() -> dict[str, System | None]:
    """What makes something else of a step."""
    x = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.6, 0.8]])
    spheres = Motion(ConstraintSet([Sphere([0, 1, 2], np.zeros(3), 1.0)], x, np.ones(3)), x)
    bond = Motion(ConstraintSet([Distance([0, 1])], x, np.ones(3)), x)
    return {
        "nothing known": None,
        "bonds": System(bond),
        "great circles": System(spheres),
        "forces of velocities": System(bond, lambda x, v, t: -v, velocity_dependent=True),
    }


SYSTEMS = systems()


def test_every_public_stepper_is_here() -> None:
    public = [getattr(folder, name) for folder in (steppers, thermostats) for name in folder.__all__]
    listed = {each for each in public if isinstance(each, type) and issubclass(each, Listed)}
    assert listed == {type(stepper) for stepper in LISTED}
    # Those that choose their steps, or make those of another one, have no such list.
    others = {each for each in public if isinstance(each, type) and hasattr(each, "step")} - listed
    assert {each.__name__ for each in others} == {"HamiltonianMonteCarlo", "ReversibilityCheck", "Stepper"}


def each_system(stepper) -> Iterator[tuple[str, list[Operation]]]:
    """What a step consists of in every system, by its name."""
    return ((name, list(stepper.operations(system))) for name, system in SYSTEMS.items())


@STEPPERS
def test_fractions_share_the_step(stepper) -> None:
    for name, operations in each_system(stepper):
        groups = {getattr(operation, "group", "") for operation in operations}
        for verbs, group in product(SHARING, groups):
            shared = [op for op in operations if op.verb in verbs and getattr(op, "group", "") == group]
            fractions = [operation.fraction for operation in shared]
            assert not fractions or math.fsum(fractions) == pytest.approx(1.0, abs=2e-15), name
        drifts = [operation for operation in operations if isinstance(operation, Fly)]
        # A drift ends where its flights have led, the last one at the end of the step.
        flown = 0.0
        for drift in drifts:
            assert math.fsum(drift.flights) == pytest.approx(drift.fraction, abs=2e-15), name
            assert len(drift.ends) == len(drift.flights)
            for length, end in zip(drift.flights, drift.ends, strict=True):
                flown += length
                assert end == pytest.approx(flown, abs=1e-14), name
        assert drifts[-1].ends[-1] == 1.0, name


@pytest.mark.parametrize("stepper", [stepper for stepper in LISTED if stepper.reversible], ids=repr)
def test_what_is_reversible_is_the_same_backwards(stepper) -> None:
    # A kick is undone by the one that is solved for.
    for name, operations in each_system(stepper):
        timed = [(op.verb, op.fraction) for op in operations if isinstance(op, Timed)]
        pairs = {"kick": "settle", "settle": "kick"} if any(verb == "settle" for verb, _ in timed) else {}
        mirrored = [(pairs.get(verb, verb), fraction) for verb, fraction in reversed(timed)]
        assert [verb for verb, _ in mirrored] == [verb for verb, _ in timed], name
        np.testing.assert_allclose([f for _, f in mirrored], [f for _, f in timed], rtol=0, atol=1e-15, err_msg=name)


@STEPPERS
def test_a_line_for_each_operation_that_is_run(stepper) -> None:
    """All that is listed as operations, and what the interpreter does between them."""
    for name, operations in each_system(stepper):
        first, *lines = stepper.listing(SYSTEMS[name]).splitlines()
        parts = stepper.parts(SYSTEMS[name])
        assert first == f"a step of {stepper!r}"
        for line, operation in zip(lines, parts, strict=True):
            verb, *rest = line.split()
            group = getattr(operation, "group", "")
            assert verb == operation.verb and line.endswith(operation.meaning + (f": {group}" if group else "")), name
            if isinstance(operation, Timed):
                assert float(rest[0]) == pytest.approx(operation.fraction, rel=1e-7), name
        verbs = iter(part.verb.removeprefix("first_") for part in parts)
        assert all(operation.verb in verbs for operation in operations), name
        if isinstance(stepper, Interpreted):  # each kick goes with what follows it
            program = stepper.program(SYSTEMS[name])
            run = [row.operation for row in program.rows if row.operation is not None]
            assert list(dict.fromkeys(run)) == list(dict.fromkeys(p for p in parts if p.verb != "kick")), name


def test_what_a_system_makes_of_a_step() -> None:
    def verbs(name: str) -> list[str]:
        return [operation.verb for operation in Geodesic(2).operations(SYSTEMS[name])]

    def drifts(name: str, stepper) -> list[Fly]:
        return [op for op in stepper.operations(SYSTEMS[name]) if isinstance(op, Fly)]

    plain = ["kick", "fly", "evaluate", "kick", "project"]
    assert verbs("nothing known") == verbs("bonds") == verbs("great circles") == plain
    assert verbs("forces of velocities") == ["kick", "fly", "settle"]
    for stepper in (Geodesic(2), BlanesMoan4(), Langevin(1.0, 1.0, 1)):
        assert all(drift.exact and len(drift.flights) == 1 for drift in drifts("great circles", stepper))
        assert not any(drift.exact or len(drift.flights) == 1 for drift in drifts("bonds", stepper))
    assert not any(drift.exact for drift in drifts("great circles", Rattle()))
    assert Suzuki4().operations(SYSTEMS["forces of velocities"])[2] == Settle(0.5 * Suzuki4().fractions[0])
