"""Averages without any error of the time step: Hamiltonian Monte Carlo on constraints.

    python hamiltonian_monte_carlo.py                        three masses, some seconds
    python hamiltonian_monte_carlo.py --full PART --out F    one part, added to the JSON in F; PART is
                                                                         small, water, precision, dhfr, judge or chain
    python hamiltonian_monte_carlo.py --show F               the tables of an earlier result

small: distributions beside quadrature and Metropolis. water: 512 rigid TIP3P waters with PME in OpenMM. precision: what
platforms do to the energy. dhfr: a protein in water. judge: the package physical_validation on 27 rigid waters in ASE.
chain: 100 and 1000 bonds beside the package mici, by processor time (`python -m pip install mici`).
"""

from __future__ import annotations

import argparse
import json
import lzma
import math
import time
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2, ks_2samp, kstest

import kcons
from kcons import ConstraintSet, Motion, State, System, run
from kcons.comparison import environment, json_files
from kcons.constraints import Distance
from kcons.steppers import BlanesMoan4, Geodesic, Rattle, Stepper
from kcons.thermostats import (
    Counts,
    HamiltonianMonteCarlo,
    Langevin,
    autocorrelation_time,
    mean,
    thermal_velocities,
    tune,
)

# -- three masses -----------------------------------------------------------------------------------

KT = 0.6
#: Strengths of the wells, and the force on the last mass.
WELLS, PULL = np.array([1.0, 0.5, 2.0]), 1.5
CORNER = np.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]])


def force(x: np.ndarray, t: float) -> np.ndarray:
    f = -WELLS[:, None] * x
    f[2, 0] += PULL
    return f


def potential(x: np.ndarray, t: float) -> float:
    return float(0.5 * WELLS @ (x * x).sum(axis=1) - PULL * x[2, 0])


def three_masses() -> tuple[System, State]:
    """Two bonds of length 1, a free angle, each mass in a well."""
    motion = Motion(ConstraintSet([Distance([[0, 1], [1, 2]])], CORNER, np.ones(3)), CORNER)
    system = System(motion, force, potential=potential)
    return system, State(CORNER, thermal_velocities(system, CORNER, KT, 1))


def observables(x: np.ndarray) -> tuple[float, float, float]:
    """Cosine of the angle, potential energy, place of the last mass."""
    return float((x[0] - x[1]) @ (x[2] - x[1])), potential(x, 0.0), float(x[2, 0])


def metropolis(samples: int, apart: int = 60) -> np.ndarray:
    """The same by moves of the middle mass and of the two bonds: no dynamics, and the metric sqrt(det Z) by hand."""
    rng = np.random.default_rng(5)

    def log_density(x: np.ndarray) -> float:
        cosine = (x[0] - x[1]) @ (x[2] - x[1])
        return 0.5 * math.log(4 - cosine**2) - potential(x, 0.0) / KT

    x, kept = CORNER.copy(), []
    now = log_density(x)
    for k in range(samples * apart):
        new = x + 0.7 * (rng.random(3) - 0.5)
        arm = 2 * (k % 2)
        turned = x[arm] - x[1] + 0.5 * rng.standard_normal(3)
        new[arm] = new[1] + turned / np.linalg.norm(turned)
        there = log_density(new)
        if math.log(1 - rng.random()) < there - now:
            x, now = new, there
        if k % apart == apart - 1:
            kept.append(observables(x))
    return np.array(kept)


def sampled(stepper: Stepper, dt: float, proposals: int) -> tuple[np.ndarray, Counts | None]:
    system, state = three_masses()
    found = run(system, state, dt, proposals, stepper=stepper, record=1, check_every=0)
    counts = Counts.of(found.last) if isinstance(stepper, HamiltonianMonteCarlo) else None
    return np.array([observables(s.positions) for s in found.frames[20:]]), counts


