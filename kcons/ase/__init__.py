"""Constraints on ASE `Atoms`: one object that owns everything that is held.

ASE applies constraint objects one after another, and each undoes the work of the one before. `Constraints` holds the
whole set and solves it as one. Units are ASE's; targets are in angstrom and radian. Importing this package registers
the object with ASE, which makes files that contain it readable.

- `topology`, `translation`: constraints by name, rigid water, ASE's own constraints taken over
- `binding`, `constraints_object`: the object, whether the caller respects it, a calculator on the constraints
- `named_calculators`: calculators by name
- `dynamics`: dynamics with any stepper, and ASE's log with multipliers and the right temperature
- `thermostat_dynamics`: thermostats, barostats, the pressure along a run
"""

from kcons.errors import with_extra

try:
    from kcons.ase.constraints_object import (
        ConstrainedCalculator,
        Constraints,
        ConstraintsWithFixedAtoms,
        attach,
        constrain,
        to_ase_constraints,
    )
    from kcons.ase.dynamics import ConstrainedDynamics, ConstraintLogger
    from kcons.ase.thermostat_dynamics import (
        ConstrainedLangevin,
        ConstrainedMonteCarlo,
        ConstrainedNoseHoover,
        IsokineticDynamics,
        MultipleTimeSteps,
        PressureReporter,
        draw_velocities,
    )
    from kcons.ase.topology import constraints_of, repair_elements, repartition_hydrogen_mass, rigid_water
    from kcons.ase.translation import from_ase_constraints
except ModuleNotFoundError as error:
    raise with_extra(error, "kcons.ase") from error

__all__ = [
    "ConstrainedCalculator",
    "ConstrainedDynamics",
    "ConstrainedLangevin",
    "ConstrainedMonteCarlo",
    "ConstrainedNoseHoover",
    "ConstraintLogger",
    "Constraints",
    "ConstraintsWithFixedAtoms",
    "IsokineticDynamics",
    "MultipleTimeSteps",
    "PressureReporter",
    "attach",
    "constrain",
    "constraints_of",
    "draw_velocities",
    "from_ase_constraints",
    "repair_elements",
    "repartition_hydrogen_mass",
    "rigid_water",
    "to_ase_constraints",
]
