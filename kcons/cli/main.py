"""The command `kcons`. Everything heavy is imported by the subcommand that needs it."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from kcons import __version__
from kcons.cli import check, compare, free_energy, machine
from kcons.cli.terminal import Terminated, drop_what_follows, in_order
from kcons.errors import KconsError, did_you_mean, with_extra

COMMANDS = (*compare.COMMANDS, *check.COMMANDS, *free_energy.COMMANDS, *machine.COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    The exit status: 0; of `check`, 1 for a violation and 3 where not all could be told; of `scan` and
    `freeenergy`, 3 where some points or windows failed; 2 for an error that the user can mend; 130 when interrupted,
    143 when terminated. Characters that the encoding of the output lacks become '?', and what nobody reads any more, as
    behind `head`, is dropped.
    """
    status = 0
    streams = [stream for stream in (sys.stdout, sys.stderr) if isinstance(stream, io.TextIOWrapper)]
    before = [stream.errors for stream in streams]
    for stream in streams:
        stream.reconfigure(errors="replace")
    try:
        status = _main(arguments)
        for stream in streams:
            stream.flush()
    except OSError as error:
        drop_what_follows()
        if not isinstance(error, BrokenPipeError):
            print(f"kcons: the output cannot be written: {error}", file=sys.stderr)
            status = 2
    finally:
        for stream, errors in zip(streams, before, strict=True):
            stream.reconfigure(errors=errors)
    return status


def _main(arguments: Sequence[str] | None) -> int:
    parser, commands = parsers()
    chosen, unknown = parser.parse_known_args(arguments)
    if unknown:  # argparse would show the usage of kcons, not that of the command
        mine = commands.get(chosen.command, parser)
        names = [option.name for command in COMMANDS if command.name == chosen.command for option in command.options]
        near = did_you_mean(unknown[0].partition("=")[0], names)
        mine.error(f"unrecognized arguments: {' '.join(unknown)}{near}")
    if chosen.command is None:
        parser.print_help()
        return 0
    status = 2
    try:
        with in_order():
            return int(chosen.run(chosen))
    except ModuleNotFoundError as error:
        explained = with_extra(error, f"kcons {chosen.command}")
        if not isinstance(explained, KconsError):
            raise
        said = str(explained)
    except BrokenPipeError:
        raise
    except (FileExistsError, NotADirectoryError) as error:
        said = f"{error.filename}: there is a file where a folder has to be; give another folder (--out)"
    except (KconsError, OSError) as error:
        said = " ".join(str(error).split())
    except MemoryError as error:
        said = f"there is not enough memory: {error}"
    except KeyboardInterrupt as stop:
        said, status = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        said += f"; finished {chosen.kept} are kept: run again to resume" if chosen.kept else ""
    print(f"kcons: {said}", file=sys.stderr)
    return status


def parsers() -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser of the command line, and that of each command by name."""
    parser = argparse.ArgumentParser(prog="kcons", description="Constraints in molecular dynamics.")
    parser.add_argument("--version", action="version", version=f"kcons {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command")
    for command in COMMANDS:
        mine = commands.add_parser(command.name, help=command.help, description=command.description)
        for option in command.options:
            mine.add_argument(option.name, **option.how)
        mine.set_defaults(run=command.run, kept=command.kept)
    return parser, commands.choices
