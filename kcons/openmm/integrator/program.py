"""Ensembles, and the program of a step: what an ensemble puts into it, and its lines with the words that explain them.

What begins and ends a step, and what may be left out of it, goes by a few variables:

- `between` is 1 for all steps of a call but the last ones. A step after which nobody looks at the velocities may end
  without the second half of its kick and without a projection; it says so in `behind`, and the next makes up for it.
- `call` is 1 where a call of `step` begins and 2 afterwards. Forces are kept in a variable within a call only. Where it
  is 0, which is so without Python, they are computed in each step.
- `failed` is the number of the part whose solve failed; -1 asks Python to look at positions that others have moved.
  Nothing moves then until Python has read it. Of a step that failed x and v go back to `x_last` and `v_last`; what is
  kept of x is computed anew (`stale`), and `loose` says that v is not tangent.
- `ending` is 1 in the last step of a call, which sums `motion` for `Guard.look`.
- `phase` is other than 0 where virtual sites are placed at the end of an execution of the program only: each execution
  is then the part of a step from one force evaluation to the next, and counts on by itself.
"""

from __future__ import annotations

import re
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple, Self

import numpy as np
import openmm

from kcons.errors import InputError, UnsupportedError
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Operation, Project, Turn, drifts_of
from kcons.steppers.splitting import SCHEMES as STEPPERS
from kcons.steppers.splitting import Rattle, Splitting
from kcons.thermostats.isokinetic import SCHEMES as ISOKINETIC

#: A `ProjectedIntegrator` and a `Part`, whose modules import this one.
Integrator = Any
AnyPart = Any

#: Schemes whose shortest drifts are less than this part of a step: what rounding does to x, divided by the length of
#: the drift, must be kept out of v there.
SHORT_DRIFT = 1 / 30
_GIVEN = "x, v, m, f, dt: positions, velocities, masses, applied forces, time step"
_FORCES = re.compile(r"\b(f|energy)(\d*)\b")

#: Variables of steps that Python sets or that do not begin with 0: their kind, what they stand for, their first value.
VARIABLES: dict[str, tuple[Any, ...]] = {
    "phase": ("control", "0: make a whole step; k: make part k of a step only"),
    "ending": ("control", "1 in the last step of a call"),
    "call": ("control", "1 where a call of step begins, 2 within it, 0 without Python"),
    "failed": ("control", "number of the part whose solve failed, 0 for none"),
    "between": ("control", "1 if nobody looks at the velocities after this step"),
    "behind": ("control", "1 where v lacks what ends a step"),
    "looked": ("control", "1 if somebody may have looked since the last step", 1.0),
    "coarse": ("setting", "1 in single precision: rounding of x over a time step is much beside a kick"),
    "moving": ("setting", "1 where barostats may move x between steps"),
    "stale": ("number", "1 at a fresh start, and where what is kept of x must be computed anew", 1.0),
}


# -- schemes --------------------------------------------------------------------------------------


def _any_flows(order: int) -> Splitting:
    """A splitting that keeps its order with any kicks, those of the isokinetic thermostat among them."""
    splitting = Splitting(*ISOKINETIC[order])
    splitting.order = order
    return splitting


#: Schemes by name.
SCHEMES: dict[str, Callable[[], Splitting]] = {
    **STEPPERS,
    "isokinetic4": lambda: _any_flows(4),
    "isokinetic6": lambda: _any_flows(6),
}


def to_scheme(scheme: str | Splitting) -> Splitting:
    """The splitting of a name; `InputError` for an unknown one."""
    if isinstance(scheme, Splitting):
        return scheme
    if not isinstance(scheme, str) or scheme not in SCHEMES:
        raise InputError(f"no scheme {scheme!r}; known: {', '.join(SCHEMES)}", item="scheme")
    return SCHEMES[scheme]()


def stages_of(operations: Iterable[Operation]) -> tuple[list[float], list[float]]:
    """Drifts, and the kick before each of them and after the last, as fractions of the step."""
    drifts: list[float] = []
    kicks = [0.0]
    for operation in operations:
        if isinstance(operation, Kick | Turn):
            kicks[-1] += operation.fraction
        elif isinstance(operation, Fly):
            drifts += operation.flights
            kicks += [0.0] * len(operation.flights)
    return drifts, kicks


# -- ensembles ------------------------------------------------------------------------------------


