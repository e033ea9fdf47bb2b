"""How many force evaluations does an accurate trajectory cost? All steppers on three systems with known solutions.

    python examples/04_high_order.py                  the usual steppers on one of them, some seconds
    python examples/04_high_order.py --full --out F   all steppers, long energy runs, minutes; F receives JSON
    python examples/04_high_order.py --show F         the tables of an earlier result
    python examples/04_high_order.py --plot P --show F    draw its figure into P (.png, .svg)

The error is the root-mean-square distance an atom from the test system's own solution at its horizon, t = 5. The
evaluations at a given error are found on the line between two points of the curve, both axes logarithmic.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from kcons import ConstraintSet
from kcons.comparison import METHODS, CoreStepper, json_files, measure, processor_of, test_systems
from kcons.constraints import Sphere
from kcons.errors import KconsError
from kcons.motion import Motion
from kcons.steppers import ProjectedRungeKutta4, ProjectedVerlet, State, Stepper, System, run

SYSTEMS = ("butane", "dumbbells", "triple-pendulum")
#: The error at which costs are compared.
GOAL = 5e-7
#: Curves begin and end at so many force evaluations, or end where they are this good.
FIRST, MOST = 64, 2**17
BEST = {True: 1e-10, False: GOAL}

#: Pendulum of the energy runs: let go at 2 rad, m = l = g = 1.
ANGLE = 2.0
ENERGY_STEPS, ENERGY_TIME = {True: (0.1, 0.01), False: (0.1,)}, {True: 1000.0, False: 20.0}


# -- work and precision ---------------------------------------------------------------------------


def curve(
    test_system: test_systems.TestSystem, reference: test_systems.Reference, name: str, full: bool
) -> list[dict[str, float]]:
    """Step, force evaluations and error, from coarse to fine."""
    method = METHODS[name]
    assert isinstance(method, CoreStepper)
    system = System(test_system.motion, test_system.potential.forces)
    cost = method.stepper.force_evaluations
    found: list[dict[str, float]] = []
    # From point to point, evaluations grow by this factor.
    growth = 2**0.5 if full else 2.0 if method.stepper.order > 2 else 4.0
    wanted, tried = float(FIRST), 0
    while wanted <= MOST:
        steps = max(2, round(wanted / cost))
        wanted *= growth
        if steps == tried:
            continue
        tried = steps
        dt = test_system.horizon / steps
        test_system.potential.forget()
        try:
            end = run(system, State(test_system.positions, test_system.velocities), dt, steps, stepper=method.make(dt))
        except KconsError:  # the step is too large
            continue
        error = test_system.deviation(end.positions, reference.positions)
        found.append({"dt": dt, "evaluations": test_system.potential.evaluations, "error": error})
        if error < BEST[full]:
            break
    return found


def at_goal(points: list[dict[str, float]], item: str, goal: float = GOAL) -> float | None:
    """`item` where the error comes down to `goal` for good; None if it never does."""
    above = [k for k, p in enumerate(points) if not p["error"] <= goal]
    k = above[-1] if above else -1
    if not 0 <= k < len(points) - 1:
        return None
    (e0, y0), (e1, y1) = ((np.log(p["error"]), np.log(p[item])) for p in points[k : k + 2])
    return float(np.exp(y0 + (np.log(goal) - e0) / (e1 - e0) * (y1 - y0)))


def cpu_seconds(test_system: test_systems.TestSystem, name: str, points: list[dict[str, float]]) -> float | None:
    """Processor time to the horizon with the step that reaches the goal; the better of two runs."""
    dt = at_goal(points, "dt")
    if dt is None:
        return None
    steps = round(test_system.horizon / dt)
    stepper = METHODS[name].make(dt)
    system = System(test_system.motion, test_system.potential.forces)
    times = []
    for _ in range(2):
        test_system.potential.forget()
        start = process_time()
        run(
            system,
            State(test_system.positions, test_system.velocities),
            test_system.horizon / steps,
            steps,
            stepper=stepper,
        )
        times.append(process_time() - start)
    return min(times)


def work_precision(full: bool, console: Console) -> dict[str, Any]:
    """The curves of all systems."""
    names = [n for n, m in METHODS.items() if isinstance(m, CoreStepper) and (full or m.usual)]
    systems: dict[str, Any] = {}
    for name in SYSTEMS if full else SYSTEMS[-1:]:
        test_system = test_systems.build(name)
        reference = test_system.reference()
        curves, seconds = {}, {}
        for stepper in names:
            curves[stepper] = curve(test_system, reference, stepper, full)
            seconds[stepper] = cpu_seconds(test_system, stepper, curves[stepper]) if full else None
            needed = at_goal(curves[stepper], "evaluations")
            console.print(f"{name}, {stepper}: {'-' if needed is None else f'{needed:,.0f}'} evaluations for {GOAL:g}")
        systems[name] = {
            "title": test_system.title,
            "horizon": test_system.horizon,
            "reference_error": reference.error,
            "curves": curves,
            "cpu_seconds": seconds,
        }
    return systems


# -- energy ---------------------------------------------------------------------------------------


def energy_slope(stepper: Stepper, dt: float, time: float) -> float:
    """Least-squares slope of the pendulum's energy against time, the energy written down every 0.1."""
    x = np.array([[np.sin(ANGLE), 0.0, -np.cos(ANGLE)]])
    motion = Motion(ConstraintSet(Sphere(0, np.zeros(3), 1.0), x, [1.0]), x)
    weight = np.array([[0.0, 0.0, -1.0]])
    system = System(motion, lambda x, t: weight, potential=lambda x, t: float(x[0, 2]))
    seen: list[tuple[float, float]] = []
    try:
        run(
            system,
            system.initial_state(x),
            dt,
            round(time / dt),
            stepper=stepper,
            observers=[lambda state: seen.append((state.time, system.total_energy(state)))],
            every=round(0.1 / dt),
        )
    except KconsError:  # it has drifted away
        return float("nan")
    t, e = np.array(seen).T
    return float(np.polyfit(t - t.mean(), e - e.mean(), 1)[0])


