"""Free energies from mean forces and from work.

- `gaussian_process`: a free energy learned from its gradient
- `profile`: in one coordinate, where to sample next, and its figure; in several
- `pulls`: from the work of moving targets
"""
