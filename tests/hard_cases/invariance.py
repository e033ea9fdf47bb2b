"""What must not matter: fixed atoms as infinite mass, direction of time, order, orientation, and a pause."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from ase.io import read, write

from hard_cases import truths
from hard_cases.bodies import TRIANGLE, WATER, WATER_MASSES
from hard_cases.case import Outcome, case, outcome
from hard_cases.chains import bonds, zigzag
from hard_cases.long_runs import pendulum
from hard_cases.motions import miscounted
from hard_cases.problem import Array, Numbers, Problem
from hard_cases.programs import Core, Forces, PlainAse, PlainOpenMM, Program
from kcons.comparison.runs import seen
from kcons.steppers import State, run


@case("H26", "Fixed atom and bond: a pendulum", "elliptic functions to 10 x the error of RATTLE; 2 degrees of freedom")
def fixed_and_bond(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    dt, steps = 0.02, 100
    for degrees in (10.0, 90.0):
        problem = pendulum(np.radians(degrees))
        end = program.run(problem, dt, steps)
        expected = truths.pendulum(np.radians(degrees), dt * steps)
        plain = np.abs(truths.dense_rattle(problem, dt, steps)[1] - expected).max()
        found.append((f"{degrees:g}: position", np.abs(end.x[1] - expected).max(), 10 * plain))
        found.append((f"{degrees:g}: fixed atom moved by", np.abs(end.x[0]).max(), 0))
    return outcome(*found, miscounted(program, pendulum(1.0), 2))


_HALF = "the velocities of VerletIntegrator belong to half steps: turning them round is not the reverse"


@case("H30", "n steps, velocities turned round, n steps", "at the start to 1e-10 after 2 x 1e4 steps", openmm=_HALF)
def reversal(program: Program, quick: bool) -> Outcome:
    """Springs to anchors: not chaotic."""
    x = truths.rotated([[0.0, 0, 0], [1.2, 0, 0]])
    problem = Problem(x, [1.0, 2.0], [(0, 1)], [1.2], tether=0.5, anchors=0 * x)
    problem = problem.moving([[0, 0.5, 0.1], [0.3, -0.2, 0.3]])
    steps = program.length(quick, 1000, 10_000)
    end = program.run(problem, 0.01, steps)
    back = program.run(problem.but(positions=end.x, velocities=-end.v), 0.01, steps)
    off = max(np.abs(back.x - x).max(), np.abs(back.v + problem.v).max())
    return outcome(("start missed by", off, 1e-10), remark=f"2 x {steps} steps")


@case("H31", "Atoms and rows in another order; another frame", "the same motion to 1e-11 after 1000 steps")
def order_and_frame(program: Program, quick: bool) -> Outcome:
    rng = np.random.default_rng(8)
    x = np.vstack([truths.rotated(WATER), truths.rotated(zigzag(6), 1) + np.array([2.5, 1.0, 0.0])])
    masses = np.concatenate([WATER_MASSES, rng.uniform(1, 16, 6)])
    pairs = np.array([*TRIANGLE, *[(k, k + 1) for k in range(3, 8)], (3, 5), (5, 7)])
    links = np.array([(0, 4), (1, 6), (2, 8), (3, 7)])

    def springs(numbers: Numbers) -> list[tuple[int, int, float, float]]:
        return [(int(numbers[i]), int(numbers[j]), 0.5, 0.9 * float(np.linalg.norm(x[i] - x[j]))) for i, j in links]

    plain = Problem(x, masses, [tuple(p) for p in pairs], springs=springs(np.arange(9)))
    plain, steps = plain.moving(0.1 * rng.standard_normal((9, 3))), program.length(quick, 300, 1000)
    v, end = plain.v, program.run(plain, 0.01, steps).x
    order = rng.permutation(9)
    new = np.argsort(order)
    flipped = new[pairs[rng.permutation(len(pairs))]][:, ::-1]
    shuffled = Problem(x[order], masses[order], flipped.tolist(), velocities=v[order], springs=springs(new))
    permuted = program.run(shuffled, 0.01, steps).x[new]
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    shift = np.array([3.0, -2.0, 1.0])
    turned = program.run(plain.but(positions=x @ turn + shift, velocities=v @ turn), 0.01, steps).x
    return outcome(
        ("another order", np.abs(permuted - end).max(), 1e-11),
        ("another frame", np.abs((turned - shift) @ turn.T - end).max(), 1e-11),
        remark=f"{steps} steps",
    )


@case("H32", "Saved at step 500 of 1000 and gone on with", "the same to the last bit")
def restart(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(zigzag(8))
    problem = Problem(x, np.linspace(1, 12, 8), bonds(8), np.ones(7), tether=0.3, anchors=0 * x)
    problem = problem.moving(0.1 * np.random.default_rng(0).standard_normal((8, 3)))
    half = program.length(quick, 200, 500)
    ways = {Core: _restart_core, PlainAse: _restart_ase, PlainOpenMM: _restart_openmm}
    ends = next(way for kind, way in ways.items() if isinstance(program, kind))(program, problem, half)
    return outcome(("difference", np.abs(ends[0] - ends[1]).max(), 0), remark=f"{2 * half} steps")


def _restart_core(program: Core, problem: Problem, half: int) -> tuple[Array, Array]:
    system = program.system(problem)
    start = system.initial_state(problem.x, problem.v, project=True)
    whole = run(system, start, 0.01, 2 * half)
    file = io.BytesIO()
    run(system, start, 0.01, half).save(file)
    file.seek(0)
    state = State.load(file)
    fresh = program.system(problem.but(positions=state.positions, lengths=problem.held_lengths, anchors=0 * problem.x))
    again = run(fresh, state, 0.01, half)
    return whole.positions, again.positions


def _restart_ase(program: PlainAse, problem: Problem, half: int) -> tuple[Array, Array]:
    atoms = program.atoms(problem, project=True)
    dynamics = program.dynamics(atoms, 0.01)
    dynamics.run(half)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "half.traj"
        write(path, atoms)
        other: Any = read(path)
    dynamics.run(half)
    other.calc = Forces(problem)
    if program.name == "ASE":
        # FixBondLengths does not keep its lengths in files.
        program.hold(other, problem.but(lengths=problem.held_lengths))
    program.dynamics(other, 0.01).run(half)
    return atoms.get_positions(), other.get_positions()


def _restart_openmm(program: PlainOpenMM, problem: Problem, half: int) -> tuple[Array, Array]:
    whole: Any = program.begin(problem, 0.01, True)
    whole.advance(half)
    system, integrator, _ = program.build(problem, 0.01)
    context = program.context(system, integrator)
    context.loadCheckpoint(whole.context.createCheckpoint())
    whole.advance(half)
    integrator.step(half)
    return whole.observe()[0], seen(context)[0]
