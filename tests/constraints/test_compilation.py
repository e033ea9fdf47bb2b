"""Where compiled kernels are kept, what is said of them, and what is not compiled."""

from __future__ import annotations

import ast
import errno
import gc
import logging
import os
import shutil
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from types import CodeType, ModuleType

import numba
import numpy as np
import pytest

import kcons
from kcons.constraints import compilation
from kcons.constraints.compilation import SMALL, Announcer, njit, plain_if_small
from kcons.errors import MissingPackageError

#: Compiles one small kernel; says how many kernels came from the folder, and how many were compiled.
ONE_KERNEL = """
import numpy as np
from kcons.constraints import compilation
compilation.PATIENCE = 0.0
from kcons.constraints.periodic.one_piece import follow_parents
y = np.array([[0.1, 0, 0], [2.9, 0, 0]])
follow_parents(y, np.array([1]), np.array([0]), np.array([3 * np.eye(3), np.eye(3) / 3]))
assert np.allclose(y[1], [-0.1, 0, 0]), y
stats = follow_parents.stats
print(sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""

#: A kernel that calls another one, of another module: whether a bond holds through the boundary, and what was compiled.
HOLDS = """
import numpy as np
from kcons.solvers.distance_clusters import resolved
x, lattice = np.array([[0.1, 0, 0], [2.9, 0, 0]]), np.array([3 * np.eye(3), np.eye(3) / 3])
print(resolved(x, np.array([0, 1]), np.array([0.2]), lattice, 1), sum(resolved.stats.cache_misses.values()))
"""
PACKAGE = Path(kcons.__file__).parent


def copy_of_the_package(folder: Path) -> Path:
    copied = shutil.copytree(PACKAGE, folder / "kcons", ignore=shutil.ignore_patterns("__pycache__"))
    return Path(copied)


def started(code: str, **environment: str) -> subprocess.Popen[str]:
    given = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")} | environment
    given.setdefault("PYTHONPATH", str(Path(kcons.__file__).parents[1]))
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=given
    )


def ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out.strip(), err


#: A few hundred steps with kernels of several kinds: a digest of the last bits of each.
BITS = """
import hashlib
import numpy as np
from kcons import ConstraintSet, Motion
from kcons.constraints import Angle, Distance
start = np.array([[0, 0, 0], [2.4, 0, 0], [1.25, 2.2, 0], [1.25, 0.7, 2.0]])
masses = np.array([63.5, 40.0, 12.0, 1.0])
bonds = [[0, 1], [1, 2]]
for rows in ([Distance(bonds), Angle([[0, 1, 2]])], [Distance(bonds)]):
    motion, x = Motion(ConstraintSet(rows, start, masses), start), start
    v = motion.project_velocities(x, np.random.default_rng(0).normal(size=x.shape) * 0.05)
    bits = hashlib.sha256()
    for _ in range(200):
        v = v - 0.06 * (x - start) * (1 + x * x) / masses[:, None]
        x = motion.project_positions(x + 0.2 * v, x, velocities=v, dt=0.2)
        v = motion.project_velocities(x, v)
        bits.update(x.tobytes())
    print(bits.hexdigest()[:12])
