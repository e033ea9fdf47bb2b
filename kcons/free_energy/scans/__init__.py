"""Relaxed scans: minima of the energy at held values of coordinates.

- `grid`: the points
- `attempts`: relaxations, kept one by one as they are done
- `one_thread`: small matrices without threads
- `model_hessian`, `relaxation`: the optimiser
- `relaxed_scan`: from neighbour to neighbour
- `scan_report`: tables, pictures, files
- `system_calculator`: a System of OpenMM as a calculator of ASE
"""
