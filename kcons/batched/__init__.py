"""Constraints on many systems at once, on PyTorch tensors, for potentials that run there; differentiable.

Clusters of equal shape are solved side by side, across copies and molecules, on a processor or a GPU. What is held is
said by the engines (`kcons.Motion`) of the systems. Gradients go through positions, velocities, masses and lengths, by
the equations at the solution.

- `clusters`: families of constraints on tensors, and the equations of clusters that look alike, number by number or in
  one tensor, by sparse elimination
- `batch`: many systems, what is asked of them, where their clusters are, and projections that torch differentiates
- `steps`: RATTLE and Langevin dynamics
"""

from kcons.errors import with_extra

try:
    from kcons.batched.batch import Batch
    from kcons.batched.steps import gbaoab, rattle
except ModuleNotFoundError as error:
    raise with_extra(error, "kcons.batched") from error

__all__ = ["Batch", "gbaoab", "rattle"]