def energy_slopes(full: bool, console: Console) -> dict[str, dict[str, float]]:
    """Slopes of each stepper at each time step."""
    steppers = {n: m.make for n, m in METHODS.items() if isinstance(m, CoreStepper)}
    steppers["projected-verlet, project=True"] = lambda dt: ProjectedVerlet(project=True)
    steppers["projected-rk4, project=True"] = lambda dt: ProjectedRungeKutta4(project=True)
    slopes: dict[str, dict[str, float]] = {}
    for name, make in steppers.items():
        slopes[name] = {f"{dt:g}": energy_slope(make(dt), dt, ENERGY_TIME[full]) for dt in ENERGY_STEPS[full]}
        console.print(f"pendulum, {name}: " + ", ".join(f"{s:.1e} at dt {dt}" for dt, s in slopes[name].items()))
    return slopes


# -- results --------------------------------------------------------------------------------------


def show(result: dict[str, Any], console: Console) -> None:
    """The tables."""
    table = Table(title=f"Force evaluations for an error of {GOAL:g} at t = 5", box=box.SIMPLE_HEAD)
    table.add_column("stepper", no_wrap=True)
    table.add_column("order", justify="right")
    table.add_column("forces\na step", justify="right")
    systems = result["systems"]
    for name in systems:
        for heading in (f"{name}\nforces", "RATTLE\n/this", "CPU\ntime"):
            table.add_column(heading, justify="right", no_wrap=True)
    for stepper in next(iter(systems.values()))["curves"]:
        scheme = METHODS[stepper].stepper
        cells = []
        for name in systems:
            curves = systems[name]["curves"]
            needed, plain = (at_goal(curves[k], "evaluations") for k in (stepper, "rattle"))
            seconds = systems[name]["cpu_seconds"][stepper]
            if needed is None:
                cells += [f"> {curves[stepper][-1]['evaluations']:,.0f}", "", ""]
            else:
                ratio = f"{plain / needed:.1f}" if plain else ""
                cells += [f"{needed:,.0f}", ratio, "" if seconds is None else measure.duration(seconds)]
        table.add_row(stepper, str(scheme.order), str(scheme.force_evaluations), *cells)
    console.print(table)
    for name in systems:
        ratio, best = best_ratio(systems[name]["curves"])
        console.print(f"{name}: {best} needs {ratio:.1f} times fewer force evaluations than RATTLE")
    slopes = result["slopes"]
    steps = list(next(iter(slopes.values())))
    table = Table(
        title=f"Energy slope, pendulum of {ANGLE:g} rad\nm g l per unit time, over {result['energy_time']:g}",
        box=box.SIMPLE_HEAD,
    )
    table.add_column("stepper", no_wrap=True)
    for dt in steps:
        table.add_column(f"dt = {dt}", justify="right")
    for name, found in slopes.items():
        table.add_row(name, *(f"{s:.1e}" if s is not None else "gone" for s in found.values()))
    console.print(table)
    machine = result["environment"]
    versions = ", ".join(f"{name} {machine['versions'][name]}" for name in ("numpy", "scipy", "numba"))
    console.print(f"{processor_of(machine)}, one thread; {versions}; commit {machine['commit']}, {machine['date']}")


