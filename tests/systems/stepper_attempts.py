"""What steps of their own size are made of: forces that are counted, attempts that are watched."""

from __future__ import annotations

from kcons.motion import Motion
from kcons.steppers import (
    Extrapolation,
    State,
    System,
)
from kcons.steppers.extrapolation import _Table


def end_of(scheme: Extrapolation, system: System, state: State, until: float) -> State:
    *_, end = scheme.states(system, state, until)
    return end


def counted(system: System, **options) -> tuple[System, list[float]]:
    """The same, and the times at which its forces are asked for."""
    times: list[float] = []

    def force(x, *rest):
        times.append(rest[-1])
        return system.force(x, *rest)

    return System(system.motion, force, velocity_dependent=system.velocity_dependent, **options), times


def attempts(monkeypatch) -> list[tuple[float, float, bool]]:
    """From now on: time, size, and whether it was accepted, for each attempt at a step."""
    made: list[tuple[float, float, bool]] = []
    fill = _Table.fill

    def watched(table, aim):
        number = len(made)
        made.append((table.start.time, table.size, False))
        fits = fill(table, aim)
        made[number] = (table.start.time, table.size, fits)
        return fits

    monkeypatch.setattr(_Table, "fill", watched)
    return made


def system_of_test(system, far: float = 8.0) -> tuple[System, list[float]]:
    motion = Motion(system.constraint_set, system.positions)
    return counted(System(motion, system.potential.forces), far=far)