def exact(full: bool) -> tuple[list[float], list[Any]]:
    """Means and distribution functions by quadrature over the directions of the two bonds; the rest is Gaussian."""
    nodes, weights = np.polynomial.legendre.leggauss(40 if full else 24)
    turns = 64 if full else 32
    a, b, turn = np.meshgrid(nodes, nodes, (np.arange(turns) + 0.5) * 2 * math.pi / turns, indexing="ij")
    cosine = a * b + np.sqrt((1 - a * a) * (1 - b * b)) * np.cos(turn)
    first, middle, last = WELLS
    total = first + middle + last
    shift = first**2 + last**2 + PULL**2 + 2 * first * last * cosine - 2 * PULL * (first * a + last * b)
    least = -shift / (2 * total) + (first + last) / 2 - PULL * b  # of the energy, over places of the middle mass
    place = b - (first * a + last * b - PULL) / total
    w = weights[:, None, None] * weights[:, None] * np.sqrt(4 - cosine**2) * np.exp((least.min() - least) / KT)
    w, cosine, least, place = (q.ravel() for q in (w / w.sum(), cosine, least, place))
    order = np.argsort(cosine)
    spread = math.sqrt(KT / total)
    functions = [
        lambda t: np.interp(t, cosine[order], np.cumsum(w[order]) - w[order] / 2),
        lambda t: np.array([w @ chi2.cdf(2 * (q - least) / KT, 3) for q in t]),
        lambda t: np.array([w @ ndtr((q - place) / spread) for q in t]),
    ]
    grids = [np.linspace(-1, 1, 2001), np.linspace(least.min(), least.min() + 12, 400), np.linspace(-3, 4, 400)]
    smooth = [partial(np.interp, xp=grid, fp=f(grid)) for grid, f in zip(grids, functions, strict=True)]
    return [float(w @ cosine), float(w @ least + 1.5 * KT), float(w @ place)], smooth


def independent(values: np.ndarray) -> np.ndarray:
    """One of so many samples that what the slowest of the observables remembers has fallen to a few per cent."""
    return values[:: math.ceil(2 * max(autocorrelation_time(column) for column in values.T))]


def small(full: bool) -> dict[str, Any]:
    """Kolmogorov-Smirnov against quadrature and against Metropolis, and means with their errors."""
    means, functions = exact(full)
    judge = metropolis(16000 if full else 200)
    cases: dict[str, tuple[Stepper, float, int]] = {
        "HMC, RATTLE": (HamiltonianMonteCarlo(KT, (3, 9), 1), 0.28, 1),
        "HMC, BlanesMoan4": (HamiltonianMonteCarlo(KT, (1, 3), 2, stepper=BlanesMoan4()), 0.9, 1),
        "HMC, Geodesic": (HamiltonianMonteCarlo(KT, (3, 9), 3, stepper=Geodesic(4)), 0.28, 1),
        "GHMC, RATTLE": (HamiltonianMonteCarlo(KT, 2, 4, keep=0.7), 0.28, 3),
        "Langevin, same step": (Langevin(KT, 1.0, 5), 0.28, 6),
        "Metropolis": (Rattle(), 0.0, 0),
    }
    rows, other = [], independent(judge)
    for name, (stepper, dt, apart) in cases.items():
        values, counts = sampled(stepper, dt, (15000 if full else 150) * apart) if apart else (judge, None)
        found = [mean(column) for column in values.T]
        thinned = independent(values)
        rows.append(
            {
                "method": name,
                "dt": dt,
                "samples": len(values),
                "independent": len(thinned),
                "acceptance": None if counts is None else counts.acceptance,
                "rejected": None if counts is None else [counts.energy, counts.irreversible, counts.unsolved],
                "mean": [float(m[0]) for m in found],
                "error": [float(m[1]) for m in found],
                "p": [float(kstest(q, f).pvalue) for q, f in zip(thinned.T, functions, strict=True)],
                "p_metropolis": [float(ks_2samp(q, r).pvalue) for q, r in zip(thinned.T, other.T, strict=True)],
            }
        )
    return {"exact": means, "rows": rows}


# -- water and a protein in OpenMM ------------------------------------------------------------------

SCHEMES = [("blanes-moan4", 9.0), ("blanes-moan4", 12.0), ("blanes-moan4", 15.0), ("rattle", 2.0), ("rattle", 1.0)]


