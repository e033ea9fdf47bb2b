"""Derivatives of projections against differences, and what they cost."""

import numpy as np
import pytest
import torch
from torch.utils.checkpoint import checkpoint

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, clusters, gbaoab, rattle
from kcons.constraints import Angle, Dihedral, Distance, Formula, Plane, Sphere
from kcons.errors import UnsupportedError
from tests.systems.constraint_cases import MASSES, blade, scattered

#: A tree, a ring with a dihedral, atoms on surfaces, and a blade.
HELD = {
    "water": [Distance([[0, 1], [0, 2], [1, 2]])],
    "angles": [Distance([[0, 1], [1, 2], [2, 3]]), Angle([[0, 1, 2]]), Dihedral([[0, 1, 2, 3]])],
    "surfaces": [Sphere(0, [5.0, 0, 0]), Plane([1], [1.0, 2.0, 0.5]), Distance([[0, 1], [1, 2]])],
    "formula": [Formula("sin(x1 - x2) + z1*z2/4", [[0, 1]], target=None), Distance([[1, 2]])],
    "blade": [Distance([[0, 1]]), blade([0, 1], [0.0, 0.1, 1.0], 0.3)],
}


@pytest.fixture(params=["lanes", "levels"])
def elimination(request, monkeypatch):
    if request.param == "levels":
        monkeypatch.setattr(clusters, "LANES_ROWS", 0)


def system(name, copies=2, seed=6):
    """A batch, positions on its rows, displaced ones, and velocities, of the first atoms."""
    x = scattered(seed)[:4]
    motion = Motion(ConstraintSet(HELD[name], x, MASSES[:4]), x)
    rng = np.random.default_rng(1)
    start = torch.as_tensor(x).repeat(copies, 1)
    d, v = (torch.as_tensor(rng.normal(size=start.shape)) for _ in range(2))
    batch = Batch(motion, copies=copies)
    tracked = [start, start + 0.02 * d, v, batch.targets, batch.masses]
    return batch, [each.clone().requires_grad_() for each in tracked]


@pytest.mark.parametrize("name", HELD)
def test_derivatives_are_those_of_the_solution(name, elimination):
    batch, (x, y, v, targets, masses) = system(name)

    def positions(y, x, targets, masses):
        return batch.solve_positions(y, x, flight=0.1, targets=targets, masses=masses)

    def velocities(x, v, masses):
        return batch.project_velocities(x, v, masses=masses)

    def multipliers(x, v, f):
        return batch.multipliers(x, v, f)

    assert torch.autograd.gradcheck(positions, (y, x, targets, masses), atol=1e-7, rtol=1e-6)
    assert torch.autograd.gradcheck(velocities, (x, v, masses), atol=1e-7, rtol=1e-6)
    assert torch.autograd.gradcheck(multipliers, (x, v, y), atol=1e-6, rtol=1e-5)
    with pytest.raises(UnsupportedError, match="first derivatives alone"):  # and no zeros for second ones
        torch.autograd.functional.hessian(lambda y: positions(y, x, targets, masses)[0].pow(2).sum(), y)


def test_lengths_and_charges_through_a_trajectory():
    """Five steps of RATTLE: derivatives by a length and a force constant against differences."""
    batch, (x, _, v, targets, masses) = system("water", 3)
    shape = targets.detach()

    def end(scale, stiffness, masses):
        lengths = shape * scale
        here = batch.project_positions(x.detach(), x.detach(), targets=lengths, masses=masses)
        force = lambda y: -stiffness * y  # noqa: E731
        now = here, batch.project_velocities(here, v.detach(), masses=masses), force(here)
        for _ in range(5):
            now = rattle(batch, force, *now, 0.02, targets=lengths, masses=masses)
        return now[0].sum(), now[1].square().sum()

    one = torch.ones((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(end, (one, 2 * one.detach().requires_grad_(), masses), atol=1e-6, rtol=1e-5)


def test_langevin_steps_are_differentiable():
    batch, (x, _, v, _, _) = system("angles", 2)

    def end(kT, v):
        rng = torch.Generator().manual_seed(3)
        start = batch.project_velocities(x.detach(), v)
        return gbaoab(batch, lambda y: -y, x.detach(), start, -x.detach(), 0.02, kT, 1.0, generator=rng)[:2]

    kT = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(end, (kT, v), atol=1e-6, rtol=1e-5)


def test_blocks_of_steps_can_be_made_again_in_the_backward_pass():
    """With torch's own checkpoints, noise included: bit for bit the same derivative."""
    batch, (x, _, v, _, _) = system("water", 3)
    start = x.detach(), batch.project_velocities(x.detach(), v.detach())

    def end(stiffness, through):
        def block(*now):
            for _ in range(4):
                now = gbaoab(batch, lambda y: -stiffness * y, *now, 0.02, 1.0, 1.0)
            return now

        torch.manual_seed(1)
        now = *start, -stiffness * start[0]
        for _ in range(3):
            now = through(block, *now)
        return now[0].square().sum()

    stiffness = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    whole = end(stiffness, lambda block, *now: block(*now))
    again = end(stiffness, lambda block, *now: checkpoint(block, *now, use_reentrant=False))
    assert again == whole
    assert torch.autograd.grad(again, stiffness) == torch.autograd.grad(whole, stiffness)


def test_what_is_kept_for_derivatives():
    """Of a step of rigid water at most 250 bytes, whatever the iterations."""
    x = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]])
    n, kept = 50, {}
    batch = Batch(Motion(ConstraintSet(HELD["water"], x, [16.0, 1.0, 1.0]), x), copies=n)
    here = torch.as_tensor(x).repeat(n, 1)
    x, v, f = here.clone().requires_grad_(), 0.1 * torch.sin(here), torch.zeros_like(here)
    force = lambda y: torch.zeros_like(y)  # noqa: E731

    def pack(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor  # as long as it is kept nobody else gets the place
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        for step in range(11):
            if step == 1:
                first = set(kept)
            x, v, f = rattle(batch, force, x, v, f, 0.1)
    size = sum(t.numel() * t.element_size() for place, t in kept.items() if place not in first)
    assert 0 < size / n / 10 <= 250
