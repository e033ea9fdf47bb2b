"""The command `kcons completion`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

SHELLS = ("bash", "zsh", "tcsh")


def add(commands: Any, whole: Callable[[], argparse.ArgumentParser]) -> None:
    """Its options; `whole` makes the parser that is to be completed."""
    made = commands.add_parser(
        "completion",
        help="a script that completes commands and options in a shell",
        description="Prints a script. For bash, once: kcons completion bash > "
        "~/.local/share/bash-completion/completions/kcons; for zsh: into a file _kcons of a folder of $fpath.",
    )
    made.add_argument("shell", choices=SHELLS)
    made.set_defaults(run=lambda chosen: _completion(chosen, whole()))


def _completion(chosen: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    import shtab

    print(shtab.complete(parser, shell=chosen.shell))
    return 0
