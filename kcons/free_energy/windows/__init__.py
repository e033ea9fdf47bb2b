"""Windows: coordinates held at one value after another.

- `driver`: one window and its settings, many of them by any executor, and what they have found
- `ase_windows`, `openmm_windows`: recording in runs of ASE and OpenMM, and who samples windows
- `input_file`: windows as a file describes them
"""