def proposals_of(
    system: Any, x: np.ndarray, v: np.ndarray, scheme: str, dt: float, count: int, **how: Any
) -> dict[str, Any]:
    """Changes of energy of some proposals of about 120 fs, from an equilibrated start."""
    import openmm

    from kcons.openmm import HamiltonianMonteCarlo

    length, platform, precision = how.get("length", 120.0), how.get("platform", "CPU"), how.get("precision", "")
    integrator = HamiltonianMonteCarlo.reversing_integrator(1e-3 * dt, scheme)
    given = {"Precision": precision} if precision else {"Threads": "1"} if platform == "CPU" else {}
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), given)
    context.setPositions(x)
    context.setVelocities(v)
    steps = round(length / dt)
    sampler = HamiltonianMonteCarlo(context, 300, steps, 7)
    begun, changes = time.process_time(), []
    for _ in range(count):
        sampler.step(1)
        changes.append(sampler.counts.change)
    evaluations = steps * integrator.scheme.force_evaluations
    return {
        "platform": " ".join(filter(None, [platform, precision])),
        "scheme": scheme,
        "dt": dt,
        "steps": steps,
        # Two more a proposal: the forces after new velocities, and the energy.
        "fs_per_evaluation": steps * dt / (evaluations + 2),
        "proposals": count,
        "changes": [float(change) for change in changes],
        "accepted": sampler.counts.accepted,
        "not_reversible": sampler.counts.irreversible + sampler.counts.unsolved,
        "spread": float(np.sqrt(np.nanmean(np.square(changes)))),
        "expected": math.erfc(float(np.sqrt(np.nanmean(np.square(changes)))) / math.sqrt(8)),
        "cpu_seconds": time.process_time() - begun,
    }


def equilibrated(system: Any, x: Any, steps: int) -> tuple[np.ndarray, np.ndarray]:
    import openmm

    from kcons.openmm import Langevin, ProjectedIntegrator, positions_of, velocities_of

    integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300, 5.0))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"), {"Threads": "1"})
    context.setPositions(x)
    integrator.minimizeEnergy(context, maxIterations=200)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(steps)
    return positions_of(context), velocities_of(context)


def waters(count: int, tolerance: float, switched: bool) -> tuple[Any, np.ndarray]:
    """Rigid TIP3P at 33.4 molecules in a cubic nanometre, PME; where they are is for a run to forget."""
    import openmm
    from openmm import app, unit

    field = app.ForceField("tip3p.xml")
    model = app.Modeller(app.Topology(), [] * unit.nanometer)
    model.addSolvent(field, numAdded=count)
    side = (count / 33.4) ** (1 / 3)
    model.topology.setPeriodicBoxVectors(np.eye(3) * side * unit.nanometer)
    cutoff = min(0.9, 0.45 * side)
    system = field.createSystem(
        model.topology,
        app.PME,
        cutoff * unit.nanometer,
        rigidWater=True,
        removeCMMotion=False,
        ewaldErrorTolerance=tolerance,
    )
    for term in system.getForces():
        if isinstance(term, openmm.NonbondedForce) and switched:
            term.setUseSwitchingFunction(True)
            term.setSwitchingDistance(cutoff - 0.1)
    return system, np.array(model.positions.value_in_unit(unit.nanometer))


def water(full: bool) -> dict[str, Any]:
    count = 512
    x, v = equilibrated(*waters(count, 1e-5, True), 3000)
    rows = []
    for tolerance, switched in ((1e-5, True), (5e-4, True), (5e-4, False)):
        system, _ = waters(count, tolerance, switched)
        for scheme, dt in SCHEMES if tolerance == 1e-5 else SCHEMES[:1]:
            row = proposals_of(system, x, v, scheme, dt, 40 if scheme != "rattle" else 24)
            rows.append({"ewald_tolerance": tolerance, "switched": switched, **row})
    return {"molecules": count, "rows": rows}


