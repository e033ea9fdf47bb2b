"""How velocities change between the drifts: what a statistical ensemble adds to an integrator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, Self

import openmm

from kcons.errors import UnsupportedError
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import operations_of
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting


class Ensemble(Protocol):
    """The kicks of an integrator, and what happens in the middle of its step.

    A value: it never changes, and may be given to any number of integrators. What changes belongs to the integrator.

    Attributes
    ----------
    stays_tangent : bool
        Whether kicks leave v tangent to all constraints at x: a step that ends with a kick ends without a projection
        of its own then.
    adds_up : bool
        Whether two kicks at the same place, which are one of the sum of their times, are made as one. How steps are
        divided into calls then changes the rounding of the motion.
    owes : bool
        Whether the end of a step may be left to the next step if the state is not read between; see `open`.
    measures : bool
        Whether `middle` needs v tangent to the constraints, since it measures K.
    noisy : bool
        Whether it has noise, of size `spread` in the program: the kinetic energy that is reported is then that of
        `v_middle`, since velocities have the temperature of the bath in the middle of a step only.
    """

    stays_tangent: bool
    adds_up: bool
    owes: bool
    measures: bool
    noisy: bool

    def check(self, scheme: Splitting | None) -> None:
        """Raise `UnsupportedError` for schemes that lose their order, or cannot be used, with these kicks."""
        ...

    def check_timestep(self, dt: float) -> None:
        """Raise `InputError` for a time step (ps) that the ensemble cannot follow."""
        ...

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        """What a step consists of. Where there is an `Exchange`, `middle` writes it."""
        ...

    def declare(self, program: Program) -> None:
        """Variables and tables."""
        ...

    def open(self, program: Program) -> None:
        """What comes before the first kick of a step, v tangent to all constraints; also what the last step owes.

        Where constraints are applied alone (`first_stage` is not 0) it must do nothing.
        """
        ...

    def close(self, program: Program) -> None:
        """What comes at the end of a step, v tangent to all constraints; `behind` says that the next step is to do it.

        Only with `owes`, and where the program has `between`.
        """
        ...

    def take_back(self, program: Program) -> None:
        """A step failed: variables of the ensemble are again what they were before `open`."""
        ...

    def kick(
        self,
        program: Program,
        h: str,
        force: str,
        impulse: str,
        project: Callable[[], None],
        tangent: bool,
        unseen: bool = False,
    ) -> str:
        """Let the applied forces act for a time.

        For h = 0 nothing but the impulse may be added: so the constraints are applied alone.

        Parameters
        ----------
        program : Program
        h : str
            Expression of the time.
        force : str
            Name of the applied forces.
        impulse : str
            Expression that is to be added to v before (that of the drift that came before), or ''.
        project : callable
            Writes the computations that make v tangent to all constraints at x.
        tangent : bool
            Whether v is tangent before, without the impulse.
        unseen : bool
            Whether another kick follows before v is read.

        Returns
        -------
        str
            Expression of the velocities afterwards, which are not yet in v.
        """
        ...

    def middle(self, program: Program, u: str, project: Callable[[], None]) -> None:
        """Between two halves of the drift: from velocities u, an expression, to v, made tangent by `project`."""
        ...

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """At the first step of a run, x and v on the constraints.

        Raises
        ------
        KconsError
            The ensemble does not exist for this System or this start.
        """
        ...

    def go_on(self, integrator: Integrator, context: openmm.Context) -> None:
        """Others may have moved x or v in the middle of a run; raise `InputError` if it cannot go on from there."""
        ...

    def verify(self, integrator: Integrator) -> None:
        """Raise `ConvergenceError` if something went wrong since the last check."""
        ...

    def warmth(self, integrator: Integrator) -> float:
        """What 2 K/(g k) is to be multiplied with for the temperature, g being `degrees_of_freedom`."""
        ...

    def settings(self) -> dict[str, float]:
        """The global variables of the program that are settings of the ensemble, by name."""
        ...

    def at(self, temperature: float) -> Ensemble:
        """The same at another temperature (K)."""
        ...

    def follow(self, integrator: Integrator) -> None:
        """The integrator takes this ensemble, perhaps in the middle of a run; raise `KconsError` if it cannot."""
        ...


class Value:
    """An object whose attributes never change; two are equal if their attributes are."""

    owes = False
    measures = False
    noisy = False

    def check_timestep(self, dt: float) -> None:
        pass

    def open(self, program: Program) -> None:
        pass

    def close(self, program: Program) -> None:
        pass

    def take_back(self, program: Program) -> None:
        pass

    def go_on(self, integrator: Integrator, context: openmm.Context) -> None:
        pass

    @classmethod
    def of(cls, values: dict[str, Any]) -> Self:
        """The object that has these attributes, of which lists may stand for tuples; checked as any other."""
        return cls(**values)

    def _keep(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)

    def __setattr__(self, name: str, value: object) -> None:
        raise UnsupportedError(
            f"{self!r} is a value and does not change: call setTemperature or setFriction of the integrator, or make "
            f"another {type(self).__name__}"
        )

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and other.__dict__ == self.__dict__

    def __hash__(self) -> int:
        return hash((type(self), *self.__dict__.items()))


class ConstantEnergy(Value):
    """Newton's equations: v += h f/m."""

    stays_tangent = False
    adds_up = False

    def check(self, scheme: Splitting | None) -> None:
        pass

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        return operations_of(scheme)

    def declare(self, program: Program) -> None:
        pass

    def kick(
        self,
        program: Program,
        h: str,
        force: str,
        impulse: str,
        project: Callable[[], None],
        tangent: bool,
        unseen: bool = False,
    ) -> str:
        return "+".join(filter(None, ["v", impulse, f"{h}*{force}/m"]))

    def middle(self, program: Program, u: str, project: Callable[[], None]) -> None:
        raise NotImplementedError

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        pass

    def verify(self, integrator: Integrator) -> None:
        pass

    def warmth(self, integrator: Integrator) -> float:
        return 1.0

    def settings(self) -> dict[str, float]:
        return {}

    def at(self, temperature: float) -> Ensemble:
        raise UnsupportedError("at constant energy there is no temperature to set; give an ensemble")

    def follow(self, integrator: Integrator) -> None:
        pass
