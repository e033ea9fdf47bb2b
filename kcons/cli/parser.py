"""The parser of the command line: where a name is not known, it says which one may have been meant."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from typing import Any

from kcons.errors import InputError, did_you_mean


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
