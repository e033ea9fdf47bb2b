"""Held coordinates in ASE's dynamics with any calculator: recorded, and sampled window by window."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from ase import Atoms, units
from ase.md.md import MolecularDynamics

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    IsokineticDynamics,
    draw_velocities,
    from_ase_constraints,
)
from kcons.ase.binding import applied_forces
from kcons.ase.dynamics import engine_of
from kcons.ase.named_calculators import described
from kcons.ase.topology import bonds_of, velocities_of
from kcons.constraints import Constraint, Dihedral
from kcons.constraints.constraint import constraints_in
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.free_energy.held_coordinates import HeldCoordinates, named
from kcons.free_energy.series import Series
from kcons.free_energy.windows.driver import Sampler, Settings, Window, digest_of
from kcons.motion import minimize
from kcons.motion.motion import Motion
from kcons.thermostats import IsokineticSpheres

#: Largest force left by a relaxation, eV/angstrom, and the longest way of an atom in one of its steps, angstrom.
_FORCE, _STRIDE = 0.1, 0.1


class AseRecorder:
    """An observer of ASE's dynamics that keeps a `Series`.

    Parameters
    ----------
    dynamics : MolecularDynamics
        Of kcons, or another one of ASE whose atoms carry a `kcons.ase.Constraints`. Times are in ASE's unit,
        multipliers in eV by the unit of the coordinate.
    coordinates : mapping of str to Constraint
        As for `HeldCoordinates`.

    Attributes
    ----------
    series : Series

    Raises
    ------
    InputError
        The atoms carry no constraints of kcons, or do not hold a coordinate.
    UnsupportedError
        At a sample: velocities on isokinetic spheres, where the multipliers need thermal ones.

    Examples
    --------
    ``dynamics.attach(AseRecorder(dynamics, {"torsion": torsion}), interval=10)``
    """

    def __init__(self, dynamics: MolecularDynamics, coordinates: Mapping[str, Constraint]) -> None:
        self.dynamics, self.coordinates = dynamics, named(coordinates)
        self._motion: Motion | None = None
        self._held = self._bound()
        self.series = Series(self._held.names, self._held.periods)

    def _bound(self) -> HeldCoordinates:
        """The coordinates among what is held now: masses, constraints or periodicity may have been changed."""
        dynamics, atoms = self.dynamics, self.dynamics.atoms
        motion = engine_of(dynamics, atoms)
        if motion is not self._motion:
            turns = any(isinstance(item, Dihedral) for item in self.coordinates.values())
            how: dict[str, Any] = {"time": dynamics.get_time(), "bonds": bonds_of(atoms) if turns else None}
            self._held = HeldCoordinates(motion, self.coordinates, atoms.positions, **how)
            self._motion = motion
        return self._held

    def __call__(self) -> None:
        dynamics, held = self.dynamics, self._bound()
        if isinstance(dynamics, IsokineticDynamics):  # known once it runs
            self.series.isokinetic_degrees_of_freedom = dynamics.thermostat_degrees_of_freedom
        sample = held.sample(*_state(dynamics))
        spheres = isinstance(getattr(dynamics, "stepper", None), IsokineticSpheres)
        if spheres and not np.isfinite(sample.mean_kinetic).all():
            raise UnsupportedError(
                f"velocities on isokinetic spheres are not thermal, and multipliers of {', '.join(held.names)} "
                "need them: their mean is found without only for up to 60 rows at rest. Take bath='langevin'"
            )
        self.series.append(sample)


def _state(dynamics: MolecularDynamics) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Positions, velocities, applied forces and time."""
    forces = dynamics.state.forces if isinstance(dynamics, ConstrainedDynamics) else None
    if forces is None:
        forces = applied_forces(dynamics.atoms)
    return dynamics.atoms.positions, velocities_of(dynamics.atoms, dynamics), forces, dynamics.get_time()


