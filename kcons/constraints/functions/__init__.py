"""Functions of one's own as rows.

- `custom`: functions in Python, or compiled by Numba
- `expressions`: formulas read, differentiated and written as code
- `formula`: rows that are formulas
- `straight_line`: functions of rows as lists of operations, for engines in other languages
"""
