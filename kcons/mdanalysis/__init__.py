"""MDAnalysis: constraints from any topology it reads, conversions, checks of trajectories, and writing them.

Lengths are in angstrom, times in ps, masses in dalton, as everywhere in MDAnalysis.

- `loading`: files opened, with errors that name the remedy
- `topology`: constraints by its selection language
- `conversions`: Universe, `Atoms` and System, one into the other; `ag.convert_to("ASE")`
- `writing`: runs written to files
- `check`: how well a trajectory kept its constraints
"""

from kcons.errors import with_extra

try:
    from kcons.mdanalysis.check import CheckResult, ConstraintCheck, check_trajectory
    from kcons.mdanalysis.conversions import (
        ASEConverter,
        ase_to_openmm,
        from_ase,
        from_openmm,
        openmm_to_ase,
        to_ase,
        to_openmm,
        universe_of,
    )
    from kcons.mdanalysis.loading import load_trajectory, open_universe
    from kcons.mdanalysis.topology import constraints_of, selected, snapshot_of
    from kcons.mdanalysis.writing import (
        ASE_UNITS,
        OPENMM_UNITS,
        OpenMMReporter,
        RunUnits,
        TrajectoryWriter,
        write_ase,
    )
except ModuleNotFoundError as error:
    raise with_extra(error, "kcons.mdanalysis") from error

__all__ = [
    "ASE_UNITS",
    "OPENMM_UNITS",
    "ASEConverter",
    "CheckResult",
    "ConstraintCheck",
    "OpenMMReporter",
    "RunUnits",
    "TrajectoryWriter",
    "ase_to_openmm",
    "check_trajectory",
    "constraints_of",
    "from_ase",
    "from_openmm",
    "load_trajectory",
    "open_universe",
    "openmm_to_ase",
    "selected",
    "snapshot_of",
    "to_ase",
    "to_openmm",
    "universe_of",
    "write_ase",
]
