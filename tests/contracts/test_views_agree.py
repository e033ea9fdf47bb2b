"""One system seen by MDAnalysis, ASE and OpenMM: the same rows, and those of OpenMM's createSystem."""

from __future__ import annotations

import numpy as np
import pytest
from host_systems import DHFR, VILLIN, quietly, read_atoms, read_universe
from openmm import app

import kcons.ase
import kcons.mdanalysis
import kcons.openmm

OPENMM = {"hbonds": app.HBonds, "allbonds": app.AllBonds, "hangles": app.HAngles}


@pytest.fixture(scope="module")
def force_field():
    return app.ForceField("amber14-all.xml", "amber14/tip3pfb.xml")


@pytest.fixture(scope="module", params=[VILLIN, DHFR], ids=["villin", "dhfr"])
def views(request):
    """MDAnalysis, ASE, OpenMM."""
    return read_universe(request.param), read_atoms(request.param), app.PDBFile(str(request.param))


@pytest.mark.parametrize("kind", ["hbonds", "allbonds", "hangles", "allangles"])
def test_three_views_give_identical_rows(views, kind):
    universe, atoms, pdb = views
    by_universe = quietly(kcons.mdanalysis.constraints_of, universe, kind)
    by_atoms = quietly(kcons.ase.constraints_of, atoms, kind)
    by_topology = kcons.openmm.constraints_of(pdb.topology, pdb.positions, kind)
    assert len(by_universe) == len(by_atoms) == len(by_topology)
    for one, two, three in zip(by_universe, by_atoms, by_topology, strict=True):
        assert one.family == two.family == three.family
        np.testing.assert_array_equal(one.atoms, two.atoms)
        np.testing.assert_array_equal(one.atoms, three.atoms)
        unit = 1.0 if one.family in ("Angle", "Dihedral") else 10.0  # nm
        turn = 2 * np.pi if one.family == "Dihedral" else np.inf
        for off in (two.target - one.target, three.target * unit - one.target):
            np.testing.assert_allclose(off - turn * np.round(off / turn) if turn < np.inf else off, 0.0, atol=1e-10)


@pytest.mark.parametrize("kind", list(OPENMM))
def test_the_pairs_are_those_of_create_system(views, kind, force_field):
    pdb = views[2]
    system = force_field.createSystem(pdb.topology, constraints=OPENMM[kind], rigidWater=True)
    theirs = {tuple(sorted(system.getConstraintParameters(k)[:2])) for k in range(system.getNumConstraints())}
    rows = quietly(kcons.mdanalysis.constraints_of, views[0], kind, angles="distances")
    ours = [tuple(sorted(pair)) for item in rows for pair in item.atoms.tolist()]
    assert len(ours) == len(set(ours)) == len(theirs)
    assert set(ours) == theirs


def test_hangles_as_angles_are_the_same_angles(views):
    rows = quietly(kcons.mdanalysis.constraints_of, views[0], "hangles")
    apart = quietly(kcons.mdanalysis.constraints_of, views[0], "hangles", angles="distances")
    angles = next(item for item in rows if item.family == "Angle")
    ends = {tuple(sorted((i, k))) for i, _, k in angles.atoms.tolist()}
    more = {tuple(sorted(p)) for item in apart for p in item.atoms.tolist()}
    less = {tuple(sorted(p)) for item in rows if item.family == "Distance" for p in item.atoms.tolist()}
    assert more - less == ends
    assert len(ends) == angles.n_rows > 100