def precision(full: bool) -> dict[str, Any]:
    """The same proposals of 64 waters on each platform: what the precision of forces and positions does to dH."""
    import openmm

    system, x = waters(64, 1e-5, True)
    x, v = equilibrated(system, x, 2000)
    present = {openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())}
    kinds = [("Reference", ""), ("CPU", "")]
    kinds += [("OpenCL", name) for name in ("double", "mixed", "single") if "OpenCL" in present]
    rows = []
    for platform, name in kinds:
        how = {"platform": platform, "precision": name, "length": 36.0}
        rows.append(proposals_of(system, x, v, "blanes-moan4", 6.0, 8, **how))
    exact = np.array(rows[0]["changes"])
    for row in rows:
        row["off"] = float(np.sqrt(np.nanmean((np.array(row["changes"]) - exact) ** 2)))
    return {"molecules": 64, "rows": rows}


def dhfr(full: bool) -> dict[str, Any]:
    """Dihydrofolate reductase in water, 23 558 atoms, bonds of hydrogen held; forces of the CPU platform."""
    import openmm
    from openmm import app, unit

    name = Path(kcons.__file__).parent / "comparison" / "test_systems" / "data" / "5dfr_solv-cube_equil.pdb.xz"
    pdb = app.PDBFile(StringIO(lzma.decompress(name.read_bytes()).decode()))
    system = app.ForceField("amber99sb.xml", "tip3p.xml").createSystem(
        pdb.topology,
        app.PME,
        0.9 * unit.nanometer,
        constraints=app.HBonds,
        removeCMMotion=False,
        ewaldErrorTolerance=1e-5,
    )
    for term in system.getForces():
        if isinstance(term, openmm.NonbondedForce):
            term.setUseSwitchingFunction(True)
            term.setSwitchingDistance(0.8)
    x = np.array(pdb.positions.value_in_unit(unit.nanometer))  # equilibrated as it is
    return {"rows": [proposals_of(system, x, 0 * x, "blanes-moan4", 5.0, 24, length=40.0)]}


# -- physical_validation ----------------------------------------------------------------------------


def judge(full: bool) -> dict[str, Any]:
    """27 rigid waters with smooth forces in ASE at two temperatures, judged by physical_validation."""
    import physical_validation as pv
    from ase import Atoms, units

    from kcons.ase import ConstrainedMonteCarlo, constrain
    from kcons.comparison import Potential, PotentialCalculator, fluid

    temperatures, found = (400.0, 425.0), []
    unit = pv.data.UnitData(
        kb=units.kB, energy_str="eV", energy_conversion=96.48533, length_str="A", length_conversion=0.1,
        volume_str="A^3", volume_conversion=1e-3, temperature_str="K", temperature_conversion=1,
        pressure_str="eV/A^3", pressure_conversion=1.602177e6, time_str="fs", time_conversion=1e-3,
    )  # fmt: skip
    counts = []
    for temperature in temperatures:
        chosen = fluid.water(27, seed=5)
        atoms = Atoms(chosen.symbols, positions=chosen.positions, masses=chosen.forces.masses)
        atoms.calc = PotentialCalculator(Potential(chosen.forces.evaluate, "water"))
        constrain(atoms, Distance(fluid.triangles(27)))
        sampler = ConstrainedMonteCarlo(atoms, 8 * units.fs, temperature, (6, 10), stepper=BlanesMoan4(), rng=9)
        sampler.run(100)
        series: list[tuple[float, float]] = []
        sampler.attach(lambda a=atoms, s=series: s.append((a.get_kinetic_energy(), a.get_potential_energy())))
        sampler.run(1200 if full else 10)
        counts.append(sampler.counts.acceptance)
        system = pv.data.SystemData(
            natoms=81, nconstraints=81, ndof_reduction_tra=0, ndof_reduction_rot=0, mass=atoms.get_masses(),
            molecule_idx=3 * np.arange(27), nconstraints_per_molecule=np.full(27, 3),
        )  # fmt: skip
        kinetic, energy = np.transpose(series[1:])
        ensemble = pv.data.EnsembleData("NVT", natoms=81, volume=1000.0, temperature=temperature)
        seen = pv.data.ObservableData(kinetic_energy=kinetic, potential_energy=energy)
        found.append(pv.data.SimulationData(units=unit, system=system, ensemble=ensemble, observables=seen))
    return {
        "temperatures": temperatures,
        "samples": len(found[0].observables.kinetic_energy),
        "acceptance": counts,
        "kinetic_p": [float(pv.kinetic_energy.distribution(d, strict=True, verbosity=0)) for d in found],
        "ensemble_sigma": [float(s) for s in pv.ensemble.check(*found, verbosity=0)],
    }


