"""What all thermostats have in common: constraints, restarts, marches, refusals, words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import (
    TWO,
    distance,
    dumbbells,
    loaded,
    molecules,
    quartic,
    quartic_potential,
    springs,
    waves,
    waves_potential,
)

from kcons.errors import ConvergenceError, InputError, NonFiniteError, UnsupportedError
from kcons.steppers import Rattle, System, run
from kcons.thermostats import (
    ForceGroups,
    HamiltonianMonteCarlo,
    Isokinetic,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    NoseHooverChain,
    thermal_velocities,
)

FIELDS = ("positions", "velocities", "forces", "thermostat", "time")
BATHS = {
    "Langevin": lambda seed: Langevin(0.5, 1.0, seed),
    "LangevinRespa": lambda seed: LangevinRespa(0.5, 1.0, seed, steps=TWO),
    "LangevinRespa, middle": lambda seed: LangevinRespa(0.5, 1.0, seed, steps=TWO, slow_kicks="middle"),
    "IsokineticSpheres": lambda seed: IsokineticSpheres(0.5, 1.0, seed, steps=TWO),
    "IsokineticSpheres, middle": lambda seed: IsokineticSpheres(0.5, 1.0, seed, steps=TWO, slow_kicks="middle"),
    "HamiltonianMonteCarlo": lambda seed: HamiltonianMonteCarlo(0.5, (1, 4), seed, keep=0.3),
    "NoseHooverChain": lambda seed: NoseHooverChain(0.5, 1.0),
    "Isokinetic": lambda seed: Isokinetic(0.5),
    "Isokinetic of order 4": lambda seed: Isokinetic(0.5, order=4),
}
NOISY = [name for name in BATHS if not name.startswith(("Nose", "Isokinetic of")) and name != "Isokinetic"]
EVERY = pytest.mark.parametrize("name", BATHS)


def begun(name="bent"):
    """Molecules and an ion under forces of two groups."""
    held, state = molecules(name, 3, ions=1)
    forces = ForceGroups({"fast": waves, "slow": lambda x, t: 0.3 * quartic(x)})
    potential = lambda x, t: waves_potential(x) + 0.3 * quartic_potential(x)  # noqa: E731
    return System(held.motion, forces, potential=potential), state


def same(a, b):
    return all(
        np.array_equal(getattr(a, field), getattr(b, field)) for field in FIELDS if getattr(a, field) is not None
    )


@EVERY
def test_everything_stays_on_the_constraints(name):
    held, state = begun("triangles")
    end = run(held, state, 0.05, 30, stepper=BATHS[name](3))
    rows = held.motion.constraint_set
    assert distance(end, state) > 0.05
    assert np.abs(rows.value(end.positions)).max() <= 1e-13
    assert np.abs(rows.jacobian(end.positions) @ end.velocities.ravel()).max() <= 1e-13


@EVERY
def test_a_run_goes_on_to_the_last_bit(name):
    """From a state in memory and from a file; noise is a function of the seed and of the number of the step."""
    held, state = begun()
    half = run(held, state, 0.05, 12, stepper=BATHS[name](3))
    whole = run(held, half, 0.05, 12, stepper=BATHS[name](3))
    assert same(run(begun()[0], loaded(half), 0.05, 12, stepper=BATHS[name](3)), whole)
    if name in NOISY:
        for other, seed in ((half, 4), (replace(half, step=0), 3)):
            assert distance(run(held, other, 0.05, 12, stepper=BATHS[name](seed)), whole) > 1e-3


@EVERY
def test_a_run_is_its_steps_one_by_one_and_changes_no_array(name):
    held, state = begun()
    stepper = BATHS[name](3)
    state = one = stepper.step(held, state, 0.05)
    arrays = [getattr(state, field) for field in FIELDS if isinstance(getattr(state, field), np.ndarray)]
    before = [array.copy() for array in arrays]
    for array in arrays:
        array.flags.writeable = False
    for _ in range(7):
        one = stepper.step(held, one, 0.05)
    assert same(run(held, state, 0.05, 7, stepper=BATHS[name](3)), one)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))


@EVERY
def test_steps_and_systems_that_cannot_be(name):
    held, state = begun()
    stepper = BATHS[name](3)
    with pytest.raises(UnsupportedError):
        stepper.step(System(held.motion, lambda x, v, t: -v, velocity_dependent=True), state, 0.1)
    broken = {key: lambda x, t: np.nan * x for key in ("fast", "slow")}
    if name != "HamiltonianMonteCarlo":
        with pytest.raises(NonFiniteError, match=r"non-finite force at step [01]"):
            stepper.step(System(held.motion, ForceGroups(broken)), state, 0.1)
        with pytest.raises((ConvergenceError, InputError), match="step 1: "):
            stepper.step(held, state, 900.0)
    if name == "NoseHooverChain":
        with pytest.raises(NonFiniteError, match="non-finite velocity at step 1 on atom 0"):
            stepper.step(held, replace(state, velocities=np.nan * state.velocities), 0.1)
    if name in NOISY:
        with pytest.raises(InputError, match="noise cannot be taken back"):
            stepper.step(held, state, -0.1)
    with pytest.raises(InputError, match="variables of another thermostat"):
        stepper.step(held, replace(state, thermostat=np.zeros(77)), 0.1)
    after = stepper.step(held, state, 0.1)
    still = stepper.step(held, after, 0.0)
    assert np.array_equal(still.positions, after.positions) and np.array_equal(still.velocities, after.velocities)


RESPA = {"": {"steps": TWO}, ", three": {"steps": {"slow": 1, "medium": 2, "fast": 6}}}
RESPA[", middle"] = {"steps": TWO, "slow_kicks": "middle"}
MIDDLE = IsokineticSpheres(0.5, 1e-32, 3, steps=TWO, slow_kicks="middle"), IsokineticSpheres(0.5, 1e-32, 3)
SPHERES = [{"spheres": kind} for kind in ("split", "axes", "cluster", "global")]
#: Without noise, and what they come near to: one step for all forces.
SILENT = {
    "NoseHooverChain": (NoseHooverChain(0.5, 1.0),) * 2,
    "Langevin": (Langevin(0.5, 0.0, 3, substeps=4), Rattle()),
    **{f"Respa{key}": (LangevinRespa(0.5, 0.0, 3, **more), Langevin(0.5, 0.0, 3)) for key, more in RESPA.items()},
    **{k["spheres"]: [IsokineticSpheres(0.5, 1e-32, 3, **k, **more) for more in ({"steps": TWO}, {})] for k in SPHERES},
    "spheres, middle": MIDDLE,
}


@pytest.mark.parametrize("name", SILENT)
def test_without_noise_it_is_of_order_two(name):
    stepper, plain = SILENT[name]
    held, x = dumbbells(2)
    groups = {"fast": springs, "medium": lambda x, t: 0.1 * quartic(x), "slow": lambda x, t: 0.3 * waves(x)}
    named = [name for name in getattr(stepper, "names", ()) if name] or groups
    split = System(held.motion, ForceGroups({name: groups[name] for name in named}))
    state = held.initial_state(x, 0.5 * np.random.default_rng(1).normal(size=x.shape), project=True)
    counts = (16, 32, 64)
    known = run(split, state, 1 / 1024, 1024, stepper=plain).positions
    errors = [np.abs(run(split, state, 1 / n, n, stepper=stepper).positions - known).max() for n in counts]
    assert np.diff(-np.log2(errors)) == pytest.approx([2, 2], abs=0.2)


@pytest.mark.parametrize(
    ("thermostat", "away", "spread", "slope"),
    [(Isokinetic(0.5), 0.0, 2e-3, 3e-5), (NoseHooverChain(0.5, 1.0), 1.2, 5e-3, 1e-5)],
    ids=["isokinetic", "chain"],
)
def test_conserved_energy_has_no_slope(thermostat, away, spread, slope):
    """But for what a random walk leaves; a thermostat that leaks energy shows 1e-3 and more."""
    held, x = dumbbells(2, force=quartic, potential=quartic_potential)
    x = x - away
    state = thermostat.start(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)))
    values = []
    look = lambda s: values.append(thermostat.conserved_energy(held, s))  # noqa: E731
    run(held, state, 0.01, 20_000, stepper=thermostat, observers=[look], every=20)
    assert np.std(values) <= spread
    assert abs(np.polyfit(np.linspace(0, 200, len(values)), values, 1)[0]) <= slope
