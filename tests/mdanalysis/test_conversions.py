"""Universe, Atoms, OpenMM: there and back, with units and with what is held."""

from __future__ import annotations

import warnings

import MDAnalysis as mda
import numpy as np
import openmm
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.constraints import FixAtoms
from host_systems import ALANINE, DHFR, VILLIN, quietly, read_universe
from MDAnalysis.lib.mdamath import triclinic_vectors
from openmm import app, unit

from kcons.ase import constrain
from kcons.constraints import CenterOfMass, Distance, FixedAtoms, LinearRelation, RadiusOfGyration
from kcons.errors import InputError, UnsupportedError
from kcons.mdanalysis import (
    TrajectoryWriter,
    ase_to_openmm,
    constraints_of,
    from_ase,
    from_openmm,
    openmm_to_ase,
    snapshot_of,
    to_ase,
    to_openmm,
)
from kcons.openmm import constraints_of as constraints_of_topology


@pytest.fixture(scope="module")
def villin():
    return read_universe(VILLIN)


@pytest.fixture(scope="module")
def held(villin):
    return quietly(constraints_of, villin, "hbonds")


def same_rows(one, two, factor=1.0):
    """The same pairs at the same lengths, in any grouping."""

    def table(rows):
        pairs = np.concatenate([np.sort(r.atoms, axis=1) for r in rows])
        targets = np.concatenate([r.target for r in rows])
        order = np.lexsort(pairs.T)
        return pairs[order], targets[order]

    (a, b), (c, d) = table(one), table(two)
    np.testing.assert_array_equal(a, c)
    np.testing.assert_allclose(b, factor * d, rtol=0, atol=1e-10)


def test_universe_to_ase_to_openmm_and_back(villin, held):
    atoms = to_ase(villin, held)
    assert atoms.get_chemical_symbols()[:5] == ["N", "H", "H", "H", "C"]
    np.testing.assert_allclose(atoms.positions, villin.atoms.positions, atol=2e-6)
    np.testing.assert_allclose(atoms.cell.lengths(), villin.dimensions[:3], atol=1e-5)
    np.testing.assert_allclose(atoms.get_masses(), villin.atoms.masses)
    assert atoms.get_number_of_degrees_of_freedom() == 3 * len(atoms) - held.constraint_set.n_rows
    made = ase_to_openmm(atoms)
    again = openmm_to_ase(made.topology, made.positions, made.system)
    np.testing.assert_allclose(again.positions, atoms.positions, rtol=0, atol=1e-12)  # double precision all the way
    np.testing.assert_array_equal(again.numbers, atoms.numbers)
    # And without ASE between.
    made = to_openmm(villin, held)
    assert made.part is None
    assert made.topology.getNumResidues() == len(villin.residues)
    assert made.topology.getNumBonds() == len(held.topology.bonds)
    there = made.positions.value_in_unit(unit.angstrom)
    np.testing.assert_allclose(there, snapshot_of(villin).positions, atol=1e-12)
    box = made.topology.getPeriodicBoxVectors().value_in_unit(unit.angstrom)
    np.testing.assert_allclose(np.diag(np.array(box)), villin.dimensions[:3], atol=1e-5)
    for universe, rows in (from_ase(again), from_openmm(made.topology, made.positions, made.system)):
        same_rows(rows, held)
        for name in ("names", "resnames", "resids", "masses"):
            np.testing.assert_array_equal(getattr(universe.atoms, name), getattr(villin.atoms, name), err_msg=name)
        np.testing.assert_allclose(universe.atoms.positions, villin.atoms.positions, atol=2e-6)
        np.testing.assert_allclose(universe.dimensions, villin.dimensions, atol=1e-5)
        np.testing.assert_array_equal(universe.bonds.indices, held.topology.bonds)


def test_residues_in_another_order_than_in_the_universe(villin):
    group = sum(residue.atoms for residue in villin.residues[[7, 2, 5]])
    made = to_openmm(group, quietly(constraints_of, group, "hbonds"))
    assert [atom.name for atom in made.topology.atoms()] == group.names.tolist()
    assert [residue.name for residue in made.topology.residues()] == villin.residues[[7, 2, 5]].resnames.tolist()


