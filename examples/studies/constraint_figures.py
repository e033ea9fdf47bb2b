"""Motions under constraints of one's own, each beside what theory says: a picture for docs/own_constraints.md.

python examples/studies/constraint_figures.py            prints how far each is from its closed form
python examples/studies/constraint_figures.py FOLDER     also writes own_constraints.png there
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Constraint, Custom, Distance, Formula, Plane, VelocityFormula

#: Of positions and time.
Force = Callable[[np.ndarray, float], np.ndarray]
#: Of the hub of a wheel of radius 1 and a point that turns with it, on the ground z = 0.
ROLLS = "vx1 - ((z2 - z1)*(vx2 - vx1) - (x2 - x1)*(vz2 - vz1))/((x2 - x1)**2 + (z2 - z1)**2)"


def moved(
    held: list[Constraint], x: np.ndarray, v: np.ndarray, force: Force | None, length: float, steps: int
) -> tuple[Motion, np.ndarray, np.ndarray]:
    """Times and positions."""
    motion, path = Motion(ConstraintSet(held, x, np.ones(len(x))), x), list[State]()
    start = State(x, motion.project_velocities(x, v))
    run(System(motion, force), start, length / steps, steps, observers=[path.append], every=5)
    return motion, np.array([state.time for state in path]), np.array([state.positions for state in path])


def skate(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Two masses on a blade that turns with the rate 2 on a slope: cycloids across it, and no way down (Bloch 2003)."""
    pull, rate, half = 1.0, 2.0, 0.1
    x = np.array([[-half, 0.0, 0.0], [half, 0.0, 0.0]])
    v = np.array([[pull / rate, -rate * half, 0.0], [pull / rate, rate * half, 0.0]])
    blade = VelocityFormula("(x2 - x1)*(vy1 + vy2) - (y2 - y1)*(vx1 + vx2)", [0, 1])
    held = [Distance([[0, 1]]), Plane([0, 1], [0.0, 0.0, 1.0], 0.0), blade]
    _, t, path = moved(held, x, v, lambda x, t: np.tile([0.0, -pull, 0.0], (2, 1)), 6.0, steps)
    turned = rate * t
    exact = np.stack([turned + np.sin(turned) * np.cos(turned), np.sin(turned) ** 2], axis=1) * pull / (2 * rate**2)
    return path.mean(axis=1)[:, :2], exact


def wheel(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """A point on the rim of a wheel that rolls at speed 1: a cycloid."""
    along, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    turns = np.radians([0, 120, 240])[:, None]  # from the top; the center of mass is the hub
    rim = np.cos(turns) * up + np.sin(turns) * along
    x = np.vstack([up, up + rim])
    v = along + np.vstack([0 * along, np.cos(turns) * along - np.sin(turns) * up])
    held = [
        Plane([0], up, 1.0),
        Plane([0, 1, 2, 3], [0.0, 1.0, 0.0], 0.0),
        Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]),
        VelocityFormula(ROLLS, [0, 1]),
    ]
    _, t, path = moved(held, x, v, None, 12.0, steps)
    return path[:, 1, [0, 2]], np.stack([t + np.sin(t), 1 + np.cos(t)], axis=1)


def spiral(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """A velocity at 80 degrees from the radius everywhere: a logarithmic spiral, at constant speed."""
    lean = np.radians(80)
    held = VelocityFormula("c*(x1*vy1 - y1*vx1) - s*(x1*vx1 + y1*vy1)", 0, {"c": np.cos(lean), "s": np.sin(lean)})
    x, v = np.array([[1.0, 0.0, 0.0]]), np.array([[np.cos(lean), np.sin(lean), 0.0]])
    _, t, path = moved([Plane([0], [0.0, 0.0, 1.0], 0.0), held], x, v, None, 10.0, steps)
    far = 1 + t * np.cos(lean)
    around = np.log(far) * np.tan(lean)
    return path[:, 0, :2], far[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)


def rounded_cube(steps: int) -> tuple[np.ndarray, float]:
    """Free motion on x^4 + y^4 + z^4 = 1; how far it leaves the surface."""
    x, v = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.7]])
    held = Custom([0], lambda r: float(np.sum(r**4)), lambda r: 4 * r**3)
    motion, _, path = moved([held], x, v, None, 40.0, steps)
    return path[:, 0], max(float(np.abs(motion.constraint_set.value(r)).max()) for r in path)


def wave(steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, and three beads that a travelling wave lifts; how far they leave it."""
    x = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    x[:, 2] = 0.3 * np.sin(x[:, 0])
    held = Formula("z1 - 0.3*sin(x1 - t)", [0, 1, 2])
    motion, t, path = moved([held], x, np.zeros((3, 3)), lambda x, t: np.tile([0.0, 0.0, -1.0], (3, 1)), 6.0, steps)
    pairs = zip(path, t, strict=True)
    return t, path, max(float(np.abs(motion.constraint_set.value(r, then)).max()) for r, then in pairs)


def picture(folder: Path, steps: int = 800) -> None:
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(5.2, 8.0), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=[0.7, 0.9, 2.2, 2.0])
    beside = {
        "VelocityFormula: a skate on a slope": (grid[0, :], "y", skate(steps)),
        "VelocityFormula: a point on the rim of a wheel": (grid[1, :], "z", wheel(steps)),
        "VelocityFormula:\n80° from the radius": (grid[2, 0], "y", spiral(steps)),
    }
    for title, (place, up, (found, exact)) in beside.items():
        axes = figure.add_subplot(place, title=title, aspect="equal", xlabel="x", ylabel=up)
        axes.plot(*exact.T, color="0.75", linewidth=6)
        axes.plot(*found.T, color="#0072B2")
        if up == "z":
            axes.set_yticks([0, 2])
    figure.axes[0].set_yticks([0, 0.1])
    path, _ = rounded_cube(4 * steps)
    axes = figure.add_subplot(grid[2, 1], projection="3d", title="Custom:\nx⁴ + y⁴ + z⁴ = 1")
    axes.plot(*path.T, color="#0072B2", linewidth=0.8)
    axes.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], zticks=[-0.5, 0.5])
    axes.set_box_aspect((1, 1, 1))
    times, beads, _ = wave(steps)
    axes = figure.add_subplot(grid[3, :], title="Formula: beads on a traveling wave", xlabel="x", ylabel="z")
    along = np.linspace(-2, 9, 200)
    for k, shade in zip(np.linspace(0, len(times) - 1, 4).astype(int), ("0.85", "0.7", "0.5", "0.2"), strict=True):
        axes.plot(along, 0.3 * np.sin(along - times[k]), color=shade, label=f"t = {times[k]:.0f}")
    for bead in range(3):
        axes.plot(beads[:, bead, 0], beads[:, bead, 2], color="#D55E00")
    axes.set_ylim(-0.33, 0.62)
    axes.legend(loc="upper center", ncols=4, fontsize=10, handlelength=1, columnspacing=1)
    figure.savefig(folder / "own_constraints.png", dpi=110)


def main(arguments: list[str], steps: int = 100) -> None:
    for name, motion in (("Skate", skate), ("Wheel", wheel), ("Spiral", spiral)):
        found, exact = motion(steps)
        print(f"{name:<15} {np.abs(found - exact).max():.1e} from the closed form")
    for name, held in (("Custom", rounded_cube), ("Formula", wave)):
        print(f"{name:<15} {held(steps)[-1]:.1e} off the surface at most")
    if arguments:
        from matplotlib import rc_context

        with rc_context({"font.size": 11, "axes.titlesize": 12}):
            picture(Path(arguments[0]))


if __name__ == "__main__":
    main(sys.argv[1:])