class AseWindows(Sampler):
    """Windows of ASE `Atoms`.

    Parameters
    ----------
    atoms : ase.Atoms
        The structure that all windows start from. Its ASE constraints are held beside the coordinates.
    calculator : callable
        Makes a calculator, in each process anew; a function of a module, so that it can be pickled.
    coordinates : mapping of str to Constraint
        Angstrom and radian; what they are held at is set by the windows.
    held : sequence of Constraint
        What is held besides, for example ``kcons.ase.constraints_of(atoms, "hbonds")``.

    Raises
    ------
    InputError
        A calculator instead of what makes one; coordinates without names.
    KconsError
        A coordinate that is undefined at the structure or depends on the other constraints.
    """

    kJ = units.mol / units.kJ

    def __init__(
        self,
        atoms: Atoms,
        calculator: Callable[[], Any],
        coordinates: Mapping[str, Constraint],
        held: Constraint | Sequence[Constraint] = (),
    ) -> None:
        if not callable(calculator):
            raise InputError(
                f"calculator is {calculator!r:.80}; give what makes one, such as functools.partial(EMT)",
                item="calculator",
            )
        self.atoms, self.calculator = atoms.copy(), calculator
        rows, atoms = [*from_ase_constraints(self.atoms), *constraints_in(held, "held")], self.atoms
        atoms.set_constraint()
        where = (atoms.get_positions(), atoms.get_masses(), atoms.cell.array if atoms.pbc.any() else None, atoms.pbc)
        super().__init__(coordinates, rows, *where, *2 * (bonds_of(atoms),))

    @property
    def digest(self) -> str:
        """What the windows in a folder belong to, of the calculator as it is made now."""
        made = self.calculator
        given = (made.args, made.keywords) if isinstance(made, partial) else ()
        function = made.func if isinstance(made, partial) else made
        # Not all that makes a calculator what it is need be among its parameters, nor among these arguments.
        maker = [getattr(function, "__qualname__", type(function).__qualname__), *given, described(made(), self.atoms)]
        frame = [self.atoms.numbers, self.atoms.positions, self.atoms.cell.array, self.atoms.pbc]
        frame.append(self.atoms.get_masses())
        return digest_of(frame, maker, self.held, list(self.coordinates.values()))

    def simulation(self, window: Window, settings: Settings) -> _Simulation:
        return _Simulation(self, window, settings)


class _Simulation:
    """A run in ASE."""

    def __init__(self, sampler: AseWindows, window: Window, settings: Settings) -> None:
        self._sampler, self._settings = sampler, settings
        self.atoms = atoms = sampler.atoms.copy()
        atoms.calc = sampler.calculator()
        motion, x = sampler.placed(window.start)

        def force(x: FloatArray, _: float) -> FloatArray:
            atoms.positions = x
            return np.asarray(atoms.get_forces(apply_constraint=False))

        if settings.relax:
            try:
                x = minimize(motion, force, x, tolerance=_FORCE, longest=_STRIDE, steps=settings.relax).positions
            except ConvergenceError as error:  # relaxed as far as wanted
                if error.positions is None:
                    raise
                x = error.positions
        atoms.positions = x
        self._dynamics: Any = None

    def hold(self, begin: Sequence[float], end: Sequence[float], seed: int, velocities: int | None) -> None:
        settings, sampler, dt = self._settings, self._sampler, self._settings.timestep * units.fs
        if velocities is not None:
            still = [*sampler.held, *sampler.at(begin)]
            draw_velocities(self.atoms, settings.temperature, velocities, constraints=still)
        rows = [*sampler.held, *sampler.towards(begin, end, settings.pull * dt)]
        bath = settings.temperature, settings.friction / (1000 * units.fs)
        self._dynamics = ConstrainedLangevin(self.atoms, dt, *bath, rng=seed, constraints=rows)

    def step(self, steps: int) -> None:
        self._dynamics.run(steps)

    def run(self, steps: int, every: int, take: Callable[..., None]) -> None:
        first = self._dynamics.nsteps
        # Before the first step ASE calls it, too.
        self._dynamics.attach(lambda: take(*self.state()) if self._dynamics.nsteps > first else None, interval=every)
        self._dynamics.run(steps)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        return _state(self._dynamics)
