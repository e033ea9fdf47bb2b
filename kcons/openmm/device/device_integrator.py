"""The integrator whose steps a plugin of OpenMM makes on the device."""

from __future__ import annotations

import copy
import ctypes
import json
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
import openmm

from kcons.constraints import Constraint
from kcons.constraints.arguments import whole_number
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, UnsupportedError
from kcons.openmm.device import build
from kcons.openmm.device.kernels import PLAIN, Op, plan, room_for
from kcons.openmm.device.rows import KernelRows, constraints_of, function_on_device
from kcons.openmm.ensembles import Isokinetic, IsokineticSpheres, Langevin, LangevinRespa, NoseHoover, NoseHooverMiddle
from kcons.openmm.integrator.guard import Guard
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.program import ConstantEnergy, Ensemble, Program, to_scheme, write_step
from kcons.openmm.integrator.projected import ProjectedIntegrator
from kcons.openmm.quantities import box_of, nanometers, positions_of
from kcons.openmm.surface_integrator import SurfaceIntegrator
from kcons.steppers.operations import Chain, Exchange, Fly, Operation, Project
from kcons.steppers.splitting import Splitting
from kcons.thermostats.nose_hoover import FRACTIONS

#: Ensembles whose operations kernels have.
ENSEMBLES = (ConstantEnergy, Langevin, Isokinetic, NoseHoover, NoseHooverMiddle, LangevinRespa, IsokineticSpheres)
_EMPTY = '<Integrator type="KconsProgram" version="1" stepSize="0.001" constraintTolerance="1e-10" description=""/>'
_DOUBLES, _WHOLES = ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_int)
#: Integrators by their address; and why the last plan could not be made.
_ALIVE: weakref.WeakValueDictionary[int, DeviceIntegrator] = weakref.WeakValueDictionary()
_REFUSALS: list[Exception] = []
#: Places in what the kernel `look` tells: sum of v^2; whether a row failed, in which step, its number, its residual.
_MOTION, _FAILED, _STEP, _ROW, _RESIDUAL = 0, 2, 3, 4, 5


