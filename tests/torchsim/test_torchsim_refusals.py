"""What is refused, each before anything has changed, in a sentence with a remedy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch_sim as ts
from torch_models import Drops, K, WithStress, drop, state_of

from kcons.constraints import Distance, FixedAtoms, Plane, VelocityFormula
from kcons.errors import InputError, UnsupportedError
from kcons.torchsim import hold, langevin, nose_hoover, nve, report


def held(n=2):
    state = drop(n)
    hold(state, "water")
    return state


@pytest.mark.parametrize(
    ("constraints", "options", "says"),
    [
        ("hbond", {}, "did you mean 'hbonds'"),
        ("hbonds, allbonds", {}, "'hbonds, allbonds'"),
        ("water", {"water_geometry": "tip9p"}, "no water model"),
        ([], {}, "nothing is to be held"),
        ([Distance(np.zeros((0, 2), int))], {}, "nothing is to be held"),
        ([Distance([0, 40])], {}, "40"),
        ([Distance([0, 1], [2.0])], {}, "project=True"),
        ([3.0], {}, "is no kcons constraint"),
        ([Distance([0, 1])], {"rigid_bodies": [[0, 1, 2]]}, "rigid_bodies: options of names"),
    ],
    ids=str,
)
def test_bad_input_is_named_and_leaves_the_state(constraints, options, says):
    state = drop(2)
    x = state.positions.clone()
    with pytest.raises(InputError, match=says):
        hold(state, constraints, **options)
    assert state.constraints == [] and torch.equal(state.positions, x)


def test_the_system_is_named():
    state = ts.concatenate_states([drop(2), drop(2, 1)])
    state.positions[7, 0] += 0.2
    with pytest.raises(InputError, match="Distance") as error:
        hold(state, "water", water_geometry="tip3p")
    assert "system 1" in " ".join(error.value.__notes__)


@pytest.mark.parametrize(
    "row", [Distance([0, 1], lambda t: [1.0 + t]), VelocityFormula("vx1", 0)], ids=["moving target", "velocities"]
)
def test_rows_that_need_the_time_are_refused(row):
    with pytest.raises(UnsupportedError, match=r"kcons\.steppers"):
        hold(drop(1), [row])


def test_other_objects_are_refused():
    with pytest.raises(InputError, match=r"torch_sim\.SimState"):
        hold(drop(1).to_atoms(), "water")
    with pytest.raises(InputError, match=r"call kcons\.torchsim\.hold"):
        nve.init(drop(1), Drops(), kT=300 * K)
    with pytest.raises(InputError, match=r"call kcons\.torchsim\.hold"):
        report(drop(1))


def test_constraints_of_torchsim_beside_are_refused():
    state = drop(2)
    state.constraints = ts.constraints.FixCom([0])
    with pytest.raises(UnsupportedError, match="FixCom"):
        hold(state, "water")
    state = held()
    with pytest.raises(UnsupportedError, match=r"Constraints on the state.* one call of hold"):
        hold(state, "water")
    state.constraints = [*state.constraints, ts.constraints.FixCom([0])]
    with pytest.raises(UnsupportedError, match="FixCom"):
        nve.init(state, Drops(), kT=300 * K)


def test_momentum_that_is_conserved_along_some_axes_is_refused():
    """A Nose-Hoover chain would give it its share of the heat, and never change it; friction does."""
    state = ts.concatenate_states([drop(1), drop(1, 1)])
    hold(state, ["water", Plane(0, [0, 0, 1])])
    numbers = state.rng.get_state()
    with pytest.raises(UnsupportedError, match=r"system 0 .* along 2 of three axes.*kcons\.torchsim\.langevin"):
        nose_hoover.init(state, Drops(), kT=300 * K, dt=1.0)
    assert torch.equal(state.rng.get_state(), numbers)
    langevin.init(state, Drops(), kT=300 * K)
    hold(fixed := drop(1), [FixedAtoms([0, 1, 2])])
    with pytest.raises(UnsupportedError, match=r"system 1 has no degrees of freedom left"):
        nose_hoover.init(ts.concatenate_states([held(), fixed]), Drops(), kT=300 * K, dt=1.0)


WRONG = [(langevin.step, "dt", -1.0), (nve.init, "kT", -1.0), (nve.step, "gamma", 5.0), (nose_hoover.init, "tau", 0)]
WRONG += [(langevin.step, "dt", torch.tensor([1.0, np.inf])), (nose_hoover.step, "dt", torch.tensor([1.0, np.nan]))]


@pytest.mark.parametrize(("call", "item", "value"), [*WRONG, (langevin.step, "kT", [1.0, 1.0, 1.0])])
def test_settings_that_are_none_are_refused(call, item, value):
    with pytest.raises((InputError, TypeError), match=rf"{item} is .*; give|{item} has shape|argument '{item}'"):
        call(nve.init(held(), Drops(), kT=300 * K), Drops(), **{"dt": 1.0, "kT": 300 * K, item: value})


@pytest.mark.filterwarnings("ignore")  # TorchSim's own about constraints
@pytest.mark.parametrize("integrator", ts.Integrator)
def test_integrators_of_torchsim_are_refused(integrator):
    """They cool the system: positions are corrected and momenta are not."""
    x = drop(8).positions.numpy()
    state = state_of(x, [8, 1, 1] * 8, np.tile([15.999, 1.008, 1.008], 8), cell=9.3 * np.eye(3))
    hold(state, "water")
    pressure = {"external_pressure": 0.0} if integrator.startswith("npt") else {}
    with pytest.raises(UnsupportedError, match=r"kcons\.torchsim\.nve, langevin or nose_hoover"):
        ts.integrate(state, WithStress(), integrator=integrator, n_steps=2, temperature=300, timestep=0.001, **pressure)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda state: setattr(state, "masses", 2 * state.masses), "mass"),
        (lambda state: setattr(state, "cell", 1.1 * state.cell), "cell"),
        (lambda state: setattr(state, "pbc", False), "pbc"),
        (lambda state: state.positions[1].add_(0.1), "atom [012] 0.0.* off its constraints"),
    ],
    ids=["masses", "cell", "pbc", "positions"],
)
def test_a_state_that_has_become_another_is_refused(change, says):
    x = drop(2).positions.numpy()
    state = state_of(x, [8, 1, 1] * 2, np.tile([15.999, 1.008, 1.008], 2), cell=12.0 * np.eye(3))
    hold(state, "water")
    change(state)
    with pytest.raises(InputError, match=rf"system 0 .*{says}.*hold again"):
        nve.init(state, Drops(), kT=300 * K)


def test_masses_that_are_edited_in_a_run_are_refused():
    state = nve.init(held(), Drops(), kT=300 * K)
    state = nve.step(state, Drops(), dt=torch.tensor(0.01))
    with torch.inference_mode(), pytest.raises(UnsupportedError, match=r"use torch\.no_grad\(\)"):
        nve.step(state, Drops(), dt=torch.tensor(0.01))
    state.masses.mul_(2)
    with pytest.raises(InputError, match="system 0 has masses"):
        nve.step(state, Drops(), dt=torch.tensor(0.01))


def test_positions_that_are_edited_between_steps_are_refused():
    model, settings = Drops(), {"dt": torch.tensor(0.01)}
    state = nve.step(nve.init(held(), model, kT=300 * K), model, **settings)
    state.positions.add_(0.3)  # stays on the constraints
    state = nve.step(state, model, **settings)
    for edit in (lambda x: x[1].add_(0.1), lambda x: setattr(state, "positions", x + torch.eye(len(x), 3) * 0.1)):
        kept = state.positions.clone()
        edit(state.positions)
        with pytest.raises(InputError, match=r"atom [012] .* off its constraints"):
            nve.step(state, model, **settings)
        state.positions = kept
    nve.step(state, model, **settings)