# -- chains beside mici -----------------------------------------------------------------------------

#: Strength of the well about the origin; kT, masses and bonds are 1.
HOLD = 0.02


def straightened(n: int) -> np.ndarray:
    """A random walk of n bonds."""
    turns = np.random.default_rng(4).normal(size=(n, 3))
    x = np.vstack([np.zeros(3), np.cumsum(turns / np.linalg.norm(turns, axis=1)[:, None], axis=0)])
    return np.asarray(x - x.mean(axis=0))


def told(x: np.ndarray) -> tuple[float, float]:
    """Potential energy, and the mean cosine of neighbouring bonds."""
    d = np.diff(x, axis=0)
    return 0.5 * HOLD * float(np.vdot(x, x)), float((d[1:] * d[:-1]).sum(axis=1).mean())


def by_kcons(n: int, dt: float, steps: int, proposals: int) -> dict[str, Any]:
    x, bonds = straightened(n), np.stack([np.arange(n), np.arange(n) + 1], axis=1)
    motion = Motion(ConstraintSet([Distance(bonds)], x, np.ones(n + 1)), x)
    system = System(motion, lambda x, t: -HOLD * x, potential=lambda x, t: 0.5 * HOLD * float(np.vdot(x, x)))
    sampler = HamiltonianMonteCarlo(1.0, steps, 1, stepper=Rattle())
    state = sampler.step(system, system.initial_state(x, project=True), dt)
    begun, found = time.process_time(), []
    for _ in range(proposals):
        state = sampler.step(system, state, dt)
        found.append(told(state.positions))
    return _chain("kcons", n, found, Counts.of(state).acceptance, time.process_time() - begun)


def by_mici(n: int, dt: float, steps: int, proposals: int) -> dict[str, Any]:
    """The same proposals with its fastest solver for this system; constraints, their Jacobian and gradients by hand."""
    import mici

    rows = np.arange(n)

    def bonds(q: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * ((np.diff(q.reshape(-1, 3), axis=0) ** 2).sum(axis=1) - 1))

    def jacobian(q: np.ndarray) -> np.ndarray:
        d, found = np.diff(q.reshape(-1, 3), axis=0), np.zeros((n, 3 * n + 3))
        for k in range(3):
            found[rows, 3 * rows + k], found[rows, 3 * rows + 3 + k] = -d[:, k], d[:, k]
        return found

    system = mici.systems.DenseConstrainedEuclideanMetricSystem(
        lambda q: 0.5 * HOLD * float(q @ q), bonds, grad_neg_log_dens=lambda q: HOLD * q, jacob_constr=jacobian
    )
    solver = mici.solvers.solve_projection_onto_manifold_quasi_newton
    integrator = mici.integrators.ConstrainedLeapfrogIntegrator(system, step_size=dt, projection_solver=solver)
    draw = mici.transitions.IndependentMomentumTransition(system)
    move = mici.transitions.MetropolisStaticIntegrationTransition(system, integrator, n_step=steps)
    rng = np.random.default_rng(1)
    state = mici.states.ChainState(pos=straightened(n).ravel(), mom=None, dir=1)
    state.mom = system.sample_momentum(state, rng)
    begun, found, accepted = time.process_time(), [], 0.0
    for _ in range(proposals):
        state, _ = draw.sample(state, rng)
        state, statistics = move.sample(state, rng)
        accepted += statistics["metrop_accept_prob"]
        found.append(told(state.pos.reshape(-1, 3)))
    return _chain("mici", n, found, accepted / proposals, time.process_time() - begun)


