"""Pages of the hard cases."""

from __future__ import annotations

import re

import pytest

from kcons.comparison.hard_cases import report, run


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    kept = tmp_path_factory.mktemp("study") / "hard_cases.json"
    return run(only=["h02", "X06", "H22"], quick=True, kept=kept), kept


def test_pages(result, tmp_path):
    found, _ = result
    written = report.write(found, tmp_path)
    assert [path.name for path in written] == ["hard_cases.png", "hard_cases.html"]
    html = written[1].read_text(encoding="utf-8")
    assert "One bond with two targets" in html and "ContradictionError" in html
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", html)
    text = report.markdown(found)
    assert "| H02 | One bond with two targets, 1.0 and 1.001 | refused (ContradictionError) |" in text
    assert report.failures(found) == []
    assert "kcons: 3 of 3 as asked for" in report.summary(found)
