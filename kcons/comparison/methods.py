"""Methods of `kcons compare`: each is one entry, made of a function that starts a run.

`add_method` is how all of them are registered: steppers of kcons, SciPy's and ASE's integrators, OpenMM's, and a
user's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from string import Template
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from scipy.linalg import qr

from kcons import steppers
from kcons.comparison.projected_equation import ProjectedEquation
from kcons.comparison.runs import InAse, InOpenMM, OfStates, OnArrays, Run
from kcons.comparison.test_systems import TestSystem
from kcons.constraints import Angle, Distance
from kcons.constraints.arguments import Count, checked
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, unknown
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, System
from kcons.steppers.splitting import SCHEMES as STEPPERS

if TYPE_CHECKING:
    from kcons.comparison.test_systems.openmm_engine import OpenMMEngine

#: A test system and a time step (or tolerance) to a run.
Start = Callable[[TestSystem, float], Run]
#: A test system to the reason why a method cannot run it; None if it can.
Refuses = Callable[[TestSystem], str | None]
Code = str | Callable[[TestSystem], str]

Engine = Literal["arrays", "ASE", "OpenMM"]
ENGINES = get_args(Engine)


@dataclass(frozen=True)
class Method:
    """A way to run a test system, which `add_method` registers for `compare` and `kcons compare`.

    Parameters
    ----------
    name : str
        By which it is chosen.
    start : callable
        Test system and time step (or tolerance) to a `kcons.comparison.runs.Run` at the start.
    title : str
        What tables call it; its name by default.
    engine : {'arrays', 'ASE', 'OpenMM'}
        Whose loop and forces it runs on: methods of one engine are compared by time.
    force_evaluations : int
        Of a step. Steps are as many times longer than RATTLE's, so that all cost about the same.
    adaptive : bool
        Whether its setting is a relative tolerance.
    holds : bool
        Whether it holds what the test system holds; of one that does not, a baseline, only the cost is stated.
    usual : bool
        Whether it runs unless methods are named.
    refuses : callable
        Test system to the reason why the method cannot run it, or None.
    code : str or callable, optional
        Lines of Python that run it, with $made_by (an expression that makes the test system), $step (or the tolerance),
        $steps and $ps (the step in ps); or a test system to them.
    """

    name: str
    start: Start
    title: str
    engine: str = "arrays"
    force_evaluations: int = 1
    adaptive: bool = False
    holds: bool = True
    usual: bool = True
    refuses: Refuses = lambda system: None
    code: Code | None = None

    def refusal(self, system: TestSystem) -> str | None:
        """Why it cannot run a test system, or None."""
        if self.engine == "OpenMM":
            if find_spec("openmm") is None:
                return "OpenMM is not installed; python -m pip install openmm"
            if system.openmm is None:
                return "the test system has no OpenMM System"
        return system.refusals.get(self.name) or self.refuses(system)

    def settings(self, system: TestSystem) -> list[float]:
        """Time steps, which cost as many force evaluations as those of the test system cost RATTLE; or tolerances."""
        if self.adaptive:
            return list(system.tolerances)
        steps, each = system.time_steps, self.force_evaluations
        first = max(system.horizon / steps[0] / each, 1.0 if each == 1 else 2.0)
        counts = dict.fromkeys(max(1, round(first * steps[0] / dt)) for dt in steps)
        return [system.horizon / count for count in counts]


METHODS: dict[str, Method] = {}


@checked
def add_method(
    name: str, start: Start, *, engine: Engine = "arrays", force_evaluations: Count = 1, **options: Any
) -> Method:
    """Register a `Method`, which takes these arguments, in place of one of that name."""
    if name.lower() in ("all", *map(str.lower, ENGINES)) or "," in name:
        raise InputError(f"name is {name!r}, which stands for several methods; choose another", item="name")
    options = {"title": name, "engine": engine, "force_evaluations": force_evaluations, **options}
    METHODS[name] = Method(name, start, **options)
    return METHODS[name]


def choose(names: Iterable[str] | None, system: TestSystem | None = None) -> list[Method]:
    """Methods by name; 'all', 'arrays', 'ASE' and 'OpenMM' stand for all and for those of an engine.

    By default the usual ones that can run the test system: of OpenMM alone where its forces are OpenMM's, else all of
    arrays and ASE and the plainest of OpenMM.
    """
    usual = [method for method in METHODS.values() if method.usual]
    if names is None:
        if system is not None and system.openmm is not None and system.openmm.home:
            usual = [m for m in usual if m.engine == "OpenMM" and m.refusal(system) is None]
        elif system is not None:
            guests = GUESTS[2:] if system.openmm is not None and system.openmm.surfaces else GUESTS[:2]
            able = [m for m in usual if m.name in guests and m.refusal(system) is None]
            usual = [m for m in usual if m.engine != "OpenMM" or m in able]
        return usual
    groups = {"all": list(METHODS.values())} | {e.lower(): [m for m in usual if m.engine == e] for e in ENGINES}
    picked: dict[str, Method] = {}
    if isinstance(names, str):
        raise InputError(f"methods is {names!r:.80}; give a list, such as ['rattle']", item="methods")
    for name in names:
        if name in METHODS:
            picked[name] = METHODS[name]
        elif name.lower() in groups:
            able = [m for m in groups[name.lower()] if system is None or m.refusal(system) is None]
            picked |= {m.name: m for m in able}
        else:
            raise InputError(f"there is no method {unknown(name, (*METHODS, *groups))}", item="methods")
    if not picked:
        raise InputError(f"no method is named; there are {', '.join(METHODS)}", item="methods")
    return list(picked.values())


#: Methods of OpenMM that also run, unless methods are named, with test systems whose forces are not OpenMM's: with
#: distances, and with surfaces.
GUESTS = ("openmm-verlet", "openmm-kcons-rattle", "openmm-held-rattle")


def _step(dt: float) -> str:
    """A time step as text, with all digits: steps divide the horizon."""
    return repr(float(f"{dt:.15g}"))


# -- kcons on arrays --------------------------------------------------------------------------------

#: Those that run unless methods are named: the plain one, and of each order a composition and a splitting.
USUAL = ("rattle", "suzuki4", "kahan-li6", "blanes-moan4", "blanes-moan6")

_ON_ARRAYS = """\
from kcons import Motion, State, System, run
from kcons.comparison import test_systems
$imports

