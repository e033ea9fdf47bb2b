"""All bonds and angles at 4 fs: the page shows the committed results, and they are what it says."""

from __future__ import annotations

import json
import statistics

from committed_pages import FOLDER, page, printed

RESULTS = FOLDER / "openmm_four_femtoseconds.json"


def test_page_shows_the_committed_results():
    assert printed("studies/openmm_four_femtoseconds.py", RESULTS.name) in page("openmm_platforms.md")


def test_rows_stay_and_energy_is_what_the_page_says():
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert found["full"]
    assert set(found["runs"]) == {"alanine dipeptide", "villin"}
    for run in found["runs"].values():
        assert run["place"] == "OpenCL mixed"
        assert run["picoseconds"] == 100
        assert run["residual"] < 4e-9
        rows, rank, condition = run["conditions"]["held"]
        assert rows == rank == run["conditions"]["every angle"][1]
        assert condition < 100 < run["conditions"]["every angle"][2]
        assert run["scatter"][1] < run["scatter"][0] / 3
        drift = run["drift of what steps conserve"]
        assert abs(drift["slope"]) <= drift["error"] < 1e-3
        assert abs(run["drift"]["slope"]) <= 2 * run["drift"]["error"] < 2e-3


def test_villin_does_not_drift_over_eleven_runs():
    """On two platforms, in two precisions: the mean of the slopes is within two errors, from their scatter."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    runs = [run for run in (found["runs"]["villin"], *found["again"]) if run["step"] == 0.004]
    slopes = [run["drift of what steps conserve"]["slope"] for run in runs]
    mean, error = statistics.mean(slopes), statistics.stdev(slopes) / len(slopes) ** 0.5
    assert len(runs) == 11 and abs(mean) <= 2 * error < 5e-3
    walks = [
        abs(run["drift of what steps conserve"]["slope"]) * run["freedom"] * run["picoseconds"] / 1000
        for run in (found["runs"]["villin"], *found["again"])
    ]
    assert min(walks) > 0.005 and max(walks) < 0.085
    assert {run["place"] for run in runs} == {"OpenCL mixed", "OpenCL double", "CUDA mixed", "CUDA double"}
    assert max(run["residual"] for run in runs) < 4e-9
