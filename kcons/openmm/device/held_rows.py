"""What is held on the device: constraint objects of parts, their functions, and clusters that look alike."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.functions.straight_line import Function, function_of
from kcons.errors import UnsupportedError
from kcons.openmm.device.c_writer import c_functions

#: Rows, atoms of a cluster and atoms of a row up to which a work-item has the cluster in registers.
ITEM_ROWS, ITEM_ATOMS, ITEM_WIDTH = 6, 10, 4
#: How rows take their atoms, see `clusters.c`.
STORED, RELATIVE, NEAREST, IN_CELLS = range(4)


def constraints_of(parts: Any) -> list[Constraint]:
    """The constraint objects of parts as they were given, targets that were found included.

    Raises
    ------
    UnsupportedError
        Rows of another kind.
    """
    found: list[Constraint] = []
    for part in parts if isinstance(parts, Iterable) else (parts,):
        if isinstance(part, Constraint):
            found.append(part)
        elif hasattr(part, "given"):
            found += part.given
        else:
            raise UnsupportedError(
                f"{part!r} is not held on the device; give constraint objects of kcons, or leave it to the host "
                "(device=False)"
            )
    return found


def function_on_device(item: Constraint) -> Function:
    """The function of an object's rows.

    Raises
    ------
    UnsupportedError
        Rows that only Python can compute, or whose function cannot be written in C.
    """
    found = function_of(item)
    if found is None:
        raise UnsupportedError(
            f"{item!r} is a function of Python, which no device can call; write it as a Formula, or leave it to the "
            "host (device=False)"
        )
    c_functions("looked_at", found)
    return found


class Row(NamedTuple):
    """A row of a shape: number of its function, its atoms in the cluster, how it takes them, and what it is."""

    function: int
    atoms: tuple[int, ...]
    how: int
    rolls: bool
    moves: bool
    depends: bool
    summed: bool
    period: float


class Shape(NamedTuple):
    """Clusters that look alike, whose code or tables are written once: its rows, those that depend on others last.

    `atoms` are their particles, shape (n, n_atoms), `clusters` their rows in the set, (n, n_rows); single atoms have no
    rows and no `name`, which ends those of functions. The first cluster has the number `first` among those of the name.
    """

    atoms: IntArray
    rows: tuple[Row, ...] = ()
    clusters: IntArray = np.zeros((0, 0), np.int64)
    name: str = ""
    first: int = 0

    @property
    def together(self) -> bool:
        """Whether a work-group has a cluster; else a work-item."""
        widest = max((len(row.atoms) for row in self.rows), default=0)
        return len(self.rows) > ITEM_ROWS or self.atoms.shape[1] > ITEM_ATOMS or widest > ITEM_WIDTH

    @property
    def n_rows(self) -> int:
        """Independent rows of a cluster."""
        return sum(not row.depends for row in self.rows)
