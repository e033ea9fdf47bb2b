"""Bodies held by more distances than they need, straight and nearly straight molecules, duplicated rows."""

from __future__ import annotations

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, case, outcome
from hard_cases.motions import OMEGA, Seen, energy_off, every, flat_body, move, tumble
from hard_cases.problem import Array, Problem, bends
from hard_cases.programs import Frame, Program, together

TRIANGLE = [(0, 1), (0, 2), (1, 2)]
WATER = np.array([[0.0, 0.0, 0.0], [0.9572, 0.0, 0.0], [-0.23999, 0.92663, 0.0]])
WATER_MASSES = np.array([15.999, 1.008, 1.008])


@case("H01", "One bond listed twice", "as the run with one bond to 1e-12 over 1e4 steps; 5 degrees of freedom")
def duplicate_rows(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1.2, 0, 0]])
    v = np.array([[0, 0.5, 0], [0, -0.2, 0.3]])
    pull = np.array([[0.3, -0.2, 0.1], [0.1, 0.4, -0.2]])
    steps = program.length(quick, 1000, 10_000)
    once = Problem(x, [1.0, 2.5], [(0, 1)], velocities=v, push=pull, tether=0.5, anchors=0 * x)
    runs: list[list[Array]] = []
    for problem in (once, once.but(pairs=[(0, 1), (1, 0)])):
        seen: list[Array] = []
        program.run(problem, 0.01, steps, lambda frame, seen=seen: seen.append(frame.x.copy()), every=10)  # type: ignore[misc]
        runs.append(seen)
    apart = np.abs(np.array(runs[0]) - np.array(runs[1])).max()
    freedom = program.degrees_of_freedom(once.but(pairs=[(0, 1), (1, 0)]))
    return outcome(
        ("difference from one bond", apart, 1e-12),
        ("degrees of freedom, miscounted by", abs(freedom - 5), 0),
        remark=f"{steps} steps",
    )


@case("H03", "Tetrahedron by 6, bipyramid by 10, octahedron by 15", "10 x the error of RATTLE; residual 1e-10; 6 dof")
def braced_bodies(program: Program, quick: bool) -> Outcome:
    shapes = {
        "tetrahedron": _TETRAHEDRON,
        "bipyramid": _BIPYRAMID,
        "octahedron": np.vstack([np.eye(3), -np.eye(3)]),
    }
    found: list[tuple[str, float, float]] = []
    for name, shape in shapes.items():
        n = len(shape)
        result = tumble(program, shape, np.arange(1.0, n + 1), every(n), quick=quick)
        found += [check._replace(name=f"{name}: {check.name}") for check in result.checks]
    return outcome(*found)


_TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_BIPYRAMID = np.array([[1.0, 0, 0], [-0.5, 0.87, 0], [-0.5, -0.87, 0], [0, 0, 1.1], [0, 0, -1.1]])


@case("X01", "Methane by all 10 distances", "as H03")
def methane(program: Program, quick: bool) -> Outcome:
    corners = _TETRAHEDRON * 1.09 / np.sqrt(3)
    return tumble(program, np.vstack([np.zeros(3), corners]), np.array([12.0, 1, 1, 1, 1]), every(5), quick=quick)


@case("X02", "Trigonal bipyramid by all 10 distances", "as H03")
def bipyramid(program: Program, quick: bool) -> Outcome:
    return tumble(program, _BIPYRAMID, np.full(5, 12.0), every(5), quick=quick)


@case("X03", "Martini diamond by 5 distances (openmm issue 3603)", "10 x the error of RATTLE; residual 1e-10")
def diamond(program: Program, quick: bool) -> Outcome:
    """Two triangles hinged on one side, flat at the start: nothing is singular, but the fold opens both ways."""
    x = truths.rotated(_DIAMOND)
    v = np.random.default_rng(3).standard_normal((4, 3))
    return move(
        program, Problem(x, np.full(4, 45.0), every(4)[:5], velocities=v), 0.005, program.length(quick, 100, 1000)
    )


_DIAMOND = np.array([[0, 0, 0], [2.7, 0, 0], [1.35, 2.338, 0], [1.35, -2.338, 0]])


@case("X04", "Martini diamond by all 6 distances", "right, or refused as singular", "warn-or-raise")
def braced_diamond(program: Program, quick: bool) -> Outcome:
    return flat_body(program, quick, _DIAMOND, np.full(4, 45.0), every(4))


# -- straight and nearly straight ---------------------------------------------------------------------


