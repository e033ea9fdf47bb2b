"""Grids of XTC that are too fine for the library that writes them."""

from __future__ import annotations

import MDAnalysis as mda
import numpy as np
import pytest

from kcons.errors import InputError
from kcons.mdanalysis import TrajectoryWriter
from kcons.mdanalysis.writing import _refuse_beyond_xtc as refuse_beyond_xtc


def test_fine_grids_are_written_only_where_they_are_read_again(tmp_path):
    """Beyond 2^23 steps it depends on the distances of neighbours whether XTC's packing is right."""
    rng = np.random.default_rng(1)
    far = rng.uniform(0, 60, size=(200, 3))
    near = np.repeat(rng.uniform(0, 60, size=(70, 3)), 3, axis=0)[:200] + rng.normal(size=(200, 3)) * 0.5
    with TrajectoryWriter(tmp_path / "a.xtc", 200, precision=7) as writer:
        with pytest.raises(InputError, match="in steps of 1e-06: nothing was written; give a smaller precision"):
            writer.write(far)
        writer.write(near)
    universe = mda.Universe.empty(200, trajectory=True).load_new(str(tmp_path / "a.xtc"))
    assert len(universe.trajectory) == 1
    np.testing.assert_allclose(universe.atoms.positions, near, atol=2e-5)


@pytest.mark.parametrize("atoms", [9, 10])
def test_few_atoms_have_no_grid(atoms):
    x = np.full((atoms, 3), 1e9)
    if atoms == 9:
        refuse_beyond_xtc(x, 3, "a.xtc")
        return
    with pytest.raises(InputError, match=r"a.xtc cannot hold coordinates up to 1e\+09 angstrom in steps of 0.01"):
        refuse_beyond_xtc(x, 3, "a.xtc")