test_system = $made_by
motion = Motion(test_system.constraint_set, test_system.positions)  # your ConstraintSet and positions
system = System(motion, test_system.potential.forces)  # a function of positions and time
start = State(test_system.positions, test_system.velocities)
"""


def lines_on_arrays(imports: str, last: str) -> str:
    """Lines of Python that build a System, with $made_by, and the last ones."""
    return _ON_ARRAYS.replace("$imports", imports).replace(", run", ", run" if "run(" in last else "") + last


_BY_DYNAMICS = """\
from ase import units

from kcons.ase import ConstrainedDynamics, constrain
from kcons.comparison import test_systems
from kcons.steppers import $stepper

test_system = $made_by
atoms = test_system.atoms()  # yours, with a calculator and velocities
held = test_system.constraint_set.constraints  # yours, such as [Distance([[0, 1], [1, 2]])]
constrain(atoms, held)
dynamics = ConstrainedDynamics(atoms, $step * units.fs, $stepper())
dynamics.run($steps)
"""


def on_arrays(
    make: Callable[[float], steppers.Stepper], system: TestSystem, dt: float, held: ConstraintSet | None = None
) -> Run:
    """A run of the stepper that `make` gives for a time step, with what the test system holds or something else."""
    stepper = make(dt)
    if held is None:  # what does not keep positions on the surface cannot have rows that depend on each other there
        held = system.constraint_set if stepper.symplectic else independent_rows(system)
    made = System(Motion(held, system.positions), system.potential.forces)
    return OnArrays(made, made.with_forces(State(system.positions, system.velocities)), stepper, dt)


def _nothing_held(system: TestSystem, dt: float) -> Run:
    return on_arrays(lambda dt: Rattle(), system, dt, ConstraintSet([], system.positions, system.masses))


def _code_of_stepper(stepper: str, system: TestSystem) -> str:
    if system.units.energy == "eV":
        return _BY_DYNAMICS.replace("$stepper", stepper)
    last = f"end = run(system, start, $step, $steps, stepper={stepper}())\n"
    return lines_on_arrays(f"from kcons.steppers import {stepper}", last)


def _fixed_stepper(stepper: steppers.Stepper, system: TestSystem, dt: float) -> Run:
    return on_arrays(lambda dt: stepper, system, dt)


for _name, _make in STEPPERS.items():
    _stepper = _make()
    add_method(
        _name,
        partial(_fixed_stepper, _stepper),
        title=f"kcons {'RATTLE' if _name == 'rattle' else type(_stepper).__name__}",
        force_evaluations=_stepper.force_evaluations,
        usual=_name in USUAL,
        code=partial(_code_of_stepper, type(_stepper).__name__),
    )
for _name, _title, _order in (("projected-verlet", "Verlet", 2), ("projected-rk4", "Runge-Kutta", 4)):
    _equation = ProjectedEquation(_order)
    add_method(
        _name,
        partial(_fixed_stepper, _equation),
        title=f"projected equation, {_title}",
        force_evaluations=_equation.force_evaluations,
        usual=False,
    )
add_method("verlet", _nothing_held, title="baseline: Verlet, nothing held", holds=False)


def independent_rows(system: TestSystem, held: ConstraintSet | None = None) -> ConstraintSet:
    """The constraint set, or an equivalent one, without rows that others imply at the start (last in a pivoted QR)."""
    if held is None:
        held = system.constraint_set
    rank = system.motion.rank
    if rank == held.n_rows:
        return held
    weighted = held.jacobian(system.positions).toarray() / np.sqrt(np.repeat(held.masses, 3))
    kept = np.sort(qr(weighted.T, mode="r", pivoting=True)[1][:rank])
    pieces = []
    for item, start in zip(held.constraints, held.starts, strict=False):
        mine = kept[(kept >= start) & (kept < start + item.n_rows)] - start
        if len(mine):
            pieces.append(item.select(mine))
    return ConstraintSet(pieces, system.positions, held.masses, cell=system.cell)


# -- SciPy ------------------------------------------------------------------------------------------


def _dop853(land: bool, system: TestSystem, rtol: float) -> Run:
    """DOP853 on a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^-1 b (notes eq. 105); nothing else stops a drift off the rows.

    With `land`, positions and velocities go back onto the rows after each step (Hairer, Lubich and Wanner, IV.4).
    """
    from scipy.integrate import DOP853

    # Off the surface rows that depend on each other contradict each other.
    motion = Motion(independent_rows(system), system.positions)
    shape, n = system.positions.shape, system.positions.size
    last: list[FloatArray] = [np.zeros(shape)]

    def rate(t: float, y: FloatArray) -> FloatArray:
        x, v = y.reshape(2, *shape)
        f = last[0] = system.potential.forces(x, t)
        return np.concatenate([y[n:], motion.acceleration(x, v, f, t).ravel()])

    def states(solver: Any) -> Iterator[State]:
        while True:
            message, t = solver.step(), float(solver.t)
            if solver.status == "failed":
                raise KconsError(f"DOP853 gave up at t = {t:g}: {message}")
            x, v = solver.y.reshape(2, *shape)
            if land:
                x = motion.project_positions(x, x, time=t)
                v = motion.project_velocities(x, v, time=t)
                solver.y = np.concatenate([x.ravel(), v.ravel()])
                # By less than the tolerance: the force known there need not be computed again.
                solver.f = np.concatenate([v.ravel(), motion.acceleration(x, v, last[0], t).ravel()])
            yield State(x, v, time=t)

    # Errors are measured against one unit of length and the thermal speed, not against each entry.
    speed = float(np.sqrt(np.mean(system.velocities**2))) or 1.0
    start = np.concatenate([system.positions.ravel(), system.velocities.ravel()])
    atol = rtol * np.repeat([1.0, speed], n)
    begin = partial(DOP853, rate, 0.0, start, system.horizon, rtol=max(rtol, 1e-13), atol=atol)
    return OfStates(lambda: states(begin()), State(system.positions, system.velocities))


add_method("dop853", partial(_dop853, False), title="SciPy DOP853 on eq. 105", adaptive=True)
add_method("dop853-projected", partial(_dop853, True), title="kcons + DOP853, projected", adaptive=True)


# -- ASE --------------------------------------------------------------------------------------------


def _in_ase(held: Callable[[TestSystem], Sequence[Any]], system: TestSystem, dt: float) -> Run:
    from ase.md.verlet import VelocityVerlet

    atoms = system.atoms()
    run = InAse(atoms, VelocityVerlet(atoms, timestep=dt), dt)
    atoms.set_constraint(list(held(system)))
    system.potential.forces(system.positions)
    return run


def _kcons_in_ase(system: TestSystem) -> Sequence[Any]:
    from kcons.ase import Constraints

    return [Constraints(system.constraint_set.constraints)]


def _fix_bond_lengths(system: TestSystem) -> Sequence[Any]:
    """FixBondLengths at its own tolerance, angles held by their end distances."""
    from ase.constraints import FixBondLengths

    return [*_fixed(system), FixBondLengths(system.bonds)]


def _fix_internals(system: TestSystem) -> Sequence[Any]:
    """FixInternals at its own tolerance."""
    from ase.constraints import FixInternals

    atoms, held = system.atoms(), system.constraint_set.constraints
    pairs, triples = ([a for c in held if isinstance(c, k) for a in c.atoms.tolist()] for k in (Distance, Angle))
    bonds = [[float(atoms.get_distance(*pair)), pair] for pair in pairs]
    angles = [[float(atoms.get_angle(*triple)), triple] for triple in triples]
    return [*_fixed(system), FixInternals(bonds=bonds or None, angles_deg=angles or None)]


def _fixed(system: TestSystem) -> list[Any]:
    from ase.constraints import FixAtoms

    return [FixAtoms(system.fixed.tolist())] if len(system.fixed) else []


def _distances_only(system: TestSystem) -> str | None:
    return None if system.bonds is not None else "it holds internal coordinates only"


_IN_ASE = """\
$imports
from ase.md.verlet import VelocityVerlet

