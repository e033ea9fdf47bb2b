"""Pictures of the pages, each from one result file: a function a picture."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import harness
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from result_tables import named

RESULTS = Path(__file__).resolve().parent / "results"
OURS, THEIRS = "#1f77b4", "#999999"


def load(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def axes_of(height: float) -> tuple[Figure, Axes]:
    drawn = Figure(figsize=(6.6, height), layout="constrained")
    axes = drawn.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return drawn, axes


def bars(names: Sequence[str], values: Sequence[float], label: str, ours: Callable[[str], bool], form: str) -> Figure:
    """Horizontal bars with their values; those of kcons in blue."""
    drawn, axes = axes_of(1.0 + 0.33 * len(names))
    axes.barh(range(len(names)), values, color=[OURS if ours(name) else THEIRS for name in names], height=0.65)
    for k, value in enumerate(values):
        axes.text(value, k, f" {value:{form}}", va="center", fontsize=9)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set(ylim=(len(names) - 0.4, -0.6), xlim=(0, 1.15 * max(values)))
    drawn.supxlabel(label, fontsize=9)
    return drawn


def points(names: Sequence[str], found: Sequence[Sequence[float]], right: float, label: str, ours: Any) -> Figure:
    """Values with standard errors beside the right one."""
    drawn, axes = axes_of(1.0 + 0.33 * len(names))
    axes.axvline(right, color="black", linewidth=0.8)
    for k, (name, (value, error)) in enumerate(zip(names, found, strict=True)):
        axes.errorbar(value, k, xerr=error, fmt="o", color=OURS if ours(name) else THEIRS, capsize=3)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set(ylim=(len(names) - 0.4, -0.6))
    drawn.supxlabel(label, fontsize=9)
    return drawn


def ase_step() -> Figure:
    rows = [row for row in load("ase_dynamics")["cost"] if row["waters"] == 1000]
    names = [row["dynamics"].replace("ConstrainedDynamics, ", "") for row in rows]
    label = "µs a step, 1000 rigid waters, forces that cost nothing (gray: ASE's VelocityVerlet)"
    return bars(names, [row["step_us"] for row in rows], label, lambda name: "Velocity" not in name, ".0f")


def openmm_gpu() -> Figure:
    rows = named(load("openmm_platforms")["measurements"][1]["rows"])
    values = [row["ratio"] for row in rows]
    label = "speed on a GPU, of VerletIntegrator (DHFR in water, HBonds, mixed precision)"
    return bars([row["name"] for row in rows], values, label, lambda name: "kcons" in name, ".2f")


def openmm_device() -> Figure:
    """Steps without Forces on the CPU platform, by the plugin, by a CustomIntegrator and by OpenMM's own."""
    head, table = harness.read(RESULTS / "openmm_device.csv")
    machine = ", ".join(head["machine"].split(", ")[:2])
    times = table[table.precision == "CPU, double precision"].set_index("integrator").ms * 1000
    kinds = ("rattle", "Langevin", "NoseHoover", "Isokinetic")
    drawn = Figure(figsize=(5.2, 4.4), layout="constrained")
    axes = drawn.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    looks = (("kcons, plugin", "{}, device", OURS), ("kcons, CustomIntegrator", "{}, program", "#9ecae1"),
             ("OpenMM's own", "OpenMM beside {}", THEIRS))  # fmt: skip
    for shift, (label, form, color) in zip((-0.27, 0.0, 0.27), looks, strict=True):
        found = {k + shift: times[form.format(kind)] for k, kind in enumerate(kinds) if form.format(kind) in times}
        axes.barh(list(found), list(found.values()), height=0.26, color=color, label=label)
        for place, value in found.items():
            axes.text(value, place, f" {value:.0f}", va="center", fontsize=10)
    axes.set_yticks(range(len(kinds)), kinds, fontsize=11)
    axes.set(ylim=(len(kinds) - 0.4, -0.6), xlim=(0, 1.12 * times[[f"{kind}, program" for kind in kinds]].max()))
    drawn.supxlabel(f"µs per step: 1335 atoms of rigid water without Forces,\nCPU platform; {machine}", fontsize=10)
    drawn.legend(loc="outside upper center", fontsize=10, ncols=2)
    return drawn


def openmm_hold() -> Figure:
    names, values = [], []
    for row in load("openmm_constraints")["solver"]:
        for solver, key in (("CCMA", "ccma_p_ns"), ("kcons", "p_ns")):
            names.append(f"{row['name']}, {row['tolerance']:.0e}: {solver}")
            values.append(row[key])
    return bars(names, values, "ns a row for positions, the solver alone", lambda name: "kcons" in name, ".0f")


def thermostats() -> Figure:
    runs = [p for p in load("thermostats")["parts"].values() if "temperature" in p and p["thermostat"] != "g"]
    names = [f"{p.get('fluid', 'two atoms in a trap')}: {p['thermostat'].replace('g - 1', 'isokinetic')}" for p in runs]
    found = [[value / p["thermal_energy"] for value in p["temperature"]] for p in runs]
    return points(names, found, 1.0, "kT of the configurations over the kT asked for", lambda name: True)