class Ensemble:
    """The kicks of an integrator, and what happens in the middle of its step; this one is Newton's: v += h f/m.

    A value: its attributes never change, two are equal if theirs are, and it may be given to any number of
    integrators. What changes belongs to the integrator. The attributes are the arguments it is made with.

    A new ensemble overrides what differs: `declare` its variables and `settings`, and with `BetweenHalves` what
    `middle` does to v; or `open` and `close` around the step, or `kick`. All write into the program p of a step.

    Attributes
    ----------
    stays_tangent : bool
        Whether kicks leave v tangent to all constraints at x: a step that ends with a kick ends without a projection
        of its own then.
    adds_up : bool
        Whether two kicks at the same place, which are one of the sum of their times, are made as one.
    owes : bool
        Whether what `close` does may be left to the next step if the state is not read between.
    noisy : bool
        Whether it has noise, of size `spread` in the program: the kinetic energy that is reported is then that of
        the middle, since velocities have the temperature of the bath in the middle of a step only.
    """

    stays_tangent = adds_up = owes = noisy = False

    # -- what it goes with ----------------------------------------------------------------------

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for schemes that lose their order, or cannot be used, with these kicks."""

    def check_timestep(self, dt: float) -> None:
        """Raise `InputError` for a time step (ps) that the ensemble cannot follow."""

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        """What a step consists of. Where there is an `Exchange`, `middle` writes it."""
        return scheme.program(None).operations

    # -- the program ----------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        """Variables and tables."""

    def write(self, p: Program) -> None:
        """Write the step."""
        if p.parts:
            kind = _lean_step if p.lean else _guarded_step
        else:
            kind = _joined_step if p.joined else _single_step if p.one_drift else _loop_step
        kind(p)

    def open(self, p: Program) -> None:
        """What comes before the first kick of a step, v tangent to all constraints; also what the last step owes."""

    def close(self, p: Program) -> None:
        """What comes at the end of a step, v tangent to all constraints.

        With `owes`, and where the program has `between`, `behind` says that the next step is to do it.
        """

    def take_back(self, p: Program) -> None:
        """A step failed: variables of the ensemble are again what they were before `open`."""

    def kick(self, p: Program, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """Let the applied forces act for a time h; returns the velocities afterwards, which are not yet in v.

        All are expressions. `impulse`, of the drift that came before, is to be added to v first; v is `tangent` without
        it; another kick follows before v is read (`unseen`).
        """
        return "+".join(filter(None, ["v", impulse, f"{h}*{p.force}/m"]))

    def middle(self, p: Program, u: str) -> None:
        """Between two halves of the drift: from velocities u, an expression, to v."""
        raise NotImplementedError

    def drift(self, p: Program, h: str, u: str) -> str:
        """A drift of length h with velocities u; returns what `Program.drift` does."""
        return p.flight(h, u)

    # -- a run ----------------------------------------------------------------------------------

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """At the first step of a run, x and v on the constraints.

        Raises
        ------
        KconsError
            The ensemble does not exist for this System or this start.
        """

    def verify(self, integrator: Integrator) -> None:
        """Raise `ConvergenceError` if something went wrong since the last check."""

    def warmth(self, integrator: Integrator) -> float:
        """What 2 K/(g k) is to be multiplied with for the temperature, g being `degrees_of_freedom`."""
        return 1.0

    def settings(self) -> dict[str, float]:
        """The global variables of the program that are settings of the ensemble, by name."""
        return {}

    def follow(self, integrator: Integrator) -> None:
        """The integrator takes this ensemble, perhaps in the middle of a run; raise `KconsError` if it cannot."""

    # -- a value --------------------------------------------------------------------------------

    def replaced(self, **changes: Any) -> Self:
        """The same with other arguments."""
        return type(self)(**{**vars(self), **changes})

    def _keep(self, **attributes: Any) -> None:
        vars(self).update(attributes)

    def __setattr__(self, name: str, value: object) -> None:
        raise UnsupportedError(
            f"{self!r} is a value and does not change: call setTemperature or setFriction of the integrator, or make "
            f"another {type(self).__name__}"
        )

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and vars(other) == vars(self)

    def __hash__(self) -> int:
        return hash((type(self), *vars(self).items()))


class ConstantEnergy(Ensemble):
    """Newton's equations."""


