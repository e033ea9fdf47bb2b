"""Clusters of rows as C: families as functions, small clusters as straight code, large ones as tables.

A work-item has a small cluster in registers: Newton's method with J = A(x + d) M^-1 A(x)^T, whose elimination is
written out; what stays zero has no code. Distances are held as u.u/2 = t^2/2, which needs neither root nor division.
A work-group has a large cluster, with an order of elimination by levels (see `clusters.c`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.functions.straight_line import Function, Operand, Tape, record
from kcons.constraints.target import FloatArray
from kcons.plan.clusters import elimination

#: Rows, atoms of a cluster and atoms of a row up to which a work-item has the cluster in registers.
ITEM_ROWS, ITEM_ATOMS, ITEM_WIDTH = 6, 10, 4
#: How rows take their atoms, see `clusters.c`.
STORED, RELATIVE, IN_CELLS = range(3)
#: Where a function has no tape.
REMEDY = ", and is not written in C; leave it to the host (device=False)"
#: Operations that are operators in C, and functions that have another name there.
_OPERATORS = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
_NAMES = {"absolute": "fabs", "power": "pow", "arctan2": "atan2", "arcsin": "asin", "arccos": "acos", "arctan": "atan"}


class Array(NamedTuple):
    """An array of 'mixed' or 'int' numbers, which kernels know by its name, and what it begins with.

    One that is `saved` belongs to a state: checkpoints and States have it. Kernels are given those that are `passed`.
    """

    name: str
    kind: str
    values: FloatArray | IntArray
    saved: bool = False
    passed: bool = True


# -- families -----------------------------------------------------------------------------------------


def literal(number: float) -> str:
    """A number as C, in the precision of the kernel."""
    return f"((mixed) {float(number)!r})"


def _text(operand: Operand) -> str:
    if not isinstance(operand, tuple):
        return literal(operand)
    name, k = operand
    return {"k": f"k{k}", "t": "t"}.get(name, f"{name}[{k}]")


def _lines(tape: Tape) -> str:
    lines = []
    for k, (name, operands) in enumerate(tape.steps):
        given = [_text(each) for each in operands]
        if name in _OPERATORS:
            text = _OPERATORS[name].join(given)
        else:
            text = f"-{given[0]}" if name == "negative" else f"{_NAMES.get(name, name)}({', '.join(given)})"
        lines.append(f" mixed k{k} = {text};\n")
    return "".join(lines)


def c_functions(name: str, function: Function, space: str = "") -> str:
    """A row as ``void NAME(const mixed* r, GLOBAL const mixed* p, mixed t, mixed* out)``, r and out in a `space`.

    With the time in a formula also its dq/dt, ``NAME_rate``. Raises UnsupportedError where C cannot be written for it.
    """
    tape = function.tape(REMEDY)
    results = "".join(f" out[{k}] = {_text(each)};\n" for k, each in enumerate(tape.results))
    places = f"{space}const mixed* r, GLOBAL const mixed* p, mixed t"
    text = f"DEVICE void {name}({places}, {space}mixed* out) {{\n{_lines(tape)}{results}}}\n"
    if function.rate is not None:
        rate = record(function.rate, function.known, REMEDY)
        text += f"DEVICE mixed {name}_rate({places}) {{\n{_lines(rate)} return {_text(rate.results[0])};\n}}\n"
    return text


# -- clusters that look alike -------------------------------------------------------------------------


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


# -- small ones ---------------------------------------------------------------------------------------


class ItemWriter:
    """The two functions of a shape for a work-item, and the `table` that they read, (n_clusters, size).

    Its numbers for the first cluster begin at `start`, for the present one at ``n``.
    """

    def __init__(self, shape: Shape, held: Any, start: int, first_row: int) -> None:
        self.name, self.held, self.start = shape.name, held, start
        self.rows, self.count = shape.rows, len(shape.rows)
        self.single = shape.atoms.shape[1] == 1
        self.row_number = f"{first_row}+cluster*{self.count}"
        #: Of each row, as C: its target or the number of its moving one, its scale, where cells and parameters begin.
        self.targets: list[str] = []
        self.scales: list[str] = []
        self.cells: list[str] = []
        self.parameters: list[str] = []
        self.table: FloatArray = np.zeros((len(shape.clusters), 0))
        for row, mine in zip(self.rows, shape.clusters.T, strict=True):
            self.targets.append(self._number((held.mover if row.moves else held.target)[mine], row))
            self.scales.append(self._number(held.scale[mine], row))
            self.cells.append(self._number(held.shift[mine], row) if row.how == IN_CELLS else "")
            self.parameters.append(f"n+{self.table.shape[1]}")
            self.table = np.column_stack([self.table, [held.parameters[i] for i in mine]])

    def _number(self, values: FloatArray | IntArray, row: Row) -> str:
        """A number of each cluster, as C; it is in the code for constraints of the System that share it."""
        if not row.summed and np.all(values == values[0]):
            return literal(values[0])
        self.table = np.column_stack([self.table, values])
        return f"n[{self.table.shape[1] - 1}]"

    def _plain(self, row: Row) -> bool:
        """Whether a row is a distance that is held at one length."""
        return self.held.functions[row.function].is_distance and not row.moves

    def _legs(self, row: Row) -> list[dict[int, str]]:
        """Atoms that share three numbers of a row's gradient, and with which sign: of a distance both."""
        a = row.atoms
        return [{a[0]: "-", a[1]: "+"}] if self._plain(row) else [{each: "+"} for each in a]

    def _unit(self, k: int) -> str:
        """What residuals are multiplied by, and multipliers are to be."""
        return f"{self.targets[k]}*" if self._plain(self.rows[k]) else ""

    # -- rows ------------------------------------------------------------------------------------

    def _value(self, k: int, row: Row, time: str, moved: bool) -> str:
        """Value, less the target of a plain row, and gradient at x or x + d; of rows of velocities half-way."""
        text, size = "", 3 * len(row.atoms)
        for i, atom in enumerate(row.atoms):
            place, way = (f"{{0}}[{3 * atom}+c]".format(of) for of in "xd")
            if row.how != STORED:
                place, way = (f"{each}-{each[0]}[{3 * row.atoms[0]}+c]" for each in (place, way))
            half = "(mixed) 0.5*" * row.rolls
            text += f" XYZ r{k}[{3 * i}+c] = {place}{f'+{half}({way})' * moved};\n"
            if row.rolls:
                text += f" XYZ r{k}[{size + 3 * i}+c] = {f'd[{3 * atom}+c]' if moved else '0'};\n"
            if row.how == IN_CELLS:
                text += f" ROWS_SHIFT((r{k}+{3 * i}), (rows_cells+(int) {self.cells[k]}+{3 * i}))\n"
        if not self._plain(row):
            return f"{text} rows_f{row.function}(r{k}, {self.parameters[k]}, rows_knots[0]+{time}, o{k});\n"
        u, t = f"(r{k}+3)", self.targets[k]
        return f"{text} o{k}[0] = (mixed) 0.5*(ROWS_DOT({u}, {u})-{t}*{t}); XYZ o{k}[1+c] = {u}[c];\n"

    def _begin(self, what: str, first: str, time: str) -> str:
        """What a function begins with: its numbers, and gradients at x."""
        text = (
            f"INLINED void {what}_{self.name}(ROWS int cluster, mixed {first}, mixed time, const mixed* x, "
            f"mixed* d, const mixed* w) {{\n GLOBAL const mixed* n = rows_numbers+{self.start}+cluster*"
            f"{self.table.shape[1]};\n mixed off[{self.count}], sum[{self.count}], whole, J[{self.count**2}], "
            f"y[{self.count}];\n"
        )
        for k, row in enumerate(self.rows):
            size, kept = 3 * len(row.atoms), 3 * len(self._legs(row))
            text += f" mixed r{k}[{size * (1 + row.rolls)}], o{k}[{1 + size}], g{k}[{size}];\n"
            text += self._value(k, row, time, False)
            text += f" UNROLLED for (int c = 0; c < {kept}; c++) g{k}[c] = o{k}[1+c];\n sum[{k}] = 0;\n"
        return text

    def _wanted(self, k: int, row: Row, time: str, rate: int) -> str:
        """Target of a row at a time, or its rate; of rows of velocities there is no rate."""
        if row.moves:
            return f"rows_moving(rows_knots, (int) {self.targets[k]}, {time}, {rate})"
        return "0" if rate else self.targets[k]

    # -- algebra ---------------------------------------------------------------------------------

    def _product(self, k: int, j: int, left: str) -> str:
        """Entry of J: the gradient of row k in `left` times M^-1 that of row j at the start; '' where it is zero."""
        terms = []
        for p, one in enumerate(self._legs(self.rows[k])):
            for q, other in enumerate(self._legs(self.rows[j])):
                weight = "".join(f"{'+' if one[a] == other[a] else '-'}w[{a}]" for a in one if a in other)
                terms += [
                    f"({weight})*ROWS_DOT(({left}{k}+{{}}), (g{j}+{3 * q}))".format(3 * p + (left == "o"))
                ] * bool(weight)
        return "+".join(terms)

    def _solved(self, left: str) -> str:
        """J y = off, y, and what it takes from d or v, which is called `d`; gradients of J's rows are in `left`."""
        n, text = self.count, ""
        few = n == 3 and all(self._plain(row) and not row.depends for row in self.rows)
        filled = [set[int]() for _ in self.rows]
        for k in range(n):
            for j in range(n):
                entry = self._product(k, j, left) or "0" * few
                if entry:
                    filled[k].add(j)
                    text += f" J[{k * n + j}] = {f'J[{j * n + k}]' if left == 'g' and j < k else entry};\n"
        text += self._by_cofactors() if few else self._by_elimination(filled)
        text += "".join(f" sum[{k}] += y[{k}];" for k in range(n)) + "\n"
        for k, row in enumerate(self.rows):
            for p, leg in enumerate(self._legs(row)):
                pushed = " ".join(f"d[{3 * a}+c] {'-' if sign == '+' else '+'}= w[{a}]*z;" for a, sign in leg.items())
                text += f" XYZ {{mixed z = g{k}[{3 * p}+c]*y[{k}]; {pushed}}}\n"
        return text

    def _by_cofactors(self) -> str:
        """y of three lengths with one division; elimination has three, each of which waits for the one before."""
        J = np.pad([[f"J[{3 * k + j}]" for j in range(3)] for k in range(3)], (0, 2), "wrap")
        minors = [
            [f"({J[k + 1, j + 1]}*{J[k + 2, j + 2]}-{J[k + 1, j + 2]}*{J[k + 2, j + 1]})" for j in range(3)]
            for k in range(3)
        ]
        text = f" whole = 1/({'+'.join(f'{J[0, j]}*{minors[0][j]}' for j in range(3))});\n"
        for j in range(3):
            text += f" y[{j}] = whole*({'+'.join(f'{minors[k][j]}*off[{k}]' for k in range(3))});\n"
        return text

    def _by_elimination(self, filled: list[set[int]]) -> str:
        """J's L and U in place, without pivoting: it is nearly symmetric and positive; and y."""
        n, text = self.count, ""
        for k, row in enumerate(self.rows):
            pivot = f"J[{k * n + k}]"
            text += f" whole = fabs({pivot});\n" * row.depends
            for m in range(k):
                if m not in filled[k]:  # which grows
                    continue
                text += f" J[{k * n + m}] *= J[{m * n + m}];\n"
                for j in sorted(each for each in filled[m] if each > m):
                    old = f"J[{k * n + j}]" if j in filled[k] else "0"
                    filled[k].add(j)
                    text += f" J[{k * n + j}] = {old}-J[{k * n + m}]*J[{m * n + j}];\n"
            none = f"fabs({pivot}) <= ROWS_PIVOT*whole ? 0 : " * row.depends
            text += f" {pivot} = {none}1/{pivot};\n"
        for k in range(n):
            taken = "".join(f"-J[{k * n + m}]*y[{m}]" for m in sorted(filled[k]) if m < k)
            text += f" y[{k}] = off[{k}]{taken};\n"
        for k in range(n - 1, -1, -1):
            taken = "".join(f"-J[{k * n + j}]*y[{j}]" for j in sorted(filled[k]) if j > k)
            text += f" y[{k}] = (y[{k}]{taken})*J[{k * n + k}];\n"
        return text

    def _sums(self, by: str) -> str:
        add = f" ROWS_ADD(rows_sums, rows_lost, {self.row_number}+"
        return "".join(f"{add}{k}, {self._unit(k)}sum[{k}]{by})\n" for k, row in enumerate(self.rows) if row.summed)

    # -- functions -------------------------------------------------------------------------------

    def positions(self) -> str:
        """x + d on the rows."""
        starts = turns = missed = turned = ""
        for k, row in enumerate(self.rows):
            time, unit = "time-h/2" if row.rolls else "time", self._unit(k)
            allowed = f"tolerance*{unit}{self.scales[k]}{'*(mixed) 0.0625' * row.rolls}"
            starts += f" mixed t{k} = {'h*' * row.rolls}{self._wanted(k, row, time, 0)}, a{k} = {allowed};\n"
            if row.how == STORED:
                size = f"a{k} += ROWS_ROUNDING*fabs(o{k}[1+c]*r{k}[c]);"
                starts += f" for (int c = 0; c < {3 * len(row.atoms)}; c++) {size}\n"
            turns += f"{self._value(k, row, time, True)} off[{k}] = o{k}[0]{'' if unit else f'-t{k}'};"
            if row.period:
                turns += f" off[{k}] -= {literal(row.period)}*rint(off[{k}]/{literal(row.period)});"
            turns += f" there = there && fabs(off[{k}]) <= a{k};\n"  # so that NaN fails
            missed += f" if (!(fabs(off[{k}]) <= a{k})) bad = {k};"
            along = "+".join(f"ROWS_DOT((o{k}+{1 + 3 * p}), (g{k}+{3 * p}))" for p in range(len(self._legs(row))))
            turned += f" if (!({along} > 0)) bad = {k};\n"
        # A row of one particle is met to rounding, by one more iteration.
        first, stop, then = (", last = 0", "there && last", " last = there;") if self.single else ("", "there", "")
        units = ", ".join(self._unit(k)[:-1] or "1" for k in range(self.count))
        fail = f"{{const mixed unit[] = {{{units}}}; FAIL({self.row_number}+bad, off[bad]/unit[bad]); return;}}\n"
        return (
            f"{self._begin('positions', 'h', 'time-h')}{starts} int bad = -1{first};\n"
            f" for (int turn = 0;; turn++) {{\n int there = 1;\n{turns} if ({stop}) break;{then}\n"
            f" if (turn == ROWS_TURNS) {{{missed} {fail} }}\n{self._solved('o')} }}\n"
            f"{turned} if (bad >= 0) {fail}{self._sums('/h')}}}\n"
        )

    def velocities(self) -> str:
        """v, which is called d, along the rows."""
        speeds = ""
        for k, row in enumerate(self.rows):
            rate = self._wanted(k, row, "time", 0 if row.rolls else 1)
            if self.held.functions[row.function].rate is not None:
                rate += f"-rows_f{row.function}_rate(r{k}, {self.parameters[k]}, rows_knots[0]+time)"
            speeds += f" off[{k}] = {'0' if rate == '0' else f'rate == 0 ? 0 : -rate*({rate})'};\n"
            for p, leg in enumerate(self._legs(row)):
                speed = "".join(f"{sign}d[{3 * a}+c]" for a, sign in leg.items())
                speeds += f" XYZ off[{k}] += g{k}[{3 * p}+c]*({speed});\n"
        return (
            f"{self._begin('velocities', 'rate', 'time')}{speeds}{self._solved('g')}"
            f" if (rate != 0) {{{self._sums('')} }}\n}}\n"
        )


