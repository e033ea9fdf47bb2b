"""What a step costs with constraints of one's own, beside the families of kcons.

    python examples/studies/own_constraints.py           a few seconds
    python examples/studies/own_constraints.py --full    a minute: longer blocks, 100,000 particles
    python examples/studies/own_constraints.py --car     the car axis, beside SciPy's DOP853 on equations of index 1

One particle or body, a step of RATTLE without forces; then many particles, the projection of positions and velocities,
for each row.
Processor time of blocks that are taken in turn in one process; medians, and ratios to the sphere.

The car axis (two wheels on a road that moves one of them) has the parameters and the solution at t = 3 of Mazzia and
Magherini, Test Set for Initial Value Problem Solvers, release 2.4 (2008), II-1.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numba
import numpy as np
from scipy.integrate import solve_ivp

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import (
    Constraint,
    Custom,
    Distance,
    Ellipsoid,
    Formula,
    Plane,
    Sphere,
    Torus,
    VelocityFormula,
)
from kcons.steppers import BlanesMoan6

AXES = np.array([1.0, 2.0, 3.0])
TORUS = "sqrt((sqrt(x1**2 + y1**2) - R)**2 + z1**2)"


@numba.njit
def quartic(r):
    return r[0, 0] ** 4 + r[0, 1] ** 4 + r[0, 2] ** 4


@numba.njit
def quartic_gradient(r):
    return 4.0 * r**3


#: Name -> what holds these atoms, each on a surface of its own through where it is.
HELD: dict[str, Callable[[np.ndarray], Constraint]] = {
    "Sphere": lambda atoms: Sphere(atoms, [0, 0, 0]),
    "Cylinder": lambda atoms: Ellipsoid(atoms, [0, 0, 0], [1.0, 1.0, np.inf], target=None),
    "Plane": lambda atoms: Plane(atoms, [0, 0, 1.0]),
    "Ellipsoid": lambda atoms: Ellipsoid(atoms, [0, 0, 0], AXES, target=None),
    "Torus": lambda atoms: Torus(atoms, [0, 0, 0], [0, 0, 1.0], 0.5),
    "Formula, a sphere": lambda atoms: Formula("sqrt(x1**2 + y1**2 + z1**2)", atoms, target=None),
    "Formula, a torus": lambda atoms: Formula(TORUS, atoms, {"R": 0.5}, None),
    "Formula, a wave": lambda atoms: Formula("z1 - a*sin(k*x1)*cos(y1)", atoms, {"a": 0.1, "k": 2.0}, None),
    "Custom, Numba": lambda atoms: Custom(atoms[:, None], quartic, quartic_gradient),
    "Custom, Python": lambda atoms: Custom(atoms[:, None], quartic.py_func, quartic_gradient.py_func),
    "Custom, no gradient": lambda atoms: Custom(atoms[:, None], quartic.py_func),
}


UP, ALONG = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
TURNS = np.radians([[0], [120], [240]])
BLADE = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
WHEEL = UP + np.vstack([0 * UP, np.cos(TURNS) * UP + np.sin(TURNS) * ALONG])
SKATE = "(x2 - x1)*(vy1 + vy2) - (y2 - y1)*(vx1 + vx2)"
ROLLS = "vx1 - ((z2 - z1)*(vx2 - vx1) - (x2 - x1)*(vz2 - vz1))/((x2 - x1)**2 + (z2 - z1)**2)"
SPIRAL = "x1*vy1 - y1*vx1 - 0.2*(x1*vx1 + y1*vy1)"
#: Name -> where the atoms of a body that glides or rolls are, and what holds them.
BODIES: dict[str, tuple[np.ndarray, list[Constraint]]] = {
    "Skate, 4 rows": (BLADE, [Distance([[0, 1]]), Plane([0, 1], UP), VelocityFormula(SKATE, [0, 1])]),
    "Wheel, 11 rows": (
        WHEEL,
        [
            *(Plane([0], UP), Plane([0, 1, 2, 3], [0.0, 1.0, 0.0])),
            *(Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]), VelocityFormula(ROLLS, [0, 1])),
        ],
    ),
    "VelocityFormula": (ALONG[None], [Plane([0], UP), VelocityFormula(SPIRAL, 0)]),
}


def start(name: str, n: int) -> tuple[Motion, np.ndarray, np.ndarray]:
    """A motion of n particles on their surfaces, positions and velocities along them."""
    rng = np.random.default_rng(0)
    around = rng.uniform(0, 2 * np.pi, n)
    x = np.stack([np.cos(around), np.sin(around), rng.uniform(-0.4, 0.4, n)], axis=1) * rng.uniform(0.9, 1.1, (n, 1))
    motion = Motion(ConstraintSet(HELD[name](np.arange(n)), x, np.ones(n)), x)
    return motion, x, motion.project_velocities(x, rng.normal(size=(n, 3)))


def one_particle(name: str) -> Callable[[int], float]:
    """Microseconds of a step, over so many steps."""
    if name in BODIES:
        x, held = BODIES[name]
        motion = Motion(ConstraintSet(held, x, np.ones(len(x))), x)
        v = motion.project_velocities(x, np.random.default_rng(0).normal(size=x.shape))
    else:
        motion, x, v = start(name, 1)
    system, state = System(motion, lambda x, t: np.zeros_like(x)), State(x, v)

    def block(steps: int) -> float:
        begin = time.process_time()
        run(system, state, 0.001, steps)
        return (time.process_time() - begin) / steps * 1e6

    return block


def many_particles(name: str, n: int) -> Callable[[int], float]:
    """Nanoseconds a row of one projection of the positions and one of the velocities."""
    motion, x, v = start(name, n)

    def block(turns: int) -> float:
        spent = 0.0
        for _ in range(turns):
            new, speeds = x + 0.003 * v, v.copy()
            begin = time.process_time()
            motion.project_positions(new, x, velocities=speeds, dt=0.003, out=new)
            motion.project_velocities(new, speeds, out=speeds)
            spent += time.process_time() - begin
        return spent / turns / n * 1e9

    return block


class Counted:
    """A function that counts its calls and keeps the last place."""

    def __init__(self, function: Callable[[np.ndarray], object]) -> None:
        self.function, self.calls, self.place = function, 0, np.zeros((1, 3))

    def __call__(self, r: np.ndarray) -> object:
        self.calls, self.place = self.calls + 1, r
        return self.function(r)

    def seconds(self, repeats: int = 300) -> float:
        """Of one call."""
        begin = time.process_time()
        for _ in range(repeats):
            self.function(self.place)
        return (time.process_time() - begin) / repeats


def beside_own_calls(size: int, turns: int) -> None:
    """What a step takes with Python functions, beside what the calls that it makes of them take alone."""
    print(f"{'Python functions':22}{'calls':>8}{'µs of these':>14}{'µs a step':>12}{'ratio':>8}")
    value, slope = quartic.py_func, quartic_gradient.py_func
    for name, given in {"Custom, Python": [value, slope], "Custom, no gradient": [value]}.items():
        counted = [Counted(function) for function in given]
        HELD["counted"] = lambda atoms, counted=counted: Custom(atoms[:, None], *counted)
        step = one_particle("counted")
        step(size)
        for each in counted:
            each.calls = 0
        step(size)
        calls = [each.calls / size for each in counted]
        del HELD["counted"]
        step, found = one_particle(name), []
        step(size)
        for _ in range(turns):
            own = 1e6 * sum(n * each.seconds() for n, each in zip(calls, counted, strict=True))
            found.append((own, step(size)))
        own, whole = np.median(found, axis=0)
        ratio = np.median([b / a for a, b in found])
        print(f"{name:22}{sum(calls):8.1f}{own:14.1f}{whole:12.1f}{ratio:8.1f}")
    print()


def medians(blocks: dict[str, Callable[[int], float]], size: int, turns: int) -> dict[str, float]:
    """The median of blocks taken in turn; the first, which may compile, does not count."""
    found: dict[str, list[float]] = {name: [] for name in blocks}
    for turn in range(turns + 1):
        for name, block in blocks.items():
            took = block(size)
            if turn:
                found[name].append(took)
    return {name: float(np.median(values)) for name, values in found.items()}


def show(title: str, unit: str, found: dict[str, float]) -> None:
    print(f"{title}\n{'':22}{unit:>12}{'Sphere = 1':>14}")
    for name, value in found.items():
        print(f"{name:22}{value:12.1f}{value / found['Sphere']:14.2f}")
    print()


# -- the car axis -------------------------------------------------------------------------------

LENGTH, SPRING, MASS, HEIGHT, FREQUENCY, END = 1.0, 0.5, 5e-4, 0.1, 10.0, 3.0
START = np.array([0.0, 0.5, 1.0, 0.5]), np.array([-0.5, 0.0, -0.5, 0.0])
PLACES = [0.0493455784275402809, 0.496989460230171154, 1.04174252488542151681, 0.373911027265361256927]
MULTIPLIERS = [-0.00473688659084893325, -0.00110468033125734369]


def road(t: float) -> tuple[float, float]:
    up = HEIGHT * np.sin(FREQUENCY * t)
    return np.sqrt(LENGTH**2 - up**2), up


def springs(q: np.ndarray, t: float) -> np.ndarray:
    """Of (x_l, y_l, x_r, y_r), and the weight."""
    left, right = q[:2], q[2:] - road(t)
    a, b = np.hypot(left[0], left[1]), np.hypot(right[0], right[1])
    f = np.concatenate([(SPRING / a - 1.0) * left, (SPRING / b - 1.0) * right])
    f[1::2] -= MASS
    return f


def index_one(t: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations and multipliers: both constraints differentiated twice, and two equations solved."""
    q, v = y[:4], y[4:]
    x, up = road(t)
    rise = HEIGHT * FREQUENCY * np.cos(FREQUENCY * t)
    bend = -(FREQUENCY**2) * up
    run = -up * rise / x
    run_bend = -(rise**2 + up * bend + run**2) / x
    rod, speed = q[:2] - q[2:], v[:2] - v[2:]
    G = np.array([[x, up, 0.0, 0.0], [*(2 * rod), *(-2 * rod)]])
    b = -np.array([2 * (v[0] * run + v[1] * rise) + q[0] * run_bend + q[1] * bend, 2 * (speed @ speed)])
    f = springs(q, t)
    found = np.linalg.solve(G @ G.T, MASS * b - G @ f)
    return (f + G.T @ found) / MASS, found


