"""Compiling in a process of its own, so that its memory does not add to that of a check.

A check of a large system needs little more memory than the program itself; compiling its kernels, once on a machine,
takes 50 MB and more, which LLVM and numba never give back. Where a kernel is in no cache yet, a short process compiles
it on a small sample of the same rows and leaves it in numba's cache, where this process then finds it.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numba
import numpy as np
import scipy.sparse as sp
from numba.core import event
from numpy.typing import NDArray

from kcons.constraints.compilation import all_compiled
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import KconsError
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import Block
from kcons.mdanalysis.check.frames.deviations import Deviations
from kcons.mdanalysis.check.frames.frame_kernels import coordinate_grid, kinetic
from kcons.mdanalysis.check.frames.row_table import RowTable
from kcons.mdanalysis.check.rank_by_pieces import PIECE, rank_of

#: Clusters of each kind in a sample: compiled code takes four at once, solvers up to eight.
OF_A_KIND = 8
#: What the other process runs.
COMMAND = "from kcons.mdanalysis.check.compiling import main; main()"

T = TypeVar("T")


@dataclass
class Frame:
    """One frame, as the loops over frames meet it.

    Attributes
    ----------
    x : ndarray of float32, shape (3 n_atoms,)
        Positions in angstrom.
    v : ndarray of float32, shape (3 n_atoms,), or None
    dimensions : ndarray, shape (6,), or None
        The cell.
    time : float
    in_blocks : bool
        Whether the file can be read by `kcons.mdanalysis.check.files.plain_dcd`.
    """

    x: NDArray[np.float32]
    v: NDArray[np.float32] | None
    dimensions: NDArray[np.float32] | None
    time: float
    in_blocks: bool

    def of(self, atoms: IntArray) -> Frame:
        """Some of the atoms."""
        x = self.x.reshape(-1, 3)[atoms].ravel()
        return Frame(x, None if self.v is None else np.zeros_like(x), self.dimensions, self.time, self.in_blocks)


def frame_of(ts: Any, time: float, in_blocks: bool) -> Frame:
    """The frame that a reader has just read.

    Parameters
    ----------
    ts : MDAnalysis.coordinates.timestep.Timestep
    time : float
    in_blocks : bool
        See `Frame`.
    """
    x = np.array(ts.positions, dtype=np.float32).ravel()
    v = np.array(ts.velocities, dtype=np.float32).ravel() if ts.has_velocities else None
    return Frame(x, v, ts.dimensions, time, in_blocks)


def look_once(table: RowTable, frame: Frame) -> None:
    """Look at one frame in the way of the loops, and forget what was found."""
    table = table.fresh()
    found = Deviations(table.set.n_rows, 1)
    if frame.in_blocks and table.only_lengths:
        points = frame.x.reshape(-1, 3)
        words = np.zeros((1, 3 * (len(points) + 2)), dtype=np.int32)
        words[0].view(np.float32).reshape(3, -1)[:, 1:-1] = points.T
        cell = np.zeros((1, 6), dtype=np.float32)
        if frame.dimensions is not None:
            cell[0] = frame.dimensions
        table.look_at_block(found, 0, Block(words, 0, cell), np.empty_like(points), (1, 1))
    else:
        # A frame that cannot be looked at is for the loops to report.
        with suppress(KconsError), np.errstate(all="ignore"):
            table.look(found, 0, frame.x, frame.v, frame.dimensions, frame.time)
    if frame.v is not None:
        kinetic(frame.v, table.set.masses)


@dataclass
class Sample:
    """What takes the same kernels, with the same types of arguments, as a large check.

    Attributes
    ----------
    constraint_set : ConstraintSet
        Some of its rows.
    frame : Frame
        Their atoms.
    precision : FilePrecision
        Of the file.
    rank : bool
        Whether the rank is asked for.
    """

    constraint_set: ConstraintSet
    frame: Frame
    precision: FilePrecision
    rank: bool

    def use(self) -> None:
        """Compile, or load, all kernels."""
        x = coordinate_grid(self.frame.x.reshape(-1, 3), self.precision.grid)
        look_once(RowTable(self.constraint_set, self.precision), self.frame)
        if self.rank:
            # The check says so of its own rows.
            with suppress(KconsError):
                rank_of(self.constraint_set, x)


def sample_of(constraint_set: ConstraintSet, frame: Frame, precision: FilePrecision, rank: bool) -> Sample:
    """A few clusters of each kind: equal numbers of rows, of atoms, and of rows of each sort.

    Parameters
    ----------
    constraint_set : ConstraintSet
    frame : Frame
        Of all atoms of the set.
    precision : FilePrecision
        Of the file.
    rank : bool
        Whether the rank is asked for.
    """
    incidence = constraint_set.incidence
    graph = sp.block_array([[None, incidence], [incidence.T, None]], format="csr")
    n_clusters, labels = sp.csgraph.connected_components(graph, directed=False)
    of_rows, of_atoms = labels[: constraint_set.n_rows], labels[constraint_set.n_rows :]
    families = sorted({item.family for item in constraint_set.constraints})
    sort = np.concatenate([np.full(c.n_rows, families.index(c.family)) for c in constraint_set.constraints])
    counts = [np.bincount(of_rows[sort == k], minlength=n_clusters) for k in range(len(families))]
    counts.append(np.bincount(of_atoms, minlength=n_clusters))
    # Atoms without rows are clusters, too.
    clusters = np.unique(of_rows)
    _, kind = np.unique(np.stack(counts)[:, clusters], axis=1, return_inverse=True)
    kind = kind.ravel()
    order = np.argsort(kind, kind="stable")
    begins = np.searchsorted(kind[order], kind[order])
    chosen = clusters[order[np.arange(len(order)) - begins < OF_A_KIND]]
    rows = np.flatnonzero(np.isin(of_rows, chosen))[:PIECE]
    part, atoms = constraint_set.subset(rows)
    return Sample(part, frame.of(atoms), precision, rank)


class _Cold(BaseException):
    """A kernel would be compiled. Not an Exception, which code on the way might handle."""


class _Refusal(event.Listener):  # type: ignore[misc]
    """Stops this thread where it begins to compile a kernel of kcons: these are cached, others need not be."""

    def __init__(self) -> None:
        self._thread = threading.get_ident()

    def on_start(self, event: Any) -> None:
        module = str(event.data["dispatcher"].py_func.__module__)
        if threading.get_ident() == self._thread and module.partition(".")[0] == "kcons":
            raise _Cold

    def on_end(self, event: Any) -> None:
        pass


def compiled_elsewhere(sample: Callable[[], Sample], task: Callable[[], T]) -> T:
    """Do a task that may be begun twice; where a kernel is in no cache, have `sample` used by another process first.

    Where that process fails, or cannot be had, this one compiles.
    """
    try:
        with event.install_listener("numba:compile", _Refusal()):
            return task()
    except _Cold:
        pass
    _use_elsewhere(sample())
    return task()


def _use_elsewhere(sample: Sample) -> bool:
    """Whether another process could use the sample."""
    if not sys.executable or getattr(sys, "frozen", False):
        return False
    paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
    environment = os.environ | {"PYTHONPATH": paths}
    if folder := getattr(numba.config, "CACHE_DIR", ""):
        environment["NUMBA_CACHE_DIR"] = str(folder)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", COMMAND], input=pickle.dumps(sample), capture_output=True, env=environment
        )
    except (OSError, pickle.PicklingError, AttributeError, TypeError):
        # Functions of one's own need not be what pickle can send.
        return False
    return done.returncode == 0


def main() -> None:
    """Use the sample that comes in."""
    sample: Sample = pickle.load(sys.stdin.buffer)
    with all_compiled():
        sample.use()
