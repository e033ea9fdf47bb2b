"""Failures in ConstrainedDynamics are named and rolled back."""

from __future__ import annotations

import numpy as np
import pytest
from ase.io import read
from ase_systems import (
    FS,
    Field,
    equal,
    state,
    water,
)

from kcons.ase import ConstrainedDynamics
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError

# -- failures ---------------------------------------------------------------------------------------


def spoiled(forces):
    forces[1, 2] = np.nan
    return forces


FAILURES = {
    "nan": (spoiled, NonFiniteError, "non-finite force at step 7 on atom 1"),
    "inf": (lambda f: f + np.inf, NonFiniteError, "non-finite force at step 7"),
    "shape": (lambda f: f[:2], InputError, r"shape \(2, 3\) at step 7"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_bad_calculator_at_a_step(case, tmp_path):
    how, error, message = FAILURES[case]
    good, _ = water()
    ConstrainedDynamics(good, FS).run(6)
    path = tmp_path / "md.traj"
    atoms, _ = water(Field(bad=7, how=how))  # one evaluation at the start, one a step
    with ConstrainedDynamics(atoms, FS, trajectory=str(path)) as dyn:
        with pytest.raises(error, match=message):
            dyn.run(20)
        assert dyn.nsteps == 6
    assert equal(state(atoms), state(good))
    frames = read(path, index=":")
    assert len(frames) == 7
    assert equal(state(frames[-1]), state(good))
    # With a calculator that works, the run goes on from there as if nothing had happened.
    atoms.calc = Field()
    dyn.run(3)
    ConstrainedDynamics(good, FS).run(3)
    assert equal(state(atoms), state(good))


def test_calculator_that_raises():
    def fail(forces):
        raise RuntimeError("no convergence")

    good, _ = water()
    ConstrainedDynamics(good, FS).run(6)
    atoms, _ = water(Field(bad=7, how=fail))
    with pytest.raises(RuntimeError, match="no convergence") as caught:
        ConstrainedDynamics(atoms, FS).run(20)
    assert any("in step 7" in note for note in caught.value.__notes__)
    assert equal(state(atoms), state(good))


def test_time_step_too_large():
    """The step is told in fs, not in ASE's unit."""
    atoms, _ = water(Field(0.0), temperature=3000)
    with pytest.warns(UserWarning, match="steps of 60 fs. Is that meant"):
        dyn = ConstrainedDynamics(atoms, 60 * FS)
    before = state(atoms)
    with pytest.raises(ConvergenceError, match=r"step 1: time step too large \(dt = 60 fs\)") as caught:
        dyn.run(5)
    assert caught.value.step == 1
    assert equal(state(atoms), before)


def test_atoms_off_their_rows_are_refused_at_the_start():
    atoms, _ = water()
    atoms.positions[0] += 0.1
    with pytest.raises(InputError, match="off row"):
        ConstrainedDynamics(atoms, FS)


def test_nan_positions_are_refused_at_the_start():
    atoms, _ = water()
    atoms.positions[0, 0] = np.nan
    with pytest.raises(KconsError):
        ConstrainedDynamics(atoms, FS)
