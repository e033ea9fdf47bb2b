"""Warnings are errors; of deprecations only those that this package or its tests cause."""

from __future__ import annotations

import functools
import gc
import locale
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import hypothesis
import pytest

# There is a worker of pytest-xdist for each core. A library with threads of its own waits for them: OpenBLAS in every
# small matrix, tblite (OpenMP) in every step of nine atoms, OpenMM in every force. Set before they are loaded;
# processes that tests start have it as well.
for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENMM_CPU_THREADS"):
    os.environ.setdefault(threads, "1")

# Processes that tests start, which are many, need not translate kcons from its text again, each of them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# No test is timed: machines differ. The same examples in every run; `--hypothesis-profile default` tries others.
hypothesis.settings.register_profile("kcons", deadline=None, derandomize=True)
hypothesis.settings.load_profile("kcons")

HERE = Path(__file__).parent
LOCALE = locale.setlocale(locale.LC_ALL)
#: How long comparisons run what is to be timed, less than usual: no test looks at a time. What else they do stays.
LITTLE = {
    "bare_solvers": {"SAMPLING": 0.01},
    "kcons.comparison.measure": {"MORE_SECONDS": 0.01, "PASS_SECONDS": 1e-3},
}
#: The same of the package, of modules that were imported.
USUAL: dict[str, dict[str, object]] = {}
#: Modules of the package and of its tests, as they are called when they are imported.
FILES = list(HERE.rglob("*.py"))
#: Folders of tests that need a package which is not among the extras of `all`; `.ci/run` runs them in an environment of
#: their own.
NEEDS = {"batched": "torch", "torchsim": "torch_sim"}
collect_ignore = [folder for folder, package in NEEDS.items() if find_spec(package) is None]
OWN = sorted({"kcons", "tests"} | {path.parent.name if path.stem == "__init__" else path.stem for path in FILES})


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Workers take files one after another, not turns in each: what a module shares is made once."""
    if getattr(config.option, "numprocesses", None) and config.option.dist == "no":
        config.option.dist = "worksteal"


def pytest_report_header() -> list[str]:
    return [f"tests/{folder} is left out: {NEEDS[folder]} is not installed" for folder in collect_ignore]


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()  # during collection: nothing of it is garbage, and searches were two fifths of its time
    # What other packages warn of in their own modules, a newer Python or NumPy in most cases, is for them to mend.
    for kind in ("DeprecationWarning", "PendingDeprecationWarning", "FutureWarning", "SyntaxWarning"):
        config.addinivalue_line("filterwarnings", f"default::{kind}")
        config.addinivalue_line("filterwarnings", rf"error::{kind}:({'|'.join(OWN)})(\.|$)")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes seconds comes first: workers that take over what others have left then end together."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def pytest_collection_finish(session: pytest.Session) -> None:
    """What was collected stays to the end: no search through all objects has to see it, and searches are few."""
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture
def without_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where there is no compiler: a test of what the CustomIntegrator does."""
    from kcons.openmm.device import build

    monkeypatch.setattr(build, "refusal", lambda: "there is no C++ compiler")


@pytest.fixture(autouse=True)
def custom_integrators(request: pytest.FixtureRequest) -> None:
    """Whether the plugin was compiled here makes no difference, but to pages and tests with device in their names."""
    asked = "device" in request.node.nodeid or request.path.parent.name in ("pages", "studies")
    if getattr(find_spec("openmm"), "origin", None) and not asked:  # this folder has one of that name
        request.getfixturevalue("without_device")


def pytest_runtest_setup() -> None:
    # The Fourier transforms of OpenMM's OpenCL (VkFFT) leave the process in the C locale, in which texts are ASCII.
    locale.setlocale(locale.LC_ALL, LOCALE)
    if "openmm.app" in sys.modules:
        read_force_fields_once(sys.modules["openmm.app"])
    for name, amounts in LITTLE.items():
        if name in sys.modules and name not in USUAL:
            module = vars(sys.modules[name])
            USUAL[name] = {amount: module[amount] for amount in amounts}
            module.update(amounts)


@pytest.fixture
def usual_amounts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `LITTLE` changes is as the package has it."""
    for name, amounts in USUAL.items():
        for amount, value in amounts.items():
            monkeypatch.setattr(sys.modules[name], amount, value)


def read_force_fields_once(app: ModuleType) -> None:
    """Those that come with OpenMM: a second each, of many tests. Files of a test are read by it."""
    force_field = app.ForceField
    if not isinstance(force_field, type):
        return  # done
    once = functools.cache(force_field)
    data = Path(app.__file__).parent / "data"

    def read(*files: object) -> object:
        own = all(isinstance(file, str) and (data / file).is_file() for file in files)
        return (once if own else force_field)(*files)

    app.ForceField = read  # type: ignore[attr-defined]
