"""The HTML page: self-contained, escaped, well formed."""

from html.parser import HTMLParser
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from kcons.comparison.study import html_page
from kcons.comparison.study.tables import Table

VOID = {"meta", "link", "img", "br"}


class Reader(HTMLParser):
    """Checks that every tag is closed in order, and remembers addresses and text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attributes):
        self.addresses += [value for name, value in attributes if name in ("href", "src")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    figure = Figure()
    figure.subplots().plot([1, 2], [3, 4])
    table = Table(["method", "error"], [["a < b & c", "1e-6"], ["plain", "2"]], marks=["good", ""])
    sections = [
        html_page.Section("First", ["<script>text</script>"], [figure], [table]),
        html_page.Section("Last", literal="x"),
    ]
    reader = Reader()
    reader.feed(html_page.write(tmp_path / "p.html", "A title", sections, introduction=["Hello."]).read_text())
    return reader


def test_every_tag_is_closed(read):
    assert read.open == []


def test_nothing_is_fetched_from_elsewhere(read):
    assert len(read.addresses) == 4
    assert all(address.startswith(("#", "data:")) for address in read.addresses)


def test_text_is_shown_as_it_is(read):
    for text in ("a < b & c", "<script>text</script>", "A title", "Hello."):
        assert text in read.text


def test_a_row_of_the_wrong_length_of_marks_is_an_error(tmp_path):
    table = Table(["a"], [["1"], ["2"]], marks=["good"])
    with pytest.raises(ValueError):
        html_page.write(tmp_path / "p.html", "t", [html_page.Section("s", tables=[table])])


def test_folded_tables_diagrams_and_sorting(tmp_path):
    table = Table(["method"], [["a"]])
    section = html_page.Section("S", tables=[table], literal="why", diagram='<div class="diagram"></div>', folded=True)
    page = html_page.write(tmp_path / "p.html", "T", [section], head="<style>.x{}</style>").read_text()
    assert (
        page.index('<div class="diagram">') < page.index("<details>") < page.index("<table>") < page.index("</details>")
    )
    assert page.count("why") == 1 and "<style>.x{}</style></head>" in page and 'closest("th")' in page
