"""Programs as data, their listings, schemes by name, and the variables of steps."""

from __future__ import annotations

import re

import openmm
import pytest
from openmm_systems import context_of, holding, state_of
from tied_cluster import KINDS

from kcons import thermostats
from kcons.errors import InputError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator
from kcons.openmm.integrator.program import (
    SCHEMES,
    VARIABLES,
    ConstantEnergy,
    Program,
    forces_at_old_positions,
    to_scheme,
)
from kcons.steppers import Geodesic, Rattle


def test_computations_and_listing_go_together():
    integrator = openmm.CustomIntegrator(0.5)
    p = Program(integrator, Rattle(), (), ConstantEnergy())
    p.number("k", "stiffness", 2.0)
    p.number("k", "declared twice is declared once", 3.0)
    p.vector("old", "positions before")
    p.table("share", [0.25, 0.75], "parts of the step")
    p.number("stage", "number of the stage")
    p.each("old", "x", "remember")
    with p.loop("stage < 2", "both stages"):
        p.each("x", "x+share(stage)*dt*v", "fly")
        p.let("stage", "stage+1", "next")
        with p.when("k = 1", "in which nothing is written"):
            pass
    with p.when("k = 2", "always"):
        p.sum("total", "v*(x-old)", "how far")
    p.let_others_act()
    p.hold_positions("nothing to hold")
    p.hold_velocities("nothing to hold")
    p.hand_over()
    assert p.listing().splitlines() == [
        "variables",
        "  x, v, m, f, dt: positions, velocities, masses, applied forces, time step",
        "  k: stiffness",
        "  old: positions before (each degree of freedom)",
        "  share(k): parts of the step",
        "  stage: number of the stage",
        "each step",
        "  old = x                      # remember",
        "  while stage < 2:             # both stages",
        "      x = x+share(stage)*dt*v  # fly",
        "      stage = stage+1          # next",
        "  if k = 2:                    # always",
        "      total = sum(v*(x-old))   # how far",
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
    assert integrator.getGlobalVariableByName("total") == 0.5 * (1 + 4 + 9)


@pytest.mark.parametrize("kind", KINDS)
def test_listings_are_complete(kind):
    """Every computation of an integrator has a line, in order; blocks are indented."""
    integrator = KINDS[kind]().integrator
    text = integrator.listing()
    assert str(integrator).endswith(text)
    steps = text.split("each step\n")[1].splitlines()
    made = [integrator.getComputationStep(k) for k in range(integrator.getNumComputations())]
    written = [k for k in made if k[0] != openmm.CustomIntegrator.BlockEnd]
    assert len(steps) == len(written)
    for line, (_, variable, expression) in zip(steps, written, strict=True):
        assert "#" in line and variable in line and expression in line


def test_every_variable_of_the_list_is_used_and_controls_are_idle_between_calls():
    used = set()
    more = [ProjectedIntegrator(1e-3, "blanes-moan6"), ProjectedIntegrator(1e-3, "suzuki4", parts=[holding()])]
    kept = [make() for make in KINDS.values()]
    for integrator in (*(made.integrator for made in kept), *more):
        used |= set(integrator.program.numbers) | set(integrator.program.vectors)
        for name, value in integrator.program.idle.items():
            assert integrator.getGlobalVariableByName(name) == value
    assert set(VARIABLES) <= used | {"phase"}


def ways(program):
    """Through its blocks, each left out or gone through once: what OpenMM lists when a Context is first used.

    Blocks that neither need forces nor change positions it passes over.
    """
    outer, here, counts = [], 1, False
    for kind, variable, expression, _ in program.lines:
        if kind in ("when", "loop"):
            outer.append((here, counts))
            here, counts = 1, False
        elif kind == "end":
            before, also = outer.pop()
            here, counts = before * (1 + here if counts else here), counts or also
        else:
            counts = counts or kind == "others" or variable == "x" or bool(re.search(r"\b(f|energy)\d*\b", expression))
    return here


@pytest.mark.parametrize(("kind", "most"), [("collective", 603), ("carried", 601), ("Langevin", 161)])
def test_few_ways_through_the_program(kind, most):
    """The set-up of a Context takes time for each."""
    assert ways(KINDS[kind]().integrator.program) <= most


def test_forces_at_old_positions_are_seen():
    """GPUs keep what a computation makes of x as a difference, until constraints are applied to positions."""

    def written(*lines):
        p = Program(openmm.CustomIntegrator(1e-3), Rattle(), (), ConstantEnergy())
        for line in lines:
            p.hold_positions("hold") if line == "hold" else p.each(*line, "words")
        return p.lines

    assert forces_at_old_positions(written(("x", "x+v"), ("v", "f3"), "hold"))
    assert not forces_at_old_positions(written(("x", "x+v"), "hold", ("v", "f3")))
    assert not forces_at_old_positions(written(("x", "x+v"), ("v", "f3")))
    assert not forces_at_old_positions(written(("v", "f3"), ("x", "x+v"), "hold"))


# -- schemes ----------------------------------------------------------------------------------------


def test_names_of_schemes():
    assert isinstance(to_scheme("rattle"), Rattle)
    own = Rattle()
    assert to_scheme(own) is own
    for wrong in ("verlet", ["rattle"]):
        with pytest.raises(InputError, match="known: rattle, geodesic"):
            to_scheme(wrong)
    by_name, by_object = ProjectedIntegrator(1e-3, "geodesic"), ProjectedIntegrator(1e-3, Geodesic(8))
    assert by_name.program.lines == by_object.program.lines
    assert by_name.program.tables == by_object.program.tables
    assert "Geodesic(substeps=3)" in repr(ProjectedIntegrator(1e-3, Geodesic(3)))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_steps_are_those_of_the_steppers_on_arrays(scheme):
    integrator = ProjectedIntegrator(1e-3, scheme)
    assert integrator.operations() == SCHEMES[scheme]().operations()
    for operation in integrator.operations():
        assert str(operation) in integrator.listing()


def test_thermostats_are_those_on_arrays():
    langevin = ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)).operations()
    assert langevin == thermostats.Langevin(1.0, 1.0, 1, substeps=1).operations()
    for order, scheme in ((2, "rattle"), (4, "isokinetic4"), (6, "isokinetic6")):
        isokinetic = ProjectedIntegrator(1e-3, scheme, ensemble=Isokinetic(300)).operations()
        assert isokinetic == thermostats.Isokinetic(1.0, order=order).operations()
