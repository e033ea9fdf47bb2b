"""Free energies of four kinds of coordinates: a ring that puckers, two torsions, two ions in water, the axis of a pore.

python examples/studies/more_free_energies.py                 one short window of each but the ions, to see how it goes
python examples/studies/more_free_energies.py ions            one short window of these
python examples/studies/more_free_energies.py --full FOLDER   profiles (some ten minutes), pictures and numbers
python examples/studies/more_free_energies.py --full FOLDER pore ions   only these
"""

from __future__ import annotations

import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes

from kcons.ase import constraints_of
from kcons.comparison import environment, json_files
from kcons.constraints import Dihedral, Distance, Plane
from kcons.free_energy import (
    AseWindows,
    FreeEnergy,
    OpenMMWindows,
    Settings,
    Windows,
    plot_profile,
    plot_surface,
)

DOCS = Path(__file__).parents[2] / "docs"
KT = 0.00831446261815324 * 300.0  # kJ/mol


def sampled(
    sampler: object, places: object, folder: Path, settings: Settings, full: bool, both_sides: bool = True
) -> FreeEnergy:
    here = None if full else ThreadPoolExecutor(1)  # one window is not worth another process
    how = {"executor": here, "workers": 1, "progress": lambda *n: print(folder.name, *n, flush=True)}
    found = Windows(sampler, folder, settings, both_sides=full and both_sides, **how).run(places)
    if found.failed:
        raise SystemExit(f"{found.failed}; run it again to try these once more")
    return found


def about(found: FreeEnergy) -> dict[str, object]:
    """What the page says of the windows."""
    chances = [w.hysteresis for w in found.windows if np.isfinite(w.hysteresis)]
    return {
        "windows": len(found.windows),
        "seconds": sum(w.seconds for w in found.windows),
        "least probability of both sides": min(chances) if chances else None,
    }


def short(full: bool, **settings: object) -> Settings:
    return Settings(
        **(settings if full else settings | {"relax": 20, "pull": 20, "equilibration": 2, "production": 64, "every": 2})
    )


def pictured(figure: object, name: str) -> None:
    figure.savefig(DOCS / "figures" / f"free_energy_{name}.png", dpi=120)


# -- a ring that puckers: cyclobutane with GFN2-xTB in ASE -------------------------------------------------


def gfn2() -> Calculator:
    from tblite.ase import TBLite

    return TBLite(method="GFN2-xTB", verbosity=0)


def pucker(folder: Path, full: bool) -> dict[str, object]:
    """The torsion of the four carbons, from flat to beyond both minima, which are images of each other."""
    atoms = molecule("cyclobutane")
    near = atoms.get_all_distances() < np.where((atoms.numbers[:, None] + atoms.numbers) > 7, 1.7, 1.25)
    atoms.info["bonds"] = np.argwhere(np.triu(near, 1))
    carbons = np.flatnonzero(atoms.numbers == 6)
    middle = atoms.positions[carbons].mean(axis=0)
    u, v = np.linalg.svd(atoms.positions[carbons] - middle)[2][:2]
    ring = carbons[np.argsort([np.arctan2((x - middle) @ v, (x - middle) @ u) for x in atoms.positions[carbons]])]
    sampler = AseWindows(atoms, gfn2, {"pucker": Dihedral([ring])}, constraints_of(atoms, "hbonds"))
    settings = short(full, timestep=2.0, relax=30, pull=100, equilibration=300, production=1500, every=5)
    found = sampled(sampler, np.radians(np.linspace(0, 30, 6) if full else [15.0]), folder / "pucker", settings, full)
    if not full:
        return {}
    profile = found.profile
    pictured(plot_profile(profile, coordinate="torsion of the ring / rad", energy="kJ/mol"), "pucker")
    low = profile.x[np.argmin(profile.F)]
    flat, bent = (profile.difference(low, np.radians(at)) for at in (0.0, 30.0))
    return {
        "lowest, degrees": float(np.degrees(low)),
        "barrier": flat.value,
        "error": flat.error,
        "at 30 degrees": [bent.value, bent.error],
        **about(found),
    }


# -- two coordinates: phi and psi of alanine dipeptide with amber14 in OpenMM ---------------------------------


PHI, PSI = np.radians(np.linspace(-160, -60, 6)), np.radians(np.linspace(40, 165, 6))