class _Shared(ctypes.Structure):
    """What both sides read and write of an integrator, as plugin/steps.h has it."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("whole", "every", "since", "moved", "bound", "planned")),
        ("origin", ctypes.c_double),
        ("told", ctypes.c_double * 7),
    )


# -- what becomes of operations ---------------------------------------------------------------------


def refusal(scheme: Any, parts: Sequence[Any], ensemble: Ensemble) -> str:
    """Why steps of this kind are not made on the device; empty if they are."""
    if type(ensemble) not in ENSEMBLES:
        return f"{type(ensemble).__name__} has no kernels"
    if parts and isinstance(ensemble, LangevinRespa):
        return f"{type(ensemble).__name__} holds no parts"
    try:
        for item in constraints_of(parts):
            function_on_device(item)
    except UnsupportedError as error:
        return str(error)
    exact = any(isinstance(operation, Fly) and operation.exact for operation in ensemble.operations(scheme))
    return "flights along great circles have no kernel" if exact else ""


def plain_operations(operations: Sequence[Operation], ensemble: Ensemble) -> list[Op]:
    """Operations as plain data, with the time of each; what acts in the middle of a drift is written out."""
    done: list[Op] = []
    ends: tuple[float, ...] = (0.0,)
    if isinstance(ensemble, NoseHooverMiddle):
        middle = (Project(), Chain(0.5), Chain(0.5))
        operations = [o for given in operations for o in (middle if isinstance(given, Exchange) else (given,))]
    for operation in operations:
        flights, ends = getattr(operation, "flights", ()), getattr(operation, "ends", ends[-1:])
        if isinstance(operation, Chain):
            flights = tuple(operation.fraction * f for f in FRACTIONS)
        done.append(Op(operation.verb, operation.fraction, operation.group, flights, ends))
        if isinstance(ensemble, IsokineticSpheres) and isinstance(operation, Project):
            done.append(Op("rescale"))
    return [Op("restore"), *done] if isinstance(ensemble, IsokineticSpheres) else done


class DeviceProgram(Program):
    """Variables of a step on the device: what the CustomIntegrator would have, in arrays of the plugin."""

    on_device = True
    integrator: DeviceIntegrator
    #: Variables that belong to a state, in the order of the array `memory`.
    kept: list[str]

    def hand_over(self) -> None:
        """Describe the step to the plugin."""
        self.kept = sorted({*self.memory, *({"lost"} & set(self.numbers))}, key=lambda name: (len(name), name))
        self.lines, self.lazy = [], False
        self.push()

    def write(self, name: str, value: float) -> None:
        """Change a variable that is no setting; settings go over to the plugin and into its text."""
        self.push()
        bound, now = self.integrator.shared.bound, self.integrator.getGlobalVariableByName(self.known(name))
        if name in self.kept and bound and value != now:
            values = self.integrator.read("memory")
            values[self.kept.index(name)] = value
            self.recall({"memory": values})

    def known(self, name: str) -> str:
        """The name of a variable, if it is one."""
        if name not in self.numbers:
            raise UnsupportedError(f"no variable of these steps is called {name!r}; see listing()")
        return name

    def push(self) -> None:
        """Settings, where they are others than the plugin has."""
        integrator = self.integrator
        if integrator.describe() and integrator.shared.planned:
            integrator.write("parameters", np.array([*self.settings.values(), 0.0]))

    def remembered(self) -> dict[str, Any]:
        """What belongs to the present state besides x and v."""
        self.integrator.read("memory")  # makes the kernels if there are none yet
        return {name: self.integrator.read(name) for name in self.integrator.saved}

    def recall(self, values: Mapping[str, Any]) -> None:
        """Write what `remembered` gave back into the Context."""
        for name, found in values.items():
            if self.integrator.shared.bound:
                self.integrator.write(name, found)

    def listing(self) -> str:
        """The variables, and what is done between two evaluations of forces."""
        known = [f"  {name}: {self.words[name]}" for name in [*self.settings, *self.kept]]
        return "\n".join(["on the device: one kernel between two evaluations of forces or sums", "variables", *known])


class DeviceIntegrator(ProjectedIntegrator):
    """`ProjectedIntegrator` whose steps are kernels of a plugin: what ``ProjectedIntegrator(..., device=True)`` gives.

    Raises
    ------
    UnsupportedError
        There is no plugin, or it has no kernels for this step.
    """

    program: DeviceProgram
    #: Rows of the Context, once they are known, and the arrays that belong to a state.
    rows: Any = None
    saved: Sequence[str] = ()
    _seed = 0
    _described = ""
    _recorded: Sequence[int] = ()
    _box: Any = None

    def _make(self, dt: float) -> None:
        library = build.library()
        library.kcons_set_planner(_planner)
        library.kcons_shared.restype = ctypes.POINTER(_Shared)
        library.kcons_read.restype = library.kcons_given.restype = _DOUBLES
        self.this = openmm.XmlSerializer.deserialize(_EMPTY).this  # of which the proxy of this class is the owner
        openmm.Integrator.setStepSize(self, dt)
        self._address = ctypes.c_void_p(int(self.this))
        self.shared: _Shared = library.kcons_shared(self._address).contents
        _ALIVE[int(self.this)] = self

    def _held(self, parts: Any) -> tuple[Part, ...]:
        given = tuple(parts) if isinstance(parts, Iterable) else (parts,)
        if len(given) == 1 and isinstance(part := given[0], KernelRows):
            # Kernels are those of one Context: what serves another integrator is made again.
            return (part if part.program is None else copy.deepcopy(part),)
        return (KernelRows(given),) if given else ()

    def _write(self) -> Program:
        """A step without parts: kernels hold their rows."""
        if why := refusal(self.scheme, self.parts, self._ensemble):
            raise UnsupportedError(f"no steps on the device: {why}; take ProjectedIntegrator")
        for part in self.parts:
            assert isinstance(part, KernelRows)
            part.serve(self)
        program = DeviceProgram(self, self.scheme, (), self._ensemble)
        write_step(program)
        return program

    def describe(self) -> bool:
        """Tell the plugin what a step is; returns whether it knew another one."""
        program = self.program
        description = json.dumps(
            {
                "operations": plain_operations(self.program.operations, self.ensemble),
                "settings": program.settings,
                "memory": program.kept,
                "seed": self._seed,
                "noisy": self.ensemble.noisy,
                "spheres": [getattr(self.ensemble, name, None) for name in ("spheres", "auxiliary")],
                "parts": bool(self.parts),
                "recorded": self._recorded,
            }
        )
        if description == self._described:
            return False
        self._described = description
        held = [item.atoms for item in constraints_of(self.parts) if item.width > 1]
        pairs = [np.stack([atoms[:, :-1], atoms[:, 1:]], axis=2).ravel() for atoms in held]
        tied = np.concatenate([np.zeros(0), *pairs]).astype(np.int32)
        build.library().kcons_describe(self._address, description.encode(), tied.ctypes.data_as(_WHOLES), tied.size)
        return True

    def read(self, name: str) -> FloatArray:
        """An array of the device, by its name in `kcons.openmm.device.kernels`."""
        count = ctypes.c_int()
        found = build.library().kcons_read(self._address, name.encode(), ctypes.byref(count))
        if not found:
            raise _REFUSALS.pop() if _REFUSALS else openmm.OpenMMException(build.library().kcons_error().decode())
        return np.ctypeslib.as_array(found, (count.value,)).copy()

    def write(self, name: str, values: FloatArray) -> None:
        """Write an array of the device."""
        given = np.ascontiguousarray(values, dtype=np.float64)
        library = build.library()
        if library.kcons_write(self._address, name.encode(), given.ctypes.data_as(_DOUBLES), given.size) < 0:
            raise openmm.OpenMMException(library.kcons_error().decode())

    # -- running ---------------------------------------------------------------------------------

    def attach(self, context: openmm.Context) -> None:
        super().attach(context)
        guard = cast(Guard, self._guard)
        self.shared.whole = guard.moving or not guard.undisturbed

    def _run(self, guard: Guard, steps: int, ends: bool) -> None:
        if guard.in_run and self.shared.moved:
            guard.begin()
        first = guard.context.getStepCount()
        for part in self.parts:
            if part.left != guard.context.getTime()._value:  # type: ignore[attr-defined]
                part.reset_multipliers(self)  # type: ignore[attr-defined]
        context, rows = guard.context, self.rows
        try:
            # In blocks, before each of which targets are computed, and cells where others have moved positions.
            for done in range(0, steps, rows.block):
                block, time = min(steps - done, rows.block), context.getTime()._value
                now: tuple[Any, ...] = ()
                if rows.n_cells and (self.shared.moved or box_of(context) != self._box):
                    self._box = box_of(context)
                    now = positions_of(context), np.array(self._box)
                for name, values in rows.renew(time, self._dt, block, *now).items():
                    self.write(name, values)
                self.shared.origin = time if rows.n_movers else 0.0
                openmm.Integrator.step(self, block)
        except openmm.OpenMMException as error:
            told, words = list(self.shared.told), str(error) if "NaN" in str(error) else ""
            if told[_FAILED]:
                failure: ConvergenceError = rows.failure(int(told[_ROW]), told[_RESIDUAL], int(told[_STEP]))
                if np.isfinite(told[_RESIDUAL]):
                    guard.go_back(failure)
                    raise failure from error
                words, first = f"{rows.set.row_name(failure.row)} is not finite.", int(told[_STEP]) - 1
            guard.put_back()
            if words:
                raise guard.explosion(words, first) from error
            raise
        finally:
            for part in self.parts:
                part.left = guard.context.getTime()._value  # type: ignore[attr-defined]
        if ends:
            guard.look()

    # -- records ---------------------------------------------------------------------------------

    def record(self, atoms: IntArray) -> None:
        """Choose particles of which `records` tells; before the first step of a Context."""
        self._recorded = np.unique(atoms).tolist()
        self.program.push()

    def records(self, steps: int, every: int) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, float]]:
        """Make steps, and give what was recorded on the device after each `every` of them.

        It is read when the device has no more room for it: a thousand records, or 8 MB of them.

        Yields
        ------
        x, v, f : ndarray, shape (n, 3)
            Positions, velocities and applied forces of the particles of `record`, in ascending order; molecules are
            in one piece, in any cell.
        time : float
        """
        room, n = room_for(len(self._recorded)), len(self._recorded)
        for done in range(0, steps, room * every):
            context = self._watch().context
            time, since = context.getTime()._value, context.getStepCount()
            self.shared.every, self.shared.since = every, since
            try:
                self.step(min(steps - done, room * every))
            finally:
                self.shared.every = 0
            made = (context.getStepCount() - since) // every
            for k, found in enumerate(self.read("records").reshape(room, n, 3, 3)[:made], 1):
                x, v, f = found.swapaxes(0, 1)
                yield x, v, f, time + k * every * self._dt

    # -- variables, as the CustomIntegrator has them ------------------------------------------------

    def getGlobalVariableByName(self, name: str) -> float:
        """A variable of the step, see `listing`."""
        program = self.program
        if name == "motion":
            return float(self.shared.told[_MOTION])
        if name == "failed":  # a call that fails raises
            return 0.0
        if name in program.kept and self.shared.planned:  # before they are 0, whatever positions are
            return float(self.read("memory")[program.kept.index(name)])
        return {**program.numbers, **program.settings}[program.known(name)]

    # Programs that copy integrators (openmmtools) read all variables by number, and write them.

    def getNumGlobalVariables(self) -> int:
        return len(self.program.numbers)

    def getGlobalVariableName(self, index: int) -> str:
        return list(self.program.numbers)[index]

    def getGlobalVariable(self, index: int) -> float:
        return self.getGlobalVariableByName(self.getGlobalVariableName(index))

    def setGlobalVariable(self, index: int, value: float) -> None:
        """As for a CustomIntegrator, settings have their own value again in the next step."""
        self.program.write(self.getGlobalVariableName(index), float(value))

    def getNumPerDofVariables(self) -> int:
        """None, and there are no tables and computations either."""
        return 0

    getNumComputations = getNumTabulatedFunctions = getNumPerDofVariables

    def setRandomNumberSeed(self, seed: int) -> None:
        """The seed of noise, before the Context is made; 0 for one that nobody knows."""
        self._seed = whole_number(seed, "seed", -(2**31), 2**31 - 1)
        self.program.push()

    def getRandomNumberSeed(self) -> int:
        return self._seed


# -- plans for a Context ------------------------------------------------------------------------------


@ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 2, *[ctypes.c_char_p] * 2, ctypes.c_int)
def _planner(made: int, address: int, description: bytes, name: bytes, groups: int) -> int:
    """Hand a plan over to the plugin, for what it tells of a Context."""
    library, integrator, platform = build.library(), _ALIVE.get(address), name.decode()
    described, steps = json.loads(description), ctypes.c_void_p(made)
    try:

        def given(what: str, *shape: int) -> FloatArray:
            found = library.kcons_given(steps, what.encode(), ctypes.byref(count := ctypes.c_int()))
            return np.array(found[: count.value]).reshape(-1, *shape)

        if described["parts"] and integrator is None:
            raise UnsupportedError(
                "the parts of an integrator are those of its Python object: keep a reference to it, and in place of "
                "reading its text make it again, with parts="
            )
        part = integrator.parts[0] if integrator is not None and integrator.parts else KernelRows(())
        assert isinstance(part, KernelRows)
        masses, box = given("masses"), given("box", 3)
        at = given("positions", 3), box if box.any() else None, float(given("time")[0])
        rows = part.rows_at(masses, given("constraints", 3), *at)
        cells = rows.renew(0.0, 0.0, 0, *at[:2])  # a CompoundIntegrator makes steps without Python
        source, arrays, parts, sizes = plan(described, platform, masses, groups, rows)
        if integrator is not None:
            integrator.rows, integrator.saved = rows, [array.name for array in arrays if array.saved]
        compiled = str(build.kernels_library(source)) if platform in PLAIN else ""
        library.kcons_source(steps, source.encode(), compiled.encode(), *sizes)
        for array in arrays:
            values = np.ascontiguousarray(cells.get(array.name, array.values), dtype=np.float64)
            about = array.name.encode(), array.kind == "int", array.saved, array.passed
            library.kcons_array(steps, *about, values.ctypes.data_as(_DOUBLES), values.size)
        for number, actions in enumerate(parts):
            for kernel, mask, slot in actions:
                library.kcons_action(steps, number, kernel.encode(), ctypes.c_int32(mask), slot)
    except Exception as error:  # told by the exception that OpenMM raises, or by `read`
        _REFUSALS[:] = [error]
        library.kcons_set_error(f"{type(error).__name__}: {error}".encode())
        return 0
    return 1


class DeviceSurfaceIntegrator(SurfaceIntegrator, DeviceIntegrator):
    """`SurfaceIntegrator` whose steps are kernels of a plugin."""

    def _surface_parts(self, surfaces: Any, system: openmm.System | None, positions: Any) -> Sequence[Any]:
        if positions is None:
            return list(surfaces)
        x = nanometers(positions, len(positions))
        return ConstraintSet(surfaces, x, np.ones(len(x))).constraints


def choose(
    device: bool | None,
    timestep: Any,
    scheme: str | Splitting = "rattle",
    *,
    parts: Sequence[Any] = (),
    surfaces: Any = (),
    ensemble: Ensemble | None = None,
    classes: tuple[type[ProjectedIntegrator], type[DeviceIntegrator]] = (ProjectedIntegrator, DeviceIntegrator),
    **others: Any,
) -> tuple[type[ProjectedIntegrator], str]:
    """The class of an integrator, of two, and why it is the first, which `device` True refuses."""
    given, around = (tuple(some) if isinstance(some, Iterable) else (some,) for some in (parts, surfaces))
    kind = ConstantEnergy() if ensemble is None else ensemble
    why = refusal(to_scheme(scheme), [*around, *given], kind) or build.refusal()
    nowhere_else = isinstance(ensemble, IsokineticSpheres) or any(isinstance(part, Constraint) for part in given)
    wanted = device or nowhere_else or build.accelerated() or (build.is_built() and build.compiler())
    if not (why or wanted):
        why = "the plugin is not compiled, or the compiler is gone, and OpenMM sees no GPU here; see kcons doctor"
    if not why:
        try:
            build.library()
            return classes[1], ""
        except UnsupportedError as error:
            why = str(error)
    if device:
        raise UnsupportedError(f"no steps on the device: {why}; leave out device=True for a CustomIntegrator")
    return classes[0], why


ProjectedIntegrator._on_device = staticmethod(choose)
SurfaceIntegrator._on_device = staticmethod(partial(choose, classes=(SurfaceIntegrator, DeviceSurfaceIntegrator)))
