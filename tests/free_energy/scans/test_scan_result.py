"""What a scan found in tables, plots and files."""

from __future__ import annotations

import csv
from functools import cache

import ase.io
import numpy as np
import pytest
from scan_systems import chain, threefold, two_wells

from kcons.constraints import Dihedral, Distance
from kcons.free_energy import scan
from kcons.free_energy.scans.relaxed_scan import KJ

TURN = Dihedral([[0, 1, 2, 3]])


@cache
def line():
    """Four values, the second of which fails."""
    atoms = chain(4, threefold, lambda phi: RuntimeError("no") if 0.9 < phi[0] < 1.1 else None, turns=[0.5])
    return scan(atoms, TURN, [0.5, 1.0, 1.5, 2.0])


@cache
def surface():
    return scan(chain(4, threefold), [TURN, Distance([[1, 2]])], [np.radians([40, 60]), [1.3, 1.4, 1.5]])


def test_table_and_summary():
    table = line().table()
    energies = 0.2 * (1 + np.cos(3 * np.array([0.5, 1.5, 2.0]))) * KJ
    assert table.dihedral_0_1_2_3_degrees.tolist() == pytest.approx(np.degrees([0.5, 1.0, 1.5, 2.0]))
    assert table.energy_kJ_mol[[0, 2, 3]].tolist() == pytest.approx(energies - energies.min(), abs=2e-3)
    assert np.isnan(table.energy_kJ_mol[1]) and "CalculatorError" in table.error[1]
    assert table.calls.sum() == line().evaluations
    said = line().summary()
    assert said.startswith("3 of 4 points") and "failed: Dihedral(0, 1, 2, 3) = 57.2958: CalculatorError" in said
    assert surface().table().distance_1_2_angstrom.tolist() == pytest.approx([1.3, 1.4, 1.5] * 2)


def test_what_differs_by_the_way_is_said():
    found = scan(chain(5, two_wells, turns=[np.radians(-150), 0.3]), TURN, np.radians(np.arange(-165, 180, 30)))
    assert "from different neighbors the energy differs by up to" in found.summary()
    assert len(found.plot().axes[0].lines) == 2


def test_plots():
    axes = line().plot().axes[0]
    assert axes.get_xlabel() == "Dihedral(0, 1, 2, 3) / degrees"
    x, y = axes.lines[0].get_data()
    assert x[0] == pytest.approx(np.degrees(0.5)) and np.isnan(y[1]) and np.nanmin(y) == 0
    assert axes.lines[1].get_xdata() == pytest.approx([np.degrees(1.0)])  # the cross of the point that failed
    drawn, bar = surface().plot().axes
    assert drawn.get_ylabel() == "Distance(1, 2) / angstrom" and bar.get_ylabel() == "energy / (kJ/mol)"
    assert drawn.collections[0].get_array().shape == (3, 2)


def test_files(tmp_path):
    written = line().write(tmp_path / "new")
    assert [path.name for path in written] == ["scan.csv", "scan.png", "scan.extxyz"]
    rows = list(csv.DictReader(written[0].read_text().splitlines()))
    assert float(rows[2]["energy_eV"]) == line().energies[2] and rows[1]["energy_eV"] == ""
    frames = ase.io.read(written[2], ":")
    assert len(frames) == 3
    for frame, point in zip(frames, [(0,), (2,), (3,)], strict=True):
        assert frame.get_potential_energy() == line().energies[point]
        assert frame.info["dihedral_0_1_2_3"] == pytest.approx(np.degrees(line().grid.at(point)[0]))
        assert np.abs(frame.positions - line().best[point].positions).max() < 1e-7
    assert written[1].read_bytes().startswith(b"\x89PNG")