def test_velocities_have_the_units_of_their_host(villin):
    group = villin.select_atoms("protein and resid 1")
    atoms = to_ase(group)
    rng = np.random.default_rng(5)
    v = rng.normal(size=(len(atoms), 3))
    atoms.set_velocities(v)
    universe, _ = from_ase(atoms)
    # Å per ps; the kinetic energy in kJ/mol is that of ASE in eV.
    np.testing.assert_allclose(universe.atoms.velocities, v * 1000 * units.fs, rtol=1e-6)
    kinetic = 0.5 * float(np.sum(universe.atoms.masses[:, None] * universe.atoms.velocities.astype(float) ** 2)) / 100
    assert kinetic == pytest.approx(atoms.get_kinetic_energy() / (units.kJ / units.mol), rel=1e-6)
    made = ase_to_openmm(atoms)
    speeds = made.velocities.value_in_unit(unit.angstrom / unit.picosecond)
    np.testing.assert_allclose(speeds, v * 1000 * units.fs, rtol=1e-12)
    back = openmm_to_ase(made.topology, made.positions, made.system, velocities=made.velocities)
    np.testing.assert_allclose(back.get_velocities(), v, rtol=1e-12)


def test_forces_of_openmm_on_a_file_of_mdanalysis():
    universe = read_universe(ALANINE)
    universe.atoms.masses = universe.atoms.masses + 0.5  # which the force field has others for
    rows = quietly(constraints_of, universe, "hangles", angles="distances")
    made = to_openmm(universe, rows, force_field=["amber14-all.xml"])
    assert [made.system.getParticleMass(k)._value for k in range(22)] == pytest.approx(universe.atoms.masses.tolist())
    pdb, field = app.PDBFile(str(ALANINE)), app.ForceField("amber14-all.xml")
    held = field.createSystem(pdb.topology, nonbondedMethod=app.NoCutoff, constraints=app.HAngles)
    assert made.system.getNumConstraints() == held.getNumConstraints() == 30
    theirs = field.createSystem(pdb.topology, nonbondedMethod=app.NoCutoff)
    energies = []
    for system, positions in ((made.system, made.positions), (theirs, pdb.positions)):
        context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(positions)
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
    assert energies[0] == pytest.approx(energies[1], abs=1e-9)


def test_rows_that_are_no_distances_are_carried(villin):
    group = villin.select_atoms("protein and resid 1:4")
    rows = quietly(
        constraints_of,
        group,
        "hangles",
        rigid_residues=["LEU"],
        on={
            "name CA": RadiusOfGyration,
            "name N": CenterOfMass,
            "name C": lambda atoms: LinearRelation(atoms[0], atoms[1:3], [0.4, 0.6], None),
        },
    )
    made = to_openmm(group, rows)
    assert made.part is not None
    motion = made.part.motion
    assert motion.rank + made.system.getNumConstraints() == rows.constraint_set.n_rows
    x = np.array(made.positions.value_in_unit(unit.nanometer))
    assert np.abs(motion.constraint_set.value(x)).max() < 1e-10
    _, back = from_openmm(made.topology, made.positions, made.system, part=made.part)
    families = {item.family for item in back}
    assert {"Distance", "Angle", "LinearRelation", "RadiusOfGyration", "CenterOfMass"} <= families
    gyration = next(item for item in back if item.family == "RadiusOfGyration")
    expected = next(item for item in rows if item.family == "RadiusOfGyration")
    np.testing.assert_allclose(gyration.target, expected.target, atol=1e-3)  # Å; the ring was made flat
    atoms = to_ase(group, rows)
    assert np.abs(atoms.constraints[0].engine(atoms).constraint_set.value(atoms.positions)).max() < 1e-10


def test_cut_molecules_are_whole_in_openmm(villin, held):
    other = read_universe(VILLIN)
    rng = np.random.default_rng(1)
    box = other.dimensions[:3].astype(float)
    other.atoms.positions = other.atoms.positions + rng.integers(-1, 2, size=(len(other.atoms), 3)) * box
    rows = quietly(constraints_of, other, "hbonds")
    for one, two in zip(rows, held, strict=True):
        np.testing.assert_array_equal(one.atoms, two.atoms)
        np.testing.assert_allclose(one.target, two.target, atol=3e-5)  # single precision, farther out
    made = to_openmm(other, rows)
    x = made.positions.value_in_unit(unit.angstrom)
    pairs = rows.topology.bonds
    assert np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1).max() < 2.2
    moved = (x - snapshot_of(villin).positions) / box
    assert np.abs(moved - np.round(moved)).max() < 1e-5


