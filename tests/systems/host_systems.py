"""Systems from files, for the tests of topologies."""

from __future__ import annotations

import warnings
from pathlib import Path

from openmm import app

DATA = Path(__file__).resolve().parents[1] / "data"
VILLIN = Path(app.__file__).parent / "data" / "test.pdb"
ALANINE = DATA / "alanine-dipeptide-implicit.pdb"
DHFR = DATA / "5dfr_minimized.pdb"


def read_universe(*files):
    """MDAnalysis says much about files that is of no concern here."""
    import MDAnalysis

    with warnings.catch_warnings(action="ignore"):
        return MDAnalysis.Universe(*(str(f) for f in files))


def read_atoms(file):
    import ase.io

    return ase.io.read(file)


def quietly(function, *arguments, **options):
    """Without the warnings about guessed bonds and elements, which tests of their own look at."""
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return function(*arguments, **options)