def monte_carlo() -> Figure:
    drawn, axes = axes_of(3.4)
    for scheme, color in (("blanes-moan4", OURS), ("rattle", THEIRS)):
        rows = [
            row for row in load("monte_carlo")["water"]["rows"]
            if row["scheme"] == scheme and row["ewald_tolerance"] == 1e-5
        ]  # fmt: skip
        rows.sort(key=lambda row: row["fs_per_evaluation"])
        shares = [row["accepted"] / row["proposals"] for row in rows]
        axes.plot([row["fs_per_evaluation"] for row in rows], shares, "o-", color=color, label=scheme)
    axes.set(
        xlabel="fs of trajectory an evaluation of forces (512 waters)", ylabel="proposals accepted", ylim=(0, 1.05)
    )
    axes.legend()
    return drawn


def constant_pressure() -> Figure:
    runs = {name: run for name, run in load("constant_pressure")["runs"].items() if "density" in run}
    names = [name.removeprefix("water, ") for name in runs]
    found = [run["density"] for run in runs.values()]
    label = "density of 64 TIP3P waters, g/cm³ (gray: OpenMM's barostat; line: its mean)"
    own = [run["density"][0] for name, run in runs.items() if "OpenMM" in name]
    return points(names, found, sum(own) / len(own), label, lambda name: "OpenMM" not in name)


def scans() -> Figure:
    molecules = load("scans")["molecules"]
    drawn, axes = axes_of(5.0)
    for program, color, shift in (("kcons", OURS, -0.27), ("geomeTRIC", "#bbbbbb", 0.0), ("Sella", "#777777", 0.27)):
        at = [k + shift for k in range(len(molecules))]
        axes.barh(at, [m["calls"][program] for m in molecules], height=0.26, color=color, label=program)
    axes.set_yticks(range(len(molecules)), [m["molecule"] for m in molecules], fontsize=8)
    axes.set(xlabel="calls of GFN2-xTB for a scan of 24 points", ylim=(len(molecules) - 0.4, -0.6))
    axes.legend()
    return drawn


def long_steps() -> Figure:
    drawn, axes = axes_of(3.4)
    divisions = load("long_steps")["reach"]["splittings"]
    for bath, color in (("langevin", THEIRS), ("split", OURS)):
        rows = [
            (division["share"], row)
            for division in divisions
            for row in division["water"]
            if row["bath"] == bath and row["turn"][0] < 1.6
        ]
        hot = [100 * (row["turn"][0] - 1) for _, row in rows]
        errors = [100 * row["turn"][1] for _, row in rows]
        shares = [share for share, _ in rows]
        label = {"langevin": "Langevin, 16 to 64 fs", "split": "spheres, 24 to 64 fs"}[bath]
        axes.errorbar(shares, hot, yerr=errors, fmt="o", color=color, label=label, capsize=2, markersize=5)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(
        xscale="log", xlabel="share of the stiffness that is left to the slow forces", ylabel="turns too hot by / %"
    )
    axes.legend()
    return drawn


def engine_speed() -> Figure:
    wanted = ("rigid water, 10000 molecules", "CH3, 10000 groups", "chain, zigzag, 10000 bonds",
              "tree (polymethylene), 10000 bonds", "DHFR, all bonds", "DHFR, mixed")  # fmt: skip
    data = load("engine_speed")
    found = {row["name"]: row["p_ns"] + row["v_ns"] for row in data["engine"] if row["name"] in wanted}
    for name in ("OpenMM SETTLE", "OpenMM CCMA, DHFR, all bonds, 1e-06", "OpenMM CCMA, DHFR, all bonds, 1e-12"):
        found[name] = data["peers"][name]["p_ns"] + data["peers"][name]["v_ns"]
    label = "ns a row, positions and velocities, to rounding unless a tolerance is named"
    return bars(list(found), list(found.values()), label, lambda name: "OpenMM" not in name, ".0f")


def hard_cases(verdicts: pd.DataFrame) -> Figure:
    kinds = {"right": "#2ca02c", "refused": "#9ecae1", "silently wrong": "#d62728", "crash/NaN": "#000000"}
    programs = list(verdicts.columns[2:])
    drawn, axes = axes_of(2.6)
    for k, program in enumerate(programs):
        told = [str(cell).strip("*").replace("**", "").split(":")[0].split(" (")[0] for cell in verdicts[program]]
        left = 0
        for kind, color in kinds.items():
            count = told.count(kind)
            axes.barh(k, count, left=left, color=color, height=0.65, label=kind if k == 0 else None)
            if count:
                shade = "white" if kind in ("crash/NaN", "silently wrong", "right") else "black"
                axes.text(left + count / 2, k, str(count), ha="center", va="center", color=shade, fontsize=9)
            left += count
    axes.set_yticks(range(len(programs)), programs)
    axes.set(xlabel="hard cases that the program can state", ylim=(len(programs) - 0.4, -0.6))
    drawn.legend(loc="outside upper center", ncols=4, fontsize=9)
    return drawn


#: By the name of the file, without its ending.
PICTURES: Mapping[str, Callable[[], Figure]] = {
    made.__name__.replace("_", "-"): made
    for made in (
        ase_step, constant_pressure, engine_speed, long_steps, monte_carlo, openmm_device, openmm_gpu, openmm_hold,
        scans, thermostats
    )
}  # fmt: skip