def torsions(folder: Path, full: bool) -> dict[str, object]:
    """The free energy where both minima of the extended half are, and the way from one to the other."""
    from openmm import app

    pdb = app.PDBFile(str(DOCS.parent / "tests" / "data" / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(pdb.topology, constraints=app.HBonds, removeCMMotion=False)
    held = {"phi": Dihedral([[4, 6, 8, 14]]), "psi": Dihedral([[6, 8, 14, 16]])}
    sampler = OpenMMWindows(pdb.topology, system, pdb.positions, held, platform="Reference")
    settings = short(full, timestep=2.0, pull=500, equilibration=500, production=3000, every=20)
    grid = [(a, b) for a in PHI for b in PSI] if full else [(-1.2, 1.2)]
    found = sampled(sampler, np.array(grid), folder / "torsions", settings, full, both_sides=False)
    if not full:
        return {}
    surface = found.surface
    pictured(plot_surface(surface, coordinates=("phi / rad", "psi / rad"), energy="kJ/mol"), "torsions")
    inside = [m.x for m in surface.minima() if PHI[0] <= m.x[0] <= PHI[-1] and PSI[0] <= m.x[1] <= PSI[-1]]
    minima = []
    for x in inside:
        over = surface.difference(inside[0], x)
        minima.append({"at, degrees": np.degrees(x).tolist(), "F": over.value, "error": over.error})
    return {"minima": minima, "consistency": surface.consistency.p_value, **about(found)}


# -- two ions in water along their distance, amber14 in OpenMM ---------------------------------------------------


def ions(folder: Path, full: bool) -> dict[str, object]:
    """Na+ and Cl- in a box of TIP3P water of 1.9 nm, from contact to half of the box."""
    from openmm import Vec3, app, unit

    topology = app.Topology()
    residues = topology.addChain()
    for name, element in (("NA", app.element.sodium), ("CL", app.element.chlorine)):
        topology.addAtom(name, element, topology.addResidue(name, residues))
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    box = app.Modeller(topology, [Vec3(0.8, 0.95, 0.95), Vec3(1.1, 0.95, 0.95)] * unit.nanometer)
    box.addSolvent(field, boxSize=Vec3(1.9, 1.9, 1.9) * unit.nanometer, neutralize=False)
    system = field.createSystem(box.topology, app.PME, 0.9 * unit.nanometer, constraints=app.HBonds)
    sampler = OpenMMWindows(
        box.topology, system, box.positions, {"r": Distance([[0, 1]])}, platform="CPU", properties={"Threads": "1"}
    )
    settings = short(full, timestep=2.0, relax=100, pull=500, equilibration=2500, production=10_000, every=10)
    places = np.array([2.4, 2.6, 2.8, 3.1, 3.5, 3.9, 4.5, 5.2])  # angstrom
    found = sampled(sampler, places if full else places[3:4], folder / "ions", settings, full)
    if not full:
        return {}
    profile = found.profile.without_jacobian("distance", thermal_energy=KT)
    pictured(plot_profile(profile, coordinate="r / angstrom", energy="kJ/mol", title="without the Jacobian"), "ions")
    near, far = profile.x < 3.3, profile.x > 4.0
    contact = profile.x[near][np.argmin(profile.F[near])]
    apart = profile.x[far][np.argmin(profile.F[far])]
    top = profile.x[(profile.x > contact) & (profile.x < apart)]
    barrier = top[np.argmax(np.interp(top, profile.x, profile.F))]
    over = {name: profile.difference(contact, at) for name, at in (("barrier", barrier), ("apart", apart))}
    return (
        {"contact": float(contact), "barrier at": float(barrier), "apart at": float(apart)}
        | {name: [each.value, each.error] for name, each in over.items()}
        | about(found)
    )


# -- the axis of a pore, with walls that know a closed form ----------------------------------------------------


class Pore(Calculator):
    """A pore along z, narrow in the middle: outside of the radius R(z) a spring pulls back, k (rho - R)^2/2."""

    implemented_properties = ("energy", "forces")
    k, wide, narrow, width = 0.5, 4.0, 1.0, 3.0  # eV/angstrom^2, angstrom

    def radius(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bell = (self.wide - self.narrow) * np.exp(-((z / self.width) ** 2))
        return self.wide - bell, 2 * z / self.width**2 * bell

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes) -> None:  # type: ignore[no-untyped-def]
        super().calculate(atoms, properties, system_changes)
        x = self.atoms.positions
        rho = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-12)
        radius, slope = self.radius(x[:, 2])
        out = np.maximum(rho - radius, 0.0)
        across = -self.k * out[:, None] * x[:, :2] / rho[:, None]
        forces = np.column_stack([across, self.k * out * slope])
        self.results = {"energy": float(self.k / 2 * (out**2).sum()), "forces": forces}

    def known(self, z: np.ndarray) -> np.ndarray:
        """-kT ln of the integral of exp(-U/kT) across the pore, kJ/mol."""
        kT, radius = 300 * units.kB, self.radius(z)[0][:, None]
        rho = np.linspace(0, 8, 8001)
        inside = rho * np.exp(-self.k / 2 * np.maximum(rho - radius, 0) ** 2 / kT)
        return -KT * np.log(inside.sum(axis=1))


def pore(folder: Path, full: bool) -> dict[str, object]:
    """An argon atom that is pulled through: entropy alone makes the barrier."""
    atoms = Atoms("Ar", [[0.3, 0.2, -4.0]])
    sampler = AseWindows(atoms, Pore, {"z": Plane([0], [0, 0, 1])})
    settings = short(full, timestep=10.0, friction=2.0, pull=200, equilibration=300, production=8000, every=10)
    found = sampled(
        sampler, np.append(np.linspace(-6, -0.75, 8), 0.3) if full else [-1.0], folder / "pore", settings, full
    )
    if not full:
        return {}
    profile = found.profile
    pictured(plot_profile(profile, coordinate="z / angstrom", energy="kJ/mol"), "pore")
    barrier = profile.difference(-6.0, 0.0)
    known = Pore().known(np.array([-6.0, 0.0]))
    quadrature = float(known[1] - known[0])
    return {"barrier": barrier.value, "error": barrier.error, "by quadrature": quadrature, **about(found)}


STUDIES = {"pucker": pucker, "torsions": torsions, "ions": ions, "pore": pore}


def main(arguments: list[str]) -> None:
    full = bool(arguments) and arguments[0] == "--full"
    folder = Path(arguments[1]) if full else Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    result = DOCS / "results" / "more_free_energies.json"
    for name in arguments[2 if full else 0 :] or (STUDIES if full else ["pucker", "torsions", "pore"]):
        found = STUDIES[name](folder, full)
        if full:
            known, machine = json_files.read(result) if result.exists() else {}, environment()
            of = {key: machine[key] for key in ("commit", "date")}
            json_files.write(result, known | {name: found | of, "machine": machine})
            print(name, {key: value for key, value in found.items() if not isinstance(value, list) or len(value) < 5})


if __name__ == "__main__":
    main(sys.argv[1:])
