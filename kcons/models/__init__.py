"""The same theory in other fields: flows of dynamical systems, and constrained growth.

- `flows`: dynamical systems as flows
- `growth`: models of growth, and constraints on them
"""
