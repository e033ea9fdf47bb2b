"""The command `kcons doctor`: what there is on this machine, and what is missing."""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from kcons import __version__
from kcons.cli.parser import Command, Option
from kcons.cli.terminal import show
from kcons.errors import EXTRAS

#: Names of distributions that differ from those of the packages.
DISTRIBUTIONS = {"MDAnalysis": "mdanalysis", "openmm": "OpenMM", "torch_sim": "torch-sim-atomistic"}
THREADS = ("OMP_NUM_THREADS", "OPENMM_CPU_THREADS", "NUMBA_NUM_THREADS")


def _doctor(chosen: argparse.Namespace) -> int:
    found = examine()
    wrong = found["wrong"]
    if chosen.json:
        print(json.dumps(found, indent=2))
        return 1 if wrong else 0
    for heading, entries in found.items():
        if heading != "wrong":
            show(heading, *(f"  {name:<20} {value}" for name, value in entries.items()))
    show(*(f"wrong: {sentence}" for sentence in wrong) if wrong else ["nothing is wrong"])
    return 1 if wrong else 0


def examine() -> dict[str, Any]:
    """Sections of names and what was found; under 'wrong' sentences on what has to be mended."""
    import numba

    from kcons.comparison.machine import processor, simd_width

    wrong: list[str] = []
    openmm = find_spec("openmm")
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "kcons": {"version": __version__, "Python": platform.python_version(), "at": str(Path(__file__).parents[1])},
        "machine": {
            "processor": processor(),
            "system": f"{platform.system()} {platform.machine()}",
            "SIMD": f"{simd_width()} bits",
            "cores": f"{os.cpu_count()}, {usable} of them for this process",
            "threads of Numba": str(numba.get_num_threads()),
            "set in the shell": ", ".join(f"{n}={os.environ[n]}" for n in THREADS if n in os.environ) or "nothing",
        },
        "packages": {name: version(name) or "not installed" for name in ("numpy", "scipy", "numba", "rich")},
        "extras": {name: version(name) or f"pip install 'kcons[{extra}]'" for name, extra in EXTRAS.items()},
        "OpenMM platforms": _platforms(wrong) if openmm else {},
        "steps on the device": _device() if openmm else {},
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


def _platforms(wrong: list[str]) -> dict[str, str]:
    """Whether a step was made on each platform of OpenMM, or why none was."""
    import openmm

    found = {}
    for k in range(openmm.Platform.getNumPlatforms()):
        chosen, system = openmm.Platform.getPlatform(k), openmm.System()
        system.addParticle(1.0)
        try:
            context = openmm.Context(system, openmm.VerletIntegrator(0.001), chosen)
            context.setPositions([[0.0, 0.0, 0.0]])
            context.getIntegrator().step(1)
            found[chosen.getName()] = "runs"
            del context
        except openmm.OpenMMException as error:
            found[chosen.getName()] = f"does not run: {' '.join(str(error).split())[:120]}"
    for failure in openmm.Platform.getPluginLoadFailures():
        found[f"plugin {len(found)}"] = f"not loaded: {' '.join(failure.split())[:120]}"
    if "runs" not in found.values():
        wrong.append("no platform of OpenMM runs; install it again: python -m pip install --force-reinstall openmm")
    return found


def _device() -> dict[str, str]:
    """Whether there is the plugin of OpenMM, or why there can be none."""
    from kcons.openmm.device import build

    there = next((path for path in build.places() if (path / "libKcons.so").exists()), None)
    plugin = f"in {there}" if there else "not compiled yet; kcons warmup device compiles it"
    return {
        "compiler": " ".join(build.compiler()) or "none",
        "for": ", ".join(["Reference", "CPU", *build.accelerated()]),
        "plugin": f"none: {why}" if (why := build.refusal()) else plugin,
    }


def caches(wrong: list[str]) -> dict[str, str]:
    """Where compiled kernels are kept, and whether they can be."""
    from kcons.comparison.machine import PACKAGE, kernels_cached

    places = {
        "beside the package": PACKAGE / "constraints" / "__pycache__",
        "in your home": Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")),
    }
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        places = {"$NUMBA_CACHE_DIR": Path(given)}
    can = {name: writable(path) for name, path in places.items()}
    if not any(can.values()):
        wrong.append(
            "compiled kernels cannot be kept, so that every process compiles them anew: "
            "set NUMBA_CACHE_DIR to a folder of yours"
        )
    said = {name: f"{path}, {'can' if can[name] else 'cannot'} be written to" for name, path in places.items()}
    return said | {"compiled kernels": "there are some" if kernels_cached() else "none yet; kcons warmup compiles them"}


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
