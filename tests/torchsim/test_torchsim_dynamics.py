"""Dynamics: the trajectory of the engine on arrays, energy, temperature, distributions, failed steps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch_sim as ts
from torch_models import FS, Drops, Free, K, drop, off, total_energy

from kcons.errors import ConvergenceError, NonFiniteError
from kcons.steppers import Rattle, State, System, run
from kcons.torchsim import hold, langevin, nose_hoover, nve

RESULT = Path(__file__).parents[2] / "docs" / "results" / "torchsim.json"


def held_drops(systems, waters, rng=0):
    state = ts.concatenate_states([drop(waters, rng + k) for k in range(systems)])
    hold(state, "water")
    state.rng = rng
    return state


def go_on(pair, state, model, steps, dt, look=None, **settings):
    for k in range(steps):
        state = pair.step(state, model, dt=dt, **settings)
        if look is not None:
            look(k, state)
    return state


def settled(systems, waters, steps, rng=0, model=None):
    """Drops at 300 K: the grid falls together while friction is strong."""
    state = langevin.init(held_drops(systems, waters, rng), model or Drops(), kT=300 * K)
    return go_on(langevin, state, model or Drops(), steps, 2 * FS, kT=300 * K, gamma=0.05 / FS)


def test_constant_energy_is_the_trajectory_of_the_engine():
    """50 steps of RATTLE of two drops of other sizes, and the same on arrays."""
    model = Drops()
    state = ts.concatenate_states([drop(5, 5), drop(3, 3)])
    hold(state, "water")
    start = nve.init(state, model, kT=300 * K)
    end = go_on(nve, start.clone(), model, 50, 2 * FS)
    for k in range(2):
        alone = start[k]
        motion = alone.constraints[0].motions[0]

        def force(x, t, alone=alone):
            alone.positions = torch.tensor(x)
            return model(alone)["forces"].numpy()

        began = State(start[k].positions.numpy(), start[k].velocities.numpy())
        path = run(System(motion, force), began, 2 * FS, 50, stepper=Rattle())
        assert np.abs(path.positions - end[k].positions.numpy()).max() < 1e-10
        assert np.abs(path.velocities - end[k].velocities.numpy()).max() < 1e-10
        assert np.abs(start[k].positions.numpy() - end[k].positions.numpy()).max() > 0.05


@pytest.mark.slow
def test_energy_of_sixteen_drops_does_not_drift():
    """16 systems of 27 rigid waters, 150 steps of 2 fs: at most 0.001 kT a water."""
    model = Drops()
    state = settled(16, 27, 150, model=model)
    energies = [total_energy(state)]
    end = go_on(nve, state, model, 150, 2 * FS, look=lambda k, now: energies.append(total_energy(now)))
    course = torch.stack(energies).mean(1).numpy() / (27 * 300 * K)
    drift = np.polynomial.Polynomial.fit(np.arange(151), course, 1).convert().coef[1] * 150
    assert abs(drift) < 1e-3
    assert off(end).max() < 1e-13
    assert float(end.calc_temperature().mean()) > 250


def temperatures(pair, state, model, steps, dt, skip, **settings):
    """Mean of each system."""
    kept = []

    def look(k, now):
        if k >= skip:
            kept.append(now.calc_temperature().numpy())

    go_on(pair, state, model, steps, dt, look=look, **settings)
    return np.mean(kept, axis=0)


def error_of(means):
    """Of the mean of systems that know nothing of each other."""
    return np.std(means, ddof=1) / np.sqrt(len(means))


@pytest.mark.validation
@pytest.mark.parametrize("pair", [langevin, nose_hoover], ids=["langevin", "nose_hoover"])
def test_temperature_over_20_ps(pair):
    """Sixteen drops of 27 rigid waters at 2 fs: within two standard errors of 300 K."""
    model, settings = Drops(), {"kT": 300 * K}
    state = settled(16, 27, 2000, rng=7, model=model)
    if pair is langevin:
        start, settings["gamma"] = state, 0.005 / FS
    else:
        start = pair.init(state, model, dt=2 * FS, tau=100 * FS, **settings)
    means = temperatures(pair, start, model, 10_000, 2 * FS, 0, **settings)
    known = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    name = "langevin" if pair is langevin else "nose_hoover"
    known[name] = {"temperature": means.mean(), "standard_error": error_of(means), "systems": means.tolist()}
    RESULT.write_text(json.dumps(known, indent=1) + "\n")
    assert abs(means.mean() - 300) < 2 * error_of(means)


def test_momenta_are_drawn_from_the_canonical_distribution():
    """2 K / kT of rigid waters has the mean and the variance of a sum of as many squares as there are freedoms."""
    state = held_drops(200, 2, 3)
    for pair, freedom in ((langevin, 12), (nve, 9)):  # with constant energy the center of mass rests
        start = pair.init(state, Drops(), kT=300 * K)
        assert start.get_number_of_degrees_of_freedom().tolist() == [freedom] * 200
        twice = (start.momenta**2 / start.masses[:, None]).sum(1).reshape(200, -1).sum(1).numpy() / (300 * K)
        assert abs(twice.mean() - freedom) < 4 * np.sqrt(2 * freedom / 200)
        assert abs(twice.var(ddof=1) / (2 * freedom) - 1) < 4 * np.sqrt(2 / 199 * (1 + 6 / freedom))
        held = state.constraints[0]
        velocities = start.momenta / start.masses[:, None]
        kept = held.batch(start).project_velocities(start.positions, velocities)
        assert float((kept - velocities).abs().max()) < 1e-12
    drifting = langevin.init(state, Drops(), kT=300 * K)  # a chain would only scale what it moves by
    for each in (start, nose_hoover.init(drifting, Drops(), kT=300 * K, dt=FS)):
        assert float(each.momenta.reshape(200, -1, 3).sum(1).abs().max()) < 1e-12


def test_each_copy_may_have_its_own_temperature():
    state = ts.concatenate_states([drop(8, 2)] * 30)
    hold(state, "water")
    state.rng = 4
    wanted = torch.tensor([100.0, 300.0, 900.0], dtype=torch.float64).repeat(10)
    start = langevin.init(state, Free(), kT=wanted * K)
    end = go_on(langevin, start, Free(), 40, 2 * FS, kT=wanted * K, gamma=0.05 / FS)
    found = end.calc_temperature().reshape(10, 3).mean(0).numpy()
    assert np.abs(found / [100, 300, 900] - 1).max() < 4 * np.sqrt(2 / (48 * 10))


def test_what_nose_hoover_dynamics_conserves():
    model = Drops()
    state = settled(3, 8, 100, rng=2, model=model)
    kT = torch.tensor(300 * K, dtype=torch.float64)
    start = nose_hoover.init(state, model, kT=kT, dt=1 * FS, tau=50 * FS)
    known = []
    look = lambda k, now: known.append((ts.nvt_nose_hoover_invariant(now, kT), total_energy(now)))  # noqa: E731
    go_on(nose_hoover, start, model, 200, 1 * FS, look, kT=kT)
    conserved, energy = (torch.stack(part).numpy() for part in zip(*known, strict=True))
    assert np.ptp(conserved, axis=0).max() < 0.03 * np.ptp(energy, axis=0).min()


def test_chains_go_with_their_systems():
    """A slice goes on as the whole does."""
    model = Drops()
    start = nose_hoover.init(settled(4, 4, 20, model=model), model, kT=300 * K, dt=2 * FS)
    middle = go_on(nose_hoover, start, model, 10, 2 * FS, kT=300 * K)
    part = go_on(nose_hoover, middle[[2, 0]], model, 10, 2 * FS, kT=300 * K)
    whole = go_on(nose_hoover, middle, model, 10, 2 * FS, kT=300 * K)
    assert float((part.positions - whole[[2, 0]].positions).abs().max()) < 1e-11
    assert torch.allclose(part.chain_momenta, whole.chain_momenta[[2, 0]], rtol=1e-9)


@pytest.mark.parametrize("pair", [nve, langevin, nose_hoover], ids=["nve", "langevin", "nose_hoover"])
def test_a_failed_step_leaves_the_state(pair):
    model = Drops()
    state = pair.init(held_drops(3, 2), model, kT=300 * K, dt=2 * FS)
    state.momenta = state.momenta.clone()
    state.momenta[7] += 900 * state.masses[7]
    before = {name: value.clone() for name, value in vars(state).items() if torch.is_tensor(value)}
    with pytest.raises(ConvergenceError, match=r"copy 1.* smaller time step"):
        pair.step(state, model, dt=4 * FS, kT=300 * K)
    assert all(torch.equal(getattr(state, name), value) for name, value in before.items())
    pair.step(state, model, dt=0.0001 * FS, kT=300 * K)  # goes on


@pytest.mark.parametrize("pair", [nve, langevin, nose_hoover], ids=["nve", "langevin", "nose_hoover"])
def test_forces_that_are_not_finite_are_named(pair):
    state = pair.init(held_drops(3, 2), Drops(), kT=300 * K, dt=2 * FS)
    bad = torch.where(torch.arange(18)[:, None] < 8, 0.0, torch.inf).expand(18, 3)
    model = lambda state: {**Drops()(state), "forces": bad}  # noqa: E731
    for call in (pair.step, pair.init):
        before = dict(vars(state))
        with pytest.raises(NonFiniteError, match=r"force of atom 8 \(in system 1\)"):
            call(state, model, dt=2 * FS, kT=300 * K)
        assert vars(state) == before


def test_the_settings_of_integrate_are_in_the_units_of_torchsim():
    """`gamma` in 1/ps and `tau` in ps, as for the integrators of TorchSim; internal units where steps are called."""
    model, state = Drops(), held_drops(2, 2)
    made = ts.integrate(state, model, integrator=langevin, n_steps=3, temperature=300, timestep=0.002, gamma=5.0)
    start = langevin.init(state.clone(), model, kT=300 * K)
    again = go_on(langevin, start, model, 3, 2 * FS, kT=300 * K, gamma=0.005 / FS)
    assert float((made.positions - again.positions).abs().max()) < 1e-12
    made = ts.integrate(
        state, model, integrator=nose_hoover, n_steps=1, temperature=300, timestep=0.002, init_kwargs={"tau": 0.1}
    )
    assert torch.allclose(made.tau, torch.tensor(100 * FS, dtype=torch.float64))
