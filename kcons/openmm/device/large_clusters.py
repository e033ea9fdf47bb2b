"""Large clusters: tables for a work-group, with an order of elimination by levels (see `clusters.c`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.openmm.device.c_writer import c_functions
from kcons.openmm.device.held_rows import Row, Shape
from kcons.openmm.device.kernels import Array
from kcons.plan.clusters_alike import elimination


def large_clusters(shapes: list[Shape], held: Any, first_row: int) -> tuple[list[Array], IntArray, list[Shape], str]:
    """The clusters of all large shapes in one set of tables.

    Returns
    -------
    arrays : list of Array
    rows : ndarray of int
        Rows of the set in the order of the tables.
    shapes : list of Shape
        The same, with the numbers of their first clusters.
    source : str
        The functions ``positions_large`` and ``velocities_large``.
    """
    numbered: list[Shape] = []
    rows: list[int] = []
    kinds: list[Row] = []
    levels: list[int] = []
    #: Of each row the atoms and the later rows that it is coupled to, among those of all clusters.
    atoms: list[IntArray] = []
    later: list[IntArray] = []
    doubtful: list[bool] = []
    clusters = [(0, 0, 0)]
    for shape in shapes:
        numbered.append(shape._replace(name="large", first=len(clusters) - 1))
        order = elimination([row.atoms for row in shape.rows], {k for k, r in enumerate(shape.rows) if r.depends})
        # Where rows may depend on others any pivot may vanish: not all of them are marked in large clusters.
        doubtful += [bool(held.doubtful[shape.clusters].any())] * shape.clusters.size
        for cluster in shape.clusters:
            first, first_atom, _ = clusters[-1]
            kinds += [shape.rows[k] for k in order.rows]
            atoms += [np.array(row.atoms) + first_atom for row in kinds[first:]]
            later += [some + first for some in order.later]
            levels += (order.levels[:-1] + first).tolist()
            rows += cluster[order.rows].tolist()
            clusters.append((len(rows), first_atom + shape.atoms.shape[1], len(levels)))
    count, n_atoms, _ = clusters[-1]
    slot_atom, slot_row = np.concatenate(atoms), np.repeat(np.arange(count), [len(some) for some in atoms])
    touch = np.argsort(slot_atom, kind="stable")
    # Entries row by row, the diagonal first; their keys grow.
    entry_row = np.repeat(np.arange(count), [1 + len(some) for some in later])
    entry_column = np.concatenate([[k, *some] for k, some in enumerate(later)])
    diagonal = np.searchsorted(entry_row, np.arange(count + 1))
    key = entry_row * count + entry_column
    product = np.concatenate([_pairs(some) for some in np.split(touch, np.flatnonzero(np.diff(slot_atom[touch])) + 1)])
    product_key = slot_row[product] @ [count, 1]
    both = np.concatenate([_pairs(np.arange(*ends)) for ends in zip(diagonal[:-1] + 1, diagonal[1:], strict=True)])
    update_key = entry_column[both] @ [count, 1]
    update = np.column_stack([both, entry_row[both[:, 0]]])
    earlier = np.flatnonzero(entry_row < entry_column)
    earlier = earlier[np.argsort(entry_column[earlier], kind="stable")]
    sizes = [len(held.parameters[row]) for row in rows]
    flags = [row.rolls + 2 * doubt + 4 * row.summed for row, doubt in zip(kinds, doubtful, strict=True)]
    moves = np.array([row.moves for row in kinds])
    columns: list[Any] = [
        [*(row.function for row in kinds), 0],
        np.searchsorted(slot_row, np.arange(count + 1)),
        np.cumsum([0, *sizes]),
        [*(row.how for row in kinds), 0],
        diagonal,
        np.searchsorted(entry_column[earlier], np.arange(count + 1)),
        [*flags, 0],
        [*np.where(moves, held.mover[rows], -1), 0],
        [*held.cell[rows], 0],
    ]
    base = np.repeat([first_atom for _, first_atom, _ in clusters[:-1]], np.diff([first for first, _, _ in clusters]))
    tables: dict[str, Any] = {
        "cluster": clusters,
        "row": np.stack(columns, axis=1),
        "slot": np.stack([slot_atom - base[slot_row], slot_row], axis=1),
        "level": [*levels, count],
        "entry": np.stack(
            [
                [*entry_row, 0],
                [*entry_column, 0],
                [*np.searchsorted(np.sort(product_key), key), len(product)],
                [*np.searchsorted(np.sort(update_key), key), len(update)],
            ],
            axis=1,
        ),
        "product": product[np.argsort(product_key, kind="stable")],
        "update": update[np.argsort(update_key, kind="stable")],
        "earlier": earlier,
        "atom": np.searchsorted(slot_atom[touch], np.arange(n_atoms + 1)),
        "touch": touch,
    }
    arrays = [Array(f"rows_{name}", "int", np.ravel(table)) for name, table in tables.items()]
    arrays = [array if array.values.size else array._replace(values=np.zeros(1)) for array in arrays]
    periods = [row.period for row in kinds]
    numbers = np.stack([held.target[rows], held.scale[rows], periods], axis=1)
    parameters = np.concatenate([*(held.parameters[row] for row in rows), np.zeros(1)])
    arrays += [Array("rows_number", "mixed", numbers.ravel()), Array("rows_parameter", "mixed", parameters)]
    slots, entries = len(slot_row), len(entry_row)
    rooms = {"place": 9 * slots, "now": 3 * slots + count, "there": 3 * slots + count}
    rooms |= {"upper": entries, "lower": entries} | dict.fromkeys(("pivot", "off", "answer", "sum"), count)
    arrays += [Array(f"rows_{name}", "mixed", np.zeros(size)) for name, size in rooms.items()]
    source = _source(sorted({row.function for row in kinds}), held, first_row)
    return arrays, np.array(rows), numbered, source


def _source(used: list[int], held: Any, first_row: int) -> str:
    functions = "".join(c_functions(f"rows_g{f}", held.functions[f], "GLOBAL ") for f in used)
    cases = "".join(f" case {f}: rows_g{f}(r, p, t, out); break;\n" for f in used)
    timed = [f for f in used if held.functions[f].rate is not None]
    rates = "".join(f" if (f == {f}) return rows_g{f}_rate(r, p, t);\n" for f in timed)
    return (
        f"{functions}DEVICE void rows_function(int f, GLOBAL const mixed* r, GLOBAL const mixed* p, mixed t, "
        f"GLOBAL mixed* out) {{\n switch (f) {{\n{cases} }}\n}}\n"
        f"DEVICE mixed rows_drift(int f, GLOBAL const mixed* r, GLOBAL const mixed* p, mixed t) {{\n{rates}"
        f" return 0;\n}}\n#define ROWS_FIRST_LARGE {first_row}\n"
        f"{Path(__file__).with_name('clusters.c').read_text()}"
    )


def _pairs(some: IntArray) -> IntArray:
    """All pairs of numbers in a list, each with itself and those after it, shape (n, 2)."""
    return np.stack([some[side] for side in np.triu_indices(len(some))], axis=1)
