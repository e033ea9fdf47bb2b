"""Scripts that complete commands in a shell."""

from __future__ import annotations

import subprocess
import sys

import pytest

from kcons.cli import main


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_the_script_knows_all_commands(shell, capsys):
    assert main.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in main.commands())


def test_bash_completes(tmp_path, capsys):
    main.main(["completion", "bash"])
    script = tmp_path / "kcons.sh"
    script.write_text(capsys.readouterr().out)
    ask = f"source {script}; COMP_WORDS=(kcons com); COMP_CWORD=1; _shtab_kcons; echo ${{COMPREPLY[@]}}"
    found = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True)
    assert {"compare", "completion"} == set(found.stdout.split())


def test_without_the_extra_it_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main.main(["completion", "bash"]) == 2
    assert "pip install 'kcons[completion]'" in capsys.readouterr().err
