"""Particles on surfaces in OpenMM.

- `surface_rows`: what all surfaces share
- `closed_forms`: spheres, cylinders, planes, ellipsoids, tori
- `formulas`: surfaces given by a formula
- `surface_steps`: the program of a step
- `surface_integrator`: `SurfaceIntegrator`
"""
