"""Where compiled kernels are kept, what is said of them, and what is not compiled."""

from __future__ import annotations

import ast
import logging
import os
import shutil
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from types import CodeType, ModuleType, SimpleNamespace

import numba
import numpy as np
import pytest
from numba.core import event

import kcons
from kcons.constraints import compilation
from kcons.constraints.compilation import MUCH, SMALL, Announcer, all_compiled, plain_if_small

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

#: A kernel that calls another one, of another module: what it moves, and whether it was compiled.
MOVES = """
import numpy as np
from kcons.thermostats.pressure.centre_moves import displacements
d = np.zeros((2, 3))
displacements(
    np.array([[0.1, 0, 0], [2.9, 0, 0]]), np.array([0, 0]), np.array([0.5, 0.5]), np.ones((1, 3), dtype=bool),
    np.array([1]), np.array([0]), np.array([3 * np.eye(3), np.eye(3) / 3]), 0.1 * np.eye(3), d,
)
print(abs(d[0, 0]).round(6), sum(displacements.stats.cache_misses.values()))
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


def test_kept_in_a_folder_and_announced_once(tmp_path):
    first, second = (ended(started(ONE_KERNEL, NUMBA_CACHE_DIR=str(tmp_path))) for _ in range(2))
    assert first[0] == "0 1"
    assert first[1].count("This happens once on a machine") == 1 and "kcons warmup" in first[1]
    assert second == ("1 0", "")


def test_two_processes_at_once(tmp_path):
    both = [started(ONE_KERNEL, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    assert {ended(process)[0] for process in both} <= {"0 1", "1 0"}
    assert ended(started(ONE_KERNEL, NUMBA_CACHE_DIR=str(tmp_path)))[0] == "1 0"


def test_processors_that_share_a_folder(tmp_path):
    """Each has its own kernels in it: what one has made is never run by the other."""
    other = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    for given, found in ((other, "0 1"), ({}, "0 1"), (other, "1 0"), ({}, "1 0")):
        assert ended(started(ONE_KERNEL, NUMBA_CACHE_DIR=str(tmp_path), **given))[0] == found


def test_nothing_can_be_written_to(tmp_path):
    """Neither the package's folder nor the home: kernels are kept for one process, and that is said."""
    package = copy_of_the_package(tmp_path)
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()  # where a folder would have to be: this stops root, too
    nowhere = str(tmp_path / "kcons" / "__init__.py" / "home")
    given = {"PYTHONPATH": str(tmp_path), "HOME": nowhere, "XDG_CACHE_HOME": nowhere, "TMPDIR": str(tmp_path)}
    out, err = ended(started(ONE_KERNEL, PYTHONDONTWRITEBYTECODE="1", **given))
    assert out == "0 1"
    assert "Set NUMBA_CACHE_DIR to a folder of yours" in err
    assert not list(tmp_path.glob("kcons-*")), "the folder of the process is removed"


def test_compiled_anew_when_a_kernel_that_it_calls_has_changed(tmp_path):
    called = copy_of_the_package(tmp_path) / "constraints" / "periodic" / "one_piece.py"
    given = {"PYTHONPATH": str(tmp_path)}
    assert [ended(started(MOVES, **given))[0] for _ in range(2)] == ["0.0 1", "0.0 0"]
    text = called.read_text()
    called.write_text(text.replace("        if na != 0.0 or nb_ != 0.0 or nc != 0.0:", "        if False:"))
    assert called.read_text() != text
    assert ended(started(MOVES, **given))[0] == "0.15 1"  # the second atom is where it is stored


def names_defined_by(source: Path) -> set[str]:
    found = set()
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
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
        module = import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
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

    thrice = numba.njit(lambda n: 3 * n)
    with all_compiled():
        assert plain_if_small(thrice, 1) is thrice
    given = [plain_if_small(thrice, SMALL) for _ in range(MUCH // SMALL + 3)]
    assert given[0] is thrice.py_func and given[-1] is thrice  # that was much in all


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
    assert {counts[f"kcons.plan.independent_blocks.{name}"] for name in ("_is_forest", "_edge_blocks")} == {"0"}
    assert set(counts.values()) <= {"0", "1"}


@pytest.mark.parametrize("before", ["", "gc.disable(); "], ids=["on", "off"])
def test_the_import_leaves_the_collector_of_garbage_as_it_was(before):
    code = f"import gc; {before}import kcons; print(gc.isenabled())"
    assert ended(started(code))[0] == str(not before)


# -- the announcement -------------------------------------------------------------------------------


def compiling(name: str):
    def kernel():
        pass

    kernel.__module__ = name
    return event.Event("numba:compile", event.EventStatus.START, {"dispatcher": SimpleNamespace(py_func=kernel)})


def test_announced_after_a_second_in_all(monkeypatch, caplog):
    monkeypatch.setattr(compilation, "PATIENCE", 0.5)
    announcer = Announcer()
    counted = 0.0

    def compiled(*kernels, until):
        begun = time.perf_counter()
        for kernel in kernels:
            announcer.on_start(kernel)
        while not until():
            time.sleep(0.01)
        for kernel in reversed(kernels):
            announcer.on_end(kernel)
        return time.perf_counter() - begun

    def passed(seconds):
        end = time.perf_counter() + seconds
        return lambda: time.perf_counter() > end

    kernel, other = compiling("kcons.solvers.chains"), compiling("numpy.linalg")
    with caplog.at_level(logging.WARNING, "kcons"):
        compiled(other, until=passed(0.6))  # nobody's business
        assert announcer.seconds == 0.0 and not announcer.compiling
        counted += compiled(kernel, until=lambda: True)
        time.sleep(0.6)  # between kernels no time is counted
        assert not caplog.messages
        counted += compiled(kernel, other, until=lambda: caplog.messages)  # one is a part of the other
        counted += compiled(kernel, until=passed(0.6))
    assert announcer.seconds == pytest.approx(counted, abs=0.05)
    assert len(caplog.messages) == 1 and "once on a machine" in caplog.messages[0]


def test_kernels_here_are_watched():
    before = compilation.announcer.seconds
    kernel = numba.njit(lambda y: y + 1)
    kernel.py_func.__module__ = "kcons.here"
    assert kernel(np.float32(1)) == 2
    assert compilation.announcer.seconds > before


def test_the_clock_stands_still_while_kernels_are_compiled():
    kernel = compiling("kcons.solvers.chains")
    whole, timed = time.perf_counter(), compilation.clock()
    for pause in (0.3, 0.1):
        if pause == 0.3:
            compilation.announcer.on_start(kernel)
        time.sleep(pause)
        if pause == 0.3:
            compilation.announcer.on_end(kernel)
    whole, timed = time.perf_counter() - whole, compilation.clock() - timed
    assert 0.1 <= timed < whole - 0.29
