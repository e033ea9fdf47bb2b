"""The plugin, compiled where it is used and kept in the caches of the user.

OpenMM comes with all of its headers and its libraries with all symbols, so that a C++ compiler is all that is needed.
There is one library for the integrator with the platforms Reference and CPU, and one for each of OpenCL, CUDA and HIP,
since OpenMM loads those of each platform apart.
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
#: Platforms that have a library of their own.
ACCELERATED = ("OpenCL", "CUDA", "HIP")
#: Name of the package that `python -m kcons.openmm.device.wheel` makes.
PACKAGE = "kcons_device"
_CORE = ("program_integrator.cpp", "plain_platforms.cpp")
_FLAGS = ("-std=c++17", "-O2", "-fPIC", "-shared", "-w")


def compiler() -> list[str]:
    """The C++ compiler: $CXX, or the first of g++, c++ and clang++ that is there; empty if none is."""
    given = shlex.split(os.environ.get("CXX", ""))
    found = [path for name in (*given[:1], "g++", "c++", "clang++") if (path := shutil.which(name))]
    return [found[0], *(given[1:] if given and found[0] == shutil.which(given[0]) else [])] if found else []


def folder() -> Path:
    """Where libraries are kept: with Numba's files if $NUMBA_CACHE_DIR is set, else where caches of the user are."""
    given = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) / "kcons-device"


def headers() -> Path | None:
    """OpenMM's headers: beside its libraries, as pip and conda have them."""
    path = Path(openmm.version.openmm_library_path).parent / "include"
    return path if (path / "OpenMM.h").exists() else None


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
    if headers() is None:
        return f"OpenMM's headers are not at {Path(openmm.version.openmm_library_path).parent / 'include'}"
    return ""


def reluctance() -> str:
    """Why the plugin is not taken where nobody demands it; empty if it is."""
    if not (accelerated() or is_built()):
        return "the plugin is not compiled, and OpenMM has no platform for GPUs here; kcons warmup device compiles it"
    if not (accelerated() or compiler()):
        return "the platforms Reference and CPU need a C++ compiler, and there is none"
    return ""


def is_built() -> bool:
    """Whether the library of the integrator is there: in the cache, or in an installed wheel."""
    return any((path / "libKcons.so").exists() for path in places())


def places() -> list[Path]:
    """Folders that may have libraries of these sources: an installed wheel, and the cache."""
    found = importlib.util.find_spec(PACKAGE)
    wheel = [Path(path) / digest() for path in (found.submodule_search_locations or ())] if found else []
    return [*wheel, folder() / digest()]


def accelerated() -> list[str]:
    """Platforms of OpenMM here that have a library of their own."""
    names = [openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())]
    return [name for name in names if name in ACCELERATED]


def build(target: Path, platforms: Sequence[str], stubs: bool = False) -> None:
    """Compile the libraries of some of the platforms `ACCELERATED` into a folder.

    With `stubs`, link with empty libraries of the names of OpenMM's, so that none of the platforms need be here.
    """
    target.mkdir(parents=True, exist_ok=True)
    libraries = Path(openmm.version.openmm_library_path)
    with tempfile.TemporaryDirectory(dir=target) as made:
        where = [f"-L{libraries}", f"-L{libraries / 'plugins'}", f"-Wl,-rpath,{libraries}:{libraries / 'plugins'}"]
        if stubs:
            where = [f"-L{made}"]
            for name in ("OpenMM", *(f"OpenMM{platform}" for platform in platforms)):
                stub = ["-shared", "-xc++", os.devnull, f"-Wl,-soname,lib{name}.so", "-o", f"{made}/lib{name}.so"]
                _compile(stub)
        shared = [*_FLAGS, f"-I{headers()}", *where, f"-L{made}", "-Wl,-rpath,$ORIGIN"]
        core = [str(SOURCES / name) for name in _CORE]
        _compile([*core, *shared, "-lOpenMM", "-Wl,-soname,libKcons.so", "-o", f"{made}/libKcons.so"])
        for platform in platforms:
            name, source = f"libKcons{platform}.so", str(SOURCES / "common_platform.cpp")
            linked = [*shared, "-lKcons", f"-lOpenMM{platform}", "-lOpenMM"]
            _compile([source, f'-DPLATFORM="{platform}"', *linked, "-o", f"{made}/{name}"])
        for path in Path(made).glob("libKcons*.so"):
            os.replace(path, target / path.name)


def _compile(arguments: Sequence[str]) -> None:
    done = subprocess.run([*compiler(), *arguments], capture_output=True, text=True)
    if done.returncode:
        raise UnsupportedError(f"the C++ compiler refused the plugin: {done.stderr.strip()[:2000]}")


@cache
def library() -> ctypes.CDLL:
    """The library of the integrator, with those of all platforms loaded into OpenMM; UnsupportedError without one."""
    if why := refusal():
        raise UnsupportedError(f"no steps on the device: {why}")
    wanted = accelerated()
    names = ["libKcons.so", *(f"libKcons{name}.so" for name in wanted)]
    there = next((path for path in places() if all((path / name).exists() for name in names)), None)
    if there is None:
        there = folder() / digest()
        logger.info("compiling the plugin of OpenMM for %s", ", ".join(["Reference", "CPU", *wanted]))
        build(there, wanted)
    loaded = ctypes.CDLL(str(there / "libKcons.so"))
    loaded.kcons_error.restype = ctypes.c_char_p
    for name in wanted:
        openmm.Platform.loadPluginLibrary(str(there / f"libKcons{name}.so"))
    return loaded


def kernels_library(source: str) -> Path:
    """Kernels for Reference and CPU, compiled to a library; UnsupportedError where there is no compiler."""
    if not compiler():
        raise UnsupportedError("steps on the platforms Reference and CPU need a C++ compiler, and there is none")
    path = folder() / f"kernels_{hashlib.sha256(f'{_FLAGS} {source}'.encode()).hexdigest()[:24]}.so"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as made:
            text = Path(made) / "kernels.cpp"
            text.write_text(source)
            _compile([str(text), *_FLAGS, "-o", f"{made}/kernels.so"])
            os.replace(f"{made}/kernels.so", path)
    return path
