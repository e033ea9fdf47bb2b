"""Clusters of any connectivity, by sparse elimination of A M^-1 A^T.

- `elimination`: order and pattern, found once
- `row_functions`: rows that are called by their addresses, alone or many at once
- `newton`: Newton's method and refinement of tangents, whatever the rows are
- `distances`: held distances
- `mixed_rows`: rows of mixed kinds
"""
