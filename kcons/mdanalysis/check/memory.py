"""Memory that is free, given back to the system."""

from __future__ import annotations

import ctypes
import sys


def give_back() -> None:
    """Let the C library return freed pages; parsing a large topology and setting up leave tens of megabytes of them.

    Does nothing where the library is not glibc, whose heap shrinks by itself only at its end.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
