"""Batches on PyTorch: nanoseconds a row, launches, residuals in single precision, and the share of a step.

    python batched.py --quick --out DIR                a few minutes
    python batched.py --device cuda --out DIR          a quarter of an hour on a GPU, most of it compilation

Rigid waters, and copies of a tree of 21 bonds, by the engine, by batches in both precisions, and with compiled steps.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import harness
import numpy as np
import pandas as pd
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, rattle
from kcons.constraints import Distance

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]])
PARENTS = [0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 5, 5, 6, 7, 8, 9, 9, 10, 11, 12, 13]


def waters() -> tuple[Motion, np.ndarray]:
    return Motion(ConstraintSet(Distance([[0, 1], [0, 2], [1, 2]]), WATER, [16.0, 1.0, 1.0]), WATER), WATER


def tree() -> tuple[Motion, np.ndarray]:
    x = np.zeros((22, 3))
    for k, parent in enumerate(PARENTS):
        way = np.random.default_rng(k).normal(size=3)
        x[k + 1] = x[parent] + way / np.linalg.norm(way)
    bonds = Distance([[parent, k + 1] for k, parent in enumerate(PARENTS)])
    return Motion(ConstraintSet(bonds, x, np.resize([12.0, 1.0], 22)), x), x


def medians(call: Callable[[], Any], device: str, repeats: int = 5) -> float:
    """Seconds, of one thread on a processor."""

    def done() -> None:
        call()
        if device != "cpu":
            torch.cuda.synchronize()

    clock = time.process_time if device == "cpu" else time.perf_counter
    return float(np.median(harness.in_turn({"": done}, repeats, clock)[""]))


def launches(call: Callable[[], Any], device: str) -> int:
    """Kernels that are started on a GPU; on a processor operations that torch is asked for, and compiled ones."""
    kinds = torch.profiler.ProfilerActivity
    with torch.profiler.profile(activities=[kinds.CPU if device == "cpu" else kinds.CUDA]) as seen:
        call()
    if device != "cpu":
        return sum(each.device_type.name == "CUDA" for each in seen.events())
    asked = {id(each) for each in seen.events() if each.name.startswith(("aten::", "## Call"))}
    return sum(id(each) in asked and id(each.cpu_parent) not in asked for each in seen.events())


def measured(name: str, copies: int, device: str, dtype: torch.dtype, compiled: bool) -> Iterator[dict[str, Any]]:
    """One system in copies, 0.02 off its rows."""
    motion, place = {"waters": waters, "tree of 21 bonds": tree}[name]()
    batch = Batch(motion, copies=copies, device=device, dtype=dtype, compiled=compiled)
    x = torch.as_tensor(place).repeat(copies, 1, 1).to(batch.device, dtype)
    y = x + 0.02 * torch.as_tensor(np.random.default_rng(0).normal(size=x.shape)).to(batch.device, dtype)
    row = {"part": "speed", "system": name, "copies": copies, "dtype": str(dtype)[6:], "compiled": compiled}
    found = batch.project_positions(y, x)
    off = max(
        float(each.residual) for each in Batch(motion, min(copies, 20), device=device, dtype=dtype).report(found[:20])
    )
    with torch.no_grad():
        seconds = [medians(lambda: batch.project_positions(y, x), device)]
        seconds.append(medians(lambda: batch.project_velocities(x, y), device))
        count = launches(lambda: batch.project_positions(y, x), device)
    tracked = y.clone().requires_grad_()
    both = medians(lambda: batch.project_positions(tracked, x).sum().backward(), device)
    ns = [1e9 * each / batch.n_rows for each in (*seconds, both - seconds[0])]
    yield {**row, "positions": ns[0], "velocities": ns[1], "backward": ns[2], "launches": count, "residual": off}


def share(copies: int, device: str, compiled: bool) -> Iterator[dict[str, Any]]:
    """Of constraints in a step of drops of 27 waters with a pair potential."""
    rng, sites = np.random.default_rng(0), 81
    grid = 3.1 * np.stack(np.meshgrid(*[range(3)] * 3), -1).reshape(-1, 1, 3)
    place = (WATER @ np.linalg.qr(rng.normal(size=(27, 3, 3)))[0] + grid).reshape(-1, 3)
    pairs = (3 * np.arange(27)[:, None, None] + [[0, 1], [0, 2], [1, 2]]).reshape(-1, 2)
    motion = Motion(ConstraintSet(Distance(pairs), place, np.tile([16.0, 1.0, 1.0], 27)), place)
    batch = Batch(motion, copies=copies, device=device, compiled=compiled)
    one, two = torch.triu_indices(sites, sites, 1, device=device)
    one, two = one[one // 3 != two // 3], two[one // 3 != two // 3]
    charge = torch.tensor([-0.834, 0.417, 0.417], dtype=torch.float64, device=device).repeat(27)

    def force(x: torch.Tensor) -> torch.Tensor:
        x = x.detach().requires_grad_()
        energy = (charge[one] * charge[two] / (x[:, one] - x[:, two]).norm(dim=-1)).sum()
        return -torch.autograd.grad(energy, x)[0]

    x = torch.as_tensor(place, device=device).repeat(copies, 1, 1)
    v, f = torch.zeros_like(x), force(x)
    whole = medians(lambda: rattle(batch, force, x, v, f, 0.02), device)
    alone = medians(lambda: force(x), device)
    row = {"part": "share", "system": "drops of 27 waters", "copies": copies, "compiled": compiled}
    yield {**row, "step": 1e3 * whole, "forces": 1e3 * alone, "share": 1 - alone / whole}


def by_the_engine(name: str, copies: int) -> Iterator[dict[str, Any]]:
    """The same copies as one system on arrays, by compiled kernels of Numba."""
    motion, place = {"waters": waters, "tree of 21 bonds": tree}[name]()
    (bonds,) = motion.constraint_set.constraints
    n, x = len(place), np.tile(place, (copies, 1))
    pairs = (n * np.arange(copies)[:, None, None] + bonds.atoms).reshape(-1, 2)
    whole = Motion(ConstraintSet(Distance(pairs), x, np.tile(motion.masses, copies)), x)
    y = x + 0.02 * np.random.default_rng(0).normal(size=x.shape)
    found = whole.project_positions(y, x)
    seconds = [medians(lambda: whole.project_positions(y, x), "cpu")]
    seconds.append(medians(lambda: whole.project_velocities(x, y), "cpu"))
    row = {"part": "speed", "system": name, "copies": copies, "dtype": "engine", "compiled": True}
    ns = [1e9 * each / len(pairs) for each in seconds]
    off = whole.report(found, condition=False).residual
    yield {**row, "positions": ns[0], "velocities": ns[1], "residual": off}


def pieces(chosen: argparse.Namespace) -> dict[str, Callable[[], Iterator[dict[str, Any]]]]:
    torch.set_num_threads(1)
    counts = {"tree of 21 bonds": 512, "waters": 10_000}
    if chosen.quick:
        counts = dict.fromkeys(counts, 20)
    if chosen.device != "cpu":
        counts = {name: 10 * copies for name, copies in counts.items()}
    found: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {}
    for name, copies in counts.items():
        found[f"{name}, engine"] = partial(by_the_engine, name, copies)
        for dtype in (torch.float64, torch.float32):
            for compiled in (False, True)[: 1 if chosen.quick or name != "waters" else 2]:
                about = f"{name}, {dtype}, {'compiled' if compiled else 'eager'}"
                found[about] = partial(measured, name, copies, chosen.device, dtype, compiled)
    for compiled in (False, True)[: 1 if chosen.quick else 2]:
        copies = 2 if chosen.quick else 64
        found[f"share, {'compiled' if compiled else 'eager'}"] = partial(share, copies, chosen.device, compiled)
    return found


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Nanoseconds a row, launches and residuals; milliseconds of a step, and the share that constraints have."""
    about = {"system": "{}", "copies": "{:.0f}", "compiled": "{}"}
    times = dict.fromkeys(("positions", "velocities", "backward"), "{:.0f}")
    speed = {**about, "dtype": "{}", **times, "launches": "{:.0f}", "residual": "{:.0e}"}
    return {
        "ns a row": harness.shown(table, "speed", **speed),
        "ms a step": harness.shown(table, "share", **about, step="{:.2f}", forces="{:.2f}", share="{:.2f}"),
    }


def main() -> None:
    parser = harness.options(__doc__, "batched")
    parser.add_argument("--device", default="cpu", help="cpu (default), or cuda")
    parser.set_defaults(torch=torch.__version__)
    harness.main("batched", parser, pieces, tables)


if __name__ == "__main__":
    main()
