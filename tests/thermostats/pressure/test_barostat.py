"""What barostats have in common."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from pressure_systems import gas, no_force, started

from kcons.constraints import FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.thermostats.pressure import CellRescaling, CellSystem, MonteCarloBarostat


def test_widths_go_to_an_acceptance_of_one_half_and_trials_are_counted():
    system, x = gas(n=100)
    barostat = MonteCarloBarostat(101 / 12**3, width=1e-4, kind="semi-isotropic")
    state = started(system, x, barostat)
    for k in range(400):
        state = barostat.move(system, state, 1.0, 1.0)
        vars(state)["step"] = k
    assert np.isnan(barostat.acceptance(replace(state, barostat=None))).all()
    tried, _, widths = state.barostat[11:].reshape(3, 2)
    assert tried.sum() == 400
    assert np.all(np.exp(widths) > 0.03)
    assert np.all(barostat.acceptance(state) > 0.4)


def test_a_trial_is_a_function_of_the_state_and_the_seed():
    system, x = gas(n=10)
    barostat, other = MonteCarloBarostat(0.01, width=0.2), MonteCarloBarostat(0.01, width=0.2, rng=1)
    state = started(system, x, barostat)
    cell = system.cell
    once = barostat.move(system, state, 1.0, 1.0)
    for again, same in ((barostat, True), (other, False)):
        system.set_cell(cell, x)
        found = again.move(system, state, 1.0, 1.0)
        assert np.array_equal(found.barostat, once.barostat) == same


def test_overlaps_are_rejected():
    system, x = gas(n=10, force=lambda x, t, h: x, potential=lambda x, t, h: 0.0 if h[0, 0] >= 12 else np.inf)
    barostat = MonteCarloBarostat(1e6, width=0.2)
    state = started(system, x, barostat)
    for k in range(10):
        state = barostat.move(system, state, 1.0, 1.0)
        vars(state)["step"] = k
        assert np.array_equal(system.cell, 12 * np.eye(3))
        assert np.array_equal(state.positions, x)


@pytest.mark.parametrize("energy", [np.inf, -np.inf])
@pytest.mark.parametrize("barostat", [MonteCarloBarostat(1.0), CellRescaling(1.0, 1.0, 1.0)])
def test_an_energy_that_judges_nothing(barostat, energy):
    """Otherwise all trials would be accepted."""
    functions = {"potential": lambda x, t, h: energy, "stress": lambda x, t, h: np.zeros((3, 3))}
    system, x = gas(n=4, force=no_force, **functions)
    state = started(system, x, barostat)
    with pytest.raises(NonFiniteError, match="inf at step 0, by which no trial"):
        barostat.move(system, state, 1.0, 1.0)
    assert np.array_equal(system.cell, 12 * np.eye(3))


def test_a_cell_too_small_for_the_cutoff_is_refused_at_the_start():
    system, x = gas(n=4)
    with pytest.raises(InputError, match=r"width of 12, less than twice the cutoff \(6.1\)"):
        MonteCarloBarostat(1.0, cutoff=6.1).pieces(system, x)


def test_remainders_of_far_positions_are_kept():
    """What rounding takes from positions 1e6 away is known still after a trial."""
    system, x = gas(n=3)
    state = system.initial_state(x + 1e6, project=True)
    assert state.remainder is not None
    barostat = MonteCarloBarostat(0.0, width=0.2)
    vars(state)["barostat"] = barostat.begin(system)
    after = barostat.move(system, state, 1.0, 1.0)
    assert after.positions is not state.positions
    pairs = np.arange(6).reshape(-1, 2)
    d = np.diff(after.positions[pairs], axis=1)[:, 0]
    d -= np.round(d @ np.linalg.inv(after.cell)) @ after.cell
    d += np.diff(after.remainder[pairs], axis=1)[:, 0]
    assert np.linalg.norm(d, axis=1) == pytest.approx(np.ones(3), abs=2e-9)


def test_angles_of_the_cell_and_atoms_held_in_space():
    _, x = gas(n=2)
    held = ConstraintSet(FixedAtoms([0]), x, np.ones(4), cell=np.full(3, 12.0))
    system = CellSystem(Motion(held, x))
    barostat = MonteCarloBarostat(1.0, kind="flexible", held="stay")
    with pytest.raises(UnsupportedError, match="angles"):
        barostat.pieces(system, x)


def test_copies_know_no_pieces_of_systems():
    system, x = gas(n=4)
    barostat = MonteCarloBarostat(0.01, every=3, rng=5, width=0.2)
    state = started(system, x, barostat)
    after = barostat.move(system, state, 1.0, 1.0)
    for again in (pickle.loads(pickle.dumps(barostat)), copy.deepcopy(barostat), copy.copy(barostat)):
        system.set_cell(state.cell, x)
        assert repr(again) == repr(barostat)
        assert np.array_equal(again.move(system, state, 1.0, 1.0).barostat, after.barostat)