def test_sites_out_of_the_plane_stay_where_they_are_whatever_unit_the_rows_are_in():
    """Coefficients of TIP5P's lone pairs have a unit."""
    universe = mda.Universe.empty(5, trajectory=True)
    universe.add_TopologyAttr("names", ["O", "H1", "H2", "L1", "L2"])
    universe.add_TopologyAttr("elements", ["O", "H", "H", "", ""])
    universe.add_TopologyAttr("masses", [16.0, 1.008, 1.008, 0.0, 0.0])
    universe.add_TopologyAttr("resnames", ["SOL"])
    universe.atoms.positions = [[0, 0, 0], [0.757, 0.586, 0], [-0.757, 0.586, 0], [0, -0.4, 0.57], [0, -0.4, -0.57]]
    plain = to_openmm(universe)
    for rows in (
        constraints_of(universe, "none"),
        constraints_of_topology(plain.topology, plain.positions, "none", system=plain.system),
    ):
        made = to_openmm(universe, rows)
        context = openmm.Context(made.system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
        context.setPositions(made.positions)
        context.computeVirtualSites()
        placed = context.getState(positions=True).getPositions(asNumpy=True)
        for x in (made.positions, placed):
            np.testing.assert_allclose(x.value_in_unit(unit.angstrom), universe.atoms.positions, atol=1e-5)


def test_constraints_of_ase_come_along_and_what_cannot_be_converted_is_refused(villin):
    group = villin.select_atoms("protein and resid 1")
    atoms = to_ase(group)
    constrain(atoms, Distance([[0, 1]]))
    atoms.set_constraint([*atoms.constraints, FixAtoms([8])])
    assert [item.family for item in from_ase(atoms)[1]] == ["Distance", "FixedAtoms"]
    atoms.rotate(30, "y", rotate_cell=True)
    fields, dhfr = ["amber14-all.xml", "amber14/tip3pfb.xml"], app.PDBFile(str(DHFR)).topology
    for kind, words, call in (
        (InputError, "turn cell and positions", lambda: from_ase(atoms)),
        (InputError, "turn cell and positions", lambda: ase_to_openmm(atoms)),
        (InputError, "nonbondedCutoff is for a force field", lambda: to_openmm(group, nonbondedCutoff=1.0)),
        (UnsupportedError, "rigidWater is what", lambda: to_openmm(villin, force_field=fields, rigidWater=True)),
        (InputError, "force field", lambda: to_openmm(group, force_field=["no-such-file.xml"])),
        (InputError, "positions have shape", lambda: from_openmm(dhfr, np.zeros((3, 3)))),
    ):
        with pytest.raises(kind, match=words):
            call()


def ethane_cut(box):
    """Two carbons with hydrogens, the second beyond the edge of a box of 10 angstrom."""
    universe = mda.Universe.empty(4, trajectory=True)
    universe.add_TopologyAttr("elements", ["H", "C", "C", "H"])
    universe.add_TopologyAttr("masses", [1.0, 12.0, 12.0, 1.0])
    universe.add_TopologyAttr("bonds", [(0, 1), (1, 2), (2, 3)])
    universe.atoms.positions = [[8.6, 0.0, 0.0], [9.6, 0.0, 0.0], [1.1, 0.5, 0.0], [2.1, 0.5, 0.0]]
    if box:
        universe.dimensions = [10.0, 10.0, 10.0, 90.0, 90.0, 90.0]
    return universe


@pytest.mark.parametrize("turned", [0, 1, 2])
def test_a_cell_with_a_vector_turned_round_is_the_same_lattice(tmp_path, turned):
    """Lengths and angles of such vectors are those of the mirror image."""
    cell = np.array([[10.0, 0, 0], [2, 9, 0], [2, 3, 10]])
    cell[turned] *= -1
    atoms = Atoms("N2", [[0, 0, 0], [0, 0, 1.1]], cell=cell, pbc=True)
    with TrajectoryWriter(tmp_path / "run.trr", 2, velocities=False) as writer:
        writer.write(atoms.positions, cell=cell)
    written = mda.coordinates.TRR.TRRReader(str(tmp_path / "run.trr")).ts.dimensions
    for box in (from_ase(atoms).universe.dimensions, written):
        steps = cell @ np.linalg.inv(triclinic_vectors(box, dtype=np.float64))
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-5)
    with pytest.warns(UserWarning, match="periodic in all directions; this cell is not"):
        ase_to_openmm(Atoms("N2", atoms.positions, cell=np.abs(cell), pbc=[True, True, False]))


