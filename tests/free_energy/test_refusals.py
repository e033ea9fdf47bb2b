"""What free energies and scans refuse: the call, the argument it names, what it says; the error if no `InputError`."""

from __future__ import annotations

import io
from functools import partial

import numpy as np
import openmm
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.lj import LennardJones
from ase.md.verlet import VelocityVerlet
from constraint_cases import blade
from scan_systems import chain, threefold

from kcons import ConstraintSet
from kcons.ase import Constraints
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, FixedAtoms, Plane, VelocityFormula
from kcons.errors import ConstraintError, InputError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.free_energy import (
    AseRecorder,
    AseWindows,
    FreeEnergy,
    HeldCoordinates,
    HeldCoordinatesReporter,
    OpenMMWindows,
    Sample,
    Series,
    Settings,
    fit_surface,
    integrate,
    mean_force,
    pull_free_energy,
    scan,
    weighted_mean,
)
from kcons.free_energy.scans.relaxed_scan import Grid

TURN, LENGTH = Dihedral([[0, 1, 2, 3]]), Distance([[0, 1]])
CALCULATOR = partial(LennardJones, sigma=1.0, epsilon=0.02, rc=6.0)

# -- settings of windows, and who samples them --

_SETTINGS = {"temperature": "300", "timestep": 0.0, "every": None, "relax": -1, "pull": 0.5}
SETTINGS = [
    *((partial(Settings, **{name: value}), name, f"{name} is") for name, value in _SETTINGS.items()),
    (lambda: Settings(production=300, every=10), "production", r"fewer than 32 samples; .* a smaller `every`"),
]


def methanol(coordinates, calculator=CALCULATOR):
    return AseWindows(molecule("CH3OH"), calculator, coordinates)


def recorder(name, row, held=()):
    atoms = molecule("CH3OH")
    atoms.calc = CALCULATOR()
    if held:
        atoms.set_constraint(Constraints(held))
    return AseRecorder(VelocityVerlet(atoms, units.fs), {name: row})


def two_particles(coordinates, atoms=2):
    """In OpenMM."""
    made, topology = openmm.System(), openmm.app.Topology()
    residue = topology.addResidue("X", topology.addChain())
    for _ in range(2):
        made.addParticle(1.0)
    for _ in range(atoms):
        topology.addAtom("X", None, residue)
    return OpenMMWindows(topology, made, np.eye(3)[:2], coordinates)


_OH, _ENDS = Distance([[1, 3]]), Dihedral([[2, 0, 1, 3]])


SAMPLERS = [
    (lambda: methanol({"t": TURN}, CALCULATOR()), "calculator", r"calculator is .*; give what makes one"),
    (lambda: methanol(TURN), "coordinates", "no coordinates are named"),
    (lambda: methanol({"turn": 90}), "turn", "'turn' is 90; give a kcons constraint of one row"),
    (lambda: methanol({"q": Distance([[0, 1], [1, 3]])}), "q", "'q' is .*; give a kcons constraint of one row"),
    (lambda: methanol({"q": blade([0, 1])}), "q", "velocity constraint.*holds no coordinate"),
    (lambda: AseWindows(molecule("C2H2"), CALCULATOR, {"t": _ENDS}), None, "collinear", SingularGeometryError),
    (lambda: two_particles({"r": Distance([[0, 9]])}), "atoms", "no atom 9; the System has 2 part"),
    (lambda: two_particles({"r": LENGTH}, 0), "topology", "Topology has 0 atoms and the System 2 particle"),
    (lambda: recorder("t", TURN), "coordinates", "no Constraints objects"),
    (lambda: recorder("t", TURN, [_OH]), "t", r"t, Dihedral\(0, 1, 2, 3\), is not among"),
    (lambda: HeldCoordinatesReporter(io.StringIO(), 0, {"t": TURN}), "reportInterval", "reportInterval is"),
    (lambda: HeldCoordinatesReporter(io.StringIO(), 1, None), "coordinates", "no coordinates are named; g"),
]

