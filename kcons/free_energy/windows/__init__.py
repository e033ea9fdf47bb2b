"""Windows: coordinates held at one value after another.

- `window`: one window and its settings
- `ase_windows`, `openmm_windows`: who samples it
- `window_results`: what windows have found
- `driver`: many of them, by any executor
- `input_file`: windows as a file describes them
- `windows_report`: what is shown of them
"""
