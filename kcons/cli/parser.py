"""The options of a command as a table, and a parser that says which name may have been meant."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

from kcons.errors import InputError, did_you_mean


class Option:
    """A row of the table of a command.

    Parameters
    ----------
    name : str
        '--out'; without dashes of what is given by its place.
    help : str
    group : str
        The heading it stands under.
    more
        Further arguments of `argparse.ArgumentParser.add_argument`: type, default, nargs, choices, metavar, action.
    """

    def __init__(self, name: str, help: str, *, group: str = "", **more: Any) -> None:
        self.name, self.group, self.how = name, group, {"help": help, **more}


class Command(NamedTuple):
    """A command: its table of options, and what runs it.

    Attributes
    ----------
    name, help, description : str
    options : sequence of Option
    run : callable
        Is given the options as attributes; returns the exit status.
    kept : str
        What of its work stays when it is stopped, and is gone on from.
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
        parser.set_defaults(run=self.run, of=parser, kept=self.kept)


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose complaints name what is nearest; parsers of commands are of this kind, too."""

    def commands(self) -> dict[str, Parser]:
        """The parser of each command; none for that of a command."""
        found = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]
        return dict(found[0].choices) if found else {}

    def given(self, chosen: argparse.Namespace) -> dict[str, str]:
        """Options that are not what they are by default: where they are kept, and how they are written."""
        options = [action for action in self._actions if action.option_strings and hasattr(chosen, action.dest)]
        return {a.dest: a.option_strings[0] for a in options if getattr(chosen, a.dest) != a.default}

    def take_only(self, chosen: argparse.Namespace, known: Collection[str], why: str) -> None:
        """Complain of an option that would say nothing.

        Raises
        ------
        InputError
        """
        for name, option in self.given(chosen).items():
            if name not in known:
                raise InputError(f"{option} {why}", item=name)

    def parse_fully(self, arguments: Sequence[str] | None = None) -> argparse.Namespace:
        """As `parse_args`."""
        chosen, rest = self.parse_known_args(arguments)
        if rest:
            of = self.commands().get(getattr(chosen, "command", None) or "", self)
            options = [option for action in of._actions for option in action.option_strings]
            of.error(f"unrecognized arguments: {' '.join(rest)}{did_you_mean(rest[0].partition('=')[0], options)}")
        return chosen

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(str(value), map(str, action.choices or ()))
            raise
