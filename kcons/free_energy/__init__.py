"""Free energies along held coordinates, and relaxed scans.

- `averages`: means of correlated samples with weights
- `gaussian_process`, `profile`: free energies from mean forces, and where to sample next
"""

from importlib import import_module
from typing import Any

#: Public names by the module that has them, which is imported when one is asked for.
_NAMES = {
    "averages": ("Mean", "weighted_mean"),
    "profile": ("Profile", "integrate"),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)


def __getattr__(name: str) -> Any:
    for module, names in _NAMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