"""


def test_the_run_that_compiles_gives_the_bits_of_those_that_load(tmp_path):
    first, second = (ended(started(BITS, NUMBA_CACHE_DIR=str(tmp_path)))[0] for _ in range(2))
    assert len(set(first.split())) == 2
    assert first == second


def test_a_kernel_calls_its_own_copies_of_others():
    @njit
    def called(y):  # too much to become a part of its caller
        total = 0.0
        for k in range(int(y)):
            total += np.sin(k * y) + np.sin(2 * y) * np.cos(3 * k * y) + np.exp(-k * y) * np.log(1 + k) + np.tan(y + k)
            total += np.sinh(y / (1 + k)) * np.cosh(y) + np.tanh(k * y) + np.arctan(k * y) + np.sqrt(1 + k * y)
            total += np.sin(4 * k * y) + np.sin(5 * y) * np.cos(6 * k * y) + np.exp(-7 * k * y) + np.tan(y + 8 * k)
        return total

    @njit
    def caller(y):
        return called(y) + called(2 * y)

    caller(3.0)
    (made,) = caller.overloads.values()
    copies = [f for f in made.library._final_module.functions if "called" in f.name and not f.is_declaration]
    assert copies and {f.linkage.name for f in copies} == {"internal"}
    shared = [f for f in made.library._get_module_for_linking().functions if "called" in f.name]
    assert {f.linkage.name for f in shared} == {"linkonce_odr"}  # one for all that a further caller links


def test_damaged_files_are_made_anew(tmp_path):
    given = {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert ended(started(ONE_KERNEL, **given))[0] == "0 1"
    for ending, part in (("nbi", 0.5), ("nbc", 0.0)):
        files = list(tmp_path.rglob(f"*.{ending}"))
        for file in files:
            content = file.read_bytes()
            file.write_bytes(content[: int(part * len(content))])
        assert files
        assert ended(started(ONE_KERNEL, **given))[0] == "0 1"
        assert ended(started(ONE_KERNEL, **given)) == ("1 0", "")


def test_a_number_given_twice_by_two_processes_gives_nobody_the_kernel_of_the_other(tmp_path):
    files = compilation._Files(str(tmp_path), "kernel", "source")
    files.save("one kind of arguments", "its code")
    files._save_index({"another kind": files._load_index()["one kind of arguments"]})
    assert files.load("another kind") is None
    files.save("another kind", "other code")
    assert files.load("another kind") == "other code"


def test_a_folder_that_is_full_costs_the_cache_and_not_the_run(tmp_path, monkeypatch, caplog):
    @njit(cache=True)
    def thrice(n):
        return 3 * n

    def full(self, key, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(compilation._Files, "save", full)
    compilation._say_once.cache_clear()
    with caplog.at_level(logging.WARNING, "kcons"):
        assert thrice(2) == 6 and thrice(2.0) == 6.0
    assert sum("No space left" in message for message in caplog.messages) == 1


def test_kernels_are_kept_in_a_folder_that_processors_share_and_announced_once(tmp_path):
    """Each has its own in it: what one has made is never run by the other."""
    other = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    for given, found in ((other, "0 1"), ({}, "0 1"), (other, "1 0"), ({}, "1 0")):
        out, err = ended(started(ONE_KERNEL, NUMBA_CACHE_DIR=str(tmp_path), **given))
        assert out == found
        assert [err.count(words) for words in ("once on a machine", "kcons warmup")] == 2 * [int(found[2])]


def test_nothing_can_be_written_to(tmp_path):
    """Neither the package's folder nor the home: a word, and not each process's own kernels."""
    package = copy_of_the_package(tmp_path)
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()  # where a folder would have to be: this stops root, too
    nowhere = str(tmp_path / "kcons" / "__init__.py" / "home")
    given = {"PYTHONPATH": str(tmp_path), "HOME": nowhere, "XDG_CACHE_HOME": nowhere, "TMPDIR": str(tmp_path)}
    process = started(ONE_KERNEL, PYTHONDONTWRITEBYTECODE="1", **given)
    assert "UnsupportedError: compiled kernels can be kept nowhere" in process.communicate(timeout=60)[1]
    assert ended(started(ONE_KERNEL, PYTHONDONTWRITEBYTECODE="1", NUMBA_CACHE_DIR=str(tmp_path), **given))[0] == "0 1"


def test_compiled_anew_when_a_kernel_that_it_calls_has_changed(tmp_path):
    called = copy_of_the_package(tmp_path) / "solvers" / "kernels" / "lattices.py"
    given = {"PYTHONPATH": str(tmp_path)}
    assert [ended(started(HOLDS, **given))[0] for _ in range(2)] == ["True 1", "True 0"]
    text = called.read_text()
    called.write_text(text.replace("r[n] - (i * a[n]", "r[n] - (0.0 * i * a[n]"))
    assert called.read_text() != text
    assert ended(started(HOLDS, **given))[0] == "False 1"  # the second atom is where it is stored


def names_defined_by(source: Path) -> set[str]:
    found = set()
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("numba"):
            found |= {alias.name for alias in node.names}  # kernels are kept for one version of Numba
        elif not isinstance(node, ast.Import | ast.ImportFrom):
            found |= {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    return found


def names_in(code: CodeType) -> set[str]:
    return set(code.co_names).union(*(names_in(part) for part in code.co_consts if isinstance(part, CodeType)))


def test_all_that_kernels_take_from_other_modules_is_known():
    """Functions and constants: each is defined in a module whose source the kernel is kept with."""
    kernels = 0
    for path in sorted(PACKAGE.rglob("*.py")):
        sources, _ = compilation.kernel_sources(path)
        if path not in sources:
            continue
        try:
            module = import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
        except MissingPackageError:
            continue
        defined = set().union(*(names_defined_by(source) for source in sources))
        for made in vars(module).values():
            function = getattr(made, "py_func", getattr(made, "_defn", None))
            if function is None or function.__module__ != module.__name__:
                continue
            kernels += 1
            for name in names_in(function.__code__) & function.__globals__.keys():
                used = function.__globals__[name]
                if isinstance(used, ModuleType):
                    of_kcons = used.__name__.startswith("kcons.")
                    assert not of_kcons or Path(str(used.__file__)) in sources, f"{module.__name__}: {name}"
                elif not str(getattr(used, "__module__", "kcons.")).startswith(
                    ("numba", "numpy", "llvmlite", "builtins")
                ):
                    assert name in defined, f"{module.__name__}.{function.__name__} takes {name} from elsewhere"
    assert kernels > 150


def test_without_compiling_there_is_a_word():
    process = started("from kcons import ConstraintSet", NUMBA_DISABLE_JIT="1")
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 1
    assert "UnsupportedError: NUMBA_DISABLE_JIT is set" in err and "unset it" in err


def test_little_work_is_left_to_python():
    @numba.njit
    def twice(n):
        return 2 * n

    assert plain_if_small(twice, SMALL) is twice.py_func
    assert plain_if_small(twice, SMALL + 1) is twice
    assert twice(1) == 2
    assert plain_if_small(twice, 1) is twice  # it is there


def test_a_small_molecule_needs_its_numerics_only():
    """What orders its rows is left to Python; kernels are made for one kind of arguments."""
    code = """