Car = tuple[np.ndarray, np.ndarray, int]


def car_by_dop853(tolerance: float) -> Car:
    """Places and multipliers at the end, and evaluations."""

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[4:], index_one(t, y)[0]])

    found = solve_ivp(slope, (0.0, END), np.concatenate(START), "DOP853", rtol=tolerance, atol=tolerance)
    return found.y[:4, -1], index_one(END, found.y[:, -1])[1], found.nfev


def car_by_kcons(steps: int) -> Car:
    """The same, by steps of BlanesMoan6."""
    times: list[float] = []

    def force(x: np.ndarray, t: float) -> np.ndarray:
        times.append(t)
        f = np.zeros((2, 3))
        f[:, :2] = springs(x[:, :2].ravel(), t).reshape(2, 2)
        return f

    upright = Formula("x1*sqrt(L**2 - (h*sin(w*t))**2) + y1*h*sin(w*t)", 0, {"h": HEIGHT, "w": FREQUENCY, "L": LENGTH})
    x, v = (np.pad(each.reshape(2, 2), ((0, 0), (0, 1))) for each in START)
    motion = Motion(ConstraintSet([upright, Distance([[0, 1]], LENGTH)], x, [MASS, MASS]), x)
    system = System(motion, force)
    start = system.initial_state(x, v)
    times.clear()
    end = run(system, start, END / steps, steps, stepper=BlanesMoan6())
    taken = len(times)
    found = motion.multipliers(end.positions, end.velocities, force(end.positions, END), END)
    # The published second row is the square of the length: its gradient is twice as long.
    return end.positions[:, :2].ravel(), found / [1.0, 2.0 * LENGTH], taken