from kcons.comparison import test_systems

test_system = $made_by
atoms = test_system.atoms()  # yours, with a calculator and velocities
atoms.set_constraint($held)
VelocityVerlet(atoms, $step * test_system.units.time_unit).run($steps)
"""


def _lines_in_ase(imports: str, held: str) -> str:
    return _IN_ASE.replace("$imports", imports).replace("$held", held)


add_method(
    "ase-kcons",
    partial(_in_ase, _kcons_in_ase),
    title="ASE Verlet + kcons",
    engine="ASE",
    code=_lines_in_ase("from kcons.ase import Constraints", "Constraints(test_system.constraint_set.constraints)"),
)
add_method(
    "ase-bonds",
    partial(_in_ase, _fix_bond_lengths),
    title="ASE Verlet + FixBondLengths",
    engine="ASE",
    refuses=_distances_only,
    code=_lines_in_ase(
        "from ase.constraints import FixAtoms, FixBondLengths",
        "[FixAtoms(test_system.fixed), FixBondLengths(test_system.bonds)]",
    ),
)
add_method(
    "ase-internals",
    partial(_in_ase, _fix_internals),
    title="ASE Verlet + FixInternals",
    engine="ASE",
    refuses=_distances_only,
)
add_method(
    "ase-verlet",
    partial(_in_ase, lambda system: []),
    title="baseline: ASE Verlet, nothing held",
    engine="ASE",
    holds=False,
)


# -- OpenMM -----------------------------------------------------------------------------------------

#: Tolerances of OpenMM's own solvers; the second is the default of its integrators.
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12)
DEFAULT = 1e-5
#: Tolerance under the integrators of kcons.
TIGHT = 1e-12


def exponent(tolerance: float) -> str:
    """'1e-5', as it is in names and titles."""
    return f"{tolerance:.0e}".replace("e-0", "e-")


def evaluations(scheme: str) -> int:
    """Force evaluations of a step of a scheme."""
    return STEPPERS[scheme]().force_evaluations


def _engine(system: TestSystem) -> OpenMMEngine:
    assert system.openmm is not None
    return system.openmm


def only_water(system: TestSystem) -> bool:
    """Whether OpenMM's System holds nothing but rigid water."""
    from kcons.openmm.callback_rows import move_constraints

    engine = _engine(system)
    return not engine.surfaces and not move_constraints(engine.copy())


