"""Every dynamics class of ASE with the constraint object: right, or a typed error."""

from __future__ import annotations

import ase.md
import ase.optimize
import numpy as np
import pytest
from ase.calculators.emt import EMT
from ase.md.andersen import Andersen
from ase.md.bussi import Bussi
from ase.md.contour_exploration import ContourExploration
from ase.md.langevin import Langevin
from ase.md.md import MolecularDynamics
from ase.md.nose_hoover_chain import MTKNPT, IsotropicMTKNPT, MaskedMTKNPT
from ase.md.nvtberendsen import NVTBerendsen
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import BFGS
from ase.optimize.optimize import Dynamics
from ase_systems import FS, TEMPERATURE, classes_in, dumbbells, ethanol, follow, mean_and_error, off, random, slip

#: Canonical classes whose mean temperature is right to their standard error.
CANONICAL = {
    "Langevin": lambda a: Langevin(a, 2 * FS, temperature_K=TEMPERATURE, friction=0.05 / FS, fixcm=False, rng=random()),
    "Bussi": lambda a: Bussi(a, 2 * FS, TEMPERATURE, 10 * FS, rng=random()),
    "NVTBerendsen": lambda a: NVTBerendsen(a, 2 * FS, TEMPERATURE, 50 * FS, fixcm=False),
}
#: Classes that do not go through the constraints: `tests/ase/test_binding.py` has what is said of them.
REFUSED = {"LangevinBAOAB", "NoseHooverChainNVT", "MelchionnaNPT", "NPT"}
#: Classes that refuse constraints themselves.
REFUSE_THEMSELVES = {cls.__name__: cls for cls in (IsotropicMTKNPT, MaskedMTKNPT, MTKNPT)}
#: Others, of which those that have no test here make their steps as one of those that have.
BY_NAME = {"VelocityVerlet", "NPTBerendsen", "Inhomogeneous_NPTBerendsen", "SwitchLangevin", "ContourExploration"}


def test_no_dynamics_class_is_forgotten():
    found = set(classes_in(ase.md, MolecularDynamics, Dynamics)) - {"MolecularDynamics"}
    assert found == set(CANONICAL) | REFUSED | set(REFUSE_THEMSELVES) | BY_NAME | {"Andersen"}


def test_velocity_verlet_has_no_energy_slope():
    atoms, _ = ethanol()
    BFGS(atoms, logfile=None).run(fmax=0.01)
    thermalize_momenta(atoms, 50, rng=random())  # EMT knows no molecules; hotter, they fall apart
    kinetic = atoms.get_kinetic_energy()
    energies = {}
    for dt, steps in ((0.5, 300), (0.25, 600)):
        run = atoms.copy()
        run.calc = EMT()
        energies[dt] = follow(VelocityVerlet(run, dt * FS), run.get_total_energy, steps)
        held = run.constraints[0]
        assert off(run, held) <= 1e-12 and slip(run, held) <= 1e-12
        drift = np.polyfit(np.linspace(0, 1, steps + 1), energies[dt], 1)[0]
        assert abs(drift) <= 2e-3 * kinetic
    # Fluctuations of second order in the time step.
    assert energies[0.5].std() / energies[0.25].std() == pytest.approx(4, rel=0.15)


@pytest.mark.parametrize("name", CANONICAL)
def test_temperature(name):
    atoms, held = dumbbells()
    seen = follow(CANONICAL[name](atoms), atoms.get_temperature, 1400)
    mean, error = mean_and_error(seen[200:])
    assert error < 6
    assert abs(mean - TEMPERATURE) <= 3 * error + (0.01 * TEMPERATURE if name == "NVTBerendsen" else 0)
    assert off(atoms, held) <= 1e-12 and slip(atoms, held) <= 1e-12


def test_andersen_that_draws_all_velocities_moves_no_atom_by_a_force():
    """Half a kick goes with the velocities that are drawn anew, the other half with those of the next step."""
    (free, held), (pulled, _) = dumbbells(2), dumbbells(2)
    pulled.calc = EMT()
    for atoms in (free, pulled):
        Andersen(atoms, 1 * FS, TEMPERATURE, 1.0, fixcm=False, rng=random()).run(20)
    assert np.abs(free.positions - pulled.positions).max() <= 1e-12 >= off(free, held)


def test_contour_exploration_keeps_lengths():
    atoms, held = ethanol()
    thermalize_momenta(atoms, TEMPERATURE, rng=random())
    ContourExploration(atoms, maxstep=0.05, rng=np.random.RandomState(0)).run(50)
    assert off(atoms, held) <= 1e-12


@pytest.mark.parametrize("name", REFUSE_THEMSELVES)
def test_classes_that_refuse_constraints_themselves(name):
    atoms, _ = dumbbells(4)
    with pytest.raises(NotImplementedError, match="does not support constraints"):
        more = {"mask": (1, 1, 1)} if name == "MaskedMTKNPT" else {}
        REFUSE_THEMSELVES[name](atoms, FS, TEMPERATURE, 0.0, 100 * FS, 1000 * FS, **more)
