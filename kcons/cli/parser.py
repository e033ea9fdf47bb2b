"""The options of a command as a table."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


class Option:
    """A row of the table of a command: name ('--out'; without dashes of what is given by its place), help, heading.

    `more` are further arguments of `argparse.ArgumentParser.add_argument`: type, default, nargs, choices, ...
    """

    def __init__(self, name: str, help: str, *, group: str = "", **more: Any) -> None:
        self.name, self.group, self.how = name, group, {"help": help, **more}


class Command(NamedTuple):
    """A command: its table of options, and what runs it.

    `run` is given the options as attributes and returns the exit status; `kept` is what of its work stays when it is
    stopped, and is gone on from.
    """

    name: str
    help: str
    description: str
    options: Sequence[Option]
    run: Callable[[argparse.Namespace], int]
    kept: str = ""

    def add(self, commands: Any) -> None:
        parser = commands.add_parser(self.name, help=self.help, description=self.description)
        groups: dict[str, Any] = {"": parser}
        for option in self.options:
            if option.group not in groups:
                groups[option.group] = parser.add_argument_group(option.group)
            groups[option.group].add_argument(option.name, **option.how)
        parser.set_defaults(run=self.run, kept=self.kept)
