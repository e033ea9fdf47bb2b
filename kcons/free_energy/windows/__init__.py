"""Windows: coordinates held at one value after another.

- `window`: one window and its settings
- `ase_windows`, `openmm_windows`: recording in runs of ASE and OpenMM, and who samples windows
- `driver`: many of them, by any executor, and what they have found
- `input_file`: windows as a file describes them
"""
