"""Rows that are singular only at second order: linear and planar bodies held by distances.

- `singular_rows`: the test, and one block of rows with dense algebra
- `flat_bodies`: linear and planar rigid groups in a block, and the linear rows that hold them
- `conversion`: found at set-up, converted to linear rows or refused
"""
