"""Measurements behind docs/growth.md: random starts, a large ensemble, work against precision.

python examples/notes/growth_results.py                   small samples, some seconds
python examples/notes/growth_results.py --full --out F    10^6 random systems, 10^4 hypercycles; F receives JSON
python examples/notes/growth_results.py --full --part ensemble --out F    one part of F again
python examples/notes/growth_results.py --show F          the tables of an earlier result
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from kcons.comparison import environment, processor_of
from kcons.models.growth import ConstrainedHypercycle, Hypercycle, Populations, solve, solve_ensemble

KINDS = ("a", "b", "c")
MEANING = {"a": "fixed total", "b": "entropy produced", "c": "none produced"}
START = np.array([0.6, 0.1, 0.1, 0.1, 0.1])


def constrained(model: Hypercycle, kind: str, tau: Any = 30.0) -> ConstrainedHypercycle:
    """The three systems of figure 11."""
    if kind == "a":
        return model.with_fixed_total()
    return model.with_entropy_production(tau) if kind == "b" else model.without_entropy_production()


# -- random starts and rates ------------------------------------------------------------------------


def random_systems(n: int, count: int, seed: int) -> tuple[Hypercycle, np.ndarray, np.ndarray]:
    """Hypercycles with parameters over decades, their tau, and starts down to ln x = -700; (model, tau, log_x0)."""
    rng = np.random.default_rng([seed, n])
    k_h, kT = 10 ** rng.uniform(-1, 1, count), 10 ** rng.uniform(-1, 1, count)
    mu0 = rng.normal(size=(n, count)) * kT * 10 ** rng.uniform(-1, 0.5, count)
    tau, total = 10 ** rng.uniform(-1, 2, count) / k_h, 10 ** rng.uniform(-0.5, 0.5, count)
    spread = rng.integers(0, 3, count)
    log_x = np.where(
        spread == 0,
        np.log(rng.dirichlet(np.ones(n), count).T),
        np.where(spread == 1, rng.uniform(-5, 0, (n, count)), rng.uniform(-700, 0, (n, count))),
    )
    log_x += np.log(total) - np.log(np.sum(np.exp(log_x), axis=0))
    return Hypercycle(n, k_h, mu0, kT), tau, log_x


def in_extended_precision(model: Hypercycle, log_x0: np.ndarray, log_x: np.ndarray, left: Any) -> np.ndarray:
    """What is left of the rows, shape (3, N), computed from ln x alone in the longest numbers NumPy has.

    Of sum x, of the excess of g, and of g itself; `left` is the part of the excess that the law leaves. Ordinary
    numbers would do no better than the engine, and see their own round-off.
    """
    mu0, kT = (np.asarray(value, dtype=np.longdouble) for value in (model.mixture.mu0, model.mixture.kT))

    def total_and_energy(logarithms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y = logarithms.astype(np.longdouble)
        x = np.exp(y)
        total = np.sum(x, axis=0)
        return total, np.sum(x * (mu0 + kT * (y - np.log(total))), axis=0)

    top = np.max(-mu0 / kT, axis=0)
    least = -kT * (top + np.log(np.sum(np.exp(-mu0 / kT - top), axis=0)))
    (total0, g0), (total, g) = total_and_energy(log_x0), total_and_energy(log_x)
    excess0 = g0 - total0 * least
    return np.abs([total - total0, g - total * least - excess0 * left, g - total0 * least - excess0 * left])


def random_group(n: int, kind: str, share: int, seed: int, batch: int = 16384) -> dict[str, Any]:
    """`share` random systems of n species under one kind of constraints, to t = 10/k_h."""
    sums = {"trajectories": 0, "finite": 0, "failed": 0, "settled": 0, "steps": 0, "above_1e-13": 0}
    worst = {"total": 0.0, "entropy": 0.0, "gibbs": 0.0, "of_terms": 0.0, "least_log_x": 0.0, "most_steps": 0.0}
    begin = process_time()
    for part, first in enumerate(range(0, share, batch)):
        many = min(batch, share - first)
        model, tau, log_x0 = random_systems(n, many, seed + 1000 * part + 100_000 * KINDS.index(kind))
        system = constrained(model, kind, tau)
        times = np.linspace(0.1, 1.0, 10)[:, None] * 10.0 / model.k_h
        found = solve_ensemble(system, times, log_x0=log_x0, rtol=1e-6, atol=1e-8, batch=batch)
        start = Populations.from_logarithms(np.zeros(many), log_x0)
        size = np.maximum(1.0, np.abs(model.mixture.gibbs_energy(start)))
        # What g is the sum of: its own zero is that of the potentials, and arbitrary.
        terms = np.maximum(size, np.sum(start.x * np.abs(model.mixture.potentials(start)), axis=0))
        above = np.zeros(many, dtype=bool)
        finite = np.all(np.isfinite(found.log_x), axis=(0, 1))
        rows = ("total",) if kind == "a" else ("total", "entropy", "gibbs")
        for t, log_x in zip(found.t, found.log_x, strict=True):
            law = np.exp(-t.astype(np.longdouble) / tau) if kind == "b" else 1.0
            left = in_extended_precision(model, log_x0, log_x, law)[: len(rows)] / size
            for name, off in zip(rows, left, strict=True):
                worst[name] = max(worst[name], float(np.max(off[finite], initial=0.0)))
            of_terms = (np.max(left[1:], axis=0, initial=0.0) * size / terms)[finite]
            worst["of_terms"] = max(worst["of_terms"], float(np.max(of_terms, initial=0.0)))
            above |= finite & np.any(left > 1e-13, axis=0)
        sums["above_1e-13"] += int(above.sum())
        sums["trajectories"] += many
        sums["finite"] += int(finite.sum())
        sums["failed"] += int(found.failed.sum())
        sums["settled"] += int(np.isfinite(found.settled_time).sum())
        sums["steps"] += int(found.steps.sum())
        worst["least_log_x"] = min(worst["least_log_x"], float(np.nanmin(found.log_x)))
        worst["most_steps"] = max(worst["most_steps"], float(found.steps.max()))
    group = {"n": n, "kind": kind, **sums, **worst, "cpu_s": process_time() - begin}
    print(
        f"n = {n} ({kind}): {sums['trajectories']:,} trajectories, {sums['finite']:,} finite, least ln x "
        f"{worst['least_log_x']:.3g}, rows {worst['total']:.1e} {worst['entropy']:.1e} "
        f"{worst['gibbs']:.1e}, {group['cpu_s']:.0f} s",
        flush=True,
    )
    return group


def random_starts(
    count: int, seed: int = 1, sizes: tuple[int, ...] = (2, 3, 4, 5, 6, 8), processes: int = 1
) -> dict[str, Any]:
    """`count` random systems to t = 10/k_h: is ln x finite, do the rows hold?"""
    kinds = [(n, kind) for n in sizes for kind in KINDS]
    shares = [count // len(kinds) + (number < count % len(kinds)) for number in range(len(kinds))]
    work = [(n, kind, share, seed) for (n, kind), share in zip(kinds, shares, strict=True)]
    if processes == 1:
        groups = [random_group(*arguments) for arguments in work]
    else:
        with ProcessPoolExecutor(processes) as pool:
            groups = [task.result() for task in [pool.submit(random_group, *arguments) for arguments in work]]
    result: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-8, "groups": groups}
    for key in ("trajectories", "finite", "failed", "settled", "above_1e-13"):
        result[key] = sum(g[key] for g in groups)
    result["worst_row"] = max(max(g["total"], g["entropy"], g["gibbs"]) for g in groups)
    result["worst_of_terms"] = max(g["of_terms"] for g in groups)
    result["cpu_s"] = sum(g["cpu_s"] for g in groups)
    return result


# -- a large ensemble -------------------------------------------------------------------------------


#: Tolerances that bring the error of each system to t = 100 below 1e-6.
TOLERANCE = {"a": 4e-10, "b": 2e-8, "c": 2e-9}
#: Populations below are judged by the relative error of ln x: species that die out go beyond all numbers.
LEAST_COUNTED = 1e-10


def ensemble(count: int, end: float = 100.0, threads: int = 2, seed: int = 2) -> dict[str, Any]:
    """`count` hypercycles of figure 11 from random starts to t = `end`, against runs with a tolerance of 1e-12."""
    x0 = np.random.default_rng(seed).dirichlet(np.ones(5), count).T
    result: dict[str, Any] = {"count": count, "end": end, "threads": threads, "kinds": {}}
    for kind in KINDS:
        system, rtol = constrained(Hypercycle(), kind), TOLERANCE[kind]
        # Other work on the machine: processes that wanted a core in the last minute.
        load = os.getloadavg()[0]
        wall, cpu = perf_counter(), process_time()
        found = solve_ensemble(system, [end], x0, rtol=rtol, atol=rtol, batch=5000, threads=threads)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        fine = solve_ensemble(system, [end], x0, rtol=1e-12, atol=1e-12, batch=5000, threads=threads)
        # d ln x is the relative error of x.
        off, exact = np.abs(found.log_x[0] - fine.log_x[0]), fine.log_x[0]
        counted = exact > np.log(LEAST_COUNTED)
        error = np.max(np.where(counted, off, off / np.abs(exact)), axis=0)
        of_x = np.max(np.abs(found.x[0] - fine.x[0]), axis=0)
        result["kinds"][kind] = {
            "rtol": rtol,
            "wall_s": wall,
            "cpu_s": cpu,
            "load": load,
            "failed": int(found.failed.sum()),
            "error_max": float(error.max()),
            "error_median": float(np.median(error)),
            "x_error_max": float(of_x.max()),
            "share_counted": float(counted.mean()),
            "steps_mean": float(found.steps.mean()),
        }
        print(
            f"({kind}) {count:,} to t = {end:g}: {wall:.1f} s wall, {cpu:.1f} s CPU, "
            f"largest relative error {error.max():.1e}, of x {of_x.max():.1e}",
            flush=True,
        )
    return result


# -- work and precision -----------------------------------------------------------------------------


def by_hand(model: Hypercycle, tau: float, budget: float) -> Any:
    """dx/dt with the multipliers of (153) put in by hand, b as a function of time: what one would give to SciPy."""
    mu0, k = model.mixture.mu0, float(model.k_h)

    def velocity(t: float, x: np.ndarray) -> np.ndarray:
        total = x.sum()
        mu = mu0 + np.log(x / total)
        M1, M2 = x @ mu, x @ mu**2
        rates = k * np.roll(x, -1)
        eta0 = x @ rates
        eta1 = -budget / tau * np.exp(-t / tau) - (x * rates) @ mu
        z = ((total * eta1 + eta0 * M1) * mu - (eta1 * M1 + eta0 * M2)) / (total * M2 - M1**2)
        return x * (rates + z)

    return velocity


def work_precision(end: float = 100.0, tolerances: tuple[float, ...] = (1e-4, 1e-6, 1e-8, 1e-10)) -> dict[str, Any]:
    """Evaluations and errors of `solve` and of SciPy's methods, figure 11 (b)."""
    model = Hypercycle()
    system = model.with_entropy_production(30.0)
    p0 = Populations.from_values(0.0, START)
    budget = float(model.mixture.excess(p0, 1.0))
    fine = solve(system, (0.0, end), START, rtol=1e-13, atol=1e-13)
    exact, law = fine.y[:, -1], budget * np.exp(-end / 30.0)
    rows: list[dict[str, Any]] = []

    def note(name: str, tolerance: float, x: np.ndarray | None, nfev: int, seconds: float, why: str = "") -> None:
        row: dict[str, Any] = {"method": name, "rtol": tolerance, "nfev": nfev, "cpu_s": seconds, "note": why}
        if x is not None and np.all(x > 0):
            excess = float(model.mixture.excess(Populations.from_values(end, x / x.sum()), 1.0))
            row |= {
                "error": float(np.max(np.abs(x - exact) / exact)),
                "total": float(abs(x.sum() - 1)),
                "excess_error": float(abs(excess / law - 1)),
            }
        rows.append(row)

    for tolerance in tolerances:
        for method in ("DOP853", "Radau"):
            begin = process_time()
            found = solve(system, (0.0, end), START, method, rtol=tolerance, atol=tolerance)
            note(f"kcons, {method}", tolerance, found.y[:, -1], found.nfev, process_time() - begin)
        for method in ("RK45", "DOP853", "Radau", "LSODA"):
            begin = process_time()
            with np.errstate(all="ignore"):
                ivp = solve_ivp(
                    by_hand(model, 30.0, budget), (0.0, end), START, method, rtol=tolerance, atol=1e-3 * tolerance
                )
            good = ivp.success and np.all(np.isfinite(ivp.y))
            note(
                f"SciPy {method}",
                tolerance,
                ivp.y[:, -1] if good else None,
                ivp.nfev,
                process_time() - begin,
                "" if good else f"ends at t = {ivp.t[-1]:.3g}",
            )
    return {"end": end, "system": "figure 11 (b), start (0.6, 0.1, 0.1, 0.1, 0.1)", "rows": rows}


