"""Names that are not known, and the nearest one that is."""

from __future__ import annotations

import pytest

from kcons.cli import main


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["comapre", "water"], "'compare'"),
        (["compare", "water", "--metods", "rattle"], "'--methods'"),
        (["compare", "water", "--constrain", "hbond"], "'hbonds'"),
        (["check", "run.xtc", "--topology", "x", "--targts", "mean"], "'--targets'"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_wrong_words_of_the_command_line(words, meant, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert f"did you mean {meant}?" in said


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["compare", "watr"], "'water'"),
        (["compare", "chan"], "'chain'"),
        (["compare", "water", "--methods", "ratle"], "'rattle'"),
        (["warmup", "protein"], "'proteins'"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_wrong_names_of_test_systems_and_methods(words, meant, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(words) == 2
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_what_is_like_nothing_has_no_suggestion(capsys):
    assert main.main(["compare", "qqqq"]) == 2
    assert "did you mean" not in capsys.readouterr().err


def test_commands_are_listed_with_their_parsers():
    assert main.commands()["compare"].prog == "kcons compare"
    assert main.commands()["compare"].commands() == {}
