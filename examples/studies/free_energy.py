"""Free energies from held coordinates, against what is known.

    python free_energy.py                   some seconds: a chain under three thermostats
    python free_energy.py --full            the same with errors of 1 %, into docs/results/free_energy.json
    python free_energy.py --alanine FOLDER  phi of alanine dipeptide: windows against umbrellas and MBAR
    python free_energy.py --pulls FOLDER    the same over its lower barrier by pulls, after --alanine FOLDER
    python free_energy.py --placement       how many windows five profiles need
    python free_energy.py --recording       what a sample costs beside a step

The chain has four atoms, bonds held, harmonic angles and a torsion that is held; a trap on its first atom leaves the
torsion's distribution alone. Its mean force is a quadrature. With so few atoms the angular momentum changes slowly
where a thermostat has no noise, and a long run does not know its error: many begin where Langevin dynamics end.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from kcons import ConstraintSet, Motion, State, System, run
from kcons.comparison import environment, json_files
from kcons.constraints import Dihedral, Distance
from kcons.free_energy import FreeEnergy, HeldCoordinates, Recorder, Settings, Windows, mean_force
from kcons.steppers import Stepper
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain, thermal_velocities

RESULT = Path(__file__).parents[2] / "docs" / "results" / "free_energy.json"
MASSES = np.array([12.0, 14.0, 16.0, 12.0])
LENGTHS = (1.5, 1.4, 1.5)
KT, BEND, BENT, PULL = 2.494, 40.0, 1.95, 6.0  # kJ/mol, and angstrom, u: the unit of time is 0.1 ps
PHI = 1.1


# -- the chain ------------------------------------------------------------------------------------------


def chain(first: float, second: float, phi: float) -> np.ndarray:
    a, b, c = LENGTHS
    x = np.zeros((4, 3))
    x[0] = a * np.array([np.cos(first), np.sin(first), 0])
    x[2] = [b, 0, 0]
    x[3] = x[2] + c * np.array([-np.cos(second), np.sin(second) * np.cos(phi), np.sin(second) * np.sin(phi)])
    return x


def internal_energy(x: np.ndarray) -> float:
    """Angles, and a spring between the ends, which pulls on the torsion."""
    angles = [
        np.arccos(np.dot(u, w) / np.linalg.norm(u) / np.linalg.norm(w))
        for u, w in ((x[0] - x[1], x[2] - x[1]), (x[1] - x[2], x[3] - x[2]))
    ]
    return float(BEND / 2 * np.sum((np.array(angles) - BENT) ** 2) + PULL / 2 * np.sum((x[0] - x[3]) ** 2))


def force(x: np.ndarray, time: float) -> np.ndarray:
    f = np.zeros((4, 3))
    end = PULL * (x[3] - x[0])
    f[0] += end
    f[3] -= end
    for i, j, k in ((0, 1, 2), (1, 2, 3)):
        u, w = x[i] - x[j], x[k] - x[j]
        p, q = np.sqrt(u @ u), np.sqrt(w @ w)
        u, w = u / p, w / q
        cosine = u @ w
        slope = BEND * (np.arccos(cosine) - BENT) / np.sqrt(1 - cosine * cosine)
        to_i, to_k = slope * (w - cosine * u) / p, slope * (u - cosine * w) / q
        f[i] += to_i
        f[k] += to_k
        f[j] -= to_i + to_k
    f[0] -= np.array([20.0, 30.0, 45.0]) * x[0] * (1 + x[0] * x[0])
    return f


def exact(n: int = 80) -> float:
    """dF/dphi by quadrature over both angles: the bonds' measure is sqrt(det H) sin sin."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    angles = BENT + 1.15 * nodes

    def integral(phi: float) -> float:
        total = 0.0
        for first, w in zip(angles, weights, strict=True):
            for second, u in zip(angles, weights, strict=True):
                x = chain(first, second, phi)
                rows = ConstraintSet(Distance([[0, 1], [1, 2], [2, 3]]), x, MASSES).jacobian(x).toarray()
                h = np.linalg.det(rows / np.repeat(MASSES, 3) @ rows.T)
                total += w * u * np.sqrt(h) * np.sin(first) * np.sin(second) * np.exp(-internal_energy(x) / KT)
        return total

    step = 1e-3
    return float(-KT * (np.log(integral(PHI + step)) - np.log(integral(PHI - step))) / (2 * step))


