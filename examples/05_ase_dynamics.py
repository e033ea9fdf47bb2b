"""Our dynamics class beside ASE's: far from the origin, with a bond that is pulled, and the pressure of a gas.

Run with ``python examples/05_ase_dynamics.py``; a few seconds.
"""

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.emt import EMT
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet

from kcons.ase import ConstrainedDynamics, constrain, rigid_water
from kcons.constraints import Distance
from kcons.steppers import Rattle


class Free(Calculator):
    """No forces and no stress: what is seen is the constraints alone."""

    implemented_properties = ("energy", "forces", "stress")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results = {"energy": 0.0, "forces": np.zeros((len(atoms), 3)), "stress": np.zeros(6)}


def water(at: float) -> Atoms:
    """One rigid water molecule at a distance from the origin."""
    atoms = molecule("H2O")
    atoms.positions += at
    atoms.calc = Free()
    constrain(atoms, rigid_water(atoms))
    thermalize_momenta(atoms, 300, rng=np.random.default_rng(1))
    return atoms


def far_from_the_origin(steps: int) -> None:
    print(f"Kinetic energy lost by a free rigid water in {steps} steps of 1 fs (relative)")
    print("  distance/A  VelocityVerlet  ConstrainedDynamics")
    for distance in (0.0, 1e3, 1e6):
        change = []
        for dynamics in (VelocityVerlet, ConstrainedDynamics):
            atoms = water(distance)
            before = atoms.get_kinetic_energy()
            dynamics(atoms, 1 * units.fs).run(steps)
            change.append(abs(atoms.get_kinetic_energy() / before - 1))
        print(f"  {distance:10.0e}  {change[0]:14.1e}  {change[1]:19.1e}")


def pulled_bond(steps: int) -> None:
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    length = atoms.get_distance(0, 1)
    rate = 0.002 / units.fs
    bond = Distance([[0, 1]], lambda t: length + rate * t)
    dynamics = ConstrainedDynamics(atoms, 0.5 * units.fs, Rattle(), constraints=[bond])

    print("\nThe C-C bond of ethanol, pulled at 0.002 A/fs")
    print("  time/fs  length/A  length - target/A  potential energy/eV")

    def show() -> None:
        time = dynamics.get_time()
        now = atoms.get_distance(0, 1)
        miss = now - length - rate * time
        print(f"  {time / units.fs:7.1f}  {now:8.5f}  {miss:17.1e}  {atoms.get_potential_energy():19.4f}")

    dynamics.attach(show, interval=max(1, steps // 4))
    dynamics.run(steps)


def pressure_of_a_gas(draws: int) -> None:
    rng = np.random.default_rng(0)
    atoms = Atoms(cell=[24.0] * 3, pbc=True)
    for place in np.ndindex(3, 3, 3):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        one.translate(8.0 * np.array(place))
        atoms += one
    atoms.calc = Free()
    constrain(atoms, rigid_water(atoms))
    seen = []
    for _ in range(draws):
        thermalize_momenta(atoms, 300, rng=rng)
        with_constraints, without = (
            -atoms.get_stress(include_ideal_gas=True, apply_constraint=use)[:3].mean() for use in (True, False)
        )
        seen.append((with_constraints, without))
    bar = 1e5 * units.Pascal
    mean = np.mean(seen, axis=0) / bar
    error = np.std(seen, axis=0)[0] / np.sqrt(draws) / bar
    expected = 27 * units.kB * 300 / atoms.get_volume() / bar
    print("\nPressure of 27 free rigid waters at 300 K, in bar")
    print(
        f"  N k T / V {expected:.1f}; found {mean[0]:.1f} +- {error:.1f}; without the constraints' part {mean[1]:.1f}"
    )


def main(steps: int = 1000) -> None:
    far_from_the_origin(steps)
    pulled_bond(max(4, steps // 10))
    pressure_of_a_gas(max(10, steps // 5))


if __name__ == "__main__":
    main()
