"""Positions that are off the constraints, brought onto them; for starts, not for time steps.

- `descent`: steps downhill along the constraints, for minima and for the nearest point
- `nearest_point`: the nearest point in the mass metric
- `kept_geometry`: bonds and angles that are to stay as they were
- `rigid_pieces`: groups of atoms that turn and shift
- `moved_groups`: structures brought to a target by moving groups
"""
