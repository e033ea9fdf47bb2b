"""Tables of the results that studies have left as JSON: a function a file, from what is in it to tables by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from typing import Any

import pandas as pd

Tables = dict[str, pd.DataFrame]
Data = Mapping[str, Any]


def pm(value: Any, digits: int = 2, times: float = 1.0, less: float = 0.0) -> str:
    """A number with its standard error, given as a pair or as {'mean' or 'slope': ..., 'error': ...}."""
    if value is None:
        return ""
    if isinstance(value, Mapping):
        value = (value.get("mean", value.get("slope")), value["error"])
    return f"{times * (value[0] - less):.{digits}f} ± {times * value[1]:.{digits}f}"


def small(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}e}"


def fixed(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:,.{digits}f}"


def frame(rows: Iterable[Any], /, **columns: Callable[[Any], Any]) -> pd.DataFrame:
    """A table of rows: a function of a row for each column; '_' in a name is a space."""
    return pd.DataFrame([{name.replace("_", " "): of(row) for name, of in columns.items()} for row in rows])


def told_once(rows: Iterable[Mapping[str, Any]], key: str = "system") -> list[dict[str, Any]]:
    """Rows whose `key` is blank where it is that of the row before."""
    found, before = [], None
    for row in rows:
        found.append({**row, key: "" if row[key] == before else row[key]})
        before = row[key]
    return found


#: Integrators that have left kcons since they were measured.
GONE = ("kcons RattleIntegrator", "kcons leapfrog", "kcons Isokinetic, leapfrog")


def named(found: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{"name": name, **row} for name, row in found.items() if name not in GONE]


def ase_dynamics(data: Data) -> Tables:
    return {
        "cost": frame(
            data["cost"],
            rigid_waters=lambda r: r["waters"],
            dynamics=lambda r: r["dynamics"],
            µs_a_step=lambda r: fixed(r["step_us"], 0),
        ),
        "far": frame(
            data["far"],
            distance_from_the_origin=lambda r: f"{r['distance']:.0e} Å",
            step=lambda r: f"{r['timestep_fs']} fs",
            VelocityVerlet=lambda r: small(r["ase"]),
            ConstrainedDynamics=lambda r: small(r["kcons"]),
        ),
        "energy": frame(
            data["energy"],
            stepper=lambda r: f"`{r['stepper']}`",
            step=lambda r: f"{r['timestep_fs']:.2f} fs",
            evaluations=lambda r: r["evaluations"],
            deviation=lambda r: f"{small(r['deviation_ev'])} eV",
        ),
        "statistics": frame(
            data["statistics"],
            what=lambda r: r["what"],
            expected=lambda r: fixed(r["expected"]),
            found=lambda r: pm((r["mean"], r["error"])),
        ),
    }


def butane(data: Data) -> Tables:
    rows = [
        {"place": place, "free": data["free energy"][place], "relaxed": data["relaxed scan"][place]}
        for place in data["free energy"]
    ]
    found = frame(
        rows,
        place=lambda r: r["place"],
        free_energy_at_300_K=lambda r: pm(r["free"], 1),
        relaxed_energy=lambda r: fixed(r["relaxed"], 1),
    )
    return {"profile": found}


def certificate(data: Data) -> Tables:
    return {
        "cost": frame(
            data["certificates"],
            system=lambda r: r["name"],
            rows=lambda r: f"{r['rows']:,}",
            µs_a_step=lambda r: fixed(r["step_us"], 1),
            µs_a_certificate=lambda r: fixed(r["certificate_us"], 0),
            share_of_the_run=lambda r: f"{100 * r['share']:.2f} %",
        )
    }


def constant_pressure(data: Data) -> Tables:
    runs = named(data["runs"])
    cells = [r for r in runs if r["name"].startswith("crystal")]
    return {
        "water": frame(
            [r for r in runs if "density" in r],
            run=lambda r: r["name"],
            thermostat=lambda r: r["thermostat"],
            ps=lambda r: fixed(r["picoseconds"], 0),
            density=lambda r: pm(r["density"], 4),
            compressibility=lambda r: pm(r["compressibility"], 2, 1e5),
        ),
        "runs": frame(
            [r for r in runs if "density" not in r and r not in cells and not r["name"].startswith("cost")],
            run=lambda r: r["name"],
            **{
                key.replace(" ", "_"): (lambda r, key=key: pm(r[key], 3) if isinstance(r.get(key), list) else "")
                for key in sorted({k for r in runs for k, v in r.items() if isinstance(v, list) and len(v) == 2})
                if key not in ("density", "compressibility")
            },
        ),
    }


def engine_speed(data: Data) -> Tables:
    return {
        "engine": frame(
            data["engine"],
            system=lambda r: r["name"],
            rows=lambda r: f"{r['rows']:,}",
            P=lambda r: fixed(r["p_ns"], 1),
            V=lambda r: fixed(r["v_ns"], 1),
            times_bare=lambda r: fixed(r["ratio_to_bare"]),
            error=lambda r: small(r["relative_error"], 0),
            across=lambda r: small(r["velocity_error"], 0),
            set_up=lambda r: f"{r['setup_s']:.3f} s",
        ),
        "peers": frame(
            [r for r in named(data["peers"]) if "p_ns" in r],
            solver=lambda r: r["name"],
            P=lambda r: fixed(r["p_ns"], 1),
            V=lambda r: fixed(r["v_ns"], 1),
            error=lambda r: small(r["relative_error"], 0),
        ),
    }


def error_budget(data: Data) -> Tables:
    steps, tolerances = [], []
    for scene in data["scenes"].values():
        for method, curve in scene["steps"].items():
            points = [curve[0], curve[len(curve) // 2], curve[-1]]
            shown = "; ".join(f"{step:.3g}: {error:.0e}" for step, error in points)
            steps.append({"system": scene["title"], "unit": " → ".join(scene["units"]), "method": method, "is": shown})
        for solver, curve in scene["tolerances"]["solvers"].items():
            shown = "; ".join(f"{'exact' if row[0] is None else f'{row[0]:.0e}'}: {row[1]:.0e}" for row in curve)
            tolerances.append({"system": scene["title"], "solver": solver, "is": shown})
    return {
        "steps": frame(
            told_once(steps),
            system=lambda r: r["system"],
            method=lambda r: r["method"],
            units=lambda r: r["unit"],
            step_and_error=lambda r: r["is"],
        ),
        "tolerances": frame(
            told_once(tolerances),
            system=lambda r: r["system"],
            solver=lambda r: r["solver"],
            tolerance_and_distance=lambda r: r["is"],
        ),
    }


def free_energy(data: Data) -> Tables:
    chain, alanine, pulls = data["chain"], data["alanine dipeptide"], data["pulls"]
    about = [
        ("windows, umbrellas", f"{alanine['windows']}, {alanine['umbrellas']}"),
        ("steps of each method", f"{alanine['steps of each method']:,}"),
        ("root mean square difference below 30 kJ/mol", fixed(alanine["root mean square difference"])),
        ("largest difference below 30 kJ/mol", fixed(alanine["largest difference below 30 kJ/mol"])),
        ("largest standard error: windows, MBAR", f"{alanine['largest error of the windows']:.2f}, "
         f"{alanine['largest error of MBAR']:.2f}"),
        ("64 pulls each way, BAR", pm(pulls["BAR"])),
        ("the same difference by the windows", pm(pulls["windows"])),
    ]  # fmt: skip
    return {
        "chain": frame(
            named(chain["thermostats"]),
            thermostat=lambda r: r["name"],
            dF=lambda r: pm((r["mean force"], r["error"])),
            raw_multiplier=lambda r: fixed(r["raw multiplier"]),
            quadrature=lambda r: fixed(chain["quadrature"]),
        ),
        "alanine": frame(about, what=lambda r: r[0], found=lambda r: r[1]),
        "placement": frame(
            named(data["placement"]),
            profile=lambda r: r["name"],
            proposed=lambda r: r["proposed"],
            equal_distances_trapezoidal_rule=lambda r: r["trapezoidal rule"],
            equal_distances_spline=lambda r: r["spline"],
        ),
    }


def more_free_energies(data: Data) -> Tables:
    ring, ions, pore, torsions = (data[key] for key in ("pucker", "ions", "pore", "torsions"))
    second = torsions["minima"][1]
    rows = [
        ("ring of cyclobutane, GFN2-xTB: the flat ring over the lowest", pm((ring["barrier"], ring["error"]), 1)),
        ("the same, at 30 degrees", pm(ring["at 30 degrees"], 1)),
        ("Na⁺ and Cl⁻ in water: barrier over contact", pm(ions["barrier"], 1)),
        ("the same, second minimum", pm(ions["apart"], 1)),
        ("axis of a pore: barrier", f"{pm((pore['barrier'], pore['error']), 1)}; {pore['by quadrature']:.1f} exact"),
        ("alanine dipeptide, φ and ψ: second minimum over the first", pm((second["F"], second["error"]), 1)),
    ]
    return {"coordinates": frame(rows, coordinate=lambda r: r[0], kJ_a_mol=lambda r: r[1])}


def high_order(data: Data) -> Tables:
    goal = data["goal"]

    def needed(curve: list[dict[str, float]]) -> float | None:
        """On the line of the logarithms between the two neighbors of the goal."""
        for a, b in pairwise(curve):
            if a["error"] > goal >= b["error"]:
                at = math.log(a["error"] / goal) / math.log(a["error"] / b["error"])
                return a["evaluations"] * (b["evaluations"] / a["evaluations"]) ** at
        return None

    methods = list(next(iter(data["systems"].values()))["curves"])
    rows = [
        {"method": m, **{name: needed(scene["curves"][m]) for name, scene in data["systems"].items()}} for m in methods
    ]
    slopes = data["slopes"]
    seconds = [
        {"method": m, **{name: scene["cpu_seconds"].get(m) for name, scene in data["systems"].items()}} for m in methods
    ]
    return {
        "evaluations": frame(
            rows,
            stepper=lambda r: r["method"],
            **{
                name.replace("-", "_"): (lambda r, name=name: "not reached" if r[name] is None else f"{r[name]:,.0f}")
                for name in data["systems"]
            },
        ),
        "seconds": frame(
            seconds,
            stepper=lambda r: r["method"],
            **{
                name.replace("-", "_"): (lambda r, name=name: "" if r[name] is None else f"{1000 * r[name]:.3g} ms")
                for name in data["systems"]
            },
        ),
        "slopes": frame(
            named(slopes) if isinstance(slopes, Mapping) else slopes,
            stepper=lambda r: r["name"],
            **{
                f"step_{key}": (lambda r, key=key: small(r[key]))
                for key in (next(iter(slopes.values())) if isinstance(slopes, Mapping) else slopes[0])
            },
        ),
    }


def killed_runs(data: Data) -> Tables:
    rows = [{"work": work, **data[work]} for work in ("scan", "windows")]
    return {
        "kills": frame(
            rows,
            work=lambda r: r["work"],
            kills=lambda r: r["kills"],
            pieces_finished=lambda r: r["in all"],
            lost=lambda r: r["lost"],
            result=lambda r: r["result"],
        )
    }


def long_runs(data: Data) -> Tables:
    return {
        "flight": frame(
            named(data["free_flight"]),
            body_and_stepper=lambda r: r["name"],
            steps=lambda r: f"{r['steps']:,}",
            energy=lambda r: small(r["energy"]),
            momentum=lambda r: small(r["momentum"]),
            angular_momentum=lambda r: small(r["spin"]),
        ),
        "reversal": frame(
            named(data["reversal"]),
            stepper=lambda r: r["name"],
            steps=lambda r: f"{r['steps']:,}",
            positions=lambda r: small(r["positions"]),
            velocities=lambda r: small(r["velocities"]),
        ),
    }


def _water(rows: list[Data]) -> pd.DataFrame:
    return frame(
        rows,
        bath=lambda r: r["name"],
        U=lambda r: pm(r["energy"]),
        T_of_shifts=lambda r: pm(r["shift"], 1, 300),
        T_of_turns=lambda r: pm(r["turn"], 1, 300),
        slow_evaluations_a_ps=lambda r: fixed(r["slow_per_ps"], 0),
        ps=lambda r: fixed(r["ps"], 0),
    )


def long_steps(data: Data) -> Tables:
    reach = data["reach"]
    rows = [{**reach["reference"]}]
    for division in reach["splittings"]:
        told = f"{division['name']}, share {division['share']:.3f}: "
        rows += [{**row, "name": told + row["name"]} for row in division["water"]]
    cost = data["cost"]["small_step_us"]
    return {
        "near": _water(data["water"]),
        "reach": _water(rows),
        "beyond": _water(data["beyond"]["water"]),
        "cost": frame(cost.items(), bath=lambda r: r[0], µs_a_small_step=lambda r: fixed(r[1], 0)),
    }


def _samplers(parts: Iterable[Data]) -> pd.DataFrame:
    return frame(
        [part for part in parts if "kinds" in part],
        method=lambda r: r["method"],
        step=lambda r: f"{r['step']:g} fs",
        friction=lambda r: f"{1000 * r['friction']:g}/ps",
        shifts=lambda r: pm(r["kinds"].get("shift"), 1, 100),
        turns=lambda r: pm(r["kinds"].get("turn"), 1, 100),
        internal=lambda r: pm(r["kinds"].get("internal"), 1, 100),
        evaluations_a_ps=lambda r: fixed(1000 * r["evaluations"] / r["length"], 0),
        evaluations_a_sample=lambda r: fixed(r["correlation"], 0),
    )


def long_steps_xtb(data: Data) -> Tables:
    runs = [part for part in data["parts"].values() if "method" in part]
    parts = [{**part, "method": f"{part['system']}, {part['method']}"} for part in runs]
    return {"samplers": _samplers(parts)}


def solvated_peptide(data: Data) -> Tables:
    return {"samplers": _samplers(data["parts"].values())}


def step_length(data: Data) -> Tables:
    runs: dict[tuple[str, float], list[Data]] = {}
    for name, part in data["parts"].items():
        if ", run " in name:
            runs.setdefault((part["thermostat"], part["step"]), []).append(part)
    rows = [
        {"thermostat": thermostat, "step": step, "runs": found, "motion": motion, "at": at}
        for (thermostat, step), found in runs.items()
        for at, motion in enumerate(("moving", "turning"))
    ]

    def over_runs(key: str) -> Callable[[Data], str]:
        def shown(row: Data) -> str:
            values = [run[key][row["at"]] for run in row["runs"]]
            n = len(values)
            return pm((sum(v for v, _ in values) / n, math.hypot(*(e for _, e in values)) / n), 2, 100, 1.0)

        return shown

    return {
        "samplers": _samplers(data["parts"].values()),
        "velocities": frame(
            rows,
            thermostat=lambda r: r["thermostat"],
            step=lambda r: f"{r['step']:g} fs",
            runs=lambda r: len(r["runs"]),
            motion=lambda r: r["motion"],
            at_the_positions=over_runs("at the positions"),
            in_the_middle=over_runs("in the middle"),
            configurations=over_runs("configurations"),
        ),
    }


def monte_carlo(data: Data) -> Tables:
    water = [
        *data["water"]["rows"],
        *({**row, "system": "DHFR in water"} for row in data["dhfr"]["rows"]),
    ]
    return {
        "small": frame(
            data["small"]["rows"],
            method=lambda r: r["method"],
            accepted=lambda r: "" if r["acceptance"] is None else f"{100 * r['acceptance']:.0f} %",
            mean_of_the_cosine=lambda r: pm((r["mean"][0], r["error"][0]), 4),
            least_p=lambda r: fixed(min(r["p"]), 3),
        ),
        "water": frame(
            water,
            system=lambda r: r.get("system", "512 waters"),
            scheme=lambda r: r["scheme"],
            step=lambda r: f"{r['dt']:g} fs",
            fs_an_evaluation=lambda r: fixed(r["fs_per_evaluation"]),
            accepted=lambda r: f"{r['accepted']} of {r['proposals']}",
            deviation_of_the_energy=lambda r: f"{r['spread']:.3f} kT",
            Ewald_tolerance=lambda r: small(r.get("ewald_tolerance"), 0),
        ),
        "precision": frame(
            data["precision"]["rows"],
            platform=lambda r: r["platform"],
            deviation_of_the_energy=lambda r: f"{r['spread']:.4f} kT",
            off_Reference=lambda r: small(r["off"]),
        ),
        "chain": frame(
            data["chain"]["rows"],
            bonds=lambda r: r["bonds"],
            package=lambda r: r["package"],
            effective_samples_a_second=lambda r: f"{r['effective'] / r['cpu_seconds']:.3g}",
        ),
    }


def openmm(data: Data) -> Tables:
    water, work = data["measurements"]["plain water"], data["measurements"]["work and precision"]
    evaluations = work["evaluations_per_ps_at_5e-7_nm"]
    return {
        "speed": frame(
            named(water["rows"]),
            integrator=lambda r: r["name"],
            ms_a_step=lambda r: fixed(r["ms"]),
            speed=lambda r: fixed(r["ratio"]),
        ),
        "evaluations": frame(
            evaluations.items(),
            scheme=lambda r: f"`{r[0]}`",
            evaluations_a_ps=lambda r: f"{r[1]:,.0f}",
            fewer_than_rattle=lambda r: f"{work['fewer_than_rattle'][r[0]]:.1f} ×",
        ),
    }


def openmm_compare(data: Data) -> Tables:
    rows = []
    for part in data.values():
        for target in part["targets"]:
            rows.append({"system": part["scene"]["title"], **target})
    return {
        "targets": frame(
            told_once(rows),
            system=lambda r: r["system"],
            error=lambda r: f"{r['target']:.0e} Å",
            OpenMM=lambda r: fixed(r["own"], 0),
            kcons=lambda r: fixed(r["evaluations"], 0),
            best=lambda r: r["best"],
        )
    }


def openmm_barostats(data: Data) -> Tables:
    return {
        "volumes": frame(
            data["runs"].values(),
            barostat=lambda r: r["barostat"],
            ensemble=lambda r: r["ensemble"],
            molecules=lambda r: r["molecules"],
            p=lambda r: fixed(r["p"]),
            p_of_fewer=lambda r: small(r["less"], 0),
            p_of_more=lambda r: small(r["more"], 0),
        )
    }


def openmm_constraints(data: Data) -> Tables:
    steps = [
        {"system": part["name"], "integrator": name, "ms": ms, "ratio": part["ratio"][name]}
        for part in data["steps"]
        for name, ms in part["ms_a_step"].items()
    ]

    def own(row: Data) -> str:
        found = row["OpenMM"]
        return small(found["error"], 0) if found["error"] is not None else f"NaN after {found.get('steps', 0)} steps"

    def ours(row: Data) -> str:
        found = row["kcons"]
        return small(found["error"], 0) if found.get("error") is not None else "refused"

    return {
        "solver": frame(
            data["solver"],
            system=lambda r: r["name"],
            tolerance=lambda r: small(r["tolerance"], 0),
            P_CCMA=lambda r: fixed(r["ccma_p_ns"], 0),
            P_kcons=lambda r: fixed(r["p_ns"], 0),
            V_CCMA=lambda r: fixed(r["ccma_v_ns"], 0),
            V_kcons=lambda r: fixed(r["v_ns"], 0),
            error_CCMA=lambda r: small(r["ccma_error"], 0),
            error_kcons=lambda r: small(r["error"], 0),
        ),
        "setup": frame(
            data["setup"],
            system=lambda r: r["name"],
            CCMA=lambda r: f"{r['ccma_s']:.2f} s",
            rows_given_to_kcons=lambda r: f"{r['given_s']:.3f} s",
            moved_over_to_kcons=lambda r: f"{r['moved_s']:.3f} s",
        ),
        "steps": frame(
            told_once(steps),
            system=lambda r: r["system"],
            integrator=lambda r: r["integrator"],
            ms_a_step=lambda r: fixed(r["ms"]),
            speed=lambda r: fixed(r["ratio"]),
        ),
        "hard": frame(data["hard"], distances_held=lambda r: r["name"], kcons=ours, OpenMM=own),
    }


def openmm_four_femtoseconds(data: Data) -> Tables:
    runs = [*named(data["runs"]), *({"name": "villin", **row} for row in data["again"])]
    conditions = [
        {"molecule": name, "angles": angles, "is": found}
        for name, run in data["runs"].items()
        for angles, found in run["conditions"].items()
    ]
    return {
        "rows": frame(
            conditions,
            molecule=lambda r: r["molecule"],
            angles=lambda r: r["angles"],
            rows=lambda r: r["is"][0],
            rank=lambda r: r["is"][1],
            condition=lambda r: f"{r['is'][2]:.3g}",
        ),
        "energy": frame(
            runs,
            molecule=lambda r: r["name"],
            platform=lambda r: r["place"],
            step=lambda r: f"{1000 * r['step']:g} fs",
            ps=lambda r: fixed(r["picoseconds"], 0),
            residual=lambda r: small(r["residual"]),
            drift=lambda r: pm(r["drift"], 4),
        ),
    }


def openmm_heavy_hydrogens(data: Data) -> Tables:
    return {
        part: frame(
            found["runs"],
            integrator=lambda r: r["name"],
            step=lambda r: f"{r['fs']} fs",
            U_bonds=lambda r: pm(r["bonds"]) if r["bonds"]["error"] else "held",
            U_angles=lambda r: pm(r["angles"]),
            reported=lambda r: pm(r["reported"], 1),
        )
        for part, found in data["parts"].items()
    }


def openmm_platforms(data: Data) -> Tables:
    rows = [{"system": m["title"], **row} for m in data["measurements"] for row in named(m["rows"])]
    return {
        "speed": frame(
            told_once(rows),
            system=lambda r: r["system"],
            integrator=lambda r: r["name"],
            µs_a_step=lambda r: fixed(1000 * r["ms"], 0) if "ms" in r else "",
            speed=lambda r: fixed(r.get("ratio")),
            largest_residual=lambda r: small(r["residual"], 0),
            drift=lambda r: pm(r.get("drift"), 4),
        )
    }


def openmm_thermostats(data: Data) -> Tables:
    parts = data["measurements"]
    sampling = [{"name": n, **row} for n, rows in parts["sampling"]["sampling"].items() for row in rows]
    return {
        "speed": frame(
            named(parts["speed"]["rows"]),
            integrator=lambda r: r["name"],
            ms_a_step=lambda r: fixed(r["ms"]),
            speed=lambda r: fixed(r["ratio"]),
        ),
        "sampling": frame(
            sampling,
            integrator=lambda r: r["name"],
            step=lambda r: f"{r['fs']:g} fs",
            mean_U=lambda r: pm((r["mean"], r["error"]), 1),
        ),
        "kinetic": frame(
            named(parts["kinetic"]["rows"]),
            integrator=lambda r: r["name"],
            g=lambda r: r["g"],
            mean=lambda r: pm((r["mean"], r["mean error"]), 1),
            variance=lambda r: pm((r["variance"], r["variance error"]), 1),
        ),
    }


def random_cells(data: Data) -> Tables:
    kinds = [{"name": "all", **data["outcomes"]}, *named(data["kinds"]), *named(data["features"])]
    return {
        "outcomes": frame(
            kinds,
            systems=lambda r: r["name"],
            right=lambda r: f"{r['right']:,}",
            refused=lambda r: f"{r['refused']:,}",
            refused_without_a_reason=lambda r: r["unfounded"],
            wrong_without_an_error=lambda r: r["silent"],
        )
    }


def scans(data: Data) -> Tables:
    programs = ("kcons", "geomeTRIC", "Sella", "geomeTRIC's scan")
    total = {name: sum(m["calls"][name] for m in data["molecules"]) for name in programs}
    both = sum(m["both ways"]["calls"] for m in data["molecules"])
    rows = [*data["molecules"], {"molecule": "all", "calls": total, "both ways": {"calls": both}}]
    return {
        "calls": frame(
            rows,
            molecule=lambda r: r["molecule"],
            barrier=lambda r: fixed(r.get("barrier")),
            **{name.replace(" ", "_"): (lambda r, name=name: f"{r['calls'][name]:,}") for name in programs},
            kcons_both_ways=lambda r: f"{r['both ways']['calls']:,}",
            off=lambda r: fixed(r["off"]["kcons"], 3) if "off" in r else "",
        )
    }


def thermostat_cost(data: Data) -> Tables:
    return {
        "cost": frame(
            data["cost"],
            system=lambda r: r["system"],
            constant_energy=lambda r: f"{r['constant_energy_us']:.1f} µs",
            isokinetic=lambda r: f"{r['isokinetic_us']:.1f} µs",
            ratio=lambda r: fixed(r["ratio"]),
        )
    }


def thermostats(data: Data) -> Tables:
    runs = [part for part in data["parts"].values() if "temperature" in part and "thermal_energy" in part]
    return {
        "configurations": frame(
            told_once(
                {"system": "two atoms in a trap", **run, **({"system": run["fluid"]} if "fluid" in run else {})}
                for run in runs
            ),
            system=lambda r: r["system"],
            thermostat=lambda r: r["thermostat"] if r["thermostat"] == "Langevin" else f"2K = ({r['thermostat']}) kT",
            degrees_of_freedom=lambda r: r["g"],
            kT_found_over_kT_asked=lambda r: pm(r["temperature"], 4, 1 / r["thermal_energy"]),
            mean_U=lambda r: pm(r.get("energy"), 3),
        )
    }


#: By the name of the file.
TABLES: Mapping[str, Callable[[Data], Tables]] = {
    made.__name__: made
    for made in (
        ase_dynamics, butane, certificate, constant_pressure, engine_speed, error_budget, free_energy, high_order,
        killed_runs, long_runs, long_steps, long_steps_xtb, monte_carlo, more_free_energies, openmm, openmm_barostats,
        openmm_compare, openmm_constraints, openmm_four_femtoseconds, openmm_heavy_hydrogens, openmm_platforms,
        openmm_thermostats, random_cells, scans, solvated_peptide, step_length, thermostat_cost,
        thermostats,
    )
} | {"openmm_mixed_drift": openmm_platforms}  # fmt: skip
