"""Which periodic images rows mean.

- `one_piece`: clusters made whole along their rows
- `images`: the images of the atoms of rows, followed in time
"""
