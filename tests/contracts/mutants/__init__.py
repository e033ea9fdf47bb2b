"""Single lines of the package made wrong, and the tests that must notice.

An entry is (file in kcons/, its text, the wrong text, tests that must fail). The text occurs once in the file. Names of
tests are those that pytest takes, several parted by blanks; parameters in brackets are left out where any will do.
"""

from mutants import ase_dynamics, files, free_energies, models, openmm_programs, solvers, steppers, studies

MUTANTS = [
    *solvers.MUTANTS,
    *openmm_programs.MUTANTS,
    *models.MUTANTS,
    *steppers.MUTANTS,
    *files.MUTANTS,
    *studies.MUTANTS,
    *free_energies.MUTANTS,
    *ase_dynamics.MUTANTS,
]