# -- held coordinates: six atoms of a chain, and two more on a skate --

RING = [[0, 0.1, 0.2], [1.1, 0, -0.1], [1.6, 1.2, 0.1], [2.7, 1.3, 0.9], [3.1, 0.4, 1.9], [2.2, -0.5, 2.4]]
X = np.array([*RING, [9, 9.1, 9.2], [10.1, 9, 8.9]])
R, CENTER, EDGE = Distance([[0, 3]]), CenterDistance([0, 1], [4, 5]), blade([6, 7])
SET, STILL = ConstraintSet([R, CENTER, EDGE], X, np.ones(8)), np.zeros((8, 3))


def held(coordinates, rows=None, x=X):
    return HeldCoordinates(SET if rows is None else ConstraintSet(rows, x, np.ones(8)), coordinates, x)


TWO, BESIDE = Distance([[0, 1], [1, 2]]), Distance([[5, 6]])
#: Three planes through one line.
PLANES = {k: Plane([0], n) for k, n in zip("abc", [(0, 0, 1.0), (0, 0.6, 0.8), (0, 1.0, 0)], strict=True)}
LONG = [TWO, Angle([[0, 1, 2]]), Distance([[0, 2]])]
HELD = [
    (lambda: held({}), "coordinates", "no coordinates"),
    (lambda: held({"a": R, "b": Distance([[3, 0]])}), "a", "a and b are the same row 0"),
    (lambda: held({"a": Distance([[0, 4]])}), "a", r"a, Distance\(0, 4\), is not among the 3 rows"),
    (lambda: held({"a": TURN}), "a", "not among"),
    (lambda: held({"e": EDGE}), "e", "velocity constraint.*holds no coordinate"),
    (lambda: held({"r": LONG[2]}, LONG), None, r"r depends on the other.*Z = 0.*take out", SingularGeometryError),
    (lambda: held(PLANES, [LENGTH, *PLANES.values()]), None, "a and b and c depend", SingularGeometryError),
    (lambda: held({"r": BESIDE}, [BESIDE, EDGE]), None, r"r share.* velocity.*Motion\.mult", UnsupportedError),
    (lambda: held({"r": R}).sample(X, STILL, STILL[:4]), "forces", "forces must have shape"),
    (lambda: held({"r": R}).sample(X, STILL, np.inf + STILL), "forces", "forces of atom 0", NonFiniteError),
]

# -- series, means, mean forces --


def series(values):
    found, zero = Series(["r"]), np.zeros(1)
    for k, value in enumerate(values):
        found.append(Sample(float(k), np.array([value]), zero + k % 3, zero, 0.0, zero, 0.0, zero + np.nan, zero))
    return found


N20 = np.arange(20.0)
MEANS = [
    (lambda: mean_force(N20, 1.0), "series", r"give a kcons\.free_energy\.Series"),
    (lambda: mean_force(series([1.0] * 20), 0.0), "kT", "kT is 0.0; give a positive number"),
    (lambda: mean_force(series([1.0] * 9), 1.0), "values", "too few"),
    (lambda: mean_force(series([1.0] * 9)[9:], 1.0), "series", "no samples"),
    (lambda: mean_force(series([1.0] * 9 + [1.1] * 9), 1.0), "r", r"r moved by 0\.1"),
    (lambda: mean_force(series([1.0] * 19 + [np.nan]), 1.0), "r", "values of r are not finite"),
    (lambda: weighted_mean(np.zeros(15)), "values", "too few"),
    (lambda: weighted_mean([1.0] * 19 + [np.nan]), "values", "sample 19"),
    (lambda: weighted_mean(N20, np.ones(19)), "weights", r"shape \(20,\)"),
    (lambda: weighted_mean(N20, np.full(20, np.inf)), "weights", "sample 0"),
    (lambda: weighted_mean(N20, -np.ones(20)), "weights", "negative"),
    (lambda: weighted_mean(N20, np.zeros(20)), "weights", "positive"),
    (lambda: weighted_mean(N20, np.eye(20)[3]), "weights", "sample 3 has all of the weight"),
]

