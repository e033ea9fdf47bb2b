"""The lines of code that run a method on a test system, to be pasted and changed.

Each snippet runs as it stands, from the start of the test system to its horizon. What is to be replaced for a system of
one's own is named in comments.
"""

from __future__ import annotations

import inspect

from kcons.comparison.methods.method import Method
from kcons.comparison.methods.methods import METHODS, Adaptive, AseBonds, AseKcons, CoreStepper, ProjectedOde
from kcons.comparison.methods.openmm import TIGHT, BuiltIn, Compiled, Held, OnSurfaces, Projected, only_water
from kcons.comparison.test_systems import TestSystem
from kcons.errors import InputError

_ON_ARRAYS = (
    "test_system = MADE_BY",
    "motion = Motion(test_system.constraint_set, test_system.positions)  # your ConstraintSet and positions",
    "system = System(motion, test_system.potential.forces)  # a function of positions and time",
    "start = State(test_system.positions, test_system.velocities)",
)


def code(test_system: TestSystem, method: str, setting: float, made_by: str) -> str:
    """Python for one method.

    Parameters
    ----------
    test_system : TestSystem
    method : str
        A key of `kcons.comparison.methods.methods.METHODS`.
    setting : float
        Time step in the unit that tables show, or tolerance.
    made_by : str
        The expression that makes the test system after ``from kcons.comparison import test_systems``, as in
        ``test_systems.build("chain", 10)``.

    Raises
    ------
    InputError
        Unknown method.
    """
    if method not in METHODS:
        raise InputError(f"there is no method {method!r}", item="method")
    found = METHODS[method]
    steps = 0 if found.adaptive else round(test_system.horizon / (setting * test_system.units.time_unit))
    molecular = test_system.units.energy == "eV"
    # All digits: steps divide the horizon.
    dt = repr(float(f"{setting:.15g}"))
    if getattr(test_system, "friction", 0.0):
        lines = _any(method, setting if found.adaptive else setting * test_system.units.time_unit)
    elif isinstance(found, CoreStepper) and _plain(found):
        stepper = type(found.make(1.0)).__name__
        lines = _ase_stepper(dt, steps, stepper) if molecular else _arrays(dt, steps, stepper)
    elif isinstance(found, Adaptive):
        lines = _adaptive(type(found.scheme(setting)).__name__, setting)
    elif isinstance(found, AseKcons):
        lines = _ase_kcons(dt, steps)
    elif isinstance(found, AseBonds):
        lines = _ase_bonds(dt, steps)
    elif isinstance(found, ProjectedOde) and not found.project:
        lines = _scipy(setting)
    elif isinstance(found, BuiltIn | Compiled | Projected) and not isinstance(found, OnSurfaces):
        assert test_system.openmm is not None
        step = repr(float(f"{setting * test_system.units.time_unit * test_system.openmm.time:.15g}"))
        lines = _openmm(found, step, steps, keep_water=not only_water(test_system))
    else:
        lines = _any(method, setting if found.adaptive else setting * test_system.units.time_unit)
    return "\n".join(lines).replace("MADE_BY", made_by) + "\n"


def _plain(method: CoreStepper) -> bool:
    """Whether its class can do without arguments, and keeps to the constraints."""
    stepper = method.make(1.0)
    needed = [p for p in inspect.signature(type(stepper)).parameters.values() if p.default is p.empty]
    return stepper.symplectic and not [p for p in needed if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]


def _ase_stepper(dt: str, steps: int, stepper: str) -> list[str]:
    return [
        "from ase import units",
        "",
        "from kcons.comparison import test_systems",
        "from kcons.ase import ConstrainedDynamics",
        f"from kcons.steppers import {stepper}",
        "",
        "test_system = MADE_BY",
        "atoms = test_system.atoms()  # yours, with a calculator and velocities",
        "held = test_system.constraint_set.constraints  # yours, such as [Distance([[0, 1], [1, 2]])]",
        f"dynamics = ConstrainedDynamics(atoms, {dt} * units.fs, {stepper}(), constraints=held)",
        f"dynamics.run({steps})",
    ]


def _arrays(dt: str, steps: int, stepper: str) -> list[str]:
    return [
        "from kcons import Motion, State, System, run",
        "from kcons.comparison import test_systems",
        f"from kcons.steppers import {stepper}",
        "",
        *_ON_ARRAYS,
        f"end = run(system, start, {dt}, {steps}, stepper={stepper}())",
    ]


