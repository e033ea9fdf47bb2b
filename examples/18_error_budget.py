"""Where the error of a constrained trajectory comes from: time step, tolerance of the constraints, rounding.

    python examples/18_error_budget.py                         a small chain, some seconds
    python examples/18_error_budget.py --full --out F          the committed numbers, some minutes
    python examples/18_error_budget.py --redraw F --plot P     tables and figure of an earlier run

Each is changed alone. The step: with constraints to rounding. The tolerance: at one step, as the distance from the
trajectory with exact constraints at this same step, so that nothing but the tolerance is left. Rounding: the same
horizon in more and more steps, until more steps make it worse.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from kcons import State, System, run, steppers
from kcons.comparison import METHODS, Reference, json_files, processor_of, test_systems
from kcons.comparison import measure as compare

STEP_METHODS = ("rattle", "blanes-moan4", "blanes-moan6")
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
#: Gauss-Seidel sweeps, and OpenMM's SETTLE (water) or CCMA; kcons has no tolerance to choose.
SOLVERS = ("shake", "openmm-verlet")
#: Small and full sizes, and the step at which tolerances are compared, in units of the test system's longest.
SYSTEMS = {"water": (8, 64, 0.25), "chain": (20, 100, 0.125), "dumbbells": (2, 2, 0.125)}
ROUNDING = {"RATTLE": steppers.Rattle(), "BlanesMoan6": steppers.BlanesMoan6()}
BUDGET = 60.0


def of_steps(test_system, reference, full: bool) -> dict:
    """Error against time step, constraints to rounding."""
    found = {}
    for name in STEP_METHODS:
        method, points = METHODS[name], []
        parts = (1, 2, 4) if full else (1,)
        for dt in sorted({dt / k for dt in method.settings(test_system) for k in parts}, reverse=True):
            m = compare.Bench(test_system, reference, BUDGET).measure(method, dt)
            if m.error is not None:
                points.append([m.setting, m.error])
        found[method.title] = points
    return found


def of_tolerances(test_system, dt, full: bool) -> dict:
    """Distance from the trajectory with exact constraints at the same step, and what is left of the violation."""
    steps = round(test_system.horizon / dt)
    system = System(test_system.motion, test_system.potential.forces)
    exact = run(system, State(test_system.positions, test_system.velocities), test_system.horizon / steps, steps)
    bench = compare.Bench(test_system, Reference(exact.positions, 0.0, "RATTLE with exact constraints"), BUDGET)
    found = {}
    for solver in SOLVERS:
        points = []
        for tolerance in TOLERANCES if full else TOLERANCES[::4]:
            name = f"{solver}-{tolerance:.0e}".replace("e-0", "e-")
            method = METHODS[name if name in METHODS else solver]
            if method.refuses(test_system) is None:
                m = bench.measure(method, test_system.horizon / steps)
                points.append([tolerance, m.error, m.constraint_residual])
        if points:
            found[solver] = points
    m = bench.measure(METHODS["ase-kcons"], test_system.horizon / steps)
    found["kcons"] = [[None, m.error, m.constraint_residual]]
    return {"step": test_system.horizon / steps / test_system.units.time_unit, "solvers": found}


def of_rounding(full: bool) -> dict:
    """Error against the number of steps to one horizon: the power of the scheme first, then that of rounding."""
    test_system = test_systems.build("rotor")
    reference = test_system.reference()
    system = System(test_system.motion, test_system.potential.forces)
    found = {}
    for name, stepper in ROUNDING.items():
        points = []
        for steps in np.unique(np.geomspace(64, 400_000 if full else 2_000, 13 if full else 6).astype(int)):
            if steps * stepper.force_evaluations > (600_000 if full else 8_000):
                continue
            end = run(
                system,
                State(test_system.positions, test_system.velocities),
                test_system.horizon / steps,
                steps,
                stepper=stepper,
            )
            residual, _ = test_system.residuals(end.positions, end.velocities)
            points.append([int(steps), test_system.deviation(end.positions, reference.positions), residual])
        found[name] = points
    return {
        "title": test_system.title,
        "length": test_system.units.length,
        "reference": reference.error,
        "curves": found,
    }


def measure(full: bool) -> dict:
    result: dict = {"environment": compare.environment(), "full": full, "scenes": {}}
    for name in SYSTEMS if full else ("chain",):
        small, large, fraction = SYSTEMS[name]
        test_system = test_systems.build(name, large if full else small, quick=not full)
        reference = test_system.reference()
        compare.warm_up(test_system, [METHODS[n] for n in (*STEP_METHODS, *SOLVERS, "ase-kcons") if n in METHODS])
        result["scenes"][name] = {
            "title": test_system.title,
            "units": [test_system.units.time, test_system.units.length],
            "reference": reference.error,
            "steps": of_steps(test_system, reference, full),
            "tolerances": of_tolerances(test_system, fraction * max(test_system.time_steps), full),
        }
    result["rounding"] = of_rounding(full)
    return slim(result)


def slim(value):
    if isinstance(value, dict):
        return {key: slim(item) for key, item in value.items()}
    if isinstance(value, list):
        return [slim(item) for item in value]
    return float(f"{value:.3g}") if isinstance(value, float) else value


def show(result: dict) -> str:
    lines = []
    for found in result["scenes"].values():
        time, length = found["units"]
        lines += [
            found["title"],
            f"  time step, constraints exact; reference good to {found['reference']:.0e} {length}",
        ]
        for title, points in found["steps"].items():
            lines.append(f"    {title:<20}" + "  ".join(f"{dt:.3g} {time}: {error:.0e}" for dt, error in points[::2]))
        part = found["tolerances"]
        lines.append(f"  tolerance at a step of {part['step']:.3g} {time}: distance from exact constraints (and |σ|)")
        for solver, points in part["solvers"].items():
            cells = (
                f"{'exact' if tolerance is None else f'{tolerance:.0e}'}: "
                + ("failed" if error is None else f"{error:.0e} ({residual:.0e})")
                for tolerance, error, residual in points
            )
            lines.append(f"    {solver:<20}" + "  ".join(cells))
    part = result["rounding"]
    lines += [
        part["title"],
        f"  number of steps to one horizon; reference good to {part['reference']:.0e} {part['length']}",
    ]
    for name, points in part["curves"].items():
        lines.append(f"    {name:<20}" + "  ".join(f"{steps:,}: {error:.0e}" for steps, error, _ in points[::2]))
    return "\n".join(lines)


def plot(result: dict, path: Path) -> None:
    figure = Figure(figsize=(13, 8), layout="constrained")
    panels = figure.subplots(2, 4, squeeze=False)
    for column, (name, found) in enumerate(result["scenes"].items()):
        time, length = found["units"]
        top, bottom = panels[0, column], panels[1, column]
        for title, points in found["steps"].items():
            top.loglog([p[0] for p in points], [p[1] for p in points], "o-", markersize=4, label=title)
        top.axhline(found["reference"] or 1e-16, color="black", linewidth=0.8, linestyle=":")
        top.set(title=name, xlabel=f"time step / {time}", ylabel=f"error / {length}")
        for solver, points in found["tolerances"]["solvers"].items():
            if solver == "kcons":
                bottom.axhline(max(points[0][1], 1e-17), color="black", label="kcons in ASE, no tolerance")
                continue
            known = [p for p in points if p[1]]
            bottom.loglog([p[0] for p in known], [p[1] for p in known], "s-", markersize=4, label=solver)
        bottom.set(xlabel="tolerance", ylabel=f"distance from exact constraints / {length}")
        bottom.set_title(f"step {found['tolerances']['step']:.3g} {time}", fontsize=9)
        bottom.legend(fontsize=7)
        top.legend(fontsize=7)
        top.xaxis.set_major_locator(LogLocator())
        top.xaxis.set_minor_formatter(NullFormatter())
    part = result["rounding"]
    for row, (index, what) in enumerate(((1, f"error / {part['length']}"), (2, "max |σ|"))):
        axes = panels[row, 3]
        for name, points in part["curves"].items():
            axes.loglog([p[0] for p in points], [max(p[index], 1e-17) for p in points], "o-", markersize=4, label=name)
        axes.set(xlabel="steps to one horizon", ylabel=what, title="rotor" if row == 0 else "")
        axes.legend(fontsize=7)
    for axes in panels.flat:
        axes.grid(alpha=0.4)
    environment = result["environment"]
    figure.suptitle(
        f"{processor_of(environment)}; kcons {environment['versions']['kcons']}; {environment['date']}", fontsize=8
    )
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--out", type=Path, help="file for the numbers, JSON")
    parser.add_argument("--redraw", type=Path, help="numbers of an earlier run instead of a new one")
    parser.add_argument("--plot", type=Path, help="file for the figure")
    options = parser.parse_args()
    result = measure(options.full) if options.redraw is None else json_files.read(options.redraw)
    if options.out is not None:
        json_files.write(options.out, result, indent=None)
    if options.plot is not None:
        plot(result, options.plot)
    print(show(result))


if __name__ == "__main__":
    main()