#: CPU seconds after which a solver is taken to be stuck.
PATIENCE = 10.0


def far_out() -> list[dict[str, Any]]:
    """Where the plain equation fails: close to equilibrium, t = 900, and near extinction."""
    rows: list[dict[str, Any]] = []
    model = Hypercycle()
    system = model.with_entropy_production(30.0)
    for name, start, end in (
        ("to equilibrium, t = 900", START, 900.0),
        ("near extinction, t = 10", np.array([0.9, 0.04, 0.03, 0.02, 0.01]), 10.0),
    ):
        budget = float(model.mixture.excess(Populations.from_values(0.0, start), 1.0))
        exact = solve(system, (0.0, end), start, rtol=1e-11, atol=1e-12).log_y[:, -1]
        for method in ("kcons, DOP853", "SciPy DOP853", "SciPy Radau", "SciPy LSODA"):
            owner, solver = method.replace(",", "").split()
            row: dict[str, Any] = {"case": name, "method": method, "rtol": 1e-8}
            if owner == "kcons":
                found = solve(system, (0.0, end), start, solver, rtol=1e-8, atol=1e-8)
                row |= {"reached": end, "error": float(np.max(np.abs(np.expm1(found.log_y[:, -1] - exact))))}
            else:
                velocity, reached = by_hand(model, 30.0, budget), [0.0]
                deadline = process_time() + PATIENCE

                def patient(
                    t: float,
                    x: np.ndarray,
                    velocity: Any = velocity,
                    reached: Any = reached,
                    deadline: float = deadline,
                ) -> np.ndarray:
                    if process_time() > deadline:
                        raise TimeoutError
                    reached[0] = t
                    return np.asarray(velocity(t, x))

                try:
                    with np.errstate(all="ignore"):
                        ivp = solve_ivp(patient, (0.0, end), start, solver, rtol=1e-8, atol=1e-11)
                except (TimeoutError, ValueError):  # Radau: NaN in its matrix
                    row["reached"] = float(reached[0])
                else:
                    x = ivp.y[:, -1]
                    row["reached"] = float(ivp.t[-1])
                    if ivp.t[-1] == end and np.all(np.isfinite(x)) and np.all(x > 0):
                        row["error"] = float(np.max(np.abs(x / np.exp(exact) - 1)))
            rows.append(row)
    return rows


