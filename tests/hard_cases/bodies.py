"""Bodies held by more distances than they need, straight and nearly straight molecules, duplicated rows."""

from __future__ import annotations

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, case, outcome
from hard_cases.motions import OMEGA, every, flat_body, miscounted, move, tumble
from hard_cases.problem import Array, Problem, bends
from hard_cases.programs import Frame, Program

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
    twice, runs = once.but(pairs=[(0, 1), (1, 0)]), ([], [])
    for problem, seen in zip((once, twice), runs, strict=True):
        program.run(problem, 0.01, steps, lambda frame, seen=seen: seen.append(frame.x.copy()), every=10)
    return outcome(
        ("difference from one bond", np.abs(np.subtract(*runs)).max(), 1e-12),
        miscounted(program, twice, 5),
        remark=f"{steps} steps",
    )


_TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_BIPYRAMID = np.array([[1.0, 0, 0], [-0.5, 0.87, 0], [-0.5, -0.87, 0], [0, 0, 1.1], [0, 0, -1.1]])
_METHANE = np.vstack([np.zeros(3), _TETRAHEDRON * 1.09 / np.sqrt(3)])
SINGULAR = "right, or refused as singular"
_DIAMOND = np.array([[0, 0, 0], [2.7, 0, 0], [1.35, 2.338, 0], [1.35, -2.338, 0]])


@case("H03", "Tetrahedron by 6, bipyramid by 10, octahedron by 15", "10 x the error of RATTLE; residual 1e-10; 6 dof")
def braced_bodies(program: Program, quick: bool) -> Outcome:
    shapes = {"tetrahedron": _TETRAHEDRON, "bipyramid": _BIPYRAMID, "octahedron": np.vstack([np.eye(3), -np.eye(3)])}
    found = {name: tumble(program, quick, x, np.arange(1.0, len(x) + 1), every(len(x))) for name, x in shapes.items()}
    return outcome(*(check for name, result in found.items() for check in result.named(name)))


HEAVY = np.full(4, 45.0)
for number, title, limit, kind, function, shape, masses in (
    ("X01", "Methane by all 10 distances", "as H03", "bound", tumble, _METHANE, np.array([12.0, 1, 1, 1, 1])),
    ("X02", "Trigonal bipyramid by all 10 distances", "as H03", "bound", tumble, _BIPYRAMID, np.full(5, 12.0)),
    ("X04", "Martini diamond by all 6 distances", SINGULAR, "warn-or-raise", flat_body, _DIAMOND, HEAVY),
):
    case(number, title, limit, kind, shape=shape, masses=masses, pairs=every(len(shape)))(function)


@case("X03", "Martini diamond by 5 distances (openmm issue 3603)", "10 x the error of RATTLE; residual 1e-10")
def diamond(program: Program, quick: bool) -> Outcome:
    """Two triangles hinged on one side, flat at the start: nothing is singular, but the fold opens both ways."""
    v = np.random.default_rng(3).standard_normal((4, 3))
    return move(program, quick, Problem(truths.rotated(_DIAMOND), HEAVY, every(4)[:5], velocities=v))


# -- straight and nearly straight ---------------------------------------------------------------------

CO2, CO2_MASSES = np.array([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]]), np.array([16.0, 12.0, 16.0])


class _Bent:
    """How far the middle of three atoms was off the line of the others."""

    value = 0.0

    def __call__(self, frame: Frame) -> None:
        x = frame.x
        d = (x[2] - x[0]) / np.linalg.norm(x[2] - x[0])
        self.value = float(np.maximum(self.value, np.linalg.norm(np.cross(x[1] - x[0], d))))


