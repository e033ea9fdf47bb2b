"""Windows sampled by ASE with any calculator."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
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
from kcons.free_energy.held_coordinates import named
from kcons.free_energy.windows.window import Held, Settings, Window, angles_of, digest_of, scales_of
from kcons.motion import minimise

#: Largest force left by a relaxation, eV/angstrom, and the longest way of an atom in one of its steps, angstrom.
_FORCE, _STRIDE = 0.1, 0.1


class AseWindows:
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
        self.atoms = atoms.copy()
        self.calculator = calculator
        self.coordinates = named(coordinates)
        self.held = [*from_ase_constraints(self.atoms), *held]
        self.atoms.set_constraint()
        self.names = tuple(self.coordinates)
        self.angles = angles_of(self.coordinates)
        self.scales = scales_of(self.coordinates, 1.0)

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

    def _rows(self) -> Held:
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

    def begin(self) -> tuple[FloatArray, FloatArray]:
        return self._rows().begin()

    def sample(self, window: Window, settings: Settings, file: Path) -> None:
        began = time.process_time()
        held = self._rows()
        atoms = self._prepared(held, window, settings)
        if settings.pull:
            self._moving(held, atoms, window, settings).run(settings.pull)
        rows = [*held.others, *held.at(window.target)]
        # Velocities of the pull's end have its rate.
        free = settings.thermostat != "langevin" and all(row.translation_invariant for row in rows)
        draw_velocities(atoms, settings.temperature, window.seed + 1, constraints=rows, zero_momentum=free)
        dt, friction, common = _units(settings)
        if settings.thermostat == "langevin":
            common |= {"friction": friction, "rng": window.seed + 2}
            dynamics: Any = ConstrainedLangevin(atoms, dt, constraints=rows, **common)
        elif settings.thermostat == "nose-hoover":
            dynamics = ConstrainedNoseHoover(atoms, dt, tdamp=1 / friction, constraints=rows, **common)
        else:
            dynamics = IsokineticDynamics(atoms, dt, constraints=rows, **common)
        dynamics.run(settings.equilibration)
        recorder = AseRecorder(dynamics, self.coordinates)
        dynamics.attach(recorder, interval=settings.every)
        dynamics.run(settings.production)
        recorder.series.seconds = time.process_time() - began
        recorder.series.save(file)

    def pull(self, window: Window, settings: Settings, file: Path) -> None:
        held = self._rows()
        atoms = self._prepared(held, window, settings)
        dt, friction, common = _units(settings)
        rows = [*held.others, *held.at(window.start)]
        dynamics = ConstrainedLangevin(atoms, dt, friction=friction, rng=window.seed + 2, constraints=rows, **common)
        dynamics.run(settings.equilibration)
        moving = self._moving(held, atoms, window, settings)
        recorder = AseRecorder(moving, self.coordinates)
        moving.attach(recorder, interval=1)
        moving.run(settings.pull)
        recorder.series.save(file)

    def _prepared(self, held: Held, window: Window, settings: Settings) -> Atoms:
        """The atoms at the start of a window, relaxed, with velocities."""
        atoms = self.atoms.copy()
        atoms.calc = self.calculator()
        motion, x = held.placed(window.start)
        if settings.relax:

            def force(x: FloatArray, _: float) -> FloatArray:
                atoms.positions = x
                return np.asarray(atoms.get_forces(apply_constraint=False))

            try:
                x = minimise(motion, force, x, tolerance=_FORCE, longest=_STRIDE, steps=settings.relax).positions
            except ConvergenceError as error:  # relaxed as far as wanted
                if error.positions is None:
                    raise
                x = error.positions
        atoms.positions = x
        draw_velocities(atoms, settings.temperature, window.seed, constraints=[*held.others, *held.at(window.start)])
        return atoms

    def _moving(self, held: Held, atoms: Atoms, window: Window, settings: Settings) -> ConstrainedLangevin:
        """Langevin dynamics with the coordinates moving from the start of the window to its target."""
        dt, friction, common = _units(settings)
        rows = [*held.others, *held.towards(window, settings.pull * dt)]
        return ConstrainedLangevin(atoms, dt, friction=friction, rng=window.seed, constraints=rows, **common)


def _units(settings: Settings) -> tuple[float, float, dict[str, Any]]:
    """Time step and friction in ASE's units, and the temperature as its classes take it."""
    return settings.timestep * units.fs, settings.friction / (1000 * units.fs), {"temperature_K": settings.temperature}
