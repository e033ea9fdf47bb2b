"""Isokinetic spheres in OpenMM: velocities of each molecule on spheres of their own, for long time steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import openmm
from openmm import unit

from kcons.constraints.arguments import positive
from kcons.errors import UnsupportedError
from kcons.openmm.ensembles.langevin_ensemble import by_group, refuse_other_groups
from kcons.openmm.integrator.program import Ensemble, Integrator, Program
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, number
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting
from kcons.thermostats import IsokineticSpheres as OnArrays


class IsokineticSpheres(Ensemble):
    """Canonical configurations at long steps, for ``ProjectedIntegrator(timestep, ensemble=..., device=True)``.

    The bath of `kcons.thermostats.IsokineticSpheres`: velocities of each cluster of atoms that constraints join stay on
    spheres, together with auxiliary variables, so that no resonance of slow forces heats it. Dynamics are lost:
    transport and relaxation times mean nothing.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float.
    friction : Quantity or float
        In 1/ps if a float, above 0: the rate at which the bath forgets.
    steps : mapping of int to int, optional
        Steps of each force group in a step of the integrator, as for `LangevinRespa`.
    spheres : {'split', 'axes', 'cluster'}
        'split': one sphere for the center of mass of each cluster and one for the motion about it; 'axes': one for each
        of x, y and z of the center of mass; 'cluster': one for each cluster.
    auxiliary : int
        Auxiliary variables on each sphere.
    substeps, slow_kicks
        As for `kcons.thermostats.IsokineticSpheres`.

    Raises
    ------
    InputError
        Temperature or friction not positive, unknown words, a sphere of radius 0.
    UnsupportedError
        Without ``device=True``: no program of a CustomIntegrator has sums over molecules.

    Notes
    -----
    The kinetic energy says nothing of the temperature; `computeSystemTemperature` takes that into account.

    References
    ----------
    Leimkuhler, Margul and Tuckerman, Mol. Phys. 111, 3579 (2013).
    """

    temperature: float
    friction: float
    spheres: Literal["split", "axes", "cluster"]
    auxiliary: int
    steps: tuple[tuple[int, int], ...] | None

    def __init__(
        self,
        temperature: unit.Quantity | float,
        friction: unit.Quantity | float,
        steps: Mapping[int, int] | None = None,
        *,
        spheres: Literal["split", "axes", "cluster"] = "split",
        auxiliary: int = 1,
        substeps: int = 3,
        slow_kicks: Literal["ends", "middle"] = "ends",
    ) -> None:
        if spheres == "global":
            raise UnsupportedError(
                "spheres='global' needs sums over all particles; choose 'split', 'axes' or 'cluster'"
            )
        self._keep(
            temperature=positive(kelvins(temperature), "temperature"),
            friction=number(friction, unit.picosecond**-1, "friction"),
            steps=None if steps is None else tuple(by_group(steps).items()),
            spheres=spheres,
            auxiliary=auxiliary,
            substeps=substeps,
            slow_kicks=slow_kicks,
        )
        self._on_arrays()

    def _on_arrays(self) -> OnArrays:
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if name != "temperature"}
        if given["steps"] is not None:
            given["steps"] = {str(group): count for group, count in given["steps"]}
        return OnArrays(1.0, given.pop("friction"), 0, **given)

    def __repr__(self) -> str:
        return f"IsokineticSpheres({self.temperature:g} K, {self.friction:g}/ps, spheres={self.spheres!r})"

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for all schemes but 'rattle': the bath has its own."""
        if scheme.kicks != (0.5, 0.5) or scheme.drifts != (1.0,):
            raise UnsupportedError(f"{self!r} has a scheme of its own; leave out {scheme!r}")

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        return self._on_arrays().operations()

    def declare(self, p: Program) -> None:
        kT, friction = self.settings().values()
        p.setting("kT", "Boltzmann's constant times the temperature, kJ/mol", kT)
        p.setting("friction", "1/ps", friction)

    def write(self, p: Program) -> None:
        """No program: kernels have the spheres."""
        if not p.on_device:
            raise UnsupportedError(f"{self!r} is made by kernels: give device=True, or take LangevinRespa")

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """Refuse targets that move, and forces of groups without a number of steps."""
        if any(part.driven for part in integrator.parts):
            raise UnsupportedError(f"{self!r} needs constant targets; use Langevin")
        self.verify(integrator)

    def verify(self, integrator: Integrator) -> None:
        """Refuse forces that got another group in the run."""
        if self.steps is not None:
            refuse_other_groups(integrator, integrator.context, self.steps)

    def warmth(self, integrator: Integrator) -> float:
        integrator.read("seed")  # makes the kernels if there are none yet
        return float(integrator.degrees_of_freedom() / integrator.rows.warm)

    def settings(self) -> dict[str, float]:
        return {"kT": GAS_CONSTANT * self.temperature, "friction": self.friction}
