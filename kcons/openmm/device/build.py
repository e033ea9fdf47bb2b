"""The plugin, compiled where it is used and kept in the caches of the user.

OpenMM comes with all headers and symbols: a C++ compiler is all that is needed. There is one library for the integrator
with the platforms Reference and CPU, and one for each of OpenCL, CUDA and HIP, which OpenMM loads apart.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import logging
import os
import platform as machine
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import openmm

from kcons.errors import UnsupportedError

logger = logging.getLogger("kcons.openmm")

SOURCES = Path(__file__).parent / "plugin"
#: Beside OpenMM's libraries, as pip and conda have them.
HEADERS = Path(openmm.version.openmm_library_path).parent / "include"
#: Platforms that have a library of their own.
ACCELERATED = ("OpenCL", "CUDA", "HIP")
#: Name of the package that `python -m kcons.openmm.device.wheel` makes.
PACKAGE = "kcons_device"
_FLAGS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-w")


def compiler() -> list[str]:
    """The C++ compiler: $CXX, or the first of g++, c++ and clang++ that is there; empty if none is."""
    known = shlex.split(os.environ.get("CXX", "")), ["g++"], ["c++"], ["clang++"]
    return next(([path, *words[1:]] for words in known if words and (path := shutil.which(words[0]))), [])


def folder() -> Path:
    """Where libraries are kept: with Numba's files if $NUMBA_CACHE_DIR is set, else where caches of the user are."""
    given = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) / "kcons-device"


def digest() -> str:
    """Of the sources, OpenMM's version and the machine: what a library was made of."""
    known = hashlib.sha256(f"{openmm.version.full_version} {machine.machine()} {_FLAGS}".encode())
    for path in sorted(SOURCES.iterdir()):
        known.update(path.read_bytes())
    return known.hexdigest()[:16]


def refusal() -> str:
    """Why there can be no plugin; empty if there is one or it can be made."""
    if sys.platform != "linux":
        return f"the plugin is made for Linux, and this is {sys.platform}"
    if is_built():
        return ""
    if not compiler():
        return "there is no C++ compiler; install g++, or a wheel made by python -m kcons.openmm.device.wheel"
    return "" if (HEADERS / "OpenMM.h").exists() else f"OpenMM's headers are not at {HEADERS}"


def is_built() -> bool:
    """Whether the library of the integrator is there: in the cache, or in an installed wheel."""
    return any((path / "libKcons.so").exists() for path in places())


def places() -> list[Path]:
    """Folders that may have libraries of these sources: an installed wheel, and the cache."""
    found = importlib.util.find_spec(PACKAGE)
    wheels = (found and found.submodule_search_locations) or ()
    return [Path(path) / digest() for path in (*wheels, folder())]


def accelerated() -> list[str]:
    """Platforms of OpenMM here that have a library of their own."""
    names = [openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())]
    return [name for name in names if name in ACCELERATED]


def build(target: Path, platforms: Sequence[str]) -> None:
    """Compile the libraries of some of the platforms `ACCELERATED`, which need not be here, into a folder."""
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target) as made:
        # Linked with empty libraries of the names of OpenMM's, which Python has loaded before.
        for name in ("OpenMM", *(f"OpenMM{platform}" for platform in platforms)):
            _compile(["-shared", "-xc++", os.devnull, f"-Wl,-soname,lib{name}.so", "-o", f"{made}/lib{name}.so"])
        shared = [*_FLAGS, f"-I{HEADERS}", f"-L{made}", "-Wl,--no-as-needed,-rpath,$ORIGIN"]
        core = [str(SOURCES / "program_integrator.cpp"), *shared, "-lOpenMM", "-Wl,-soname,libKcons.so"]
        _compile([*core, "-o", f"{made}/libKcons.so"])
        for platform in platforms:
            linked = [*shared, "-lKcons", f"-lOpenMM{platform}", "-lOpenMM", "-o", f"{made}/libKcons{platform}.so"]
            _compile([str(SOURCES / "common_platform.cpp"), f'-DPLATFORM="{platform}"', *linked])
        for path in Path(made).glob("libKcons*.so"):
            os.replace(path, target / path.name)


def _compile(arguments: Sequence[str], source: str = "") -> None:
    if not compiler():
        raise UnsupportedError("there is no C++ compiler, which steps on Reference and CPU and a wheel need")
    done = subprocess.run([*compiler(), *arguments], input=source, capture_output=True, text=True)
    if done.returncode:
        raise UnsupportedError(f"the C++ compiler refused the plugin: {done.stderr.strip()[:2000]}")


@cache
def library() -> ctypes.CDLL:
    """The library of the integrator, with those of all platforms loaded into OpenMM; UnsupportedError without one."""
    if why := refusal():
        raise UnsupportedError(f"no steps on the device: {why}")
    names = ["libKcons.so", *(f"libKcons{name}.so" for name in accelerated())]
    there = next((path for path in places() if all((path / name).exists() for name in names)), None)
    if there is None:
        there = folder() / digest()
        logger.info("compiling the plugin of OpenMM for %s", ", ".join(["Reference", "CPU", *accelerated()]))
        build(there, accelerated())
    loaded = [ctypes.CDLL(str(there / name)) for name in names]
    loaded[0].kcons_error.restype = ctypes.c_char_p
    return loaded[0]


def kernels_library(source: str) -> Path:
    """Kernels for Reference and CPU, compiled to a library; UnsupportedError where there is no compiler."""
    path = folder() / f"kernels_{hashlib.sha256(f'{_FLAGS} {source}'.encode()).hexdigest()[:24]}.so"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as made:
            _compile(["-xc++", "-", *_FLAGS, "-o", f"{made}/kernels.so"], source)
            os.replace(f"{made}/kernels.so", path)
    return path
