"""Operations as data."""

from __future__ import annotations

import dataclasses
import math

import pytest

from kcons.steppers.operations import (
    Damp,
    Evaluate,
    Exchange,
    Fly,
    Kick,
    Project,
    Settle,
    Turn,
    drifts_of,
    mirrored,
    splitting,
)


def test_mirrored_fractions() -> None:
    odd, even = mirrored((0.1, -0.3)), mirrored((0.1, -0.3), 2)
    assert odd == (0.1, -0.3, 1.4, -0.3, 0.1)
    assert even == (0.1, -0.3, 0.7, 0.7, -0.3, 0.1)
    assert math.fsum(odd) == math.fsum(even) == 1.0
    assert mirrored(()) == (1.0,) and mirrored((), 2) == (0.5, 0.5)


def test_drifts_know_where_their_flights_end() -> None:
    first, second = drifts_of((0.5, 0.5), (0.25, 0.5, 0.25))
    assert first == Fly(0.5, (0.125, 0.25, 0.125), (0.125, 0.375, 0.5))
    assert second.ends == (0.625, 0.875, 1.0)
    assert drifts_of((1.0,), exact=True) == (Fly(1.0, (1.0,), (1.0,), True),)


def test_kicks_or_drifts_come_first() -> None:
    half = drifts_of((0.5, 0.5))
    assert splitting((0.5, 0.5), (1.0,)) == (Kick(0.5), *drifts_of((1.0,)), Evaluate(), Kick(0.5), Project())
    assert splitting((1.0,), (0.5, 0.5)) == (half[0], Evaluate(), Kick(1.0), half[1], Project())


def test_settled_and_damped() -> None:
    first, second = drifts_of((0.25, 0.75))
    settled = splitting((0.1, 0.8, 0.1), (0.25, 0.75), settled=True)
    assert settled == (Kick(0.125), first, Settle(0.125), Kick(0.375), second, Settle(0.375))
    damped = splitting((0.5, 0.5), (1.0,), (0.25, 0.75), damped=True)
    assert damped[1:4] == (Damp(0.125), first, Damp(0.125))
    assert damped[4:7] == (Damp(0.375), second, Damp(0.375))


def test_operations_are_values() -> None:
    assert Kick(0.5) == Kick(0.5) != Turn(0.5)
    assert len({Kick(0.5), Kick(0.5), Kick(1.0), Evaluate(), Evaluate(), *drifts_of((1.0,)), *drifts_of((1.0,))}) == 4
    with pytest.raises(dataclasses.FrozenInstanceError):
        Kick(0.5).fraction = 1.0  # type: ignore[misc]


def test_words() -> None:
    assert str(Exchange(1.0)) == "exchange  1             let the heat bath act on velocities along the constraints"
    assert str(Evaluate()).split(maxsplit=1) == ["evaluate", "forces at the new positions"]
    assert str(Fly(0.5, (0.25, 0.25), (0.25, 0.5))).endswith("along the constraints, in 2 flights")
    assert str(Fly(0.5, (0.5,), (0.5,), True)).endswith("along great circles")
