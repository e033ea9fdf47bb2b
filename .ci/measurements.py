"""The measurements in docs/results: what makes each, of which commit it is, and whether it is stale.

    python .ci/measurements.py                    the table
    python .ci/measurements.py NAME ...           some of it
    python .ci/measurements.py --stale            measure again what is stale, one after the other
    python .ci/measurements.py --stale NAME ...   some of that

After a measurement pages of docs that show what its example prints show the new lines; what their text says in words is
for a person to read again (the tests of tests/pages find where it is no longer true).

A result is stale where a definition of the code that it measures has changed since its commit (what was added, names of
files, imports, documentation and layout do not count), and where its commit is not in this repository or not in the
file. Times are those of an idle core; measure on an idle machine.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import shlex
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
CORE = ("constraints", "motion", "plan", "solvers", "steppers")
ASE, OPENMM, BATHS = (*CORE, "ase"), (*CORE, "openmm"), (*CORE, "thermostats")


@dataclass(frozen=True)
class Measurement:
    """What makes one file, or one folder, of docs/results.

    Attributes
    ----------
    parts : tuple of str
        Folders of the package that it measures.
    commands : tuple of str
        As a person types them; F stands for the file.
    minutes : float or None
        About; None where nobody noted it.
    by_hand : str
        Why ``--stale`` leaves it out; '' where it does not.
    """

    parts: tuple[str, ...]
    commands: tuple[str, ...]
    minutes: float | None = None
    by_hand: str = ""


def script(name: str, *more: str) -> tuple[str, ...]:
    return tuple(f"python examples/{name}.py {words}" for words in more or ("--full --out F",))


TABLE = {
    "ase_dynamics.json": Measurement(ASE, script("05_ase_dynamics"), 2),
    "butane.json": Measurement((*BATHS, "ase", "free_energy"), script("30_butane_torsion", "--full"), 12),
    "certificate.json": Measurement(CORE, script("03_engine_speed", "--certificates --full --out F"), 2),
    "compare_water.json": Measurement(
        (*ASE, "comparison/work_precision", "comparison/methods"),
        ("kcons compare water --out compare-water", "cp compare-water/compare.json F"),
        7,
    ),
    "constant_pressure.json": Measurement(
        (*BATHS, "ase"),
        (*script("34_constant_pressure", "--full"), *script("38_constant_pressure_water", "--full")),
        45,
    ),
    "engine_speed.json": Measurement(CORE, script("03_engine_speed"), 4),
    "error_budget.json": Measurement(CORE, script("18_error_budget"), 1),
    "free_energy.json": Measurement(
        (*BATHS, "openmm", "free_energy"),
        script(
            "29_free_energy",
            "--full",
            "--placement",
            "--recording",
            "--alanine alanine-windows",
            "--pulls alanine-windows",
        ),
        95,
    ),
    "growth.json": Measurement((*CORE, "models"), ("python examples/notes/growth_results.py --full --out F",), 5),
    "high_order.json": Measurement(CORE, script("04_high_order"), 18),
    "killed_runs.json": Measurement(("free_energy",), ("python tests/contracts/killed_runs.py",), 3),
    "long_runs.json": Measurement(
        CORE,
        ("env KCONS_LONG_RUNS=F python -m pytest -m validation tests/contracts/test_long_runs.py",),
        5,
    ),
    "long_steps.json": Measurement(
        (*BATHS, "ase"),
        (
            *script("31_long_steps", "--small", "--cost"),
            *script("39_long_steps_water", "--full long-steps", "--collect long-steps", "--fresh"),
            *script(
                "41_long_steps_reach",
                *("--full long-steps-reach", "--collect long-steps-reach", "--beyond long-steps-beyond"),
            ),
        ),
        300,
    ),
    "long_steps_xtb.json": Measurement((*BATHS, "ase", "comparison/averages"), script("studies/xtb_steps"), 30),
    "monte_carlo.json": Measurement(
        (*BATHS, "openmm", "ase"),
        script(
            "32_hamiltonian_monte_carlo",
            *(f"--full {part} --out F" for part in ("small", "water", "precision", "dhfr", "judge", "chain")),
        ),
        15,
    ),
    "more_free_energies.json": Measurement(
        (*BATHS, "ase", "openmm", "free_energy"), script("35_more_free_energies", "--full more-free-energies"), 11
    ),
    "openmm.json": Measurement(OPENMM, script("06_openmm"), 1),
    "openmm_barostats.json": Measurement(
        (*OPENMM, "thermostats"),
        (
            "env KCONS_BAROSTATS=F python -m pytest -m validation -k each_beside_each"
            " tests/contracts/test_openmm_barostat_ensembles.py",
        ),
        5,
    ),
    "openmm_compare.json": Measurement(OPENMM, script("11_openmm_compare"), 7),
    "openmm_constraints.json": Measurement(OPENMM, script("08_openmm_constraints"), 5),
    "openmm_four_femtoseconds.json": Measurement(OPENMM, script("24_openmm_four_femtoseconds"), 50),
    "openmm_heavy_hydrogens.json": Measurement(OPENMM, script("25_openmm_heavy_hydrogens"), 4),
    "openmm_mixed_drift.json": Measurement(
        OPENMM, script("23_openmm_platforms", '--platform "OpenCL mixed" --drift 10 --starts 3 --out F'), 75
    ),
    "openmm_platforms.json": Measurement(
        OPENMM,
        script("23_openmm_platforms", '--platform "CUDA mixed" --full --pdb FILE --out F'),
        None,
        "needs a GPU and a file of DHFR",
    ),
    "openmm_surfaces.json": Measurement(OPENMM, script("09_openmm_surfaces"), 1),
    "openmm_thermostats.json": Measurement((*OPENMM, "thermostats"), script("12_openmm_thermostats"), 40),
    "random_cells.json": Measurement(CORE, ("python tests/contracts/random_cells.py --cases 10000 --out F",), 6),
    "report": Measurement((*ASE, "openmm", "comparison"), ("kcons compare --all --out F",), 90),
    "scans.json": Measurement((*ASE, "free_energy"), script("28_relaxed_scan"), 4),
    "solvated_peptide.json": Measurement((*BATHS, "comparison/averages"), script("40_peptide_steps"), 30),
    "step_length.json": Measurement((*BATHS, "comparison/averages"), script("33_step_length"), 16),
    "thermostat_cost.json": Measurement((*BATHS, "ase"), script("22_thermostat_cost"), 1),
    "thermostats.json": Measurement((*BATHS, "ase"), script("10_thermostats"), 20),
    "trajectory_check.json": Measurement(
        (*CORE, "mdanalysis"), script("21_check_speed", "--full --out F", "--full --cold --out F"), 6
    ),
}


def git(*words: str) -> bytes | None:
    """What git says; None where it fails."""
    result = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True)
    return None if result.returncode else result.stdout


@cache
def sources(commit: str | None, part: str) -> tuple[bytes, ...]:
    """The files of a folder of the package, now or at a commit; none where it did not exist."""
    folder = f"kcons/{part}"
    if commit is None:
        return tuple(path.read_bytes() for path in sorted((ROOT / folder).rglob("*.py")))
    archive = git("archive", commit, folder)
    if archive is None:
        return ()
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        members = [member for member in files if member.name.endswith(".py")]
        return tuple(files.extractfile(member).read() for member in members)  # type: ignore[union-attr]


@cache
def definitions(commit: str | None, part: str) -> frozenset[bytes]:
    from kcons.comparison.study.machine import pieces

    return frozenset(pieces(sources(commit, part)))


def found(data: Any, key: str) -> Iterator[Any]:
    """All that stands under `key` anywhere in a result."""
    if isinstance(data, dict):
        if key in data:
            yield data[key]
        for value in data.values():
            yield from found(value, key)
    elif isinstance(data, list):
        for value in data:
            yield from found(value, key)


def facts(name: str) -> dict[str, list[Any]]:
    """Commits, dates and widths of registers that stand in a file, or in the files of a folder."""
    path = RESULTS / name
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    read = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()]
    return {key: sorted({v for data in read for v in found(data, key) if v}) for key in ("commit", "date", "simd")}


@cache
def state(name: str) -> str:
    """'current', or why the result is stale."""
    commits = facts(name)["commit"]
    if not commits:
        return "stale: no commit"
    for commit in commits:
        if commit.endswith("+"):
            return f"stale: of uncommitted code on {commit[:7]}"
        if git("cat-file", "-e", f"{commit}^{{commit}}") is None:
            return f"stale: {commit[:7]} is not in this repository"
    changed = {}
    for part in TABLE[name].parts:
        now = definitions(None, part)
        gone = [len(definitions(commit, part) - now) for commit in commits]
        new = [0 if definitions(commit, part) else len(now) for commit in commits]
        if max(gone + new):
            changed[part] = max(gone + new)
    counts = ", ".join(f"{count} in {part}" for part, count in changed.items())
    return f"stale: definitions changed: {counts}" if counts else "current"


def row(name: str) -> str:
    """A line of the table."""
    about = facts(name)
    commits = about["commit"]
    one = commits[0][:7] if len(commits) == 1 else f"{len(commits) or 'no'} commits"
    minutes = TABLE[name].minutes
    columns = (
        name,
        "?" if minutes is None else f"{minutes:g}",
        one,
        (about["date"] or ["?"])[-1][:10],
        "/".join(map(str, about["simd"])) or "?",
        state(name),
    )
    return "{:<30} {:>4} {:<10} {:<10} {:>4} {}".format(*columns)


def shown(name: str) -> list[str]:
    """What each example of a result prints of it, as pages show it; '' where one cannot, as before a first run."""
    said = []
    for example in dict.fromkeys(re.findall(r"examples/[\w/]+\.py", " ".join(TABLE[name].commands))):
        option = "--summary" if "--summary" in (ROOT / example).read_text(encoding="utf-8") else "--show"
        words = [sys.executable, example, option, str(RESULTS / name)]
        result = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
        text = "" if result.returncode else result.stdout.strip("\n")
        said.append("\n".join(line.rstrip() for line in text.split("\n")))
    return said


def follow(old: str, new: str, pages: Path) -> int:
    """Put new output in place of old wherever a page shows it, whole or in blocks; how many places were found."""
    blocks = [(old, new)]
    if all(old not in page.read_text(encoding="utf-8") for page in pages.glob("*.md")):
        blocks = list(zip(old.split("\n\n"), new.split("\n\n"), strict=False))
    places = 0
    for page in sorted(pages.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        for before, after in blocks:
            if before and after and before in text:
                text, places = text.replace(before, after), places + 1
        page.write_text(text, encoding="utf-8")
    return places


def measure(name: str) -> bool:
    """Run the commands of a result and show it on the pages; whether all went well."""
    start, before = time.monotonic(), shown(name)
    for command in TABLE[name].commands:
        words = [
            str(RESULTS / name) if w == "F" else w.replace("=F", f"={RESULTS / name}") for w in shlex.split(command)
        ]
        if words[0] in ("python", "kcons"):
            words[:1] = [sys.executable, *(["-m", "kcons"] if words[0] == "kcons" else [])]
        print(f"== {shlex.join(words)}", flush=True)
        if subprocess.run(words, cwd=ROOT).returncode:
            print(f"== FAILED: {name}", file=sys.stderr)
            return False
    for old, new in zip(before, shown(name), strict=True):
        if old != new:
            print(f"== {follow(old, new, ROOT / 'docs')} places on pages show the new lines: read what is said of them")
    print(f"== {name} took {(time.monotonic() - start) / 60:.1f} minutes", flush=True)
    return True


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(TABLE)}")
    parser.add_argument("--stale", action="store_true", help="measure again what is stale")
    chosen = parser.parse_args(arguments)
    unknown = [name for name in chosen.names if name not in TABLE]
    if unknown:
        parser.error(f"no measurement is called {unknown[0]}; there are {', '.join(TABLE)}")
    names = chosen.names or list(TABLE)
    print("{:<30} {:>4} {:<10} {:<10} {:>4} {}".format("result", "min", "commit", "date", "bits", "state"))
    for name in names:
        print(row(name))
        if chosen.names:
            print("".join(f"    {command}\n" for command in TABLE[name].commands), end="")
    stale = [name for name in names if state(name) != "current"]
    again = [name for name in stale if not TABLE[name].by_hand]
    known = [TABLE[name].minutes for name in again]
    total = sum(m for m in known if m is not None)
    more = f" and {known.count(None)} of unknown length" if None in known else ""
    print(f"{len(stale)} of {len(names)} are stale; to measure {len(again)} again takes about {total:g} minutes{more}")
    for name in stale:
        if TABLE[name].by_hand:
            print(f"{name} is measured by hand: it {TABLE[name].by_hand}")
    if not chosen.stale:
        return 0
    return 0 if all([measure(name) for name in again]) else 1


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
