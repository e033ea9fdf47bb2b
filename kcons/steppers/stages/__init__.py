"""What steps are made of.

- `drifts`: constrained flight without forces
- `friction`: friction of the system
- `compensated_steps`: positions and velocities on their way, without adding up rounding errors
- `fused_stages`: whole stages in one compiled call
"""
