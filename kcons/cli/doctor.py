"""The command `kcons doctor`: what there is on this machine, and what is missing."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import tempfile
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from kcons import __version__
from kcons.cli.parser import Command, Option
from kcons.cli.terminal import console
from kcons.errors import EXTRAS

#: Names of distributions that differ from those of the packages.
DISTRIBUTIONS = {"MDAnalysis": "mdanalysis", "openmm": "OpenMM"}
NEEDED = ("numpy", "scipy", "numba", "rich")


def _doctor(chosen: argparse.Namespace) -> int:
    found = examine()
    if chosen.json:
        print(json.dumps(found, indent=2))
    else:
        terminal = console()
        for heading, entries in found.items():
            if heading == "wrong":
                continue
            terminal.print(f"[bold]{heading}[/bold]")
            for name, value in entries.items():
                terminal.print(f"  {name:<20} {value}", highlight=False, markup=False, soft_wrap=True)
        for sentence in found["wrong"]:
            terminal.print(f"wrong: {sentence}", highlight=False, markup=False, soft_wrap=True)
        if not found["wrong"]:
            terminal.print("nothing is wrong")
    return 1 if found["wrong"] else 0


def examine() -> dict[str, Any]:
    """Sections of names and what was found; under 'wrong' sentences on what has to be mended."""
    wrong: list[str] = []
    return {
        "kcons": {"version": __version__, "Python": platform.python_version(), "at": str(Path(__file__).parents[1])},
        "machine": machine(),
        "packages": {name: version(name) or "not installed" for name in NEEDED},
        "extras": {name: version(name) or f"pip install 'kcons[{EXTRAS[name]}]'" for name in EXTRAS},
        "OpenMM platforms": platforms(wrong),
        "caches": caches(wrong),
        "wrong": wrong,
    }


def version(package: str) -> str | None:
    """The version of a package that can be imported; None of one that cannot."""
    if find_spec(package) is None:
        return None
    try:
        return metadata.version(DISTRIBUTIONS.get(package, package))
    except metadata.PackageNotFoundError:
        return "of unknown version"


# -- machine ----------------------------------------------------------------------------------------


def machine() -> dict[str, str]:
    """Processor, the width of its registers, and threads."""
    import numba

    from kcons.comparison.machine import processor, simd_width

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    set_by = {
        name: os.environ[name]
        for name in ("OMP_NUM_THREADS", "OPENMM_CPU_THREADS", "NUMBA_NUM_THREADS")
        if name in os.environ
    }
    return {
        "processor": processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "SIMD": f"{simd_width()} bits",
        "cores": f"{os.cpu_count()}, {usable} of them for this process",
        "threads of Numba": str(numba.get_num_threads()),
        "set in the shell": ", ".join(f"{name}={value}" for name, value in set_by.items()) or "nothing",
    }


# -- OpenMM -----------------------------------------------------------------------------------------


def platforms(wrong: list[str]) -> dict[str, str]:
    """Each platform of OpenMM with its device and the precisions that run on it."""
    if find_spec("openmm") is None:
        return {}
    import openmm

    names = [openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())]
    found = {name: _try_platform(name) for name in names}
    for failure in openmm.Platform.getPluginLoadFailures():
        found[f"plugin {len(found)}"] = f"not loaded: {_first_line(failure)}"
    if not any(said.startswith("runs") for said in found.values()):
        wrong.append("no platform of OpenMM runs; install it again: python -m pip install --force-reinstall openmm")
    return found


def _try_platform(name: str) -> str:
    import openmm

    chosen = openmm.Platform.getPlatformByName(name)
    adjustable = "Precision" in chosen.getPropertyNames()
    running: list[str] = []
    device = failure = ""
    for precision in ("single", "mixed", "double") if adjustable else ("",):
        system = openmm.System()
        system.addParticle(1.0)
        given = {"Precision": precision} if adjustable else {}
        try:
            context = openmm.Context(system, openmm.VerletIntegrator(0.001), chosen, given)
            context.setPositions([[0.0, 0.0, 0.0]])
            context.getIntegrator().step(1)
        except openmm.OpenMMException as error:
            failure = _first_line(str(error))
            continue
        running.append(precision or {"Reference": "double", "CPU": "mixed"}.get(name, "its own precision"))
        if "DeviceName" in chosen.getPropertyNames():
            device = chosen.getPropertyValue(context, "DeviceName")
        elif name == "CPU":
            device = f"{chosen.getPropertyValue(context, 'Threads')} threads"
        del context
    return f"runs: {', '.join(running)}" + (f" ({device})" if device else "") if running else f"does not run: {failure}"


def _first_line(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()[:120]


# -- caches -----------------------------------------------------------------------------------------


def caches(wrong: list[str]) -> dict[str, str]:
    """Where compiled kernels are kept, and whether they can be."""
    from kcons.comparison.machine import kernels_cached
    from kcons.constraints import compilation

    here = Path(compilation.__file__).parent / "__pycache__"
    places: dict[str, Path] = {"beside the package": here}
    if "NUMBA_CACHE_DIR" in os.environ:
        places = {"$NUMBA_CACHE_DIR": Path(os.environ["NUMBA_CACHE_DIR"])}
    else:
        places["in your home"] = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    can = {name: writable(path) for name, path in places.items()}
    if not any(can.values()):
        wrong.append(
            "compiled kernels cannot be kept, so that every process compiles them anew: "
            "set NUMBA_CACHE_DIR to a folder of yours"
        )
    said: dict[str, str] = {
        name: f"{path}, {'can' if can[name] else 'cannot'} be written to" for name, path in places.items()
    }
    said["compiled kernels"] = "there are some" if kernels_cached() else "none yet; kcons warmup compiles them"
    return said


def writable(folder: Path) -> bool:
    """Whether a file can be made in a folder, or in the nearest folder above that there is."""
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


COMMAND = Command(
    "doctor",
    "MD engines, platforms, threads, caches and optional packages of this machine",
    "What kcons finds on this machine. Exit status 0; 1 if something is wrong, which is said.",
    (Option("--json", "as JSON, to send along with a question", action="store_true"),),
    _doctor,
)
