"""Several workers: threads where files are read without the interpreter's lock, processes that inherit otherwise."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from MDAnalysis.analysis.backends import BackendBase, BackendMultiprocessing
from MDAnalysis.coordinates.memory import MemoryReader

from kcons.errors import InputError

#: Analyses that run now, for processes forked meanwhile.
_RUNNING: dict[int, Any] = {}


class BackendThreads(BackendBase):  # type: ignore[misc]
    """Parts of a trajectory in threads of this process.

    Parameters
    ----------
    n_workers : int
    """

    def apply(self, func: Callable[[Any], Any], computations: list[Any]) -> list[Any]:
        """Results of `func`, in order."""
        with ThreadPoolExecutor(self.n_workers) as pool:
            return list(pool.map(func, computations))


def with_backend(options: dict[str, Any], threads: bool) -> dict[str, Any]:
    """Options for MDAnalysis' `run`, which has no threads: `BackendThreads` in their place.

    Parameters
    ----------
    options : dict
        'backend', with 'threads' among the names, and 'n_workers'; of several workers without a backend, threads where
        they can be had and processes otherwise.
    threads : bool
        Whether they can be had.

    Raises
    ------
    InputError
        Threads that cannot be had.
    """
    backend, n_workers = options.get("backend"), options.get("n_workers") or 1
    if backend is None and n_workers > 1:
        backend = "threads" if threads else "multiprocessing"
    if backend == "threads":
        if not threads:
            raise InputError(
                "threads need a DCD file without transformations and rows that are all lengths; use "
                "backend='multiprocessing'",
                item="backend",
            )
        return options | {"backend": BackendThreads(n_workers), "unsupported_backend": True}
    return options | {"backend": backend}


@contextmanager
def inherited(analysis: Any, backend: Any) -> Iterator[None]:
    """Processes forked within inherit the analysis; sending it to them can take longer than the check itself.

    Does nothing where processes are not forked, and for other backends than MDAnalysis' own processes.
    """
    ours = backend == "multiprocessing" or isinstance(backend, BackendMultiprocessing)
    if not ours or multiprocessing.get_start_method() != "fork":
        yield
        return
    key = id(analysis)
    _RUNNING[key] = analysis
    try:
        yield
    finally:
        del _RUNNING[key]


def short_pickle(analysis: Any) -> tuple[Any, ...] | None:
    """What `__reduce_ex__` may give instead of the analysis; None where it must be sent as a whole."""
    return (_found, (id(analysis),)) if id(analysis) in _RUNNING else None


def _found(key: int) -> Any:
    inherited = _RUNNING[key]
    # copy.copy would ask __reduce_ex__, which leads here.
    analysis = object.__new__(type(inherited))
    vars(analysis).update(vars(inherited))
    # Places in files are shared between a process and its children, so that each needs files of its own.
    reader = analysis._trajectory
    if not isinstance(reader, MemoryReader):
        # Not as a part of the analysis, which would be found again.
        analysis._trajectory = pickle.loads(pickle.dumps(reader))
    return analysis
