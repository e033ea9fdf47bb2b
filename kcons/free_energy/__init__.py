"""Free energies along held coordinates, and relaxed scans.

- `torsion_force`: torsions turned as rigid groups
- `held_coordinates`, `series`: multipliers and Z by name, and samples of them
- `averages`: means of correlated samples with weights
- `mean_forces`: the mean force of one window
- `profiles`: free energies from mean forces, and where to sample next
- `windows`: recording in runs of ASE and OpenMM, and many windows by any executor
- `scans`: relaxed scans
"""

from importlib import import_module
from typing import Any

from kcons.errors import with_extra

#: Public names by the module that has them, which is imported when one is asked for.
_NAMES = {
    "held_coordinates": ("HeldCoordinates", "Sample"),
    "series": ("Recorder", "Series"),
    "mean_forces": ("MeanForce", "mean_force"),
    "windows.window": ("Settings", "Window"),
    "windows.ase_windows": ("AseRecorder", "AseWindows"),
    "windows.openmm_windows": ("HeldCoordinatesReporter", "OpenMMWindows"),
    "windows.driver": ("FreeEnergy", "WindowResult", "Windows"),
    "windows.input_file": ("InputFile", "read_input"),
    "averages": ("Mean", "weighted_mean"),
    "profiles.profile": ("Profile", "Surface", "fit_surface", "integrate", "plot_profile"),
    "profiles.pulls": ("Pulled", "pull_free_energy"),
    "scans.relaxed_scan": ("Scan", "scan"),
    "scans.system_calculator": ("SystemCalculator",),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)


def __getattr__(name: str) -> Any:
    for module, names in _NAMES.items():
        if name in names:
            try:
                found = import_module(f"{__name__}.{module}")
            except ModuleNotFoundError as error:
                raise with_extra(error, f"{__name__}.{name}") from error
            return found if module.endswith(f".{name}") else getattr(found, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
