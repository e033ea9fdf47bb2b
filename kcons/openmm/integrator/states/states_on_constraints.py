"""States on constraints: minimised, given velocities of a temperature, and how many degrees of freedom they have."""

from __future__ import annotations

import openmm
from openmm import unit

from kcons.constraints.arguments import positive, whole_number
from kcons.openmm.ensembles.isokinetic_ensemble import kelvins
from kcons.openmm.integrator.guard import Guard
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.states.minimization import descend
from kcons.openmm.quantities import number


class StatesOnConstraints(openmm.Integrator):
    """What integrators that keep constraints do with a state besides making steps.

    Attributes
    ----------
    parts : tuple of Part
        What is held besides the constraints of the System.
    """

    parts: tuple[Part, ...] = ()

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        """The guard of the Context that this integrator belongs to."""
        raise NotImplementedError

    def setVelocitiesToTemperature(
        self, context: openmm.Context, temperature: unit.Quantity | float, seed: int | None = None
    ) -> None:
        """Draw velocities for a temperature (K if a float) and make them tangent to all constraints.

        Context.setVelocitiesToTemperature does it for the System's own constraints, to 1e-5 only.

        Raises
        ------
        InputError
            A temperature below zero, a seed that is none.
        """
        temperature = kelvins(temperature)
        self._watch(context)  # refuses before velocities are changed
        arguments = (temperature,) if seed is None else (temperature, whole_number(seed, "seed", -(2**31), 2**31 - 1))
        context.setVelocitiesToTemperature(*arguments)
        self.applyVelocityConstraints(context)

    def minimizeEnergy(
        self,
        context: openmm.Context | None = None,
        tolerance: unit.Quantity | float = 10.0,
        maxIterations: int = 0,
    ) -> None:
        """Minimise the energy with all constraints kept.

        Without parts this is OpenMM's LocalEnergyMinimizer, followed by `applyConstraints`; OpenMM's minimiser knows
        nothing of parts.

        Parameters
        ----------
        tolerance : Quantity or float
            Root mean square of the force components along the constraints, in kJ/mol/nm if a float.
        maxIterations : int
            0 for no limit.

        Raises
        ------
        InputError
            A tolerance that is not above zero, a number of iterations that is none.
        """
        context = self._watch(context).context
        tolerance = positive(number(tolerance, unit.kilojoule_per_mole / unit.nanometer, "tolerance"), "tolerance")
        maxIterations = whole_number(maxIterations, "maxIterations", 0)
        if self.parts:
            descend(self, context, tolerance, maxIterations)
        else:
            openmm.LocalEnergyMinimizer.minimize(context, tolerance, maxIterations)
            self.applyConstraints(context)

    def degrees_of_freedom(self, context: openmm.Context | None = None) -> int:
        """Three for each particle with a mass, less the rank of all constraints.

        Also less three where a CMMotionRemover keeps the centre of mass at rest. Found at the first call.
        """
        return self._watch(context).degrees_of_freedom()

    def independent_momenta(self, context: openmm.Context | None = None) -> int:
        """Three for each particle with a mass, less the rank of all constraints, whatever happens to total momentum."""
        return self._watch(context).independent_momenta()
