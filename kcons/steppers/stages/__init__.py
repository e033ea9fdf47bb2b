"""What steps are made of.

- `compiled_operations`: operations one after another in one compiled call
- `packed_system`: what compiled operations know of a system
"""
