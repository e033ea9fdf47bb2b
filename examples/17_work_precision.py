"""A work-precision diagram from nothing but a loop: error against force evaluations and time. Read it, and change it.

    python examples/17_work_precision.py                     a colliding pair of dumbbells, some seconds
    python examples/17_work_precision.py --scene chain       another test system of `kcons compare --list`
    python examples/17_work_precision.py --redraw            the figure once more, from work_precision.json

`kcons compare` does the same for all methods of all MD engines, with budgets, tables and fronts.
"""

import argparse
from pathlib import Path
from time import perf_counter

import numpy as np
from matplotlib.figure import Figure

from kcons import State, System, run, steppers
from kcons.comparison import json_files, test_systems
from kcons.errors import ConvergenceError

STEPPERS = [steppers.Rattle(), steppers.Suzuki4(), steppers.BlanesMoan4(), steppers.BlanesMoan6()]
RESULT = Path("work_precision.json")


def measure(name: str) -> dict:
    test_system = test_systems.build(name, quick=True)
    system = System(test_system.motion, test_system.potential.forces)
    start = State(test_system.positions, test_system.velocities)
    reference = test_system.reference()
    curves = {}
    for stepper in STEPPERS:
        stepper.step(system, start, test_system.horizon / 1000)  # compiles what has to be compiled
        points = []
        for force_evaluations in (60, 120, 240, 480, 960):
            steps = max(1, force_evaluations // stepper.force_evaluations)  # the same work for all
            test_system.potential.forget()
            times = []
            try:
                for _ in range(3):
                    begun = perf_counter()
                    end = run(system, start, test_system.horizon / steps, steps, stepper=stepper)
                    times.append(perf_counter() - begun)
            except ConvergenceError as failure:  # a step too long for the constraints: no point
                print(f"{type(stepper).__name__}, {steps} steps: {str(failure).split('.')[0]}")
                continue
            error = np.sqrt(np.mean(np.sum((end.positions - reference.positions) ** 2, axis=1)))
            points.append([test_system.potential.evaluations / 3, float(np.median(times)), float(error)])
        curves[type(stepper).__name__] = points
    return {
        "scene": test_system.title,
        "length": test_system.units.length,
        "reference": reference.error,
        "curves": curves,
    }


def draw(result: dict, path: Path) -> None:
    figure = Figure(figsize=(9, 4), layout="constrained")
    for column, axes in enumerate(figure.subplots(1, 2, sharey=True)):
        for stepper, points in result["curves"].items():
            axes.loglog([p[column] for p in points], [p[2] for p in points], "o-", label=stepper)
        axes.axhline(result["reference"], color="black", linestyle=":", linewidth=0.8)
        axes.set_xlabel(("force evaluations", "wall time / s")[column])
        axes.grid(alpha=0.4)
    figure.axes[0].set_ylabel(f"error / {result['length']}")
    figure.axes[0].legend()
    figure.suptitle(result["scene"], fontsize=9)
    figure.savefig(path, dpi=120)


parser = argparse.ArgumentParser()
parser.add_argument("--scene", default="dumbbells")
parser.add_argument("--redraw", action="store_true")
options = parser.parse_args()
if not options.redraw:
    json_files.write(RESULT, measure(options.scene))
result = json_files.read(RESULT)
draw(result, RESULT.with_suffix(".png"))
for stepper, points in result["curves"].items():
    print(f"{stepper:<12}", "  ".join(f"{evaluations:4.0f}: {error:.1e}" for evaluations, _, error in points))