def show(result: dict[str, Any]) -> None:
    """Print the tables."""
    r = result["random"]
    print(
        f"\nRandom systems to t = 10/k_h: {r['trajectories']:,}, finite {r['finite']:,}, "
        f"{r['cpu_s']:.0f} s CPU\nRows within {r['worst_row']:.1e} of max(1, |g_0|), {r['above_1e-13']} of the systems "
        f"above 1e-13; within {r['worst_of_terms']:.1e} of the terms of g_0"
    )
    e = result["ensemble"]
    print(f"\n{e['count']:,} hypercycles to t = {e['end']:g}, {e['threads']} threads")
    for kind, row in e["kinds"].items():
        print(
            f"  ({kind}) {MEANING[kind]:17s} rtol {row['rtol']:.0e} {row['wall_s']:6.1f} s wall "
            f"{row['cpu_s']:6.1f} s CPU   error {row['error_max']:.1e} (median {row['error_median']:.1e})"
        )
    w = result["work_precision"]
    print(f"\nWork and precision to t = {w['end']:g}, {w['system']}")
    print("  method              rtol    evaluations   CPU s     error    |sum x - 1|   g - g_eq off by")
    for row in w["rows"]:
        tail = (
            f"{row['error']:9.1e} {row['total']:11.1e} {row['excess_error']:14.1e}" if "error" in row else row["note"]
        )
        print(f"  {row['method']:16s} {row['rtol']:8.0e} {row['nfev']:12,} {row['cpu_s']:8.2f} {tail}")
    if result["far_out"]:
        print()
        for row in result["far_out"]:
            end = f"error {row['error']:.1e}" if "error" in row else f"ends at t = {row['reached']:.4g} or is wrong"
            print(f"  {row['case']:26s} {row['method']:14s} {end}")
    m = result["machine"]
    print(
        f"\n{processor_of(m)}, {m['cores']} cores; numpy {m['versions']['numpy']}, scipy {m['versions']['scipy']}; "
        f"{m['date']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the sample sizes of docs/growth.md")
    parser.add_argument("--part", choices=("ensemble", "work_precision", "random", "far_out"), help="this part alone")
    parser.add_argument("--processes", type=int, default=2, help="for the random systems")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument("--show", type=Path, help="tables of an earlier result instead of a run")
    options = parser.parse_args()
    if options.part and not options.out:
        parser.error("--part writes into the file that --out names")
    full = options.full
    parts: dict[str, Callable[[], Any]] = {
        "ensemble": lambda: ensemble(10_000 if full else 50, 100.0 if full else 5.0),
        "work_precision": lambda: work_precision() if full else work_precision(5.0, (1e-4, 1e-6)),
        "random": lambda: (
            random_starts(1_000_000, processes=options.processes) if full else random_starts(180, sizes=(3,))
        ),
        "far_out": far_out if full else lambda: [],
    }
    if options.show:
        result = json.loads(options.show.read_text(encoding="utf-8"))
    elif options.part:
        result = json.loads(options.out.read_text(encoding="utf-8"))
        result[options.part] = parts[options.part]()
    else:
        result = {"machine": environment(), "full": full} | {name: part() for name, part in parts.items()}
    if options.out:
        options.out.write_text(json.dumps(result, indent=1, default=float) + "\n", encoding="utf-8")
    show(result)


if __name__ == "__main__":
    main()
