"""Pictures of the pages that show what kcons does, computed by kcons: a function a picture."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import MDAnalysis
import numpy as np
from ase import Atoms
from ase.build import molecule
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from kcons.constraints import Distance
from kcons.mdanalysis import ConstraintCheck, TrajectoryWriter, constraints_of, from_ase
from kcons.models.flows import DampedOscillator, Pendulum, Stability, find_equilibria, phase_volume
from kcons.steppers import State

BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "#999999"


def flows() -> Figure:
    """Equilibria of the pendulum among its trajectories, and a disk that shrinks under friction."""
    drawn = Figure(figsize=(5.2, 6.6), layout="constrained")
    above, below = drawn.subplots(2, 1)
    x, v = np.meshgrid(np.linspace(-4.2, 4.2, 300), np.linspace(-2.6, 2.6, 200))
    levels = [-0.8, -0.3, 0.3, 1.0, 1.7, 2.5]
    above.contour(x, v, v**2 / 2 - np.cos(x), levels, colors=GRAY, linewidths=0.9, linestyles="solid")
    for point in find_equilibria(Pendulum(omega=1.0), box=[[-4.0, 4.0], [-2.0, 2.0]]):
        color = ORANGE if point.classification.stability is Stability.UNSTABLE else BLUE
        above.plot(*point.position, "o", color=color, markersize=8)
        words = str(point.classification).replace(" ", "\n")
        pale = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        above.text(point.position[0], 0.35, words, ha="center", va="bottom", color=color, fontsize=11, bbox=pale)
    above.set(title="pendulum: equilibria", xlabel="angle / rad", ylabel="angular velocity")

    flow, turn = DampedOscillator(1.0, 0.2), np.linspace(0, 2 * np.pi, 100)
    disk = np.array([4 + np.cos(turn), np.sin(turn)])
    below.plot(*flow.exact(np.linspace(0, 10, 300), [4.0, 0.0]).T, color=GRAY, linewidth=0.9)
    found = phase_volume(flow, [4.0, 0.0], times=[0.0, 5.0, 10.0])
    places = (5.2, 0.0), (1.2, 2.7), (-0.9, 0.6)
    for t, matrix, volume, place in zip(found.t, found.propagators, found.log_volume, places, strict=True):
        below.fill(*matrix @ disk, color=BLUE, alpha=0.7)
        below.text(*place, f"t = {t:g}\narea × {np.exp(volume):.2f}", fontsize=11, va="center")
    below.set(title="damped oscillator: phase-space volume", xlabel="x", ylabel="dx/dt", xlim=(-4, 8))
    return drawn


def held_by_name() -> Figure:
    """What each name holds in ethanol: bonds thick, angles as sectors."""
    atoms = molecule("CH3CH2OH")
    universe, _ = from_ase(atoms)
    view = atoms.copy()
    for angle, axis in ((30, "y"), (-15, "x")):
        view.rotate(angle, axis)
    x, depth = view.positions[:, :2], np.argsort(view.positions[:, 2])
    bonds = constraints_of(universe, "allbonds", guess_bonds=True)[0].atoms
    drawn = Figure(figsize=(5.2, 5.0), layout="constrained")
    for axes, name in zip(drawn.subplots(2, 2).ravel(), ("hbonds", "allbonds", "hangles", "allangles"), strict=True):
        rows = {type(c).__name__: c.atoms for c in constraints_of(universe, name, guess_bonds=True)}
        for i, j, k in rows.get("Angle", []):
            corners = [x[j], x[j] + 0.55 * (x[i] - x[j]), x[j] + 0.55 * (x[k] - x[j])]
            axes.add_patch(Polygon(corners, color=ORANGE, alpha=0.4, linewidth=0))
        held = {tuple(sorted(pair)) for pair in rows["Distance"].tolist()}
        for pair in bonds.tolist():
            color, width = (BLUE, 4) if tuple(sorted(pair)) in held else (GRAY, 1.5)
            axes.plot(*x[pair].T, color=color, linewidth=width, zorder=2)
        for k in depth:
            axes.text(*x[k], atoms.symbols[k], ha="center", va="center", fontsize=9, zorder=3,
                      bbox={"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": "black"})  # fmt: skip
        told = f"{len(held)} bonds" + (f", {len(rows['Angle'])} angles" if "Angle" in rows else "")
        axes.set_title(f"{name}\n{told}", fontsize=11)
        axes.set(xlim=(x[:, 0].min() - 0.35, x[:, 0].max() + 0.35), aspect="equal")
        axes.set_ylim(x[:, 1].min() - 0.35, x[:, 1].max() + 0.35)
        axes.axis("off")
    return drawn


def rounding_in_files() -> Figure:
    """Deviations of exactly rigid water that files of several formats show, and the bound on them."""
    rng, n = np.random.default_rng(1), 1000
    shape = np.array([[0.0, 0.0, 0.0], [0.7570, 0.5859, 0.0], [-0.7570, 0.5859, 0.0]])
    pairs = (3 * np.arange(n)[:, None, None] + [[0, 1], [0, 2], [1, 2]]).reshape(-1, 2)
    turns, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    x = (rng.random((n, 1, 3)) * 98 + shape @ turns).reshape(-1, 3)
    lengths = np.linalg.norm(x[pairs[:3, 0]] - x[pairs[:3, 1]], axis=1)
    found = {}
    # No names of residues and no cell in the file.
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(action="ignore"):
        Atoms("OHH" * n, x).write(f"{folder}/top.xyz")
        for ending in ("gro", "xtc", "pdb", "trr", "dcd"):
            path = Path(folder) / f"run.{ending}"
            if ending in ("gro", "pdb"):
                MDAnalysis.Universe(f"{folder}/top.xyz").atoms.write(str(path))
            else:
                with TrajectoryWriter(path, 3 * n, interval=1.0) as writer:
                    writer(State(x, np.zeros_like(x)))
            universe = MDAnalysis.Universe(f"{folder}/top.xyz", str(path))
            check = ConstraintCheck(universe, Distance(pairs, np.tile(lengths, n)), rank=False).run().check
            assert check.status == "kept"
            found[ending.upper()] = check.units[0]
    drawn = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = drawn.subplots()
    for k, unit in enumerate(found.values()):
        axes.barh(k, unit.bound, left=1e-7, color="#cfe3f1", height=0.7, label=None if k else "bound for rounding")
        axes.plot(unit.largest, k, "o", color=BLUE, markersize=8, label=None if k else "largest deviation found")
    axes.axvline(1e-4, color=ORANGE, linewidth=1.5, label="default tolerance (1 Å)")
    axes.set_yticks(range(len(found)), list(found), fontsize=11)
    axes.set(xscale="log", xlim=(1e-6, 0.1), ylim=(len(found) - 0.5, -0.5))
    axes.set_xlabel("deviation / Å, water that is exactly rigid")
    axes.legend(loc="lower right", fontsize=10)
    return drawn


#: By the name of the file, without its ending.
PICTURES: Mapping[str, Callable[[], Figure]] = {
    made.__name__.replace("_", "-"): made for made in (flows, held_by_name, rounding_in_files)
}
