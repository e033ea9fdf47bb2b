"""Hard cases: where constraints are difficult, and what must be true there, for kcons and other programs alike.

A case is a function with `hard_cases.case.case` as its decorator. Tests run all of them through kcons; the table with
ASE and OpenMM beside it comes from `examples/studies/hard_cases.py`.
"""
