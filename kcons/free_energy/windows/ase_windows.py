"""Windows sampled by ASE with any calculator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from ase import Atoms, units

from kcons.ase import (
    ConstrainedLangevin,
    ConstrainedNoseHoover,
    IsokineticDynamics,
    draw_velocities,
    from_ase_constraints,
)
from kcons.ase.named_calculators import described
from kcons.ase.topology import bonds_of
from kcons.constraints import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.free_energy.ase_recorder import AseRecorder
from kcons.free_energy.series import Series
from kcons.free_energy.windows.window import Held, Sampler, Settings, Thermostat, Window, digest_of
from kcons.motion import minimise

#: Largest force left by a relaxation, eV/angstrom, and the longest way of an atom in one of its steps, angstrom.
_FORCE, _STRIDE = 0.1, 0.1


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
        At `begin`: a coordinate that is undefined at the structure or depends on the other constraints.
    """

    kJ = units.mol / units.kJ

    def __init__(
        self,
        atoms: Atoms,
        calculator: Callable[[], Any],
        coordinates: Mapping[str, Constraint],
        held: Sequence[Constraint] = (),
    ) -> None:
        if not callable(calculator):
            raise InputError(
                f"calculator is {calculator!r:.80}; give what makes one, such as functools.partial(EMT)",
                item="calculator",
            )
        super().__init__(coordinates, 1.0)
        self.atoms = atoms.copy()
        self.calculator = calculator
        self.held = [*from_ase_constraints(self.atoms), *held]
        self.atoms.set_constraint()

    @property
    def digest(self) -> str:
        """What the windows in a folder belong to, of the calculator as it is made now."""
        calculator = self.calculator
        made = (
            (calculator.func, calculator.args, calculator.keywords)
            if isinstance(calculator, partial)
            else (calculator,)
        )
        # Not all that makes a calculator what it is need be among its parameters, nor among these arguments.
        maker = [getattr(made[0], "__qualname__", type(made[0]).__qualname__), *made[1:]]
        maker.append(described(calculator(), self.atoms))
        frame = [self.atoms.numbers, self.atoms.positions, self.atoms.cell.array, self.atoms.pbc]
        frame.append(self.atoms.get_masses())
        return digest_of(frame, maker, self.held, list(self.coordinates.values()))

    def rows(self) -> Held:
        atoms = self.atoms
        return Held(
            self.coordinates,
            self.held,
            atoms.positions.copy(),
            atoms.get_masses(),
            atoms.cell.array if atoms.pbc.any() else None,
            atoms.pbc,
            lambda: bonds_of(atoms),
        )

    def simulation(self, held: Held, window: Window, settings: Settings) -> _Simulation:
        return _Simulation(self, held, window, settings)


class _Simulation:
    """A run in ASE."""

    def __init__(self, sampler: AseWindows, held: Held, window: Window, settings: Settings) -> None:
        self._held, self._settings, self._coordinates = held, settings, sampler.coordinates
        self.atoms = atoms = sampler.atoms.copy()
        atoms.calc = sampler.calculator()
        motion, x = held.placed(window.start)

        def force(x: FloatArray, _: float) -> FloatArray:
            atoms.positions = x
            return np.asarray(atoms.get_forces(apply_constraint=False))

        if settings.relax:
            try:
                x = minimise(motion, force, x, tolerance=_FORCE, longest=_STRIDE, steps=settings.relax).positions
            except ConvergenceError as error:  # relaxed as far as wanted
                if error.positions is None:
                    raise
                x = error.positions
        atoms.positions = x
        self._dynamics: Any = None

    def hold(
        self, begin: Sequence[float], end: Sequence[float], thermostat: Thermostat, seed: int, velocities: int | None
    ) -> None:
        settings, dt = self._settings, self._settings.timestep * units.fs
        friction = settings.friction / (1000 * units.fs)
        rows = [*self._held.others, *self._held.at(begin)]
        if velocities is not None:
            still = thermostat != "langevin" and not self._held.knows_a_place
            draw_velocities(self.atoms, settings.temperature, velocities, constraints=rows, zero_momentum=still)
        if tuple(begin) != tuple(end):
            rows = [*self._held.others, *self._held.towards(begin, end, settings.pull * dt)]
        common: dict[str, Any] = {"temperature_K": settings.temperature, "constraints": rows}
        if thermostat == "langevin":
            self._dynamics = ConstrainedLangevin(self.atoms, dt, friction=friction, rng=seed, **common)
        elif thermostat == "nose-hoover":
            self._dynamics = ConstrainedNoseHoover(self.atoms, dt, tdamp=1 / friction, **common)
        else:
            self._dynamics = IsokineticDynamics(self.atoms, dt, **common)

    def step(self, steps: int) -> None:
        self._dynamics.run(steps)

    def record(self, steps: int, every: int, *, start: bool = False) -> Series:
        recorder = AseRecorder(self._dynamics, self._coordinates)
        self._dynamics.attach(recorder, interval=every)  # before the first step ASE calls it
        self._dynamics.run(steps)
        return recorder.series
