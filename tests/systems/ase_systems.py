"""Atoms, calculators and measures that the tests of kcons.ase share."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import numpy as np
from ase import Atoms, units
from ase.build import bulk, molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.emt import EMT
from ase.calculators.tip3p import TIP3P
from ase.md.andersen import Andersen
from ase.md.bussi import Bussi
from ase.md.langevin import Langevin
from ase.md.nvtberendsen import NVTBerendsen
from ase.md.verlet import VelocityVerlet

from kcons.ase import Constraints, constrain, draw_velocities, rigid_water
from kcons.constraints import (
    Angle,
    CenterOfMass,
    Dihedral,
    Distance,
    DistanceDifference,
    FixedAtoms,
    Line,
    LinearCombination,
    Plane,
)
from kcons.steppers import BlanesMoan6a, Geodesic, KahanLi6, Rattle, ReversibilityCheck

FS = units.fs
TEMPERATURE = 300.0

#: Of each kind of stepper one: what it does on arrays it does in ASE, see `contracts/test_ase_steppers.py`.
KINDS = [Rattle(), Geodesic(), KahanLi6(), BlanesMoan6a(), ReversibilityCheck(Rattle())]

#: Classes of ASE that respect constraints, each a dynamics object for these atoms and this time step.
OF_ASE = {
    "VelocityVerlet": VelocityVerlet,
    "Langevin": lambda a, dt: Langevin(a, dt, temperature_K=250, friction=0.01 / FS, fixcm=False, rng=random()),
    "NVTBerendsen": lambda a, dt: NVTBerendsen(a, dt, 250, 100 * FS, fixcm=False),
    "Bussi": lambda a, dt: Bussi(a, dt, 250, 100 * FS, rng=random()),
    "Andersen": lambda a, dt: Andersen(a, dt, 250, 1e-9, fixcm=False, rng=random()),
}


class Free(Calculator):
    """No forces, no stress."""

    implemented_properties = ("energy", "forces", "stress")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results = {"energy": 0.0, "forces": np.zeros((len(atoms), 3)), "stress": np.zeros(6)}


class Field(Calculator):
    """A smooth field on every atom; from evaluation `bad` on what `how` says."""

    implemented_properties = ("energy", "forces")

    def __init__(self, stiffness=0.05, bad=None, how=None):
        super().__init__()
        self.stiffness, self.bad, self.how, self.calls = stiffness, bad, how, 0

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        x = atoms.positions
        forces = -self.stiffness * x
        if self.bad is not None and self.calls >= self.bad:
            forces = self.how(forces)
        self.calls += 1
        self.results = {"energy": 0.5 * self.stiffness * float((x**2).sum()), "forces": forces}


#: Names of objects of ASE, and rows of ethanol that they hold; a file of ASE without kcons has one object at most.
AS_ASE = {
    "FixAtoms": [FixedAtoms([8]), FixedAtoms([7])],
    "FixBondLengths": [Distance([[0, 1], [1, 2]]), Distance([[0, 3]])],
    "FixInternals": [
        *(Distance([[0, 1]]), Angle([[0, 1, 2]]), Dihedral([[3, 2, 1, 0]])),
        DistanceDifference([[0, 4], [1, 5]], weights=[1.0, -2.0]),
    ],
    "FixedPlane": [Plane([4, 0, 5], [0, 1, 2])],
    "FixedPlane FixedPlane": [Plane([4, 5], [0, 1, 2]), Plane([6], [1, 0, 0])],
    "FixedLine": [Line([4, 5], None, [0, 1, 2])],
    "FixCartesian": [LinearCombination([[3], [5]], [[0, 0, 1.0]]), LinearCombination([[3], [5]], [[1.0, 0, 0]])],
    "FixCartesian FixCartesian": [
        LinearCombination([[3], [5]], [[0, 0, 2.0]]),
        LinearCombination([[3]], [[1.0, 0, 0]]),
    ],
    "FixSubsetCom": [CenterOfMass([0, 1, 2])],
    "FixAtoms FixBondLengths": [FixedAtoms([8]), Distance([[0, 1]])],
}

# -- atoms ------------------------------------------------------------------------------------------


def random(seed=1):
    return np.random.default_rng(seed)


def loose_waters(n=2, seed=0, spacing=3.1) -> Atoms:
    """n waters in random orientations on a line of a grid, nothing held."""
    rng = random(seed)
    atoms = Atoms()
    for k in range(n):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        one.translate(spacing * np.array(np.unravel_index(k, (2, 2, -(-n // 4)))))
        atoms += one
    return atoms


def rigid(n=2, seed=0, temperature=300.0) -> tuple[Atoms, Constraints]:
    """TIP3P waters, held rigid."""
    atoms = loose_waters(n, seed)
    held = constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    if temperature:
        draw_velocities(atoms, temperature, rng=random(seed))
    atoms.calc = TIP3P(rc=6.0)
    return atoms, held


def water(calc=None, temperature=300.0, at=0.0) -> tuple[Atoms, Constraints]:
    """One rigid water in a smooth field."""
    atoms = molecule("H2O")
    atoms.positions += at
    atoms.calc = Field() if calc is None else calc
    held = constrain(atoms, rigid_water(atoms))
    draw_velocities(atoms, temperature, rng=random(3))
    return atoms, held


def dumbbells(n=60, seed=0, side=60.0) -> tuple[Atoms, Constraints]:
    """An ideal gas of rigid CO in a periodic box."""
    rng = random(seed)
    axis = rng.normal(size=(n, 3))
    axis *= 1.1 / np.linalg.norm(axis, axis=1)[:, None]
    x = np.empty((2 * n, 3))
    x[0::2] = rng.uniform(0, side, size=(n, 3))
    x[1::2] = x[0::2] + axis
    atoms = Atoms("CO" * n, positions=x, cell=[side] * 3, pbc=True, calculator=Free())
    held = constrain(atoms, Distance(np.arange(2 * n).reshape(-1, 2)))
    draw_velocities(atoms, TEMPERATURE, rng=rng)
    return atoms, held


def water_gas(side=3, spacing=8.0, seed=0) -> Atoms:
    """Waters without forces in a periodic box, nothing held."""
    rng = random(seed)
    atoms = Atoms(cell=[side * spacing] * 3, pbc=True)
    for place in np.ndindex(side, side, side):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        one.translate(spacing * np.array(place))
        atoms += one
    atoms.calc = Free()
    return atoms


def ethanol() -> tuple[Atoms, Constraints]:
    """Ethanol by EMT, which knows no molecules but is smooth."""
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    return atoms, constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2], [1, 0, 3]])])


def copper() -> Atoms:
    """A crystal with two bonds held; the forces of EMT tell of volume."""
    atoms = bulk("Cu", cubic=True) * 2
    atoms.rattle(0.05, rng=random(3))
    atoms.calc = EMT()
    constrain(atoms, Distance([[0, 1], [2, 3]]))
    draw_velocities(atoms, TEMPERATURE, 1)
    return atoms


# -- measures ---------------------------------------------------------------------------------------


def off(atoms, held) -> float:
    """Largest violation of a row by the positions."""
    return float(np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max())


def slip(atoms, held) -> float:
    """Largest violation of a row by the velocities."""
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    return float(np.abs(rows @ atoms.get_velocities().ravel()).max())


def state(atoms):
    return atoms.get_positions(), atoms.get_momenta()


def equal(a, b) -> bool:
    return all(np.array_equal(p, q) for p, q in zip(a, b, strict=True))


def mean_and_error(values, blocks=10) -> tuple[float, float]:
    """Mean and its standard error from means of blocks."""
    values = np.asarray(values)
    means = values[len(values) % blocks :].reshape(blocks, -1).mean(axis=1)
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(blocks))


def follow(dyn, quantity, steps) -> np.ndarray:
    """Values of `quantity` at each step of a run."""
    seen: list[float] = []
    dyn.attach(lambda: seen.append(quantity()))
    dyn.run(steps)
    return np.array(seen)


def pressure(atoms) -> float:
    return -atoms.get_stress(include_ideal_gas=True)[:3].mean()


def classes_in(package, *roots):
    """All classes that a package of ASE defines below `roots`."""
    found = {}
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if ".test" in module.name:
            continue
        for name, item in vars(importlib.import_module(module.name)).items():
            if inspect.isclass(item) and item.__module__ == module.name and issubclass(item, roots):
                found[name] = item
    return found
