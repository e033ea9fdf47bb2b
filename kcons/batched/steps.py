"""Time steps of a batch, as functions that torch differentiates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcons.batched.batch import Batch

#: Forces, of the shape of positions.
Force = Callable[[Tensor], Tensor]


def kick(batch: Batch, x: Tensor, v: Tensor, forces: Tensor, h: float, **options: Any) -> Tensor:
    """Velocities after forces have acted for a time h at positions x, on the rows: v + h M_par^+ f.

    `options` are those of `Batch.project_velocities`.
    """
    return batch.project_velocities(x, v + h * _inverse_masses(batch, x, options) * forces, **options)


def drift(batch: Batch, x: Tensor, v: Tensor, h: float, **options: Any) -> tuple[Tensor, Tensor]:
    """Positions after a time h on the rows, and velocities with the impulse that has kept them there.

    Velocities are not projected at the new place. `options` are those of `Batch.solve_positions`; the `time` is that of
    the end.
    """
    time = options.pop("time", 0.0)
    found = batch.solve_positions(x + h * v, x, time=time, reference_time=time - h, flight=h, **options)
    return found.positions, v + found.push / h


def rattle(
    batch: Batch,
    force: Force,
    x: Tensor,
    v: Tensor,
    forces: Tensor,
    dt: float,
    *,
    time: float = 0.0,
    targets: Tensor | None = None,
    masses: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of RATTLE: order two, reversible, on the rows; differentiable in all that are tensors.

    Parameters
    ----------
    batch : Batch
    force : callable
        Forces at positions, of the same shape.
    x, v, forces : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
        Positions and velocities on the rows, and the forces there.
    dt : float
    time : float
        At the beginning of the step.
    targets, masses : Tensor, optional
        As for `Batch.solve_positions`.

    Returns
    -------
    x, v, forces : Tensor
        At the end of the step.

    References
    ----------
    H. C. Andersen, J. Comput. Phys. 52, 24 (1983).
    """
    half = 0.5 * dt * _inverse_masses(batch, x, {"masses": masses})
    x, v = drift(batch, x, v + half * forces, dt, time=time + dt, targets=targets, masses=masses)
    forces = force(x)
    return x, batch.project_velocities(x, v + half * forces, time=time + dt, masses=masses), forces


def gbaoab(
    batch: Batch,
    force: Force,
    x: Tensor,
    v: Tensor,
    forces: Tensor,
    dt: float,
    kT: float | Tensor,
    friction: float,
    *,
    generator: torch.Generator | None = None,
    time: float = 0.0,
    targets: Tensor | None = None,
    masses: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of Langevin dynamics on the rows, g-BAOAB with one step of positions each half.

    Parameters
    ----------
    batch, force, x, v, forces, dt, time, targets, masses
        As for `rattle`.
    kT : float or Tensor
        Temperature as an energy; of tensors one that is broadcast to velocities.
    friction : float
        Rate at which velocities are forgotten.
    generator : torch.Generator, optional
        Of the noise.

    References
    ----------
    B. Leimkuhler and C. Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """
    tangent = {"masses": masses}
    w = _inverse_masses(batch, x, tangent)
    v = kick(batch, x, v, forces, 0.5 * dt, time=time, **tangent)
    x, v = drift(batch, x, v, 0.5 * dt, time=time + 0.5 * dt, targets=targets, masses=masses)
    kept = torch.exp(torch.as_tensor(-friction * dt, dtype=x.dtype, device=x.device))
    noise = torch.randn(x.shape, dtype=x.dtype, device=x.device, generator=generator)
    v = kept * v + torch.sqrt((1 - kept * kept) * kT * w) * noise
    v = batch.project_velocities(x, v, time=time + 0.5 * dt, **tangent)
    x, v = drift(batch, x, v, 0.5 * dt, time=time + dt, targets=targets, masses=masses)
    forces = force(x)
    return x, kick(batch, x, v, forces, 0.5 * dt, time=time + dt, **tangent), forces


def _inverse_masses(batch: Batch, x: Tensor, options: dict[str, Any]) -> Tensor:
    return batch.weights(options.get("masses")).reshape(*x.shape[:-1], 1)
