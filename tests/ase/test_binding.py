"""One engine for masses, cell and company, and edits of atoms: what is noticed, refused, or put right."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from time import sleep

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import ExternalForce, FixAtoms, FixBondLengths, FixCartesian, FixCom, FixedMode, FixedPlane
from ase.md.langevinbaoab import LangevinBAOAB
from ase.md.melchionna import MelchionnaNPT
from ase.md.nose_hoover_chain import NoseHooverChainNVT
from ase.md.npt import NPT
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import BFGS, FIRE
from ase_systems import (
    FS,
    OF_ASE,
    TEMPERATURE,
    Field,
    Free,
    dumbbells,
    equal,
    loose_waters,
    off,
    random,
    rigid,
    state,
    water,
    water_gas,
)

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstrainedNoseHoover,
    Constraints,
    MultipleTimeSteps,
    attach,
    constrain,
    draw_velocities,
    rigid_water,
)
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, Sphere
from kcons.errors import InputError, UnsupportedError


@pytest.mark.parametrize(
    "other",
    [
        *(FixAtoms([0]), FixBondLengths([[0, 4]]), FixedPlane([1], (0, 0, 1)), FixCartesian([2])),
        Constraints(Distance([2, 4])),
        FixedMode(np.eye(6)[:, :3]),  # of atoms 0, 1 and 2; it says itself that it acts on none
    ],
    ids=lambda v: type(v).__name__,
)
@pytest.mark.parametrize("first", [True, False])
def test_company_on_the_same_atoms_is_refused(other, first):
    atoms, held = rigid(2)
    held.restore(atoms)
    atoms.set_constraint([held, other] if first else [other, held])
    before = atoms.positions.copy()
    with pytest.raises(UnsupportedError, match=f"{type(other).__name__} acts on atom.*if kcons has a counterpart"):
        atoms.set_positions(before + np.random.default_rng(0).normal(scale=0.01, size=(6, 3)))
    assert np.array_equal(atoms.positions, before)
    with pytest.raises(UnsupportedError):
        atoms.get_forces()
    if not isinstance(other, FixedMode):
        attach(atoms)  # as it is told
        atoms.get_forces()


def test_fix_com_is_welcome_but_beside_a_surface():
    atoms, held = rigid(2)
    atoms.set_constraint([held, FixCom()])
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, 1 * units.fs).run(10)
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 12 - 3
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    held = constrain(atoms, Sphere([0], [0, 0, 0]))
    atoms.set_constraint([FixCom(), held])
    with pytest.raises(UnsupportedError, match=r"FixCom acts on atom 0"):
        atoms.set_momenta(np.ones((2, 3)))


def test_momenta_without_the_force_of_company():
    """ASE adds that of ExternalForce to all momenta that are set: dynamics gain 400 eV in 40 fs."""
    atoms, held = rigid(2)
    before = atoms.get_momenta()
    atoms.set_constraint(ExternalForce(0, 3, 0.5))
    constrain(atoms, held.constraints)
    assert atoms.get_momenta() == pytest.approx(before, abs=1e-14)
    with pytest.raises(UnsupportedError, match="adds the force of ExternalForce to all momenta that are set"):
        atoms.set_momenta(before)


def test_copies_in_cells_of_their_own():
    """Centers that nothing ties together, whose images are followed over a tenth of a cell vector and no more."""
    atoms = loose_waters(2)
    atoms.cell, atoms.pbc = np.full(3, 12.0), True
    constrain(atoms, [rigid_water(atoms), CenterDistance([0, 1, 2], [3, 4, 5])])
    images = [atoms.copy() for _ in range(3)]
    for image, factor in zip(images, (0.92, 1.0, 1.08), strict=True):
        image.set_cell(factor * atoms.cell)
    for seed in range(2):
        for image in images:
            image.set_positions(image.positions + np.random.default_rng(seed).normal(scale=0.01, size=(6, 3)))
            assert off(image, image.constraints[0]) <= 1e-14
    assert len({id(image.constraints[0].engine(image)) for image in images}) == 3
    assert np.array_equal(atoms.constraints[0].engine(atoms).cell()[0], atoms.cell.array)


def test_copies_are_asked_in_turn(monkeypatch):
    """Threads, as those of NEB(parallel=True), would write into the tables of the engine that copies share."""
    atoms, asked = molecule("CO"), Lock()
    motion = constrain(atoms, Distance([0, 1])).engine(atoms)

    def alone(x, forces, out):
        assert asked.acquire(blocking=False)
        sleep(0.05)
        asked.release()

    monkeypatch.setattr(motion, "project_forces", alone)
    with ThreadPoolExecutor(3) as pool:
        images = [atoms.copy() for _ in range(3)]
        list(pool.map(lambda image: image.constraints[0].adjust_forces(image, np.ones((2, 3))), images))


def test_cells_that_are_set():
    """The engine goes on in a new one; one that is too small is refused before it is set."""
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    engine, x = held.engine(atoms), atoms.get_positions()
    with pytest.raises(InputError, match=r"Distance.*half the box"):
        atoms.set_cell([6, 3, 6], scale_atoms=True)
    assert atoms.cell.lengths().tolist() == [6, 6, 6]
    assert np.array_equal(atoms.positions, x)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(3)
    atoms.set_cell([6.1, 6, 5.9], scale_atoms=True)
    assert held.engine(atoms) is engine and engine.constraint_set.half_width == pytest.approx(2.95)


# -- forces that are known --------------------------------------------------------------------------


class Settings(Field):
    """A field whose stiffness `set` changes."""

    discard_results_on_any_change = True

    def __init__(self, **settings):
        super().__init__()
        self.set(**settings)

    def calculate(self, *args, **kwargs):
        self.stiffness = self.parameters["stiffness"]
        super().calculate(*args, **kwargs)


@pytest.mark.parametrize(
    "change",
    [
        lambda atoms: atoms.calc.set(stiffness=3.0),
        lambda atoms: (atoms.calc.set(stiffness=3.0), atoms.get_potential_energy()),
        lambda atoms: setattr(atoms.constraints[-1], "external_force", 4.0),
        lambda atoms: atoms.set_initial_charges([2.0, 0.0, 0.0]),
        lambda atoms: setattr(atoms, "calc", type(atoms.calc)(stiffness=3.0)),
    ],
    ids=["settings", "settings, and asked", "force of ase", "charges", "another"],
)
def test_forces_of_the_same_calculator_that_changed(change):
    """A step begins with the forces that there are now."""

    class Charged(Settings):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"] += self.atoms.get_initial_charges()[:, None]

    atoms, _ = water(Charged(stiffness=0.05))
    atoms.set_constraint([*atoms.constraints, ExternalForce(0, 1, 0.2)])
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(2)
    change(atoms)
    again = atoms.copy()
    again.calc = Charged(**atoms.calc.parameters)
    dyn.run(1)
    ConstrainedDynamics(again, FS).run(1)
    assert equal(state(atoms), state(again))


def test_what_was_given_by_numbers_of_atoms_is_no_longer_of_these():
    """All these lengths are 1, so that the rows that are meant cannot be told from their neighbors by length."""
    line = Atoms("H5", positions=np.arange(5)[:, None] * [1.0, 0.0, 0.0], calculator=Free())
    atoms = line.copy()
    atoms.calc = Free()
    dyn = ConstrainedDynamics(atoms, FS, constraints=[Distance([[2, 3]])])
    dyn.run(1)
    del atoms[0]
    with pytest.raises(InputError, match=r"1 of 5 atoms were removed.*make a new one"):
        dyn.run(1)
    dyn = ConstrainedDynamics(line, FS)
    dyn.run(1)
    del line[0]
    dyn.run(1)
    assert dyn.degrees_of_freedom == 12


@pytest.mark.parametrize("changed", ["fast", "slow"])
def test_each_calculator_of_several_time_steps(changed):
    atoms, _ = water()
    given = {"fast": Settings(stiffness=0.05), "slow": Settings(stiffness=0.02)}
    options = {"temperature_K": 300, "friction": 0.01 / FS, "fast_steps": 2, "rng": 1}
    dyn = MultipleTimeSteps(atoms, FS, **given, **options)
    dyn.run(2)
    given[changed].set(stiffness=3.0)
    again = atoms.copy()
    dyn.run(1)
    other = MultipleTimeSteps(again, FS, **{k: Settings(**each.parameters) for k, each in given.items()}, **options)
    other.nsteps = 2
    other.run(1)
    np.testing.assert_allclose(state(atoms), state(again), rtol=1e-12, atol=1e-13)


# -- atoms that are edited between steps --------------------------------------------------------------


ALL = OF_ASE | {
    "ConstrainedDynamics": ConstrainedDynamics,
    "ConstrainedLangevin": lambda a, dt: ConstrainedLangevin(a, dt, 250, 0.01 / FS, rng=5),
    "ConstrainedNoseHoover": lambda a, dt: ConstrainedNoseHoover(a, dt, 250, 50 * FS, momentum="free"),
    "BFGS": lambda a, dt: BFGS(a, logfile=None),
    "FIRE": lambda a, dt: FIRE(a, logfile=None),
}
FEW = "VelocityVerlet", "ConstrainedDynamics", "BFGS"
EDITS = {
    "set_dihedral": lambda a: a.set_dihedral(3, 2, 1, 0, 60, indices=[3]),
    "rotate_dihedral": lambda a: a.rotate_dihedral(3, 2, 1, 0, 40, indices=[3]),
    "set_angle": lambda a: a.set_angle(0, 1, 2, 100, indices=[2, 3]),
    "set_distance": lambda a: a.set_distance(1, 2, a.get_distance(1, 2) + 0.03),
    "positions": lambda a: a.positions.__setitem__(1, a.positions[1] + 0.02),
    "apply_constraint": lambda a: a.set_positions(a.positions * 1.002, apply_constraint=False),
}


def held_ethanol():
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    held = constrain(atoms, [Distance([[1, 2]]), Angle([[0, 1, 2]]), Dihedral([[3, 2, 1, 0]])])
    draw_velocities(atoms, 250, rng=4)
    return atoms, held


@pytest.mark.parametrize(("name", "edit"), [(n, e) for n in ALL for e in EDITS if e == "rotate_dihedral" or n in FEW])
def test_an_edit_between_runs_is_refused(name, edit):
    """The remedy is named, nothing is changed, and after it the run goes on as warm as it was."""
    atoms, held = held_ethanol()
    run = ALL[name](atoms, 0.8 * FS)
    run.run(steps=3)
    kelvin = atoms.get_temperature()
    EDITS[edit](atoms)
    x, p = atoms.get_positions(), atoms.get_momenta()
    with pytest.raises(InputError, match=r"atoms are off row .*restore\(atoms\)"):
        run.run(steps=1)
    assert np.array_equal(atoms.positions, x) and np.array_equal(atoms.get_momenta(), p)
    held.restore(atoms)
    run.run(steps=1)
    assert off(atoms, held) <= 1e-12
    if name not in ("BFGS", "FIRE"):
        assert abs(atoms.get_temperature() - kelvin) < 250


@pytest.mark.parametrize("name", [*OF_ASE, "ConstrainedDynamics"])
def test_what_a_file_rounds_is_put_right_without_heat(name):
    """The correction alone, in steps as short as these, is 3 % of the speed of its atoms."""
    ends = []
    for size in (0.0, 5e-7):
        atoms, held = held_ethanol()
        run = ALL[name](atoms, 0.005 * FS)
        run.run(2)
        atoms.positions[1] += size * (atoms.positions[1] - atoms.positions[2])
        run.run(1)
        assert off(atoms, held) <= 1e-12
        ends.append(atoms.get_momenta())
    assert np.abs(ends[1] - ends[0]).max() <= 1e-4 * np.abs(ends[0]).max()


def test_time_that_is_set_is_no_way_of_moving_targets():
    """In one step, which would be made into velocity of all that hangs on them."""
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    length = atoms.get_distance(0, 1)
    run = ConstrainedDynamics(atoms, FS, constraints=[Distance([[0, 1]], lambda t: length + 0.001 * t)])
    run.run(2)
    run.time += 200
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.2"):
        run.run(1)


# -- the cell ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "factor"), [*((name, 0.97) for name in OF_ASE), ("VelocityVerlet", 1.00001), ("VelocityVerlet", 1.02)]
)
def test_atoms_scaled_with_the_cell_are_put_right(name, factor):
    """As after a barostat: lengths are as before, each molecule is about its new center, and no atom is faster."""
    atoms = water_gas(2)
    held = constrain(atoms, rigid_water(atoms))
    draw_velocities(atoms, 250, rng=3)
    run = OF_ASE[name](atoms, FS)
    run.run(2)
    kinetic, whole = atoms.get_kinetic_energy(), atoms.get_volume()
    atoms.set_cell(atoms.cell * [factor, 1, 1], scale_atoms=True)
    run.run(1)
    assert off(atoms, held) <= 1e-12
    assert atoms.get_volume() == pytest.approx(factor * whole)
    assert atoms.get_kinetic_energy() == pytest.approx(kinetic, rel=0.1)
    atoms.set_cell(atoms.cell * 1.001, scale_atoms=True)
    atoms.positions[0] += 0.05
    with pytest.raises(InputError, match=r"restore\(atoms\)"):  # this is another edit
        run.run(1)


# -- frames -----------------------------------------------------------------------------------------

ROWS = {
    "CO": [Distance([0, 1])],
    "H2O": [Distance([[0, 1], [0, 2], [1, 2]])],
    "CH3CH2OH": [Distance([[0, 1], [1, 2], [2, 3], [0, 6]]), Angle([[0, 1, 2]]), Dihedral([[3, 2, 1, 0]])],
}


@pytest.mark.parametrize("name", ROWS)
def test_frames_on_the_constraints_are_taken(name):
    """Wherever they are, also with the digits of an XYZ file."""
    rng = random(7)
    for _ in range(60):
        frame, atoms = molecule(name), molecule(name)
        frame.rotate(rng.uniform(0, 180), rng.normal(size=3))
        frame.translate(rng.normal(size=3))
        digits = rng.choice([8, 17])
        frame.positions = np.round(frame.positions, digits)
        held = constrain(atoms, ROWS[name])
        atoms.set_positions(frame.positions)
        assert np.abs(atoms.positions - frame.positions).max() <= max(1e-14, 2 * 10.0**-digits)
        assert off(atoms, held) <= 1e-12


# -- classes that move atoms past their constraints are found --------------------------------------


#: Classes that do not go through the constraints: our error, in how many steps, and what it says.
REFUSED = {
    "LangevinBAOAB": (lambda a: LangevinBAOAB(a, FS, temperature_K=TEMPERATURE, T_tau=100 * FS, rng=1), 1, "off row"),
    "NoseHooverChainNVT": (lambda a: NoseHooverChainNVT(a, FS, TEMPERATURE, 100 * FS), 2, "asks again"),
}
for kind in (MelchionnaNPT, NPT):
    make = partial(kind, timestep=FS, temperature_K=TEMPERATURE, externalstress=0.0, ttime=50 * FS)
    REFUSED[kind.__name__] = make, 60, "3 steps in a row"


@pytest.mark.parametrize("name", REFUSED)
def test_classes_that_move_atoms_past_constraints_are_found(name):
    make, steps, message = REFUSED[name]
    atoms, held = dumbbells(10)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ASE's own advice about its class
        with pytest.raises(UnsupportedError, match=f"{message}.*ConstrainedDynamics.*Langevin") as caught:
            make(atoms).run(steps)
    assert name in str(caught.value) or name in ("NPT",)
    # The object still works once the atoms are put right.
    held.restore(atoms)
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, FS).run(3)
    assert off(atoms, held) <= 1e-12


def test_honest_dynamics_raise_no_alarm():
    # Positions set again and again between momenta, velocities drawn anew, long steps.
    atoms, held = dumbbells(6)
    raw = atoms.positions + random().normal(scale=0.02, size=atoms.positions.shape)
    for _ in range(4):
        atoms.set_positions(raw)
        thermalize_momenta(atoms, 900, rng=random())
    atoms.set_positions(raw)
    for _ in range(4):
        VelocityVerlet(atoms, 8 * FS).run(20)
        thermalize_momenta(atoms, 900, rng=random())
    assert off(atoms, held) <= 1e-12


def test_atoms_at_rest_ask_for_the_same_positions():
    """A kick along the bond is the same in each step, but for rounding."""
    atoms = molecule("CO")
    held = constrain(atoms, Distance([0, 1]))
    start = atoms.get_positions()
    apart = np.outer(1 / atoms.get_masses(), start[0] - start[1]) * [[1], [-1]]
    for pull in (0.1, 0.1, 0.11, 0.11, 0.1, 0.1, 0.1):
        atoms.set_positions(start + pull * apart)
        atoms.set_momenta(np.zeros((2, 3)))
    assert off(atoms, held) <= 1e-14
    assert atoms.positions == pytest.approx(start, abs=1e-14)
