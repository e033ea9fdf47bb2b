"""Positions that are off the constraints, brought onto them; for starts, not for time steps.

- `nearest_point`: the nearest point in the mass metric, and steps downhill along the constraints
- `kept_geometry`: molecules, with bonds and angles that are to stay as they were
- `moved_groups`: structures brought to a target by moving groups
"""