def _in_openmm(kind: str, given: tuple[Any, ...], tolerance: float, how: str, system: TestSystem, dt: float) -> Run:
    """A run of an integrator of OpenMM or of `kcons.openmm`, by its name and what it takes beside the step.

    `how`: 'own' constraints of the System; 'held', moved to the solver of kcons (rigid water stays, unless there is
    nothing else); or 'free' of them.
    """
    import openmm

    from kcons.openmm import ProjectedIntegrator, hold

    engine = _engine(system)
    made, x = engine.copy(constraints=how != "free"), system.positions * engine.length
    v, each = system.velocities * engine.speed, 1
    own = kind != "ProjectedIntegrator"
    if own:
        integrator = getattr(openmm, kind)(*given, dt * engine.time)
        integrator.setConstraintTolerance(tolerance)
        if hasattr(integrator, "setRandomNumberSeed"):
            integrator.setRandomNumberSeed(1)
    else:
        parts = []
        if how == "held":
            parts = [hold(made, engine.surfaces, x, take="all", keep_water=not only_water(system))]
        integrator = ProjectedIntegrator(engine.step(dt), *given, tolerance=tolerance, parts=parts)
        each = evaluations(given[0])
    context = engine.context(made, integrator)
    context.setPositions(x)
    if own:
        # Velocities are those of half a step earlier: then the first position is the one that RATTLE reaches.
        state = context.getState(forces=True, groups=integrator.getIntegrationForceGroups())
        v = v - 0.5 * dt * engine.time * state.getForces(asNumpy=True)._value / system.masses[:, None]
    context.setVelocities(v)
    units = {"length": engine.length, "speed": engine.speed}
    return InOpenMM(context, integrator, dt, force_evaluations=each, half_step=own, **units)


