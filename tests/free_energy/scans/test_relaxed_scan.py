"""Relaxed scans: known profiles, both ways, failures, resuming."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import ExternalForce, FixAtoms, Hookean
from scan_systems import chain, threefold, two_wells

from kcons.constraints import CenterDistance, Custom, Dihedral, Distance
from kcons.errors import CalculatorError, InputError, OccupiedError, UnreadableError
from kcons.free_energy import scan

TURN = Dihedral([[0, 1, 2, 3]])
RING = np.radians(np.arange(-180, 180, 30))


def profile(phi):
    """Of `threefold`, eV."""
    return 0.2 * (1 + np.cos(3 * np.asarray(phi)))


def test_a_torsion_has_its_profile():
    atoms = chain(4, threefold)
    before = atoms.positions.copy()
    found = scan(atoms, TURN, RING, fmax=1e-3)
    assert np.array_equal(atoms.positions, before) and not atoms.constraints
    np.testing.assert_allclose(found.energies, profile(RING), atol=2e-7)
    assert found.failed == {} and found.hysteresis.max() < 2e-7
    for point, attempt in found.best.items():
        phi = TURN.measure(attempt.positions[None, :4], 0.0)[0] - RING[point]
        assert abs(phi - 2 * np.pi * np.round(phi / (2 * np.pi))) < 1e-13
        assert attempt.largest <= 1e-3
    assert found.evaluations == atoms.calc.calls
    there = found.structure((3,))
    assert there.info["dihedral_0_1_2_3"] == pytest.approx(-90) and there.info["energy"] == found.energies[3]


def test_two_coordinates():
    atoms = chain(5, threefold)
    grid = [np.radians([-120.0, -60.0]), np.radians([40.0, 60.0, 80.0])]
    found = scan(atoms, [TURN, Dihedral([[1, 2, 3, 4]])], grid, fmax=2e-3)
    a, b = np.meshgrid(*grid, indexing="ij")
    np.testing.assert_allclose(found.energies, profile(a) + profile(b), atol=1e-6)
    assert found.energies.shape == (2, 3) and found.failed == {}
    assert found.grid.neighbors((0, 0)) == [(1, 0), (0, 1)]


def lowest(a):
    """Of `two_wells`, over the second dihedral."""
    b = np.linspace(-np.pi, np.pi, 20001)
    return np.min(0.1 * (1 - np.cos(2 * b)) + 0.6 * np.sin(a)[:, None] * np.cos(b - 0.4), axis=1)


def test_a_cell_that_cuts_the_molecule_changes_nothing():
    found = []
    for cell in (None, [8.0, 9.0, 10.0]):
        atoms = molecule("H2O2")
        if cell is not None:
            atoms.set_cell(cell)
            atoms.pbc = True
            atoms.positions += 4.2
            atoms.positions[:] = atoms.positions % cell
            atoms.positions[0, 0] -= 8.0
        atoms.calc = EMT()
        found.append(scan(atoms, Dihedral([[2, 0, 1, 3]]), [1.0, 1.4]))
    assert found[0].evaluations == found[1].evaluations
    np.testing.assert_allclose(found[0].energies, found[1].energies, atol=1e-6)


def test_values_that_descend_stay_in_their_order():
    """The first value, again at the end of a whole turn, is left out, and next to the last one."""
    values = np.radians(np.arange(180, -181, -30))
    found = scan(chain(4, threefold, turns=[1.0]), TURN, values, fmax=1e-3)
    np.testing.assert_allclose(found.energies, profile(values[:-1]), atol=2e-7)
    assert found.grid.neighbors((0,)) == [(1,), (11,)] and found.attempts[0].point == (4,)
    assert found.grid.said((1,)) == "Dihedral(0, 1, 2, 3) = 150"


def test_both_ways_find_the_lower_of_two_minima():
    """One way, the scan stays in a minimum that is not the lowest any more until that one is gone."""
    values = np.radians(np.arange(-165, 180, 15))
    atoms = chain(5, two_wells, turns=[np.radians(-150), 0.3])
    one = scan(atoms, TURN, values, fmax=2e-3, both_ways=False)
    both = scan(atoms, TURN, values, fmax=2e-3)
    truth = lowest(values)
    np.testing.assert_allclose(both.energies, truth, atol=3e-6)
    assert np.max(one.energies - truth) > 0.02
    assert both.hysteresis.max() > 0.02 and one.hysteresis.max() == 0.0
    assert len(one.attempts) == len(values) < len(both.attempts)


def test_what_else_is_held_stays():
    """Constraints of kcons and of ASE; those that only add forces count in the energy."""
    atoms = chain(5, threefold)
    atoms.set_constraint(FixAtoms([0]))
    found = scan(atoms, Dihedral([[1, 2, 3, 4]]), [0.5, 0.6], held=Distance([[2, 3]], 1.5), fmax=2e-3)
    for attempt in found.best.values():
        np.testing.assert_allclose(attempt.positions[0], atoms.positions[0], atol=1e-14)
        assert abs(np.linalg.norm(attempt.positions[2] - attempt.positions[3]) - 1.5) < 1e-14
    np.testing.assert_allclose(found.energies, profile([0.5, 0.6]) + 15 * 0.1**2, atol=2e-6)
    atoms.set_constraint(Hookean(0, 4, k=1.0, rt=3.0))
    assert scan(atoms, TURN, [0.5], fmax=2e-3).energies[0] > profile(0.5) + 0.01
    assert [type(item) for item in atoms.constraints] == [Hookean]
    pair = [scan(atoms, row, [1.5], fmax=2e-3).energies for row in (Distance([[0, 1]]), CenterDistance([0], [1]))]
    np.testing.assert_allclose(*pair, atol=1e-6)


def test_one_failed_point_does_not_stop_the_others():
    def fails(phi):
        at = np.degrees(phi[0])
        return RuntimeError("no convergence") if 50 < at < 70 else np.nan if -70 < at < -50 else None

    found = scan(chain(4, threefold, fails), TURN, RING)
    assert set(found.failed) == {(4,), (8,)}
    assert found.failed[8,].startswith("Dihedral(0, 1, 2, 3) = 60: CalculatorError: the calculator failed")
    assert "RuntimeError: no convergence" in found.failed[8,]
    assert "NonFiniteError: the force on atom 0 is not finite" in found.failed[4,]
    good = np.isfinite(found.energies)
    assert good.sum() == 10
    np.testing.assert_allclose(found.energies[good], profile(RING[good]), atol=2e-5)
    with pytest.raises(InputError, match="no structure at"):
        found.structure((4,))


def test_where_nothing_succeeds_the_first_error_is_raised():
    with pytest.raises(CalculatorError, match="broken") as raised:
        scan(chain(4, threefold, lambda phi: ValueError("broken")), TURN, RING[:3])
    assert isinstance(raised.value.__cause__, ValueError)


def test_a_failed_point_is_tried_again_by_the_next_run(tmp_path):
    """Once in a run; what was tried before is not done again, whatever came of it."""
    broken = [True]

    def fails(phi):
        return RuntimeError("no licence") if broken[0] and 50 < np.degrees(phi[0]) < 70 else None

    def scanned():
        atoms = chain(4, threefold, fails)
        return scan(atoms, TURN, RING, folder=tmp_path), atoms.calc.calls

    (first, _), (second, calls) = scanned(), scanned()
    assert set(first.failed) == set(second.failed) == {(8,)}
    assert calls == 1 and len(second.attempts) == len(first.attempts) + 1
    broken[0] = False
    third, calls = scanned()
    assert third.failed == {} and len(third.attempts) > len(second.attempts) + 1  # its neighbors from it
    assert calls == third.evaluations - second.evaluations
    np.testing.assert_allclose(third.energies, profile(RING), atol=2e-5)
    fourth, calls = scanned()
    assert calls == 0 and np.array_equal(fourth.energies, third.energies)


class Stop(BaseException):
    """As an interruption does."""


def test_a_scan_goes_on_where_it_stopped(tmp_path):
    """Nothing that was done is done again, and the end is the same to the last bit."""
    values, calls, found = np.radians(np.arange(-165, 0, 30)), [], []
    for folder, last in (("whole", None), ("cut", 3), ("cut", 7), ("cut", None)):
        atoms, lines = chain(5, two_wells, turns=[np.radians(-150), 0.3]), []

        def stop(finished, points, said, lines=lines, last=last):
            lines.append(said)
            if len(lines) == last:
                raise Stop

        with pytest.raises(Stop) if last else nullcontext():
            found.append(scan(atoms, TURN, values, folder=tmp_path / folder, progress=stop))
        calls.append(atoms.calc.calls)
    whole, cut = found
    assert whole.evaluations == cut.evaluations == calls[0] == sum(calls[1:])
    assert np.array_equal(cut.energies, whole.energies)
    for point, attempt in whole.best.items():
        assert np.array_equal(cut.best[point].positions, attempt.positions)


def test_a_folder_of_another_scan_is_refused(tmp_path):
    atoms = chain(4, threefold)
    scan(atoms, TURN, [0.5], folder=tmp_path)
    for said, value, how in (
        ("values", 0.6, {}),
        ("settings", 0.5, {"fmax": 0.02}),
        ("held", 0.5, {"held": Distance([[0, 1]])}),
    ):
        with pytest.raises(OccupiedError, match=said):
            scan(atoms, TURN, [value], folder=tmp_path, **how)
    atoms.set_constraint(ExternalForce(0, 3, 0.01))
    with pytest.raises(OccupiedError, match="calculator"):
        scan(atoms, TURN, [0.5], folder=tmp_path)


def test_relaxations_in_files_are_whole_and_of_this_scan(tmp_path):
    atoms, first = chain(4, threefold), tmp_path / "relaxations" / "00000.npz"
    scan(atoms, TURN, [0.5, 0.6], folder=tmp_path)
    content, calls = first.read_bytes(), atoms.calc.calls
    first.with_name("00000.npz.unfinished").write_bytes(b"PK\x03\x04")
    scan(atoms, TURN, [0.5, 0.6], folder=tmp_path)
    assert atoms.calc.calls == calls
    first.write_bytes(b"PK\x03\x04")
    with pytest.raises(UnreadableError, match=r"00000\.npz cannot be read .*; remove it"):
        scan(atoms, TURN, [0.5, 0.6], folder=tmp_path)
    first.write_bytes((tmp_path / "relaxations" / "00001.npz").read_bytes())
    with pytest.raises(UnreadableError, match=r"relaxation 0 in .* is of another scan"):
        scan(atoms, TURN, [0.5, 0.6], folder=tmp_path)
    first.write_bytes(content)


def test_python_functions_need_no_folder(tmp_path):
    row = Custom([[0, 1]], lambda r: r[0, 0] - r[1, 0], lambda r: np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    with pytest.raises(InputError, match="Python function"):
        scan(chain(4, threefold), row, [-1.0], folder=tmp_path / "new")
    assert not (tmp_path / "new").exists()
    assert not scan(chain(4, threefold), row, [-1.0]).failed


def test_large_structures_need_no_table(monkeypatch):
    monkeypatch.setattr("kcons.free_energy.scans.relaxed_scan.MOST_ATOMS", 3)
    found = scan(chain(4, threefold), TURN, [0.5, 0.8], fmax=1e-3)
    np.testing.assert_allclose(found.energies, profile([0.5, 0.8]), atol=1e-6)


def test_a_torsion_over_atoms_that_are_not_bonded():
    atoms = molecule("trans-butane")
    atoms.calc = EMT()
    with pytest.warns(UserWarning, match=r"2, 0, 1, 3, counted from 0, and 2-0, 1-3 are no bonds; give") as told:
        scan(atoms, Dihedral([[2, 0, 1, 3]]), [1.0], evaluations=1, fmax=100.0)
    assert told[0].filename == __file__
