"""The parts of the whole comparison."""

from __future__ import annotations

from kcons.comparison import test_systems
from kcons.comparison.work_precision import parts_of_the_whole, whole


def test_the_plan_has_every_system_that_was_asked_for():
    plan = {item.key: item for item in parts_of_the_whole.PLAN}
    assert len(plan) == len(parts_of_the_whole.PLAN)
    for item in plan.values():
        assert item.scene in test_systems.SYSTEMS
    assert {"sphere", "sphere-pendulum", "sphere-pendulum-top", "pendulum", "triple-pendulum", "rotor"} <= set(plan)
    assert {"dumbbells", "fekete", "ethanol", "water-216", "water-900", "water-5000"} <= set(plan)
    assert [plan[f"chain-1e{k}"].size for k in range(2, 7)] == [10**k for k in range(2, 7)]
    for structure in ("alanine", "dhfr"):
        for constrain in ("hbonds", "allbonds", "hangles"):
            assert plan[f"{structure}-{constrain}"].options == {"constrain": constrain}
    assert sum(item.seconds for item in plan.values()) <= 6300  # "an hour and three quarters" (docs/report.md)
    assert sum(item.quick_seconds for item in plan.values()) <= whole.QUICK_SECONDS
    assert [item.key for item in parts_of_the_whole.chosen(["water"])] == ["water-216", "water-900", "water-5000"]
