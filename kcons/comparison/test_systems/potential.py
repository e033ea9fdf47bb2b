"""Energies and forces of a test system, the same for every method that runs it.

A `Potential` remembers its last point, so that an MD engine asking twice pays once, and counts what it evaluates.
`PotentialCalculator` hands it to ASE.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from ase import Atoms
from ase.calculators import calculator as of_ase

from kcons.constraints.target import FloatArray
from kcons.errors import CalculatorError, InputError

Evaluate = Callable[[FloatArray], tuple[float, FloatArray]]
#: Name of the potential of systems on which no forces act.
NO_FORCES = "no forces"


class Potential:
    """Energy and forces as a function of the positions.

    Parameters
    ----------
    evaluate : callable
        Positions, shape (n_atoms, 3), to (energy, forces of the same shape).
    name : str
        What it is, for the report.

    Attributes
    ----------
    evaluations : int
        Points evaluated so far.
    """

    def __init__(self, evaluate: Evaluate, name: str) -> None:
        self._evaluate = evaluate
        self.name = name
        self.evaluations = 0
        self._last: tuple[FloatArray, float, FloatArray] | None = None

    def forces(self, x: FloatArray, time: float = 0.0) -> FloatArray:
        """Forces at `x`, shape (n_atoms, 3); a copy."""
        return self._known(x)[2].copy()

    def energy(self, x: FloatArray, time: float = 0.0) -> float:
        """Potential energy at `x`."""
        return self._known(x)[1]

    def watched(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy and forces at `x` for an onlooker: neither counted nor remembered."""
        if self._last is not None and np.array_equal(self._last[0], x):
            return self._last[1], self._last[2].copy()
        return self._evaluated(x)

    def forget(self) -> None:
        """Start counting anew; the next point is evaluated whatever it is."""
        self._last = None
        self.evaluations = 0

    def _known(self, x: FloatArray) -> tuple[FloatArray, float, FloatArray]:
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = np.array(x, dtype=float), *self._evaluated(x)
            self.evaluations += 1
        return self._last

    def _evaluated(self, x: FloatArray) -> tuple[float, FloatArray]:
        found = self._evaluate(x)
        if not isinstance(found, tuple) or len(found) != 2:
            raise InputError(f"{self.name} gives a {type(found).__name__}; give (energy, forces)", item="potential")
        return float(found[0]), np.asarray(found[1], float)


def no_forces() -> Potential:
    """The potential of a system on which no forces act."""
    return Potential(lambda x: (0.0, np.zeros_like(x)), NO_FORCES)


def uniform_field(masses: FloatArray, gravity: float = 1.0) -> Evaluate:
    """Weights along -z."""
    force = np.outer(masses, [0.0, 0.0, -gravity])

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        return -float(np.sum(force * x)), force

    return evaluate


class PotentialCalculator:
    """A `Potential` as an ASE calculator.

    It adds as little as can be: ASE's own base class copies the atoms and their constraints at every
    step, which would be counted as the cost of the method under test.
    """

    implemented_properties = ("energy", "forces")
    name = "potential"

    def __init__(self, potential: Potential) -> None:
        self.potential = potential
        self.parameters: dict[str, Any] = {}

    def get_forces(self, atoms: Atoms) -> FloatArray:
        return self.potential.forces(atoms.positions)

    def get_potential_energy(self, atoms: Atoms, force_consistent: bool = False) -> float:
        return self.potential.energy(atoms.positions)

    def get_property(self, name: str, atoms: Atoms, allow_calculation: bool = True) -> Any:
        if name in ("energy", "free_energy"):
            return self.get_potential_energy(atoms)
        if name == "forces":
            return self.get_forces(atoms)
        raise NotImplementedError(f"a test system has energy and forces, no {name}")

    def calculation_required(self, atoms: Atoms, properties: list[str]) -> bool:
        return True


def of_calculator(atoms: Atoms, calculator: Any, name: str) -> Potential:
    """The potential that an ASE calculator gives for these atoms (without their constraints).

    Where the calculator says that it failed, the potential raises `CalculatorError`.
    """
    copy = Atoms(atoms.symbols, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc, masses=atoms.get_masses())
    copy.calc = calculator

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        copy.positions[:] = x
        try:
            return float(copy.get_potential_energy()), np.asarray(copy.get_forces())
        except of_ase.CalculatorError as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise CalculatorError(f"{name} failed: {text}; mend the start, or choose other forces") from error

    return Potential(evaluate, name)
