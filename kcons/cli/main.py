"""The command `kcons`. Everything heavy is imported by the subcommand that needs it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from kcons import __version__
from kcons.cli import check, compare, doctor, freeenergy, plan, scan, warmup
from kcons.cli.parser import Option, Parser, add_options
from kcons.cli.terminal import Terminated, ended_in_order, patient_streams, warnings_in_a_line
from kcons.errors import KconsError, with_extra


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    The exit status: 0; of `check`, 1 for a violation and 3 where not all could be told; of `scan` and
    `freeenergy`, 3 where some points or windows failed; 2 for an error that the user can mend; 130 when interrupted,
    143 when terminated.
    """
    try:
        with patient_streams():
            return _main(arguments)
    except OSError as error:
        print(f"kcons: the output cannot be written: {error}", file=sys.stderr)
        return 2


def _main(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    chosen = parser.parse_fully(arguments)
    if chosen.version:
        print(f"kcons {__version__}")
        return 0
    if chosen.command is None:
        parser.print_help()
        return 0
    try:
        with ended_in_order(), warnings_in_a_line():
            return int(chosen.run(chosen))
    except ModuleNotFoundError as error:
        explained = with_extra(error, f"kcons {chosen.command}")
        if not isinstance(explained, KconsError):
            raise
        print(f"kcons: {explained}", file=sys.stderr)
        return 2
    except (FileExistsError, NotADirectoryError) as error:
        print(
            f"kcons: {error.filename}: there is a file where a folder has to be; give another folder (--out)",
            file=sys.stderr,
        )
        return 2
    except (KconsError, OSError) as error:
        print(f"kcons: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"kcons: there is not enough memory: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        ended, status = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        kept = getattr(chosen, "kept", None)
        more = f"; finished {kept} are kept: run again to resume" if kept else ""
        print(f"kcons: {ended}{more}", file=sys.stderr)
        return status


def commands() -> dict[str, Parser]:
    """The parser of each command."""
    return _parser().commands()


#: Options of `compare` and `plan` about the system.
_MOLECULES = "molecules in OpenMM: alanine, dhfr, dhfr-water, villin, and files"
_FILES = "any file that MDAnalysis reads; these options make it read PDB files, too"
SYSTEM = (
    Option(
        "scene",
        "one of the built-in test systems, --list shows them; or a file: PDB, mmCIF, or what MDAnalysis reads",
        nargs="?",
        metavar="SYSTEM",
    ),
    Option("--size", "number of molecules, bonds or particles", type=int),
    Option("--seed", "of the initial velocities (default 1)", type=int, default=1),
    Option("--list", "list test systems and methods, and leave", action="store_true"),
    Option(
        "--constrain",
        "beside rigid water (default hbonds for files; the last two for files that MDAnalysis reads)",
        choices=("hbonds", "allbonds", "hangles", "allangles", "none"),
        group=_MOLECULES,
    ),
    Option(
        "--forcefield",
        "files of OpenMM (default amber14-all.xml amber14/tip3pfb.xml)",
        nargs="+",
        metavar="XML",
        group=_MOLECULES,
    ),
    Option("--add-hydrogens", "add hydrogens that a file lacks, at pH 7", action="store_true", group=_MOLECULES),
    Option("--platform", "of OpenMM (default: Reference up to 200 atoms, CPU above)", group=_MOLECULES),
    Option("--coordinates", "coordinates, where the topology file has none", type=Path, metavar="FILE", group=_FILES),
    Option(
        "--forces",
        "openmm (default), force fields of OpenMM by name, comma separated (amber14-all,amber14/tip3p), or emt, "
        "lj, tip3p, gfn1, gfn2, or another calculator of ASE; not for plan",
        group=_FILES,
    ),
    Option("--select", "hold only what is within this selection of MDAnalysis", metavar="WORDS", group=_FILES),
    Option("--rigid-residues", "residues held rigid", nargs="+", metavar="NAME", group=_FILES),
)


def _parser() -> Parser:
    parser = Parser(prog="kcons", description="Constraints in molecular dynamics.")
    parser.add_argument("--version", action="store_true", help="print the version and leave")
    commands = parser.add_subparsers(title="commands", dest="command")
    common = Parser(add_help=False)
    add_options(common, SYSTEM)
    compare.add(commands, common)
    plan.add(commands, common)
    check.add(commands)
    for command in (doctor.COMMAND, freeenergy.COMMAND, scan.COMMAND, warmup.COMMAND):
        command.add(commands)
    return parser