_IN_OPENMM = """\
$imported

from kcons.comparison import test_systems

test_system = $made_by
md_engine = test_system.openmm
system = md_engine.copy()  # yours, with its constraints
$integrator
context = md_engine.context(system, integrator)  # or openmm.Context(system, integrator), app.Simulation(...)
context.setPositions(test_system.positions * md_engine.length)
context.setVelocities(test_system.velocities * md_engine.speed)
integrator.step($steps)
"""


def _lines_in_openmm(kind: str, given: tuple[Any, ...], tolerance: float, how: str, system: TestSystem) -> str:
    """Lines of Python that do what `_in_openmm` does."""
    lines, imported = "", "import openmm"
    if kind == "ProjectedIntegrator":
        imported, taken = "from kcons.openmm import ProjectedIntegrator", ["$ps", *(f'"{word}"' for word in given)]
        if how == "held":
            imported += ", hold"
            taken.append("parts=[part]")
            lines = f"""\
x = test_system.positions * md_engine.length
part = hold(system, md_engine.surfaces, x, take="all", keep_water={not only_water(system)})  # constraints move to kcons
"""
        lines += f"integrator = ProjectedIntegrator({', '.join(taken)}, tolerance={tolerance:g})"
    else:
        lines = f"integrator = openmm.{kind}({', '.join([*map(repr, given), '$ps'])})\n"
        lines += f"integrator.setConstraintTolerance({tolerance:g})"
    return _IN_OPENMM.replace("$imported", imported).replace("$integrator", lines)


def _bonds_in_openmm(system: TestSystem) -> str | None:
    return None if system.bonds is not None else "a System holds distances only"


