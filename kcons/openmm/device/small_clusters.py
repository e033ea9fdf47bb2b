"""Small clusters: straight code for a work-item, which has the cluster in registers.

Newton's method with J = A(x + d) M^-1 A(x)^T, whose elimination is written out: what stays zero has no code. J is made
row by row, so that only the gradients at the start of the drift are kept.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.openmm.device.c_writer import literal
from kcons.openmm.device.held_rows import IN_CELLS, NEAREST, STORED, HeldRows, Pattern, Row

#: Rows from which a matrix is kept in the precision of forces: registers are then scarce, and residuals are exact still.
FEW = 4


class Record:
    """Numbers of each cluster of a pattern, one after another; targets that all clusters share are in the code.

    Attributes
    ----------
    start, size : int
        Place of those of the first cluster, and how many a cluster has.
    targets, scales : list of str
        Of each row, as C.
    parameters, cells : list of int
        Where those of each row begin; cells count from `first_cell`, and there are `cell_size` a cluster.
    table : ndarray, shape (n_clusters, size)
    """

    def __init__(self, pattern: Pattern, held: HeldRows, start: int, first_cell: int) -> None:
        self.start, self.first_cell, self.cell_size = start, first_cell, 0
        self.targets: list[str] = []
        self.scales: list[str] = []
        self.parameters: list[int] = []
        self.cells: list[int] = []
        columns = [np.zeros((len(pattern.clusters), 0))]
        place = {row: k for k, row in enumerate(held.moving)}
        for k, row in enumerate(pattern.rows):
            mine = pattern.clusters[:, k]
            goals = np.array([place[i] for i in mine], dtype=float) if row.moves else held.target[mine]
            for values, texts in ((goals, self.targets), (held.scale[mine], self.scales)):
                if not row.summed and np.all(values == values[0]):
                    texts.append(literal(values[0]))
                else:
                    texts.append(f"n[{sum(c.shape[1] for c in columns)}]")
                    columns.append(values[:, None])
            self.parameters.append(sum(c.shape[1] for c in columns))
            columns.append(np.array([held.parameters[i] for i in mine]))
            self.cells.append(self.cell_size)
            self.cell_size += 3 * len(row.atoms) if row.how == IN_CELLS else 0
        self.table: FloatArray = np.hstack(columns)
        self.size = self.table.shape[1]


def _gathered(row: Row, cells: str, moved: bool) -> str:
    """Positions of a row's atoms into r, and of rows of velocities the way behind them; at x + d or at x."""
    lines, share = [], "(mixed) 0.5*" if row.rolls else ""
    first, size = 3 * row.atoms[0], 3 * len(row.atoms)
    for i, atom in enumerate(row.atoms):
        a, b = 3 * atom, 3 * row.atoms[i - 1] if row.how == NEAREST and i else first
        place = [f"x[{a + c}]" if row.how == STORED else f"x[{a + c}]-x[{b + c}]" for c in range(3)]
        way = [f"d[{a + c}]" if row.how == STORED else f"(d[{a + c}]-d[{b + c}])" for c in range(3)]
        if row.how != STORED and a == b:
            place, way = ["0"] * 3, ["0"] * 3
        lines.append(f" {{mixed ux = {place[0]}, uy = {place[1]}, uz = {place[2]};")
        if row.how == NEAREST and i:
            lines.append(" ROWS_NEAR(ux, uy, uz)")
        if row.how == IN_CELLS and i:
            n = [f"{cells}[{3 * i + c}]" for c in range(3)]
            lines.append(f" ux += {n[0]}*box0.x+{n[1]}*box1.x+{n[2]}*box2.x; uy += {n[1]}*box1.y+{n[2]}*box2.y;")
            lines.append(f" uz += {n[2]}*box2.z;")
        for c, u in enumerate(("ux", "uy", "uz")):
            before = f"r[{3 * (i - 1) + c}]+" if row.how == NEAREST and i else ""
            lines.append(f" r[{3 * i + c}] = {before}{u}{f'+{share}{way[c]}' if moved else ''};")
            if row.rolls:
                lines.append(f" r[{size + 3 * i + c}] = {f'd[{a + c}]' if moved else '0'};")
        lines.append("}\n")
    return "".join(lines)


