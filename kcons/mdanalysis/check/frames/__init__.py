"""What is found in one frame after another.

- `four_rows`, `frame_kernels`: the compiled loops
- `deviations`: what they find, by row and by frame
- `length_table`, `row_table`: rows laid out for them
"""
