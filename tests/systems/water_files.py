"""Files of rigid water, made by hand, and readers that share nothing with kcons."""

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

mda = pytest.importorskip("MDAnalysis")

OH, ANGLE = 0.9572, np.radians(104.52)
HH = 2 * OH * np.sin(ANGLE / 2)


def water(n: int, frames: int, side: float = 12.0, seed: int = 0) -> np.ndarray:
    """Rigid water that tumbles through a cell, atoms wrapped one by one, shape (frames, 3 n, 3)."""
    rng = np.random.default_rng(seed)
    half = ANGLE / 2
    shape = OH * np.array([[0.0, 0, 0], [np.sin(half), np.cos(half), 0], [-np.sin(half), np.cos(half), 0]])
    x = np.zeros((frames, n, 3, 3))
    centers = rng.random((n, 1, 3)) * side
    for k in range(frames):
        turns, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
        centers = centers + 0.3 * rng.normal(size=centers.shape)
        x[k] = centers + shape @ turns
    return x.reshape(frames, 3 * n, 3) % side


def whole(x: np.ndarray, side: float = 12.0) -> np.ndarray:
    """Molecules made whole."""
    y = x.reshape(len(x), -1, 3, 3)
    d = y - y[:, :, :1]
    return (y - side * np.rint(d / side)).reshape(x.shape)


def pairs(n: int) -> np.ndarray:
    o = 3 * np.arange(n)
    return np.stack([o, o + 1, o, o + 2, o + 1, o + 2], axis=1).reshape(-1, 2)


def targets(n: int) -> np.ndarray:
    return np.tile([OH, OH, HH], n)


def universe(n: int, masses: bool = True):
    made = mda.Universe.empty(
        3 * n,
        n_residues=n,
        atom_resindex=np.repeat(np.arange(n), 3),
        residue_segindex=np.zeros(n, int),
        trajectory=True,
    )
    made.add_TopologyAttr("names", ["OW", "HW1", "HW2"] * n)
    made.add_TopologyAttr("elements", ["O", "H", "H"] * n)
    made.add_TopologyAttr("resnames", ["SOL"] * n)
    made.add_TopologyAttr("resids", np.arange(1, n + 1))
    if masses:
        made.add_TopologyAttr("masses", [15.999, 1.008, 1.008] * n)
    return made


def loaded(path, n: int, masses: bool = True):
    """The universe with a trajectory."""
    from kcons.mdanalysis import load_trajectory

    made = universe(n, masses)
    load_trajectory(made, path)
    return made


def checked(path, n: int, constraints=None, *, run=None, masses: bool = True, **options):
    """The result of a check of all distances of all molecules, or of other rows."""
    from kcons.constraints import Distance
    from kcons.mdanalysis import ConstraintCheck

    rows = Distance(pairs(n), targets(n)) if constraints is None else constraints
    return ConstraintCheck(loaded(path, n, masses), rows, **options).run(**(run or {})).check


def write(
    path: Path, x: np.ndarray, side: float | list | None = 12.0, velocities: np.ndarray | None = None, **options
) -> Path:
    """A trajectory of MDAnalysis' own writers or as programs write text, 2 ps between frames, of one cell or many."""
    if path.suffix in (".mdcrd", ".arc", ".lammpsdump"):
        return write_text(path, x)
    n = x.shape[1]
    cells = side if isinstance(side, list) else [side and [side, side, side, 90, 90, 90]] * len(x)
    made = mda.Universe.empty(n, trajectory=True, velocities=velocities is not None)
    if path.suffix == ".dcd":
        options.setdefault("dt", 2.0)
    if path.suffix == ".pdb":
        options.setdefault("multiframe", True)
    with warnings.catch_warnings(action="ignore"), mda.Writer(str(path), n, **options) as writer:
        for k, positions in enumerate(x):
            ts = made.trajectory.ts
            ts.positions = positions
            if velocities is not None:
                ts.velocities = velocities[k]
            ts.dimensions = cells[k]
            ts.time, ts.frame, ts.dt = 2.0 * k, k, 2.0
            writer.write(made.atoms)
    return path


