"""Settings of an integrator: those it was made with, later changes, and changes of its Context."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterable
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.errors import InputError, MissingSettingError, UnsupportedError
from kcons.openmm.ensembles.barostat_temperature import warn_of_barostat
from kcons.openmm.ensembles.isokinetic_ensemble import kelvins
from kcons.openmm.ensembles.langevin_ensemble import Langevin
from kcons.openmm.integrator.ensemble import ConstantEnergy, Ensemble
from kcons.openmm.integrator.guard import Guard, find_context
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.precision import DOUBLE, Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import number, relative_tolerance
from kcons.steppers.splitting import Splitting

#: Forces that differ by less, relative to the largest, are the same: platforms may add them in another order.
_SAME = 1e-6
#: A time step in ps without a unit that is longer may be one in fs.
_LONG = 0.02


_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


class _OfEnsembles(Generic[_Given, _Found]):
    """A method that an integrator has where its ensemble has what it is about, as integrators of OpenMM do.

    So programs can ask by `hasattr` whether there is a thermostat.
    """

    def __init__(self, method: Callable[Concatenate[Any, _Given], _Found]) -> None:
        self.method = method
        functools.update_wrapper(cast(Any, self), method)

    def __get__(self, integrator: Settings | None, owner: type | None = None) -> Callable[_Given, _Found]:
        if integrator is None:
            return self.method  # type: ignore[return-value]
        what = self.method.__name__[3:].lower()
        if self.method.__name__ != "setTemperature" or not integrator.thermostatted:
            integrator._given(what)
        return MethodType(self.method, integrator)


class Settings(Integrator):
    """Settings belong to the integrator: they are kept here and in its program, and written into the Context.

    Attributes
    ----------
    program : Program
    scheme : Splitting or None
        None for the leapfrog.
    """

    program: Program
    scheme: Splitting | None
    #: Of the System's constraints; None where the platform decides.
    asked_tolerance: float | None = None
    #: Whether variables were written by their numbers.
    _written = False
    _ensemble: Ensemble
    _guard: Guard | None

    def refresh(self) -> None:
        """Compute the forces anew at the next step."""
        raise NotImplementedError

    @property
    def ensemble(self) -> Ensemble:
        """How velocities change between drifts, as it is now; see `setTemperature`, `setFriction`."""
        return self._ensemble

    @property
    def thermostatted(self) -> bool:
        """Whether velocities change by more than forces and constraints."""
        return type(self.ensemble) is not ConstantEnergy

    # -- temperature and friction ---------------------------------------------------------------

    @_OfEnsembles
    def setTemperature(self, temperature: unit.Quantity | float) -> None:
        """Change the temperature (K if a float) of the ensemble.

        Raises
        ------
        InputError
            It is below zero; with `Isokinetic`, zero.
        MissingSettingError
            At constant energy.
        """
        self._take(self.ensemble.at(kelvins(temperature)))
        guard = self._guard
        if guard is not None and guard.alive is not None and guard.started:
            warn_of_barostat(guard.context, self._given("temperature"), stacklevel=3)

    @_OfEnsembles
    def getTemperature(self) -> unit.Quantity:
        """The temperature of the ensemble.

        Raises
        ------
        MissingSettingError
            It has none; so `hasattr` is False.
        """
        return self._given("temperature") * unit.kelvin

    @_OfEnsembles
    def setFriction(self, friction: unit.Quantity | float) -> None:
        """Change the friction (1/ps if a float) of the ensemble.

        Raises
        ------
        InputError
            It is below zero.
        MissingSettingError
            The ensemble has none.
        """
        assert isinstance(self.ensemble, Langevin)
        self._take(self.ensemble.with_friction(friction))

    @_OfEnsembles
    def getFriction(self) -> unit.Quantity:
        """The friction of the ensemble.

        Raises
        ------
        MissingSettingError
            It has none; so `hasattr` is False.
        """
        return self._given("friction") / unit.picosecond

    def _given(self, what: str) -> float:
        value = getattr(self.ensemble, what, None)
        if not isinstance(value, float):
            name = "constant energy" if not self.thermostatted else repr(self.ensemble)
            raise MissingSettingError(f"there is no {what} at {name}; give ensemble=Langevin(temperature, friction)")
        return value

    def _take(self, ensemble: Ensemble) -> None:
        ensemble.follow(self)  # first, as it may refuse
        self._ensemble = ensemble
        for name, value in ensemble.settings().items():
            self.program.set(name, value)

    # -- steps, tolerance, variables, force groups ------------------------------------------------------------

    @property
    def _dt(self) -> float:
        return float(self.getStepSize().value_in_unit(unit.picosecond))

    def setStepSize(self, size: unit.Quantity | float) -> None:
        """Change the time step.

        Raises
        ------
        InputError
            It is no positive number, or more than the ensemble can follow.

        Warns
        -----
        UserWarning
            It is above 20 fs and has no unit.
        """
        dt = picoseconds(size)
        self.ensemble.check_timestep(dt)
        super().setStepSize(dt)

    def setConstraintTolerance(self, tol: float) -> None:
        """Change the relative tolerance of the System's constraints.

        One that was left open stays so where it is set to what an integrator without a Context, or this one, has.

        Raises
        ------
        InputError
            It is not between 0 and 1.
        """
        wanted = relative_tolerance(tol)
        if self.asked_tolerance is None and wanted in (DOUBLE.tolerance, self.getConstraintTolerance()):
            return
        self.asked_tolerance = wanted
        super().setConstraintTolerance(wanted)

    def take_precision(self, precision: Precision) -> None:
        """The Context is known: tolerances that were left open become those of its platform."""
        if self.asked_tolerance is None:
            openmm.CustomIntegrator.setConstraintTolerance(self, precision.tolerance)
        for part in self.parts:
            part.take_precision(self.program, precision)

    def setGlobalVariableByName(self, name: str, value: float) -> None:
        """Set a variable of the program.

        Raises
        ------
        UnsupportedError
            It is a setting, which has a method of its own.
        """
        if name in self.program.settings:
            raise UnsupportedError(
                f"{name} is a setting of the integrator: use setTemperature, setFriction, or set_target of a part"
            )
        super().setGlobalVariableByName(name, value)

    def setGlobalVariable(self, index: int, value: float) -> None:
        """Write a variable of the program by its number, as programs do that copy all of them; a run begins anew.

        A setting that has another value than the integrator's by the next step is put right and refused there; the
        methods that change settings write their variables.
        """
        self.program.write(self.getGlobalVariableName(index), value)
        self._written = True

    def _take_written(self) -> None:
        """What `setGlobalVariable` has written is taken, but for settings and what controls the program."""
        self._written = False
        differing = self.program.differing()
        self.program.push()
        self.refresh()
        if self._guard is not None:
            self._guard.begin_anew()
        if differing:
            raise UnsupportedError(
                f"setGlobalVariable wrote {', '.join(differing)}, which is a setting of the integrator and has its "
                "value again: use setTemperature, setFriction, or set_target of a part"
            )

    def setIntegrationForceGroups(self, groups: int | Iterable[int]) -> None:
        """Choose the force groups that act; groups that carry rows never do.

        Parameters
        ----------
        groups : int or iterable of int
            A bit mask or group numbers. -1 and all 32 groups mean: all but the groups of rows.

        Raises
        ------
        InputError
            Groups that carry rows are among those given; what is no number of a group.
        UnsupportedError
            The Context exists; it has read the groups and would ignore the change.
        """
        if getattr(self, "_guard", None) is not None or (getattr(self, "program", None) and find_context(self)):
            raise UnsupportedError("the Context has read the force groups already; set them before it is created")
        if isinstance(groups, int | np.integer):
            wanted = {g for g in range(32) if (int(groups) >> g) & 1}
        elif isinstance(groups, Iterable) and not isinstance(groups, str):
            wanted = {whole_number(group, "force group", 0, 31) for group in groups}
        else:
            raise InputError(f"groups is {groups!r}; give numbers of force groups, such as {{0, 1}}", item="groups")
        rows = self.row_groups
        if len(wanted) == 32:
            wanted -= rows
        if wanted & rows:
            raise InputError(
                f"force groups {sorted(wanted & rows)} carry constraint rows, their forces are gradients and must not "
                "act; leave them out",
                item="groups",
            )
        super().setIntegrationForceGroups(wanted)

    # -- what the Context is told, see kcons.openmm.integrator.states.hearing -------------------------------------

    def _hear_moved(self) -> None:
        """Something has moved x or v."""
        if self._guard is not None:
            self._guard.disturbed = True

    def _hear_forget(self) -> None:
        """A State is about to be loaded: what it does not bring is that of a new integrator."""
        self.program.forget()
        if self.scheme is None:
            self.setPerDofVariableByName("impulse", [openmm.Vec3(0, 0, 0)] * self._n_particles())

    def _hear_loaded(self, context: openmm.Context) -> None:
        """Variables were read from a State or checkpoint: what this integrator was made with wins.

        The run goes on as if nothing had happened where the State is that of this run. Forces that were kept are
        those of another System otherwise, or of other settings.
        """
        other = bool(self.program.differing())
        self.program.push()
        if other or not self._forces_kept(context):
            self.refresh()
        if self._guard is not None:
            self._guard.begin_anew()

    def _hear_reinitialized(self) -> None:
        """The Context has read the System again."""
        self._guard = None
        self.program.push()
        self.refresh()

    def _forces_kept(self, context: openmm.Context) -> bool:
        """Whether forces that the program has kept are those at x."""
        if "force" not in self.program.vectors or self.getGlobalVariableByName("stale"):
            return True
        kept = np.array(self.getPerDofVariableByName("force"))
        state = context.getState(forces=True, groups=self.getIntegrationForceGroups())
        now = np.asarray(state.getForces(asNumpy=True)._value)
        return bool(np.abs(kept - now).max(initial=0.0) <= _SAME * np.abs(now).max(initial=0.0))

    def _n_particles(self) -> int:
        return len(self.getPerDofVariableByName("xu"))


def picoseconds(timestep: Any) -> float:
    """A time step; a long one without a unit, which may be meant in fs, draws a warning where the caller was called."""
    dt = number(timestep, unit.picosecond, "timestep")
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(
            f"the time step is {timestep}; give a positive one; to go back in time, reverse the velocities",
            item="timestep",
        )
    if dt > _LONG and not unit.is_quantity(timestep):
        warnings.warn(
            f"the time step is {dt:g} ps, that is {dt * 1e3:g} fs: is it meant in fs? Give it with its unit, "
            f"{dt:g} * unit.femtoseconds or {dt:g} * unit.picoseconds",
            stacklevel=3,
        )
    return dt
