"""What is held of a system, by name: the same options for MDAnalysis, ASE and OpenMM, documented once."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypedDict, TypeVar

from numpy.typing import ArrayLike

from kcons.constraints import Constraint
from kcons.constraints.arguments import checked
from kcons.constraints.constraint import IntArray
from kcons.errors import InputError, did_you_mean
from kcons.topology.rigid_groups import GEOMETRIES, WATER

#: What can be held by name, and what that means.
CONSTRAIN: dict[str, str] = {
    "none": "no bonds",
    "hbonds": "bonds with a hydrogen",
    "allbonds": "all bonds",
    "hangles": "all bonds, and the angles H-X-H and H-O-X",
    "allangles": "all bonds and all angles",
}

#: Rows on a selection: gets the atoms, gives constraints.
RowMaker = Callable[[IntArray], Constraint]

F = TypeVar("F", bound=Callable[..., Any])


class Options(TypedDict, total=False):
    """Options of `Holding` beside `constrain`."""

    rigid_water: bool
    water_names: Iterable[str]
    water_geometry: str | tuple[float, float] | None
    rigid_residues: Iterable[str]
    rigid_bodies: Iterable[str | Sequence[int] | IntArray]
    angles: Literal["angles", "distances"]
    on: Mapping[Any, RowMaker] | Sequence[tuple[Any, RowMaker]] | None
    select: ArrayLike | str
    guess_bonds: bool | Literal["missing"]


@dataclass(frozen=True)
class Holding:
    """What is held of a system.

    Parameters
    ----------
    constrain : {'hbonds', 'allbonds', 'hangles', 'allangles', 'none'} or None
        Bonds with hydrogens; all bonds; these and the angles H-X-H and H-O-X; all bonds and angles. The first three
        are what they are in OpenMM. The rows of the last are independent: not every angle is one, and flat centers and
        rings have dihedrals, see `kcons.topology.angle_rows`.
    rigid_water : bool
        Hold water by three distances; found by residue name and composition. Sites without mass (TIP4P) are placed,
        not held: ``.virtual_sites``.
    water_names : iterable of str
        Residue names that are water besides the usual ones.
    water_geometry : str, (float, float) or None
        'tip3p', 'spc', ..., or O-H length in angstrom and H-O-H angle in degrees; None holds each molecule as it is.
    rigid_residues : iterable of str
        Names of residues held rigid, each by itself.
    rigid_bodies : iterable
        Lists of atoms (or selections in words for MDAnalysis), each held rigid as a whole.
    on : mapping or sequence of pairs, optional
        Rows on selections: selection -> callable that gets its atoms and gives a constraint, for example
        ``{"protein": CenterOfMass}`` for MDAnalysis, ``{(0, 1, 2): CenterOfMass}`` for the others.
    select : 'all', mask, atoms or str
        Rows are kept if all of their atoms are among these; `rigid_bodies` and `on` are not restricted. For MDAnalysis
        words or an AtomGroup, for the others masks and numbers of atoms.
    angles : {'angles', 'distances'}
        Angles as rows in radian, or as distances of their ends as in OpenMM.
    guess_bonds : bool or 'missing'
        'missing' guesses bonds of atoms without any, with a warning; False never; True all of them anew.
    """

    constrain: str | None = "hbonds"
    rigid_water: bool = True
    water_names: Iterable[str] = ()
    water_geometry: str | tuple[float, float] | None = None
    rigid_residues: Iterable[str] = ()
    rigid_bodies: Iterable[str | Sequence[int] | IntArray] = ()
    on: Mapping[Any, RowMaker] | Sequence[tuple[Any, RowMaker]] | None = None
    select: ArrayLike | str = "all"
    angles: Literal["angles", "distances"] = "angles"
    guess_bonds: bool | Literal["missing"] = "missing"

    def __post_init__(self) -> None:
        if self.kind not in CONSTRAIN:
            raise InputError(
                f"cannot constrain {self.constrain!r}{did_you_mean(self.kind, CONSTRAIN)}; there are "
                f"{', '.join(CONSTRAIN)}",
                item="constrain",
            )
        if not (self.kind != "none" or self.rigid_water or self.residues or self.bodies or self.on):
            raise InputError("nothing is to be held; name bonds, water, residues, bodies or rows", item="constrain")
        for entry in self.own_rows:
            if not (isinstance(entry, tuple | list) and len(entry) == 2 and callable(entry[1])):
                raise InputError(
                    f"on has {entry!r:.100}; give pairs of a selection and what gets its atoms and makes a constraint, "
                    "such as the class kcons.constraints.CenterOfMass itself",
                    item="on",
                )

    @property
    def kind(self) -> str:
        """What is held of bonds and angles, a key of `CONSTRAIN`."""
        return "none" if self.constrain is None else str(self.constrain).lower()

    @cached_property
    def residues(self) -> tuple[str, ...]:
        """Names of the residues that are held rigid."""
        return (self.rigid_residues,) if isinstance(self.rigid_residues, str) else tuple(self.rigid_residues)

    @cached_property
    def bodies(self) -> tuple[str | Sequence[int] | IntArray, ...]:
        """What is held rigid, as it was given."""
        one = isinstance(self.rigid_bodies, str) or hasattr(self.rigid_bodies, "atoms")  # words, or an AtomGroup
        return (self.rigid_bodies,) if one else tuple(self.rigid_bodies)  # type: ignore[return-value]

    @cached_property
    def own_rows(self) -> tuple[tuple[Any, RowMaker], ...]:
        """Selections and what makes rows of them."""
        return tuple(self.on.items() if isinstance(self.on, Mapping) else self.on or ())

    @property
    def waters(self) -> frozenset[str]:
        """Residue names that are rigid water, in capitals."""
        return WATER | {str(n).strip().upper() for n in self.water_names} if self.rigid_water else frozenset()

    def geometry(self) -> tuple[tuple[float, float] | None, float]:
        """O-H length (angstrom) and H-O-H angle (degrees) of water, None as found; O-M length of a named model."""
        given = self.water_geometry
        if given is None:
            return None, 0.0
        if isinstance(given, str):
            name = given.lower().replace("-", "").replace("/", "").replace("_", "")
            if name not in GEOMETRIES:
                raise InputError(
                    f"no water model {given!r}{did_you_mean(given, GEOMETRIES)}; there are {', '.join(GEOMETRIES)}; or "
                    "give (O-H in angstrom, H-O-H in degrees)",
                    item="water_geometry",
                )
            length, angle, site = GEOMETRIES[name]
            return (length, angle), site
        return water_geometry(given, "water_geometry"), 0.0


Holding.__init__ = checked(Holding.__init__)  # type: ignore[method-assign]


def water_geometry(given: Any, item: str) -> tuple[float, float]:
    """O-H length (angstrom) and H-O-H angle (degrees) that somebody gave."""
    try:
        length, angle = (float(v) for v in given)
    except (TypeError, ValueError):
        raise InputError(f"{item} is {given!r:.80}; give (O-H in angstrom, H-O-H in degrees)", item=item) from None
    if not (0 < length < math.inf and 60 < angle < 180):
        raise InputError(
            f"water of O-H {length:g} angstrom and H-O-H {angle:g} degrees: give a positive length, and an angle "
            "between 60 and 180 in degrees",
            item=item,
        )
    return length, angle


#: What functions with these options give and refuse.
_RETURNS = """

Returns
-------
HeldRows
    A list of constraints; ``.constraint_set`` has them as a set.

Raises
------
InputError
    Selections that match nothing, unknown names, no coordinates, masses, elements or bonds.

Warns
-----
UserWarning
    If bonds were guessed without being asked for, or not for all hydrogens."""


def with_options(function: F) -> F:
    """Write the options of `Holding`, and what comes back, into documentation and signature of a function.

    They take the place of ``**options``, which ends the docstring of the function.
    """
    signature = inspect.signature(function)
    own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = inspect.signature(Holding).parameters.values()
    more = [p.replace(kind=p.KEYWORD_ONLY) for p in options if p.name not in signature.parameters]
    function.__signature__ = signature.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
    if function.__doc__ and Holding.__doc__:  # python -OO has none
        described = inspect.cleandoc(Holding.__doc__).partition("----------\n")[2] + _RETURNS
        function.__doc__ = inspect.cleandoc(function.__doc__).replace("**options", described, 1)
    return function
