"""What a trajectory file can hold: the precision of its coordinates, by format.

A constraint can be told to be kept only to the precision of the file. Formats store a fixed number of decimals
(XTC, PDB, GRO: a grid) or numbers in single precision (DCD, TRR, NetCDF, H5MD: a part in 2^24 of the coordinate).
The latter is a matter of every single coordinate: an atom that is far away makes no other one less precise.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from MDAnalysis.lib.util import anyopen
from numpy.typing import ArrayLike

from kcons.constraints.arguments import positive
from kcons.constraints.target import FloatArray
from kcons.mdanalysis.loading import format_named, format_of, line_of

#: Formats whose numbers are floats in nanometers, which MDAnalysis turns into angstrom, in single precision again.
_NANOMETERS = {"TRR", "H5MD", "TNG"}
#: Decimals in angstrom of text formats that fix them.
_DECIMALS = {"PDB": 3, "ENT": 3, "PDBQT": 3, "XPDB": 3, "PQR": 3, "TRJ": 3, "MDCRD": 3, "CRDBOX": 3, "CRD": 5}
#: Magic numbers of XTC; files of the second hold more than 2^31 bytes a frame.
XTC_MAGIC = (1995, 2023)
#: Atoms of a text file whose numbers are looked at.
MOST_READ = 1000
#: Steps, in angstrom, that coordinates may have had before they came into a file of floats.
GRIDS = (0.1, 0.01, 0.001, 0.0001)
#: Logarithm of the chance, at most, that numbers which were not rounded lie on such a grid.
BY_CHANCE = -30.0
#: Half the distance of neighboring single precision numbers is at most this part of the power of two below them.
HALF_UNIT = 2.0**-24


@dataclass(frozen=True)
class FilePrecision:
    """Precision of the coordinates of one file, in angstrom; the format is as MDAnalysis names it."""

    format: str
    #: Distance of neighboring numbers that the file can hold; 0 if they are floats, and the unit of these.
    step: float = 0.0
    unit: float = 1.0
    #: Whether the numbers of the file can be had back from MDAnalysis' single precision: they lie on a grid.
    exact: bool = False
    #: Significant digits of numbers that are written with as many decimals as they need; 0 if that is not so.
    digits: int = 0
    #: Coordinates were moved by up to this after they had been rounded to these digits.
    shift: float = 0.0

    @cached_property
    def coefficients(self) -> tuple[float, float, float]:
        """Rounding moves coordinates of an atom, 2^e <= largest < 2^(e+1), by base; + factor 2^e from `reach` on."""
        if self.exact:
            # Integers of XTC are turned into nanometers, and these into angstrom, with four roundings; they can be had
            # back where these make less than half a step. Elsewhere the one taken for it is off by twice the four.
            return 0.5 * self.step, 16 * HALF_UNIT, 2.0 ** np.floor(np.log2(self.step / (8 * HALF_UNIT)))
        if self.digits:
            # The last digit is worth 10^(1 - digits) of the number, at most, and numbers are below 2 2^e.
            part = 10.0 ** (1 - self.digits)
            return 0.5 * part * self.shift, part + 3 * HALF_UNIT, 0.0
        # Rounded once, as stored; then, of decimals or nanometers, by the change to angstrom, where 2^e may be twice
        # that of the number stored.
        return 0.5 * self.step, (1 if self.unit == 1.0 and not self.step else 3) * HALF_UNIT, 0.0

    def stored(self, coordinates: ArrayLike) -> FloatArray:
        """Coordinates in double precision, as the file holds them."""
        exact = np.asarray(coordinates, dtype=np.float64)
        return np.rint(exact * (1.0 / self.step)) * self.step if self.exact else exact

    def half_step(self, coordinates: ArrayLike) -> FloatArray:
        """Largest error by rounding of coordinates of atoms, shape (..., 3); infinite where there are no numbers."""
        size = np.abs(np.asarray(coordinates, dtype=np.float64)).max(axis=-1)
        base, factor, reach = self.coefficients
        with np.errstate(all="ignore"):
            below = np.where(size > 0, np.ldexp(1.0, np.frexp(size)[1] - 1), 0.0)
            below = np.where(below < reach, 0.0, below)
        return np.where(np.isfinite(size), base + factor * below, np.inf)


def precision_of(path: str | Path, file_format: str, step: float | None = None) -> FilePrecision:
    """Precision of a file, read from it where it says; `step`, in angstrom, is what a person knows better."""
    name = file_format.upper()
    if step is not None:
        return FilePrecision(name, positive(step, "precision"))
    if name == "XTC":
        with open(path, "rb") as file:
            steps = _xtc_precision(file)
        return FilePrecision(name, 10.0 / steps, exact=True) if steps else FilePrecision(name, unit=10.0)
    if name == "GRO":
        # Columns are n + 5 wide for n decimals, so that two points of the third line are n + 5 apart.
        points = [k for k, c in enumerate(line_of(path, 2)) if c == ord(".")]
        return FilePrecision(name, 10.0 * 10.0 ** -(points[1] - points[0] - 5 if len(points) > 1 else 3))
    if name in _DECIMALS:
        return FilePrecision(name, 10.0 ** -_DECIMALS[name])
    if name == "XYZ":
        with anyopen(str(path), "rb") as file:
            head, _ = _words(file), file.readline()
            lines = [_words(file) for _ in range(min(int(head[0]), MOST_READ) if head and head[0].isdigit() else 0)]
        return _of_words(name, [word for words in lines for word in words[1:4]])
    if name == "LAMMPSDUMP":
        return _of_dump(path)
    return FilePrecision(name, unit=10.0 if name in _NANOMETERS else 1.0)


def precision_of_reader(reader: Any, step: float | None = None) -> FilePrecision:
    """As `precision_of`, of the coordinates that a reader gives; of several files that of the coarsest."""
    parts = [precision_of_reader(part, step) for part in getattr(reader, "readers", ())]
    if parts:
        return replace(max(parts, key=lambda part: float(part.half_step([1.0]))), exact=False)
    name, path = format_of(reader) or "MEMORY", str(getattr(reader, "filename", None) or "")
    if not Path(path).is_file():
        return FilePrecision(name, step or 0.0)
    changed = bool(getattr(reader, "transformations", ()))
    if name == "MEMORY":
        # Read from a file at once; what was done to the coordinates since is not known.
        name, changed = format_named(path), True
    found = precision_of(path, name, step)
    # What a transformation did to the coordinates no longer lies on the grid of the file.
    return replace(found, exact=False) if changed else found


def described(precisions: Sequence[FilePrecision], largest: float) -> str:
    """Precision of frames in a sentence for a person; `largest` is the largest coordinate of a usual one."""
    usual, steps = precisions[0], {one.step for one in precisions}
    if len(steps) > 1:
        return f"{usual.format} stores coordinates in steps of {min(steps):.3g} to {max(steps):.3g} Å, by frame"
    if usual.step > 0:
        return f"{usual.format} stores coordinates in steps of {usual.step:.3g} Å ({usual.step / 10:.3g} nm)"
    step = f"{2 * float(usual.half_step([largest])):.1e} Å where coordinates reach {largest:.0f} Å"
    if usual.digits:
        return f"{usual.format} stores {usual.digits} digits of coordinates: steps of up to {step}"
    return f"{usual.format} stores coordinates in single precision: steps of {step}"


def by_frame(path: str | Path, offsets: Sequence[int], usual: FilePrecision) -> list[FilePrecision]:
    """Precision of each frame, by where it begins, of an XTC file, which may be put together from several."""
    with open(path, "rb") as file:
        found = [_xtc_precision(file, int(offset)) for offset in offsets]
    kinds = {steps: replace(usual, step=10.0 / steps, exact=True) if steps else usual for steps in set(found)}
    return [kinds[steps] for steps in found]


def _xtc_precision(file: BinaryIO, offset: int = 0) -> float:
    """Steps in a nanometer, from a frame; 1000 is usual. 0 for floats, as which up to 9 atoms are stored."""
    file.seek(offset)
    head = file.read(60)
    magic, n_atoms, precision = struct.unpack(">2i48xf", head) if len(head) == 60 else (0, 10, 0.0)
    if n_atoms <= 9:
        return 0.0
    return float(precision) if magic in XTC_MAGIC and 1 <= precision < 1e8 else 1000.0


def grid_of(coordinates: ArrayLike) -> float:
    """Step of the decimal grid that single precision numbers lie on, as after a conversion from XTC or text; or 0.

    Most must not lie on one ten times as coarse: rounded numbers end in any digit, those that a person wrote do not.
    """
    x = np.abs(np.asarray(coordinates, dtype=np.float64).ravel())
    x = x[x > 0]
    # Of integers of XTC through nanometers to angstrom, and of one format to the next: a rounding each.
    error = 8 * HALF_UNIT * np.ldexp(1.0, np.frexp(x)[1] - 1)
    for step in GRIDS:
        if (_off_grid(x, step) <= error).all():
            rounded = (_off_grid(x, 10 * step) > error).mean() > 0.5 if len(x) else False
            return step if rounded and np.log(2 * error / step).sum() < BY_CHANCE else 0.0
    return 0.0


def _off_grid(x: FloatArray, step: float) -> FloatArray:
    return np.asarray(np.abs(x - np.rint(x / step) * step))


def _words(file: BinaryIO) -> list[str]:
    return file.readline().decode("ascii", "replace").split()


def _of_dump(path: str | Path) -> FilePrecision:
    """Of a dump of LAMMPS, whose box MDAnalysis moves to the origin."""
    shift = scale = 0.0
    lines: list[list[str]] = []
    with anyopen(str(path), "rb") as file:
        while (words := _words(file)) and words[:2] != ["ITEM:", "ATOMS"]:
            if words[:2] == ["ITEM:", "BOX"]:
                bounds = [(float(low), float(high)) for low, high, *_ in (_words(file) for _ in range(3))]
                shift, scale = max(abs(low) for low, _ in bounds), max(high - low for low, high in bounds)
        while len(lines) < MOST_READ and (line := _words(file)) and line[0] != "ITEM:":
            lines.append(line)
    for ending in ("", "s", "u", "su"):  # in MDAnalysis' order
        columns = [words.index(axis + ending) - 2 for axis in "xyz" if axis + ending in words]
        if len(columns) == 3:
            break
    found = [line[k] for line in lines if len(line) > max(columns, default=0) for k in columns]
    return _of_words("LAMMPSDUMP", found, shift, scale if "s" in ending else 1.0)


def _of_words(name: str, words: Sequence[str], shift: float = 0.0, scale: float = 1.0) -> FilePrecision:
    """Precision of numbers as they are written: all with the same decimals, or with as many as they need."""
    decimals = {len(word.partition(".")[2]) for word in words}
    if len(decimals) == 1 and not any("e" in word.lower() for word in words):
        return FilePrecision(name, scale * 10.0 ** -decimals.pop())
    digits = [len(word.lower().partition("e")[0].replace(".", "").lstrip("+-0")) for word in words]
    return FilePrecision(name, digits=max(digits, default=0), shift=shift)
