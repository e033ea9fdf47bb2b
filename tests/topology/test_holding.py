"""The options for what is held: one set of them in every MD engine, documented once."""

from __future__ import annotations

import inspect
from dataclasses import fields

import numpy as np
import pytest

import kcons.ase
import kcons.mdanalysis
import kcons.openmm
from kcons.errors import InputError
from kcons.topology import Holding
from kcons.topology.holding import Options

ENGINES = [kcons.ase.constraints_of, kcons.mdanalysis.constraints_of, kcons.openmm.constraints_of]


def test_options_of_the_signature_are_those_of_the_object():
    assert {field.name for field in fields(Holding)} == {"constrain", *Options.__annotations__}


@pytest.mark.parametrize("function", ENGINES, ids=lambda f: f.__module__)
def test_help_shows_every_option_with_its_default(function):
    shown = inspect.signature(function).parameters
    page = inspect.getdoc(function)
    assert "**options" not in page
    for field in fields(Holding):
        assert shown[field.name].default == field.default
        assert page.count(f"\n{field.name} : ") == 1
    # The parameters of the function itself come first, what it returns and raises last.
    assert page.index("rigid_water :") > page.index("Parameters\n")
    assert page.index("guess_bonds :") < page.index("Returns\n") < page.index("Raises\n")


def test_iterables_are_read_once():
    holding = Holding("none", rigid_bodies=iter([[0, 1, 2]]), rigid_residues=iter(["HOH"]), rigid_water=False)
    assert holding.bodies == holding.bodies == ([0, 1, 2],)
    assert holding.residues == holding.residues == ("HOH",)
    assert Holding("none", rigid_residues="HOH").residues == ("HOH",)


def test_geometry_of_water():
    assert Holding().geometry() == (None, 0.0)
    assert Holding(water_geometry="TIP4P/2005").geometry() == ((0.9572, 104.52), 0.1546)
    assert Holding(water_geometry=(1, 109)).geometry() == ((1.0, 109.0), 0.0)
    with pytest.raises(InputError, match="give a positive length"):
        Holding(water_geometry=(np.nan, 109)).geometry()
    assert Holding(rigid_water=False).waters == frozenset()
    assert "MINE" in Holding(water_names=[" mine "]).waters


@pytest.mark.parametrize("on", [{"protein": "CenterOfMass"}, [("protein", None)], ["protein"], [1]])
def test_own_rows_that_cannot_be_made(on):
    with pytest.raises(InputError, match=r"on has .*give pairs .*CenterOfMass itself") as caught:
        Holding(on=on)
    assert caught.value.item == "on"
