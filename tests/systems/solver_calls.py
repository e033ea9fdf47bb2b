"""Requests to solvers of distances, with lengths and rates in the order of the solver's own rows."""

import numpy as np

from kcons.solvers.cluster_solver import Request


def positions(solver, x_new, x_ref, lengths=None, lattice=None, velocities=None, inv_dt=0.0, multipliers=None):
    request = Request(x_new, x_ref, by_row(solver, lengths), lattice, velocities=velocities, inv_dt=inv_dt)
    return solver.positions(request, multipliers)


def tangents(solver, x, y, rates=None, lattice=None, multipliers=None):
    return solver.tangents(Request(y, x, by_row(solver, rates), lattice), multipliers)


def by_row(solver, values):
    """The values by row number of the set; rows that the solver does not have would show as NaN."""
    if values is None:
        return None
    wanted = np.full(solver.rows.max() + 1, np.nan)
    wanted[solver.rows] = values
    return wanted
