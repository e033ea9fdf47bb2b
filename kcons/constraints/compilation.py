"""Compiled kernels: where they are kept, what is said while they are made, and what needs none.

Numba compiles a kernel when it is first called, and keeps the result on disk, so that a machine compiles it once. Each
processor has results of its own in the same folder, and several processes may use it at once. For all kernels of kcons,
which `njit` and `cfunc` of this module make:

- Where the folder of kcons cannot be written to, Numba keeps results below the user's home; where that cannot be
  written to either, in ``$NUMBA_CACHE_DIR``, which has to be set then.
- The machine code of a kernel is the same in the process that compiles it and in those that load it (`_Library`), so
  results are the same to the last bit.
- A damaged file counts as missing.
- A kernel is compiled anew when its own source has changed or that of any kernel it may call: Numba by itself looks at
  its own file only, and what was kept would call others as they were.
- Compiling that has taken a second is announced, once in a process, by the logger ``kcons`` (on standard error unless
  logging is set up otherwise).
- Garbage is not collected while a kernel is compiled: that takes a fifth of the time.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import inspect
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import caching, codegen, compiler
from numba.core.ccallback import CFunc
from numba.core.sigutils import normalize_signature

from kcons.errors import UnsupportedError

logger = logging.getLogger("kcons")

#: Elements of work that Python does in less time than a compiled kernel takes to be loaded from disk; 0 leaves none.
SMALL = 3000
#: Seconds of compiling, in all, before it is announced.
PATIENCE = 1.0

_config: Any = numba.config

if _config.DISABLE_JIT:
    raise UnsupportedError(
        "NUMBA_DISABLE_JIT is set, and kcons has kernels that exist compiled only; unset it (to step through a kernel, "
        "call its `py_func` where it has one)"
    )


def plain_if_small(kernel: Any, size: int) -> Any:
    """A compiled function, or for little work the Python function that it was made of, unless it is loaded already.

    For work on integers, about `size` elements: both return the same. What it calls must be
    `numba.extending.register_jitable`, which is compiled as a part of the caller only.
    """
    return kernel if size > SMALL or kernel.signatures else kernel.py_func


_PACKAGE = Path(__file__).parents[1]
#: Kernels, and functions that are compiled as parts of kernels.
_HAS_KERNELS = re.compile(
    r"^(import|from) numba|^from kcons\.constraints\.compilation import .*\b(njit|cfunc)\b|^# Compiled into kernels"
    r"|^ +def row\(r: Any, p: Any",
    re.MULTILINE,
)
_IMPORTS = re.compile(r"^from (kcons[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)


@functools.cache
def _kernels_in(path: Path) -> tuple[bytes, frozenset[Path]]:
    """The source of a module with kernels, and the files that it imports from; nothing for other modules."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if not _HAS_KERNELS.search(text):
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


# -- what is kept on disk ---------------------------------------------------------------------------