def _bonds_or_surfaces(system: TestSystem) -> str | None:
    return None if _engine(system).surfaces else _bonds_in_openmm(system)


def _add_in_openmm(
    name: str, title: str, kind: str, *given: Any, tolerance: float = TIGHT, how: str = "own", usual: bool = True
) -> None:
    """Register an integrator as `_in_openmm` takes it."""
    what = kind, given, tolerance, how
    add_method(
        name,
        partial(_in_openmm, *what),
        title=f"OpenMM {title}" if how != "free" else title,
        engine="OpenMM",
        force_evaluations=evaluations(given[0]) if kind == "ProjectedIntegrator" else 1,
        holds=how != "free",
        usual=usual,
        refuses=_bonds_or_surfaces if how == "held" else _bonds_in_openmm if how == "own" else lambda system: None,
        code=partial(_lines_in_openmm, *what) if how != "free" else None,
    )


for _name, _title, _own, _given in (
    ("openmm-verlet", "Verlet", "VerletIntegrator", ()),
    ("openmm-middle", "LangevinMiddle, no friction", "LangevinMiddleIntegrator", (300.0, 0.0)),
    ("openmm-nose-hoover", "NoseHoover, no bath", "NoseHooverIntegrator", ()),
):
    for _t in TOLERANCES:
        _plain = _t == DEFAULT
        _full, _usual = _name if _plain else f"{_name}-{exponent(_t)}", _plain or _name == "openmm-verlet"
        _add_in_openmm(_full, f"{_title}, {exponent(_t)}", _own, *_given, tolerance=_t, usual=_usual)
_ours = "ProjectedIntegrator"
for _scheme in (*USUAL, "geodesic", "yoshida4", "blanes-moan6a"):
    _add_in_openmm(f"openmm-kcons-{_scheme}", f"+ kcons {_scheme}", _ours, _scheme, usual=_scheme in USUAL)
for _t in (1e-4, DEFAULT, 1e-6):
    _name, _title = f"openmm-kcons-rattle-{exponent(_t)}", f"+ kcons rattle, {exponent(_t)}"
    _add_in_openmm(_name, _title, _ours, "rattle", tolerance=_t)
for _scheme in ("rattle", "blanes-moan4", "blanes-moan6"):
    _name, _title, _usual = f"openmm-held-{_scheme}", f"+ kcons {_scheme}, own solver", _scheme != "blanes-moan4"
    _add_in_openmm(_name, _title, _ours, _scheme, how="held", usual=_usual)
_add_in_openmm(
    "openmm-free", "baseline: OpenMM Verlet, nothing held", "VerletIntegrator", tolerance=DEFAULT, how="free"
)


# -- lines of Python --------------------------------------------------------------------------------


def code(system: TestSystem, name: str, setting: float, made_by: str) -> str:
    """Lines of Python that run a method on a test system, to be pasted and changed.

    Parameters
    ----------
    system : TestSystem
    name : str
        Of the method.
    setting : float
        Time step in the unit that tables show, or tolerance.
    made_by : str
        The expression that makes the test system after ``from kcons.comparison import test_systems``, as in
        ``test_systems.build("chain", 10)``.
    """
    method = choose([name])[0]
    internal = float(setting if method.adaptive else setting * system.units.time_unit)
    lines = method.code or ""
    if callable(lines):
        lines = lines(system)
    if not lines:
        lines = f"""\
from kcons.comparison import METHODS, test_systems

test_system = $made_by
run = METHODS["{name}"].start(test_system, {internal!r})
while run.time < test_system.horizon * (1 - 1e-9):
    run.advance()
print(run.observe()[0])
"""
    ps = ""
    if "$ps" in lines:
        ps = _step(internal * _engine(system).time)
        if float(ps) > 0.02:  # which might be meant in fs
            ps, lines = f"{ps} * unit.picoseconds", lines.replace("\n\n", "\nfrom openmm import unit\n\n", 1)
    steps = 0 if method.adaptive else round(system.horizon / internal)
    return Template(lines).substitute(made_by=made_by, step=_step(setting), steps=steps, ps=ps)