class ItemWriter:
    """The two functions of a pattern for a work-item; numbers of cluster c begin at ``n``."""

    def __init__(self, name: str, pattern: Pattern, record: Record, first_row: int, timed: list[bool]) -> None:
        self.name, self.record, self.timed = name, record, timed
        self.rows, self.count = pattern.rows, len(pattern.rows)
        self.filled: list[set[int]] = []
        #: Whether the matrix is in the precision of forces.
        self.coarse = self.count >= FEW and not any(row.depends for row in self.rows)
        self.row_number = f"{first_row}+cluster*{self.count}"
        self.slots = np.concatenate([[0], np.cumsum([len(row.atoms) for row in self.rows])]).tolist()

    def text(self) -> str:
        return self.positions() + self.velocities()

    def _begin(self, what: str, rest: str, positions: str, changed: str) -> str:
        rolls = any(row.rolls for row in self.rows)
        widest = 3 * max(len(row.atoms) for row in self.rows)
        numbers = f" GLOBAL const mixed* n = rows_numbers+{self.record.start}+cluster*{self.record.size};\n"
        return (
            f"DEVICE void {what}_{self.name}(ROWS int cluster, mixed {rest}, mixed time, const mixed* x, "
            f"mixed* {changed}, const mixed* w) {{\n mixed r[{widest * (1 + rolls)}], o[{1 + widest}], "
            f"g[{3 * self.slots[-1]}], off[{self.count}], sum[{self.count}];\n"
            f" {'real' if self.coarse else 'mixed'} J[{self.count**2}], y[{self.count}];\n{numbers}"
        )

    def _call(self, k: int, time: str, moved: bool) -> str:
        """Value and gradient of row k in o."""
        row = self.rows[k]
        place = f"{self.record.first_cell + self.record.cells[k]}+cluster*{self.record.cell_size}"
        cells = f"(rows_cells+{place})" if row.how == IN_CELLS else ""
        return f"{_gathered(row, cells, moved)} rows_f{row.function}(r, n+{self.record.parameters[k]}, {time}, o);\n"

    def _reference(self, time: str, then: Callable[[int], str]) -> str:
        lines = []
        for k, row in enumerate(self.rows):
            lines.append(self._call(k, time, False))
            lines += [f" g[{3 * self.slots[k] + c}] = o[{1 + c}];" for c in range(3 * len(row.atoms))]
            lines.append(then(k) + "\n")
        return "".join(lines)

    def _products(self, k: int, gradient: Callable[[int], str]) -> tuple[str, set[int]]:
        """Row k of J, from its gradient and those at the reference; which entries are not zero."""
        lines, there = [], set()
        for j, other in enumerate(self.rows):
            terms = [
                f"w[{a}]*({'+'.join(f'{gradient(3 * p + c)}*g[{3 * (self.slots[j] + q) + c}]' for c in range(3))})"
                for p, a in enumerate(self.rows[k].atoms)
                for q, b in enumerate(other.atoms)
                if a == b
            ]
            if terms:
                there.add(j)
                lines.append(f" J[{k * self.count + j}] = {'+'.join(terms)};\n")
        return "".join(lines), there

    def _factored(self, there: list[set[int]]) -> str:
        """L and U in place, without pivoting: J is nearly symmetric and positive."""
        n, lines = self.count, []
        filled = [set(each) for each in there]
        for k, row in enumerate(self.rows):
            if row.depends:
                lines.append(f" whole = fabs((mixed) J[{k * n + k}]);\n")
            for m in range(k):
                if m not in filled[k]:  # which grows
                    continue
                lines.append(f" J[{k * n + m}] *= J[{m * n + m}];\n")
                for j in sorted(each for each in filled[m] if each > m):
                    old = f"J[{k * n + j}]" if j in filled[k] else "0"
                    filled[k].add(j)
                    lines.append(f" J[{k * n + j}] = {old}-J[{k * n + m}]*J[{m * n + j}];\n")
            pivot = f"J[{k * n + k}]"
            none = f"fabs((mixed) {pivot}) <= ROWS_PIVOT*whole ? 0 : " if row.depends else ""
            lines.append(f" {pivot} = {none}1/{pivot};\n")
        declared = " mixed whole;\n" if any(row.depends for row in self.rows) else ""
        self.filled = filled
        return f"{declared}{''.join(lines)}"

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
            for p, a in enumerate(row.atoms):
                for c in range(3):
                    lines.append(f" d[{3 * a + c}] -= w[{a}]*g[{3 * (self.slots[k] + p) + c}]*y[{k}];")
            lines.append("\n")
        return "".join(lines)

    def _sums(self, by: str) -> str:
        lines = [f" rows_sums[{self.row_number}+{k}] -= sum[{k}]{by};" for k, r in enumerate(self.rows) if r.summed]
        return "".join(lines) + "\n"

    def _wanted(self, k: int, row: Row, time: str, rate: int) -> str:
        """Target of a row at a time, or its rate."""
        if row.moves:
            return f"rows_moving(rows_knots, (int) {self.record.targets[k]}, {time}, {rate})"
        return self.record.targets[k] if not rate else "0"

    def positions(self) -> str:
        rows = self.rows
        start = "".join(
            f" mixed t{k} = {'h*' if r.rolls else ''}{self._wanted(k, r, 'time-h/2' if r.rolls else 'time', 0)}, "
            f"a{k} = tolerance*{self.record.scales[k]}{'*(mixed) 0.0625' if r.rolls else ''};\n"
            for k, r in enumerate(rows)
        )

        def rounded(k: int) -> str:
            if rows[k].how != STORED:
                return f" sum[{k}] = 0;"
            size = "+".join(f"fabs(o[{1 + c}]*r[{c}])" for c in range(3 * len(rows[k].atoms)))
            return f" sum[{k}] = 0;\n#ifdef SINGLE\n a{k} += (mixed) 5e-7*({size});\n#endif"

        there, turn = [], []
        for k, row in enumerate(rows):
            turn.append(self._call(k, "time-h/2" if row.rolls else "time", True))
            off = f"off[{k}] = o[0]-t{k};"
            if row.period:
                off += f" off[{k}] -= {literal(row.period)}*rint(off[{k}]/{literal(row.period)});"
            along = "+".join(f"o[{1 + c}]*g[{3 * self.slots[k] + c}]" for c in range(3 * len(row.atoms)))
            turn.append(f" {off} there = there && fabs(off[{k}]) <= a{k} && {along} > 0;   // so that NaN fails\n")
            products, some = self._products(k, lambda c: f"o[{1 + c}]")
            turn.append(products)
            there.append(some)
        told = "".join(f" if (!(fabs(off[{k}]) <= a{k})) bad = {k};" for k in range(self.count - 1, -1, -1))
        return (
            f"{self._begin('positions', 'h', 'x', 'd')}{start}{self._reference('time-h', rounded)}"
            f" for (int turn = 0;; turn++) {{\n int there = 1;\n{''.join(turn)} if (there) break;\n"
            f" if (turn == ROWS_TURNS) {{int bad = 0;{told} FAIL({self.row_number}+bad, off[bad]); return;}}\n"
            f"{self._factored(there)}{self._solved()} }}\n{self._sums('/h')}}}\n"
        )

    def velocities(self) -> str:
        rows = self.rows
        kept = "".join(f" mixed c{k} = 0;\n" for k in range(self.count))

        def demanded(k: int) -> str:
            row = rows[k]
            moving = self._wanted(k, row, "time", 0 if row.rolls else 1)
            drift = f"-rows_f{row.function}_rate(r, n+{self.record.parameters[k]}, time)"
            rate = "" if moving == "0" and not row.rolls else moving
            rate += drift if self.timed[row.function] else ""
            return f" sum[{k}] = 0;" + (f" if (rate != 0) c{k} = rate*({rate});" if rate else "")

        there, products = [], []
        for k, row in enumerate(rows):
            slot = 3 * self.slots[k]
            text, some = self._products(k, lambda c, slot=slot: f"g[{slot + c}]")  # type: ignore[misc]
            products.append(text)
            there.append(some)
        factored = self._factored(there)
        off = []
        for k, row in enumerate(rows):
            slot = 3 * self.slots[k]
            parts = [f"g[{slot + 3 * p + c}]*d[{3 * a + c}]" for p, a in enumerate(row.atoms) for c in range(3)]
            off.append(f" off[{k}] = {'+'.join(parts)}-c{k};\n")
        return (
            f"{self._begin('velocities', 'rate', 'x', 'd')}{kept}{self._reference('time', demanded)}"
            f"{''.join(products)}{factored} for (int pass = 0; pass < {2 + self.coarse}; pass++) {{\n"
            f"{''.join(off)}{self._solved()} }}\n if (rate != 0) {{{self._sums('')} }}\n}}\n"
        )
