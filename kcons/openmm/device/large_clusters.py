"""Large clusters: tables for a work-group, with an order of elimination by levels (see `clusters.c`)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.openmm.device.c_writer import c_functions
from kcons.openmm.device.held_rows import IN_CELLS, HeldRows, Pattern
from kcons.openmm.device.kernels import Array
from kcons.plan.clusters_alike import elimination

#: Numbers of a row in `rows_row`.
_ROW = 9


class _Tables(NamedTuple):
    """Tables of one cluster, whose numbers count from its own beginning, without what ends them."""

    row: IntArray
    slot: IntArray
    level: IntArray
    entry: IntArray
    product: IntArray
    update: IntArray
    earlier: IntArray
    atom: IntArray
    touch: IntArray


def _tables(pattern: Pattern, held: HeldRows) -> tuple[_Tables, IntArray]:
    """Tables of a pattern, and its rows in the order of elimination."""
    count = len(pattern.rows)
    order = elimination([row.atoms for row in pattern.rows], {k for k, r in enumerate(pattern.rows) if r.depends})
    rows = [pattern.rows[k] for k in order.rows]
    widths = np.array([len(row.atoms) for row in rows])
    slots = np.stack([np.concatenate([row.atoms for row in rows]), np.repeat(np.arange(count), widths)], axis=1)
    touch = np.argsort(slots[:, 0], kind="stable")
    # Entries row by row, the diagonal first; `key` grows.
    lengths = np.array([1 + len(later) for later in order.later])
    diagonal = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    entry = np.stack(
        [np.repeat(np.arange(count), lengths), np.concatenate([[k, *later] for k, later in enumerate(order.later)])],
        axis=1,
    )
    key = entry @ [count, 1]
    product = np.concatenate([_pairs(some) for some in np.split(touch, np.flatnonzero(np.diff(slots[touch, 0])) + 1)])
    product = product[np.argsort(slots[product, 1] @ [count, 1], kind="stable")]
    of = np.concatenate([_pairs(later) for later in order.later]) @ [count, 1]
    both = np.concatenate([_pairs(np.arange(b + 1, b + n)) for b, n in zip(diagonal, lengths, strict=True)])
    update = np.column_stack([both, entry[both[:, 0], 0]])[np.argsort(of, kind="stable")]
    aside = np.flatnonzero(entry[:, 0] < entry[:, 1])
    earlier = aside[np.argsort(entry[aside, 1], kind="stable")]
    # In clusters where rows may depend on others any pivot may vanish: not all of them are marked in large ones.
    doubtful = bool(held.doubtful[pattern.clusters].any())
    sizes = np.array([len(held.parameters[pattern.clusters[0, k]]) for k in order.rows])
    cells = np.array([3 * len(row.atoms) * (row.how == IN_CELLS) for row in rows])
    columns = [
        np.array([row.function for row in rows]),
        np.cumsum(widths) - widths,
        np.cumsum(sizes) - sizes,
        np.array([row.how for row in rows]),
        diagonal,
        np.searchsorted(entry[earlier, 1], np.arange(count)),
        np.array([row.rolls + 2 * doubtful + 4 * row.summed for row in rows]),
        np.full(count, -1),
        np.cumsum(cells) - cells,
    ]
    found = (
        np.stack(columns, axis=1),
        slots,
        order.levels[:-1],
        np.column_stack(
            [entry, np.searchsorted(slots[product, 1] @ [count, 1], key), np.searchsorted(np.sort(of), key)]
        ),
        product,
        update,
        earlier,
        np.searchsorted(slots[touch, 0], np.arange(pattern.atoms.shape[1])),
        touch,
    )
    return _Tables(
        *(table.astype(np.int64).reshape(len(table), math.prod(table.shape[1:])) for table in found)
    ), order.rows


def _pairs(some: IntArray) -> IntArray:
    """All pairs of numbers in a list, each with itself and those after it, shape (n, 2)."""
    return np.stack([some[side] for side in np.triu_indices(len(some))], axis=1)


class LargeClusters:
    """The clusters of all large patterns in one set of tables.

    Attributes
    ----------
    arrays : list of Array
    rows : ndarray of int
        Rows of the set in the order of the tables.
    source : str
        The functions ``positions_large`` and ``velocities_large``.
    firsts : list of int
        Number of the first cluster of each pattern.
    """

    def __init__(self, patterns: list[Pattern], held: HeldRows, first_row: int) -> None:
        parts: dict[str, list[IntArray]] = {name: [] for name in _Tables._fields}
        used = dict.fromkeys([*_Tables._fields, "parameter", "cells"], 0)
        clusters: list[IntArray] = []
        rows: list[IntArray] = []
        self.firsts: list[int] = []
        place = {row: k for k, row in enumerate(held.moving)}
        cells_begin = 3 * sum(len(held.set.row_atoms(row)) for row in held.in_cells)
        for pattern in patterns:
            tables, order = _tables(pattern, held)
            n = len(pattern.clusters)
            mine = pattern.clusters[:, order]
            self.firsts.append(sum(map(len, clusters)))
            rows.append(mine.ravel())
            sizes = {name: len(table) for name, table in zip(_Tables._fields, tables, strict=True)}
            sizes["parameter"] = sum(len(held.parameters[row]) for row in mine[0])
            some = [k for k, row in enumerate(order) if pattern.rows[row].how == IN_CELLS]
            sizes["cells"] = 3 * sum(len(pattern.rows[order[k]].atoms) for k in some)
            held.in_cells += mine[:, some].ravel().tolist()
            #: What the numbers in each column of a table count.
            counted = {
                "row": ("", "slot", "parameter", "", "entry", "earlier", "", "", "cells"),
                "slot": ("", "row"),
                "level": ("row",),
                "entry": ("row", "row", "product", "update"),
                "product": ("slot", "slot"),
                "update": ("entry", "entry", "row"),
                "earlier": ("entry",),
                "atom": ("touch",),
                "touch": ("slot",),
            }
            for name, table in zip(_Tables._fields, tables, strict=True):
                step = np.array([sizes.get(what, 0) for what in counted[name]])
                base = np.array([used.get(what, 0) for what in counted[name]])
                parts[name].append((table + base + step * np.arange(n)[:, None, None]).reshape(-1, table.shape[1]))
            moving = np.array([[place.get(int(row), -1) for row in each] for each in mine])
            parts["row"][-1][:, 7] = moving.ravel()
            steps = np.array([sizes["row"], sizes["atom"], sizes["level"]])
            clusters.append(np.array([used["row"], used["atom"], used["level"]]) + steps * np.arange(n)[:, None])
            for name in used:
                used[name] += n * sizes[name]
        ends = {
            "row": [0, used["slot"], used["parameter"], 0, used["entry"], used["earlier"], 0, 0, 0],
            "level": [used["row"]],
            "entry": [0, 0, used["product"], used["update"]],
            "atom": [used["touch"]],
        }
        self.rows: IntArray = np.concatenate(rows)
        final = np.array([[used["row"], used["atom"], used["level"]]])
        self.arrays = [Array("rows_cluster", "int", np.concatenate([*clusters, final]).ravel())]
        for name, tables_of in parts.items():
            end = [np.array([ends[name]])] if name in ends else []
            flat = np.concatenate([*tables_of, *end]).ravel()
            self.arrays.append(Array(f"rows_{name}", "int", flat if len(flat) else np.zeros(1, dtype=np.int64)))
        periods = np.array([held.set.locate(int(row))[0].period or 0.0 for row in self.rows])
        numbers = np.stack([held.target[self.rows], held.scale[self.rows], periods], axis=1)
        parameters = np.concatenate([held.parameters[row] for row in self.rows] + [np.zeros(1)])
        self.arrays += [Array("rows_number", "mixed", numbers.ravel()), Array("rows_parameter", "mixed", parameters)]
        count, slots, entries = used["row"], used["slot"], used["entry"]
        rooms = {"place": 9 * slots, "now": 3 * slots + count, "there": 3 * slots + count}
        rooms |= {"upper": entries, "lower": entries} | dict.fromkeys(("pivot", "off", "answer", "sum"), count)
        self.arrays += [Array(f"rows_{name}", "mixed", np.zeros(size)) for name, size in rooms.items()]
        self.source = self._source(patterns, held, first_row, cells_begin)

    @staticmethod
    def _source(patterns: list[Pattern], held: HeldRows, first_row: int, first_cell: int) -> str:
        used = sorted({row.function for pattern in patterns for row in pattern.rows})
        functions = "".join(c_functions(f"rows_g{f}", held.functions[f], "GLOBAL ") for f in used)
        cases = "".join(f" case {f}: rows_g{f}(r, p, t, out); break;\n" for f in used)
        timed = [f for f in used if held.functions[f].rate is not None]
        rates = "".join(f" if (f == {f}) return rows_g{f}_rate(r, p, t);\n" for f in timed)
        return (
            f"{functions}DEVICE void rows_function(int f, GLOBAL const mixed* r, GLOBAL const mixed* p, mixed t, "
            f"GLOBAL mixed* out) {{\n switch (f) {{\n{cases} }}\n}}\n"
            f"DEVICE mixed rows_drift(int f, GLOBAL const mixed* r, GLOBAL const mixed* p, mixed t) {{\n{rates}"
            f" return 0;\n}}\n#define ROWS_FIRST_LARGE {first_row}\n#define ROWS_FIRST_CELL {first_cell}\n"
            f"{Path(__file__).with_name('clusters.c').read_text()}"
        )


def group_size(patterns: list[Pattern]) -> int:
    """Work-items that a work-group wants for the largest cluster: a warp, or many."""
    largest = max((len(pattern.rows) for pattern in patterns), default=0)
    return 64 if not largest else 32 if largest <= 64 else 256
