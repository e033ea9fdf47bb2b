"""Compiled kernels: where they are kept, what is said while they are made, and what needs none.

Numba compiles a kernel when it is first called, and keeps the result on disk, so that a machine compiles it once. Each
processor has results of its own in the same folder, and several processes may use it at once.

- Where the folder of kcons cannot be written to, Numba keeps results below the user's home; where that cannot be
  written to either, in ``$NUMBA_CACHE_DIR``. Without any of these they are kept for one process only.
- A kernel is compiled anew when its own source has changed or that of any kernel it may call: Numba by itself looks at
  its own file only, and what was kept would call others as they were.
- Compiling that has taken a second is announced, once in a process, by the logger ``kcons`` (on standard error unless
  logging is set up otherwise).
- Garbage is not collected while a kernel is compiled: almost nothing of what the compiler makes is garbage before it
  is done, and to look for it takes a fifth of the time.
- What is done once for a set of constraints is left to Python where there are few rows (`plain_if_small`).
"""

from __future__ import annotations

import atexit
import functools
import gc
import hashlib
import logging
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kcons.errors import UnsupportedError

# Nothing that Numba imports is garbage. To look for it among all that it makes takes a tenth of the time.
_collected = gc.isenabled()
gc.disable()
try:
    import numba
    from numba.core import caching, event
finally:
    if _collected:
        gc.enable()

logger = logging.getLogger("kcons")

#: Elements of work that Python does in less time than a compiled kernel takes to be loaded from disk.
SMALL = 3000
#: Elements in all after which Python has spent a second or so.
MUCH = 100_000
#: Seconds of compiling, in all, before it is announced.
PATIENCE = 1.0

_config: Any = numba.config

if _config.DISABLE_JIT:
    raise UnsupportedError(
        "NUMBA_DISABLE_JIT is set, and kcons has kernels that exist compiled only; unset it (to step through a kernel, "
        "call its `py_func` where it has one)"
    )


_in_python: dict[Any, int] = {}
_all_compiled = False


@contextmanager
def all_compiled() -> Iterator[None]:
    """Leave nothing to Python, however small: where kernels are compiled for larger systems."""
    global _all_compiled
    before, _all_compiled = _all_compiled, True
    try:
        yield
    finally:
        _all_compiled = before


def plain_if_small(kernel: Any, size: int) -> Any:
    """A compiled function, or for little work the Python function that it was made of, unless it is loaded already.

    For work on integers: both return the same. Where little comes again and again, it is loaded after all.

    Parameters
    ----------
    kernel : numba.core.registry.CPUDispatcher
        What it calls must be `numba.extending.register_jitable`, which is compiled as a part of the caller only.
    size : int
        About how many elements are looked at; see `SMALL`.
    """
    if _all_compiled or size > SMALL or kernel.signatures or _in_python.get(kernel, 0) > MUCH:
        return kernel
    _in_python[kernel] = _in_python.get(kernel, 0) + size
    return kernel.py_func


