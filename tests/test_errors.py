"""Errors: caught as the built-in that fits, and carrying their data in plain numbers."""

from __future__ import annotations

import inspect
import pickle

import numpy as np
import pytest

from kcons import errors
from kcons.errors import ConvergenceError, InputError, KconsError, SingularGeometryError

KINDS = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_one_root_beside_a_built_in(kind):
    assert issubclass(kind, KconsError)
    assert kind is KconsError or issubclass(kind, ValueError | RuntimeError | FloatingPointError | ImportError)
    assert inspect.getdoc(kind)
    error = kind("what, and what to do")
    assert str(error) == "what, and what to do" and (error.atoms, error.step) == ((), None)
    with pytest.raises(AttributeError, match="atmos"):
        kind("what is misspelled", atmos=[1])


def test_data_are_plain_numbers():
    error = InputError("no", item="masses", atoms=np.array([3, 4]))
    assert error.item == "masses" and error.atoms == (3, 4) and type(error.atoms[0]) is int
    error = SingularGeometryError("no", rows=np.array([2]), atoms=(np.int64(1),))
    assert error.rows == (2,) and error.atoms == (1,) and type(error.rows[0]) is int


def test_errors_come_back_from_other_processes():
    error = pickle.loads(pickle.dumps(ConvergenceError("no", row=4, atoms=[1, 2], step=9)))
    assert str(error) == "no" and (error.row, error.atoms, error.step) == (4, (1, 2), 9)
    assert np.isnan(error.residual) and (error.cluster, error.positions) == (-1, None)
    assert pickle.loads(pickle.dumps(InputError("no", item="Sphere: center"))).item == "center"


def test_a_missing_extra_is_named():
    found = errors.with_extra(ModuleNotFoundError("no", name="openmm"), "kcons.openmm")
    assert isinstance(found, errors.MissingPackageError) and isinstance(found, ModuleNotFoundError)
    said = "which is not installed, or not in this version: python -m pip install --upgrade 'kcons[openmm]'"
    assert str(found) == f"kcons.openmm needs openmm, {said}" and found.name == "openmm"
    newer = errors.with_extra(ModuleNotFoundError("no", name="openmm.newer"), "kcons.openmm")
    assert str(newer).startswith("kcons.openmm needs openmm.newer, which is not")
    assert errors.with_extra(found, "other") is found
    own = ModuleNotFoundError("no", name="kcons.nothing")
    assert errors.with_extra(own, "other") is own


def test_extras_are_those_of_the_package():
    import tomllib
    from pathlib import Path

    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for package, extra in errors.EXTRAS.items():
        listed = project["optional-dependencies"][extra]
        distribution = package.lower().replace("_", "-")
        assert any(entry.lower().startswith(distribution) for entry in listed), (package, extra)
    needed = " ".join(project["dependencies"]).lower()
    assert not [package for package in errors.EXTRAS if package.lower() in needed]


@pytest.mark.parametrize(
    ("module", "package"),
    [("kcons.ase", "ase"), ("kcons.openmm", "openmm"), ("kcons.mdanalysis", "MDAnalysis")],
)
def test_a_folder_without_its_md_engine_names_the_extra(module, package, monkeypatch):
    import sys
    from importlib import import_module

    gone = [name for name in sys.modules if f"{name}.".startswith((f"{module}.", f"{package}."))]
    for name in gone:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(errors.MissingPackageError, match=rf"kcons\[{package.lower()}\]"):
        import_module(module)


def test_did_you_mean():
    known = ["rattle", "suzuki4", "Water"]
    assert errors.did_you_mean("ratle", known) == " (did you mean 'rattle'?)"
    assert errors.did_you_mean("watr", known) == " (did you mean 'Water'?)"
    assert errors.did_you_mean("xyz", known) == ""
