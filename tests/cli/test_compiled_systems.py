"""What `kcons warmup` runs compiles everything that it uses."""

from __future__ import annotations

from kcons.cli import main
from kcons.cli.compiled_systems import KINDS
from kcons.constraints.compilation import announcer


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
