"""Free energies from mean forces and from work.

- `gaussian_process`: a free energy learned from its gradient
- `profile`: in one coordinate, and where to sample next
- `mean_force_surface`: in several coordinates
- `pulls`: from the work of moving targets
- `plots`: figures of all of them
"""
