"""Charge and O-H length of a rigid water model, fitted to trajectories of another model by gradients through RATTLE.

Run with ``python examples/water_model_by_gradients.py``; ten seconds. It needs PyTorch. Units: nm, ps, dalton, kJ/mol.
"""

import numpy as np
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, rattle
from kcons.constraints import Distance

n, sine, cosine = 8, np.sin(np.radians(52.26)), np.cos(np.radians(52.26))
wanted = torch.tensor([0.417, 0.09572], dtype=torch.float64)  # TIP3P: charge of a hydrogen, O-H length

# Waters on a grid, each turned at random, with thermal velocities.
rng = np.random.default_rng(1)
water = 0.09572 * np.array([[0, 0, 0], [sine, cosine, 0], [-sine, cosine, 0]])
grid = 0.3 * np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(n, 1, 3)
start = (water @ np.linalg.qr(rng.normal(size=(n, 3, 3)))[0] + grid).reshape(-1, 3)
masses = np.tile([15.999, 1.008, 1.008], n)
pairs = (3 * np.arange(n)[:, None, None] + [[0, 1], [0, 2], [1, 2]]).reshape(-1, 2)
batch = Batch(Motion(ConstraintSet(Distance(pairs), start, masses), start))
begin, speeds = torch.as_tensor(start), torch.as_tensor(rng.normal(size=start.shape) * np.sqrt(2.5 / masses[:, None]))
one, two = torch.tensor([(i, j) for i in range(3 * n) for j in range(i) if i // 3 != j // 3]).T


def trajectory(charge: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
    """Positions of the oxygens in 15 steps of 2 fs."""
    lengths = torch.stack([length, length, 2 * sine * length]).repeat(n)
    charges = torch.stack([-2 * charge, charge, charge]).repeat(n)

    def force(x: torch.Tensor) -> torch.Tensor:
        r = (x[one] - x[two]).norm(dim=1)
        near = (0.315 / r[(one % 3 == 0) & (two % 3 == 0)]) ** 6
        energy = (138.935 * charges[one] * charges[two] / r).sum() + 2.544 * (near * near - near).sum()
        return -torch.autograd.grad(energy, x, create_graph=True)[0]

    x = batch.project_positions(begin, begin, targets=lengths).requires_grad_()
    v, f, path = batch.project_velocities(x, speeds), force(x), []
    for _ in range(15):
        x, v, f = rattle(batch, force, x, v, f, 0.002, targets=lengths)
        path.append(x[::3])
    return torch.stack(path)


target, factors = trajectory(*wanted).detach(), torch.tensor([0.85, 0.95], dtype=torch.float64, requires_grad=True)
fit = torch.optim.LBFGS([factors], max_iter=20, line_search_fn="strong_wolfe", tolerance_change=1e-14)


def distance() -> torch.Tensor:
    fit.zero_grad()
    off = 1e6 * (trajectory(*(factors * wanted)) - target).square().mean()
    off.backward()
    print("charge {:.6f} e, O-H {:.6f} nm, off by".format(*(factors * wanted).tolist()), f"{off.sqrt().item():.1e} pm")
    return off


fit.step(distance)
assert torch.allclose(factors, torch.ones_like(factors), atol=1e-5)
