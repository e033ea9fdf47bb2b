"""Programs as data, their listings, schemes by name, and the variables of steps."""

from __future__ import annotations

import re

import openmm
import pytest
from openmm_systems import holding
from tied_cluster import KINDS

from kcons import thermostats
from kcons.errors import InputError
from kcons.openmm import Langevin, ProjectedIntegrator
from kcons.openmm.integrator.program import SCHEMES, VARIABLES, to_scheme
from kcons.steppers import Geodesic, Rattle


@pytest.mark.parametrize("kind", KINDS)
def test_listings_are_complete(kind):
    """Every computation of an integrator has a line, in order; blocks are indented."""
    integrator = KINDS[kind]().integrator
    text = integrator.listing()
    assert str(integrator).endswith(text)
    lines, depth, kinds = iter(text.split("each step\n")[1].splitlines()), 0, openmm.CustomIntegrator
    for k in range(integrator.getNumComputations()):
        kind, variable, expression = integrator.getComputationStep(k)
        if kind == kinds.BlockEnd:
            depth -= 1
            continue
        line = next(lines)
        assert len(line) - len(line.lstrip()) == 2 + 4 * depth
        assert "#" in line and variable in line and expression in line
        depth += kind in (kinds.IfBlockStart, kinds.WhileBlockStart)
    assert next(lines, None) is None


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
