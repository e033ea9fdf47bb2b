"""The command `kcons warmup`: what a first run would compile, compiled beforehand."""

from __future__ import annotations

import argparse
import time
from importlib.util import find_spec

from kcons.cli.parser import Command, Option
from kcons.cli.terminal import console, names
from kcons.errors import InputError, did_you_mean


def _warmup(chosen: argparse.Namespace) -> int:
    from kcons.cli.compiled_systems import KINDS, NEEDS
    from kcons.constraints.compilation import all_compiled, announcer

    if chosen.list:
        for name, use in KINDS.items():
            print(f"{name:12} {use.__doc__}")
        return 0
    wanted = [name for given in chosen.what for name in names(given)] or list(KINDS)
    if unknown := sorted(set(wanted) - set(KINDS)):
        raise InputError(
            f"nothing here is called {unknown[0]!r}{did_you_mean(unknown[0], KINDS)}; choose of {', '.join(KINDS)}",
            item="what",
        )
    terminal = console()
    announcer.announced = announcer.keeps  # it is said here
    for name in wanted:
        needed = NEEDS.get(name)
        if needed is not None and find_spec(needed) is None:
            terminal.print(f"{name}: {needed} is not installed")
            continue
        begun, before = time.perf_counter(), announcer.seconds
        with all_compiled(), terminal.status(f"{name}: {KINDS[name].__doc__}"):
            refused = KINDS[name]()
        if refused:
            terminal.print(f"{name}: {refused}")
            continue
        compiled, whole = announcer.seconds - before, time.perf_counter() - begun
        terminal.print(f"{name}: compiled in {compiled:.1f} s" if compiled else f"{name}: is there ({whole:.1f} s)")
    return 0


COMMAND = Command(
    "warmup",
    "compile beforehand what a first run would compile",
    "Compile the kernels that systems of these kinds need, once on a machine (a processor), and keep them where later "
    "runs find them. Without names: all.",
    (
        Option("what", "kinds of systems; see --list", nargs="*"),
        Option("--list", "say what each of them is, and leave", action="store_true"),
    ),
    _warmup,
)
