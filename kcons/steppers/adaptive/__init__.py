"""Steps that choose their own size.

- `tolerated`: the tolerance, attempts at a step, and what is said where there is none
- `extrapolation`: a reversible scheme, extrapolated to many digits
"""