class _Files(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Numba's index and data of a kernel; what is damaged is not there."""

    def load(self, key: Any) -> Any:
        try:
            found = super().load(key)
        except Exception:  # pickle raises whatever the bytes lead to
            return None
        # Two processes that write an index at once may give a number twice, and the index is written before the data.
        return found[1] if found is not None and found[0] == (self._source_stamp, key) else None

    def save(self, key: Any, data: Any) -> None:
        super().save(key, ((self._source_stamp, key), data))

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:
            return {}


@functools.cache
def _say_once(folder: str, error: str) -> None:
    logger.warning(f"compiled code cannot be kept in {folder}, and is made anew by each process: {error}")


class _KernelCache(caching.FunctionCache):  # type: ignore[misc]
    """A kernel is kept where Numba would keep it, and is fresh until one of its sources changes."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        parts = (cell.cell_contents for cell in function.__closure__ or ())
        files = {Path(inspect.getfile(part)) for part in (function, *parts) if inspect.isfunction(part)}
        stamp = self._impl.locator.get_source_stamp()
        if all(source.is_relative_to(_PACKAGE) for source in files):
            stamp = "".join(kernel_sources(source)[1] for source in sorted(files))
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, stamp)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say_once(self._cache_path, str(error))


# -- kernels ----------------------------------------------------------------------------------------


class _Library(codegen.JITCodeLibrary):  # type: ignore[misc]
    """The machine code of a kernel, which has its own copies of all kernels that it calls.

    Numba leaves these visible, so that a call goes to the copy that the process met first: the called kernel itself
    where it was compiled here, and that of some caller where kernels were loaded. And it takes copies after machine
    code was made of a kernel, which changes it, so that they differ from it. Results then differ in their last bits
    between the process that compiles and those that load.
    """

    def _finalize_final_module(self) -> None:
        module = self._final_module
        # For callers, as they get it where this kernel was loaded.
        self._shared_module = llvm.parse_bitcode(self._linkable().as_bitcode())
        for function in module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.linkonce_odr:
                function.linkage = llvm.Linkage.internal
        super()._finalize_final_module()

    def _linkable(self) -> Any:
        module = self._final_module.clone()
        for function in module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = llvm.Linkage.linkonce_odr
        return module


class _Compiler(compiler.Compiler):  # type: ignore[misc]
    """Makes a `_Library`, and is watched by the `Announcer`."""

    def compile_extra(self, func: Any) -> Any:
        self.state.library = _Library(self.state.targetctx.codegen(), func.__qualname__)
        self.state.library.enable_object_caching()
        with announcer.watching():
            return super().compile_extra(func)


def njit(function: Any = None, /, *, cache: bool = False, **options: Any) -> Any:
    """`numba.njit` for kernels of kcons, with its options; `cache` keeps them on disk. Without a function a decorator.

    Machine code is the same whether it was compiled or loaded, and it is compiled anew when any of its sources changes.
    """

    def made(function: Any) -> Any:
        kernel = numba.njit(pipeline_class=_Compiler, **(options | {"no_cfunc_wrapper": True}))(function)
        if cache:
            kernel._cache = _KernelCache(function)
        return kernel

    return made if function is None else made(function)


def cfunc(signature: Any, *, cache: bool = False, **options: Any) -> Callable[[Any], Any]:
    """`numba.cfunc` for kernels of kcons; see `njit`."""

    def made(function: Any) -> Any:
        kernel: Any = CFunc(function, normalize_signature(signature), {}, options, pipeline_class=_Compiler)
        if cache:
            kernel._cache = _KernelCache(function)
        kernel.compile()
        return kernel

    return made


def has_a_file(function: Any) -> bool:
    """Whether a function was written in a file, beside which or for which kernels can be kept."""
    return Path(function.__code__.co_filename).is_file()


class Announcer:
    """Says that kernels of kcons are compiled, the first that begins after `PATIENCE`; keeps garbage meanwhile.

    `seconds` is what compiling has taken in this process.
    """

    def __init__(self) -> None:
        self.seconds, self.announced = 0.0, False
        self._depth, self._begun = 0, 0.0  # Numba compiles in one thread at a time

    @property
    def compiling(self) -> bool:
        """Whether a kernel is being compiled."""
        return self._depth > 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """While a kernel is compiled, which may be a part of another one."""
        now, collected = time.perf_counter(), gc.isenabled()
        gc.disable()
        if not self._depth:
            self._begun = now
        self._depth += 1
        try:
            if not self.announced and self.seconds + now - self._begun >= PATIENCE:
                self.announced = True
                logger.warning(
                    "kcons compiles the kernels that this system needs. This happens once on a machine and takes some "
                    "seconds; `kcons warmup` does it beforehand"
                )
            yield
        finally:
            self._depth -= 1
            if collected:
                gc.enable()
            if not self._depth:
                self.seconds += time.perf_counter() - self._begun


def clock() -> float:
    """`time.perf_counter` without the time that compiling has taken: what is timed by it is what later runs take."""
    return time.perf_counter() - announcer.seconds


announcer = Announcer()
try:
    njit(cache=True)(has_a_file)  # which is not compiled
except RuntimeError:  # no locator
    raise UnsupportedError(
        "compiled kernels can be kept nowhere: neither the folder of kcons nor your home can be written to; set "
        "NUMBA_CACHE_DIR to a folder of yours"
    ) from None
