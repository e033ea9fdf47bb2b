"""Relaxed scans.

- `relaxation`: minima on constraints with few evaluations
- `system_calculator`: an OpenMM System as an ASE calculator
- `relaxed_scan`: the scan, its points, what it found and its files
"""