def _chain(name: str, n: int, found: list[tuple[float, float]], acceptance: float, seconds: float) -> dict[str, Any]:
    cosine = np.array(found)[len(found) // 10 :, 1]
    value, error = mean(cosine) if len(cosine) > 100 else (cosine.mean(), math.nan)
    return {
        "package": name,
        "bonds": n,
        "proposals": len(found),
        "acceptance": float(acceptance),
        "cpu_seconds": seconds,
        "cosine": [float(value), float(error)],
        "effective": min(float(cosine.var() / error**2) / len(cosine), 1.0) * len(found),
    }


def chain(full: bool) -> dict[str, Any]:
    """In turn: kcons, mici, kcons, ...

    Of 1000 bonds mici makes a few proposals only. They are of the same kind as those of kcons, and taken to be worth as
    much.
    """
    rows = []
    for n, dt, steps, ours, theirs in ((100, 0.1, 10, 2000, 300), (1000, 0.1, 10, 2000, 4)):
        by_kcons(n, dt, steps, 2)
        for _ in range(3 if n == 100 else 1):
            first, second = by_kcons(n, dt, steps, ours), by_mici(n, dt, steps, theirs)
            if theirs < 100:
                second["effective"] = theirs * first["effective"] / ours
            rows += [first, second]
    return {"rows": rows}


# -- all of it --------------------------------------------------------------------------------------

PARTS = {"small": small, "water": water, "precision": precision, "dhfr": dhfr, "judge": judge, "chain": chain}


def _forces(row: dict[str, Any]) -> str:
    """Where a row has forces that are not the best: which ones."""
    if row.get("ewald_tolerance", 1e-5) <= 1e-5:
        return ""
    return f", Ewald tolerance {row['ewald_tolerance']:g}{'' if row['switched'] else ', no switch'}"


def show(found: dict[str, Any]) -> None:
    for row in found.get("small", {}).get("rows", []):
        share = "" if row["acceptance"] is None else f"{row['acceptance']:.0%} accepted, "
        print(f"{row['method']:20} {share}<cos> {row['mean'][0]:.4f} ({row['error'][0]:.4f}), p {min(row['p']):.2g}")
    if "small" in found:
        print(f"{'quadrature':20} <cos> {found['small']['exact'][0]:.4f}")
    for name in ("water", "dhfr"):
        for row in found.get(name, {}).get("rows", []):
            print(
                f"{name:6} {row['scheme']:13} {row['dt']:4g} fs  {row['fs_per_evaluation']:.2f} fs an evaluation, "
                f"{row['accepted']}/{row['proposals']} accepted, dH/kT {row['spread']:.3f}{_forces(row)}"
            )
    for row in found.get("precision", {}).get("rows", []):
        print(f"64 waters, {row['platform']:14} dH/kT {row['spread']:.4f}, off by {row['off']:.2g}")
    if "judge" in found:
        print("physical_validation:", {k: v for k, v in found["judge"].items() if k in ("kinetic_p", "ensemble_sigma")})
    for row in found.get("chain", {}).get("rows", []):
        rate = row["effective"] / row["cpu_seconds"]
        print(f"{row['bonds']:5} bonds, {row['package']:6} {rate:.3g} effective samples a second of processor time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", metavar="PART", choices=PARTS)
    parser.add_argument("--out", metavar="F")
    parser.add_argument("--show", metavar="F")
    chosen = parser.parse_args()
    if chosen.show:
        show(json.loads(Path(chosen.show).read_text(encoding="utf-8")))
    elif chosen.full:
        part = {chosen.full: {"environment": environment(), **PARTS[chosen.full](True)}}
        show(part)
        if chosen.out:
            known = json.loads(Path(chosen.out).read_text(encoding="utf-8")) if Path(chosen.out).exists() else {}
            json_files.write(chosen.out, {**known, **part})
    else:
        show({"small": small(False)})
        system, state = three_masses()
        found = tune(system, state, 0.05, HamiltonianMonteCarlo(KT, 6, 1, stepper=BlanesMoan4()), proposals=40)
        print(f"a step for {found.acceptance:.0%}: {found.dt:.2f}")


if __name__ == "__main__":
    main()
