"""A calculator that fails: typed error, no array changed by a hook or a step, trajectories readable."""

from __future__ import annotations

import numpy as np
import pytest
from ase.build import molecule
from ase.io import read
from ase.io.trajectory import Trajectory
from ase_systems import FS, KINDS, OF_ASE, Field, equal, off, state, water

from kcons.ase import ConstrainedDynamics, constrain
from kcons.constraints import Distance
from kcons.errors import InputError, NonFiniteError

OURS = {repr(kind): lambda a, dt, kind=kind: ConstrainedDynamics(a, dt, kind) for kind in KINDS}


def no_numbers(forces):
    forces = np.array(forces)
    forces[1, 2] = np.nan
    return forces


def no_result(forces):
    raise RuntimeError("no convergence")


#: What a calculator does, and the error under ASE's own classes and under ours.
FAILURES = {
    "nan": (no_numbers, InputError, "atom 1 is not finite", NonFiniteError, "non-finite force at step 4 on atom 1"),
    "inf": (lambda f: f + np.inf, InputError, "not finite", NonFiniteError, "non-finite force at step 4"),
    # ASE's arithmetic, before any hook.
    "shape": (lambda f: f[:2], ValueError, "shape", InputError, r"shape \(2, 3\) at step 4"),
    "raises": (no_result, RuntimeError, "no convergence", RuntimeError, "no convergence"),
}


@pytest.mark.parametrize("case", FAILURES)
@pytest.mark.parametrize("name", [*OF_ASE, *OURS])
def test_dynamics(name, case, tmp_path):
    how, *said = FAILURES[case]
    error, message = said[2:] if name in OURS else said[:2]
    make = (OF_ASE | OURS)[name]
    atoms, held = water(Field(how=how))
    good, _ = water()
    dyn, peer = make(atoms, FS), make(good, FS)
    peer.run(3)

    def spoil():
        if dyn.nsteps == 3:
            atoms.calc.bad = 0

    with Trajectory(tmp_path / "md.traj", "w", atoms) as file:
        dyn.attach(file.write)
        dyn.attach(spoil)
        with pytest.raises(error, match=message) as caught:
            dyn.run(20)
    assert dyn.nsteps == 3
    frames = read(tmp_path / "md.traj", index=":")
    assert len(frames) == 4
    assert equal(state(frames[-1]), state(good))
    if name in OF_ASE:
        assert case != "nan" or "calculator" in str(caught.value)
        assert np.isfinite(atoms.positions).all() and np.isfinite(atoms.get_momenta()).all()
        assert off(atoms, held) <= 1e-14
        return
    assert caught.value.step == 4
    assert case != "raises" or any("in step 4" in note for note in caught.value.__notes__)
    assert equal(state(atoms), state(good))
    # With a calculator that works, the run goes on as if nothing had happened.
    atoms.calc = Field()
    dyn.observers.clear()
    dyn.run(2)
    peer.run(2)
    assert equal(state(atoms), state(good))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("atom", [0, 8])
def test_atoms_that_are_not_held_count_too(atom, bad):
    atoms = molecule("CH3CH2OH")
    held = constrain(atoms, Distance([0, 1]))
    for hook, what in (("adjust_positions", "position"), ("adjust_momenta", "moment|velocity"), ("adjust_forces", "f")):
        values = atoms.positions.copy()
        values[atom, 1] = bad
        asked = values.copy()
        with pytest.raises(InputError, match=f"{what}.* of atom {atom} is not finite|{what}.*atom {atom}"):
            getattr(held, hook)(atoms, values)
        assert np.array_equal(values, asked, equal_nan=True)
        with pytest.raises(InputError, match=r"shape \(9, 3\)"):
            getattr(held, hook)(atoms, np.zeros((4, 3)))
