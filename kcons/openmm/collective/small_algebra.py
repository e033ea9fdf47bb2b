"""Small dense algebra written as computations on global variables: Gram matrices, their inverses, Broyden updates."""

from __future__ import annotations

from collections.abc import Iterable

from kcons.openmm.integrator.program import Program

#: A pivot below this fraction of the row's own norm means that the row depends on others, in double precision.
PIVOT = 1e-10


class Block:
    """Rows that meet one another, and the K x K matrices they share.

    Parameters
    ----------
    rows : sequence of int
        Numbers of the rows.
    code : int
        Of the part; in every name.
    """

    def __init__(self, rows: Iterable[int], code: int) -> None:
        self.rows = tuple(rows)
        self.code = code

    def gram(self, i: int, j: int) -> str:
        """Name of (A M^-1 A^T)_ij."""
        return f"gram{self.code}_{max(i, j)}_{min(i, j)}"

    def inverse(self, i: int, j: int) -> str:
        """Name of an entry of the inverse, which Broyden updates make unsymmetric."""
        return f"inverse{self.code}_{i}_{j}"

    def of(self, name: str, i: int) -> str:
        return f"{name}{self.code}_{i}"

    def declare(self, p: Program) -> None:
        c = self.code
        p.setting(f"small{c}", "a pivot below this fraction of the row's own norm means dependence", PIVOT)
        for i in self.rows:
            for j in self.rows:
                if j <= i:
                    p.number(self.gram(i, j), f"gradient of row {i} . M^-1 gradient of row {j}")
                p.number(self.inverse(i, j), f"inverse of the Gram matrix, then of d sigma{i}/d push{j}", float(i == j))
            p.number(self.of("own", i), f"size of row {i} alone, for its pivot", 0.0)
        if len(self.rows) > 1:
            p.number(f"pivot{c}", "what is left of a row beside those before it")
            for i in self.rows:
                for j in self.rows:
                    if j <= i:
                        p.number(f"factor{c}_{i}_{j}", "Cholesky factor of the Gram matrix")
                        p.number(f"back{c}_{i}_{j}", "inverse of that factor")

    # -- inverse of the Gram matrix -------------------------------------------------------------

    def invert(self, p: Program, singular: str) -> None:
        """inverse = (A M^-1 A^T)^-1.

        `singular`, unless `failed` is set, becomes 1 + the number of the first row whose pivot vanishes.
        """
        if len(self.rows) == 1:
            (i,) = self.rows
            self._test(p, singular, i, self.gram(i, i))
            p.let(self.inverse(i, i), f"1/select({singular}, 1, {self.gram(i, i)})", "inverse of the Gram matrix")
            return
        c = self.code
        for a, i in enumerate(self.rows):
            before = self.rows[:a]
            for j in before:
                done = _sum(f"factor{c}_{i}_{k}*factor{c}_{j}_{k}" for k in self.rows[: self.rows.index(j)])
                p.let(f"factor{c}_{i}_{j}", f"({self.gram(i, j)}-({done}))/factor{c}_{j}_{j}", "Cholesky factor")
            left = _sum(f"factor{c}_{i}_{k}^2" for k in before)
            p.let(f"pivot{c}", f"{self.gram(i, i)}-({left})", f"row {i} beside the rows before it")
            self._test(p, singular, i, f"pivot{c}")
            p.let(f"factor{c}_{i}_{i}", f"sqrt(select({singular}, 1, pivot{c}))", "Cholesky factor")
            p.let(f"back{c}_{i}_{i}", f"1/factor{c}_{i}_{i}", "inverse of the factor")
            for b, j in enumerate(before):
                done = _sum(f"factor{c}_{i}_{k}*back{c}_{k}_{j}" for k in self.rows[b:a])
                p.let(f"back{c}_{i}_{j}", f"-({done})*back{c}_{i}_{i}", "inverse of the factor")
        for a, i in enumerate(self.rows):
            for j in self.rows[: a + 1]:
                total = _sum(f"back{c}_{k}_{i}*back{c}_{k}_{j}" for k in self.rows[a:])
                p.let(self.inverse(i, j), total, "inverse of the Gram matrix")
                if i != j:
                    p.let(self.inverse(j, i), self.inverse(i, j), "symmetric")

    def _test(self, p: Program, singular: str, i: int, pivot: str) -> None:
        # step(NaN) is 0: a row that is not a number is singular too.
        good = f"step({pivot}-small{self.code}*{self.of('own', i)})*step({pivot}-1e-200)"
        # After a failure x may be anywhere; the row that failed is to be named, not this one.
        p.let(singular, f"select({singular}+failed, {singular}, select({good}, 0, {i + 1}))", f"does row {i} vanish?")

    # -- quasi-Newton ---------------------------------------------------------------------------

    def declare_newton(self, p: Program) -> None:
        c = self.code
        for i in self.rows:
            p.number(f"change{c}_{i}", f"change of sigma of row {i} in the last iteration")
            if len(self.rows) > 1:
                p.number(f"expected{c}_{i}", "push that the inverse at hand expects for it")
                p.number(f"left{c}_{i}", "last push times the inverse")
        p.number(f"weight{c}", "denominator of the update")
        p.number(f"length{c}", "square of the last push")

    def update(self, p: Program, active: str) -> None:
        """Broyden: change the inverse so that it explains what the last push `more` did to sigma.

        inverse += (more - inverse change) (more^T inverse) / (more^T inverse change), where `active` is not 0 and
        the denominator is safe.
        """
        c, rows = self.code, self.rows
        if len(rows) == 1:
            (i,) = rows
            more, change, inverse = f"more{c}_{i}", f"change{c}_{i}", self.inverse(i, i)
            p.let(f"weight{c}", f"{more}*{change}*{inverse}", "does the push explain the change?")
            safe = f"{active}*step({more}*{more}-1e-300)*step({_safe(c, f'{more}*{more}')})"
            p.let(inverse, f"select({safe}, {more}/select({safe}, {change}, 1), {inverse})", "secant")
            return
        for i in rows:
            total = _sum(f"{self.inverse(i, j)}*change{c}_{j}" for j in rows)
            p.let(f"expected{c}_{i}", total, "push that explains the change")
            p.let(f"left{c}_{i}", _sum(f"more{c}_{j}*{self.inverse(j, i)}" for j in rows), "push times inverse")
        p.let(f"weight{c}", _sum(f"left{c}_{j}*change{c}_{j}" for j in rows), "denominator of the update")
        p.let(f"length{c}", _sum(f"more{c}_{j}^2" for j in rows), "square of the push")
        safe = f"{active}*step(length{c}-1e-300)*step({_safe(c, f'length{c}')})"
        p.let(f"weight{c}", f"select({safe}, 1/select({safe}, weight{c}, 1), 0)", "no update where it is not safe")
        for i in rows:
            for j in rows:
                new = f"{self.inverse(i, j)}+weight{c}*(more{c}_{i}-expected{c}_{i})*left{c}_{j}"
                p.let(self.inverse(i, j), new, "Broyden's update")

    def solve(self, i: int, name: str) -> str:
        """Expression for (inverse vector)_i, the vector's entries named name{code}_{row}."""
        return _sum(f"{self.inverse(i, j)}*{name}{self.code}_{j}" for j in self.rows)


def _safe(code: int, length: str) -> str:
    return f"abs(weight{code})-0.1*{length}"


def _sum(terms: Iterable[str]) -> str:
    return "+".join(terms) or "0"


def blocks(meet: list[set[int]]) -> list[list[int]]:
    """Rows whose sets share a member, directly or through others, in blocks; sorted.

    Parameters
    ----------
    meet : list of set of int
        For each row, what it touches.
    """
    found: list[tuple[set[int], list[int]]] = []
    for row, touched in enumerate(meet):
        together, numbers, apart = set(touched), [row], []
        for others, rows in found:
            if others & together:
                together |= others
                numbers += rows
            else:
                apart.append((others, rows))
        found = [*apart, (together, numbers)]
    return sorted(sorted(rows) for _, rows in found)
