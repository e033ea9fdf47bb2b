"""Windows: coordinates held at one value after another.

- `window`: one window and its settings
- `ase_windows`, `openmm_windows`: who samples it
- `free_energy`: what windows have found, and how it is shown
- `driver`: many of them, by any executor
- `input_file`: windows as a file describes them
"""
