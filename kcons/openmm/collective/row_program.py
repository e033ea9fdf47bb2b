"""The computations that hold rows of which each is the energy of one force group."""

from __future__ import annotations

import math
from typing import Any

import openmm

from kcons.openmm.collective.clock import Clock, variables_of
from kcons.openmm.collective.forecast import Forecast, Measured
from kcons.openmm.collective.small_algebra import Block
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.program import Program
from kcons.steppers.operations import Exchange


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

    evaluates = stays_finite = solves_alone = True
    written = (*Part.written, "_leapfrog", "_single", "_blocks", "_forecast", "_base", "_start")
    code = 1
    names: tuple[str, ...]
    atoms: tuple[tuple[int, ...], ...]
    scales: tuple[float, ...]
    periods: tuple[float, ...]
    tolerance: float
    asked_tolerance: float | None
    max_iterations: int
    n_rows: int
    _groups: tuple[int, ...]
    _targets: list[float | str | None]
    _rates: list[float | str]
    _drives: bool
    _meet: list[list[bool]]
    _block_rows: list[list[int]]

    # -- names in the program -------------------------------------------------------------------

    def _of(self, name: str, row: int, integrator: object = None) -> str:
        return f"{name}{self.code_in(integrator)}_{row}"

    def _target(self, row: int) -> str:
        """Expression of the target now."""
        target = self._targets[row]
        if isinstance(target, str):
            return target
        return self._of("target", row) + (f"+{self._rate(row)}*clock{self.code}" if self._rates[row] != 0.0 else "")

    def _rate(self, row: int) -> str:
        rate = self._rates[row]
        return rate if isinstance(rate, str) else self._of("rate", row)

    # -- program --------------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        c = self.code
        scheme = getattr(p.integrator, "scheme", None)
        self._leapfrog = scheme is None
        self._single = scheme is None or len(scheme.drifts) * len(scheme.flight) == 1
        alone = len(getattr(p.integrator, "parts", (self,))) == 1
        self._blocks = [Block(rows, c) for rows in self._block_rows]
        for k, name in enumerate(self.names):
            p.vector(self._of("row", k), f"M_par^+ gradient of row {k}, {name}")
            target, rate = self._targets[k], self._rates[k]
            if isinstance(target, float):
                p.setting(self._of("target", k), f"target of row {k}", target)
            if isinstance(rate, float):
                p.setting(self._of("rate", k), "change of this target in a ps", rate)
            p.number(self._of("push", k), "L: x moves by L times the row")
            p.number(self._of("more", k), "change of L")
            p.number(self._of("sigma", k), "coordinate less target")
            p.number(self._of("now", k), "the same, after the last push")
            p.number(self._of("impulse", k), "multiplier times time, over this step")
            p.number(self._of("mean", k), "multiplier, mean over the last step", math.nan)  # none before it
            p.number(self._of("lambda", k), "multiplier at the start of the last step, to second order", math.nan)
            p.number(self._of("end", k), "multiplier of the last velocity projection")
            p.number(self._of("work", k), "work done by moving the target")
            p.number(self._of("slope", k), "rate of the coordinate less that of the target")
        for block in self._blocks:
            block.declare(p)
            block.declare_newton(p)
        p.number(f"known{c}", "whether the last velocity projection was at the start of this step")
        p.number(f"singular{c}", "1 + number of the first row that vanishes or depends on others")
        p.number(f"residual{c}", "size of sigma relative to the scales")
        p.setting(f"tolerance{c}", "what it may be", self.tolerance)
        p.number(f"iterations{c}", "quasi-Newton iterations of the last drift")
        p.number(f"state{c}", "of the iteration: 1 iterate, 2 give up, 0 done")
        p.number(f"held{c}", "whether the rows hold")
        p.number(f"bad_sum{c}", "not a number if a multiplier is none")
        if self._drives:
            Clock(c).declare(p)
        self._forecast = (Forecast if self.lean and alone else Measured)(c, self._blocks, self._meet)
        self._forecast.declare(p)
        self._base, self._start = "xu", "x_last"
        if not alone:
            self._base = p.vector(f"base{c}", "positions as other parts leave them")
        if self.meets_system:
            p.vector(f"v_kept{c}", "velocities while v is used to project rows")
            if not self._single or _halved(p.integrator, scheme):
                self._start = p.vector(f"start{c}", "positions at the start of the drift")

    def _gradients(self, p: Program, *, sizes: bool, slopes: bool, products: bool = True) -> None:
        """row = M_par^+ gradient, its Gram matrix and the inverse of that, at x."""
        keep = self.meets_system and not (self.lean and not slopes)
        if keep:
            p.each(f"v_kept{self.code}", "v", "v is needed to project the rows")
        v = f"v_kept{self.code}" if self.meets_system else "v"
        for k, group in enumerate(self._groups):
            row = self._of("row", k)
            if slopes:
                p.sum(self._of("slope", k), f"-f{group}*{v}", f"rate of {self.names[k]}")
            if self.meets_system:
                p.each("v", f"-f{group}/m", f"M^-1 gradient of {self.names[k]}")
                p.hold_velocities("its part along the constraints of the System")
                p.each(row, "v", "M_par^+ gradient")
                if sizes:
                    p.sum(self._of("own", k), f"f{group}*f{group}/m", "its size without those constraints")
            else:
                p.each(row, f"-f{group}/m", f"M^-1 gradient of {self.names[k]}")
        if keep and not slopes:
            p.each("v", f"v_kept{self.code}", "v again")
        if not products:
            return
        self._forecast.products(p)
        for k in range(self.n_rows) if sizes and not self.meets_system else ():
            gram = next(block.gram(k, k) for block in self._blocks if k in block.rows)
            p.let(self._of("own", k), gram, "its size")
        self._forecast.invert(p)

    def begin(self, p: Program) -> None:
        """Gradients where x is not where the last step ended."""
        if not self._leapfrog:
            self._gradients_kept(p)
            p.let(f"known{self.code}", "0", "no projection was here")

    def renew(self, p: Program) -> None:
        """Gradients after a step without `project`. Their sizes, which tell what a small pivot is, may be old."""
        self._gradients(p, sizes=False, slopes=False, products=False)
        self._forecast.renew(p)
        self._refuse_dependent(p)
        p.let(f"known{self.code}", "0", "no projection was here")

    def remember(self, p: Program) -> None:
        if self._drives:
            Clock(self.code).begin(p)
        if self._leapfrog:  # no velocity projection has computed them
            self._gradients_kept(p)
        if self._start == f"start{self.code}":
            p.each(self._start, "x", "to start again from")

    def _gradients_kept(self, p: Program, sizes: bool = True) -> None:
        """Gradients for the drift; v stays."""
        self._gradients(p, sizes=sizes, slopes=False)
        self._refuse_dependent(p)

    def _refuse_dependent(self, p: Program) -> None:
        singular = f"select(singular{self.code}, {self.code}, 0)"
        p.let("failed", f"select(failed, failed, {singular})", "rows must be independent")

    def _clock(self, integrator: openmm.CustomIntegrator) -> float:
        return Clock(self.code_in(integrator)).now(variables_of(integrator)) if self._drives else 0.0

    @property
    def _pushes(self) -> str:
        return "+".join(f"{self._of('push', k)}*{self._of('row', k)}" for k in range(self.n_rows))

    def foresee(self, p: Program) -> str:
        return self._forecast.foresee(p, self._pushes)

    def land(self, p: Program, h: str) -> None:
        c = self.code
        if self._drives:
            Clock(c).drift(p, h)
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
        if self._forecast.foresees:
            with p.when(f"select(sparing{c}, state{c}, 0) > 2", "one more, which need not be measured"):
                self._push(p)
            p.let(f"held{c}", f"max(held{c}, delta(state{c}-3))", "it does what it did before")
        p.let("failed", f"select(failed, failed, select(held{c}, 0, {c}))", "did it succeed?")
        begins = "delta(stage)"  # not so where constraints are applied alone
        for k in range(self.n_rows):
            push, impulse = self._of("push", k), self._of("impulse", k)
            before = f"select({begins}, 0, {impulse})"
            if self.lean:  # a drift of velocities that were not made tangent pushes for that as well
                before = f"-select(behind*looked, 0.5*dt*{self._of('end', k)}, 0)"
            p.let(impulse, f"{before}+{push}/{h}", "multiplier times time")
            if self._leapfrog:
                p.let(self._of("lambda", k), f"{push}/({h}*{h})", "multiplier where the drift began")
            else:
                at = f"select(known{c}, 0.5*({self._of('end', k)}+2*{push}/({h}*{h})), 2*{push}/({h}*{h}))"
                if self.lean:
                    at = f"select(behind, {push}/({h}*{h}), {at})"
                p.let(
                    self._of("lambda", k),
                    f"select({begins}, {at}, {self._of('lambda', k)})",
                    "multiplier where the step began",
                )
        self._forecast.keep(p)
        p.let(f"known{c}", "0", "further drifts begin elsewhere")
        if not self._single:
            self._gradients_kept(p)
        if self._leapfrog:
            self._end_step(p)

    def _push(self, p: Program) -> None:
        if self.meets_system:
            p.each("x", self._start, "constraints of the System refer to where the drift began")
            p.hold_positions("refer to here")
        p.each("x", f"{self._base}+{self._pushes}", "push along the rows")
        if self.meets_system:
            p.hold_positions("onto the constraints of the System")

    def _measure(self, p: Program) -> None:
        """sigma at x; what the last push did, for the quasi-Newton matrix."""
        c = self.code
        for k, group in enumerate(self._groups):
            off = f"energy{group}-({self._target(k)})"
            p.let(self._of("now", k), off, f"{self.names[k]} less its target")
            if self.periods[k]:
                now, period = self._of("now", k), repr(self.periods[k])
                p.let(now, f"{now}-{period}*floor({now}/{period}+0.5)", "nearest image")
        p.let(f"held{c}", f"delta(state{c}-1)", "is this an iteration?")
        for k in range(self.n_rows):
            now, sigma = self._of("now", k), self._of("sigma", k)
            p.let(self._of("change", k), f"{now}-{sigma}", "what the push changed")
            p.let(sigma, f"select(held{c}, {now}, {sigma})", "keep")

    def _decide(self, p: Program, first: bool) -> None:
        """Done, once more, or give up: then a last pass leaves x where it flew to."""
        c, rows = self.code, range(self.n_rows)
        squares = "+".join(f"({self._of('sigma', k)}/{self.scales[k]!r})^2" for k in rows)
        p.let(f"residual{c}", f"sqrt({squares})", "size of sigma; not a number if one is none")
        p.let(f"held{c}", f"held{c}*step(tolerance{c}-residual{c})", "do the rows hold?")
        for block in () if first else self._blocks:
            block.update(p, f"delta(state{c}-1)*step(1e10-residual{c})")
        p.let(f"iterations{c}", f"iterations{c}+delta(state{c}-1)", "count")
        going, again = self._forecast.judge(p, first)
        p.let(
            f"state{c}",
            f"select(delta(state{c}-1)*{going}, select(step(1e10-residual{c})"
            f"*step({self.max_iterations - 1}-iterations{c}), {again}, 2), 0)",
            "done, or once more, or give up",
        )
        for block in self._blocks:
            for k in block.rows:
                more = f"select(delta(state{c}-1)+delta(state{c}-3), -({block.solve(k, 'sigma')}), 0)"
                p.let(self._of("more", k), more, "what is missing")
        for k in rows:
            push = self._of("push", k)
            p.let(push, f"select(delta(state{c}-2), 0, {push}+{self._of('more', k)})", "push more")

    def project(self, p: Program) -> None:
        c, rows = self.code, range(self.n_rows)
        if self._single:
            self._gradients(p, sizes=False, slopes=True)
        else:
            for k, group in enumerate(self._groups):
                p.sum(self._of("slope", k), f"-f{group}*v", f"rate of {self.names[k]}")
        for k in rows:
            if self._rates[k] != 0.0:
                p.let(self._of("slope", k), f"{self._of('slope', k)}-({self._rate(k)})", "less that of the target")
        for block in self._blocks:
            for k in block.rows:
                p.let(self._of("more", k), f"-({block.solve(k, 'slope')})", "multiplier times time")
        p.let(f"bad_sum{c}", "+".join(f"abs({self._of('more', k)})" for k in rows), "to find what is no number")
        bad = f"select(singular{c}, {c}, select(step(1e200-bad_sum{c}), 0, {c}))"
        p.let("failed", f"select(failed, failed, {bad})", "independent rows, finite velocities?")
        for k in rows:
            p.let(self._of("more", k), f"select(failed, 0, {self._of('more', k)})", "nothing after a failure")
        pushes = "+".join(f"{self._of('more', k)}*{self._of('row', k)}" for k in rows)
        v = f"v_kept{c}" if self.meets_system and self._single else "v"
        p.each("v", f"{v}+{pushes}", "tangent to the rows")
        share = _last_share(p.integrator)
        for k in rows:
            p.let(self._of("end", k), f"2*{self._of('more', k)}/(dt*{share!r})", "multiplier at the end of the step")
            impulse = f"{self._of('impulse', k)}+{self._of('more', k)}"
            p.let(self._of("impulse", k), impulse, "all of this step")
        p.let(f"known{c}", "delta(first_stage)", "the next step begins here")
        self._end_step(p)

    def passed(self, p: Program) -> None:
        """At the end of a step without `project`."""
        if any(rate != 0.0 for rate in self._rates):
            self._end_step(p)

    def _end_step(self, p: Program) -> None:
        for k in range(self.n_rows):
            mean, impulse, work = self._of("mean", k), self._of("impulse", k), self._of("work", k)
            p.let(mean, f"select(first_stage, {mean}, {impulse}/dt)", "mean multiplier")
            if self._rates[k] != 0.0:
                done = f"{work}+select(first_stage+failed, 0, {self._rate(k)}*{impulse})"
                p.let(work, done, "force times speed of the target")


def _halved(integrator: Any, scheme: Any) -> bool:
    """Whether a bath acts between two halves of the drift: the second one does not begin where the step does."""
    ensemble = getattr(integrator, "ensemble", None)
    return ensemble is not None and any(isinstance(each, Exchange) for each in ensemble.operations(scheme))


def _last_share(integrator: openmm.CustomIntegrator) -> float:
    """Length of the last drift as a fraction of the step."""
    scheme = getattr(integrator, "scheme", None)
    return 1.0 if scheme is None else float(scheme.drifts[-1] * scheme.flight[-1])