_PACKAGE = Path(__file__).parents[1]
_IMPORTS = re.compile(r"^from (kcons[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)


@functools.cache
def _kernels_in(path: Path) -> tuple[bytes, frozenset[Path]]:
    """The source of a module with kernels, and the files that it imports from; nothing for other modules."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if not re.search("^(import|from) numba", text, re.MULTILINE):
        return b"", frozenset()
    files = set()
    for module, names in _IMPORTS.findall(text):  # a name is a module of that package, or defined in that module
        at = _PACKAGE.parent / module.replace(".", os.sep)
        files |= {at.with_suffix(".py"), *(at / f"{name}.py" for name in re.findall(r"\w+", names))}
    return text.encode(), frozenset(files)


@functools.cache
def kernel_sources(path: Path) -> tuple[frozenset[Path], str]:
    """Files of a module with kernels and of those that it imports, or these again; and a digest of what is in them."""
    found: dict[Path, bytes] = {}
    left = [path]
    while left:
        file = left.pop()
        source, imported = _kernels_in(file)
        if source:
            found[file] = source
            left.extend(imported - found.keys())
    digest = hashlib.sha256(b"".join(found[file] for file in sorted(found)))
    return frozenset(found), digest.hexdigest()


class _Locator:
    """Numba keeps kernels of this package where it would, and they are fresh until one of their sources changes."""

    @staticmethod
    def from_function(function: Any, file: str) -> Any:
        others = (kind.from_function(function, file) for kind in _locators if kind is not _Locator)
        locator = next((one for one in others if one is not None), None)
        if locator is not None and Path(file).is_relative_to(_PACKAGE):
            sources, digest = kernel_sources(Path(file))
            if len(sources) > 1:
                locator.get_source_stamp = lambda: digest
        return locator


_locators: list[Any] = caching.CacheImpl._locator_classes
_locators.insert(0, _Locator)


def _nothing() -> None:
    """What `keep_somewhere` asks Numba to keep."""


def keep_somewhere() -> str | None:
    """See that kernels can be kept; returns the folder that this process alone uses, if there is no other."""
    try:
        numba.njit(cache=True)(_nothing)
    except RuntimeError:  # no locator: neither folder can be written to
        folder = tempfile.mkdtemp(prefix="kcons-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _config.CACHE_DIR = folder
        return folder
    return None


class Announcer(event.Listener):  # type: ignore[misc]
    """Says that kernels of kcons are compiled, once it has taken `PATIENCE`; and no garbage is collected meanwhile.

    Attributes
    ----------
    seconds : float
        What compiling has taken in this process.
    announced : bool
    """

    def __init__(self, own_folder: str | None = None) -> None:
        self.seconds = 0.0
        self.announced = False
        self._own_folder = own_folder
        self._lock = threading.Lock()
        self._depth: dict[int, int] = {}
        self._begun = 0.0
        self._collected = False
        self._timer: threading.Timer | None = None

    @property
    def compiling(self) -> bool:
        """Whether a kernel is being compiled."""
        return bool(self._depth)

    def on_start(self, event: Any) -> None:
        kernel = event.data["dispatcher"].py_func
        with self._lock:
            thread = threading.get_ident()
            if not self._depth and str(kernel.__module__).partition(".")[0] != "kcons":
                return
            self._depth[thread] = self._depth.get(thread, 0) + 1
            if sum(self._depth.values()) > 1:
                return
            self._begun = time.perf_counter()
            self._collected = gc.isenabled()
            gc.disable()
            if not self.announced:
                self._timer = threading.Timer(max(PATIENCE - self.seconds, 0.0), self._announce)
                self._timer.daemon = True
                self._timer.start()

    def on_end(self, event: Any) -> None:
        with self._lock:
            thread = threading.get_ident()
            if thread not in self._depth:
                return
            self._depth[thread] -= 1
            if not self._depth[thread]:
                del self._depth[thread]
            if self._depth:
                return
            self.seconds += time.perf_counter() - self._begun
            if self._collected:
                gc.enable()
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

    def _announce(self) -> None:
        with self._lock:
            if self.announced or not self._depth:
                return
            self.announced = True
        if self._own_folder is None:
            logger.warning(
                "kcons compiles the kernels that this system needs. This happens once on a machine and takes some "
                "seconds; `kcons warmup` does it beforehand"
            )
        else:
            logger.warning(
                "kcons compiles the kernels that this system needs, and can keep them nowhere: neither its own folder "
                "nor your home can be written to. Set NUMBA_CACHE_DIR to a folder of yours, and it happens only once"
            )


def clock() -> float:
    """`time.perf_counter` without the time that compiling has taken: what is timed by it is what later runs take."""
    return time.perf_counter() - announcer.seconds


announcer = Announcer(keep_somewhere())
event.register("numba:compile", announcer)
