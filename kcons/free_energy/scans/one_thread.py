"""BLAS kept to one thread where matrices are small.

Threads that share a small matrix wait for each other longer than they compute: with few cores, or other work on them,
a hundred times as long. Only what runs inside `one_thread` is kept to one thread. A calculator has the threads that its
user chose.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from threading import Lock
from typing import Any

_lock = Lock()
#: How often `one_thread` is entered now, in all threads of Python together, and what puts the numbers of threads back.
_entered: list[Any] = []


@cache
def _libraries() -> Any:
    """The BLAS libraries that are loaded; None without threadpoolctl."""
    if find_spec("threadpoolctl") is None:
        return None
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_thread() -> Iterator[None]:
    """BLAS has one thread inside, and outside as many as before; where threadpoolctl is installed.

    May be entered again, also by other threads of Python: the last one that leaves puts the numbers back.
    """
    libraries = _libraries()
    if libraries is None:
        yield
        return
    with _lock:
        _entered.append(_entered[0] if _entered else libraries.limit(limits=1))
    try:
        yield
    finally:
        with _lock:
            before = _entered.pop()
            if not _entered:
                before.restore_original_limits()
