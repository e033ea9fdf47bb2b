"""Time steps of a batch, as functions that torch differentiates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcons.batched.batch import Batch
from kcons.constraints.arguments import not_negative, positive
from kcons.errors import InputError


def _pushed(batch: Batch, x: Tensor, v: Tensor, forces: Tensor, h: Any, masses: Tensor | None) -> Tensor:
    """Velocities after forces have acted for a time h; those between atoms whose distance is held may be any."""
    for item, given in (("v", v), ("forces", forces)):
        if given.shape != x.shape:  # which torch would spread over copies
            raise InputError(f"{item} must have shape {tuple(x.shape)}, not {tuple(given.shape)}", item=item)
    return v + h * batch.weights(masses).reshape(*x.shape[:-1], 1) * forces


def kick(batch: Batch, x: Tensor, v: Tensor, forces: Tensor, h: Any, masses: Tensor | None = None) -> Tensor:
    """The same, on the rows."""
    return batch.project_velocities(x, _pushed(batch, x, v, forces, h, masses), masses=masses)


def drift(batch: Batch, x: Tensor, v: Tensor, h: Any, **held: Any) -> tuple[Tensor, Tensor]:
    """Positions a time h later on the rows, and velocities with the impulse that has kept them there."""
    found, push = batch.solve_positions(x + h * v, x, flight=h, **held)
    return found, v + push / (h + (h == 0))


def drift_in_bath(
    batch: Batch, x: Tensor, v: Tensor, dt: Any, bath: tuple[Any, Any, Any], **held: Any
) -> tuple[Tensor, Tensor]:
    """Half a flight, friction and noise, half a flight: g-BAOAB without its kicks; of a kT, a friction, a generator."""
    (kT, friction, generator), masses = bath, held.get("masses")
    w = batch.weights(masses).reshape(*x.shape[:-1], 1)
    x, v = drift(batch, x, v, 0.5 * dt, **held)
    kept = torch.exp(-friction * dt * torch.ones((), dtype=x.dtype, device=x.device))
    noise = torch.randn(x.shape, dtype=x.dtype, device=x.device, generator=generator)
    v = kept * v + torch.sqrt((1 - kept * kept) * kT * w) * noise
    return drift(batch, x, batch.project_velocities(x, v, masses=masses), 0.5 * dt, **held)


def rattle(
    batch: Batch, force: Callable[[Tensor], Tensor], x: Tensor, v: Tensor, forces: Tensor, dt: float, **held: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of RATTLE: order two, reversible; differentiable in all that are tensors.

    Parameters
    ----------
    batch : Batch
    force : callable
        Forces at positions, of the same shape.
    x, v, forces : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
        Positions and velocities on the rows, and the forces there.
    dt : float
    **held : Tensor
        `targets` and `masses`, as for `Batch.solve_positions`.

    Returns
    -------
    x, v, forces : Tensor
        At the end of the step.

    References
    ----------
    H. C. Andersen, J. Comput. Phys. 52, 24 (1983).
    """
    masses = held.get("masses")
    x, v = drift(batch, x, _pushed(batch, x, v, forces, 0.5 * dt, masses), dt, **held)
    forces = force(x)
    return x, kick(batch, x, v, forces, 0.5 * dt, masses), forces


def gbaoab(
    batch: Batch,
    force: Callable[[Tensor], Tensor],
    x: Tensor,
    v: Tensor,
    forces: Tensor,
    dt: float,
    kT: float | Tensor,
    friction: float,
    *,
    generator: torch.Generator | None = None,
    **held: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of Langevin dynamics, g-BAOAB; differentiable as `rattle`, which tells what else is given.

    Parameters
    ----------
    kT : float or Tensor
        Temperature as an energy; a tensor is broadcast to velocities.
    friction : float
        Rate at which velocities are forgotten.
    generator : torch.Generator, optional
        Of the noise.

    References
    ----------
    B. Leimkuhler and C. Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """
    positive(dt, "dt")  # noise cannot be taken back
    for item, given in (("kT", kT), ("friction", friction)):
        for extreme in torch.stack(torch.as_tensor(given).aminmax()).tolist():
            not_negative(extreme, item)
    masses = held.get("masses")
    v = kick(batch, x, v, forces, 0.5 * dt, masses)
    x, v = drift_in_bath(batch, x, v, dt, (kT, friction, generator), **held)
    forces = force(x)
    return x, kick(batch, x, v, forces, 0.5 * dt, masses), forces