class BetweenHalves(Ensemble):
    """What acts between two halves of RATTLE's drift: half a kick, half a drift, `middle`, half a drift, half a kick.

    `declare` and `middle` are left to write: `middle` makes v out of the velocities that the first half ends with.
    """

    adds_up = True

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for all schemes but 'rattle'."""
        if scheme.kicks != (0.5, 0.5) or scheme.drifts != (1.0,) or scheme.flight != (1.0,):
            raise UnsupportedError(
                f"{type(self).__name__} splits the drift of scheme='rattle' in two; {scheme!r} has another form"
            )

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        first, second = drifts_of((0.5, 0.5))
        return (Kick(0.5), first, Exchange(1.0), second, Evaluate(), Kick(0.5), Project())


# -- the program ----------------------------------------------------------------------------------


class Line(NamedTuple):
    """One computation.

    Its kind is 'let' for a global variable, 'each' for one of each degree of freedom, 'sum'; 'hold' x or v; 'others';
    'loop', 'when' and 'end' make blocks.
    """

    kind: str
    variable: str
    expression: str
    words: str

    @property
    def code(self) -> str:
        """As `listing` shows it."""
        match self.kind:
            case "hold":
                return f"constrain {'positions' if self.variable == 'x' else 'velocities'}"
            case "others":
                return "update context state"
            case "loop" | "when":
                return f"{'while' if self.kind == 'loop' else 'if'} {self.expression}:"
            case "sum":
                return f"{self.variable} = sum({self.expression})"
        return f"{self.variable} = {self.expression}"


class Program:
    """Variables and lines of a step; `hand_over` gives them to a CustomIntegrator."""

    #: Whether a plugin has kernels in place of the lines.
    on_device = False

    def __init__(self, integrator: Integrator, scheme: Splitting, parts: Sequence[AnyPart], ensemble: Ensemble) -> None:
        # Weak, for the integrator owns its program.
        self._integrator = weakref.ref(integrator)
        self.scheme, self.parts, self.ensemble = scheme, tuple(parts), ensemble
        self.lines: list[Line] = []
        #: Global variables, and their values in a new integrator.
        self.numbers: dict[str, float] = {}
        #: Those that the integrator was made with, or was told since: kept here and written at each call of `step`, so
        #: that what a State or a checkpoint brings is a copy.
        self.settings: dict[str, float] = {}
        #: Those that control the program, as they are where nothing is asked of it; written at each call as well.
        self.idle: dict[str, float] = {}
        #: Those that belong to a state as x and v do.
        self.memory: set[str] = set()
        #: Variables with a value for each degree of freedom.
        self.vectors: list[str] = []
        #: Constants, written name(k) in expressions.
        self.tables: dict[str, tuple[float, ...]] = {}
        #: Expression of the kinetic energy that a State tells, and name of the applied forces.
        self.kinetic_energy, self.force = "m*v*v/2", "f"
        #: What tables stand for, and variables that Python sets or reads.
        self.words: dict[str, str] = {}
        verlet, plain = isinstance(scheme, Rattle), type(ensemble) is ConstantEnergy
        #: Whether parts stand beside virtual sites.
        self.sited = any(part.sited for part in self.parts)
        #: Whether there is one part, whose rows are all there is; whether it flies exactly, as the scheme asks.
        self.single = len(self.parts) == 1 and self.parts[0].alone and not self.sited
        self.exact = self.single and plain and scheme.exact_flight and self.parts[0].flies_exactly
        self.operations = ensemble.operations(Splitting(scheme.kicks, scheme.drifts) if self.exact else scheme)
        self.drifts, self.kicks = stages_of(self.operations)
        #: Whether a bath acts between two halves of the only drift.
        self.halves = any(isinstance(operation, Exchange) for operation in self.operations)
        self.one_drift = (len(self.drifts) == 1 and not self.exact) or self.halves
        #: Executions of the program in a step where virtual sites are placed at the end of each only.
        self.phases = 2 if self.halves or self.parts else len(self.drifts) + 1
        #: Whether velocity Verlet with parts leaves out what only a reader of velocities needs.
        self.lean = plain and bool(self.parts) and verlet and not self.sited
        #: Without parts: whether the kick that ends a step is made with that which begins the next.
        self.joined = ensemble.adds_up and not self.parts and verlet
        #: Where velocities in the middle and at the end of a step are noted: of joined steps in what is idle there.
        self.noted = ("xu", "x_start") if self.joined else ("v_middle", "v_end")
        #: Whether `between` is of use.
        self.lazy = self.lean or self.joined or (not self.parts and ensemble.owes)
        #: Whether drifts change v by impulses without the rounding errors of positions.
        self.filtered = not self.parts and bool(np.abs(self.drifts).min() < SHORT_DRIFT)

    @property
    def integrator(self) -> Integrator:
        integrator = self._integrator()
        assert integrator is not None
        return integrator

    # -- variables that Python reads or sets; what a line computes needs no declaration ---------

    def number(self, name: str, words: str, value: float = 0.0) -> None:
        """Declare a global variable."""
        if name not in self.words:
            self.words[name] = words
            self.numbers[name] = float(value)

    def setting(self, name: str, words: str, value: float = 0.0) -> None:
        """Declare a global variable that the integrator was made with."""
        self.settings.setdefault(name, float(value))
        self.number(name, words, value)

    def control(self, name: str, words: str, value: float = 0.0) -> None:
        """Declare a global variable that has this value between two calls of `step`."""
        self.idle.setdefault(name, float(value))
        self.number(name, words, value)

    def remember(self, name: str, words: str) -> None:
        """Declare a global variable that belongs to a state as x and v do, 0 at first."""
        self.memory.add(name)
        self.number(name, words)

    def vector(self, name: str, words: str) -> None:
        """Declare a variable with a value for each degree of freedom."""
        if name not in self.words:
            self.words[name] = f"{words} (each degree of freedom)"
            self.vectors.append(name)

    def table(self, name: str, values: Sequence[float], words: str) -> None:
        """Declare a table of constants, written name(k) in expressions."""
        self.words[f"{name}(k)"] = words
        self.tables[name] = tuple(float(value) for value in values)

    def use(self, *names: str) -> None:
        """Declare variables of the list."""
        for name in names:
            kind, *given = VARIABLES[name]
            getattr(self, kind)(name, *given)

    # -- computations ---------------------------------------------------------------------------

    def let(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for one global variable."""
        self.numbers.setdefault(variable, 0.0)
        self.lines.append(Line("let", variable, expression, words))

    def each(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for each degree of freedom."""
        if variable not in ("x", "v", *self.vectors):
            self.vectors.append(variable)
        self.lines.append(Line("each", variable, expression, words))

    def sum(self, variable: str, expression: str, words: str) -> None:
        """variable = sum of expression over all degrees of freedom."""
        self.numbers.setdefault(variable, 0.0)
        self.lines.append(Line("sum", variable, expression, words))

    def hold_positions(self, words: str) -> None:
        self.lines.append(Line("hold", "x", "", words))

    def hold_velocities(self, words: str) -> None:
        self.lines.append(Line("hold", "v", "", words))

    def let_others_act(self) -> None:
        """Barostats, CMMotionRemover, Andersen thermostats change the state here."""
        self.lines.append(Line("others", "", "", "barostats and other outside agents may act"))

    def loop(self, condition: str, words: str) -> AbstractContextManager[None]:
        """Repeat what is written inside while `condition` holds."""
        return self.when(condition, words, "loop")

    @contextmanager
    def when(self, condition: str, words: str, kind: str = "when") -> Iterator[None]:
        """Do what is written inside if `condition` holds; without anything inside, there is no block."""
        self.lines.append(Line(kind, "", condition, words))
        begun = len(self.lines)
        yield
        if len(self.lines) == begun:
            self.lines.pop()
        else:
            self.lines.append(Line("end", "", "", ""))

    # -- kicks, drifts, projections -------------------------------------------------------------

    def kick(self, h: str, impulse: str = "", tangent: bool = False) -> None:
        """The applied forces act for h, after the impulse of a drift."""
        words = "constraint forces act, then the applied ones" if impulse else "applied forces act"
        self.each("v", self.ensemble.kick(self, h, impulse, tangent), f"the {words} (kick)")

    def drift(self, h: str, u: str = "v") -> str:
        """Fly h along all constraints with velocities u; returns the impulse that keeps x on them, to be added to u."""
        return self.ensemble.drift(self, h, u)

    def flight(self, h: str, u: str) -> str:
        """The drift itself."""
        if self.filtered:
            return self._filtered_flight(h)
        for part in self.parts:
            part.remember(self)
        self.land(u, h)
        return f"(x-xu)/{h}"

    def _filtered_flight(self, h: str) -> str:
        """The drift, with rounding kept out of v: of (x-xu)/h only what is along the gradients at its start is added.

        (x-xu)/h is the change of v by the constraint forces, plus the rounding errors of x divided by h. Constraint
        forces act along the gradients where the drift began, so that whatever else (x-xu)/h has is rounding.
        """
        self.each("x_start", "x", "where the drift begins")
        self.each("x", f"x+{h}*v", "move freely (drift)")
        self.each("xu", "x", "where that leads")
        self.hold_positions("back onto the constraints of the System")
        self.each("v_next", f"v+(x-xu)/{h}", "the constraint forces act on v as well, and rounding errors of x")
        self.each("v", f"(x-xu)/{h}", "to be split")
        self.each("xu", "x", "where the drift ends")
        self.each("x", "x_start", "back, for a moment")
        self.hold_positions("the solver of the System takes its directions from here")
        self.hold_velocities("what is along the constraints: rounding")
        self.each("x", "xu", "where the drift ends")
        self.hold_positions("the solver of the System takes its directions from here")
        return "v_next-2*v"

    def land(self, u: str, h: str) -> None:
        """Fly freely for h with velocities u, and go from there back onto all constraints."""
        u = u if u.isidentifier() else f"({u})"
        self.each("x", f"x+{h}*{u}", "move freely (drift)")
        self.each("xu", "x", "where that leads")
        for part in self.parts:
            if not (part.meets_system or part.lands_last):
                part.land(self, h)
        together = [part for part in self.parts if part.meets_system]
        if together:
            together[0].land(self, h)
        else:
            self.hold_positions("back onto the constraints of the System")
        # Until then GPUs keep x as a difference, and forces do not see it.
        for part in self.parts:
            if part.lands_last:
                part.land(self, h)
        if self.sited and any(part.lands_last for part in self.parts):
            self.hold_positions("GPUs place virtual sites")

    def project(self) -> None:
        """Make v tangent to all constraints at x."""
        self.hold_velocities("tangent to the constraints of the System")
        for part in self.parts:
            part.project(self)

    @property
    def ends_tangent(self) -> bool:
        """Whether the last kick leaves v tangent, so that no projection is needed."""
        return self.ensemble.stays_tangent and self.kicks[-1] != 0 and (not self.parts or self.one_drift)

    def note_middle(self, velocities: str) -> None:
        """The velocities between the last drift of a step and the kick that ends it."""
        if self.ensemble.noisy:
            self.each(self.noted[0], velocities, "its kinetic energy is reported")

    def note_end(self) -> None:
        """The step that has this middle ends."""
        if self.ensemble.noisy:
            self.each(self.noted[1], "v", "to see whether others change v")

    # -- the integrator -------------------------------------------------------------------------

    def hand_over(self) -> None:
        """Give variables and lines to the integrator: the only place where a program of OpenMM is made."""
        integrator = self.integrator
        for name, value in self.numbers.items():
            integrator.addGlobalVariable(name, value)
        for name in self.vectors:
            integrator.addPerDofVariable(name, 0)
        for name, table in self.tables.items():
            integrator.addTabulatedFunction(name, openmm.Discrete1DFunction(list(table)))
        integrator.setKineticEnergyExpression(self.kinetic_energy)
        add = {
            "let": integrator.addComputeGlobal,
            "each": integrator.addComputePerDof,
            "sum": integrator.addComputeSum,
            "hold": lambda x, _: (
                integrator.addConstrainPositions() if x == "x" else integrator.addConstrainVelocities()
            ),
            "others": lambda *_: integrator.addUpdateContextState(),
            "loop": lambda _, condition: integrator.beginWhileBlock(condition),
            "when": lambda _, condition: integrator.beginIfBlock(condition),
            "end": lambda *_: integrator.endBlock(),
        }
        for line in self.lines:
            add[line.kind](line.variable, line.expression)

    def set(self, name: str, value: float) -> None:
        """Change a setting, here and in the Context."""
        self.settings[name] = float(value)
        self.write(name, value)

    def write(self, name: str, value: float) -> None:
        """Change a global variable in the Context only."""
        openmm.CustomIntegrator.setGlobalVariableByName(self.integrator, name, float(value))

    def push(self) -> None:
        """Write all settings into the Context, and end what was under way there."""
        self.recall({**self.settings, **self.idle})

    def remembered(self) -> dict[str, Any]:
        """What belongs to the present state besides x and v."""
        return {name: self.integrator.getGlobalVariableByName(name) for name in sorted(self.memory)}

    def recall(self, values: Mapping[str, Any]) -> None:
        """Write what `remembered` gave back into the Context."""
        for name, value in values.items():
            self.write(name, value)

    def listing(self) -> str:
        """The variables, and the steps with their words in a column beside."""
        rows, depth = [], 0
        for line in self.lines:
            if line.kind == "end":
                depth -= 1
                continue
            rows.append(("    " * depth + line.code, line.words))
            depth += line.kind in ("loop", "when")
        width = min(max((len(code) for code, _ in rows), default=0), 60)
        steps = [f"  {code:<{width}}  # {words}" for code, words in rows]
        known = [f"{name}: {words}" for name, words in self.words.items()]
        return "\n".join(["variables", *(f"  {line}" for line in (_GIVEN, *known)), "each step", *steps])


def forces_at_old_positions(lines: Sequence[Line]) -> bool:
    """Whether GPUs compute forces at old positions where the System has constraints.

    They keep what a computation makes of x as a difference, which forces do not see, until the next constraints are
    applied to positions; where no such line follows anywhere below, x is changed at once.
    """
    holds = [k for k, line in enumerate(lines) if line[:2] == ("hold", "x")]
    kept = False
    for k, line in enumerate(lines):
        if kept and _FORCES.search(line.expression):
            return True
        if line.kind == "hold" and line.variable == "x":
            kept = False
        elif line.kind == "each" and line.variable == "x":
            kept = bool(holds) and k < holds[-1]
    return False


# -- steps ----------------------------------------------------------------------------------------


def write_step(p: Program) -> None:
    """Write the lines of a step."""
    if p.lazy:
        p.use("between")
    p.ensemble.declare(p)
    if p.ensemble.noisy:
        # Where others have set v since, it is theirs that counts.
        p.kinetic_energy = "m*u*u/2; u=select(spread*delta(v-{1}), {0}, v)".format(*p.noted)
    p.ensemble.write(p)
    p.use("ending")
    with p.when("ending != 0", "a call ends"):
        p.sum("motion", "v*v", "are velocities finite?")


def _single_step(p: Program) -> None:
    """One drift, or two halves with a bath between them, without parts."""
    p.use("phase")
    h = "(0.5*dt)" if p.halves else "dt"
    with p.when("phase != 2", "up to the new positions"):
        p.let_others_act()
        p.ensemble.open(p)
        if p.kicks[0]:
            p.kick(_of_dt(p.kicks[0]), tangent=True)
        if p.halves:
            # The second half absorbs what is across the constraints.
            p.ensemble.middle(p, f"v+{p.drift(h)}")
        impulse = p.drift(h)
    with p.when("phase != 1", "with the forces there"):
        p.note_middle(f"v+{impulse}")
        if p.kicks[-1]:
            p.kick(_of_dt(p.kicks[-1]), impulse)
        else:
            p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
        if not p.ends_tangent:
            p.project()
        p.note_end()
        p.ensemble.close(p)
    p.let("phase", f"select(phase, select({p.phases}-phase, phase+1, 1), 0)", "the part that is next")


def _loop_step(p: Program) -> None:
    """Several drifts, without parts."""
    n = len(p.drifts)
    _declare_stages(p)
    p.use("phase")
    p.let("stage", "select(phase, phase-1, 0)", "first drift")
    p.let("stop", f"select(phase, min(phase, {n}), {n})", "where to stop")
    with p.when("stage = 0", "a step begins"):
        p.let_others_act()
        p.ensemble.open(p)
    # One loop over tables: unrolled, or with more blocks, the set-up of OpenMM takes long.
    with p.loop("stage < stop", "all drifts and kicks of the scheme"):
        with p.when("kick_share(stage) != 0", "a kick comes first"):
            p.kick("dt*kick_share(stage)")
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        p.each("v", f"v+{p.drift('h')}", "the constraint forces act on v as well")
        p.let("stage", "stage+1", "what follows")
    with p.when(f"phase*({p.phases}-phase) = 0", "the step ends"):
        if p.kicks[-1]:
            p.kick(_of_dt(p.kicks[-1]))
        if not p.ends_tangent:
            p.project()
        p.ensemble.close(p)
    p.let("phase", f"select(phase, select({p.phases}-phase, phase+1, 1), 0)", "the part that is next")


def _joined_step(p: Program) -> None:
    """Velocity Verlet without parts, of which two kicks between drifts are made as one where v is not read."""
    p.use("behind", "phase", "coarse")
    h = "(0.5*dt)" if p.halves else "dt"
    with p.when("phase != 2", "up to the new positions"):
        p.let_others_act()
        p.let("kick", "0.5+0.5*behind", "with the half kick that is missing")
        u = p.ensemble.kick(p, "kick*dt", tangent=True, unseen=True)
        with p.when("coarse != 0", "where a drift leads does not tell v: the impulse alone is read from it"):
            p.each("v", u, "the applied forces act (kick)")
            if p.halves:
                p.ensemble.middle(p, f"v+{p.drift(h)}")
            else:
                p.each("v", f"v+{p.drift(h)}", "the constraint forces act on v as well")
        with p.when("coarse = 0", "v need not be written: it follows from where the drift leads"):
            p.each("x_start", "x", "where the drift begins")
            p.each("x", f"x+{h}*({u})", "the applied forces act, then move freely (drift)")
            p.hold_positions("back onto the constraints of the System")
            if p.halves:
                p.ensemble.middle(p, f"(x-x_start)/{h}")
            else:
                p.each("v", f"(x-x_start)/{h}", "as the drift went")
        if p.halves:  # this half absorbs what noise has across the constraints
            p.each("v", f"v+{p.drift(h)}", "the constraint forces act on v as well")
        if p.ensemble.stays_tangent:
            with p.when("exact+1-between != 0", "kicks need it"):
                p.project()
    with p.when("between+delta(phase-1) = 0", "somebody looks at the velocities"):
        p.note_middle("v")
        p.kick("0.5*dt", tangent=True)
        if not p.ensemble.stays_tangent:  # otherwise the next drift absorbs what v has across
            p.project()
        p.note_end()
    p.let("behind", "between", "the next step makes up for it")
    p.let("phase", "select(phase, 3-phase, 0)", "the part that is next")


def _declare_stages(p: Program) -> None:
    p.table("drift_share", p.drifts, "length of drift k as a fraction of the step")
    p.table("kick_share", p.kicks, "length of the kick before drift k as a fraction of the step")


def _of_dt(share: float) -> str:
    return "dt" if share == 1 else f"{share!r}*dt"


# -- steps that are taken back when a part fails --------------------------------------------------


def _declare_guards(p: Program) -> None:
    """Variables of steps with parts, their stages, and what parts need."""
    p.use("failed", "stale", "call")
    p.number("good_steps", "steps done since the integrator was made")
    _declare_stages(p)
    p.force = "force"  # parts evaluate row groups, and OpenMM remembers the forces of the last groups only
    for part in p.parts:
        part.declare(p)


def _see_who_moved(p: Program) -> None:
    """How far x is from where the last step ended; where a call begins, Python has to look at what others moved."""
    p.sum("moved", "(x-x_last)^2", "barostats, setPositions and minimizers move x between steps")
    asks = "select(call-1, failed, select(moved, -1, 0))"
    p.let("failed", f"select(failed+stale, failed, {asks})", "a call begins: ask Python to look at x")


def _guarded_step(p: Program) -> None:
    """Any scheme with parts."""
    _declare_guards(p)
    if not (p.sited and p.one_drift):
        _up_to_forces(p, _with_forces)
        return
    p.use("phase")
    with p.when("phase != 2", "up to the new positions"):
        _up_to_forces(p, lambda _: None)
    with p.when("phase != 1", "with the forces there"):
        _with_forces(p)
    p.let("phase", "select(phase, 3-phase, 0)", "the part that is next")


def _up_to_forces(p: Program, then: Callable[[Program], None]) -> None:
    with p.when("failed = 0", "a step, and nothing failed before"):
        p.let_others_act()
    _see_who_moved(p)
    with p.when("failed = 0", "after a failure nothing moves"):
        with p.when("moved+stale != 0", "others did"):
            p.each("x_last", "x", "start here")
        with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
            p.each("force", "f", "applied forces")
        if p.ensemble.noisy:
            # Reference and CPU draw random numbers with each computation: how steps are divided into calls must not
            # change the noise.
            with p.when("moved+stale+abs(call-2) = 0", "forces are known"):
                p.each("force", "force", "as many random numbers are drawn")
        p.let("call", "select(call, 2, 0)", "forces are known in this call")
        with p.when("moved+stale != 0", "others did"):
            for part in p.parts:
                part.begin(p)
        p.let("stale", "0", "what is kept belongs to x")
        p.each("v_last", "v", "to come back to")
        p.ensemble.open(p)
        if p.kicks[0]:
            p.kick("dt*kick_share(0)", tangent=True)
        p.let("stage", "0", "first drift")
        if p.halves:
            p.let("h", "dt*drift_share(0)", "length of the first drift")
            p.ensemble.middle(p, f"v+{p.drift('h')}")
            p.let("stage", "1", "what follows")
        if p.one_drift:
            _only_drift(p, lambda: p.drift("h"))
        else:
            _all_drifts(p)
        then(p)


def _only_drift(p: Program, drift: Callable[[], object]) -> None:
    """One drift needs no loop; set-up takes 15 times as long for each block within a loop."""
    p.let("per_h", "0", "no drift yet")
    with p.when("failed = 0", "rows are independent"):
        p.let("h", "dt*drift_share(stage)", "length of the drift")
        drift()
        p.let("per_h", "1/h", "the constraint forces act on v as well")
        p.let("stage", "stage+1", "what follows")


def _all_drifts(p: Program) -> None:
    with p.loop(f"stage < {len(p.drifts)}*step(0.5-failed)", "all drifts and kicks of the scheme"):
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        if p.single:
            # From (x-xu)/h, the shortest of many drifts would have most of the digits of v.
            p.parts[0].land_alone(p, "v", "h")
        else:
            p.each("v", f"v+{p.drift('h')}", "the constraint forces act on v as well")
        p.let("stage", "stage+1", "what follows")
        # Without the block set-up is faster, but forces are then computed after a failure as well.
        if all(p.kicks[1:]) and all(part.stays_finite for part in p.parts):
            _kick_after(p)
        else:
            with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
                _kick_after(p)


def _kick_after(p: Program, impulse: str = "") -> None:
    """The kick that follows drift `stage`, with the forces at x."""
    p.each("force", "f", "applied forces")
    p.kick("dt*kick_share(stage)", impulse)


def _with_forces(p: Program) -> None:
    with p.when("failed = 0", "all solves converged"):
        if p.one_drift:
            p.note_middle("v+per_h*(x-xu)")
            _kick_after(p, "per_h*(x-xu)")
        if not p.ends_tangent:
            p.project()
        p.note_end()
        p.ensemble.close(p)
        p.let("good_steps", "good_steps+delta(failed)", "count it")
        p.each("x_last", "select(failed, x_last, x)", "where forces were computed")
    with p.when("failed > 0", "a solve failed"):
        p.each("x", "x_last", "back to where the step began")
        p.each("v", "v_last", "back to where the step began")
        p.ensemble.take_back(p)
        p.let("stale", "1", "what is kept belongs to elsewhere")


def _lean_step(p: Program) -> None:
    """Velocity Verlet with parts.

    Between two steps of one call velocities are not read. The second half kick of a step and the first of the next are
    then one, and the velocities are not made tangent: the next drift starts where they would be, pushes along the same
    gradients, and absorbs what they have across. The motion is the same; see notes on RATTLE and leapfrog.
    """
    p.use("moving", "looked", "behind")
    _declare_guards(p)
    with p.when("select(failed, 0, looked) != 0", "x and v may have been changed"):
        p.each("v_last", "v", "to come back to")
        p.let_others_act()
        _see_who_moved(p)
    with p.when("failed = 0", "after a failure nothing moves"):
        with p.when("looked != 0", "x and v may have been changed"):
            with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
                p.each("force", "f", "applied forces")
            p.let("call", "select(call, 2, 0)", "forces are known in this call")
            with p.when("moved+stale != 0", "others did"):
                p.each("x_last", "x", "start here")
                across = any(part.meets_system for part in p.parts)
                if across:
                    p.each("u", "v", "v is needed to project the rows")
                for part in p.parts:
                    part.begin(p)
                if across:
                    p.each("v", "u", "v again")
            p.each("u", "v+kick_share(0)*dt*force/m", "the applied forces act (kick)")
        with p.when("looked = 0", "in the middle of many steps"):
            p.let_others_act()
            p.each("x_last", "x", "to come back to")
            p.each("u", "v+dt*f/m", "the applied forces act (both half kicks)")
            for part in p.parts:
                part.renew(p)
        p.let("stale", "0", "what is kept belongs to x")
        p.let("stage", "0", "the drift")
        _only_drift(p, lambda: p.parts[0].land_alone(p, "u", "h") if p.single else p.flight("h", "u"))
        with p.when("select(failed, 0, 1-between) != 0", "somebody looks at the velocities"):
            landed = "v" if p.single else "u+per_h*(x-xu)"
            p.each("force", "f", "applied forces")
            p.each("v", f"{landed}+dt*kick_share(stage)*force/m", "constraint forces act, then the applied ones (kick)")
            p.project()
            p.each("x_last", "select(failed, x_last, x)", "where the step ended")
        with p.when("select(failed, 0, between) != 0", "nobody looks"):
            if not p.single:
                p.each("v", "u+per_h*(x-xu)", "the constraint forces act on v as well")
            for part in p.parts:
                part.passed(p)
        # Without blocks: the set-up of OpenMM goes along each way through them.
        p.let("good_steps", "good_steps+delta(failed)", "count it if all solves converged")
        with p.when("failed != 0", "a solve failed"):
            p.each("x", "x_last", "back to where the step began")
            p.each("v", "select(looked, v_last, u-0.5*dt*f/m)", "back to where the step began")
            p.let("loose", "1-looked", "was it complete?")
            p.let("stale", "1", "what is kept belongs to elsewhere")
        p.let("looked", "select(failed, 1, 1-between)", "does somebody look?")
        p.let("behind", "1-looked", "v lacks half a kick")
