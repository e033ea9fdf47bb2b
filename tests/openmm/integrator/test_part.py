"""What parts have in common, and how a row that is off is named."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm_parts import HeldCoordinates

from kcons.openmm.integrator.part import Miss, Part
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.step_writer import StepWriter


def worst(off, allowed, near=0.0):
    return Miss.worst("positions", np.array(off), allowed, lambda k: f"row {k}", lambda k: [k, k + 1], near)


def test_the_worst_is_relative_to_what_is_allowed():
    miss = worst([1e-3, -2e-3, 1e-9], [1e-4, 1e-3, 1e-8])
    assert (miss.row, miss.off, miss.allowed, miss.atoms) == (0, 1e-3, 1e-4, [0, 1])
    assert worst([1e-3, 2e-3], 1e-2) is None
    assert worst([1e-3, np.nan], 1e-9).row == 1


def test_near_are_only_rows_of_which_all_are():
    assert worst([1e-3, 2e-3], 1e-6, 0.01).near
    assert not worst([1e-3, 2e-2], 1e-6, 0.01).near
    assert not worst([1e-3, np.nan], 1e-6, 0.01).near


def test_a_part_needs_what_every_part_has():
    class Without(Part):
        pass

    with pytest.raises(TypeError, match="abstract"):
        Without()


def test_what_a_part_does_not_have_writes_nothing():
    program = Program(integrator := openmm.CustomIntegrator(1e-3))
    part = HeldCoordinates([0], 0, 0.0, 1)
    for method in (part.begin, part.begin_early, part.renew, part.passed):
        method(program)
    part.begin_run()
    assert program.operations == []
    assert integrator.getNumComputations() == 0
    assert part.engine_at(None) is None
    assert not part.driven
    assert not part.steered


def test_hooks_are_called_where_they_belong():
    class Telling(HeldCoordinates):
        def begin(self, program):
            program.let("stage", "7", "begin")

        def begin_early(self, program):
            program.let("stage", "8", "early")

    from kcons.openmm import ProjectedIntegrator

    integrator = ProjectedIntegrator(1e-3, "suzuki4", parts=[Telling([0], 0, 0.0, 2, evaluates=True)])
    lines = integrator.listing().splitlines()
    begin = next(k for k, line in enumerate(lines) if line.endswith("# begin"))
    assert "if moved+stale != 0:" in "".join(lines[begin - 4 : begin])
    assert not any(line.endswith("# early") for line in lines)
    assert isinstance(integrator._plan, StepWriter)