def sampled(stepper: Callable[[int], Stepper], steps: int, every: int, runs: int, g: int = 0) -> dict[str, float]:
    """Averages over runs from starts of Langevin dynamics, and the standard errors of these."""
    turn = Dihedral([[0, 1, 2, 3]])
    x = chain(BENT, BENT, PHI)
    motion = Motion(ConstraintSet([Distance([[0, 1], [1, 2], [2, 3]]), turn], x, MASSES), x)
    system, rng = System(motion, force), np.random.default_rng(1)
    place = system.initial_state(x, thermal_velocities(system, x, KT, rng))
    found = []
    for k in range(runs):
        place = run(system, place, 0.02, 2000, stepper=Langevin(KT, 1.0, seed=1))
        start = State(place.positions, thermal_velocities(system, place.positions, KT, rng))
        recorder = Recorder(system, HeldCoordinates(motion, {"phi": turn}, x))
        recorder.series.isokinetic_degrees_of_freedom = g
        run(system, start, 0.02, steps // runs, stepper=stepper(k), observers=[recorder], every=every)
        one = mean_force(recorder.series, KT)
        found.append((one.force[0], one.raw[0]))
    (mean, raw), spread = np.mean(found, axis=0), np.std(found, axis=0, ddof=1)[0]
    return {"mean force": float(mean), "error": float(spread / np.sqrt(runs)), "raw multiplier": float(raw)}


def closed_forms(full: bool) -> dict[str, object]:
    steps, runs = (1_600_000, 64) if full else (12_000, 4)
    steppers = {
        "Langevin": (lambda k: Langevin(KT, 1.0, seed=2 + k), 0),
        "Nose-Hoover": (lambda k: NoseHooverChain(KT, 2.0), 0),
        "isokinetic": (lambda k: Isokinetic(KT), 8),
    }
    truth = exact(60 if full else 16)
    rows = {name: sampled(stepper, steps, 20, runs, g) for name, (stepper, g) in steppers.items()}
    for name, row in rows.items():
        away = (row["mean force"] - truth) / row["error"]
        print(
            f"{name:12s} dF/dphi {row['mean force']:8.3f} +- {row['error']:.3f}, quadrature {truth:.3f} "
            f"({away:+.1f} standard errors); raw multiplier {row['raw multiplier']:.3f}"
        )
    return {"quadrature": truth, "steps": steps, "runs": runs, "degrees of freedom": 8, "thermostats": rows}


# -- where windows are put ------------------------------------------------------------------------------

#: F, its derivative, first and last window, and the period.
PROFILES = {
    "Lennard-Jones": (lambda r: 4 * (r**-12 - r**-6), lambda r: 4 * (6 * r**-7 - 12 * r**-13), 0.95, 3.0, None),
    "Morse": (
        lambda r: 50 * (1 - np.exp(-2 * (r - 1))) ** 2,
        lambda r: 200 * (1 - np.exp(-2 * (r - 1))) * np.exp(-2 * (r - 1)),
        0.7,
        4.0,
        None,
    ),
    "torsion": (
        lambda t: 7 * np.cos(t) + 3 * np.cos(2 * t) + 8 * np.cos(3 * t),
        lambda t: -7 * np.sin(t) - 6 * np.sin(2 * t) - 24 * np.sin(3 * t),
        -np.pi,
        np.pi,
        2 * np.pi,
    ),
    "double well": (lambda x: 5 * (x**2 - 1) ** 2, lambda x: 20 * x * (x**2 - 1), -1.5, 1.5, None),
    "sharp barrier": (  # a twentieth of the range wide, and not in its middle
        lambda x: 20 * np.exp(-(((x - 0.4) / 0.05) ** 2)) + 5 * x,
        lambda x: -800 * ((x - 0.4) / 0.05) * np.exp(-(((x - 0.4) / 0.05) ** 2)) + 5,
        0.0,
        1.0,
        None,
    ),
}
SEEDS, MOST = 3, 64


def placement() -> dict[str, object]:
    """The fewest windows from which on all differences of free energy have an error below 1 % of the range of F.

    Each window's mean force has an error of 0.6 % of that range by the length of the coordinate.
    """
    from scipy.integrate import cumulative_trapezoid

    from kcons.free_energy import integrate

    table = {}
    for name, (F, f, low, high, period) in PROFILES.items():
        size = float(np.ptp(F(np.linspace(low, high, 201))))
        noise = 0.006 * size / (high - low)

        def off(at: np.ndarray, found: np.ndarray, F: object = F, size: float = size) -> float:
            return float(np.std(found - F(at))) / size

        def sampled_at(x: np.ndarray, rng: object, f: object = f, noise: float = noise) -> np.ndarray:
            return f(x) + noise * rng.standard_normal(len(x))

        errors: dict[str, dict[int, list[float]]] = {way: {} for way in ("proposed", "trapezoidal rule", "spline")}
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            x = np.linspace(low, high, 7, endpoint=period is None)
            y = sampled_at(x, rng)
            while len(x) <= 24:
                profile = integrate(x, y, np.full(len(x), noise), period=period)
                errors["proposed"].setdefault(len(x), []).append(off(profile.x, profile.F))
                new = np.array(profile.next_windows(1))
                x, y = np.append(x, new), np.append(y, sampled_at(new, rng))
            for n in range(7, MOST + 1):
                x = np.linspace(low, high, n, endpoint=period is None)
                y = sampled_at(x, np.random.default_rng(seed))
                profile = integrate(x, y, np.full(n, noise), period=period, method="spline")
                errors["spline"].setdefault(n, []).append(off(profile.x, profile.F))
                if period is not None:
                    x, y = np.append(x, high), np.append(y, y[0])
                straight = np.interp(profile.x, x, cumulative_trapezoid(y, x, initial=0.0))
                errors["trapezoidal rule"].setdefault(n, []).append(off(profile.x, straight))
        table[name] = {way: _enough(found) for way, found in errors.items()}
        print(name, table[name], flush=True)
    return table


def _enough(errors: dict[int, list[float]]) -> int | None:
    """The fewest from which on the root mean square of the errors stays below 1 %; None if it does not."""
    bad = [n for n, each in errors.items() if np.sqrt(np.mean(np.square(each))) > 0.01]
    least = max(bad, default=min(errors) - 1) + 1
    return least if least in errors else None


# -- alanine dipeptide ----------------------------------------------------------------------------------


def windows_of_phi(folder: Path) -> tuple[Windows, FreeEnergy]:
    """Of alanine dipeptide in vacuum: FIRST at equal distances, the others where they are proposed."""
    from openmm import app

    from kcons.free_energy import OpenMMWindows

    pdb = app.PDBFile(str(Path(__file__).parents[2] / "tests" / "data" / "alanine-dipeptide-implicit.pdb"))
    sampler = OpenMMWindows(
        pdb.topology, _system(pdb), pdb.positions, {"phi": Dihedral([[4, 6, 8, 14]])}, platform="Reference"
    )
    settings = Settings(timestep=STEP, temperature=TEMPERATURE, friction=FRICTION, production=PRODUCTION, every=25)
    said = {"workers": 1, "progress": lambda *n: print("windows", *n, flush=True)}
    held = Windows(sampler, folder / "windows", settings, **said)
    held.run(np.linspace(-np.pi, np.pi, FIRST, endpoint=False))
    return held, held.improve(0.05, MOST, below=HIGHEST, at_once=8)


def alanine(folder: Path) -> dict[str, object]:
    """phi: windows where it is held, and umbrellas with as many steps put together by MBAR."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from pymbar import FES
    from scipy.interpolate import CubicSpline

    from kcons.free_energy import weighted_mean

    held, result = windows_of_phi(folder)
    profile, windows, settings = result.profile, len(result.windows), held.settings
    total = 2 * windows * (settings.pull + settings.equilibration + PRODUCTION)
    each = total // FIRST
    places = np.linspace(-np.pi, np.pi, FIRST, endpoint=False)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        series = list(pool.map(umbrella, places, range(FIRST), [each] * FIRST, [str(folder)] * FIRST))
    # MBAR's errors are those of independent samples; the same rule as for the windows says how far apart these are.
    apart = [
        weighted_mean((each - place + np.pi) % (2 * np.pi)).inefficiency[0]
        for each, place in zip(series, places, strict=True)
    ]
    series = [each[:: int(np.ceil(every))] for each, every in zip(series, apart, strict=True)]
    phi = np.concatenate(series)
    away = (phi[None] - places[:, None] + np.pi) % (2 * np.pi) - np.pi
    fes = FES(STIFFNESS / 2 * away**2 / kT, [len(s) for s in series])
    bins = np.linspace(-np.pi, np.pi, 73)
    fes.generate_fes(
        np.zeros(len(phi)), phi, fes_type="histogram", histogram_parameters={"bin_edges": [bins]}, n_bootstraps=0
    )
    centres = ((bins[1:] + bins[:-1]) / 2)[np.histogram(phi, bins)[0] > 0]
    known = fes.get_fes(centres, reference_point="from-lowest", uncertainty_method="analytical")
    at = int(np.argmin(known["f_i"]))
    # A histogram has means over its bins, which on a steep slope are not the values in their middles.
    inside = centres[:, None] + np.diff(bins)[0] * (np.arange(20) + 0.5 - 10) / 20
    ours = -kT * np.log(np.exp(-CubicSpline(profile.x, profile.F)(inside) / kT).mean(axis=1))
    ours -= ours[at]
    difference = ours - kT * known["f_i"]
    low = kT * known["f_i"] < HIGHEST
    difference -= difference[low].mean()
    errors = np.interp(centres, profile.x, profile.error)
    found = {
        "windows": windows,
        "steps of each method": total,
        "umbrellas": FIRST,
        "seconds of the windows": sum(w.seconds for w in result.windows),
        "largest difference below 30 kJ/mol": float(np.abs(difference[low]).max()),
        "root mean square difference": float(np.sqrt(np.mean(difference[low] ** 2))),
        "largest error of the windows": float(errors[low].max()),
        "largest error of MBAR": float(kT * known["df_i"][low].max()),
        "doubtful windows": [w.number for w in result.windows if w.hysteresis < 0.01],
        "phi": centres.tolist(),
        "held": ours.tolist(),
        "error": errors.tolist(),
        "MBAR": (kT * known["f_i"]).tolist(),
        "MBAR error": (kT * known["df_i"]).tolist(),
    }
    print({k: v for k, v in found.items() if not isinstance(v, list)})
    return found


def pulls(folder: Path, count: int = 64) -> dict[str, object]:
    """From the lowest minimum over the lower barrier, 20 ps each, both ways; and the windows between the same ends."""
    from kcons.free_energy import Series, pull_free_energy, thermal_multipliers

    start, end = -1.3, 0.0
    held, result = windows_of_phi(folder)
    windows = result.profile.difference(start, end)
    settings = replace(held.settings, pull=5000)
    found = Windows(held.sampler, folder / "pulls", settings, workers=1).pull(start, end, count)
    assert found.bar is not None and found.jarzynski_backward is not None
    ways = [f"{a:g}-to-{b:g}" for a, b in ((start, end), (end, start))]
    series = [[Series.load(file) for file in sorted((folder / "pulls").glob(f"pull-{way}-*.npz"))] for way in ways]
    works = [[each.work[-1] for each in way] for way in series]
    thermal = [[each.work_of(thermal_multipliers(each, kT))[-1] for each in way] for way in series]
    fast, slow = (pull_free_energy(*each, thermal_energy=kT).best.value for each in (works, thermal))
    told = {
        "from, to": [start, end],
        "pulls each way": count,
        "steps": settings.pull,
        "BAR": [found.bar.value, found.bar.error],
        "Jarzynski": [found.jarzynski.value, found.jarzynski.error],
        "Jarzynski, backward": [found.jarzynski_backward.value, found.jarzynski_backward.error],
        "lost": found.dissipated,
        "overlap": found.overlap,
        "windows": [windows.value, windows.error],
        "standard errors off": (found.bar.value - windows.value) / float(np.hypot(found.bar.error, windows.error)),
        "with the velocities of the run": fast - slow,
    }
    print(told)
    return told


TEMPERATURE, STIFFNESS = 300.0, 150.0  # K, kJ/mol/rad^2
kT = 0.00831446261815324 * TEMPERATURE
FIRST, MOST, PRODUCTION = 24, 36, 480_000  # windows at equal distances, windows in all, steps of each side
HIGHEST = 30.0  # kJ/mol: what is compared, and where windows are added for
STEP, FRICTION = 4.0, 1.0  # fs with heavy hydrogens, 1/ps: psi, which is slow, turns fastest


def _system(pdb: object) -> object:
    from openmm import app

    field = app.ForceField("amber14-all.xml")
    return field.createSystem(pdb.topology, constraints=app.HBonds, hydrogenMass=3.0, removeCMMotion=False)


def umbrella(place: float, number: int, steps: int, folder: str) -> np.ndarray:
    """phi every 20 steps of a run with a harmonic umbrella, OpenMM's own integrator."""
    import openmm
    from openmm import app, unit

    file = Path(folder) / f"umbrella-{number}.npy"
    if file.exists():
        return np.load(file)
    pdb = app.PDBFile(str(Path(__file__).parents[2] / "tests" / "data" / "alanine-dipeptide-implicit.pdb"))
    system = _system(pdb)
    bias = openmm.CustomTorsionForce(f"{STIFFNESS / 2}*min(d, 2*pi-d)^2; d=abs(theta-place); pi=3.141592653589793")
    bias.addGlobalParameter("place", float(place))
    bias.addTorsion(4, 6, 8, 14, [])
    system.addForce(bias)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, STEP / 1000)
    integrator.setRandomNumberSeed(number + 1)
    simulation = app.Simulation(pdb.topology, system, integrator, openmm.Platform.getPlatformByName("Reference"))
    simulation.context.setPositions(pdb.positions)
    simulation.minimizeEnergy()
    simulation.context.setVelocitiesToTemperature(TEMPERATURE, number + 1)
    simulation.step(steps // 10)
    found = []
    for _ in range((steps - steps // 10) // 20):
        simulation.step(20)
        x = simulation.context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        found.append(Dihedral([[0, 1, 2, 3]]).measure(np.asarray(x)[None, [4, 6, 8, 14]], 0.0)[0])
    np.save(file, np.array(found))
    return np.array(found)


# -- what recording costs ---------------------------------------------------------------------------------


def recording(turns: int = 40, steps: int = 200) -> dict[str, object]:
    """What recording adds to the processor time of alanine dipeptide's steps with phi (and psi) held, as a part of it.

    Ratios of turns that follow one another, and their median: nothing else on the machine tells on them.
    """
    import io
    from time import process_time

    from openmm import Platform, app

    from kcons.free_energy import HeldCoordinatesReporter, OpenMMWindows, Window

    pdb = app.PDBFile(str(Path(__file__).parents[2] / "tests" / "data" / "alanine-dipeptide-implicit.pdb"))
    torsions = {"phi": Dihedral([[4, 6, 8, 14]]), "psi": Dihedral([[6, 8, 14, 16]])}
    default = Settings().every
    found: dict[str, object] = {"every": default, "platform": Platform.getPlatformByName("Reference").getName()}
    for count in (1, 2):
        held = dict(list(torsions.items())[:count])
        sampler = OpenMMWindows(pdb.topology, _system(pdb), pdb.positions, held, platform="Reference")
        start, _ = sampler.begin()
        window = Window(0, "up", tuple(start), tuple(start), 1)
        settings = Settings(temperature=TEMPERATURE, timestep=STEP, friction=FRICTION, relax=0)
        run = sampler.simulation(sampler.rows(), window, settings)
        run.hold(window.start, window.target, "langevin", 1, 1)
        simulation = run.simulation
        reporters = {every: HeldCoordinatesReporter(io.StringIO(), every, held) for every in (10, default)}
        for reporter in reporters.values():  # what is set up once
            simulation.reporters = [reporter]
            simulation.step(2 * default)
        ratios: dict[int, list[float]] = {every: [] for every in reporters}
        for _ in range(turns):
            times = {}
            for every in (0, *reporters):
                simulation.reporters = [reporters[every]] if every else []
                began = process_time()
                simulation.step(steps)
                times[every] = process_time() - began
            for every in reporters:
                ratios[every].append(times[every] / times[0] - 1)
        found[f"{count} held"] = {str(every): float(np.median(each)) for every, each in ratios.items()}
        print(count, found[f"{count} held"], flush=True)
    return found


def main(arguments: list[str]) -> None:
    if "--alanine" in arguments:
        folder = Path(arguments[arguments.index("--alanine") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        found = {"alanine dipeptide": alanine(folder)}
    elif "--pulls" in arguments:
        found = {"pulls": pulls(Path(arguments[arguments.index("--pulls") + 1]))}
    elif "--placement" in arguments:
        found = {"placement": placement()}
    elif "--recording" in arguments:
        found = {"recording": recording()}
    else:
        found = {"chain": closed_forms("--full" in arguments)}
        if "--full" not in arguments:
            return
    known = json_files.read(RESULT) if RESULT.exists() else {}
    machines = known.get("machines", {}) | dict.fromkeys(found, environment())
    json_files.write(RESULT, known | found | {"machines": machines})
    print(f"wrote {RESULT}")


if __name__ == "__main__":
    main(sys.argv[1:])
