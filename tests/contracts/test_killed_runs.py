"""Runs that are killed at random times lose nothing that was finished, and end as if nothing had happened."""

from __future__ import annotations

import pytest
from killed_runs import KINDS, killed


@pytest.mark.validation
@pytest.mark.parametrize("kind", KINDS)
def test_killed_runs_go_on(tmp_path, kind):
    found = killed(kind, tmp_path, 30)
    assert found["kills"] == 30
    # A run is begun once, and once more for each kill that met it.
    if kind == "windows":
        assert found["in all"] == 48 and 48 <= found["runs begun"] <= 48 + 30
