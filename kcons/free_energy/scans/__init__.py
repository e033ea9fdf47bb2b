"""Relaxed scans: minima of the energy at held values of coordinates.

- `grid`: the points
- `model_hessian`, `relaxation`: the optimizer
- `relaxed_scan`: from neighbor to neighbor
- `scan_result`: what was found and how it is shown, and relaxations in files
- `system_calculator`: a System of OpenMM as a calculator of ASE
"""