def best_ratio(curves: dict[str, list[dict[str, float]]]) -> tuple[float, str]:
    """How many times fewer evaluations than RATTLE the best stepper needs, and which one it is."""
    needed = {name: at_goal(points, "evaluations") for name, points in curves.items()}
    plain = needed["rattle"]
    assert plain is not None
    return max((plain / n, name) for name, n in needed.items() if n is not None)


def plot(result: dict[str, Any], path: Path) -> None:
    """Error against force evaluations, a panel a system."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from kcons.comparison import report

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    systems = result["systems"]
    panels = figure.subplots(1, len(systems), sharey=True)
    for axes, name in zip(panels, systems, strict=True):
        for stepper, points in result["systems"][name]["curves"].items():
            colour, marker = report.style(stepper)
            good = [p for p in points if p["error"] < 1.0]
            axes.loglog(
                [p["evaluations"] for p in good],
                [p["error"] for p in good],
                color=colour,
                marker=marker,
                markersize=4,
                linewidth=1.2,
                linestyle="-" if METHODS[stepper].stepper.symplectic else "--",
                label=stepper,
            )
        axes.axhline(GOAL, color="black", linewidth=0.8, linestyle=":")
        axes.set(title=name, xlabel="force evaluations", ylim=(1e-10, 1.0))
        axes.grid(True, linewidth=0.4, alpha=0.5)
    panels[0].set_ylabel("rms error an atom at t = 5")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=9)
    figure.savefig(path, dpi=110, metadata={"Software": None} if path.suffix == ".png" else None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="all steppers, finer curves, long energy runs")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument("--show", type=Path, help="tables of an earlier result instead of a run")
    parser.add_argument("--plot", type=Path, help="file for the figure")
    options = parser.parse_args()
    console = Console(width=150)
    if options.show:
        result = json_files.read(options.show)
    else:
        environment = measure.environment()
        measure.warm_up(test_systems.build(SYSTEMS[-1]))
        result = {
            "environment": environment,
            "goal": GOAL,
            "systems": work_precision(options.full, console),
            "energy_time": ENERGY_TIME[options.full],
            "slopes": energy_slopes(options.full, console),
        }
    if options.out:
        json_files.write(options.out, result)
    if options.plot:
        plot(result, options.plot)
    show(result, console)


if __name__ == "__main__":
    main()
