"""Free energies along held coordinates, and relaxed scans.

- `held_coordinates`: multipliers and Z by name; torsions turned as rigid groups
- `averages`: means of correlated samples with weights
- `series`: samples of held coordinates, and the mean force of one window
- `profiles`: free energies from mean forces, and where to sample next
- `windows`: recording in runs of ASE and OpenMM, and many windows by any executor
- `scans`: relaxed scans
"""

from kcons.errors import imported_late

#: Public names by the module that has them, which is imported when one is asked for.
_NAMES = {
    "held_coordinates": ("HeldCoordinates", "Sample"),
    "series": ("MeanForce", "Recorder", "Series", "mean_force"),
    "windows.ase_windows": ("AseRecorder", "AseWindows"),
    "windows.openmm_windows": ("HeldCoordinatesReporter", "OpenMMWindows"),
    "windows.driver": ("FreeEnergy", "Settings", "Window", "WindowResult", "Windows"),
    "windows.input_file": ("InputFile", "read_input"),
    "averages": ("Mean", "weighted_mean"),
    "profiles.profile": ("Profile", "Surface", "fit_surface", "integrate", "plot_profile"),
    "profiles.pulls": ("Pulled", "pull_free_energy"),
    "scans.relaxed_scan": ("Scan", "scan"),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)
__getattr__ = imported_late(__name__, _NAMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
