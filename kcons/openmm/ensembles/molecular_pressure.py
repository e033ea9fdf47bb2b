"""The pressure of a Context, from energies of a cell a little larger and smaller."""

from __future__ import annotations

from os import PathLike
from typing import IO, Any

import numpy as np
import openmm
from openmm import app, unit

from kcons.constraints.arguments import finite_number, positive, refuse_other, whole_number
from kcons.constraints.periodic.one_piece import make_whole, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.openmm.integrator.system_checks import virtual_sites
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, masses_of

#: kJ/mol/nm^3 in bar.
BAR = 16.6053906717


def molecular_pressure(
    context: openmm.Context, temperature: unit.Quantity | float | None = None, strain: float = 1e-3
) -> float:
    """Pressure in bar, of molecules as points: constraint forces within them have no part.

    The molecules are those that OpenMM's barostats move: joined by bonds and constraints of the System, and by the
    bonds of no strength that `kcons.openmm.hold` adds for its rows. The state of the Context is as it was afterwards,
    but for rounding of the energy's derivative in single precision.

    Parameters
    ----------
    context : openmm.Context
        Of a periodic System.
    temperature : Quantity or float, optional
        In K if a float, for N kT/V of the N molecules that have a mass, instead of the present kinetic energy of the
        centers: the same mean, with less noise.
    strain : float
        Change of all lengths.

    Raises
    ------
    InputError
        No Context; the System is not periodic; a temperature that is not positive, a strain that is none.
    NonFiniteError
        An energy is not finite.
    UnsupportedError
        Rows of a part hold several molecules together, or one in space.
    """
    thermal = None if temperature is None else GAS_CONSTANT * positive(kelvins(temperature), "temperature")
    if not 0 < finite_number(strain, "strain") < 1:
        raise InputError(f"strain is {strain}; give a small number above zero, such as 0.001", item="strain")
    refuse_other(context, openmm.Context, "context", "an openmm.Context, such as simulation.context")
    system = context.getSystem()
    if not system.usesPeriodicBoundaryConditions():
        raise InputError("a System without periodic boundaries has no pressure", item="context")
    state = context.getState(positions=True, velocities=True)
    x, v = (np.array(a._value) for a in (state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True)))
    box = np.array([row._value for row in state.getPeriodicBoxVectors()])
    volume = float(np.linalg.det(box))
    masses = masses_of(system)
    label = np.empty(len(x), dtype=np.int64)
    molecules = context.getMolecules()
    for number, members in enumerate(molecules):
        label[list(members)] = number
    n = len(molecules)
    cells = _cells_to_whole(system, x, box, label)
    # As OpenMM's barostats: the mean of positions, which sites without mass take part in.
    centers = _sums(x + cells @ box, label, n) / np.bincount(label, minlength=n)[:, None]
    # Atoms stay in the images that they are stored in.
    change = centers[label] - cells @ box
    energies = []
    groups = context.getIntegrator().getIntegrationForceGroups()
    try:
        for h in (strain, -strain):
            context.setPeriodicBoxVectors(*((1 + h) * box))
            context.setPositions(x + h * change)
            _require_on_rows(context)
            energies.append(context.getState(energy=True, groups=groups).getPotentialEnergy()._value)
    finally:
        context.setPeriodicBoxVectors(*box)
        context.setPositions(x)
    if not np.isfinite(energies).all():
        raise NonFiniteError(
            f"energies of a cell a little larger and smaller are {energies[0]} and {energies[1]}, which have no "
            "difference: particles overlap, or the Context has no positions yet",
            item="energy",
        )
    total = np.bincount(label, masses, n)
    heavy = total > 0
    if thermal is None:
        momenta = _sums(masses[:, None] * v, label, n)[heavy]
        kinetic = float(((momenta**2).sum(axis=1) / total[heavy]).sum())
    else:
        kinetic = 3 * int(heavy.sum()) * thermal
    slope = (energies[0] - energies[1]) / (2 * strain)
    return (kinetic - slope) / (3 * volume) * BAR


class PressureReporter:
    """Pressure and volume of a Simulation: ``simulation.reporters.append(PressureReporter(file, 100))``.

    Parameters
    ----------
    file : path or text file
    reportInterval : int
    temperature : Quantity or float, optional
        As for `molecular_pressure`.

    Attributes
    ----------
    values : list of float
        Pressures in bar.
    """

    def __init__(
        self,
        file: str | PathLike[str] | IO[str],
        reportInterval: int,
        temperature: unit.Quantity | float | None = None,
    ) -> None:
        self._interval = whole_number(reportInterval, "reportInterval")
        self._temperature = None if temperature is None else positive(kelvins(temperature), "temperature")
        self._own = isinstance(file, str | PathLike)
        self._file = open(file, "w") if isinstance(file, str | PathLike) else file  # noqa: SIM115
        print('#"Step","Box Volume (nm^3)","Pressure (bar)"', file=self._file)
        self.values: list[float] = []

    def __del__(self) -> None:
        if getattr(self, "_own", False):
            self._file.close()

    def describeNextReport(self, simulation: app.Simulation) -> dict[str, Any]:
        """As OpenMM asks."""
        steps = self._interval - simulation.currentStep % self._interval
        return {"steps": steps, "periodic": None, "include": []}

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """As OpenMM asks."""
        self.values.append(molecular_pressure(simulation.context, self._temperature))
        volume = state.getPeriodicBoxVolume()._value
        print(f"{simulation.currentStep},{volume:.6f},{self.values[-1]:.6g}", file=self._file, flush=True)


def _cells_to_whole(system: openmm.System, x: FloatArray, box: FloatArray, label: Any) -> FloatArray:
    """By how many cells atoms have to be moved so that molecules are in one piece, shape (n, 3)."""
    inverse = np.linalg.inv(box)
    share, n = x @ inverse, int(label.max()) + 1
    high, low = np.full((n, 3), -np.inf), np.full((n, 3), np.inf)
    np.maximum.at(high, label, share)
    np.minimum.at(low, label, share)
    if (high - low < 0.5).all():
        return np.zeros_like(x)
    bonds = [system.getConstraintParameters(k)[:2] for k in range(system.getNumConstraints())]
    for force in system.getForces():
        if isinstance(force, openmm.HarmonicBondForce | openmm.CustomBondForce):
            bonds += [force.getBondParameters(k)[:2] for k in range(force.getNumBonds())]
    bonds += [(k, system.getVirtualSite(k).getParticle(0)) for k in virtual_sites(system)]
    tree = spanning_tree(np.array(bonds, dtype=np.int64).reshape(-1, 2), len(x))
    return np.asarray(np.round((make_whole(x, *tree, np.stack([box, inverse])) - x) @ inverse))


def _require_on_rows(context: openmm.Context) -> None:
    """Refuse rows that molecules leave where they move as wholes."""
    for part in getattr(context.getIntegrator(), "parts", ()):
        miss = part.worst_violation(context, False)
        if miss is not None:
            raise UnsupportedError(
                f"molecules that move as wholes leave row {miss.name}: it holds several together, or one in space. Let "
                "those that a row joins count as one by hold(system, ..., join=True)"
            )


def _sums(values: FloatArray, label: Any, n: int) -> FloatArray:
    return np.stack([np.bincount(label, values[:, k], n) for k in range(3)], axis=1)
