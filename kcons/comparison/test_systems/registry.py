"""Test systems by name: `add_system` registers them, `build` makes them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from kcons.comparison.test_systems.system import TestSystem
from kcons.constraints.arguments import Count, Rng, checked, seed_from
from kcons.errors import InputError, unknown


@dataclass(frozen=True)
class Entry:
    """A test system by name; see `add_system`."""

    make: Callable[..., TestSystem]
    text: str
    size: int = 1
    quick_size: int | None = None
    unit: str = "system"
    only: bool = False
    takes: Collection[str] = ()
    options: Mapping[str, Any] = field(default_factory=dict)


SYSTEMS: dict[str, Entry] = {}


def add_system(name: str, make: Callable[..., TestSystem], text: str, **about: Any) -> None:
    """Register a test system for `build` and `kcons compare`, in place of one of that name.

    Parameters
    ----------
    name : str
        By which it is chosen.
    make : callable
        Size, rng and options to a `TestSystem`.
    text : str
        For the list of test systems.
    size, quick_size : int
        By default, and with `quick`.
    unit : str
        What the size counts.
    only : bool
        Whether it has this size and no other.
    takes : collection of str
        Options of `make` that may be chosen.
    options : mapping
        Options of `make` that belong to the name.
    """
    SYSTEMS[name] = Entry(make, text, **about)


@checked
def build(name: str, size: Count | None = None, rng: Rng = 1, *, quick: bool = False, **options: Any) -> TestSystem:
    """The test system called `name`.

    Parameters
    ----------
    name : str
        A key of `SYSTEMS`.
    size : int, optional
        Number of molecules, bonds or particles.
    rng : int, numpy.random.Generator or None
    quick : bool
        A smaller default size, half the horizon.
    **options
        What the test system takes, for example ``forces='ase'`` for water.

    Raises
    ------
    InputError
        Unknown name; a size the test system cannot be built at; an option that it does not take.
    """
    if name not in SYSTEMS:
        raise InputError(f"there is no test system {unknown(name, SYSTEMS)}", item="system")
    entry = SYSTEMS[name]
    if size is None:
        size = entry.quick_size if quick and entry.quick_size else entry.size
    if entry.only and size != entry.size:
        raise InputError(f"{name} is one {entry.unit}; it cannot be built at size {size}", item="size")
    for option in sorted(set(options) - set(entry.takes)):
        raise InputError(f"{name} takes {', '.join(entry.takes) or 'no options'}, not {option}", item=option)
    system = entry.make(size, seed_from(rng), **{**entry.options, **options})
    return system.shortened(2) if quick else system