def car_error(found: Car) -> float:
    """The largest, of places and multipliers."""
    return float(max(np.abs(found[0] - PLACES).max(), np.abs(found[1] - MULTIPLIERS).max()))


#: Name -> how, each with an error below 1e-7.
CAR: dict[str, Callable[[], Car]] = {
    "SciPy alone, DOP853": lambda: car_by_dop853(1e-7),
    "BlanesMoan6": lambda: car_by_kcons(150),
}


def car_axis(turns: int = 9) -> None:
    found = {name: way() for name, way in CAR.items()}
    spent: dict[str, list[float]] = {name: [] for name in CAR}
    for _ in range(turns):
        for name, way in CAR.items():
            begin = time.process_time()
            way()
            spent[name].append(time.process_time() - begin)
    print(f"{'Car axis, t = 3':22}{'error':>10}{'evaluations':>13}{'ms':>8}{'DOP853 = 1':>12}")
    first = np.array(next(iter(spent.values())))
    for name, each in found.items():
        ms, ratio = 1e3 * np.median(spent[name]), np.median(np.array(spent[name]) / first)
        print(f"{name:22}{car_error(each):10.1e}{each[2]:13,}{ms:8.0f}{ratio:12.2f}")


def main() -> None:
    if "--car" in sys.argv[1:]:
        car_axis()
        return
    full = "--full" in sys.argv[1:]
    n, turns = (100_000, 7) if full else (1_000, 3)
    one = {name: one_particle(name) for name in (*HELD, *BODIES)}
    show("One particle, or one body", "µs a step", medians(one, 1000 if full else 50, turns))
    beside_own_calls(1000 if full else 200, 9)
    compiled = [name for name in HELD if name not in ("Custom, Python", "Custom, no gradient")]
    show(f"{n:,} particles", "ns a row", medians({name: many_particles(name, n) for name in compiled}, 3, turns))


if __name__ == "__main__":
    main()
