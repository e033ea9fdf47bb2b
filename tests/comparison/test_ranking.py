"""Rankings: the cheapest that is good enough, ties within the scatter, steps that are found for an error."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from kcons.comparison import compare, find_steps, observed_orders, rank, test_systems
from kcons.comparison.measure import table_of
from kcons.comparison.ranking import pareto, predict
from kcons.errors import InputError

ABOUT = {"title": "a system", "horizon": 10.0, "force_seconds": 1e-3, "margin": 0.1}
ABOUT |= {"length": "Å", "energy": "eV", "time": "fs", "long_time": "ps", "error_unit": "Å"}
ABOUT |= {"reference_error": 1e-12, "reference": "closed form"}


def row(method, setting, error, seconds, **more):
    known = {"method": method, "title": f"kcons {method}" if method != "peer" else "a peer", "engine": "arrays"}
    known |= {"seconds": seconds, "evaluations": 1000 / setting, "step_seconds": seconds / 1000}
    known |= {"adaptive": False, "setting": setting, "status": "ok", "error": error, "note": ""}
    return {**known, "steps": 10, "rounds": 3, **more}


def made(*rows, **about):
    return table_of(list(rows), {**ABOUT, **about})


#: Second order by RATTLE, fourth order by another, which is dearer a step.
ROWS = (
    row("rattle", 4.0, 4e-3, 1.0),
    row("rattle", 2.0, 1e-3, 2.0),
    row("rattle", 1.0, 2.5e-4, 4.0),
    row("blanes", 8.0, 1.6e-3, 2.1),
    row("blanes", 4.0, 1e-4, 4.2),
    row("peer", 2.0, 1e-3, 5.0),
    row("peer", 1.0, 2.5e-4, 10.0),
)


def test_the_cheapest_that_is_as_good_as_the_usual():
    found = rank(made(*ROWS))
    assert (found.limit, found.limit_is) == (1e-3, "that of kcons rattle at 2 fs")
    assert list(found.table.method) == ["rattle", "blanes", "peer"]
    assert list(found.table.setting) == [2.0, 4.0, 2.0]
    assert list(found.table.place) == [1, 2, 3] and list(found.table.times) == [1.0, 2.1, 2.5]
    # An error that is asked for.
    found = rank(made(*ROWS), limit=2e-4)
    assert list(found.table.method) == ["blanes"] and list(found.beyond.method) == ["rattle", "peer"]
    none = rank(made(*ROWS), limit=1e-6)
    assert not len(none.table) and none.beyond.iloc[0].method == "blanes"


def test_costs_within_the_scatter_share_a_place():
    rows = [row("rattle", 2.0, 1e-3, 2.0), row("blanes", 2.0, 1e-3, 2.15), row("peer", 2.0, 1e-3, 2.3)]
    assert list(rank(made(*rows)).table.place) == [1, 1, 3]
    assert list(rank(made(*rows, margin=0.2)).table.place) == [1, 1, 1]
    assert list(rank(made(*rows, margin=None)).table.place) == [1, 2, 3]  # 5 % at least
    # Of equal ones the shortest step comes first, then the usual method: not a looser tolerance, cheaper by chance.
    rows = [row("blanes", 24.0, 1e-3, 2.0), row("loose", 2.0, 1e-3, 2.05), row("rattle", 2.0, 1e-3, 2.1)]
    found = rank(made(*rows, row("peer", 1.0, 1e-3, 2.5))).table
    assert list(found.method) == ["rattle", "loose", "blanes", "peer"] and list(found.place) == [1, 1, 1, 4]


def test_costs_are_times_or_force_evaluations():
    """Forces that take no time stand for those that do; where there are none, the time of the step itself decides."""
    rows = [row("rattle", 2.0, 1e-3, 2.0, evaluations=500), row("peer", 2.0, 1e-3, 9.0, evaluations=501)]
    for about, cost, places in (
        ({"forces": "springs"}, "seconds", [1, 2]),
        ({"forces": "springs", "force_seconds": 1e-8}, "evaluations", [1, 1]),
        ({"forces": "no forces", "force_seconds": 0.0}, "seconds", [1, 2]),
    ):
        found = rank(made(*rows, **about))
        assert found.cost == cost and list(found.table.place) == places


def test_what_cannot_be_ranked():
    assert rank(made(row("rattle", 2.0, math.nan, 1.0, status="failed"))) is None
    below = rank(made(row("rattle", 2.0, 1e-15, 1.0), row("peer", 2.0, 1e-16, 2.0)))
    assert below.limit_is == "the least that the reference can tell apart" and len(below.table) == 2


def test_fronts_and_observed_orders():
    table = made(*ROWS)
    best = pareto(table, "seconds")
    assert list(best.method) == ["rattle"] * 3 + ["blanes"] and list(best.setting) == [4.0, 2.0, 1.0, 4.0]
    assert observed_orders(table) == pytest.approx({"kcons rattle": 2.0, "kcons blanes": 4.0, "a peer": 2.0})
    # What the reference cannot tell apart says nothing.
    assert "kcons rattle" not in observed_orders(made(*ROWS, reference_error=1e-3))
    rank(table)
    pd.testing.assert_frame_equal(table, made(*ROWS))  # nothing of it is changed


def test_a_step_is_predicted_by_the_slope():
    rattle = made(*ROWS)[:3]
    found = predict(rattle, 1e-4)
    assert found["setting"] == pytest.approx(1.0 * math.sqrt(0.4)) and found["order"] == pytest.approx(2.0)
    assert found["seconds"] == pytest.approx(4.0 / math.sqrt(0.4))
    assert predict(rattle[:1], 1e-4) is None and predict(rattle, 1e-12) is None
    assert predict(pd.DataFrame(rattle).assign(error=[1e-3, 1.1e-3, 1e-3]), 1e-4) is None


def test_steps_are_found_for_an_error():
    system = test_systems.build("chain", 4)
    reference = system.reference()
    table = compare(system, ["rattle", "blanes-moan4"], reference=reference, rounds=0)
    target = 1e-8
    rows = find_steps(system, table, target, reference)
    good = [r for r in rows if r["error"] <= target]
    assert good and min(r["error"] for r in good) > 0.2 * target
    whole = table_of([*table.to_dict("records"), *rows], table.attrs)
    found = rank(whole, limit=target)
    assert found.table.method.iloc[0] == "blanes-moan4" and found.table.error.iloc[0] <= target
    assert find_steps(system, whole, target, reference) == []  # as --resume asks: what has run is not run again
    assert find_steps(system, table, 1e-6, reference) == []  # the step of 40 fs does, and RATTLE is dearer
    with pytest.raises(InputError, match="target is -1; give a positive number"):
        find_steps(system, table, -1, reference)
    assert find_steps(system, table, 1e-16, reference) == []
