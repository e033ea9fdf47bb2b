"""Numbers, picture and tables of a report."""

from __future__ import annotations

import json

import pytest
from matplotlib.figure import Figure

from kcons.comparison.study import report_files


@pytest.mark.parametrize("tables", [(), ("a", "b")])
def test_files(tmp_path, tables):
    paths = report_files.write(tmp_path / "new", "name", {"a": 1.0}, Figure(), tables)
    assert [path.name for path in paths] == ["name.json", "name.png", *(["name.txt"] if tables else [])]
    assert json.loads(paths[0].read_text()) == {"a": 1.0}
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    assert not tables or paths[2].read_text() == "a\nb\n"