def test_molecules_cut_by_a_box_that_is_not_there_are_said():
    with pytest.warns(UserWarning, match=r"1 bonds .* atoms 1 and 2 8\.5 angstrom.*universe\.dimensions = "):
        to_ase(ethane_cut(box=False))
    with warnings.catch_warnings(action="error"):
        to_ase(ethane_cut(box=True))
        # Targets that are left out are those of the frame.
        system = to_openmm(ethane_cut(box=True), [Distance([(0, 1), (2, 3)])]).system
        held = [system.getConstraintParameters(k) for k in range(2)]
        assert [(i, j, round(length._value, 6)) for i, j, length in held] == [(0, 1, 0.1), (2, 3, 0.1)]
        cut = ethane_cut(box=True)  # made whole around what is held in space
        x = to_openmm(cut, [FixedAtoms([2], cut.atoms.positions[2])]).positions.value_in_unit(unit.angstrom)
        assert np.linalg.norm(x[2] - x[1]) < 2.0
        whole = ethane_cut(box=False)
        whole.atoms[2:].positions += [10.0, 0.0, 0.0]
        to_ase(whole)


def test_rows_of_another_group_are_refused(villin):
    water = villin.select_atoms("resname HOH SOL WAT TIP3")
    ten, other = water[30:60], water[:30]
    rows = quietly(constraints_of, ten, "none")
    for convert in (to_ase, to_openmm, lambda group, held: group.convert_to("ASE", constraints=held)):
        with pytest.raises(InputError, match=rf"made for 30 atoms, and there are {len(water)} here.*constraints_of"):
            convert(water, rows)
        with pytest.raises(InputError, match=rf"atom 0 is atom {ten.indices[0]} .*here it is atom {other.indices[0]}"):
            convert(other, rows)
    (held,) = ten.convert_to("ASE", constraints=rows).constraints
    assert held.get_removed_dof(to_ase(ten)) == 30
    # Another file of the same atoms may number them otherwise.
    assert len(to_ase(mda.Merge(ten), rows).constraints) == 1


# -- ag.convert_to("ASE") ---------------------------------------------------------------------------


def test_converted_atoms_carry_constraints():
    ethane, _ = from_ase(molecule("C2H6"))
    ethane.add_TopologyAttr("bonds", [(0, 1), (0, 2), (0, 3), (0, 4), (1, 5), (1, 6), (1, 7)])
    one = Distance([[0, 1]])
    for group, options, removed in (
        (ethane.atoms, {"constrain": "hbonds"}, 6),
        (ethane.atoms, {"constraints": constraints_of(ethane, "hbonds")}, 6),
        (ethane.select_atoms("element C"), {"constraints": [one]}, 1),
        (ethane.atoms, {"constraints": one}, 1),
    ):
        atoms = group.convert_to("ASE", **options)
        (held,) = atoms.constraints
        assert len(atoms) == len(group) and held.get_removed_dof(atoms) == removed
    made = to_openmm(ethane)
    for k in (3, 4):
        made.system.setParticleMass(k, 0.0)  # OpenMM does not move it, and ignores what ties it to another
    made.system.addConstraint(3, 4, 9.0)
    (held,) = openmm_to_ase(made.topology, made.positions, made.system).constraints
    assert held.get_indices().tolist() == [3, 4]
    for options, words in (
        ({"constraints": 3}, "constraints has 3"),
        ({"constrain": "hbonds", "constraints": [one]}, "not both"),
        ({"rigid_water": False}, "rigid_water is an option of constrain"),
    ):
        with pytest.raises(InputError, match=words):
            ethane.atoms.convert_to("ASE", **options)
