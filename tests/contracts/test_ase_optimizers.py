"""Every optimizer of ASE with the constraint object: right, or a typed error."""

from __future__ import annotations

import ase.md
import ase.optimize
import numpy as np
import pytest
from ase import units
from ase.build import bulk, molecule
from ase.calculators.emt import EMT
from ase.filters import FrechetCellFilter
from ase.optimize import CellAwareBFGS
from ase.optimize.optimize import Dynamics
from ase_systems import classes_in, ethanol, off, random

from kcons.ase import constrain
from kcons.constraints import Distance
from kcons.errors import ConvergenceError

PLAIN = {
    "BFGS", "BFGSLineSearch", "FIRE", "FIRE2", "GPMin", "GoodOldQuasiNewton", "LBFGS", "LBFGSLineSearch", "MDMin",
    "ODE12r", "RFO", "SciPyFminBFGS", "SciPyFminCG",
}  # fmt: skip
PRECONDITIONED = {"PreconFIRE", "PreconLBFGS", "PreconODE12r"}
GRADIENTLESS = {"SciPyFmin", "SciPyFminPowell"}
ABSTRACT = {"Dynamics", "Optimizer", "SciPyOptimizer", "SciPyGradientlessOptimizer"}
OTHER = {"BasinHopping", "BFGSClimbFixInternals", "CellAwareBFGS", "oldBFGS"}
OPTIMISERS = classes_in(ase.optimize, Dynamics)


def test_no_optimizer_is_forgotten():
    assert set(OPTIMISERS) == PLAIN | PRECONDITIONED | GRADIENTLESS | ABSTRACT | OTHER


@pytest.mark.parametrize("name", sorted(PLAIN | PRECONDITIONED))
def test_optimizer(name):
    atoms, held = ethanol()
    if name == "GPMin":  # slow
        atoms = molecule("H2O")
        atoms.rattle(0.1, rng=random())
        atoms.calc = EMT()
        held = constrain(atoms, Distance([[0, 1], [0, 2]]))
    start = atoms.get_potential_energy()
    options = {"precon": None} if name in PRECONDITIONED else {}  # ASE's preconditioners know FixAtoms only
    assert OPTIMISERS[name](atoms, logfile=None, **options).run(fmax=0.05, steps=300)
    assert np.linalg.norm(atoms.get_forces(), axis=1).max() <= 0.05
    assert atoms.get_potential_energy() < start - (0.01 if name == "GPMin" else 1.1)
    assert off(atoms, held) <= 1e-12


def test_powell_steps_too_far():
    # Its trial points are far from each other, too far to follow the rows from one to the next.
    atoms = molecule("H2O")
    atoms.calc = EMT()
    held = constrain(atoms, Distance([[0, 1], [0, 2]]))
    with pytest.raises(ConvergenceError, match="too large for this geometry") as caught:
        OPTIMISERS["SciPyFminPowell"](atoms, logfile=None).run(ftol=1e-4, xtol=1e-4, steps=60)
    assert any("smaller timestep" in note for note in caught.value.__notes__)
    assert off(atoms, held) <= 1e-12


def test_basin_hopping():
    atoms, held = ethanol()
    start = atoms.get_potential_energy()
    quiet = dict.fromkeys(("logfile", "trajectory", "optimizer_logfile", "local_minima_trajectory"))
    hop = OPTIMISERS["BasinHopping"](atoms, temperature=300 * units.kB, dr=0.1, **quiet)
    hop.run(3)
    assert hop.get_minimum()[0] < start - 1.1
    assert off(atoms, held) <= 1e-12


@pytest.mark.filterwarnings("ignore:logm result")
def test_cell_relaxation():
    atoms = bulk("Cu", cubic=True) * 2
    atoms.set_cell(np.diag([7.2, 7.22, 7.25]), scale_atoms=True)
    atoms.rattle(0.02, rng=random())
    atoms.calc = EMT()
    held = constrain(atoms, Distance([[0, 1], [4, 5]], [2.5, 2.5]), project=True)
    optimizer = CellAwareBFGS(FrechetCellFilter(atoms, exp_cell_factor=1.0), logfile=None, long_output=False)
    assert optimizer.run(fmax=0.05, smax=0.001, steps=200)
    assert np.abs(atoms.get_forces()).max() <= 0.05
    assert np.abs(atoms.get_stress()).max() <= 0.003
    assert off(atoms, held) <= 1e-12
