"""Held states: degrees of freedom, slices, joins, batches made by TorchSim, files, precision."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch_sim as ts
from torch_models import Butanes, Drops, Free, butane, drop, off, state_of

from kcons.constraints import Dihedral, Distance, FixedAtoms
from kcons.torchsim import hold, langevin, nose_hoover, nve, report

SIZES = (5, 2, 3)


def drops(sizes=SIZES, dtype=torch.float64):
    state = ts.concatenate_states([drop(n, n, dtype) for n in sizes])
    hold(state, "water")
    return state


def test_degrees_of_freedom_are_counted_by_rank():
    state = drops()
    assert state.get_number_of_degrees_of_freedom().tolist() == [6 * n for n in SIZES]
    flat = state_of([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [6] * 4, [12.0] * 4)
    hold(flat, Distance([[i, j] for i in range(4) for j in range(i + 1, 4)]))
    assert flat.get_number_of_degrees_of_freedom().tolist() == [6]  # a rigid body, whatever holds it
    line = state_of([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]], [8, 6, 8], [16.0, 12.0, 16.0])
    hold(line, Distance([[0, 1], [1, 2], [0, 2]]))  # singular at second order: converted
    assert line.get_number_of_degrees_of_freedom().tolist() == [5]


def test_slices_take_the_right_rows_along():
    state = drops()
    for order in ([2, 0], [1], [2, 1, 0], [-1, 0]):
        part = state[order]
        assert [motion.n_atoms for motion in in_order(part)] == [3 * SIZES[k] for k in order]
        assert off(part).max() < 1e-12
        assert [found.rank for found in report(part)] == [3 * SIZES[k] for k in order]


def in_order(state):
    (held,) = state.constraints
    return [held.motions[k] for k in torch.argsort(held.system_idx).tolist()]


def test_splitting_joining_popping_and_copies():
    state = drops()
    again = ts.concatenate_states(state.split()[::-1])
    assert [motion.n_atoms for motion in in_order(again)] == [9, 6, 15] and off(again).max() < 1e-12
    (gone,) = again.pop(1)
    assert [motion.n_atoms for motion in in_order(again)] == [9, 15] and in_order(gone)[0].n_atoms == 6
    copy = state.clone()
    assert copy.constraints[0] is not state.constraints[0] and in_order(copy) == in_order(state)
    assert state.to(dtype=torch.float32).get_number_of_degrees_of_freedom().tolist() == [30, 12, 18]


def test_systems_with_nothing_held_stay_free():
    held, free = drop(2), drop(3, 1)
    hold(held, "water")
    state = ts.concatenate_states([free, held])
    assert state.get_number_of_degrees_of_freedom().tolist() == [27, 12]
    made = ts.integrate(state, Drops(), integrator=nve, n_steps=20, temperature=300, timestep=0.001)
    assert np.nanmax(off(made)) < 1e-12 and np.isnan(off(made)[0])
    shape = made.positions[:9].reshape(-1, 3, 3)
    assert float(((shape[:, 0] - shape[:, 1]).norm(dim=1) - 0.9572).abs().max()) > 1e-3  # they swing


def test_64_copies_with_bonds_and_a_torsion_held():
    """Each at a torsion of its own."""
    torsions = np.linspace(-np.pi, np.pi, 64, endpoint=False) + 0.02
    states = []
    for value in torsions:
        state = butane()
        hold(state, ["hbonds", Dihedral([CARBONS], [value])], project=True)
        states.append(state)
    state = ts.concatenate_states(states)
    assert state.get_number_of_degrees_of_freedom().tolist() == [42 - 11] * 64
    made = ts.integrate(state, Butanes(), integrator=langevin, n_steps=40, temperature=300, timestep=0.002, gamma=5.0)
    assert off(made).max() < 1e-12
    assert float(made.positions.sub(state.positions).abs().max()) > 0.05
    assert np.abs(angle(made.positions.numpy().reshape(64, -1, 3)[:, CARBONS]) - torsions).max() < 1e-12


CARBONS = [0, 1, 2, 3]


def angle(x):
    """Dihedral angles of points, shape (n, 4, 3)."""
    a, b, c = x[:, 1] - x[:, 0], x[:, 2] - x[:, 1], x[:, 3] - x[:, 2]
    m, n = np.cross(a, b), np.cross(b, c)
    return np.arctan2(np.sum(np.cross(m, n) * b, 1) / np.linalg.norm(b, axis=1), np.sum(m * n, 1))


def test_copies_of_one_system_share_its_engine():
    state = ts.concatenate_states([drop(3)] * 5 + [drop(3, 1)])
    hold(state, "water")
    assert len({id(motion) for motion in state.constraints[0].motions}) == 2


@pytest.mark.parametrize("pair", [nve, langevin, nose_hoover], ids=["nve", "langevin", "nose_hoover"])
def test_batches_made_by_torchsim(pair):
    """A run in small batches ends on the constraints, in the order that was given."""
    state = drops((4, 2, 4, 3))
    batcher = ts.BinningAutoBatcher(Drops(), memory_scales_with="n_atoms", max_memory_scaler=18)
    made = ts.integrate(
        state, Drops(), integrator=pair, n_steps=5, temperature=300, timestep=0.002, autobatcher=batcher
    )
    assert len(batcher.index_bins) > 1
    assert made.n_atoms_per_system.tolist() == [12, 6, 12, 9] and off(made).max() < 1e-12
    assert float((made.positions - state.positions).abs().max()) < 0.5  # each is where its system was


def test_reporters_and_files(tmp_path):
    state = drops()
    files = [tmp_path / f"{k}.h5" for k in range(3)]
    reporter = ts.TrajectoryReporter(
        files, state_frequency=5, prop_calculators={5: {"temperature": lambda state: state.calc_temperature()}}
    )
    made = ts.integrate(
        state, Drops(), integrator=nve, n_steps=10, temperature=300, timestep=0.002, trajectory_reporter=reporter
    )
    for k, file in enumerate(files):
        with ts.TorchSimTrajectory(file) as trajectory:
            assert trajectory.get_array("temperature").shape[0] == 3
            last = trajectory.get_state(-1)
            assert torch.equal(last.positions.double(), made[k].positions.float().double())
            # Files of TorchSim do not know constraints: hold again.
            hold(last, "water", water_geometry="tip3p", project=True)
            assert off(last).max() < 1e-12


@pytest.mark.parametrize("pbc", [True, [True, True, False]])
def test_a_periodic_cell(pbc):
    """Molecules cut at a face, in a cell that is not orthogonal."""
    cell = np.array([[9.0, 0, 0], [2.0, 9.0, 0], [1.0, 1.0, 9.0]])
    whole = drop(8)
    x = whole.positions.numpy()
    fraction = np.where(pbc, (x @ np.linalg.inv(cell)) % 1.0, x @ np.linalg.inv(cell))
    state = state_of(fraction @ cell, [8, 1, 1] * 8, whole.masses.numpy(), cell=cell)
    state.pbc = pbc
    assert float((state.positions[0::3] - state.positions[1::3]).norm(dim=1).max()) > 5.0
    hold(state, "water", water_geometry="tip3p", project=True)
    made = ts.integrate(state, Free(), integrator=nve, n_steps=20, temperature=300, timestep=0.002)
    assert off(made).max() < 1e-12 and float((made.positions - state.positions).abs().max()) > 0.1


def test_fixed_atoms_stay():
    state = ts.concatenate_states([drop(2), drop(3, 1)])
    hold(state, ["water", FixedAtoms(0)])
    assert state.get_number_of_degrees_of_freedom().tolist() == [12 - 3, 18 - 3]
    made = ts.integrate(state, Drops(), integrator=nose_hoover, n_steps=10, temperature=300, timestep=0.002)
    assert torch.equal(made.positions[[0, 6]], state.positions[[0, 6]]) and off(made).max() < 1e-12
    # No 3 degrees of freedom of a center of mass are left out where it cannot move freely.
    assert made.get_number_of_degrees_of_freedom().tolist() == [9, 15]