import numpy as np
from kcons import ConstraintSet, Motion
from kcons.constraints import Angle, Distance
x = np.array([[0, 0, 0], [1.5, 0, 0], [2, 1.4, 0], [3.5, 1.4, 0.5]])
Motion(ConstraintSet([Distance([[0, 1], [1, 2], [2, 3]]), Angle([[0, 1, 2], [1, 2, 3]])], x, np.ones(4)), x)
import numba, sys
for module in [module for name, module in sys.modules.items() if name.startswith("kcons.")]:
    for name, kernel in vars(module).items():
        if isinstance(kernel, numba.core.registry.CPUDispatcher) and kernel.py_func.__module__ == module.__name__:
            print(f"{module.__name__}.{name}", len(kernel.signatures))
"""
    counts = dict(line.split() for line in ended(started(code))[0].splitlines())
    assert counts.pop("kcons.solvers.sparse.mixed_rows._tangents") == "1"
    assert {counts[f"kcons.solvers.sparse.elimination.{name}"] for name in ("_minimum_degree", "_finish")} == {"0"}
    assert {counts[f"kcons.plan.clusters.{name}"] for name in ("_edge_blocks",)} == {"0"}
    assert set(counts.values()) <= {"0", "1"}


# -- the announcement -------------------------------------------------------------------------------


def test_announced_after_a_second_in_all(monkeypatch, caplog):
    monkeypatch.setattr(compilation, "PATIENCE", 0.2)
    announcer, counted = Announcer(), 0.0
    with caplog.at_level(logging.WARNING, "kcons"):
        for seconds, messages in ((0.1, 0), (0.15, 0), (0.0, 1), (0.1, 1)):
            time.sleep(0.3)  # between kernels no time is counted
            begun = time.perf_counter()
            with announcer.watching(), announcer.watching():  # one is a part of the other
                assert len(caplog.messages) == messages and announcer.compiling and not gc.isenabled()
                time.sleep(seconds)
            assert gc.isenabled()
            counted += time.perf_counter() - begun
    assert not announcer.compiling and announcer.seconds == pytest.approx(counted, abs=0.05)
    assert "once on a machine" in caplog.messages[0]


def test_kernels_here_are_watched_and_the_clock_stands_still_meanwhile():
    before, whole, timed = compilation.announcer.seconds, time.perf_counter(), compilation.clock()
    assert numba.njit(lambda y: y + 2)(np.float32(1)) == 3  # nobody's business
    assert compilation.announcer.seconds == before
    assert njit(lambda y: y + 1)(np.float32(1)) == 2
    taken = compilation.announcer.seconds - before
    whole, timed = time.perf_counter() - whole, compilation.clock() - timed
    assert taken > 0 and whole - timed == pytest.approx(taken, abs=1e-3) and timed > 0
