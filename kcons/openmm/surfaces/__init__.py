"""Particles on surfaces in OpenMM.

- `surface_rows`: surfaces as the part of an integrator
- `surface_integrator`: `SurfaceIntegrator`
"""
