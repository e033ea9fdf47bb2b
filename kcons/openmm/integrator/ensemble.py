"""Ensembles, and the step that they write: what an ensemble puts into it, and the variables of its program.

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

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import openmm

from kcons.errors import UnsupportedError
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import stages_of
from kcons.steppers.operations import Evaluate, Exchange, Kick, Operation, Project, drifts_of
from kcons.steppers.splitting import Rattle, Splitting

#: Schemes whose shortest drifts are less than this part of a step: what rounding does to x, divided by the length of
#: the drift, must be kept out of v there.
SHORT_DRIFT = 1 / 30


class Variable(NamedTuple):
    """What a name in a program stands for."""

    kind: str
    words: str
    value: float = 0.0


VARIABLES = {
    "phase": Variable("control", "0 for a whole step; else the number of the part of it that is made"),
    "stage": Variable("number", "number of the drift"),
    "stop": Variable("number", "the drift that is left to the next part"),
    "h": Variable("number", "length of the drift"),
    "per_h": Variable("number", "1/h after the drift"),
    "kick": Variable("number", "length of a kick as a fraction of the step, with what the last step left out"),
    "ending": Variable("control", "1 in the last step of a call"),
    "motion": Variable("number", "sum of squares of velocities where a call ended"),
    "good_steps": Variable("number", "steps done since the integrator was made"),
    "call": Variable("control", "1 where a call of step begins, 2 within it, 0 without Python"),
    "failed": Variable("control", "number of the part whose solve failed, 0 for none"),
    "loose": Variable("number", "1 where v was taken back to a step at whose end nobody looked: it is not tangent"),
    "between": Variable("control", "1 if nobody looks at the velocities after this step"),
    "behind": Variable("control", "1 where v lacks what ends a step"),
    "looked": Variable("control", "1 if somebody may have looked since the last step", 1.0),
    "coarse": Variable("setting", "1 in single precision: rounding of x over a time step is much beside a kick"),
    "moving": Variable("setting", "1 where barostats may move x between steps"),
    "moved": Variable("number", "how far others have moved x since the last step"),
    "stale": Variable("number", "1 at a fresh start, and where what is kept of x must be computed anew", 1.0),
    "xu": Variable("vector", "positions before constraints act on them"),
    "u": Variable("vector", "velocities of the drift"),
    "x_last": Variable("vector", "positions to come back to"),
    "v_last": Variable("vector", "velocities to come back to"),
    "x_start": Variable("vector", "positions where the drift began"),
    "v_middle": Variable("vector", "velocities after friction and noise, with which x moved last"),
    "v_end": Variable("vector", "v at the end of the step that has this v_middle"),
    "v_next": Variable("vector", "velocities with all of (x-xu)/h"),
    "force": Variable("vector", "applied forces at x, kept within a call where OpenMM would compute them again"),
}


def use(program: Program, *names: str) -> str:
    """Declare variables of the list; returns the last name."""
    for name in names:
        kind, words, first = VARIABLES[name]
        getattr(program, kind)(name, words, *(() if kind == "vector" else (first,)))
    return names[-1]


#: A `ProjectedIntegrator`, whose module imports this one.
Integrator = Any


class Ensemble:
    """The kicks of an integrator, and what happens in the middle of its step; this one is Newton's: v += h f/m.

    A value: its attributes never change, two are equal if theirs are, and it may be given to any number of
    integrators. What changes belongs to the integrator. The attributes are the arguments it is made with.

    A new ensemble overrides what differs: `declare` its variables and `settings`, and with `BetweenHalves` what
    `middle` does to v; or `open` and `close` around the step, or `kick`.

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
        `v_middle`, since velocities have the temperature of the bath in the middle of a step only.
    """

    stays_tangent = adds_up = owes = noisy = False

    # -- what it goes with ----------------------------------------------------------------------

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for schemes that lose their order, or cannot be used, with these kicks."""

    def check_timestep(self, dt: float) -> None:
        """Raise `InputError` for a time step (ps) that the ensemble cannot follow."""

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        """What a step consists of. Where there is an `Exchange`, `middle` writes it."""
        return scheme.operations()

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        """Variables and tables."""

    def write(self, step: Step) -> bool:
        """Write a step of its own kind; False to leave it to `write_step`."""
        return False

    def open(self, program: Program) -> None:
        """What comes before the first kick of a step, v tangent to all constraints; also what the last step owes."""

    def close(self, program: Program) -> None:
        """What comes at the end of a step, v tangent to all constraints; `behind` says that the next step is to do it.

        Only with `owes`, and where the program has `between`.
        """

    def take_back(self, program: Program) -> None:
        """A step failed: variables of the ensemble are again what they were before `open`."""

    def kick(self, step: Step, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """Let the applied forces act for a time.

        Parameters
        ----------
        step : Step
        h : str
            Expression of the time.
        impulse : str
            Expression that is to be added to v before (that of the drift that came before), or ''.
        tangent : bool
            Whether v is tangent before, without the impulse.
        unseen : bool
            Whether another kick follows before v is read.

        Returns
        -------
        str
            Expression of the velocities afterwards, which are not yet in v.
        """
        return "+".join(filter(None, ["v", impulse, f"{h}*{step.force}/m"]))

    def middle(self, step: Step, u: str) -> None:
        """Between two halves of the drift: from velocities u, an expression, to v."""
        raise NotImplementedError

    def drift(self, step: Step, h: str, u: str) -> str:
        """A drift of length h with velocities u; returns what `Step.drift` does."""
        return step.flight(h, u)

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

    def at(self, temperature: float) -> Self:
        """The same at another temperature (K)."""
        if "temperature" not in vars(self):
            raise UnsupportedError("at constant energy there is no temperature to set; give an ensemble")
        return self.replaced(temperature=temperature)

    def with_friction(self, friction: Any) -> Self:
        """The same with another friction (1/ps)."""
        if "friction" not in vars(self):
            raise UnsupportedError("there is no friction; give ensemble=Langevin(temperature, friction)")
        return self.replaced(friction=friction)

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

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

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


class Step:
    """What the functions that write a step share.

    Attributes
    ----------
    operations : tuple of Operation
        What a step consists of.
    drifts, kicks : list of float
        Its stages as fractions of the step; see `stages_of`.
    halves : bool
        Whether a bath acts between two halves of the only drift.
    phases : int
        Executions of the program that a step takes where virtual sites are placed at the end of each only.
    sited : bool
        Whether parts stand beside virtual sites.
    single : bool
        Whether there is one part, whose rows are all there is.
    lean : bool
        Whether velocity Verlet with parts leaves out what only a reader of velocities needs.
    lazy : bool
        Whether `between` is of use.
    force : str
        Name of the applied forces.
    """

    def __init__(self, program: Program, scheme: Splitting, parts: Sequence[Part], ensemble: Ensemble) -> None:
        self.program, self.scheme, self.parts, self.ensemble = program, scheme, tuple(parts), ensemble
        verlet, plain = isinstance(scheme, Rattle), type(ensemble) is ConstantEnergy
        self.sited = any(part.sited for part in self.parts)
        self.single = len(self.parts) == 1 and self.parts[0].alone and not self.sited
        exact = self.single and plain and scheme.exact_flight and self.parts[0].flies_exactly
        for part in self.parts:
            part.exact = exact
        self.operations = ensemble.operations(Splitting(scheme.kicks, scheme.drifts) if exact else scheme)
        self.drifts, self.kicks = stages_of(self.operations)
        self.halves = any(isinstance(operation, Exchange) for operation in self.operations)
        self.one_drift = (len(self.drifts) == 1 and not exact) or self.halves
        self.phases = 2 if self.halves or self.parts else len(self.drifts) + 1
        self.lean = plain and bool(self.parts) and verlet and not self.sited
        #: Without parts: the kick that ends a step is made with that which begins the next.
        self.joined = ensemble.adds_up and not self.parts and verlet
        self.lazy = self.lean or self.joined or (not self.parts and ensemble.owes)
        self.force = "f"
        #: Whether drifts change v by impulses without the rounding errors of positions.
        self.filtered = not self.parts and bool(np.abs(self.drifts).min() < SHORT_DRIFT)

    # -- kicks, drifts, projections -------------------------------------------------------------

    def kick(self, h: str, impulse: str = "", tangent: bool = False) -> None:
        """The applied forces act for h, after the impulse of a drift."""
        words = "constraint forces act, then the applied ones" if impulse else "applied forces act"
        self.program.each("v", self.kicked(h, impulse, tangent), f"the {words} (kick)")

    def kicked(self, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """The velocities after a kick, which a drift may begin with."""
        return self.ensemble.kick(self, h, impulse, tangent, unseen)

    def drift(self, h: str, u: str = "v") -> str:
        """Fly h along all constraints with velocities u; returns the impulse that keeps x on them, to be added to u."""
        return self.ensemble.drift(self, h, u)

    def flight(self, h: str, u: str) -> str:
        """The drift itself."""
        p = self.program
        if self.filtered:
            return self._filtered_flight(h)
        for part in self.parts:
            part.remember(p)
        self.land(u, h)
        return f"(x-xu)/{h}"

    def _filtered_flight(self, h: str) -> str:
        """The drift, with rounding kept out of v: of (x-xu)/h only what is along the gradients at its start is added.

        (x-xu)/h is the change of v by the constraint forces, plus the rounding errors of x divided by h. Constraint
        forces act along the gradients where the drift began, so that whatever else (x-xu)/h has is rounding.
        """
        p = self.program
        use(p, "x_start", "v_next")
        p.each("x_start", "x", "where the drift begins")
        p.each("x", f"x+{h}*v", "move freely (drift)")
        p.each("xu", "x", "where that leads")
        p.hold_positions("back onto the constraints of the System")
        p.each("v_next", f"v+(x-xu)/{h}", "the constraint forces act on v as well, and rounding errors of x")
        p.each("v", f"(x-xu)/{h}", "to be split")
        p.each("xu", "x", "where the drift ends")
        p.each("x", "x_start", "back, for a moment")
        p.hold_positions("the solver of the System takes its directions from here")
        p.hold_velocities("what is along the constraints: rounding")
        p.each("x", "xu", "where the drift ends")
        p.hold_positions("the solver of the System takes its directions from here")
        return "v_next-2*v"

    def land(self, u: str, h: str) -> None:
        """Fly freely for h with velocities u, and go from there back onto all constraints."""
        p = self.program
        u = u if u.isidentifier() else f"({u})"
        p.each("x", f"x+{h}*{u}", "move freely (drift)")
        p.each("xu", "x", "where that leads")
        for part in self.parts:
            if not (part.meets_system or part.lands_last):
                part.land(p, h)
        together = [part for part in self.parts if part.meets_system]
        if together:
            together[0].land(p, h)
        else:
            p.hold_positions("back onto the constraints of the System")
        # Until then GPUs keep x as a difference, and forces do not see it.
        for part in self.parts:
            if part.lands_last:
                part.land(p, h)
        if self.sited and any(part.lands_last for part in self.parts):
            p.hold_positions("GPUs place virtual sites")

    def project(self) -> None:
        """Make v tangent to all constraints at x."""
        self.program.hold_velocities("tangent to the constraints of the System")
        for part in self.parts:
            part.project(self.program)

    @property
    def ends_tangent(self) -> bool:
        """Whether the last kick leaves v tangent, so that no projection is needed."""
        return self.ensemble.stays_tangent and self.kicks[-1] != 0 and (not self.parts or self.one_drift)

    # -- the kinetic energy that is reported ----------------------------------------------------

    def note_middle(self, velocities: str) -> None:
        """The velocities between the last drift of a step and the kick that ends it."""
        if self.ensemble.noisy:
            self.program.each("v_middle", velocities, "its kinetic energy is reported")

    def note_end(self) -> None:
        """The step that has this `v_middle` ends."""
        if self.ensemble.noisy:
            self.program.each("v_end", "v", "to see whether others change v")
