"""What an integrator says of itself to parts, ensembles, checks and copies: all of them answer."""

from __future__ import annotations

import pytest
from openmm_systems import dumbbell, started

from kcons.constraints import Sphere
from kcons.openmm import ProjectedIntegrator, SurfaceIntegrator
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.steppers.splitting import Splitting

MADE = {
    "rattle": lambda: ProjectedIntegrator(0.001),
    "leapfrog": lambda: ProjectedIntegrator(0.001, "leapfrog"),
    "surface": lambda: SurfaceIntegrator(0.001, surfaces=Sphere([0], (0, 0, 0), 1.0), n_particles=2),
}


@pytest.mark.parametrize("kind", MADE)
def test_integrators_have_what_the_interface_says(kind):
    integrator = MADE[kind]()
    assert isinstance(integrator, Integrator)
    assert integrator.scheme is None if kind == "leapfrog" else isinstance(integrator.scheme, Splitting)
    assert all(isinstance(part, Part) for part in integrator.parts)
    assert len(integrator.parts) == (kind == "surface")
    assert isinstance(integrator.program, Program) and integrator.program.integrator is integrator
    assert isinstance(integrator.row_groups, frozenset)
    assert integrator.unseen is False and isinstance(integrator.spare, bool)
    for name in ("degrees_of_freedom", "applyConstraints", "applyVelocityConstraints"):
        assert callable(getattr(integrator, name))
    assert integrator.ensemble is not None and integrator.check_every >= 0


@pytest.mark.parametrize("kind", ["rattle", "leapfrog"])
def test_tolerances_left_open_follow_the_precision(kind):
    integrator = MADE[kind]()
    for name in ("single", "double"):
        precision = Precision("OpenCL", name)
        integrator.take_precision(precision)
        assert integrator.getConstraintTolerance() == precision.tolerance


def test_an_integrator_without_an_answer_says_so():
    with pytest.raises(NotImplementedError):
        Integrator(0.001).take_precision(Precision("CPU", "double"))


def test_the_interface_is_that_of_a_running_integrator():
    made = dumbbell()
    integrator = ProjectedIntegrator(0.001)
    context = started(made[0], integrator, made[1])
    integrator.step(1)
    assert isinstance(context.getIntegrator(), Integrator)
