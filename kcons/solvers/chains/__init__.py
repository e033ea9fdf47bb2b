"""Open chains of held distances, of any length.

- `strips`: how chains are laid out, eight to a strip
- `sweeps`: Newton's method in two sweeps along a chain
- `open_chains`: the solver
"""
