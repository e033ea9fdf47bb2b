"""Dynamics of ASE at constant pressure: a barostat beside each thermostat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ase import units
from ase.calculators.calculator import all_changes
from ase.constraints import Hookean
from ase_systems import FS, TEMPERATURE, Field, Free, copper, dumbbells, follow, state

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstrainedMonteCarlo,
    ConstrainedNoseHoover,
    IsokineticDynamics,
    MultipleTimeSteps,
    constrain,
)
from kcons.constraints import Distance
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.thermostats import CellRescaling, MonteCarloBarostat

KT = units.kB * TEMPERATURE
N, SIDE = 60, 40.0
CUBE = np.diag([SIDE] * 3).tolist()
PRESSURE = (N + 1) * KT / SIDE**3
MADE = {
    "langevin": lambda a, **k: ConstrainedLangevin(a, 2 * FS, TEMPERATURE, 0.1 / FS, rng=1, **k),
    "nose-hoover": lambda a, **k: ConstrainedNoseHoover(a, 2 * FS, TEMPERATURE, 50 * FS, momentum="free", **k),
    "isokinetic": lambda a, **k: IsokineticDynamics(a, 2 * FS, TEMPERATURE, momentum="free", **k),
}
made = pytest.mark.parametrize("name", MADE)


def barostats(**kwargs):
    return {
        "monte carlo": MonteCarloBarostat(PRESSURE, **{"every": 1, "width": 0.25, "rng": 3, **kwargs}),
        "rescaling": CellRescaling(PRESSURE, 4 * FS, 1 / PRESSURE, **{"every": 1, "rng": 3, **kwargs}),
    }


def gas():
    return dumbbells(N, side=SIDE)


def test_a_run_goes_on_without_its_barostat_in_its_cell():
    """Also where it is refused, the cell of the atoms is their own."""
    atoms, _ = gas()
    other = atoms.copy()
    whole = MADE["langevin"](atoms, barostat=barostats(every=1)["monte carlo"])
    whole.run(5)
    other.calc = Free()
    MADE["langevin"](other, state=whole.state).run(3)
    assert other.cell.array.tolist() == atoms.cell.array.tolist() != CUBE
    third, _ = gas()
    with pytest.raises(InputError, match="another barostat"):
        MADE["langevin"](third, barostat=barostats(kind="lateral")["monte carlo"], state=whole.state)
    assert third.cell.array.tolist() == CUBE
    with pytest.raises(InputError, match="off row"):
        ConstrainedDynamics(third, FS, state=replace(whole.state, positions=1.1 * atoms.positions))
    assert third.cell.array.tolist() == CUBE


# -- forces, and what moves ---------------------------------------------------------------------------


@pytest.mark.parametrize(("which", "kind"), [("monte carlo", "semi-isotropic"), ("rescaling", "flexible")])
def test_the_energy_that_trials_bring_is_accounted_for(which, kind):
    atoms = copper()
    if which == "monte carlo":  # forces of ASE's objects count in the energy, and have no stress
        atoms.set_constraint([*atoms.constraints, Hookean(a1=4, a2=5, rt=2.0, k=5.0)])
        made = MonteCarloBarostat(0.0, every=2, kind=kind, width=1e-3)
    else:
        made = CellRescaling(0.0, 100 * FS, 1.0, every=2, kind=kind)
    dyn = ConstrainedLangevin(atoms, 1 * FS, 300, 0.01 / FS, rng=1, barostat=made)
    before, cell = dyn.get_conserved_energy(), atoms.cell.array.copy()
    dyn.run(40)
    assert abs(atoms.get_volume() / abs(np.linalg.det(cell)) - 1) > 1e-4
    assert dyn.get_conserved_energy() == pytest.approx(before, abs=2e-3)
    tried = dyn.state.barostat[11:].reshape(3, -1)[0]
    assert tried.sum() == 20
    assert 0.1 < np.nanmean(made.acceptance(dyn.state)) <= 1
    if which == "rescaling":
        assert np.ptp(made.acceptance(dyn.state)) == 0
        assert atoms.cell.array[0, 1] == atoms.cell.array[0, 2] == atoms.cell.array[1, 2] == 0
        assert abs(atoms.cell.array[2, 0]) > 1e-4


class WarmElectrons(Free):
    """A free energy that fixes the cell, and an energy that knows nothing of it."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results["free_energy"] = 1e3 * (atoms.get_volume() / SIDE**3 - 1) ** 2


