"""Collective variables as rows: whatever an OpenMM Force can compute, held where it is or moved.

Positions: from where free motion led, x moves along the gradients at the start of the drift by pushes L, which a
quasi-Newton iteration finds; it begins with the inverse of the Gram matrix G = A M_par^+ A^T there, and Broyden's
update makes it explain what each push did to sigma. Velocities: one push with the same inverse where the drift ends.
In steps at whose end nobody looks, G is computed again only where the iteration has become slow, and a last push that
is good enough for sure is not measured: numbers are what the host of a GPU waits for.

What is counted is passes over the whole system, at 18 ns a degree of freedom each. A step with one drift needs, for
each row, the gradients once (row, slope and Gram matrix: 3 passes, with constraints of the System 5), one pass for
velocities, and one, or with constraints of the System two, for every further iteration of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import Constraint, Custom, Distance, MovingTarget
from kcons.constraints.arguments import positive
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.internal import MOST_TURNED
from kcons.constraints.target import FloatArray
from kcons.errors import (
    ConstraintError,
    ConvergenceError,
    InputError,
    KconsError,
    NonFiniteError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.motion.motion import Motion
from kcons.openmm.collective.coordinates import (
    Row,
    as_constraint,
    finite_number,
    found_values,
    moved_atoms,
    period_of,
    put_in_groups,
    unit_of,
)
from kcons.openmm.integrator.guard import (
    SystemRows,
    components,
    forces_alone,
    forces_of,
    groups_in,
    refuse_agents,
    require_context,
    virtual_sites,
)
from kcons.openmm.integrator.part import BOND, NEAR, Part, Precision, Solver, Violation
from kcons.openmm.integrator.program import Integrator, Program
from kcons.openmm.quantities import (
    box_of,
    energy_of,
    forces_at,
    held_pairs,
    masses_of,
    motion_of,
    positions_of,
    velocities_of,
    width_of,
    with_massless_atoms,
)
from kcons.openmm.topology import bonds_of
from kcons.solvers.tolerances import PIVOT_TOLERANCE

#: Relative tolerance of rows in double precision.
TOLERANCE = 1e-13
#: Off the rows by more than this (relative to the scale of a row, or to its rate): not on them.
START_TOLERANCE = 1e-9
#: Two values of one coordinate, by OpenMM and by kcons, differ by less.
SAME = 1e-5
#: A push that is not measured leaves this part of sigma at most; what it leaves more, the next step takes away.
_LEFT = 0.01
#: Bound of the iteration.
_ITERATIONS = 20


class CollectiveRows(Part):
    """Any OpenMM Forces, each held as one row sigma = q - target = 0.

    The energy of a Force is its coordinate q, its forces are the gradient; each has a force group of its own, which
    the integrator keeps out of the dynamics. Positions land on all rows at once (and on the constraints of the
    System, where the rows touch atoms that it constrains) along the gradients at the start of the drift,

        x1 = xu + M^-1 (sum_k L_k grad q_k(x0) + constraints of the System),    q_k(x1) = target_k,

    by a quasi-Newton iteration on the L that begins with the Gram matrix A M_par^+ A^T at x0. Velocities are projected
    with the Gram matrix at x1.

    Parameters
    ----------
    system : openmm.System
        The Forces that are not part of it are added, each in a free group. Make the Simulation or Context afterwards.
    rows : Row or openmm.Force, or a sequence of them
        What to hold. A Force alone is held at the value found at `positions`.
    positions : array_like or Quantity, shape (n_particles, 3), optional
        In nm if without unit. Needed where a target is to be found.
    tolerance : float, optional
        Of sigma, relative to the larger of 1 and the target: the root of the sum of squares over the rows. Left open,
        1e-13, or 5e-7 where the platform computes forces in single precision (CUDA, HIP and OpenCL, mixed too).
    meets_system : bool
        Say True where the rows touch atoms that the System constrains in ways that the Forces do not tell.

    Raises
    ------
    InputError
        A number that is not finite, a particle that is not there, a target to find without positions.
    UnsupportedError
        More rows than free force groups; rows on virtual sites. The System is unchanged then.

    References
    ----------
    Notes, eqs. 99-107; Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977); Andersen, ibid. 52, 24
    (1983); Broyden, Math. Comput. 19, 577 (1965).
    """

    stays_finite = True
    code = 1

    def __init__(
        self,
        system: openmm.System,
        rows: Row | openmm.Force | Sequence[Row | openmm.Force],
        *,
        positions: object | None = None,
        tolerance: float | None = None,
        meets_system: bool = False,
    ) -> None:
        listed = rows if isinstance(rows, list | tuple) else [rows]
        given = [each if isinstance(each, Row) else Row(each) for each in listed]
        if not given:
            raise InputError("no rows to hold", item="rows")
        for k, row in enumerate(given):
            if not isinstance(row.force, openmm.Force):
                raise InputError(
                    f"row {k}: {row.force!r} is no Force of OpenMM; kcons.openmm.hold holds constraints of kcons",
                    item="force",
                )
        self.asked_tolerance = tolerance
        self.tolerance = positive(TOLERANCE if tolerance is None else tolerance, "tolerance")
        self.n_rows = len(given)
        forces = [row.force for row in given]
        self.names = tuple(row.name or _name(row.force) for row in given)
        self._units = [unit_of(force) for force in forces]
        wanted = self._read_numbers(given, positions is not None)
        self.periods = tuple(
            period_of(row.force)
            if row.period is None
            else finite_number(row.period, f"period of row {k}", self._units[k])
            for k, row in enumerate(given)
        )
        #: The particles of each row.
        self.atoms = tuple(tuple(sorted(moved_atoms(system, force))) for force in forces)
        self._find_what_meets(system, meets_system)
        if None in wanted:
            found = found_values(system, forces, positions).tolist()
            wanted = [f if t is None else t for t, f in zip(wanted, found, strict=True)]
        self._targets = [float(target) for target in wanted if target is not None]
        groups = put_in_groups(system, forces)
        self._groups, self.groups = tuple(groups), frozenset(groups)
        self.scales = tuple(max(1.0, abs(target)) for target in self._targets)

    def _read_numbers(self, given: Sequence[Row], placed: bool) -> list[float | None]:
        """Rates, which are kept, and targets, None where they are to be found."""
        self._rates, targets = [], []
        for k, (row, of) in enumerate(zip(given, self._units, strict=True)):
            target = None if row.target is None else finite_number(row.target, f"target of row {k}", of)
            if target is None and not placed:
                raise InputError(f"row {k} has no target; give one, or the positions to find it at", item="positions")
            if target is not None and of == unit.radian and abs(target) > MOST_TURNED:
                raise InputError(
                    f"target of row {k} is {target:g}, over three turns, and in radian; give {target:g} * unit.degrees",
                    item="target",
                )
            targets.append(target)
            self._rates.append(finite_number(row.rate, f"rate of row {k}", of, unit.picosecond))
        return targets

    def _find_what_meets(self, system: openmm.System, asked: bool) -> None:
        """Which rows touch the same bodies that the constraints of the System make, and whether they touch any."""
        for k, touched in enumerate(self.atoms):
            sites = [atom for atom in touched if system.isVirtualSite(atom)]
            if sites:
                raise UnsupportedError(
                    f"row {k} ({self.names[k]}) depends on particle {sites[0]}, a virtual site, which OpenMM moves at "
                    "the end of a step only; build the coordinate from the particles that define the site"
                )
        self.sited = bool(virtual_sites(system))
        pairs = held_pairs(system)[0]
        tied = set(pairs.ravel().tolist())
        self.meets_system = asked or any(tied.intersection(touched) for touched in self.atoms)
        body = components(system.getNumParticles(), pairs if self.meets_system else [])
        bodies = [{int(body[atom]) for atom in touched} for touched in self.atoms]
        self._meet = [[bool(a & b) for b in bodies] for a in bodies]
        together = components(self.n_rows, [(i, j) for i, row in enumerate(self._meet) for j in range(i) if row[j]])
        self._blocks = [np.flatnonzero(together == k).tolist() for k in range(int(together.max()) + 1)]
        self._block_of = {k: block for block in self._blocks for k in block}

    # -- told by an integrator ------------------------------------------------------------------

    def attach(self, program: Program, context: openmm.Context) -> None:
        """A tolerance that was left open becomes what Forces can tell of coordinates of this size."""
        if self.asked_tolerance is None:
            self.tolerance = self.finest(context)
            program.set(f"tolerance{self.code}", self.tolerance)

    def set_target(
        self, integrator: Integrator, row: int, target: float | unit.Quantity, rate: object | None = None
    ) -> None:
        """Hold row `row` at another value from now on; `restore` brings the state there.

        It belongs to this integrator: no State or checkpoint changes it.

        Raises
        ------
        InputError
            No number, no such row; a rate for a row made without.
        """
        if row not in range(self.n_rows):
            raise InputError(f"there is no row {row}; rows are numbered from 0 to {self.n_rows - 1}", item="row")
        of = self._units[row]
        value = finite_number(target, f"target of row {row}", of)
        slope = None if rate is None else finite_number(rate, f"rate of row {row}", of, unit.picosecond)
        if slope is not None and self._rates[row] == 0.0:
            raise InputError(f"row {row} was made without a rate; give it one then", item="rate")
        require_holder(integrator)
        if slope is not None:
            integrator.program.set(self._of("rate", row, integrator), slope)
        if self._rates[row] != 0.0:
            slope = integrator.getGlobalVariableByName(self._of("rate", row, integrator))
            value -= slope * self._clock(integrator)
        integrator.program.set(self._of("target", row, integrator), value)

    # -- names in the program -------------------------------------------------------------------

    def _of(self, name: str, row: int, integrator: object = None) -> str:
        return f"{name}{self.code_in(integrator)}_{row}"

    def _gram(self, i: int, j: int) -> str:
        return f"gram{self.code}_{max(i, j)}_{min(i, j)}"

    def _inverse(self, i: int, j: int) -> str:
        """An entry of the inverse, which Broyden's updates make unsymmetric."""
        return f"inverse{self.code}_{i}_{j}"

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

    def _solved(self, i: int, name: str) -> str:
        """Expression for (inverse vector)_i."""
        return _sum(f"{self._inverse(i, j)}*{self._of(name, j)}" for j in self._block_of[i])

    # -- variables ------------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        c = self.code
        self._single = len(p.scheme.drifts) * len(p.scheme.flight) == 1
        self._counts = "min(stage, 1)*" if p.halves else ""  # what a bath does across the rows is no work
        for k in range(self.n_rows):
            p.setting(self._of("target", k), f"target of row {k}", self._targets[k])
            p.setting(self._of("rate", k), "change of this target in a ps", self._rates[k])
            p.number(self._of("work", k), "work done by moving the target")
        if self.driven:
            p.number(f"clock{c}", "time of the targets where the step began")
            p.number(f"flown{c}", "time of its drifts")
            p.number(f"began{c}", "good_steps when it began")
        p.setting(f"small{c}", "a pivot below this fraction of the row's own norm means dependence", PIVOT_TOLERANCE)
        p.setting(f"tolerance{c}", "what the residual may be", self.tolerance)
        if p.lean:
            p.number(f"renew{c}", "1 if G is to be computed", 1.0)
        #: Where the other parts leave positions, and where they are at the start of the drift.
        self._base = "xu" if len(p.parts) == 1 else f"base{c}"
        self._start = f"start{c}" if self.meets_system and (not self._single or p.halves) else "x_last"

    def take_precision(self, program: Program, precision: Precision) -> None:
        """What counts as small is what Forces of the platform can tell."""
        program.set(f"small{self.code}", max(PIVOT_TOLERANCE, 10 * precision.forces))

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
        keep = self.meets_system and not (p.lean and not slopes)
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
        for i in range(self.n_rows):
            for j in range(i + 1):
                if self._meet[i][j]:
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
        if p.lean:
            with p.when(f"state{c} > 2", "one more, which need not be measured"):
                self._push(p)
            p.let(f"held{c}", f"max(held{c}, delta(state{c}-3))", "it does what it did before")
        p.let("failed", f"select(failed, failed, select(held{c}, 0, {c}))", "did it succeed?")
        self._note_impulses(p, h)
        if p.lean:
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
            moved = f"+{self._rate(k)}*(clock{c}+flown{c})" if self._rates[k] != 0.0 else ""
            p.let(now, f"energy{group}-({self._of('target', k)}{moved})", f"{self.names[k]} less its target")
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
        if p.lean:
            sure = f"between*step(tolerance{c}-{_LEFT!r}*residual{c})"
            again = f"select({sure}, 3, 1)"
        p.let(
            f"state{c}",
            f"select(delta(state{c}-1)*(1-held{c}), select(step(1e10-residual{c})"
            f"*step({_ITERATIONS - 1}-iterations{c}), {again}, 2), 0)",
            "done, or once more, or give up",
        )
        for k in rows:
            more = f"select(delta(state{c}-1)+delta(state{c}-3), -({self._solved(k, 'sigma')}), 0)"
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
                p.let(of("expected", i), self._solved(i, "change"), "push that explains the change")
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
            before = "0" if p.lean else f"select(delta(stage), 0, {impulse})"
            share = "*(1+stage)" if p.halves else ""  # the second half also stands for the projection before it
            p.let(impulse, f"{before}+{push}/{h}{share}", "multiplier times time")

    # -- velocities -----------------------------------------------------------------------------

    def project(self, p: Program) -> None:
        c, rows = self.code, range(self.n_rows)
        if self._single:
            self._directions(p, slopes=True)
            self._invert(p)
        else:
            for k, group in enumerate(self._groups):
                p.sum(self._of("slope", k), f"-f{group}*v", f"rate of {self.names[k]}")
        for k in self._driven_rows:
            p.let(self._of("slope", k), f"{self._of('slope', k)}-({self._rate(k)})", "less that of the target")
        for k in rows:
            p.let(self._of("more", k), f"-({self._solved(k, 'slope')})", "multiplier times time")
        p.let(f"bad_sum{c}", _sum(f"abs({self._of('more', k)})" for k in rows), "to find what is no number")
        bad = f"select(singular{c}, {c}, select(step(1e200-bad_sum{c}), 0, {c}))"
        p.let("failed", f"select(failed, failed, {bad})", "independent rows, finite velocities?")
        for k in rows:
            p.let(self._of("more", k), f"select(failed, 0, {self._of('more', k)})", "nothing after a failure")
        v = f"v_kept{c}" if self.meets_system and self._single else "v"
        pushes = _sum(f"{self._of('more', k)}*{self._of('row', k)}" for k in rows)
        p.each("v", f"{v}+{pushes}", "tangent to the rows")
        for k in self._driven_rows:
            impulse = self._of("impulse", k)
            p.let(impulse, f"{impulse}+{self._counts}{self._of('more', k)}", "all of this step")
        self.passed(p)

    def passed(self, p: Program) -> None:
        """At the end of a step: the work of targets that move."""
        for k in self._driven_rows:
            done = f"{self._of('work', k)}+select(failed, 0, {self._counts}{self._rate(k)}*{self._of('impulse', k)})"
            p.let(self._of("work", k), done, "force times speed of the target")

    # -- seen from Python -----------------------------------------------------------------------

    def _clock(self, integrator: openmm.CustomIntegrator) -> float:
        """The time of the targets between steps; the step made last counts where it was kept."""
        if not self.driven:
            return 0.0
        c, read = self.code_in(integrator), integrator.getGlobalVariableByName
        kept = read(f"began{c}") != read("good_steps")
        return float(read(f"clock{c}") + (read(f"flown{c}") if kept else 0.0))

    # -- restoring and checking -----------------------------------------------------------------

    def solver_at(self, context: openmm.Context, *, plain: bool = False) -> Solver:
        """The engine with these rows at their targets, and with the constraints of the System that they meet.

        OpenMM computes the rows, in double precision; with `plain`, distances, angles and dihedrals are those of kcons:
        groups are moved whole towards these. `InputError` for a context that was made before the rows were added to its
        System, `SingularGeometryError` for a row without gradient.
        """
        require_context(context)
        x, masses = positions_of(context), masses_of(context.getSystem())
        given = (*self._in_engine(context, x, masses, plain), *self._beside(context))
        return Solver(Motion(ConstraintSet(with_massless_atoms(given, masses), x, masses), x))

    def _forces(self, context: openmm.Context) -> list[openmm.Force]:
        in_groups = {force.getForceGroup(): force for force in forces_of(context.getSystem())}
        missing = [k for k, group in enumerate(self._groups) if group not in in_groups]
        if missing:
            raise InputError(
                f"row {self._named(missing[0])} is no part of this System; make the context from the System that the "
                "rows were added to",
                item="context",
            )
        return [in_groups[group] for group in self._groups]

    def _in_engine(self, context: openmm.Context, x: FloatArray, masses: FloatArray, plain: bool) -> list[Constraint]:
        system, forces, values = context.getSystem(), self._forces(context), self.values(context)
        alone = forces_alone(system, forces, box_of(context), context.getParameters())
        rows: list[Constraint] = []
        for k, (target, rate) in enumerate(zip(*self._targets_and_rates(context), strict=True)):
            atoms = np.array(self.atoms[k])
            known = as_constraint(forces[k], target) if plain else None
            known = known and known.with_masses(masses[known.atoms])
            # The engine may see other images of the particles.
            if known is None or abs(known.measure(x[known.atoms], 0.0)[0] - values[k]) > SAME * max(1.0, abs(target)):
                functions = _value_and_gradient(alone, k, atoms, x)
                known = Custom(atoms, *functions, period=self.periods[k] or None, target=_moving(target, rate))
            rows.append(known)
        return rows

    def _beside(self, context: openmm.Context) -> list[Constraint]:
        """The constraints of the System in the clusters that the rows touch."""
        held = SystemRows.of(context.getSystem(), rounded=Precision.of(context).rounds_lengths)
        if not (self.meets_system and held.n_rows):
            return []
        body = components(len(held.masses), held.pairs)
        met = np.isin(body[held.pairs[:, 0]], body[[atom for atoms in self.atoms for atom in atoms]])
        return [Distance(held.pairs[met], held.lengths[met])] if met.any() else []

    def apply_positions(self, context: openmm.Context) -> None:
        """Bring the positions of the context onto the rows and the System's constraints; velocities stay as they are.

        Where all rows are distances, angles or dihedrals of particles or distances of centers of mass, other bonds
        and angles stay as they are, as with `hold` (`Motion.restore_positions`); with others it is the nearest point.

        Raises
        ------
        ConvergenceError, InfeasibleError, SingularGeometryError
            The rows cannot be reached, or not with bonds and angles as they are; the positions are unchanged.
        """
        require_context(context)
        start, velocities = positions_of(context), velocities_of(context)
        try:
            if context.getSystem().getNumConstraints():
                context.applyConstraints(context.getIntegrator().getConstraintTolerance())
            solver = self.solver_at(context, plain=True)
            any_function = any(isinstance(row, Custom) for row in solver.motion.sources[0].constraints)
            self.restore_by(solver, context, [] if any_function else bonds_of(context.getSystem(), start))
        except KconsError as error:
            context.setPositions(start)
            row = getattr(error, "row", -1)
            if row in range(self.n_rows):
                error.args = (f"row {self._named(row)}: {error}", *error.args[1:])
            raise
        finally:
            context.setVelocities(velocities)

    def restore(self, context: openmm.Context) -> None:
        """`apply_positions`, then `apply_velocities`, also for the System's other constraints; raises what these do."""
        self.apply_positions(context)
        context.applyVelocityConstraints(context.getIntegrator().getConstraintTolerance())
        self.apply_velocities(context)

    def check(self, context: openmm.Context) -> None:
        """Raise unless the state of the context is on the rows.

        Raises
        ------
        InputError
            The context was made before the rows were added to its System.
        SingularGeometryError
            Rows that vanish, or depend on others or on the System's constraints.
        UnsupportedError
            A barostat or CMMotionRemover that would break them.
        ConstraintError
            Positions or velocities are not on the rows; `restore` brings them there.
        """
        require_context(context)
        system, independent = context.getSystem(), self._independent(context)
        for k in range(self.n_rows):
            if k not in independent:
                raise SingularGeometryError(self._dependent(k), rows=[k])
        gradients = self.gradients(context)
        # A row that knows where the origin is gives momentum to the whole.
        sizes, totals = np.linalg.norm(gradients, axis=(1, 2)), np.linalg.norm(gradients.sum(axis=1), axis=1)
        in_space = np.flatnonzero(totals > max(1e-9, 10 * Precision.of(context).forces) * sizes)
        bound = f"collective row {self._named(int(in_space[0]))}" if len(in_space) else None
        wide = forces_alone(system, self._forces(context), 1.01 * np.array(box_of(context)), context.getParameters())
        wide.setPositions(positions_of(context))
        change = [energy_of(wide, {k}) for k in range(self.n_rows)] - self.values(context)
        cut = np.abs(change) > SAME * np.array(self.scales)
        held = [(np.array([a]), lambda _, k=k: self._named(k), cut[k : k + 1]) for k, a in enumerate(self.atoms)]
        refuse_agents(system, bound, held, context.getMolecules)
        found = self.worst_violation(context)
        if found is not None:
            remedy = "call restore(context)"
            moves = self._rates[found.row] != 0.0
            holder = owner(self, context)
            if moves and found.what == "positions" and (holder is None or self._clock(holder) == 0.0):
                remedy += (
                    ", or where the target has moved before, with another integrator, go on from there: "
                    f"set_target(integrator, {found.row}, {self.values(context)[found.row]:.12g})"
                )
            raise ConstraintError(f"the {found}; {remedy}", rows=[found.row], atoms=found.atoms)

    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """sigma and A v from the Forces themselves, at the state of the context."""
        forces, off = Precision.of(context).forces, self.residuals(context)
        allowed = np.array(self.scales) * max(START_TOLERANCE, 10 * self.tolerance, 2 * forces)
        near: ArrayLike = 0.0
        if np.any(np.abs(off) > allowed):
            # Compared with the target, one radian, or what moves an atom by a short bond.
            periods, targets = np.array(self.periods), self.targets(context)
            own = np.where(periods > 0, periods / (2 * np.pi), np.abs(targets))
            near = NEAR * np.maximum(own, BOND * np.linalg.norm(self.gradients(context), axis=(1, 2)))
        found = Violation.worst("positions", off, allowed, self._named, self.atoms.__getitem__, near)
        if found is not None or not velocities:
            return found
        gradients, v, demanded = self.gradients(context), velocities_of(context), self._targets_and_rates(context)[1]
        size = np.linalg.norm(gradients, axis=(1, 2)) * float(np.linalg.norm(v, axis=1).max(initial=0.0))
        rates = np.einsum("kai,ai->k", gradients, v) - demanded
        allowed = max(START_TOLERANCE, 2 * forces) * (size + np.abs(demanded))
        return Violation.worst("velocities", rates, allowed, self._named, self.atoms.__getitem__)

    # -- at the state of a context --------------------------------------------------------------

    def values(self, context: openmm.Context) -> FloatArray:
        """q of each row, shape (n_rows,)."""
        require_context(context)
        return np.array([energy_of(context, {group}) for group in self._groups])

    def targets(self, context: openmm.Context) -> FloatArray:
        """Where each target is now, shape (n_rows,).

        Where the integrator of the context does not hold the rows, targets are those the rows were made with.
        """
        return self._targets_and_rates(context)[0]

    def residuals(self, context: openmm.Context) -> FloatArray:
        """sigma = q - target of each row, shape (n_rows,), to the nearest image."""
        off, period = self.values(context) - self.targets(context), np.array(self.periods)
        safe = np.where(period > 0, period, 1.0)
        return np.where(period > 0, off - safe * np.floor(off / safe + 0.5), off)

    def gradients(self, context: openmm.Context) -> FloatArray:
        """grad q, shape (n_rows, n_particles, 3)."""
        return np.array([-forces_at(context, {group}) for group in self._groups])

    def rates(self, context: openmm.Context) -> FloatArray:
        """A v less the rate of the targets, shape (n_rows,), per ps."""
        across = np.einsum("kai,ai->k", self.gradients(context), velocities_of(context))
        return across - self._targets_and_rates(context)[1]

    def rank(self, context: openmm.Context) -> int:
        """How many degrees of freedom the rows take, beyond the constraints of the System."""
        return len(self._independent(context))

    def _independent(self, context: openmm.Context) -> list[int]:
        """The rows that add something to the rows before them and to the constraints of the System."""
        solver, x = self.solver_at(context), positions_of(context)
        held, n = solver.motion.sources[0].constraints, self.n_rows
        parts = [(*held[:k], *held[n:]) for k in range(n + 1)]
        ranks = [Motion(ConstraintSet(part, x, solver.motion.masses), x).rank for part in parts]
        return [k for k in range(n) if ranks[k + 1] > ranks[k]]

    def multipliers(self, context: openmm.Context) -> FloatArray:
        """lambda at the positions and velocities of the context, as accurate as these; shape (n_rows,).

        (A M_par^+ A^T) lambda = target'' - d(A v)/dt - A M_par^+ f (notes, eq. 104), M_par^+ that of the System's
        constraints. d(A v)/dt by differences of the gradient along v.
        """
        solver, (x, v) = self.solver_at(context), motion_of(context)
        f = forces_at(context, groups_in(context.getIntegrator()) - self.groups)
        return solver.motion.multipliers(x, v, f)[: self.n_rows]

    def finest(self, context: openmm.Context) -> float:
        """The smallest relative residual that is held: what Forces tell, of coordinates as they see them.

        Where those are single numbers, a row is off by the gradient times what rounding took of them, at random: twice
        its standard deviation is met by nearly each push.
        """
        precision = Precision.of(context)
        if precision.name == "double":
            return TOLERANCE
        wide = width_of(context) if context.getSystem().usesPeriodicBoundaryConditions() else 0.0
        moved = self.gradients(context) * np.maximum(np.abs(positions_of(context)), wide)
        blur = np.linalg.norm(moved, axis=(1, 2)) / np.array(self.scales)
        told = 0.8 * precision.seen * float(np.linalg.norm(blur))
        # A power of two, or it would be another number whenever x is.
        return max(precision.forces, 2.0 ** np.ceil(np.log2(told)) if 0 < told < np.inf else told)

    def _targets_and_rates(self, context: openmm.Context) -> tuple[FloatArray, FloatArray]:
        """What the integrator was made with or told; its variables are copies for the program."""
        targets, rates, holder = self._targets, self._rates, owner(self, context)
        if holder is None:
            return np.array(targets), np.array(rates)
        known = holder.program.settings
        targets = [known.get(self._of("target", k, holder), value) for k, value in enumerate(targets)]
        rates = [known.get(self._of("rate", k, holder), value) for k, value in enumerate(rates)]
        return np.array(targets) + np.array(rates) * self._clock(holder), np.array(rates)

    # -- of an integrator, after its last step --------------------------------------------------

    def work(self, integrator: openmm.CustomIntegrator) -> FloatArray:
        """What moving each target has added to the energy, in kJ/mol, shape (n_rows,): sum of lambda rate dt."""
        return self._read(integrator, "work")

    def _read(self, integrator: openmm.CustomIntegrator, name: str) -> FloatArray:
        require_holder(integrator)
        return np.array([integrator.getGlobalVariableByName(self._of(name, k, integrator)) for k in range(self.n_rows)])

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        """The error for a step in which the rows failed."""
        c = self.code
        singular = int(integrator.getGlobalVariableByName(f"singular{c}"))
        if singular:
            return SingularGeometryError(f"step {step}: {self._dependent(singular - 1)}", rows=[singular - 1])
        off = np.abs(self._read(integrator, "sigma")) / np.array(self.scales)
        residual = integrator.getGlobalVariableByName(f"residual{c}")
        row = int(np.argmax(np.where(np.isfinite(off), off, math.inf)))
        if not math.isfinite(residual):
            return NonFiniteError(
                f"step {step}: row {row} ({self.names[row]}) is not a number; forces or time step too large",
                item="position",
                step=step,
            )
        if residual <= self.tolerance:
            return NonFiniteError(
                f"step {step}: forces or velocities are not finite; the time step is too large",
                item="velocity",
                step=step,
            )
        iterations = int(integrator.getGlobalVariableByName(f"iterations{c}"))
        return ConvergenceError(
            f"step {step}: row {row} ({self.names[row]}) is off by {off[row] * self.scales[row]:.3g} after "
            f"{iterations} iterations (tolerance {self.tolerance:.3g}); time step "
            f"too large (dt = {integrator.getStepSize()}), or a start that is not on the rows: call restore(context)",
            residual=float(residual),
            tolerance=self.tolerance,
            iterations=iterations,
            row=row,
            step=step,
        )

    def _named(self, row: int) -> str:
        return f"{row} ({self.names[row]})"

    def _dependent(self, row: int) -> str:
        return (
            f"row {self._named(row)} vanishes, or depends on the rows before it or on the constraints of the System. "
            "Leave out a row that others imply; a dihedral over a straight angle or an RMSD of 0 has no direction"
        )

    def __repr__(self) -> str:
        return f"CollectiveRows({', '.join(self.names)})"


