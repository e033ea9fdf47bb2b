"""Lines of code for a method on a test system: they run, to the end of the trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.methods import methods, snippets
from kcons.comparison.work_precision import measure
from kcons.errors import InputError

CHAIN = 'test_systems.build("chain", 4)'


@pytest.fixture(scope="module")
def chain():
    return test_systems.build("chain", 4)


@pytest.fixture(scope="module")
def reference(chain):
    return chain.reference()


@pytest.mark.parametrize("name", ["rattle", "blanes-moan6", "ase-kcons", "ase-bonds", "ase-internals", "dop853"])
def test_lines_of_code_run_to_the_end_of_the_trajectory(chain, reference, name):
    method = methods.METHODS[name]
    setting = 1e-6 if method.adaptive else 2.5
    text = snippets.code(chain, name, setting, CHAIN)
    space = {}
    exec(compile(text, name, "exec"), space)
    if name == "dop853":
        end = space["end"].y[:15, -1].reshape(5, 3)
    elif name == "ase-internals":
        end = space["run"].positions
    else:
        end = space["atoms"].positions
    internal = setting if method.adaptive else setting * chain.units.time_unit
    wanted = measure.Bench(chain, reference, 20.0).measure(method, internal).error
    assert chain.deviation(end, reference.positions) == pytest.approx(wanted, rel=0.05, abs=1e-12)


def test_lines_of_code_on_arrays():
    system = test_systems.build("sphere", 2)
    text = snippets.code(system, "suzuki4", 0.2, 'test_systems.build("sphere", 2)')
    space = {}
    exec(compile(text, "suzuki4", "exec"), space)
    assert np.abs(space["end"].positions - system.reference().positions).max() < 1e-4


@pytest.mark.parametrize("name", ["extrapolation", "multistep"])
def test_lines_of_code_of_adaptive_steps(name):
    system = test_systems.build("dumbbells")
    text = snippets.code(system, name, 1e-8, 'test_systems.build("dumbbells")')
    space = {}
    exec(compile(text, name, "exec"), space)
    assert f"{name.capitalize()}(1e-08)" in text and space["end"].time == system.horizon
    assert 0 < np.abs(space["end"].positions - system.reference().positions).max() < 1e-5


@pytest.mark.parametrize(
    "name", ["openmm-verlet", "openmm-middle", "openmm-rattle-1e-6", "openmm-kcons-blanes-moan4", "openmm-held-rattle"]
)
def test_lines_of_code_in_openmm(chain, name):
    pytest.importorskip("openmm")
    text = snippets.code(chain, name, 1.25, CHAIN)
    space = {}
    exec(compile(text, name, "exec"), space)
    state = space["context"].getState(positions=True)
    end = np.array(state.getPositions(asNumpy=True)._value) / chain.openmm.length
    assert chain.deviation(end, chain.reference().positions) < 2e-3


def test_lines_of_code_of_an_unknown_method(chain):
    with pytest.raises(InputError, match="no method"):
        snippets.code(chain, "nothing", 1.0, CHAIN)
