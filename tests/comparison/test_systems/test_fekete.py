"""Particles that come to rest at the least energy known."""

from __future__ import annotations

import pytest

from kcons.comparison import METHODS, compare, test_systems
from kcons.comparison.test_systems.fekete import OPTIMA
from kcons.errors import InputError

#: Thomson's problem, as everyone has it.
PUBLISHED = {4: 3.674234614, 6: 9.985281374, 12: 49.165253058, 20: 150.881568334}


def test_optima_are_the_published_ones():
    assert set(OPTIMA) == set(PUBLISHED)
    for size, energy in PUBLISHED.items():
        assert OPTIMA[size] == pytest.approx(energy, abs=6e-10)


@pytest.mark.parametrize("size", OPTIMA)
def test_every_size_finds_its_optimum(size):
    system = test_systems.build("fekete", size)
    found = compare(system.with_time_steps([0.16]), methods=["rattle"])
    assert list(found.error) == [pytest.approx(0.0, abs=1e-8)]
    assert found.attrs["reference"].startswith("the least energy known")
    assert system.deviation(system.positions, system.positions) > 0.01  # energy, not distance


def test_sizes_without_a_known_optimum_are_refused():
    with pytest.raises(InputError, match="4, 6, 12, 20"):
        test_systems.build("fekete", 5)


def test_methods_without_friction_refuse():
    system = test_systems.build("fekete")
    for name in ("ase-kcons", "ase-bonds", "openmm-verlet"):
        assert "friction" in METHODS[name].refuses(system)
    for name in ("rattle", "kahan-li6", "dop853"):
        assert METHODS[name].refuses(system) is None
