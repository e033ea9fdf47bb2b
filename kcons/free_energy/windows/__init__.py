"""Windows: coordinates held at one value after another.

- `window`: one window and its settings
- `ase_windows`, `openmm_windows`: who samples it
- `driver`: many of them, by any executor
"""
