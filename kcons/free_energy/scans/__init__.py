"""Relaxed scans.

- `relaxation`: minima on constraints with few evaluations
- `relaxed_scan`: the scan, its points, what it found and its files
"""
