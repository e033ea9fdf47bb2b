"""What compiled kernels are made of.

- `aligned_memory`: memory for the kernels
- `array_views`: views of arrays that are not counted
- `lattices`: lattices and minimum images
- `any_width`: numbers some doubles wide
- `eight_wide`: a number eight doubles wide
- `two_and_four_wide`: numbers two and four doubles wide
"""
