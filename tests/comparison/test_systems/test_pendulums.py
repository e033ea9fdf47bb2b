"""Pendulums against an independent solution."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from kcons.comparison.test_systems.sphere import swing


def test_swing_meets_the_reference_pendulum():
    # 45-digit solution in spherical angles.
    case = json.loads((Path(__file__).parents[2] / "reference/data/A02_spherical_pendulum_generic.json").read_text())
    start = {key: np.array(case["initial"][key], dtype=float)[0] for key in ("positions", "velocities")}
    (gravity,) = (force["g"] for force in case["forces"] if force["type"] == "uniform_acceleration")
    assert gravity[:2] == [0, 0]
    (point,) = (np.array(c.get("point"), float) for c in case["constraints"] if c["type"] == "distance_to_point")
    for time, wanted in list(zip(case["times"], case["reference"]["positions"], strict=True))[1:4]:
        found = swing(start["positions"] - point, start["velocities"], -gravity[2], time)
        np.testing.assert_allclose(found + point, np.array(wanted, dtype=float)[0], atol=1e-11 * np.exp(0.3 * time))