# -- profiles, surfaces, works --

N3 = [0.0, 1.0, 2.0]
GRID = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)


def profile(**of):
    return integrate([-1.0, 0.5, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.1] * 4, **of)


def surface(**change):
    return fit_surface(**{"x": GRID, "f": GRID, "errors": np.ones((9, 2)), **change})


PROFILES = [
    (lambda: integrate(N3[:2], N3[:2], [1.0] * 2), "x", "too few"),
    (lambda: integrate([0.0, 1.0, 1.0], N3, [1.0] * 3), "x", "2 different windows"),
    (
        lambda: integrate([0.0, 1.0, 1.0, 2.0], [0.0, 1.0, 2.0, 2.0], [0.0] * 4),
        "e",
        "windows at 1 have other mean forces",
    ),
    (lambda: integrate(N3, [0.0, np.nan, 2.0], [1.0] * 3), "f", "window 1 is not finite"),
    (lambda: integrate(N3, N3[:2], [1.0] * 3), "f", r"shape \(3,\)"),
    (lambda: integrate(N3, N3, [1.0, 1.0, -1.0]), "e", "window 2 is negative"),
    (lambda: integrate(N3, N3, [1.0] * 3, zero=3.0), "zero", "beyond the windows"),
    (lambda: integrate(N3, N3, [1.0] * 3, period=-1.0), "period", "positive"),
    (lambda: integrate([0.0, 90.0, 180.0], N3, [1.0] * 3, period=6.28), "period", "units"),
    (lambda: profile().next_windows(0), "count", "count is"),
    (lambda: FreeEnergy(("a",), N3[:1], [], {"window-0": "no force"}).profile, None, "all windows fail.*-0: no force"),
    *((lambda b=b: profile().next_windows(1, below=b), "below", "below is") for b in (0.0, np.nan)),
    (lambda: surface(x=np.zeros((3, 2))), "x", r"d \+ 2 or more"),
    (lambda: surface(x=np.ones((9, 2))), "x", "one value of coordinate 0"),
    (lambda: surface(f=np.zeros((9, 3))), "f", r"shape \(9, 2\)"),
    (lambda: surface(f=np.full((9, 2), np.nan)), "f", "window 0"),
    (lambda: surface(errors=np.ones(9)), "errors", "shape"),
    (lambda: surface(errors=-np.ones((9, 2))), "errors", "negative"),
    (lambda: surface(errors=np.tile([[1.0, 2.0], [2.0, 1.0]], (9, 1, 1))), "errors", "not symmetric and pos"),
    (lambda: surface(periods=(1.0,)), "periods", "2 positive"),
    (lambda: surface(periods=(0.5, None)), "x", "further apart than the period in coordinate 0"),
    (lambda: surface(zero=[0.0]), "zero", "2 finite"),
    (lambda: surface(zero=[9.0, 0.0]), "x", "beyond the windows"),
    (lambda: surface().difference([0.0, 0.0], 0.5), "a", "a and b must be places of 2 coordinates"),
    (lambda: pull_free_energy([1.0] * 4, [1.0] * 5, thermal_energy=1.0), "forward", "5 pulls"),
    (lambda: pull_free_energy([1.0] * 5, [1.0] * 4, thermal_energy=1.0), "backward", "5 pulls"),
    (
        lambda: pull_free_energy([1.0] * 5, [0.0] * 5, thermal_energy=1.0),
        "forward",
        "the same each way, and 1 kT are lost",
    ),
    (lambda: pull_free_energy([1.0] * 5 + [np.inf], [1.0] * 5, thermal_energy=1.0), "forward", "work 5"),
    (lambda: pull_free_energy([1.0] * 5, [1.0] * 5, thermal_energy="1"), "thermal_energy", "positive"),
]

