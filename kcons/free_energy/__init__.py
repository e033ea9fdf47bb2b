"""Free energies along held coordinates, and relaxed scans.

- `grid`, `attempts`, `model_hessian`, `relaxation`, `relaxed_scan`: minima with coordinates held at the points of a grid
"""

from kcons.free_energy.relaxed_scan import Scan, scan

__all__ = ["Scan", "scan"]
