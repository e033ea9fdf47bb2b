"""Systems with expensive and cheap forces: the same where atoms are near, of the same atoms, or refused."""

from __future__ import annotations

import pytest
from ase import units

from kcons.comparison import fluid, test_systems
from kcons.comparison.averages.layers import of_fluid, of_test_systems
from kcons.errors import InputError

FS = units.fs


@pytest.fixture(scope="module")
def layers():
    return of_fluid(fluid.water(27), 3.8, sweeps=1000, inner=2 * FS)


def test_cheap_and_expensive_forces(layers):
    """The same where molecules are near, and different where they are far."""
    x = layers.positions
    cheap, expensive = layers.fast.watched(x), layers.slow.watched(x)
    assert 0 < abs(cheap[0] - expensive[0]) < abs(expensive[0])
    assert layers.molecules == 27 and layers.reference.error < 0.8
    assert [layers.inner_steps(dt * FS) for dt in (1, 2, 4, 6.1)] == [1, 1, 2, 4]


def test_two_test_systems():
    """Molecules with expensive and with cheap forces, which have to be of the same atoms and rows."""
    one = test_systems.build("butane")
    both = of_test_systems(one, one)
    assert both.thermal_energy == pytest.approx(300 * units.kB) and both.reference is None
    with pytest.raises(InputError, match="different atoms"):
        of_test_systems(one, test_systems.build("rotor"))


def test_bad_input():
    with pytest.raises(InputError, match=r"cheap forces reach 1\.5; give less than 1\.5"):
        of_fluid(fluid.dumbbells(8), 1.5, 1.5)
    with pytest.raises(InputError, match=r"molecules touch up to 2\.3 apart: take more of them"):
        of_fluid(fluid.dumbbells(8), 1.0)
