"""What `kcons warmup` runs compiles everything that it uses."""

from __future__ import annotations

import numpy as np

from kcons import ConstraintSet
from kcons.cli import main
from kcons.cli.compiled_systems import KINDS, freeenergy
from kcons.constraints import Angle
from kcons.constraints.compilation import announcer
from kcons.free_energy import HeldCoordinates, compiled_samples


def test_all_kinds_can_be_had(capsys):
    """With kernels of other tests, in most cases: nothing is compiled a second time."""
    said = announcer.announced
    for _ in range(2):
        before = announcer.seconds
        assert main.main(["warmup"]) == 0
        printed = capsys.readouterr().out
    assert announcer.seconds == before
    assert [line.split(":")[0] for line in printed.splitlines()] == list(KINDS)
    announcer.announced = said


def test_samples_of_other_coordinates_need_nothing_more():
    freeenergy()
    known = list(compiled_samples._sample.signatures)
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.5, 1.0, 0.0]])
    bend = Angle([[0, 1, 2]])
    held = HeldCoordinates(ConstraintSet(bend, x, np.ones(3)), {"bend": bend}, x)
    assert held.sample(x, np.zeros((3, 3)), np.ones((3, 3)), 0.0).multiplier.shape == (1,)
    assert known and list(compiled_samples._sample.signatures) == known
