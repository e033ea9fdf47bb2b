"""Particles on surfaces in OpenMM.

- `surface_rows`: what all surfaces share
- `landings`: quadrics, tori, and surfaces given by a formula
- `surface_integrator`: `SurfaceIntegrator`, and its step
"""
