"""What a trajectory file can hold: the precision of its coordinates, by format.

A constraint can be told to be kept only to the precision of the file. Formats store a fixed number of decimals
(XTC, PDB, GRO: a grid) or numbers in single precision (DCD, TRR, NetCDF, H5MD: a part in 2^24 of the coordinate).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kcons.errors import InputError

#: Formats whose numbers are floats in nanometres, which MDAnalysis turns into angstrom, in single precision again.
_NANOMETRES = {"TRR", "H5MD", "TNG"}
#: Decimals in angstrom of text formats that fix them.
_DECIMALS = {"PDB": 3, "ENT": 3, "PDBQT": 3, "XPDB": 3, "PQR": 3, "TRJ": 3, "MDCRD": 3, "CRDBOX": 3, "CRD": 5}
#: Magic numbers of XTC; files of the second hold more than 2^31 bytes a frame.
XTC_MAGIC = (1995, 2023)


@dataclass(frozen=True)
class FilePrecision:
    """Precision of the coordinates of one file, in angstrom.

    Attributes
    ----------
    format : str
        As MDAnalysis names it.
    step : float
        Distance of neighbouring numbers that the file can hold; 0 if they are floats.
    unit : float
        Unit of the floats in angstrom.
    exact : bool
        Whether the numbers of the file can be had back from MDAnalysis' single precision: they lie on a grid.
    """

    format: str
    step: float = 0.0
    unit: float = 1.0
    exact: bool = False

    def half_step(self, largest: float) -> float:
        """Largest error of a coordinate by rounding, where the largest coordinate is `largest`, in angstrom."""
        singles = 0.5 * float(np.spacing(np.float32(largest)))
        if self.step > 0:
            return 0.5 * self.step + (0.0 if self.exact else 2 * singles)
        if self.unit != 1.0:
            return singles + 0.5 * self.unit * float(np.spacing(np.float32(largest / self.unit)))
        return singles

    def describe(self, largest: float) -> str:
        """One sentence for a person."""
        if self.step > 0:
            return f"{self.format} stores coordinates in steps of {self.step:.3g} Å ({self.step / 10:.3g} nm)"
        step = 2 * self.half_step(largest)
        return (
            f"{self.format} stores coordinates in single precision: steps of {step:.1e} Å where coordinates reach "
            f"{largest:.0f} Å"
        )


def precision_of(path: str | Path, file_format: str, step: float | None = None) -> FilePrecision:
    """Precision of a file; read from the file itself where it says.

    Parameters
    ----------
    path : str or Path
    file_format : str
        As MDAnalysis names it, such as 'XTC'.
    step : float, optional
        What a person knows better, in angstrom.

    Raises
    ------
    InputError
        `step` is not positive.
    """
    name = file_format.upper()
    if step is not None:
        if not step > 0:
            raise InputError(f"the precision is {step}; give a positive step in angstrom, such as 0.001", item="step")
        return FilePrecision(name, float(step))
    if name == "XTC":
        per_nanometre = _xtc_precision(path)
        return (
            FilePrecision(name, 10.0 / per_nanometre, exact=True) if per_nanometre else FilePrecision(name, unit=10.0)
        )
    if name == "GRO":
        return FilePrecision(name, 10.0 * 10.0 ** -_gro_decimals(path))
    if name in _DECIMALS:
        return FilePrecision(name, 10.0 ** -_DECIMALS[name])
    if name == "XYZ":
        return FilePrecision(name, 10.0 ** -_xyz_decimals(path))
    return FilePrecision(name, unit=10.0 if name in _NANOMETRES else 1.0)


def _xtc_precision(path: str | Path) -> float:
    """Steps in a nanometre, from the first frame; 1000 is usual. 0 for floats, as which up to 9 atoms are stored."""
    with open(path, "rb") as file:
        head = file.read(60)
    if len(head) < 60:
        return 1000.0
    magic, n_atoms = struct.unpack(">2i", head[:8])
    precision = struct.unpack(">f", head[56:60])[0]
    if n_atoms <= 9:
        return 0.0
    if magic not in XTC_MAGIC or not 1 <= precision < 1e8:
        return 1000.0
    return float(precision)


def _gro_decimals(path: str | Path) -> int:
    """Columns are n + 5 wide for n decimals, so that two points are n + 5 apart."""
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [file.readline() for _ in range(3)]
    points = [k for k, c in enumerate(lines[2]) if c == "."]
    return points[1] - points[0] - 5 if len(points) > 1 else 3


def _xyz_decimals(path: str | Path) -> int:
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [file.readline() for _ in range(3)]
    words = lines[2].split()
    return len(words[1].partition(".")[2]) if len(words) > 3 and "e" not in words[1].lower() else 6
