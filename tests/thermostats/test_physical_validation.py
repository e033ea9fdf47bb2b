"""Langevin and Nosé-Hoover on rigid water and on chains in ASE, judged by the package physical_validation."""

from __future__ import annotations

import warnings

import fluids
import numpy as np
import pytest
from ase import Atoms, units

from kcons.ase import ConstrainedLangevin, ConstrainedNoseHoover, constrain, draw_velocities
from kcons.comparison import Potential, PotentialCalculator
from kcons.constraints import Distance

pv = pytest.importorskip("physical_validation")


def water():
    """27 TIP3P molecules at 0.9 g/cm3, smooth cutoff at half the box; 3 atoms a molecule, 3 rows."""
    chosen = fluids.water(27, seed=5)
    atoms = Atoms(chosen.symbols, positions=chosen.positions, masses=chosen.forces.masses)
    return _ready(atoms, chosen.forces, 3), 3, 3


def chains():
    """Six freely jointed chains of six argon-like beads; 5 rows each."""
    n, box = 6, 13.0
    rng = np.random.default_rng(6)
    x = []
    for k in range(n):
        bend = np.cumsum(np.c_[np.full(6, 1.3), 0.75 * (-1.0) ** np.arange(6), 0.1 * rng.normal(size=6)], axis=0)
        x.append(bend + np.array([0, (k % 3) * box / 3, (k // 3) * box / 2]))
    atoms = Atoms("C" * 6 * n, positions=np.concatenate(x))
    forces = fluids.LennardJones(np.repeat(range(n), 6), box, masses=atoms.get_masses(), epsilon=0.006, sigma=3.6)
    return _ready(atoms, forces, 6), 6, 5


def _ready(atoms, forces, size):
    atoms.calc = PotentialCalculator(Potential(forces.evaluate, "Lennard-Jones"))
    first = np.arange(0, len(atoms), size)
    along = [np.c_[first + k, first + k + 1] for k in range(size - 1)]
    constrain(atoms, Distance(fluids.triangles(len(first)) if size == 3 else np.concatenate(along)))
    return atoms


MOLECULES = {"rigid water": water, "chains": chains}
TEMPERATURES = {"rigid water": (400.0, 425.0), "chains": (300.0, 370.0)}


def dynamics(kind, atoms, step, temperature):
    if kind == "Langevin":
        return ConstrainedLangevin(atoms, step, temperature, 5e-3 / units.fs, rng=9, substeps=1)
    return ConstrainedNoseHoover(atoms, step, temperature, 50 * units.fs, momentum="conserved")


def thermal_run(name, kind, temperature, steps):
    """Kinetic and potential energies in eV, every 100 fs."""
    atoms, _, _ = MOLECULES[name]()
    draw_velocities(atoms, temperature, 8, zero_momentum=True)
    with warnings.catch_warnings(action="ignore"):
        moving = dynamics(kind, atoms, 2 * units.fs, temperature)
    moving.run(10_000)
    series = []
    # With noise the kinetic energy is that of the middle of a step: velocities at its ends underestimate fast motions.
    moving.attach(lambda: series.append((moving.get_kinetic_energy(), atoms.get_potential_energy())), interval=50)
    moving.run(steps)
    kinetic, potential = np.transpose(series)
    return kinetic, potential


def ase_units():
    return pv.data.UnitData(
        kb=units.kB,
        energy_str="eV",
        energy_conversion=96.48533,
        length_str="A",
        length_conversion=0.1,
        volume_str="A^3",
        volume_conversion=1e-3,
        temperature_str="K",
        temperature_conversion=1,
        pressure_str="eV/A^3",
        pressure_conversion=1.602177e6,
        time_str="fs",
        time_conversion=1e-3,
    )


def judged(name, kind, steps):
    """p of the kinetic energy, and standard errors of the ensembles at two temperatures."""
    atoms, size, rows = MOLECULES[name]()
    n = len(atoms) // size
    unit = ase_units()
    momentum = 0 if kind == "Langevin" else 3
    system = pv.data.SystemData(
        natoms=len(atoms),
        nconstraints=rows * n,
        ndof_reduction_tra=momentum,
        ndof_reduction_rot=0,
        mass=atoms.get_masses(),
        molecule_idx=size * np.arange(n),
        nconstraints_per_molecule=np.full(n, rows),
    )

    def data(temperature):
        kinetic, potential = thermal_run(name, kind, temperature, steps)
        ensemble = pv.data.EnsembleData("NVT", natoms=len(atoms), volume=1000.0, temperature=temperature)
        seen = pv.data.ObservableData(kinetic_energy=kinetic, potential_energy=potential)
        return pv.data.SimulationData(units=unit, system=system, ensemble=ensemble, observables=seen)

    cold, warm = (data(temperature) for temperature in TEMPERATURES[name])
    kinetic = [float(pv.kinetic_energy.distribution(d, strict=True, verbosity=0)) for d in (cold, warm)]
    return kinetic, [float(s) for s in pv.ensemble.check(cold, warm, verbosity=0)]


@pytest.mark.validation
@pytest.mark.filterwarnings("default")  # those of the package and of what it imports
@pytest.mark.parametrize("thermostat", ["Langevin", "Nose-Hoover"])
@pytest.mark.parametrize("system", MOLECULES)
def test_ensembles(system, thermostat):
    """Pass marks: 1e-3 for p, and 3.5 standard errors."""
    kinetic, ensemble = judged(system, thermostat, 100_000)
    assert min(kinetic) >= 1e-3 and max(ensemble) <= 3.5