# -- scans --


def scanned(coordinates, values, **how):
    return scan(chain(4, threefold), coordinates, values, **how)


STRAIGHT, SPEED = chain(4, threefold), VelocityFormula("vx1 + vy2", [[0, 1]])
STRAIGHT.positions[:3] = [[0, 0, 0], [1.4, 0, 0], [2.8, 0, 0]]
_WRONG = [{"fmax": "x"}, {"fmax": 0}, {"evaluations": 2.5}, {"held": 3}, {"held": [TURN, None]}, {"folder": 3}]
_GRIDS = [
    ([], [], "coordinates", "one or two coordinates, not 0"),
    ([TURN, LENGTH, TURN], [[0], [1], [0]], "coordinates", "one or two coordinates, not 3"),
    ([TURN], [[0], [1]], "values", "1 coordinates have 2 lists of values"),
    ([TWO], [[1]], "coordinates", "has 2 rows; a coordinate of a scan has one"),
    *(([LENGTH], [wrong], "values", "not a list of finite numbers") for wrong in ([], [1, np.nan], [[1, 2]])),
    ([LENGTH], [["far"]], None, "values of Distance"),
    *(
        ([LENGTH], [wrong], "values", "repeat or turn back; give each once and")
        for wrong in ([1, 2, 1], [1, 3, 2], [1, 1, 2])
    ),
    ([TURN], [np.radians([-180, 0, 200])], "values", "span more than its period"),
]
SCANS = [
    *((partial(Grid, rows, values), item, said) for rows, values, item, said in _GRIDS),
    *((partial(scanned, TURN, [0.1], **how), None, next(iter(how))) for how in _WRONG),
    (lambda: scanned(None, [0.1]), None, "coordinates has None"),
    (lambda: scanned([TURN, LENGTH], 3.0), "values", "2 coordinates have 1 lists of values; give one list for each"),
    (
        lambda: methanol({"t": _ENDS}).at([1.0, 2.0]),
        "targets",
        "targets must be finite numbers, one of t for each window",
    ),
    (lambda: scan(Atoms("C4", STRAIGHT.positions), TURN, [0.1]), "calculator", "no calculator"),
    (lambda: scan(STRAIGHT, TURN, [0.1]), None, "collinear; bend them, or hold a", SingularGeometryError),
    (lambda: scanned(LENGTH, [1.2], held=LENGTH), None, "distance_0_1 depends on the other", ConstraintError),
    (lambda: scanned(LONG[2], [2.2], held=LONG[:2]), None, "distance_0_2 depends", ConstraintError),
    (lambda: scanned(LENGTH, [1.2], held=FixedAtoms([0, 1])), None, "distance_0_1 depends", ConstraintError),
    (lambda: scanned([LENGTH, Distance([[1, 0]])], [[1.2], [1.2]]), "distance_0_1", "are the same row 0"),
    (lambda: scanned(Distance([[0, 9]]), [1.2]), None, "atom 9"),
    (lambda: scanned(LENGTH, [-1.0, 1.2]), None, "length greater than zero"),
    (lambda: scanned(Angle([[0, 1, 2]]), [120.0]), None, "no angle between 0 and pi"),
    (lambda: scanned(Distance([[0, 1]], lambda t: 1.0 + t), [1.2]), None, "moves with time", UnsupportedError),
    (lambda: scanned(TURN, [0.1], held=SPEED), None, "velocities", UnsupportedError),
]


@pytest.mark.parametrize("row", [*SETTINGS, *SAMPLERS, *HELD, *MEANS, *PROFILES, *SCANS])
def test_refusals(row):
    call, item, said, *kind = row
    with pytest.raises(kind[0] if kind else InputError, match=said) as caught:
        call()
    assert item is None or caught.value.item == item
