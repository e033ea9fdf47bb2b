"""Schemes by name, and their stages."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from kcons.errors import InputError
from kcons.steppers.operations import Fly, Kick, Operation, Turn
from kcons.steppers.splitting import SCHEMES as STEPPERS
from kcons.steppers.splitting import Splitting
from kcons.thermostats.isokinetic import SCHEMES as ISOKINETIC


def _any_flows(order: int) -> Splitting:
    """A splitting that keeps its order with any kicks, those of the isokinetic thermostat among them."""
    splitting = Splitting(*ISOKINETIC[order])
    splitting.order = order
    return splitting


#: Schemes by name.
SCHEMES: dict[str, Callable[[], Splitting]] = {
    **STEPPERS,
    "isokinetic4": lambda: _any_flows(4),
    "isokinetic6": lambda: _any_flows(6),
}


def to_scheme(scheme: str | Splitting) -> Splitting:
    """The splitting of a name.

    Raises
    ------
    InputError
        An unknown name.
    """
    if isinstance(scheme, Splitting):
        return scheme
    if not isinstance(scheme, str) or scheme not in SCHEMES:
        raise InputError(f"no scheme {scheme!r}; known: {', '.join(SCHEMES)}", item="scheme")
    return SCHEMES[scheme]()


def stages_of(operations: Iterable[Operation]) -> tuple[list[float], list[float]]:
    """Drifts, and the kick before each of them and after the last, as fractions of the step."""
    drifts: list[float] = []
    kicks = [0.0]
    for operation in operations:
        if isinstance(operation, Kick | Turn):
            kicks[-1] += operation.fraction
        elif isinstance(operation, Fly):
            drifts += operation.flights
            kicks += [0.0] * len(operation.flights)
    return drifts, kicks