@case("H05", "CO2 by 3 distances, collinear", "free flight to 10 x RATTLE; 5 dof; or refused", "warn-or-raise")
def collinear(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(CO2)
    axis = (x[2] - x[0]) / np.linalg.norm(x[2] - x[0])
    omega = np.cross(axis, OMEGA)
    dt, steps, bent = 0.005, program.length(quick, 100, 2000), _Bent()
    problem = Problem(x, CO2_MASSES, TRIANGLE, velocities=truths.spinning(x, CO2_MASSES, omega))
    free = program.seen(problem, dt, steps, bent)
    true = truths.linear_flight(x, problem.v, CO2_MASSES, dt * steps)
    size = float(np.linalg.norm(omega))
    plain = 1.16 * steps * (np.arcsin(size * dt) - size * dt)
    # Bent by a force on the middle atom.
    push = np.array([-0.5, 1.0, -0.5])[:, None] * 3 * np.cross(axis, omega)
    pushed = program.seen(problem.but(velocities=None, push=push), dt, steps, bent)
    return outcome(
        ("bent by", bent.value, 1e-10),
        ("residual", np.maximum(free.residual, pushed.residual), 1e-10),
        ("position error", np.abs(free.end.x - true).max(), 10 * plain),
        miscounted(program, problem, 5),
        remark=f"{steps} steps, free and with the middle atom pushed aside",
    )


@case("X05", "CO2 by 2 bonds, straight at the start", "10 x the error of RATTLE; residual 1e-10")
def two_bonds(program: Program, quick: bool) -> Outcome:
    v = 0.3 * np.random.default_rng(1).standard_normal((3, 3))
    return move(program, quick, Problem(truths.rotated(CO2), CO2_MASSES, [(0, 1), (1, 2)], velocities=v))


def _bent_triatomic(degrees: float, omega: list[float]) -> tuple[Array, Array]:
    """Places, and velocities of a turn about an axis across its own."""
    bend = np.radians(degrees)
    x = truths.rotated([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
    return x, truths.spinning(x, CO2_MASSES, np.cross((x[0] - x[2]) / np.linalg.norm(x[0] - x[2]), omega))


@case("H06", "Triatomic at 179.9 degrees by 3 distances", "residual 1e-11, energy 1e-8 over 1e4 steps")
def nearly_collinear(program: Program, quick: bool) -> Outcome:
    x, v = _bent_triatomic(179.9, [0.3, -0.5, 0.9])
    steps = program.length(quick, 500, 10_000)
    seen = program.seen(Problem(x, CO2_MASSES, TRIANGLE, velocities=v), 1e-3, steps)
    return outcome(("energy", seen.energy_off, 1e-8), ("residual", seen.residual, 1e-11), remark=f"{steps} steps")


@case("H07", "Bonds and angle held at 179.9 degrees; angle at 180", "energy 1e-10, angle 1e-9 degrees over 1e4 steps")
def angle_towards_180(program: Program, quick: bool) -> Outcome:
    return _held_angle(program, 179.9, program.length(quick, 500, 10_000), 1e-10)


def _held_angle(program: Program, degrees: float, steps: int, energy_limit: float) -> Outcome:
    x, v = _bent_triatomic(degrees, [0.03, -0.05, 0.09])
    problem, bent = Problem(x, CO2_MASSES, [(0, 1), (1, 2)], triples=[(0, 1, 2)], velocities=v), [0.0]
    seen = program.seen(problem, 1e-3, steps, lambda frame: bent.append(bends(frame.x, problem.triples)[0]))
    return outcome(
        ("angle off by (degrees)", np.abs(np.degrees(bent[1:]) - degrees).max(), 1e-9),
        ("energy", seen.energy_off, energy_limit),
        remark=f"{steps} steps",
    )


@case("X06", "Angle held at exactly 180 degrees", "refused: use a linear constraint", "raise")
def straight_angle(program: Program, quick: bool) -> Outcome:
    x = np.array([[1.0, 0, 0], [0, 0, 0], [-1, 0, 0]])
    push, bent = np.array([[0, -0.5, 0], [0, 1.0, 0], [0, -0.5, 0]]), _Bent()
    problem = Problem(x, [16.0, 12, 16], [(0, 1), (1, 2)], triples=[(0, 1, 2)], push=push)
    program.run(problem, 1e-3, 200, bent)
    return outcome(("bent by", bent.value, 1e-10))


@case("X07", "Angle held at 165, 170, 175, 179 and 179.99 degrees", "energy 1e-9, angle 1e-9 degrees")
def angles(program: Program, quick: bool) -> Outcome:
    steps = program.length(quick, 100, 2000)
    found = {angle: _held_angle(program, angle, steps, 1e-9) for angle in (165.0, 170.0, 175.0, 179.0, 179.99)}
    checks = (check for angle, result in found.items() for check in result.named(f"at {angle:g}"))
    return outcome(*checks, remark=f"{steps} steps each")