def _adaptive(scheme: str, tolerance: float) -> list[str]:
    return [
        "from kcons import Motion, State, System",
        "from kcons.comparison import test_systems",
        f"from kcons.steppers import {scheme}",
        "",
        *_ON_ARRAYS,
        f"for end in {scheme}({tolerance!r}).states(system, start, until=test_system.horizon):",
        "    pass  # each state is the end of a step",
    ]


def _ase_kcons(dt: str, steps: int) -> list[str]:
    return [
        "from ase import units",
        "from ase.md.verlet import VelocityVerlet",
        "",
        "from kcons.comparison import test_systems",
        "from kcons.ase import Constraints",
        "",
        "test_system = MADE_BY",
        "atoms = test_system.atoms()  # yours, with a calculator and velocities",
        "atoms.set_constraint(Constraints(test_system.constraint_set.constraints))",
        f"VelocityVerlet(atoms, {dt} * test_system.units.time_unit).run({steps})",
    ]


def _ase_bonds(dt: str, steps: int) -> list[str]:
    return [
        "from ase.constraints import FixAtoms, FixBondLengths",
        "from ase.md.verlet import VelocityVerlet",
        "",
        "from kcons.comparison import test_systems",
        "",
        "test_system = MADE_BY",
        "atoms = test_system.atoms()  # yours, with a calculator and velocities",
        "atoms.set_constraint([FixAtoms(test_system.fixed), FixBondLengths(test_system.bonds)])",
        f"VelocityVerlet(atoms, {dt} * test_system.units.time_unit).run({steps})",
    ]


def _scipy(rtol: float) -> list[str]:
    return [
        "import numpy as np",
        "from scipy.integrate import solve_ivp",
        "",
        "from kcons import Motion",
        "from kcons.comparison import test_systems",
        "",
        "test_system = MADE_BY",
        "motion = Motion(test_system.constraint_set, test_system.positions)  # your ConstraintSet, rows independent",
        "",
        "",
        "def rate(t, y):",
        "    x, v = y.reshape(2, -1, 3)",
        "    return np.concatenate([v, motion.acceleration(x, v, test_system.potential.forces(x, t), t)]).ravel()",
        "",
        "",
        "start = np.concatenate([test_system.positions, test_system.velocities]).ravel()",
        "scale = np.repeat([1.0, np.sqrt(np.mean(test_system.velocities**2)) or 1.0], start.size // 2)",
        f"options = dict(method='DOP853', rtol={max(rtol, 1e-13):g}, atol={rtol:g} * scale)",
        "end = solve_ivp(rate, (0, test_system.horizon), start, **options)",
        "assert end.success",
    ]


def _openmm(found: Method, dt: str, steps: int, *, keep_water: bool) -> list[str]:
    lines = ["from kcons.comparison import test_systems"]
    made = [
        "test_system = MADE_BY",
        "md_engine = test_system.openmm",
        "system = md_engine.system  # yours, with its constraints",
    ]
    if isinstance(found, BuiltIn):
        lines = ["import openmm", "", *lines]
        made += [
            f"integrator = openmm.{found.make.code(dt)}",
            f"integrator.setConstraintTolerance({found.tolerance:g})",
        ]
    elif isinstance(found, Held):
        lines += ["from kcons.openmm import ProjectedIntegrator, hold"]
        made[-1] = "system = md_engine.copy()  # yours; its constraints move to kcons"
        made += [
            "x = test_system.positions * md_engine.length",
            f'part = hold(system, md_engine.surfaces, x, take="all", keep_water={keep_water})',
            f'integrator = ProjectedIntegrator({dt}, "{found.scheme}", parts=[part], tolerance={TIGHT:g})',
        ]
    elif isinstance(found, Compiled):
        lines += ["from kcons.openmm import RattleIntegrator"]
        made += [f"integrator = RattleIntegrator({dt}, tolerance={found.tolerance:g})"]
    elif isinstance(found, Projected):
        lines += ["from kcons.openmm import ProjectedIntegrator"]
        made += [f'integrator = ProjectedIntegrator({dt}, "{found.scheme}", tolerance={TIGHT:g})']
    return [
        *lines,
        "",
        *made,
        "context = md_engine.context(system, integrator)  # or openmm.Context(system, integrator), app.Simulation(...)",
        "context.setPositions(test_system.positions * md_engine.length)",
        "context.setVelocities(test_system.velocities * md_engine.speed)",
        f"integrator.step({steps})",
    ]


def _any(method: str, setting: float) -> list[str]:
    return [
        "from kcons.comparison import test_systems",
        "from kcons.comparison import METHODS",
        "",
        "test_system = MADE_BY",
        f'run = METHODS["{method}"].start(test_system, {setting!r})',
        "while not run.finished:",
        "    run.advance()",
        "print(run.positions)",
    ]
