"""What an ensemble is to an integrator: its kicks, and what it puts between two halves of the drift."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self

import openmm

from kcons.errors import UnsupportedError
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import operations_of
from kcons.steppers.operations import Evaluate, Exchange, Kick, Operation, Project, drifts_of
from kcons.steppers.splitting import Splitting

if TYPE_CHECKING:
    from kcons.openmm.integrator.steps import Step


class Integrator(openmm.CustomIntegrator):
    """What ensembles and checks may ask of an integrator; `ProjectedIntegrator` answers, and says what each is."""

    scheme: Splitting | None
    parts: tuple[Any, ...]
    program: Program
    row_groups: frozenset[int]
    spare: bool
    check_every: int
    _guard: Any
    _watch: Callable[..., Any]
    take_precision: Callable[..., None]
    refresh: Callable[[], None]
    applyConstraints: Callable[..., None]
    applyVelocityConstraints: Callable[..., None]
    independent_momenta: Callable[..., int]
    degrees_of_freedom: Callable[..., int]
    kinetic_energy: Callable[..., Any]

    @property
    def ensemble(self) -> Ensemble:
        raise NotImplementedError

    @property
    def context(self) -> openmm.Context:
        raise NotImplementedError


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

    def check(self, scheme: Splitting | None) -> None:
        """Raise `UnsupportedError` for schemes that lose their order, or cannot be used, with these kicks."""

    def check_timestep(self, dt: float) -> None:
        """Raise `InputError` for a time step (ps) that the ensemble cannot follow."""

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        """What a step consists of. Where there is an `Exchange`, `middle` writes it."""
        return operations_of(scheme)

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

    def check(self, scheme: Splitting | None) -> None:
        """Raise `UnsupportedError` for all schemes but 'rattle'."""
        if scheme is None:
            refuse_leapfrog(self)
        elif scheme.kicks != (0.5, 0.5) or scheme.drifts != (1.0,) or scheme.flight != (1.0,):
            raise UnsupportedError(
                f"{type(self).__name__} splits the drift of scheme='rattle' in two; {scheme!r} has another form"
            )

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        first, second = drifts_of((0.5, 0.5))
        return (Kick(0.5), first, Exchange(1.0), second, Evaluate(), Kick(0.5), Project())


def refuse_leapfrog(ensemble: Ensemble) -> None:
    raise UnsupportedError(
        f"{type(ensemble).__name__} needs velocities at the time of the positions, and those of the leapfrog are half "
        "a step behind; use scheme='rattle'"
    )
