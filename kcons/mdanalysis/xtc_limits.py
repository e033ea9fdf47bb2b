"""Coordinates that XTC cannot hold: the library that writes it packs something else, and goes on."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from MDAnalysis.lib.formats.libmdaxdr import XTCFile

from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Steps from the origin that an integer counts; range of steps from which on some frames are packed wrongly, by what
#: lies between neighbouring atoms; atoms up to which there is no packing.
_MOST, _SAFE, _FLOATS = 2**31 - 3, 2**23, 9


def refuse_beyond_xtc(x: FloatArray, decimals: int, name: str) -> None:
    """Refuse coordinates that would not be read as they are.

    Parameters
    ----------
    x : ndarray, shape (n_atoms, 3)
        In angstrom.
    decimals : int
        Of nanometres, as MDAnalysis' writer takes them.
    name : str
        Of the file.

    Raises
    ------
    InputError
    """
    if len(x) <= _FLOATS:
        return
    in_nm = x / 10
    steps, spread = (float(reach.max()) * 10.0**decimals for reach in (np.abs(in_nm), np.ptp(in_nm, axis=0)))
    if max(steps, spread) > _MOST or (spread >= _SAFE and not _read_as_written(in_nm, decimals)):
        raise InputError(
            f"{name} cannot hold coordinates up to {np.abs(x).max():.4g} angstrom in steps of "
            f"{10.0 ** (1 - decimals):g}: nothing was written; give a smaller precision, or another format",
            item="positions",
        )


def _read_as_written(in_nm: FloatArray, decimals: int) -> bool:
    single = in_nm.astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        place = str(Path(folder) / "frame.xtc")
        with XTCFile(place, "w") as file:
            file.write(single, np.eye(3, dtype=np.float32), 0, 0.0, 10.0**decimals)
        with XTCFile(place) as file:
            found = file.read().x
    rounding = 10.0**-decimals + 4 * np.spacing(np.abs(single).max())
    return bool((np.abs(found - single) <= rounding).all())
