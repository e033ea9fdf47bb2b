"""The list of variables that say where a step is, and the programs that use them."""

from __future__ import annotations

import openmm
import pytest
from openmm_parts import HeldCoordinates

from kcons.constraints import Sphere
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator, SurfaceIntegrator
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.step_variables import VARIABLES, use


def test_declared_as_the_list_says():
    integrator = openmm.CustomIntegrator(1e-3)
    program = Program(integrator)
    assert use(program, "failed", "stale", "xu") == "xu"
    use(program, "end_stage", value=3)
    assert program.numbers == {"failed": 0.0, "stale": 1.0, "end_stage": 3.0}
    assert program.idle == {"failed": 0.0}
    assert program.settings == {"end_stage": 3.0}
    assert program.vectors == {"xu"}
    with pytest.raises(KeyError):
        use(program, "unheard")


def integrators():
    held = lambda **k: HeldCoordinates([0], 0, 0.0, 2, **k)  # noqa: E731
    yield ProjectedIntegrator(1e-3)
    yield ProjectedIntegrator(1e-3, "leapfrog")
    yield ProjectedIntegrator(1e-3, "blanes-moan6")
    yield ProjectedIntegrator(1e-3, parts=[held()])
    yield ProjectedIntegrator(1e-3, "suzuki4", parts=[held(evaluates=True)])
    yield ProjectedIntegrator(1e-3, ensemble=Isokinetic(300))
    yield ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0))
    yield SurfaceIntegrator(1e-3, surfaces=Sphere([0], (0, 0, 0), 1.0), n_particles=2)
    yield SurfaceIntegrator(1e-3, "suzuki4", surfaces=Sphere([0], (0, 0, 0), 1.0), n_particles=2)


def test_every_variable_of_the_list_is_used_by_some_program():
    used = set()
    for integrator in integrators():
        used |= set(integrator.program.numbers) | integrator.program.vectors
    assert set(VARIABLES) <= used


def test_controls_are_idle_between_calls():
    for integrator in integrators():
        for name in integrator.program.idle:
            assert integrator.getGlobalVariableByName(name) == VARIABLES[name].value
