"""Pushes that are foreseen from the last steps: few numbers for a GPU's host to wait for.

In the steps at whose end nobody looks, the multipliers of the rows are smooth functions of time. The iteration for
positions begins with their extrapolation, one evaluation of each row tells what is left of sigma, and the push that
takes this away need not be measured where the pushes before it show that it is good enough. The Gram matrix is
computed again only where the iteration has become slow. Every now and then, and in all steps at whose end somebody
looks, the last push is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

from kcons.openmm.collective.small_algebra import Block
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program

#: Steps after which the last push is measured again.
_PATIENCE = 64
#: What is allowed for beside the part of sigma that the last pushes have left.
_SAFETY = 4.0


class Measured:
    """Each push is measured, and nothing is foreseen.

    Parameters
    ----------
    code : int
        Of the part; in every name.
    blocks : sequence of Block
    meet : sequence of sequence of bool
        Whose gradients can have a product.
    """

    foresees = False

    def __init__(self, code: int, blocks: Sequence[Block], meet: Sequence[Sequence[bool]]) -> None:
        self.code, self.blocks, self.meet = code, blocks, meet
        self.rows = range(len(meet))

    def _of(self, name: str, row: int) -> str:
        return f"{name}{self.code}_{row}"

    def declare(self, p: Program) -> None:
        """Variables."""

    def take_precision(self, p: Program, precision: Precision) -> None:
        """The Context is known."""

    def products(self, p: Program) -> None:
        """The Gram matrix of rows at x, from their products: no force is needed."""
        for block in self.blocks:
            for k in block.rows:
                for j in block.rows:
                    if j <= k and self.meet[k][j]:
                        p.sum(block.gram(k, j), f"m*{self._of('row', k)}*{self._of('row', j)}", "Gram matrix")

    def invert(self, p: Program) -> None:
        """The inverse of the Gram matrix, and whether a row depends on others."""
        singular = f"singular{self.code}"
        p.let(singular, f"select(failed, {singular}, 0)", "nothing wrong yet")
        for block in self.blocks:
            block.invert(p, singular)

    def renew(self, p: Program) -> None:
        """Before a drift that follows a step without a projection, the rows at x."""
        self.products(p)
        self.invert(p)

    def foresee(self, p: Program, pushes: str) -> str:
        """The first pushes; what they add to x."""
        for k in self.rows:
            p.let(self._of("push", k), "0", "first without")
        return ""

    def judge(self, p: Program, first: bool) -> tuple[str, str]:
        """After a measurement: whether to push again, and the state of the iteration then."""
        return f"(1-held{self.code})", "1"

    def keep(self, p: Program) -> None:
        """After the solve."""


class Forecast(Measured):
    """Writes what is foreseen into the program of some rows; where `sparing` is 0 nothing is."""

    foresees = True

    def declare(self, p: Program) -> None:
        c = self.code
        p.setting(f"sparing{c}", "1 on GPUs, whose host waits for each number", 0.0)
        p.number(f"renew{c}", "1 if the Gram matrix is to be computed", 1.0)
        p.number(f"renewed{c}", "how often it was, within calls of step")
        p.number(f"measured{c}", "how often sigma was measured")
        p.number(f"unmeasured{c}", "steps since a last push was measured")
        p.number(f"follows{c}", "how many steps tell the next push")
        p.number(f"left{c}", "what a push leaves of sigma, as far as is known", 0.1)
        p.number(f"before{c}", "residual before the last push")
        for k in self.rows:
            p.number(self._of("last", k), "L of the last step")
            p.number(self._of("older", k), "L of the step before it")

    def take_precision(self, p: Program, precision: Precision) -> None:
        p.set(f"sparing{self.code}", float(precision.rounds_lengths))

    def renew(self, p: Program) -> None:
        with p.when(f"renew{self.code} != 0", "the Gram matrix is old"):
            self.products(p)
            self.invert(p)
            p.let(f"renewed{self.code}", f"renewed{self.code}+1", "count")

    def foresee(self, p: Program, pushes: str) -> str:
        c = self.code
        p.let(f"follows{c}", f"sparing{c}*led*follows{c}", "do the last steps tell this push?")
        for k in self.rows:
            last, older = self._of("last", k), self._of("older", k)
            line = f"select(step(follows{c}-1.5), 2*{last}-{older}, select(follows{c}, {last}, 0))"
            p.let(self._of("push", k), line, "on the line through the last ones")
        return pushes

    def judge(self, p: Program, first: bool) -> tuple[str, str]:
        c = self.code
        if not first:
            tells = f"delta(state{c}-1)*step(before{c}-10*tolerance{c})"
            ratio = f"max(residual{c}/select({tells}, before{c}, 1), 0.3*left{c})"
            p.let(f"left{c}", f"select({tells}, min({ratio}, 1), left{c})", "what did the push leave?")
        p.let(f"before{c}", f"residual{c}", "to see what the next push leaves")
        p.let(f"measured{c}", f"measured{c}+delta(state{c}-1)", "count")
        enough = f"step(tolerance{c}-{_SAFETY!r}*left{c}*residual{c})"
        sure = f"sparing{c}*between*step({_PATIENCE - 1.5!r}-unmeasured{c})*{enough}"
        again = f"select({sure}, 3, 1)"
        # Of what is foreseen, sigma within the tolerance is taken away, too.
        return (f"max(1-held{c}, min(follows{c}, 1)*{sure})" if first else f"(1-held{c})"), again

    def keep(self, p: Program) -> None:
        c = self.code
        p.let(f"unmeasured{c}", f"select(delta(state{c}-3), unmeasured{c}+1, 0)", "count")
        p.let(f"renew{c}", f"select(sparing{c}, max(step(iterations{c}-2.5), 1-led), 1)", "has it become slow?")
        p.let(f"follows{c}", f"select(failed, 0, led*min(follows{c}+1, 2))", "steps that tell the next push")
        for k in self.rows:
            p.let(self._of("older", k), self._of("last", k), "of the step before")
            p.let(self._of("last", k), self._of("push", k), "of this step")