def _moving(target: float, rate: float) -> float | MovingTarget:
    """A target that moves from here on."""
    return MovingTarget(lambda t: target + rate * t, lambda t: rate, lambda t: 0.0) if rate else target


def _value_and_gradient(
    alone: openmm.Context, group: int, atoms: IntArray, x: FloatArray
) -> tuple[Callable[[FloatArray], float], Callable[[FloatArray], FloatArray]]:
    """The coordinate that a force group is, as functions of the positions of its particles."""

    def place(r: FloatArray) -> None:
        y = x.copy()
        y[atoms] = r
        alone.setPositions(y)

    def value(r: FloatArray) -> float:
        place(r)
        return energy_of(alone, {group})

    def gradient(r: FloatArray) -> FloatArray:
        place(r)
        return -forces_at(alone, {group})[atoms]

    return value, gradient


def _name(force: openmm.Force) -> str:
    text = force.getEnergyFunction() if hasattr(force, "getEnergyFunction") else ""
    return type(force).__name__ + (f" {text}" if 0 < len(text) <= 24 else "")


def require_holder(integrator: openmm.CustomIntegrator) -> None:
    """Refuse a Context, a Simulation or whatever else is given for the integrator that holds the rows."""
    if not isinstance(integrator, openmm.CustomIntegrator):
        raise InputError(
            f"integrator is a {type(integrator).__name__}; give the integrator that holds the rows", item="integrator"
        )


def owner(rows: CollectiveRows, context: openmm.Context) -> Integrator | None:
    """The integrator of the context that holds the rows, None if it has none."""
    require_context(context)
    integrator = context.getIntegrator()
    if isinstance(integrator, openmm.CompoundIntegrator) and rows.program is not None:
        integrator = rows.program.integrator  # the member that made steps last
    return integrator if rows in getattr(integrator, "parts", ()) else None


def _sum(terms: Iterable[str]) -> str:
    return "+".join(terms) or "0"