def write_text(path: Path, x: np.ndarray, number="{:.6f}".format, columns="x y z", low=0.0, side=12.0) -> Path:
    """XYZ, a dump of LAMMPS, coordinates of AMBER, or an archive of Tinker, as programs write them.

    Numbers of XYZ and LAMMPS are written by `number`; scaled columns are parts of the box.
    """
    lines = ["title"] if path.suffix == ".mdcrd" else []
    for k, positions in enumerate(x):
        n = len(positions)
        if path.suffix == ".mdcrd":
            words = [f"{value:8.3f}" for value in positions.ravel()]
            lines += ["".join(words[i : i + 10]) for i in range(0, len(words), 10)]
        elif path.suffix == ".arc":
            lines.append(f"{n} water")
            lines += [
                f"{a + 1:6d}  {'OHH'[a % 3]}  {r[0]:.6f} {r[1]:.6f} {r[2]:.6f}  1 " for a, r in enumerate(positions)
            ]
        elif path.suffix == ".xyz":
            rows = (" ".join(number(float(value)) for value in r) for r in positions)
            lines += [str(n), "frame", *(f"{'OHH'[a % 3]} {row}" for a, row in enumerate(rows))]
        else:
            numbers = positions / side if "s" in columns else positions + low
            lines += ["ITEM: TIMESTEP", str(k), "ITEM: NUMBER OF ATOMS", str(n), "ITEM: BOX BOUNDS pp pp pp"]
            lines += [f"{low:g} {low + side:g}"] * 3 + [f"ITEM: ATOMS id type {columns}"]
            lines += [f"{a + 1} 1 " + " ".join(number(float(value)) for value in r) for a, r in enumerate(numbers)]
    path.write_text("\n".join(lines) + "\n")
    return path


def inpcrd(x: np.ndarray) -> str:
    """One frame as AMBER writes it in text."""
    words = [f"{value:12.7f}" for value in x.ravel()]
    return "\n".join(["water", str(len(x)), *("".join(words[k : k + 6]) for k in range(0, len(words), 6)), ""])


def topology(path: Path, n: int, positions: np.ndarray, side: float = 12.0) -> Path:
    """A PDB or GRO file of the same atoms."""
    made = universe(n)
    made.atoms.positions = positions
    made.dimensions = [side, side, side, 90, 90, 90]
    with warnings.catch_warnings(action="ignore"):
        made.atoms.write(str(path))
    return path


def dcd_frames(path: Path) -> np.ndarray:
    """Positions in angstrom, straight from the bytes."""
    data = path.read_bytes()
    place, records = 0, []
    while place < len(data):
        (length,) = struct.unpack_from("<i", data, place)
        records.append(data[place + 4 : place + 4 + length])
        assert struct.unpack_from("<i", data, place + 4 + length)[0] == length
        place += length + 8
    (n,) = struct.unpack("<i", records[2])
    columns = [np.frombuffer(r, "<f4").astype(np.float64) for r in records[3:] if len(r) == 4 * n]
    return np.stack(columns).reshape(-1, 3, n).transpose(0, 2, 1)


def xtc_frames(path: Path) -> np.ndarray:
    """Positions in nm, by the library of GROMACS alone; they are multiples of 0.001 nm."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    with XTCFile(str(path)) as file:
        return np.stack([np.rint(frame.x.astype(np.float64) * 1000) / 1000 for frame in file])


def deviations(x: np.ndarray, table: np.ndarray, held: np.ndarray, side: float) -> np.ndarray:
    """|r_i - r_j| - target with nearest images, shape (frames, rows)."""
    d = x[:, table[:, 0]] - x[:, table[:, 1]]
    d -= side * np.rint(d / side)
    return np.sqrt((d**2).sum(axis=2)) - held
