"""Forces in groups that are asked for at steps of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array, check_call
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError

ForceFunction = Callable[[FloatArray, float], ArrayLike]


class ForceGroups:
    """Applied forces as a sum of groups. It is the force function of a `System`: called, it gives the sum.

    Parameters
    ----------
    groups : mapping of str to callable
        Forces ``force(x, t)``, shape (n_atoms, 3), by name.

    Attributes
    ----------
    evaluations : dict of str to int
        How often each group was asked for.

    Raises
    ------
    InputError
        No groups; a name that is no text; one function in two groups, whose forces would count twice.
    """

    def __init__(self, groups: Mapping[str, ForceFunction]) -> None:
        if not isinstance(groups, Mapping) or not groups:
            raise InputError("there are no groups of forces; give a mapping of names to functions", item="groups")
        for name, force in groups.items():
            if not isinstance(name, str) or not name:
                raise InputError(f"a group of forces is called {name!r}; give it a name, a text", item="groups")
            if force is None:
                raise InputError(f"the force of group {name!r} is None; give a function of x, t", item=name)
            check_call(f"the force of group {name!r}", force, ("x", "t"))
            # By value: a method is another object each time it is looked up.
            other = next(other for other in groups if groups[other] == force)
            if other != name:
                raise InputError(
                    f"groups {other!r} and {name!r} overlap: both are {force!r}, whose forces would count "
                    "twice. Put it into one of them",
                    item=name,
                )
        self.groups: dict[str, ForceFunction] = dict(groups)
        self.evaluations = dict.fromkeys(self.groups, 0)

    @classmethod
    def difference(
        cls, cheap: ForceFunction, expensive: ForceFunction, *, fast: str = "fast", slow: str = "slow"
    ) -> ForceGroups:
        """`cheap` forces as the fast group, `expensive` less `cheap` ones as the slow group: `expensive` in all.

        Parameters
        ----------
        cheap, expensive : callable
            Of the same atoms.
        fast, slow : str
            Names of the groups.

        Raises
        ------
        InputError
            Both are the same function, or both groups have one name. While they run: their arrays differ in shape, so
            that they are of different systems.
        """
        if cheap == expensive:
            raise InputError("cheap and expensive forces are the same function; nothing is left to be slow", item=slow)
        if fast == slow:
            raise InputError(f"fast and slow forces are both called {fast!r}; give them two names", item="slow")
        return cls({fast: cheap, slow: Difference(cheap, expensive)})

    def __repr__(self) -> str:
        return f"ForceGroups({', '.join(self.groups)})"

    def __call__(self, x: FloatArray, time: float) -> FloatArray:
        """The sum over all groups."""
        total: FloatArray | None = None
        for name in self.groups:
            f = self.of(name, x, time)
            if total is None:
                total = np.array(f)
            elif f.shape != total.shape:
                raise InputError(
                    f"group {name!r} gives forces of shape {f.shape}, the groups before it {total.shape}: they are of "
                    "different systems",
                    item=name,
                )
            else:
                total += f
        assert total is not None
        return total

    def of(self, name: str, x: FloatArray, time: float) -> FloatArray:
        """Forces of one group."""
        f = as_float_array(self.groups[name](x, time), f"forces of group {name!r}")
        self.evaluations[name] += 1
        return f


class Difference:
    """Expensive forces less cheap ones at the same place."""

    def __init__(self, cheap: ForceFunction, expensive: ForceFunction) -> None:
        self.cheap, self.expensive = cheap, expensive

    def __call__(self, x: FloatArray, time: float) -> FloatArray:
        # A function may use its array again, also where both share it.
        less = np.array(as_float_array(self.cheap(x, time), "cheap forces"))
        whole = as_float_array(self.expensive(x, time), "expensive forces")
        if less.shape != whole.shape:
            raise InputError(
                f"cheap forces have shape {less.shape}, expensive ones {whole.shape}: they are of different systems, "
                "and their difference is none",
                item="forces",
            )
        return whole - less


def group_names(force: object, names: tuple[str, ...]) -> None:
    """Refuse forces whose groups are not those that a stepper has steps for.

    Raises
    ------
    UnsupportedError
        The forces are not in groups.
    InputError
        A group without a number of steps, or steps of a group that is not there.
    """
    if names == ("",):
        return
    if not isinstance(force, ForceGroups):
        raise UnsupportedError(
            f"the System has no groups of forces, and {', '.join(names)} were given steps; make it with "
            "System(motion, ForceGroups({...}))"
        )
    for name in names:
        if name not in force.groups:
            raise InputError(f"there is no group {name!r} of forces; there are {', '.join(force.groups)}", item="steps")
    for name in force.groups:
        if name not in names:
            raise InputError(f"group {name!r} of the forces has no number of steps; add it to steps", item="steps")
