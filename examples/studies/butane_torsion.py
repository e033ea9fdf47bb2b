"""The torsion of butane with GFN2-xTB at 300 K, from an input file, beside its relaxed scan.

python examples/studies/butane_torsion.py           four short windows, to see how it goes
python examples/studies/butane_torsion.py --full    the profile, into docs: some ten minutes on two cores
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from ase.build import molecule
from ase.io import write

from kcons.comparison import environment, json_files
from kcons.constraints import Dihedral
from kcons.free_energy import Windows, read_input, scan

DOCS = Path(__file__).parents[2] / "docs"
CARBONS = [0, 1, 2, 3]
INPUT = """
[structure]
file = "butane.xyz"

[forces]
calculator = "gfn2"

[[coordinate]]
name = "torsion"
dihedral = [{atoms}]
from = -180
to = {to}
windows = {windows}

[held]
constrain = "hbonds"

[sampling]
temperature = 300
timestep = 2.0
friction = 5.0
relax = {relax}
pull = {pull}
equilibration = {equilibration}
production = {production}
every = 5
"""


def input_in(folder: Path, full: bool) -> Path:
    """butane.xyz and butane.toml."""
    atoms = molecule("trans-butane")
    carbons = [a.index for a in atoms if a.symbol == "C"]
    ends = [i for i in carbons if sum(atoms.get_distance(i, j) < 1.7 for j in carbons if j != i) == 1]
    inner = {i: next(j for j in carbons if j not in ends and atoms.get_distance(i, j) < 1.7) for i in ends}
    chain = [ends[0], inner[ends[0]], inner[ends[1]], ends[1]]
    near = atoms.get_all_distances() < np.where((atoms.numbers[:, None] + atoms.numbers) > 7, 1.7, 1.25)
    atoms.info["bonds"] = np.argwhere(np.triu(near, 1))  # the file keeps them; otherwise they are guessed
    write(folder / "butane.xyz", atoms)
    numbers = {"to": 0, "windows": 10, "relax": 30, "pull": 300, "equilibration": 500, "production": 9000}
    if not full:
        numbers |= {"windows": 4, "relax": 0, "pull": 5, "equilibration": 5, "production": 160}
    text = INPUT.format(atoms=", ".join(map(str, chain)), **numbers)
    (folder / "butane.toml").write_text(text)
    CARBONS[:] = chain
    return folder / "butane.toml"


def main(full: bool) -> None:
    folder = Path("butane") if full else Path(tempfile.mkdtemp())
    folder.mkdir(exist_ok=True)
    given = read_input(input_in(folder, full))
    how = {"workers": 2 if full else 1, "progress": lambda *n: print(*n, flush=True)}
    windows = Windows(given.sampler, folder / "windows", given.settings, both_sides=full, **how)
    found = windows.run(given.targets)
    for window in found.windows:
        degrees = np.degrees(window.value[0])
        print(f"{degrees:7.1f} {window.force[0]:8.2f} +- {window.error[0]:.2f} kJ/mol/rad, raw {window.raw[0]:.2f}")
    if not full:
        return
    sampler = given.sampler
    atoms = sampler.atoms.copy()
    atoms.calc = sampler.calculator()
    relaxed = scan(atoms, [Dihedral([CARBONS])], [np.radians(np.arange(-180, 1, 15))])
    energies = relaxed.energies.ravel() * 96.485
    # Symmetric about 0 and 180 degrees: the mean force vanishes there.
    profile = found.profile
    low = int(np.argmin(profile.F))
    points = {name: profile.difference(-np.pi, np.radians(at)) for name, at in PLACES.items()}
    numbers = {
        "windows": len(found.windows),
        "steps": given.settings.production * 2,
        "free energy": {name: [each.value, each.error] for name, each in points.items()},
        "relaxed scan": {name: float(energies[round((at + 180) / 15)] - energies[0]) for name, at in PLACES.items()},
        "hysteresis": [w.hysteresis for w in found.windows],
        "lowest": float(np.degrees(profile.x[low])),
    }
    json_files.write(DOCS / "results" / "butane.json", numbers | {"machine": environment()})
    _draw(profile, energies - energies[0])
    print(json_files.text(numbers))


PLACES = {"barrier": -120.0, "gauche": -60.0, "cis": 0.0}


def _draw(profile: object, energies: np.ndarray) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    x, start = np.degrees(profile.x), float(np.interp(-np.pi, profile.x, profile.F))
    axes.plot(x, profile.F - start, label="free energy, 300 K")
    axes.fill_between(x, profile.F - start - 2 * profile.error, profile.F - start + 2 * profile.error, alpha=0.25)
    axes.plot(np.arange(-180, 1, 15), energies, "o", ms=4, label="relaxed energy")
    axes.set(xlabel="torsion C-C-C-C (degrees)", ylabel="kJ/mol", title="butane, GFN2-xTB")
    axes.legend()
    figure.savefig(DOCS / "figures" / "butane_torsion.png", dpi=150)


if __name__ == "__main__":
    main("--full" in sys.argv)
