"""The parts of the whole comparison: test systems and sizes, what is left out of them and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from kcons.errors import InputError, did_you_mean


@dataclass(frozen=True)
class Item:
    """One part of the whole comparison.

    Attributes
    ----------
    key : str
        Name of its files.
    heading : str
    scene : str
        A key of `test_systems.SYSTEMS`.
    size : int or None
    options : mapping
        For the test system.
    steps : sequence of float or None
        Time steps in the unit the test system shows, instead of its own.
    pace : float
        The finest step times this decides about the work of a converged reference.
    without : mapping of str to str
        Beginnings of names of methods that are left out, and why.
    needs : str
        A package without which it cannot run.
    budget : float
        Seconds a method.
    seconds : float
        What a full run of it takes on one core, for the time left.
    quick_seconds : float
        The same in a quick run; 0 where it is left out of it.
    quick_size : int or None
        Size in a quick run, by default what the test system says.
    """

    key: str
    heading: str
    scene: str = ""
    size: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    steps: Sequence[float] | None = None
    pace: float | None = None
    without: Mapping[str, str] = field(default_factory=dict)
    needs: str = ""
    budget: float = 15.0
    seconds: float = 30.0
    quick_seconds: float = 6.0
    quick_size: int | None = None


def _molecule(structure: str, text: str, constrain: str, title: str, **more: Any) -> Item:
    key = f"{structure}-{constrain}"
    return Item(key, f"{text}, {title}", structure, options={"constrain": constrain}, needs="openmm", **more)


#: Steps that choose their size are for few atoms and smooth forces.
FEW = dict.fromkeys(("extrapolation", "multistep"), "meant for few atoms; smaller systems show it")
TOO_LONG = {"ase-internals": "a step takes longer than the whole budget; smaller systems show it"}
TOO_LARGE = FEW | dict.fromkeys(
    ("ase-bonds", "ase-internals", "openmm-verlet-", "openmm-rattle-", "openmm-held", "dop853"),
    "too large for it: its own Python loops over bonds, or its set-up, would take hours",
)
SAVE_TIME = "left out to save time; smaller systems show it"
CCMA = "CCMA takes a minute to set up for these constraints, each time, and loops in Python longer for a step"

#: All parts, in the order in which they are run and shown.
PLAN: tuple[Item, ...] = (
    Item("sphere", "Free particles on spheres", "sphere", seconds=70, quick_seconds=6),
    Item("sphere-pendulum", "Spherical pendulums", "sphere-pendulum", seconds=55, quick_seconds=6),
    Item("sphere-pendulum-top", "Spherical pendulum that passes near the top", "sphere-pendulum-top", seconds=85),
    Item("pendulum", "Planar pendulum from 179.9°", "pendulum", seconds=50, quick_seconds=5),
    Item("triple-pendulum", "Triple pendulum", "triple-pendulum", seconds=55, quick_seconds=5),
    Item("rotor", "Asymmetric top", "rotor", seconds=120, quick_seconds=6),
    Item("dumbbells", "Two colliding dumbbells", "dumbbells", seconds=180, quick_seconds=6),
    Item("fekete", "Fekete points on a sphere", "fekete", seconds=60),
    Item("ethanol", "Ethanol, GFN2-xTB", "ethanol", needs="tblite", seconds=80, quick_seconds=20, budget=20),
    Item("water-216", "Water, 216 molecules", "water", 216, seconds=400, quick_seconds=16, quick_size=8, budget=20),
    Item(
        "water-900",
        "Water, 900 molecules",
        "water",
        900,
        without=TOO_LONG | FEW,
        seconds=600,
        quick_seconds=0,
        budget=20,
    ),
    Item(
        "water-5000",
        "Water, 5000 molecules",
        "water",
        5000,
        steps=(4.0, 2.0, 1.0),
        pace=2.0,
        without=FEW
        | dict.fromkeys(
            ("ase-internals", "dop853", "openmm-middle", "openmm-nose", "kahan-li6", "openmm-kcons-kahan-li6"),
            SAVE_TIME,
        ),
        seconds=500,
        quick_seconds=0,
        budget=15,
    ),
    Item("chain-1e2", "Chain of 10² bonds", "chain", 100, seconds=160, quick_seconds=14),
    Item("chain-1e3", "Chain of 10³ bonds", "chain", 1000, seconds=250, quick_seconds=14),
    Item("chain-1e4", "Chain of 10⁴ bonds", "chain", 10_000, without=TOO_LONG, seconds=600, quick_seconds=0, budget=10),
    Item(
        "chain-1e5",
        "Chain of 10⁵ bonds",
        "chain",
        100_000,
        steps=(10.0, 5.0, 2.5),
        pace=2.0,
        without=TOO_LARGE,
        seconds=170,
        quick_seconds=0,
        budget=10,
    ),
    Item(
        "chain-1e6",
        "Chain of 10⁶ bonds",
        "chain",
        1_000_000,
        steps=(10.0, 5.0, 2.5),
        pace=2.0,
        without=TOO_LARGE | dict.fromkeys(("openmm", "kahan-li6"), SAVE_TIME),
        seconds=280,
        quick_seconds=0,
        budget=20,
    ),
    *(
        _molecule("alanine", "Alanine dipeptide", constrain, title, seconds=110, quick_seconds=14)
        for constrain, title in (("hbonds", "HBonds"), ("allbonds", "AllBonds"), ("hangles", "HAngles"))
    ),
    *(
        _molecule("dhfr", "DHFR", constrain, title, without=FEW, seconds=250, quick_seconds=0, budget=15)
        for constrain, title in (("hbonds", "HBonds"), ("allbonds", "AllBonds"))
    ),
    _molecule(
        "dhfr",
        "DHFR",
        "hangles",
        "HAngles",
        steps=(2.0, 1.0),
        without=FEW
        | dict.fromkeys(
            (
                "ase-bonds",
                "ase-internals",
                "openmm-verlet-",
                "openmm-middle",
                "openmm-nose",
                "openmm-kcons-",
                "openmm-rattle",
            ),
            CCMA,
        ),
        seconds=200,
        quick_seconds=0,
        budget=75,
    ),
)


def chosen(keys: Sequence[str] | None = None) -> list[Item]:
    """Parts by key; all by default. A name of a test system stands for all its parts.

    Raises
    ------
    InputError
        Unknown key.
    """
    if not keys:
        return list(PLAN)
    found: dict[str, Item] = {}
    for key in keys:
        fitting = [item for item in PLAN if key == item.key] or [item for item in PLAN if key == item.scene]
        if not fitting:
            known = ", ".join(item.key for item in PLAN)
            meant = did_you_mean(key, [item.key for item in PLAN])
            raise InputError(f"there is no part {key!r} of the comparison{meant}; there are {known}", item="only")
        found |= {item.key: item for item in fitting}
    return [item for item in PLAN if item.key in found]