def test_trials_are_judged_by_the_energy_that_forces_belong_to():
    """They went by the energy that is extrapolated to cold electrons."""
    atoms, _ = gas()
    atoms.calc = WarmElectrons()
    dyn = MADE["langevin"](atoms, barostat=MonteCarloBarostat(0.0, every=1, width=0.01, rng=1))
    volumes = follow(dyn, atoms.get_volume, 100)
    assert 0 < np.abs(volumes / SIDE**3 - 1).max() < 0.06


# -- errors, with the state kept --------------------------------------------------------------------------------


class Torn(Free):
    """Has no energy where the cell is a little smaller."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=()):
        super().calculate(atoms, properties, system_changes)
        if atoms.get_volume() < 0.97 * SIDE**3:
            self.results["energy"] = np.nan


@pytest.mark.parametrize(
    ("which", "case", "error", "match"),
    [
        *((which, "cutoff", InputError, "less than twice the cutoff") for which in ("monte carlo", "rescaling")),
        *((which, "length", InputError, "half the box") for which in ("monte carlo", "rescaling")),
        ("monte carlo", "energy", NonFiniteError, "energy is nan"),
        ("rescaling", "stress", UnsupportedError, r"no stress.*MonteCarloBarostat"),
    ],
)
def test_a_trial_that_fails_leaves_the_atoms(which, case, error, match):
    atoms, _ = gas()
    if case == "length":
        atoms.positions[1] = atoms.positions[0] + [SIDE / 2 - 0.5, 0, 0]
        atoms.set_constraint()
        constrain(atoms, Distance(np.arange(2 * N).reshape(-1, 2)))
    atoms.calc = {"energy": Torn, "stress": lambda: Field(0.0)}.get(case, Free)()
    barostat = barostats(**({"cutoff": SIDE / 2 - 0.5} if case == "cutoff" else {}))[which]
    dyn, seen = MADE["langevin"](atoms, barostat=barostat), []

    def remember():
        seen[:] = [atoms.cell.array.copy(), atoms.positions.copy(), atoms.get_momenta()]

    dyn.attach(remember)
    remember()
    with pytest.raises(error, match=match) as found:
        dyn.run(200)
    assert all(np.array_equal(*pair) for pair in zip((atoms.cell.array, *state(atoms)), seen, strict=True))
    assert found.value.step == dyn.nsteps + 1


def test_what_has_no_temperature_or_no_cell():
    atoms, _ = gas()
    with pytest.raises(UnsupportedError, match="keeps no temperature"):
        ConstrainedMonteCarlo(atoms, FS, TEMPERATURE, 3, barostat=MonteCarloBarostat(0.0))
    with pytest.raises(UnsupportedError, match=r"LangevinRespa.*does not know that the cell"):
        two = {"fast": Free(), "slow": Free(), "fast_steps": 2, "friction": 0.1, "barostat": MonteCarloBarostat(0.0)}
        MultipleTimeSteps(atoms, FS, temperature_K=TEMPERATURE, **two)
    atoms.pbc = [True, True, False]
    with pytest.raises(InputError, match=r"along z.*'lateral'"):
        MADE["langevin"](atoms, barostat=MonteCarloBarostat(0.0))
    atoms.cell[2] = 0.0
    with pytest.raises(InputError, match="no volume"):
        MADE["langevin"](atoms, barostat=MonteCarloBarostat(0.0, kind="lateral"))


def test_a_step_that_fails_after_a_trial_leaves_the_cell(monkeypatch):
    """Also where the trial itself was accepted."""
    atoms, _ = gas()
    dynamics = MADE["langevin"](atoms, barostat=MonteCarloBarostat(PRESSURE, every=1, width=0.2), check_every=1)
    cell, x = atoms.cell.array.copy(), atoms.get_positions()
    tried = []

    def interrupted(*args, **kwargs):
        tried.append(atoms.cell.array.copy())
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(dynamics._systems().schedule, "made", interrupted)
        for _ in range(20):
            with pytest.raises(KeyboardInterrupt):
                dynamics.run(1)
            assert np.array_equal(atoms.cell.array, cell) and np.array_equal(atoms.positions, x)
            assert np.array_equal(dynamics.motion.lattice[0], cell)  # in the engine, which would take other images
            dynamics.nsteps += 1  # another trial
    assert any(not np.array_equal(one, cell) for one in tried)
