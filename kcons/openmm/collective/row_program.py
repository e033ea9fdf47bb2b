"""The computations that hold rows of which each is the energy of one force group.

Positions: from where free motion led, x moves along the gradients at the start of the drift by pushes L, which a
quasi-Newton iteration finds; it begins with the inverse of the Gram matrix G = A M_par^+ A^T there, and Broyden's
update makes it explain what each push did to sigma. Velocities: one push with the same inverse where the drift ends.

In steps at whose end nobody looks, G is computed again only where the iteration has become slow, and a last push that
is good enough for sure is not measured: numbers are what the host of a GPU waits for.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import openmm

from kcons.errors import InputError
from kcons.openmm.integrator.ensemble import Integrator
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import require_context
from kcons.steppers.operations import Exchange

#: A pivot below this fraction of the row's own norm means that the row depends on others, in double precision.
PIVOT = 1e-10
#: A push that is not measured leaves this part of sigma at most; what it leaves more, the next step takes away.
_LEFT = 0.01
#: Bound of the iteration.
_ITERATIONS = 20


class GroupRows(Part):
    """Writes remember, land and project for K rows into the program of an integrator.

    What is counted is passes over the whole system, at 18 ns a degree of freedom each. A step with one drift needs,
    for each row, the gradients once (row, slope and Gram matrix: 3 passes, with constraints of the System 5), one pass
    for velocities, and one, or with constraints of the System two, for every further iteration of the positions.

    Attributes
    ----------
    names, scales, periods : sequence
        One entry a row.
    """

    stays_finite = True
    code = 1
    names: tuple[str, ...]
    atoms: tuple[tuple[int, ...], ...]
    scales: tuple[float, ...]
    periods: tuple[float, ...]
    tolerance: float
    asked_tolerance: float | None
    n_rows: int
    _groups: tuple[int, ...]
    _targets: list[float]
    _rates: list[float]
    #: Rows whose gradients can have a product, directly or through others.
    _blocks: list[list[int]]
    _meet: list[list[bool]]

    # -- names in the program -------------------------------------------------------------------

    def _of(self, name: str, row: int, integrator: object = None) -> str:
        return f"{name}{self.code_in(integrator)}_{row}"

    def _gram(self, i: int, j: int) -> str:
        return f"gram{self.code}_{max(i, j)}_{min(i, j)}"

    def _inverse(self, i: int, j: int) -> str:
        """An entry of the inverse, which Broyden's updates make unsymmetric."""
        return f"inverse{self.code}_{i}_{j}"

    def _target(self, row: int) -> str:
        """Expression of the target now."""
        moved = f"+{self._rate(row)}*(clock{self.code}+flown{self.code})" if self._rates[row] != 0.0 else ""
        return self._of("target", row) + moved

    def _rate(self, row: int) -> str:
        return self._of("rate", row)

    @property
    def driven(self) -> bool:
        """Whether targets move."""
        return bool(self._driven_rows)

    @property
    def _driven_rows(self) -> list[int]:
        return [k for k, rate in enumerate(self._rates) if rate != 0.0]

    @property
    def _pushes(self) -> str:
        return _sum(f"{self._of('push', k)}*{self._of('row', k)}" for k in range(self.n_rows))

    def _solved(self, block: list[int], i: int, name: str) -> str:
        """Expression for (inverse vector)_i."""
        return _sum(f"{self._inverse(i, j)}*{self._of(name, j)}" for j in block)

    # -- variables ------------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        c, integrator = self.code, p.integrator
        scheme = integrator.scheme
        alone = len(integrator.parts) == 1
        self._single = len(scheme.drifts) * len(scheme.flight) == 1
        numbers = [
            ("push", "L: x moves by L times the row"),
            ("more", "change of L"),
            ("sigma", "coordinate less target"),
            ("now", "the same, after the last push"),
            ("change", "what the push changed"),
            ("expected", "push that the inverse at hand expects for that"),
            ("left", "last push times the inverse"),
            ("own", "size of the row alone, for its pivot"),
            ("slope", "rate of the coordinate less that of the target"),
            ("impulse", "multiplier times time, over this step"),
            ("work", "work done by moving the target"),
        ]
        for k, name in enumerate(self.names):
            p.vector(self._of("row", k), f"M_par^+ gradient of row {k}, {name}")
            p.setting(self._of("target", k), f"target of row {k}", self._targets[k])
            p.setting(self._of("rate", k), "change of this target in a ps", self._rates[k])
            for what, words in numbers:
                p.number(self._of(what, k), words)
        for block in self._blocks:
            for i in block:
                for j in block:
                    p.number(self._inverse(i, j), f"inverse of G, then of d sigma{i}/d push{j}", float(i == j))
                    if j <= i:
                        p.number(self._gram(i, j), "gradient of one row . M_par^+ gradient of the other")
                        p.number(f"factor{c}_{i}_{j}", "Cholesky factor of G")
                        p.number(f"back{c}_{i}_{j}", "inverse of that factor")
        p.setting(f"small{c}", "a pivot below this fraction of the row's own norm means dependence", PIVOT)
        p.setting(f"tolerance{c}", "what the residual may be", self.tolerance)
        p.number(f"pivot{c}", "what is left of a row beside those before it")
        p.number(f"weight{c}", "denominator of the update")
        p.number(f"length{c}", "square of the last push")
        p.number(f"singular{c}", "1 + number of the first row that vanishes or depends on others")
        p.number(f"residual{c}", "size of sigma relative to the scales")
        p.number(f"iterations{c}", "quasi-Newton iterations of the last drift")
        p.number(f"state{c}", "of the iteration: 1 iterate, 2 give up, 3 push without measuring, 0 done")
        p.number(f"held{c}", "whether the rows hold")
        p.number(f"bad_sum{c}", "not a number if a multiplier is none")
        if self.driven:
            p.number(f"clock{c}", "time of the targets where the step began")
            p.number(f"flown{c}", "time of its drifts")
            p.number(f"began{c}", "good_steps when it began")
        if self.lean:
            p.number(f"renew{c}", "1 if G is to be computed", 1.0)
        self._base = "xu" if alone else p.vector(f"base{c}", "positions as other parts leave them")
        self._start = "x_last"
        if self.meets_system:
            p.vector(f"v_kept{c}", "velocities while v is used to project rows")
            if not self._single or _halved(integrator, scheme):
                self._start = p.vector(f"start{c}", "positions at the start of the drift")

    def take_precision(self, program: Program, precision: Precision) -> None:
        """What counts as small is what Forces of the platform can tell."""
        program.set(f"small{self.code}", max(PIVOT, 10 * precision.forces))

    # -- gradients ------------------------------------------------------------------------------

    def begin(self, p: Program) -> None:
        """Gradients where x is not where the last step ended."""
        self._gradients(p)

    def renew(self, p: Program) -> None:
        """Gradients after a step without `project`. Their sizes, which tell what a small pivot is, may be old."""
        self._directions(p)
        with p.when(f"renew{self.code} != 0", "G is old"):
            self._invert(p)
        self._refuse_dependent(p)

    def remember(self, p: Program) -> None:
        c = self.code
        if self.driven:  # a step that failed is not counted in good_steps, and its time is not kept
            first, kept = "delta(stage)", f"1-delta(began{c}-good_steps)"
            p.let(f"clock{c}", f"clock{c}+{first}*({kept})*flown{c}", "the step before was kept")
            p.let(f"flown{c}", f"select({first}, 0, flown{c})", "a step begins")
            p.let(f"began{c}", "good_steps", "to see whether it is kept")
        if self._start == f"start{c}":
            p.each(self._start, "x", "to start again from")
        for k in range(self.n_rows):
            p.let(self._of("push", k), "0", "first without")

    def _gradients(self, p: Program, sizes: bool = True) -> None:
        """Rows, their Gram matrix and its inverse at x; v stays."""
        self._directions(p, sizes=sizes)
        self._invert(p, sizes)
        self._refuse_dependent(p)

    def _directions(self, p: Program, *, sizes: bool = False, slopes: bool = False) -> None:
        """row = M_par^+ gradient, at x. Where v is needed for that, lean programs keep it themselves."""
        keep = self.meets_system and not (self.lean and not slopes)
        if keep:
            p.each(f"v_kept{self.code}", "v", "v is needed to project the rows")
        v = f"v_kept{self.code}" if self.meets_system else "v"
        for k, group in enumerate(self._groups):
            row = self._of("row", k)
            if slopes:
                p.sum(self._of("slope", k), f"-f{group}*{v}", f"rate of {self.names[k]}")
            if not self.meets_system:
                p.each(row, f"-f{group}/m", f"M^-1 gradient of {self.names[k]}")
                continue
            p.each("v", f"-f{group}/m", f"M^-1 gradient of {self.names[k]}")
            p.hold_velocities("its part along the constraints of the System")
            p.each(row, "v", "M_par^+ gradient")
            if sizes:
                p.sum(self._of("own", k), f"f{group}*f{group}/m", "its size without those constraints")
        if keep and not slopes:
            p.each("v", f"v_kept{self.code}", "v again")

    def _invert(self, p: Program, sizes: bool = False) -> None:
        """G and its inverse, by Cholesky's factor; `singular` tells the first row whose pivot vanishes."""
        c, singular = self.code, f"singular{self.code}"
        for block in self._blocks:
            for i in block:
                for j in block:
                    if j <= i and self._meet[i][j]:
                        p.sum(self._gram(i, j), f"m*{self._of('row', i)}*{self._of('row', j)}", "G")
        if sizes and not self.meets_system:
            for k in range(self.n_rows):
                p.let(self._of("own", k), self._gram(k, k), "its size")
        p.let(singular, f"select(failed, {singular}, 0)", "nothing wrong yet")
        for block in self._blocks:
            for a, i in enumerate(block):
                before = block[:a]
                for b, j in enumerate(before):
                    done = _sum(f"factor{c}_{i}_{k}*factor{c}_{j}_{k}" for k in block[:b])
                    p.let(f"factor{c}_{i}_{j}", f"({self._gram(i, j)}-({done}))/factor{c}_{j}_{j}", "Cholesky factor")
                left = _sum(f"factor{c}_{i}_{k}^2" for k in before)
                p.let(f"pivot{c}", f"{self._gram(i, i)}-({left})", f"row {i} beside the rows before it")
                # step(NaN) is 0: a row that is not a number is singular too. After a failure x may be anywhere; the
                # row that failed is to be named, not this one.
                good = f"step(pivot{c}-small{c}*{self._of('own', i)})*step(pivot{c}-1e-200)"
                lost = f"select({singular}+failed, {singular}, select({good}, 0, {i + 1}))"
                p.let(singular, lost, f"does row {i} vanish?")
                p.let(f"factor{c}_{i}_{i}", f"sqrt(select({singular}, 1, pivot{c}))", "Cholesky factor")
                p.let(f"back{c}_{i}_{i}", f"1/factor{c}_{i}_{i}", "inverse of the factor")
                for b, j in enumerate(before):
                    done = _sum(f"factor{c}_{i}_{k}*back{c}_{k}_{j}" for k in block[b:a])
                    p.let(f"back{c}_{i}_{j}", f"-({done})*back{c}_{i}_{i}", "inverse of the factor")
            for a, i in enumerate(block):
                for j in block[: a + 1]:
                    total = _sum(f"back{c}_{k}_{i}*back{c}_{k}_{j}" for k in block[a:])
                    p.let(self._inverse(i, j), total, "inverse of G")
                    if i != j:
                        p.let(self._inverse(j, i), self._inverse(i, j), "symmetric")

    def _refuse_dependent(self, p: Program) -> None:
        singular = f"select(singular{self.code}, {self.code}, 0)"
        p.let("failed", f"select(failed, failed, {singular})", "rows must be independent")

    # -- positions ------------------------------------------------------------------------------

    def land(self, p: Program, h: str) -> None:
        c = self.code
        if self.driven:
            p.let(f"flown{c}", f"flown{c}+{h}", "targets at the end of the drift")
        if self._base != "xu":
            p.each(self._base, "x", "positions as other parts leave them")
        p.let(f"iterations{c}", f"select(failed, iterations{c}, 0)", "a new solve")
        p.let(f"state{c}", "select(failed, 2, 1)", "after a failure only fly")
        # The first pass is written apart: a block within the loop makes the set-up of OpenMM take 15 times as long.
        if self.meets_system:
            p.hold_positions("onto the constraints of the System")
        self._measure(p)
        self._decide(p, first=True)
        with p.loop(f"step(2.5-state{c})*state{c} > 0", "until the rows hold"):
            self._push(p)
            self._measure(p)
            self._decide(p, first=False)
        if self.lean:
            with p.when(f"state{c} > 2", "one more, which need not be measured"):
                self._push(p)
            p.let(f"held{c}", f"max(held{c}, delta(state{c}-3))", "it does what it did before")
        p.let("failed", f"select(failed, failed, select(held{c}, 0, {c}))", "did it succeed?")
        self._note_impulses(p, h)
        if self.lean:
            p.let(f"renew{c}", f"max(step(iterations{c}-2.5), 1-behind)", "has it become slow?")
        if not self._single:
            self._gradients(p)

    def _push(self, p: Program) -> None:
        if self.meets_system:
            p.each("x", self._start, "constraints of the System refer to where the drift began")
            p.hold_positions("refer to here")
        p.each("x", f"{self._base}+{self._pushes}", "push along the rows")
        if self.meets_system:
            p.hold_positions("onto the constraints of the System")

    def _measure(self, p: Program) -> None:
        """sigma at x, and what the last push did to it."""
        c = self.code
        for k, group in enumerate(self._groups):
            now = self._of("now", k)
            p.let(now, f"energy{group}-({self._target(k)})", f"{self.names[k]} less its target")
            if self.periods[k]:
                period = repr(self.periods[k])
                p.let(now, f"{now}-{period}*floor({now}/{period}+0.5)", "nearest image")
        p.let(f"held{c}", f"delta(state{c}-1)", "is this an iteration?")
        for k in range(self.n_rows):
            now, sigma = self._of("now", k), self._of("sigma", k)
            p.let(self._of("change", k), f"{now}-{sigma}", "what the push changed")
            p.let(sigma, f"select(held{c}, {now}, {sigma})", "keep")

    def _decide(self, p: Program, first: bool) -> None:
        """Done, once more, or give up: then a last pass leaves x where it flew to."""
        c, rows = self.code, range(self.n_rows)
        squares = _sum(f"({self._of('sigma', k)}/{self.scales[k]!r})^2" for k in rows)
        p.let(f"residual{c}", f"sqrt({squares})", "size of sigma; not a number if one is none")
        p.let(f"held{c}", f"held{c}*step(tolerance{c}-residual{c})", "do the rows hold?")
        if not first:
            self._update(p, f"delta(state{c}-1)*step(1e10-residual{c})")
        p.let(f"iterations{c}", f"iterations{c}+delta(state{c}-1)", "count")
        again = "1"
        if self.lean:
            sure = f"between*step(tolerance{c}-{_LEFT!r}*residual{c})"
            again = f"select({sure}, 3, 1)"
        p.let(
            f"state{c}",
            f"select(delta(state{c}-1)*(1-held{c}), select(step(1e10-residual{c})"
            f"*step({_ITERATIONS - 1}-iterations{c}), {again}, 2), 0)",
            "done, or once more, or give up",
        )
        for block in self._blocks:
            for k in block:
                more = f"select(delta(state{c}-1)+delta(state{c}-3), -({self._solved(block, k, 'sigma')}), 0)"
                p.let(self._of("more", k), more, "what is missing")
        for k in rows:
            push = self._of("push", k)
            p.let(push, f"select(delta(state{c}-2), 0, {push}+{self._of('more', k)})", "push more")

    def _update(self, p: Program, active: str) -> None:
        """Broyden: inverse += (more - inverse change) (more^T inverse) / (more^T inverse change).

        Where `active` is not 0 and the denominator is safe.
        """
        c, of = self.code, self._of
        for block in self._blocks:
            for i in block:
                p.let(of("expected", i), self._solved(block, i, "change"), "push that explains the change")
                p.let(of("left", i), _sum(f"{of('more', j)}*{self._inverse(j, i)}" for j in block), "more^T inverse")
            p.let(f"weight{c}", _sum(f"{of('left', j)}*{of('change', j)}" for j in block), "denominator of the update")
            p.let(f"length{c}", _sum(f"{of('more', j)}^2" for j in block), "square of the push")
            safe = f"{active}*step(length{c}-1e-300)*step(abs(weight{c})-0.1*length{c})"
            p.let(f"weight{c}", f"select({safe}, 1/select({safe}, weight{c}, 1), 0)", "no update where it is not safe")
            for i in block:
                for j in block:
                    new = f"{self._inverse(i, j)}+weight{c}*({of('more', i)}-{of('expected', i)})*{of('left', j)}"
                    p.let(self._inverse(i, j), new, "Broyden's update")

    def _note_impulses(self, p: Program, h: str) -> None:
        for k in self._driven_rows:
            push, impulse = self._of("push", k), self._of("impulse", k)
            before = "0" if self.lean else f"select(delta(stage), 0, {impulse})"
            p.let(impulse, f"{before}+{push}/{h}", "multiplier times time")

    # -- velocities -----------------------------------------------------------------------------

    def project(self, p: Program) -> None:
        c, rows = self.code, range(self.n_rows)
        if self._single:
            self._directions(p, slopes=True)
            self._invert(p)
        else:
            for k, group in enumerate(self._groups):
                p.sum(self._of("slope", k), f"-f{group}*v", f"rate of {self.names[k]}")
        for k in rows:
            if self._rates[k] != 0.0:
                p.let(self._of("slope", k), f"{self._of('slope', k)}-({self._rate(k)})", "less that of the target")
        for block in self._blocks:
            for k in block:
                p.let(self._of("more", k), f"-({self._solved(block, k, 'slope')})", "multiplier times time")
        p.let(f"bad_sum{c}", _sum(f"abs({self._of('more', k)})" for k in rows), "to find what is no number")
        bad = f"select(singular{c}, {c}, select(step(1e200-bad_sum{c}), 0, {c}))"
        p.let("failed", f"select(failed, failed, {bad})", "independent rows, finite velocities?")
        for k in rows:
            p.let(self._of("more", k), f"select(failed, 0, {self._of('more', k)})", "nothing after a failure")
        v = f"v_kept{c}" if self.meets_system and self._single else "v"
        pushes = _sum(f"{self._of('more', k)}*{self._of('row', k)}" for k in rows)
        p.each("v", f"{v}+{pushes}", "tangent to the rows")
        for k in self._driven_rows:
            p.let(self._of("impulse", k), f"{self._of('impulse', k)}+{self._of('more', k)}", "all of this step")
        self.passed(p)

    def passed(self, p: Program) -> None:
        """At the end of a step: the work of targets that move."""
        for k in self._driven_rows:
            done = f"{self._of('work', k)}+select(failed, 0, {self._rate(k)}*{self._of('impulse', k)})"
            p.let(self._of("work", k), done, "force times speed of the target")

    # -- seen from Python -----------------------------------------------------------------------

    def _clock(self, integrator: openmm.CustomIntegrator) -> float:
        """The time of the targets between steps; the step made last counts where it was kept."""
        if not self.driven:
            return 0.0
        c, read = self.code_in(integrator), integrator.getGlobalVariableByName
        kept = read(f"began{c}") != read("good_steps")
        return float(read(f"clock{c}") + (read(f"flown{c}") if kept else 0.0))


def require_holder(integrator: openmm.CustomIntegrator) -> None:
    """Refuse a Context, a Simulation or whatever else is given for the integrator that holds the rows."""
    if not isinstance(integrator, openmm.CustomIntegrator):
        raise InputError(
            f"integrator is a {type(integrator).__name__}; give the integrator that holds the rows", item="integrator"
        )


def owner(rows: GroupRows, context: openmm.Context) -> Integrator | None:
    """The integrator of the context that holds the rows, None if it has none."""
    require_context(context)
    integrator = context.getIntegrator()
    if (
        isinstance(integrator, openmm.CompoundIntegrator) and rows.program is not None
    ):  # the member that made steps last
        integrator = rows.program.integrator
    return integrator if rows in getattr(integrator, "parts", ()) else None


def _halved(integrator: Any, scheme: Any) -> bool:
    """Whether a bath acts between two halves of the drift: the second one does not begin where the step does."""
    ensemble = getattr(integrator, "ensemble", None)
    return ensemble is not None and any(isinstance(each, Exchange) for each in ensemble.operations(scheme))


def _sum(terms: Iterable[str]) -> str:
    return "+".join(terms) or "0"
