"""Ensembles are values: equal if their settings are, and never changed."""

from __future__ import annotations

import numpy as np
import pytest
from openmm import unit
from openmm_systems import state_of
from tied_cluster import MASSES, thermostatted

from kcons.errors import InputError, UnsupportedError
from kcons.openmm import (
    Isokinetic,
    Langevin,
    ProjectedIntegrator,
)
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
def test_ensembles_are_values():
    shared = Langevin(300, 1.0)
    one, two = thermostatted(shared)(), thermostatted(shared)()
    one.integrator.setTemperature(500)
    one.integrator.setFriction(7)
    two.run()
    assert two.integrator.getGlobalVariableByName("kT") == GAS_CONSTANT * 300
    assert (shared.temperature, shared.friction) == (300, 1.0)
    assert one.integrator.getTemperature() == 500 * unit.kelvin
    assert one.integrator.getFriction() == 7 / unit.picosecond
    for value, name in ((shared, "temperature"), (shared, "friction"), (Isokinetic(300), "temperature")):
        with pytest.raises(UnsupportedError, match="setTemperature or setFriction"):
            setattr(value, name, 400.0)
    with pytest.raises(AttributeError):
        one.integrator.ensemble = shared
    with pytest.raises(UnsupportedError, match="setting of the integrator"):
        one.integrator.setGlobalVariableByName("kT", 3.0)
    assert Langevin(300, 1.0) == shared != Langevin(300, 2.0)
    assert len({Langevin(300, 1.0), shared, Isokinetic(300, atoms=[1, 2]), Isokinetic(300, atoms=[1, 2])}) == 2
    twins = Isokinetic(300), Isokinetic(300)
    made = [thermostatted(ensemble)() for ensemble in (twins[0], twins[0])]
    made[0].run()
    made[0].integrator.setTemperature(600)
    made[1].run(2)
    assert made[1].integrator.getTemperature() == 300 * unit.kelvin
    v = state_of(made[1].context)[1]
    count = twins[0].count(made[1].integrator)
    assert abs(MASSES @ np.sum(v**2, axis=1) / ((count - 1) * GAS_CONSTANT * 300) - 1) < 1e-12


def test_what_an_ensemble_lacks():
    plain, smooth = ProjectedIntegrator(0.002), ProjectedIntegrator(0.002, ensemble=Isokinetic(300))
    lacking = [(plain, name) for name in ("getTemperature", "setTemperature", "getFriction", "setFriction")]
    for one, name in (*lacking, (smooth, "getFriction"), (smooth, "setFriction")):
        assert not hasattr(one, name)
        with pytest.raises(UnsupportedError, match="ensemble=Langevin"):
            getattr(one, name)
    assert smooth.getTemperature() == 300 * unit.kelvin
    for wrong, match in (
        (lambda: Langevin(-1, 1), "temperature"),
        (lambda: Langevin(300 * unit.nanometer, 1), "give it in K"),
        (lambda: Langevin(300, 1 * unit.picosecond), "give it in 1/ps"),
        (lambda: Langevin(300, -1), "friction"),
        (lambda: Langevin(float("nan"), 1), "temperature"),
        (lambda: Isokinetic(0), "temperature"),
        (lambda: smooth.setTemperature(0), "temperature"),
        (lambda: smooth.setTemperature(3 * unit.nanometer), "give it in K"),
    ):
        with pytest.raises(InputError, match=match):
            wrong()