# -- large ones ---------------------------------------------------------------------------------------


def large_clusters(shapes: list[Shape], held: Any, first_row: int) -> tuple[list[Array], IntArray, list[Shape], str]:
    """The clusters of all large shapes in one set of tables.

    Also rows of the set in their order, shapes with the numbers of their first clusters, and the two functions as C.
    """
    numbered: list[Shape] = []
    rows: list[int] = []
    kinds: list[Row] = []
    levels: list[int] = []
    #: Of each row the atoms and the later rows that it is coupled to, among those of all clusters.
    atoms: list[IntArray] = []
    later: list[IntArray] = []
    clusters = [(0, 0, 0)]
    for shape in shapes:
        numbered.append(shape._replace(name="large", first=len(clusters) - 1))
        order = elimination([row.atoms for row in shape.rows], {k for k, r in enumerate(shape.rows) if r.depends})
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
    begins = [np.searchsorted(np.sort(keys), key) for keys in (product_key, update_key)]
    earlier = np.flatnonzero(entry_row < entry_column)
    earlier = earlier[np.argsort(entry_column[earlier], kind="stable")]
    function, how, flags, moves = np.array([(r.function, r.how, r.rolls + 2 * r.summed, r.moves) for r in kinds]).T
    columns: list[Any] = [
        [*function, 0],
        np.searchsorted(slot_row, np.arange(count + 1)),
        np.cumsum([0, *(len(held.parameters[row]) for row in rows)]),
        [*how, 0],
        diagonal,
        np.searchsorted(entry_column[earlier], np.arange(count + 1)),
        [*flags, 0],
        [*np.where(moves, held.mover[rows], -1), 0],
        [*held.shift[rows], 0],
    ]
    base = np.repeat([first_atom for _, first_atom, _ in clusters[:-1]], np.diff([first for first, _, _ in clusters]))
    tables: dict[str, Any] = {
        "cluster": clusters,
        "row": np.stack(columns, axis=1),
        "slot": np.stack([slot_atom - base[slot_row], slot_row], axis=1),
        "level": [*levels, count],
        "entry": np.vstack([np.stack([entry_row, entry_column, *begins], axis=1), [0, 0, len(product), len(update)]]),
        "product": product[np.argsort(product_key, kind="stable")],
        "update": update[np.argsort(update_key, kind="stable")],
        "earlier": earlier,
        "atom": np.searchsorted(slot_atom[touch], np.arange(n_atoms + 1)),
        "touch": touch,
    }
    arrays = [Array(f"rows_{k}", "int", np.ravel(t) if np.size(t) else np.zeros(1)) for k, t in tables.items()]
    numbers = np.stack([held.target[rows], held.scale[rows], [row.period for row in kinds]], axis=1)
    parameters = np.concatenate([*(held.parameters[row] for row in rows), np.zeros(1)])
    arrays += [Array("rows_number", "mixed", numbers.ravel()), Array("rows_parameter", "mixed", parameters)]
    slots, entries = len(slot_row), len(entry_row)
    rooms = {"place": 6 * slots, "now": 3 * slots + count, "there": 3 * slots + count}
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
