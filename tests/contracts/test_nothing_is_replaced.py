"""Importing kcons replaces nothing that is not its own, and adds nothing to a class."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

SCRIPT = '''
import importlib, json, pkgutil, sys, types

THEIRS = ["openmm", "openmm.app", "openmm.unit", "ase", "ase.constraints", "ase.md", "ase.optimize", "ase.io",
          "ase.md.verlet", "ase.md.langevin", "ase.md.velocitydistribution", "ase.filters", "ase.calculators.emt",
          "MDAnalysis", "MDAnalysis.analysis.base", "numpy", "numpy.linalg", "numexpr"]  # numexpr adds to numpy
OPEN = {("ase.constraints", "KconsConstraints")}  # by which ASE opens files

there = []
for name in THEIRS:
    try:
        there.append(importlib.import_module(name))
    except ModuleNotFoundError:
        continue
roots = {module.__name__.partition(".")[0] for module in there}


def spaces():
    """Namespaces of modules and classes, by their own names."""
    for name, module in sorted(sys.modules.items()):
        if module is None or name.partition(".")[0] not in roots or not isinstance(module, types.ModuleType):
            continue
        yield name, vars(module)
        for thing in list(vars(module).values()):
            if isinstance(thing, type) and getattr(thing, "__module__", "").partition(".")[0] in roots:
                yield f"{thing.__module__}.{thing.__qualname__}", vars(thing)


before = {}
for name, space in spaces():
    before.setdefault(name, (space, dict(space)))
import kcons
for found in pkgutil.walk_packages(kcons.__path__, "kcons."):
    try:
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
    except ModuleNotFoundError:
        continue
changed = []
for name, (space, was) in before.items():
    module = name in sys.modules
    for key, value in was.items():
        if key.startswith("__") and key in ("__warningregistry__", "__annotations_cache__"):
            continue
        if (name, key) not in OPEN and space.get(key) is not value:
            changed.append(f"{name}.{key} is another")
    for key in space.keys() - was.keys():
        # A module that is imported becomes an attribute of its package; Python keeps warnings and caches of its own.
        imported = module and f"{name}.{key}" in sys.modules
        if (name, key) in OPEN or imported or key in ("__warningregistry__", "__abstractmethods__", "__annotations__"):
            continue
        if module and isinstance(space[key], types.ModuleType):
            continue
        changed.append(f"{name}.{key} is new")
ours = sorted(name for name in sys.modules if name.startswith("kcons."))
print(json.dumps({"looked at": len(before), "changed": changed, "kcons": ours}))
'''


@pytest.mark.slow
def test_every_namespace_is_as_it_was():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", SCRIPT], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["looked at"] > 500
    assert {"kcons.openmm.integrator.guard", "kcons.ase", "kcons.mdanalysis"} <= set(found["kcons"])
    assert found["changed"] == []
