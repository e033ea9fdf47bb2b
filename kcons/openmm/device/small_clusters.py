"""Small clusters: straight code for a work-item, which has the cluster in registers.

Newton's method with J = A(x + d) M^-1 A(x)^T, whose elimination is written out: what stays zero has no code. A distance
is written as (u.u - t^2)/2t with the gradient u/t, which needs neither root nor division.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.openmm.device.c_writer import literal
from kcons.openmm.device.held_rows import IN_CELLS, NEAREST, STORED, Row, Shape

#: Rows from which a matrix has the precision of forces: registers are then scarce, and residuals are exact still.
FEW = 4


class ItemWriter:
    """The two functions of a shape for a work-item, and what they read of each cluster.

    Attributes
    ----------
    table : ndarray, shape (n_clusters, size)
        Numbers of each cluster; those of the first one begin at `start`, of the present one at ``n``.
    """

    def __init__(self, shape: Shape, held: Any, start: int, first_row: int) -> None:
        self.name, self.held, self.start = shape.name, held, start
        self.rows, self.count = shape.rows, len(shape.rows)
        self.single = shape.atoms.shape[1] == 1
        self.row_number = f"{first_row}+cluster*{self.count}"
        #: Whether the matrix is in the precision of forces.
        self.coarse = self.count >= FEW and not any(row.depends for row in self.rows)
        self.filled: list[set[int]] = []
        #: Of each row, as C: its target or the number of its moving one, its scale, where cells and parameters begin.
        self.targets: list[str] = []
        self.scales: list[str] = []
        self.cells: list[str] = []
        self.parameters: list[str] = []
        self.table: FloatArray = np.zeros((len(shape.clusters), 0))
        for row, mine in zip(self.rows, shape.clusters.T, strict=True):
            self.targets.append(self._number((held.mover if row.moves else held.target)[mine], row))
            self.scales.append(self._number(held.scale[mine], row))
            self.cells.append(self._number(held.cell[mine], row) if row.how == IN_CELLS else "")
            self.parameters.append(f"n+{self.table.shape[1]}")
            self.table = np.column_stack([self.table, [held.parameters[i] for i in mine]])

    def _number(self, values: FloatArray | IntArray, row: Row) -> str:
        """A number of each cluster, as C; it is in the code for constraints of the System that share it."""
        if not row.summed and np.all(values == values[0]):
            return literal(values[0])
        self.table = np.column_stack([self.table, values])
        return f"n[{self.table.shape[1] - 1}]"

    def text(self) -> str:
        return self.positions() + self.velocities()

    def _plain(self, row: Row) -> bool:
        """Whether a row is a distance that is held at one length."""
        return self.held.functions[row.function].is_distance and not row.moves

    def _legs(self, row: Row) -> list[dict[int, str]]:
        """Atoms that share three numbers of a row's gradient, and with which sign: of a distance both."""
        a = row.atoms
        return [{a[0]: "-", a[1]: "+"}] if self._plain(row) else [{each: "+"} for each in a]

    def _each(self, write: Callable[[int, Row], str]) -> str:
        return "".join(write(k, row) for k, row in enumerate(self.rows))

    def _begin(self, what: str, first: str) -> str:
        def room(k: int, row: Row) -> str:
            size = 3 * len(row.atoms)
            kept = f", b{k}[{size}]" if row.how == NEAREST else ""
            return f" mixed r{k}[{size * (1 + row.rolls)}], o{k}[{1 + size}], g{k}[{size}]{kept};\n"

        return (
            f"DEVICE void {what}_{self.name}(ROWS int cluster, mixed {first}, mixed time, const mixed* x, "
            f"mixed* d, const mixed* w) {{\n GLOBAL const mixed* n = rows_numbers+{self.start}+cluster*"
            f"{self.table.shape[1]};\n{self._each(room)} mixed off[{self.count}], sum[{self.count}];\n "
            f"{'real' if self.coarse else 'mixed'} J[{self.count**2}], y[{self.count}];\n mixed z;\n"
        )

    # -- rows ------------------------------------------------------------------------------------

    def _gathered(self, k: int, row: Row, moved: bool) -> str:
        """Positions of a row's atoms into r, at x or at x + d; of rows of velocities the way stands behind them."""
        lines, first, size = [], 3 * row.atoms[0], 3 * len(row.atoms)
        for i, atom in enumerate(row.atoms):
            for c in range(3):
                a, s, own = 3 * atom + c, first + c, f"r{k}[{3 * i + c}]"
                place, way = f"x[{a}]", f"d[{a}]"
                if row.how != STORED:
                    place, way = (f"x[{a}]-x[{s}]", f"(d[{a}]-d[{s}])") if i else ("0", "0")
                    if row.how == NEAREST:
                        place = f"b{k}[{3 * i + c}]"
                if row.how == IN_CELLS and i:
                    cells = f"rows_cells[(int) {self.cells[k]}+{3 * i}"
                    shift = [f"{cells}+{m}]*box{m}.{'xyz'[c]}" for m in range(c, 3)]
                    place = "+".join([place, *shift])
                half_way = "(mixed) 0.5*" if row.rolls else ""
                lines.append(f" {own} = {place}{f'+{half_way}{way}' if moved else ''};")
                if row.rolls:
                    lines.append(f" r{k}[{size + 3 * i + c}] = {f'd[{a}]' if moved else '0'};")
        return "".join(lines) + "\n"

    def _images(self, k: int, row: Row) -> str:
        """Shortest images along the list, once: atoms move by less than half the cell."""
        if row.how != NEAREST:
            return ""
        steps = (f" ROWS_STEP(b{k}, {3 * i}, x, {3 * b}, {3 * a})" for i, (a, b) in enumerate(pairwise(row.atoms), 1))
        return f" b{k}[0] = b{k}[1] = b{k}[2] = 0;{''.join(steps)}\n"

    def _value(self, k: int, row: Row, time: str, moved: bool) -> str:
        """Value less target, or value alone, and gradient of a row."""
        text = self._gathered(k, row, moved)
        if not self._plain(row):
            return f"{text} rows_f{row.function}(r{k}, {self.parameters[k]}, {time}, o{k});\n"
        u, t = [f"r{k}[{3 + c}]" for c in range(3)], self.targets[k]
        square = "+".join(f"{each}*{each}" for each in u)
        lines = [f" o{k}[{1 + c}] = {u[c]};" for c in range(3)]
        return f"{text} o{k}[0] = (mixed) 0.5*({square}-{t}*{t});{''.join(lines)}\n"

    def _reference(self, time: str) -> str:
        text = ""
        for k, row in enumerate(self.rows):
            kept = "".join(f" g{k}[{c}] = o{k}[{1 + c}];" for c in range(3 * len(self._legs(row))))
            text += f"{self._images(k, row)}{self._value(k, row, time, False)}{kept} sum[{k}] = 0;\n"
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
                along = "+".join(f"{left.format(k, 3 * p + c)}*g{j}[{3 * q + c}]" for c in range(3))
                terms += [f"({weight})*({along})"] if weight else []
        return "+".join(terms)

    def _factored(self, symmetric: bool) -> str:
        """J, and its L and U in place, without pivoting: it is nearly symmetric and positive."""
        n, left = self.count, "g{}[{}]" if symmetric else "o{}[1+{}]"
        lines = [" mixed whole;\n"] if any(row.depends for row in self.rows) else []
        filled = self.filled = [set[int]() for _ in self.rows]
        for k in range(n):
            for j in range(n):
                text = self._product(k, j, left)
                if text:
                    filled[k].add(j)
                    lines.append(f" J[{k * n + j}] = {f'J[{j * n + k}]' if symmetric and j < k else text};\n")
        for k, row in enumerate(self.rows):
            pivot = f"J[{k * n + k}]"
            if row.depends:
                lines.append(f" whole = fabs((mixed) {pivot});\n")
            for m in range(k):
                if m not in filled[k]:  # which grows
                    continue
                lines.append(f" J[{k * n + m}] *= J[{m * n + m}];\n")
                for j in sorted(each for each in filled[m] if each > m):
                    old = f"J[{k * n + j}]" if j in filled[k] else "0"
                    filled[k].add(j)
                    lines.append(f" J[{k * n + j}] = {old}-J[{k * n + m}]*J[{m * n + j}];\n")
            none = f"fabs((mixed) {pivot}) <= ROWS_PIVOT*whole ? 0 : " if row.depends else ""
            lines.append(f" {pivot} = {none}1/{pivot};\n")
        return "".join(lines)

    def _solved(self) -> str:
        """J y = off, y, and what it takes from d or v, which is called `d`."""
        n, lines = self.count, []
        for k in range(n):
            taken = "".join(f"-J[{k * n + m}]*y[{m}]" for m in sorted(self.filled[k]) if m < k)
            lines.append(f" y[{k}] = off[{k}]{taken};\n")
        for k in range(n - 1, -1, -1):
            taken = "".join(f"-J[{k * n + j}]*y[{j}]" for j in sorted(self.filled[k]) if j > k)
            lines.append(f" y[{k}] = (y[{k}]{taken})*J[{k * n + k}]; sum[{k}] += y[{k}];\n")
        for k, row in enumerate(self.rows):
            for p, leg in enumerate(self._legs(row)):
                for c in range(3):
                    lines.append(f" z = g{k}[{3 * p + c}]*y[{k}];")
                    lines += [f" d[{3 * a + c}] {'-' if sign == '+' else '+'}= w[{a}]*z;" for a, sign in leg.items()]
            lines.append("\n")
        return "".join(lines)

    def _sums(self, by: str) -> str:
        return self._each(lambda k, r: f" rows_sums[{self.row_number}+{k}] -= {self._unit(k, r)}sum[{k}]{by};\n" if r.summed else "")

    def _unit(self, k: int, row: Row) -> str:
        """What multipliers are to be multiplied by."""
        return f"{self.targets[k]}*" if self._plain(row) else ""

    # -- functions -------------------------------------------------------------------------------

    def positions(self) -> str:
        """x + d on the rows."""

        def start(k: int, row: Row) -> str:
            goal = self._wanted(k, row, "time-h/2" if row.rolls else "time", 0)
            rounded = ""
            if row.how == STORED:
                size = "+".join(f"fabs(o{k}[{1 + c}]*r{k}[{c}])" for c in range(3 * len(row.atoms)))
                rounded = f" a{k} += ROWS_ROUNDING*({size});"
            return (
                f" mixed t{k} = {'h*' if row.rolls else ''}{goal}, "
                f"a{k} = tolerance*{self._unit(k, row)}{self.scales[k]}{'*(mixed) 0.0625' if row.rolls else ''};{rounded}\n"
            )

        def turn(k: int, row: Row) -> str:
            text = self._value(k, row, "time-h/2" if row.rolls else "time", True)
            text += f" off[{k}] = o{k}[0]{'' if self._plain(row) else f'-t{k}'};"
            if row.period:
                text += f" off[{k}] -= {literal(row.period)}*rint(off[{k}]/{literal(row.period)});"
            return f"{text} there = there && fabs(off[{k}]) <= a{k};\n"  # so that NaN fails

        def turned(k: int, row: Row) -> str:
            along = "+".join(f"o{k}[{1 + c}]*g{k}[{c}]" for c in range(3 * len(self._legs(row))))
            return f" if (!({along} > 0)) bad = {k};\n"

        # A row of one particle is met to rounding, by one more iteration.
        first, stop, then = (", last = 0", "there && last", " last = there;") if self.single else ("", "there", "")
        missed = self._each(lambda k, row: f" if (!(fabs(off[{k}]) <= a{k})) bad = {k};")
        fail = f"{{FAIL({self.row_number}+bad, off[bad]); return;}}\n"
        return (
            f"{self._begin('positions', 'h')}{self._reference('time-h')}{self._each(start)} int bad = -1{first};\n"
            f" for (int turn = 0;; turn++) {{\n int there = 1;\n{self._each(turn)} if ({stop}) break;{then}\n"
            f" if (turn == ROWS_TURNS) {{{missed} {fail} }}\n{self._factored(False)}{self._solved()} }}\n"
            f"{self._each(turned)} if (bad >= 0) {fail}{self._sums('/h')}}}\n"
        )

    def velocities(self) -> str:
        """v, which is called d, along the rows."""

        def demanded(k: int, row: Row) -> str:
            rate = self._wanted(k, row, "time", 0 if row.rolls else 1)
            if self.held.functions[row.function].rate is not None:
                rate += f"-rows_f{row.function}_rate(r{k}, {self.parameters[k]}, time)"
            return f" mixed c{k} = {'0' if rate == '0' else f'rate == 0 ? 0 : rate*({rate})'};\n"

        def speed(k: int, row: Row) -> str:
            parts = [
                f"g{k}[{3 * p + c}]*({''.join(f'{sign}d[{3 * a + c}]' for a, sign in leg.items())})"
                for p, leg in enumerate(self._legs(row))
                for c in range(3)
            ]
            return f" off[{k}] = {'+'.join(parts)}-c{k};\n"

        return (
            f"{self._begin('velocities', 'rate')}{self._reference('time')}{self._each(demanded)}"
            f"{self._factored(True)} for (int pass = 0; pass < {1 + self.coarse}; pass++) {{\n"
            f"{self._each(speed)}{self._solved()} }}\n if (rate != 0) {{{self._sums('')} }}\n}}\n"
        )
