"""Particles on surfaces in OpenMM.

- `surface_rows`: what all surfaces share
- `quadrics`, `compiled_quadrics`: spheres, cylinders, planes, ellipsoids
- `tori`: tori
- `formulas`: surfaces given by a formula
- `surface_steps`: the program of a step
- `surface_integrator`: `SurfaceIntegrator`
"""
