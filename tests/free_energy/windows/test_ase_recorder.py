"""Coordinates recorded from ASE's dynamics."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from ase import units
from ase.build import molecule
from ase.calculators.lj import LennardJones
from ase.constraints import Hookean
from ase.md.verlet import VelocityVerlet

from kcons.ase import ConstrainedDynamics, MultipleTimeSteps, constrain, draw_velocities
from kcons.ase.binding import applied_forces
from kcons.constraints import Dihedral, Distance, MovingTarget
from kcons.errors import UnsupportedError
from kcons.free_energy import AseRecorder, held_coordinates

#: The torsion of methanol, and the bonds that it turns about.
TURN, BONDS = Dihedral([[2, 0, 1, 3]]), Distance([[0, 1], [1, 3], [0, 2]])


def methanol():
    atoms = molecule("CH3OH")
    atoms.calc = LennardJones(sigma=1.0, epsilon=0.02, rc=6.0)
    return atoms


def test_a_dynamics_of_ase_under_kcons_constraints():
    atoms = methanol()
    constrain(atoms, [TURN, BONDS])
    atoms.set_velocities(np.random.default_rng(0).normal(size=(6, 3)) * 0.02)
    dynamics = VelocityVerlet(atoms, 0.2 * units.fs)
    recorder = AseRecorder(dynamics, {"turn": TURN, **{f"bond {k}": BONDS.select([k]) for k in range(3)}})
    dynamics.attach(recorder, interval=1)
    dynamics.run(3)
    assert recorder.series.names == ("turn", "bond 0", "bond 1", "bond 2")
    assert recorder.series.value[-1, 2] == pytest.approx(atoms.get_distance(1, 3))
    motion = atoms.constraints[0].engine(atoms)
    f = atoms.get_forces(apply_constraint=False)
    direct = motion.multipliers(atoms.positions, atoms.get_velocities(), f)
    np.testing.assert_allclose(recorder.series.multiplier[-1], direct, rtol=0, atol=1e-12)


def test_a_pull_and_a_change_of_masses():
    atoms = methanol()
    start, energies = atoms.get_distance(0, 1), []
    pull = Distance([[0, 1]], MovingTarget(lambda t: start + 0.02 * t))
    dynamics = ConstrainedDynamics(atoms, 0.1 * units.fs, constraints=[pull])
    recorder = AseRecorder(dynamics, {"r": pull})
    dynamics.attach(recorder, interval=1)
    for steps in (0, 150):
        dynamics.run(steps)
        kinetic = 0.5 * np.sum(atoms.get_masses()[:, None] * dynamics.state.velocities**2)
        energies.append(atoms.get_potential_energy() + kinetic)
    assert recorder.series.work[-1] == pytest.approx(energies[1] - energies[0], rel=3e-3)
    masses = atoms.get_masses()
    masses[1] *= 2
    atoms.set_masses(masses)
    before = recorder.series.log_det_z[-1]
    dynamics.run(1)
    assert recorder.series.log_det_z[-1] == pytest.approx(np.log(1 / masses[0] + 1 / masses[1])) and before != 0


def test_forces_that_ase_constraints_add_count():
    """Also in dynamics of ASE, which ask the atoms for forces."""
    atoms = methanol()
    held = constrain(atoms, [TURN, BONDS])
    atoms.set_constraint([held, Hookean(4, 3, 5.0, rt=1.0)])
    recorder = AseRecorder(VelocityVerlet(atoms, 0.5 * units.fs), {"turn": TURN})
    recorder()
    forces = applied_forces(atoms), atoms.get_forces(apply_constraint=False)
    v = atoms.get_velocities()
    direct, without = (held.engine(atoms).multipliers(atoms.positions, v, f)[0] for f in forces)
    assert recorder.series.multiplier[-1, 0] == pytest.approx(direct, abs=1e-10)
    assert abs(without - direct) > 0.01


@pytest.mark.parametrize("many", [False, True])
def test_velocities_on_spheres_are_refused_where_multipliers_need_thermal_ones(many, monkeypatch):
    """They have about three quarters of the variance; where the mean over velocities is found, none are needed."""
    if many:
        monkeypatch.setattr(held_coordinates, "_MOST_ROWS", 2)
    atoms, held = methanol(), [TURN, BONDS]
    draw_velocities(atoms, 300, 1, constraints=held)
    fast, slow = (LennardJones(sigma=1.0, epsilon=e, rc=6.0) for e in (0.02, 0.01))
    how = {"fast": fast, "slow": slow, "fast_steps": 2, "bath": "spheres", "rng": 1, "constraints": held}
    dynamics = MultipleTimeSteps(atoms, 0.5 * units.fs, temperature_K=300, friction=0.02, **how)
    recorder = AseRecorder(dynamics, {"turn": TURN})
    dynamics.attach(recorder, interval=1)
    said = r"multipliers of turn need them.*bath='langevin'"
    with pytest.raises(UnsupportedError, match=said) if many else nullcontext():
        dynamics.run(1)
    assert len(recorder.series) == (0 if many else 2) and np.isfinite(recorder.series.mean_kinetic).all()
