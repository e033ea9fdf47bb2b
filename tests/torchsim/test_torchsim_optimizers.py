"""Optimizers of TorchSim on held geometry: they end on the constraints, where no force is left along them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch_sim as ts
from torch_models import Butanes, WithStress, butane, drop, off

from kcons.constraints import Dihedral
from kcons.errors import ConvergenceError, UnsupportedError
from kcons.torchsim import hold

CARBONS = [0, 1, 2, 3]
MOST = 0.02


def left_over(state, model):
    """The largest part of a force along the constraints, by the engine on arrays, of each system."""
    (held,) = state.constraints
    forces = model(state)["forces"]
    found = []
    for motion, k in zip(held.motions, held.system_idx.tolist(), strict=True):
        part = state.system_idx == k
        x, f = (values[part].double().numpy() for values in (state.positions, forces))
        found.append(np.linalg.norm(motion.project_forces(x, f), axis=1).max())
    return np.array(found)


def bent_butanes(copies):
    states = []
    random = torch.Generator().manual_seed(1)
    for k in range(copies):
        state = butane()
        state.positions += 0.06 * torch.randn(state.positions.shape, dtype=state.dtype, generator=random)
        hold(state, ["hbonds", Dihedral([CARBONS], [0.4 + 0.5 * k])], project=True)
        states.append(state)
    return ts.concatenate_states(states)


@pytest.mark.parametrize(
    ("optimizer", "settings"),
    [
        (ts.Optimizer.fire, {}),
        (ts.Optimizer.fire, {"fire_flavor": "vv_fire"}),
        (ts.Optimizer.gradient_descent, {"pos_lr": 0.01}),
        (ts.Optimizer.bfgs, {}),
        (ts.Optimizer.lbfgs, {}),
    ],
    ids=lambda value: str(getattr(value, "value", value)),
)
def test_optimizers_end_on_the_constraints(optimizer, settings):
    model, state = Butanes(), bent_butanes(4)
    before = model(state)["energy"]
    init = {"fire_flavor": "vv_fire"} if settings.get("fire_flavor") else {}
    end = ts.optimize(
        state,
        model,
        optimizer=optimizer,
        convergence_fn=ts.generate_force_convergence_fn(MOST),
        max_steps=1500,
        init_kwargs=init,
        **settings,
    )
    assert off(end).max() < 1e-10
    assert (end.energy < before - 0.01).all()
    assert left_over(end, model).max() < 20 * MOST
    assert float(ts.system_wise_max_force(end).max()) < MOST
    unheld = end.clone()
    unheld.constraints = []
    assert float(model(unheld)["forces"].norm(dim=1).max()) > 2 * MOST  # there is something that the rows hold


def test_systems_that_are_swapped_in_and_out():
    """With an autobatcher: as each alone."""
    model, state = Butanes(), bent_butanes(5)
    batcher = ts.InFlightAutoBatcher(model, memory_scales_with="n_atoms", max_memory_scaler=30)
    settings = dict(optimizer=ts.Optimizer.fire, convergence_fn=ts.generate_force_convergence_fn(MOST), max_steps=1000)
    together = ts.optimize(state, model, autobatcher=batcher, **settings)
    assert off(together).max() < 1e-10
    alone = ts.optimize(state[3], model, **settings)
    assert abs(float(together.energy[3] - alone.energy[0])) < 1e-3


@pytest.mark.parametrize("optimizer", [ts.Optimizer.fire, ts.Optimizer.gradient_descent])
def test_cells_are_not_relaxed(optimizer):
    state = drop(3)
    hold(state, "water")
    with pytest.raises(UnsupportedError, match="relax positions alone"):
        ts.optimize(
            state, WithStress(), optimizer=optimizer, max_steps=5, init_kwargs={"cell_filter": ts.CellFilter.unit}
        )


def test_steps_that_cannot_be_held_are_told():
    state = ts.concatenate_states([drop(2), drop(2, 1)])
    hold(state, "water")
    far = state.positions.clone()
    far[6:9] += torch.tensor([[0.0], [40.0], [-40.0]], dtype=far.dtype)
    given = far.clone()
    with pytest.raises(ConvergenceError, match="copy 1, row"):
        state.constraints[0].adjust_positions(state, far)
    assert torch.equal(far, given)
