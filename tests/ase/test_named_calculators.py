"""Calculators by name."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.calculators.mixing import SumCalculator
from ase.constraints import ExternalForce, FixAtoms, Hookean

from kcons.ase.named_calculators import LISTED, described, named_calculator, refuse_unlisted
from kcons.errors import InputError


@pytest.mark.parametrize("name", ["no", "no.module:thing", "math:sqrt"])
def test_what_there_is_not_is_said(name):
    settings = "" if name == "no" else " with these settings"
    with pytest.raises(InputError, match=f"no calculator '{name}'{settings}.*gfn2, gfn1"):
        named_calculator(name, {"x": 1})


@pytest.mark.parametrize(("name", "typo", "known"), [("lj", "sgima", "sigma"), ("gfn1", "chrge", "charge")])
def test_settings_that_nothing_reads_are_refused(name, typo, known):
    if name == "gfn1":
        pytest.importorskip("tblite")
    with pytest.raises(InputError, match=rf"{name} has no setting '{typo}' .did you mean '{known}'"):
        named_calculator(name, {typo: 1})
    made = named_calculator(name, {known: 1}).parameters
    assert made[known] == 1 and made.get("method", "GFN1-xTB") == "GFN1-xTB"


def test_what_tells_calculators_from_each_other():
    """Also what atoms have that calculators read, and what adds forces."""
    lj = [LennardJones(epsilon=size) for size in (0.1, 0.2)]
    made = [(each, Atoms()) for each in (*lj, EMT(), *(SumCalculator([EMT(), each]) for each in lj))]
    adding = (ExternalForce(0, 1, 0.5), ExternalForce(0, 1, 0.6), Hookean(0, 1, 2.0, 1.0))
    made += [(EMT(), Atoms("H2", constraint=[FixAtoms([0]), item])) for item in adding]
    made += [(EMT(), Atoms("H2", **{name: [1.0, 0.0]})) for name in ("magmoms", "charges")]
    made += [(EMT(), Atoms("H2", info={"charge": charge})) for charge in (0, 1)]
    assert len({json.dumps(described(*each)) for each in made}) == len(made)
    for plain in (Atoms("H2", charges=[0.0, 0.0]), Atoms("H2", constraint=FixAtoms([0]))):
        assert described(EMT(), plain) == described(EMT(), Atoms())
    same = LennardJones(epsilon=np.float64(0.1))
    same.parameters["beside"] = {"b": object, "a": np.arange(2)}
    other = LennardJones(epsilon=0.1)
    other.parameters["beside"] = {"a": [0, 1], "b": object}
    assert described(same, Atoms()) == described(other, Atoms())
    by_pair = [LennardJones(), LennardJones()]
    for each, size in zip(by_pair, (1.0, 2.0), strict=True):  # names of all kinds, which JSON does not have
        each.parameters["pairs"] = {("Si", "C"): size, 3: np.float64(0.5), "rest": None}
    assert described(by_pair[0], Atoms()) != described(by_pair[1], Atoms())


@pytest.mark.parametrize("name", ["net.model", "FeH.eam.fs", "Cu.adp"])
def test_weights_in_a_file_belong_to_a_calculator(name, tmp_path):
    calculator, model, log = LennardJones(), tmp_path / name, tmp_path / "out.txt"
    model.write_bytes(b"weights")
    log.write_text("one")
    calculator.parameters.update(model=str(model), log=log)
    before = described(calculator, Atoms())
    log.write_text("another")
    assert json.dumps(described(calculator, Atoms())) == json.dumps(before)
    model.write_bytes(b"others!")
    assert described(calculator, Atoms()) != before


# -- what names a calculator may be somebody else ---------------------------------------------------

MODULE = """
from os import system
from ase.calculators.emt import EMT
import pathlib
pathlib.Path(__file__).with_suffix(".ran").touch()
number = 3

class Mine(EMT):
    pass

class Other:
    def __init__(self, command):
        system(command)

def made(asap_cutoff=False):
    return Mine(asap_cutoff=asap_cutoff)

def nothing(**settings):
    return None
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The name of a module, and a file that is there once it was imported."""
    (tmp_path / "calculators_of_mine.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    yield "calculators_of_mine", tmp_path / "calculators_of_mine.ran"
    sys.modules.pop("calculators_of_mine", None)


def test_a_name_a_class_or_a_function_makes_a_calculator(module):
    name, _ = module
    assert isinstance(named_calculator("emt"), EMT) and isinstance(named_calculator(f"{name}:Mine"), EMT)
    assert named_calculator("ase.calculators.lj:LennardJones", {"sigma": 2.0}).parameters.sigma == 2.0
    assert named_calculator(f"{name}:made", {"asap_cutoff": True}).parameters["asap_cutoff"] is True


@pytest.mark.parametrize("what", ["system", "Other", "nothing", "number", "pathlib", "EMT"])
def test_what_makes_no_calculator_is_refused(module, tmp_path, what):
    """Nor is what a module has from elsewhere called, nor a class that is none."""
    name, _ = module
    with pytest.raises(InputError, match=f"{name}:{what} (is no calculator of ASE, nor|makes no calculator of ASE)"):
        named_calculator(f"{name}:{what}", {"command": f"touch {tmp_path / 'shell'}"})
    assert not (tmp_path / "shell").exists()


def test_files_name_calculators_of_a_list_or_of_modules_that_their_reader_names(module):
    name, ran = module
    for listed in LISTED:
        refuse_unlisted(listed, ())
    with pytest.raises(InputError, match=f"the calculator '{name}:Mine' runs code of .*--allow-module {name} "):
        refuse_unlisted(f"{name}:Mine", ["another", f"{name}:Mine", f"{name}.more"])
    refuse_unlisted(f"{name}:Mine", [name])
    assert not ran.exists()  # nothing is imported
    # These start programs that their settings name.
    for program in ("cp2k", "aims", "lammpsrun"):
        with pytest.raises(InputError, match=f"--allow-module ase.calculators.{program} "):
            refuse_unlisted(program, ())
        refuse_unlisted(program, [f"ase.calculators.{program}"])
    for wrong in ("", ":", "os:", ":system", "gfn3", "os.path", "../os"):
        with pytest.raises(InputError, match=f"there is no calculator '{wrong}'"):
            refuse_unlisted(wrong, ["os", "os.path", "ase.calculators.gfn3"])
