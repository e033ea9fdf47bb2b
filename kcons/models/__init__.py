"""The same theory in other fields: multibody systems, flows of dynamical systems, and constrained growth.

- `integration`: SciPy's integrators with a projection after each step
- `multibody`: mechanical systems in any coordinates, with a full mass matrix
- `flows`: dynamical systems as flows
- `growth`: models of growth, and constraints on them
"""

from kcons.models.multibody import Multibody, MultibodySolution

__all__ = ["Multibody", "MultibodySolution"]
