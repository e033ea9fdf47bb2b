"""This machine: `kcons doctor`, what there is and what is missing; `kcons warmup`, kernels compiled beforehand."""

from __future__ import annotations

import argparse
import os
import platform
import time
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from kcons import __version__
from kcons.cli.compare import check_name
from kcons.cli.terminal import Command, Option, names, show
from kcons.errors import EXTRAS

THREADS = ("OMP_NUM_THREADS", "OPENMM_CPU_THREADS", "NUMBA_NUM_THREADS")


def _doctor(chosen: argparse.Namespace) -> int:
    found, wrong = examine()
    for heading, entries in found.items():
        show(heading, *(f"  {name:<20} {value}" for name, value in entries.items()))
    show(*(f"wrong: {sentence}" for sentence in wrong) if wrong else ["nothing is wrong"])
    return 1 if wrong else 0


def examine() -> tuple[dict[str, dict[str, str]], list[str]]:
    """Sections of names and what was found; sentences on what has to be mended."""
    import numba

    from kcons.comparison.machine import kernels_cached, processor, simd_width
    from kcons.constraints.compilation import has_a_file, njit

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = {
        "kcons": {"version": __version__, "Python": platform.python_version(), "at": str(Path(__file__).parents[1])},
        "machine": {
            "processor": processor(),
            "system": f"{platform.system()} {platform.machine()}",
            "SIMD": f"{simd_width()} bits",
            "cores": f"{os.cpu_count()}, {usable} of them for this process",
            "threads of Numba": str(numba.get_num_threads()),
            "set in the shell": ", ".join(f"{n}={os.environ[n]}" for n in THREADS if n in os.environ) or "nothing",
        },
        "packages": {name: version(name) or "not installed" for name in ("numpy", "scipy", "numba", "rich")},
        "extras": {name: version(name) or f"pip install 'kcons[{extra}]'" for name, extra in EXTRAS.items()},
        "compiled kernels": {
            "here": "some" if kernels_cached() else "none yet; kcons warmup compiles them",
            "kept in": str(Path(njit(cache=True)(has_a_file)._cache.cache_path).parent),
        },
    }
    wrong = []
    if find_spec("openmm"):
        found |= {"OpenMM platforms": _platforms(), "steps on the device": _device()}
        if "runs" not in found["OpenMM platforms"].values():
            wrong.append("no platform of OpenMM runs; install it again: python -m pip install --force-reinstall openmm")
    return found, wrong


def version(package: str) -> str | None:
    """The version of a package that can be imported; None of one that cannot."""
    if find_spec(package) is None:
        return None
    try:
        return metadata.version("torch-sim-atomistic" if package == "torch_sim" else package)
    except metadata.PackageNotFoundError:
        return "of unknown version"


def _platforms() -> dict[str, str]:
    """Whether a step was made on each platform of OpenMM, or why none was."""
    import openmm

    found = {}
    for chosen in map(openmm.Platform.getPlatform, range(openmm.Platform.getNumPlatforms())):
        system = openmm.System()
        system.addParticle(1.0)
        try:
            context = openmm.Context(system, openmm.VerletIntegrator(0.001), chosen)
            context.setPositions([[0.0, 0.0, 0.0]])
            context.getIntegrator().step(1)
            found[chosen.getName()] = "runs"
            del context
        except openmm.OpenMMException as error:
            found[chosen.getName()] = f"does not run: {' '.join(str(error).split())[:120]}"
    for failure in openmm.Platform.getPluginLoadFailures():
        found[f"plugin {len(found)}"] = f"not loaded: {' '.join(failure.split())[:120]}"
    return found


def _device() -> dict[str, str]:
    """Whether there is the plugin of OpenMM, or why there can be none."""
    from kcons.openmm.device import build

    there = next((path for path in build.places() if (path / "libKcons.so").exists()), None)
    plugin = f"in {there}" if there else "not compiled yet; kcons warmup device compiles it"
    return {
        "compiler": " ".join(build.compiler()) or "none",
        "for": ", ".join(["Reference", "CPU", *build.accelerated()]),
        "plugin": f"none: {why}" if (why := build.refusal()) else plugin,
    }


# -- warmup -----------------------------------------------------------------------------------------

#: Test systems that use most of the solvers, and the plugin of OpenMM.
USUAL = ("water", "chain", "butane", "alanine", "sphere", "slab", "device")
NEED_OPENMM = ("alanine", "device")


def _warmup(chosen: argparse.Namespace) -> int:
    from kcons.constraints import compilation

    wanted = [name for given in chosen.what for name in names(given)] or USUAL
    for name in (name for name in wanted if name != "device"):
        check_name(argparse.Namespace(system=name, size=None))
    announcer, compilation.SMALL = compilation.announcer, 0
    announcer.announced = True  # it is said here
    for name in wanted:
        print(name, end=": ", flush=True)
        if name in NEED_OPENMM and find_spec("openmm") is None:
            print("OpenMM is not installed")
            continue
        begun, before = time.perf_counter(), announcer.seconds
        refused = _compiled_device() if name == "device" else _system(name)
        compiled, whole = announcer.seconds - before, time.perf_counter() - begun
        print(refused or (f"compiled in {compiled:.1f} s" if compiled else f"is there ({whole:.1f} s)"))
    return 0


def _system(name: str) -> str:
    """Some steps, and what else is asked of an engine, of a test system or of what is held in a file."""
    import numpy as np

    from kcons import State, System, run, steppers, thermostats
    from kcons.comparison import test_systems

    found = test_systems.plan(name) if test_systems.is_file(name) else test_systems.build(name)
    motion, x = found.motion, found.positions
    v, f = motion.project_velocities(x, np.random.default_rng(0).normal(size=x.shape) * 0.01), np.zeros_like(x)
    motion.constraint_force(x, v, f)
    motion.acceleration(x, v, f)
    motion.restore_positions(x + 1e-3 * v)
    of_heat = thermostats.Isokinetic(1.0, momentum="free"), thermostats.NoseHooverChain(1.0, 1.0, momentum="free")
    for stepper in (steppers.Rattle(), steppers.BlanesMoan6(), *of_heat, thermostats.Langevin(1.0, 1.0, 1)):
        end = run(System(motion, lambda y, t: np.zeros_like(y)), State(x, v), 1e-3, 2, stepper=stepper)
        motion.report(end.positions, end.velocities)
    return ""


def _compiled_device() -> str:
    """Why it cannot be compiled here."""
    from kcons.constraints.compilation import announcer
    from kcons.openmm.device import build

    why = build.refusal()
    if not why and not build.is_built():
        begun = time.perf_counter()
        build.library()
        announcer.seconds += time.perf_counter() - begun
    return why


COMMANDS = (
    Command(
        "doctor",
        "MD engines, platforms, threads, caches and optional packages of this machine",
        "What kcons finds on this machine. Exit status 0; 1 if something is wrong, which is said.",
        (),
        _doctor,
    ),
    Command(
        "warmup",
        "compile beforehand what a first run would compile",
        "Kernels are compiled once on a machine, and kept where later runs find them.",
        (Option("what", f"test systems, files, device: steps of OpenMM (default: {', '.join(USUAL)})", nargs="*"),),
        _warmup,
    ),
)
