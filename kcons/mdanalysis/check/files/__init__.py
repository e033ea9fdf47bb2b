"""What files say, and how much they can hold.

- `target_file`: lengths and angles from a parameter file
- `file_precision`: the precision of coordinates, by format
- `endings`: files that end early
- `plain_dcd`: DCD files read in blocks
"""
