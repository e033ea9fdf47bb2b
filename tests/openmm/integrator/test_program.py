"""Programs and their listings."""

from __future__ import annotations

import openmm
from openmm_systems import context_of, holding, state_of

from kcons.openmm import ProjectedIntegrator
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import SCHEMES


def test_computations_and_listing_go_together():
    integrator = openmm.CustomIntegrator(0.5)
    p = Program(integrator)
    assert p.number("k", "stiffness", 2.0) == "k"
    p.number("k", "declared twice is declared once", 3.0)
    p.vector("old", "positions before")
    p.table("share", [0.25, 0.75], "parts of the step")
    p.number("stage", "number of the stage")
    p.number("total", "sum of x")
    p.each("old", "x", "remember")
    with p.loop("stage < 2", "both stages"):
        p.each("x", "x+share(stage)*dt*v", "fly")
        p.let("stage", "stage+1", "next")
    with p.when("k = 2", "always"):
        p.sum("total", "x-old", "how far")
    p.let_others_act()
    p.hold_positions("nothing to hold")
    p.hold_velocities("nothing to hold")
    assert p.integrator is integrator
    assert p.listing().splitlines() == [
        "variables",
        "  x, v, m, f, dt: positions, velocities, masses, applied forces, time step",
        "  k: stiffness",
        "  old: positions before (each degree of freedom)",
        "  share(k): parts of the step",
        "  stage: number of the stage",
        "  total: sum of x",
        "each step",
        "  old = x                      # remember",
        "  while stage < 2:             # both stages",
        "      x = x+share(stage)*dt*v  # fly",
        "      stage = stage+1          # next",
        "  if k = 2:                    # always",
        "      total = sum(x-old)       # how far",
        "  update context state         # barostats and other outside agents may act",
        "  constrain positions          # nothing to hold",
        "  constrain velocities         # nothing to hold",
    ]
    system = openmm.System()
    system.addParticle(1.0)
    context = context_of(system, integrator)
    context.setPositions([[0, 0, 0]])
    context.setVelocities([[1, 2, 3]])
    integrator.step(1)
    assert state_of(context)[0].tolist() == [[0.5, 1.0, 1.5]]
    assert integrator.getGlobalVariableByName("total") == 3.0


def test_listing_is_complete():
    """Every computation of an integrator has a line, in order; blocks are indented."""
    for scheme in (*SCHEMES, "leapfrog"):
        for parts in ((), (holding(evaluates=True),)):
            integrator = ProjectedIntegrator(1e-3, scheme, parts=parts)
            text = integrator.listing()
            assert str(integrator).endswith(text)
            steps = text.split("each step\n")[1].splitlines()
            kinds = [integrator.getComputationStep(k) for k in range(integrator.getNumComputations())]
            written = [k for k in kinds if k[0] != openmm.CustomIntegrator.BlockEnd]
            assert len(steps) == len(written)
            for line, (_, variable, expression) in zip(steps, written, strict=True):
                assert "#" in line
                assert variable in line
                assert expression in line


def test_a_block_in_which_nothing_is_written_is_none():
    program = Program(integrator := openmm.CustomIntegrator(1e-3))
    program.number("a", "a number")
    with program.when("a = 0", "nothing"), program.loop("a = 1", "nothing within"):
        pass
    assert program.operations == []
    with program.when("a = 0", "outer"):
        with program.when("a = 1", "empty"):
            pass
        with program.when("a = 2", "inner"):
            program.let("a", "3", "something")
        program.let("a", "4", "more")
    assert [o[0] for o in program.operations] == ["when", "when", "let", "end", "let", "end"]
    assert integrator.getNumComputations() == 6
    lines = program.listing().split("each step\n")[1].splitlines()
    assert [len(line) - len(line.lstrip()) for line in lines] == [2, 6, 10, 6]
