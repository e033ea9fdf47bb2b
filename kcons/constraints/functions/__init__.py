"""Functions of one's own as rows.

- `custom`: functions in Python, or compiled by Numba
- `straight_line`: functions of rows as lists of operations: for derivatives, and for engines in other languages
- `formula`: formulas read, written as code, and held
"""
