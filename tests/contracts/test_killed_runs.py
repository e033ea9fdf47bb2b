"""Runs that are killed at random times lose nothing that was finished, and end as if nothing had happened."""

from __future__ import annotations

import pytest
from killed_runs import KINDS, killed


@pytest.mark.validation
@pytest.mark.parametrize("kind", KINDS)
def test_killed_runs_go_on(tmp_path, kind):
    found = killed(kind, tmp_path, 30)
    assert found["kills"] == 30
    assert found["finished after each"][-1] > 20
    # A window is done once, unless it was killed between its file and its note.
    if kind == "windows":
        assert found["in all"] == 80 and 50 <= found["noted"] <= 80
    else:
        assert found["in all"] == 241
