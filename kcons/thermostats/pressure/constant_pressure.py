"""A stepper with a barostat."""

from __future__ import annotations

from dataclasses import replace

from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, Stepper, System
from kcons.steppers.operations import Operation
from kcons.steppers.stepper import Listed, require_stepper
from kcons.thermostats.isokinetic.isokinetic import Isokinetic
from kcons.thermostats.langevin import Langevin
from kcons.thermostats.nose_hoover import NoseHooverChain
from kcons.thermostats.pressure.barostat import WORK, Barostat, require_barostat
from kcons.thermostats.pressure.cell_system import CellSystem


class ConstantPressure(Listed):
    """Steps of a thermostat, and a trial of the barostat after every so many.

    Parameters
    ----------
    stepper : Langevin, NoseHooverChain or Isokinetic
        Others keep no temperature, or remember energies and forces of the cell that was.
    barostat : Barostat

    Raises
    ------
    InputError
        What is given is no barostat.

    Notes
    -----
    `State.barostat` holds the cell (`State.cell`), the energy that trials have brought, and what the barostat has
    learned. Trials are a function of the seed and of the number of the step: a run that is continued from a saved state
    is the same to the last bit. The cell of the `System` follows the state that a step begins with.
    """

    reversible = False
    symplectic = False

    def __init__(self, stepper: Stepper, barostat: Barostat) -> None:
        require_stepper(stepper)
        require_barostat(barostat)
        self.stepper, self.barostat = stepper, barostat

    def __repr__(self) -> str:
        return f"ConstantPressure({self.stepper!r}, {self.barostat!r})"

    @property
    def order(self) -> int:
        return self.stepper.order

    @property
    def force_evaluations(self) -> int:
        """Of the stepper; a trial takes one more, and two energies."""
        return self.stepper.force_evaluations

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        inner = self.stepper.operations(system) if isinstance(self.stepper, Listed) else ()
        return (*inner, self.barostat.operation)

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` without a thermostat, and where the stepper may not be used."""
        if not isinstance(system, CellSystem):
            raise UnsupportedError("a barostat needs a system whose cell can change: make a CellSystem")
        # Not what derives from them, with several time steps, which remembers forces.
        if type(self.stepper) not in (Langevin, NoseHooverChain, Isokinetic):
            raise UnsupportedError(
                f"{self.stepper!r} keeps no temperature, by which a barostat judges its trials, or does not know that "
                "the cell has changed; use Langevin, NoseHooverChain or Isokinetic"
            )
        self.stepper.check(system)

    def start(self, system: System, state: State) -> State:
        """The state in its cell, with variables of the barostat."""
        self.check(system)
        assert isinstance(system, CellSystem)
        known = self.barostat.variables_of(state)
        system.enter(state)
        if known is None:
            self.barostat.pieces(system, state.positions, state.time)
            state = replace(state, barostat=self.barostat.begin(system))
            if self.barostat.needs_stress:
                system.stress(state.positions, state.time)
        return state

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        KconsError
            As the stepper and the barostat; the state is as it was, also the cell of the system.
        """
        return self._advanced(system, state, dt, 1)

    def march(self, system: System, state: State, dt: float, steps: int) -> State:
        """The state after so many steps, the same to the last bit as by `step`."""
        while steps > 0:
            n = min(steps, self.barostat.every - state.step % self.barostat.every)
            state = self._advanced(system, state, dt, n)
            steps -= n
        return state

    def _advanced(self, system: System, state: State, dt: float, steps: int) -> State:
        if dt < 0:
            raise InputError(
                f"the time step is {system.shown_time(dt)}; trials of a barostat cannot be taken back", item="dt"
            )
        state = self.start(system, state)
        assert isinstance(system, CellSystem)
        march = getattr(self.stepper, "march", None)
        if steps > 1 and march is not None:
            after = march(system, state, dt, steps)
        else:
            after = state
            for _ in range(steps):
                after = self.stepper.step(system, after, dt)
        if dt and after.step % self.barostat.every == 0:
            after = self._pressed(system, after, dt)
        return after

    def _pressed(self, system: CellSystem, state: State, dt: float) -> State:
        try:
            after = self.barostat.move(system, state, self.thermal_energy(state), dt)
        except Exception as error:
            if getattr(error, "step", None) is None:
                error.step = state.step  # type: ignore[attr-defined]
            raise
        if isinstance(self.stepper, Isokinetic) and after.positions is not state.positions:
            # Its variables know of the forces: it finds both anew.
            return replace(after, forces=None)
        return after

    def thermal_energy(self, state: State) -> float:
        """kT of the configurations that the stepper samples."""
        if isinstance(self.stepper, Isokinetic):
            assert state.thermostat is not None
            return float(state.thermostat[0] / (state.thermostat[3] - 1))
        return float(self.stepper.thermal_energy)  # type: ignore[attr-defined]  # see `check`

    def conserved_energy(self, system: System, state: State) -> float:
        """What the thermostat conserves, less the energy that trials have brought."""
        state = self.start(system, state)
        assert state.barostat is not None
        return float(self.stepper.conserved_energy(system, state)) - float(state.barostat[WORK])  # type: ignore[attr-defined]


def in_cell(variables: FloatArray | None, cell: FloatArray) -> FloatArray | None:
    """Variables of a barostat that goes on in a cell that somebody else has changed."""
    if variables is None:
        return None
    own = variables.copy()
    own[:WORK] = cell.ravel()
    return own
