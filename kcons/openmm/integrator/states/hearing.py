"""Changes of a Context, passed on to its integrator: OpenMM does not notify integrators written in Python.

On import, some methods of OpenMM's classes are wrapped. They look whether the Context belongs to an integrator of
kcons, alone or within a CompoundIntegrator; for all others they do what they did, and nothing else.

* `Context.setState`, `loadCheckpoint`: what the integrator was made with is written over what comes along. A State of
  another integrator gives positions, velocities, box, time and parameters. A checkpoint is binary, and its bytes go to
  whatever program reads them: `createCheckpoint` adds which program wrote it, and others are refused.
* `Context.setPositions` and whatever else moves x or v: the next step looks where they are.
* `Context.reinitialize`: the System is looked up anew.
* `Context.getState`: groups that carry rows are no part of energy and forces, unless asked for.
* `LocalEnergyMinimizer.minimize`: knows no parts, so that `minimizeEnergy` of the integrator takes its place.
* `updateParametersInContext` of all Forces: forces that were kept are old.
* `Simulation.step`, `runForClockTime`: nobody sees the end of a call of `step` within them (see `calls`), and what an
  integrator has put off there is made before the Context answers. Integrators of OpenMM are refused where the System
  carries rows that are held.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import weakref
from collections.abc import Callable
from typing import Any

import openmm
from openmm import app

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.states.calls import settle
from kcons.openmm.integrator.system_checks import refuse_forgotten_parts

logger = logging.getLogger("kcons.openmm")

_LIVE: weakref.WeakValueDictionary[int, Integrator] = weakref.WeakValueDictionary()
#: Ends a checkpoint, before the length of what was added.
_MARK = b"kcons checkpoint"
#: What OpenMM says where integrator parameters are those of another kind; by then it has read all the rest.
_FOREIGN = ("IntegratorParameters", "global variable name", "per-DOF variable name", "CompoundIntegrator", "in node '")


def listen(integrator: Integrator) -> None:
    """Notify this integrator of changes of its Context."""
    _LIVE[int(integrator.this)] = integrator


def live(integrator: openmm.Integrator) -> Integrator | None:
    """The integrator of kcons that OpenMM hands out as a plain one; None for others."""
    return _LIVE.get(int(integrator.this))


def listeners(context: openmm.Context) -> list[Integrator]:
    """The integrators of kcons that a Context has."""
    integrator = getattr(context, "_integrator", None)
    if integrator is None or not _LIVE:
        return []
    heard = [integrator]
    if isinstance(integrator, openmm.CompoundIntegrator):
        heard = [integrator.getIntegrator(k) for k in range(integrator.getNumIntegrators())]
    return [found for one in heard if (found := live(one)) is not None]


# -- states and checkpoints -------------------------------------------------------------------------


def _set_state(original: Callable[..., None], context: openmm.Context, state: openmm.State) -> None:
    heard = listeners(context)
    if not heard:
        original(context, state)
        return
    if not state.getDataTypes() & openmm.State.IntegratorParameters:
        _moving(original, context, state)
        return
    foreign = True
    try:
        _forget(heard)
        original(context, state)
        foreign = False
    except openmm.OpenMMException as error:
        if not any(words in str(error) for words in _FOREIGN):
            raise
        logger.info("the State is that of another integrator: positions, velocities, box, time and parameters taken")
    finally:
        if foreign:
            _forget(heard)
        _loaded(heard, context)


def _forget(heard: list[Integrator]) -> None:
    for one in heard:
        one._hear_forget()


def _loaded(heard: list[Integrator], context: openmm.Context) -> None:
    _use_first(context)
    for one in heard:
        one._hear_loaded(context)


def _use_first(context: openmm.Context) -> None:
    """A RattleIntegrator answers by its first integrator, whatever a State says."""
    integrator = context._integrator
    if getattr(integrator, "closed", False):
        openmm.CompoundIntegrator.setCurrentIntegrator(integrator, 0)


def _create_checkpoint(original: Callable[..., bytes], context: openmm.Context) -> bytes:
    made = original(context)
    heard = listeners(context)
    if not heard:
        return made
    added = json.dumps(_origin(heard)).encode()
    return bytes(made) + added + len(added).to_bytes(8, "big") + _MARK


def _origin(heard: list[Integrator]) -> dict[str, Any]:
    """Which programs a Context has, and their seeds."""
    programs = repr([one.program.operations for one in heard])
    return {
        "program": hashlib.sha256(programs.encode()).hexdigest(),
        "seeds": [one.getRandomNumberSeed() for one in heard],
    }


def _load_checkpoint(original: Callable[..., None], context: openmm.Context, checkpoint: bytes) -> None:
    heard = listeners(context)
    if not heard:
        original(context, checkpoint)
        return
    origin, checkpoint = _written_by(checkpoint)
    here = _origin(heard)
    if origin.get("program") != here["program"] or len(origin.get("seeds", ())) != len(here["seeds"]):
        raise InputError(
            f"the checkpoint was written by another integrator than {heard[0]!r}, and OpenMM would read its numbers "
            "as those of this one; nothing was changed. Load a State: Simulation.saveState and loadState",
            item="checkpoint",
        )
    try:
        original(context, checkpoint)
        if any(seed and seed != was for seed, was in zip(here["seeds"], origin["seeds"], strict=True)):
            _draw_anew(context)
    finally:
        _loaded(heard, context)


def _written_by(checkpoint: bytes) -> tuple[dict[str, Any], bytes]:
    """What `_origin` has said of who wrote a checkpoint, nothing where that is damaged; and the bytes of OpenMM."""
    end = len(checkpoint) - len(_MARK) - 8
    if end < 0 or checkpoint[end + 8 :] != _MARK:
        return {}, checkpoint
    begin = end - int.from_bytes(checkpoint[end : end + 8], "big")
    try:
        origin = json.loads(checkpoint[max(begin, 0) : end])
    except ValueError:
        return {}, checkpoint
    return (origin if isinstance(origin, dict) else {}), checkpoint[:begin]


def _draw_anew(context: openmm.Context) -> None:
    """Begin the random numbers that the seed of the integrator gives, at the state that the Context is in."""
    kept = _plain_get_state(context, positions=True, velocities=True, parameters=True, integratorParameters=True)
    _plain_reinitialize(context, False)
    _plain_set_state(context, kept)


# -- what moves, and what changes -------------------------------------------------------------------


def _moving(original: Callable[..., Any], context: openmm.Context, *args: Any, **kwargs: Any) -> Any:
    try:
        return original(context, *args, **kwargs)
    finally:
        for one in listeners(context):
            one._hear_moved()


def _reinitialize(original: Callable[..., None], context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    try:
        original(context, *args, **kwargs)
    finally:
        for one in listeners(context):
            one._hear_reinitialized()


def _get_state(original: Callable[..., openmm.State], context: openmm.Context, *args: Any, **kwargs: Any) -> Any:
    computes = args or not _COMPUTES.isdisjoint(kwargs)
    if computes and len(args) <= _GROUPS and kwargs.get("groups", -1) in (-1, 0xFFFFFFFF):
        rows = {group for one in listeners(context) for group in one.row_groups}
        if rows:
            kwargs["groups"] = set(range(32)) - rows
    return original(context, *args, **kwargs)


#: What needs forces or energies, and the place of `groups` among the arguments of getState.
_COMPUTES = frozenset(["forces", "energy", "parameterDerivatives", "getForces", "getEnergy", "getParameterDerivatives"])
_GROUPS = 8


def _minimize(
    original: Callable[..., None],
    context: openmm.Context,
    tolerance: Any = 10,
    maxIterations: int = 0,
    reporter: Any = None,
) -> None:
    holding = next((one for one in listeners(context) if one.parts), None)
    if holding is None:
        _moving(original, context, tolerance, maxIterations, reporter)
        return
    if reporter is not None:
        raise UnsupportedError(
            "OpenMM's minimiser, which reports, does not know the parts that are held; minimise without a reporter"
        )
    holding.minimizeEnergy(context, tolerance, maxIterations)


def _update_parameters(original: Callable[..., None], force: openmm.Force, context: openmm.Context) -> None:
    try:
        original(force, context)
    finally:
        for one in listeners(context):
            one.refresh()


# -- Simulations ------------------------------------------------------------------------------------


def _in_simulation(original: Callable[..., None], simulation: app.Simulation, *args: Any, **kwargs: Any) -> None:
    context = simulation.context
    heard = listeners(context)
    if not heard:
        refuse_forgotten_parts(context.getSystem(), ())
    for one in heard:
        one.unseen = True
    try:
        original(simulation, *args, **kwargs)
    finally:
        for one in heard:
            one.unseen = False
        settle(context)


# -- wrapping ---------------------------------------------------------------------------------------


def wrapped(original: Callable[..., Any], call: Callable[..., Any]) -> Callable[..., Any]:
    """What calls `call` with the original method and its arguments."""

    @functools.wraps(original)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        return call(original, *args, **kwargs)

    return wrapper


def _settled(original: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def wrapper(context: openmm.Context, *args: Any, **kwargs: Any) -> Any:
        settle(context)
        return original(context, *args, **kwargs)

    return wrapper


_MOVING = (
    "setPositions",
    "setVelocities",
    "setVelocitiesToTemperature",
    "setPeriodicBoxVectors",
    "setTime",
    "applyConstraints",
    "applyVelocityConstraints",
)
_plain_get_state = openmm.Context.getState
_plain_set_state = openmm.Context.setState
_plain_reinitialize = openmm.Context.reinitialize


def _wrap_all() -> None:
    calls: dict[str, Callable[..., Any]] = {
        "setState": _set_state,
        "createCheckpoint": _create_checkpoint,
        "loadCheckpoint": _load_checkpoint,
        "reinitialize": _reinitialize,
        "getState": _get_state,
        **dict.fromkeys(_MOVING, _moving),
    }
    for name, call in calls.items():
        setattr(openmm.Context, name, wrapped(getattr(openmm.Context, name), call))
    for name in (*calls, "getStepCount", "getTime", "setStepCount", "setParameter", "computeVirtualSites"):
        setattr(openmm.Context, name, _settled(getattr(openmm.Context, name)))
    for name in ("step", "runForClockTime"):
        setattr(app.Simulation, name, wrapped(getattr(app.Simulation, name), _in_simulation))
    minimizer = openmm.LocalEnergyMinimizer
    minimizer.minimize = staticmethod(wrapped(minimizer.minimize, _minimize))
    for kind in vars(openmm).values():
        if isinstance(kind, type) and issubclass(kind, openmm.Force) and "updateParametersInContext" in vars(kind):
            name = "updateParametersInContext"
            setattr(kind, name, wrapped(getattr(kind, name), _update_parameters))


_wrap_all()