@case(
    "H05",
    "CO2 by 3 distances, collinear",
    "free flight to 10 x the error of RATTLE; 5 dof; or refused",
    "warn-or-raise",
)
def collinear(program: Program, quick: bool) -> Outcome:
    x = truths.rotated([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]])
    masses = CO2_MASSES
    axis = (x[2] - x[0]) / np.linalg.norm(x[2] - x[0])
    omega = np.cross(axis, OMEGA)
    dt, steps = 0.005, program.length(quick, 100, 2000)
    problem = Problem(x, masses, TRIANGLE, velocities=truths.spinning(x, masses, omega))
    seen, bent = Seen(problem), _Bent()
    end = program.run(problem, dt, steps, together(seen, bent))
    true = truths.linear_flight(x, problem.v, masses, dt * steps)
    size = float(np.linalg.norm(omega))
    plain = 1.16 * steps * (np.arcsin(size * dt) - size * dt)
    # Bent by a force on the middle atom.
    pushed = problem.but(velocities=None, push=np.array([-0.5, 1.0, -0.5])[:, None] * 3 * np.cross(axis, omega))
    program.run(pushed, dt, steps, together(seen, bent))
    freedom = program.degrees_of_freedom(problem)
    return outcome(
        ("bent by", bent.value, 1e-10),
        ("residual", seen.residual, 1e-10),
        ("position error", np.abs(end.x - true).max(), 10 * plain),
        ("degrees of freedom, miscounted by", abs(freedom - 5), 0),
        remark=f"{steps} steps, free and with the middle atom pushed aside",
    )


class _Bent:
    """How far the middle of three atoms was off the line of the others."""

    value = 0.0

    def __call__(self, frame: Frame) -> None:
        x = frame.x
        d = (x[2] - x[0]) / np.linalg.norm(x[2] - x[0])
        off = float(np.linalg.norm(np.cross(x[1] - x[0], d)))
        if not off <= self.value and not np.isnan(self.value):
            self.value = off


@case("X05", "CO2 by 2 bonds, straight at the start", "10 x the error of RATTLE; residual 1e-10")
def two_bonds(program: Program, quick: bool) -> Outcome:
    x = truths.rotated([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]])
    v = 0.3 * np.random.default_rng(1).standard_normal((3, 3))
    problem = Problem(x, [16.0, 12, 16], [(0, 1), (1, 2)], velocities=v)
    return move(program, problem, 0.005, program.length(quick, 100, 1000))


CO2_MASSES = np.array([16.0, 12.0, 16.0])


def _bent_triatomic(degrees: float, omega: list[float]) -> tuple[Array, Array]:
    """Places, and velocities of a turn about an axis across its own."""
    bend = np.radians(degrees)
    x = truths.rotated([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
    return x, truths.spinning(x, CO2_MASSES, np.cross((x[0] - x[2]) / np.linalg.norm(x[0] - x[2]), omega))


@case("H06", "Triatomic at 179.9 degrees by 3 distances", "residual 1e-11, energy 1e-8 over 1e4 steps")
def nearly_collinear(program: Program, quick: bool) -> Outcome:
    x, v = _bent_triatomic(179.9, [0.3, -0.5, 0.9])
    steps = program.length(quick, 500, 10_000)
    seen = Seen(problem := Problem(x, CO2_MASSES, TRIANGLE, velocities=v))
    program.run(problem, 1e-3, steps, seen)
    return outcome(
        ("energy", energy_off(seen.energies), 1e-8), ("residual", seen.residual, 1e-11), remark=f"{steps} steps"
    )


@case("H07", "Bonds and angle held at 179.9 degrees; angle at 180", "energy 1e-10, angle 1e-9 degrees over 1e4 steps")
def angle_towards_180(program: Program, quick: bool) -> Outcome:
    return _held_angle(program, 179.9, program.length(quick, 500, 10_000), 1e-10)


def _held_angle(program: Program, degrees: float, steps: int, energy_limit: float) -> Outcome:
    x, v = _bent_triatomic(degrees, [0.03, -0.05, 0.09])
    problem = Problem(x, CO2_MASSES, [(0, 1), (1, 2)], triples=[(0, 1, 2)], velocities=v)
    opened, energies = [0.0], []

    def watch(frame: Frame) -> None:
        opened.append(abs(np.degrees(bends(frame.x, problem.triples)[0]) - degrees))
        energies.append(frame.energy)

    program.run(problem, 1e-3, steps, watch)
    off = energy_off(energies)
    return outcome(
        ("angle off by (degrees)", np.max(opened), 1e-9), ("energy", off, energy_limit), remark=f"{steps} steps"
    )


@case("X06", "Angle held at exactly 180 degrees", "refused: use a linear constraint", "raise")
def straight_angle(program: Program, quick: bool) -> Outcome:
    x = np.array([[1.0, 0, 0], [0, 0, 0], [-1, 0, 0]])
    push = np.array([[0, -0.5, 0], [0, 1.0, 0], [0, -0.5, 0]])
    problem = Problem(x, [16.0, 12, 16], [(0, 1), (1, 2)], triples=[(0, 1, 2)], push=push)
    bent = _Bent()
    program.run(problem, 1e-3, 200, bent)
    return outcome(("bent by", bent.value, 1e-10))


@case("X07", "Angle held at 165, 170, 175, 179 and 179.99 degrees", "energy 1e-9, angle 1e-9 degrees")
def angles(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    steps = program.length(quick, 100, 2000)
    for degrees in (165.0, 170.0, 175.0, 179.0, 179.99):
        result = _held_angle(program, degrees, steps, 1e-9)
        found += [check._replace(name=f"at {degrees:g}: {check.name}") for check in result.checks]
    return outcome(*found, remark=f"{steps} steps each")
