"""Universe, ASE `Atoms` and OpenMM Topology with System: one into the other, with what is held.

An import registers `ASEConverter` with MDAnalysis, so that ``ag.convert_to("ASE")`` gives what `to_ase` gives.

Positions pass in double precision; only a Universe keeps them in single precision. Units are those of each side:
MDAnalysis angstrom, ps, dalton, elementary charges; ASE angstrom, eV, its own time; OpenMM nm, ps.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import MDAnalysis
import numpy as np
from MDAnalysis.converters.base import ConverterBase

from kcons.constraints import Constraint, Distance, FixedAtoms
from kcons.constraints.constraint import constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.vectors import extent
from kcons.errors import InputError, UnsupportedError
from kcons.mdanalysis.loading import format_of
from kcons.mdanalysis.topology import check_box, constraints_of, dimensions_of, snapshot_of, velocities_known
from kcons.motion.motion import Motion
from kcons.topology.rigid_groups import VirtualSites
from kcons.topology.rows_by_name import HeldRows
from kcons.topology.topology import Snapshot, whole_molecules, whole_numbers

if TYPE_CHECKING:
    import ase
    import openmm
    from openmm import unit

NM = 0.1
#: Bonds that are longer than so many times the median may be bonds across a box.
CUT = 3.0


class FromMDEngine(NamedTuple):
    """A Universe, and what was held where it came from, in angstrom and radian."""

    universe: Any
    constraints: list[Constraint]


class ToOpenMM(NamedTuple):
    """What OpenMM needs."""

    #: openmm.app.Topology.
    topology: Any
    #: On the constraints, molecules whole.
    positions: unit.Quantity
    velocities: unit.Quantity | None
    #: Distances are among its constraints, virtual sites are set.
    system: openmm.System
    #: kcons.openmm.CarriedConstraints of all other rows, for ``ProjectedIntegrator(..., parts=[part])``; or None.
    part: Any


# -- Universe and ASE -----------------------------------------------------------------------------


def to_ase(universe: Any, constraints: Iterable[Constraint] = ()) -> ase.Atoms:
    """ASE `Atoms` of the present frame, with `constraints` on them.

    Parameters
    ----------
    universe : Universe or AtomGroup
    constraints : HeldRows or iterable of Constraint
        What is held, in angstrom; atoms are moved onto it, where rigid bodies were made flat.

    Raises
    ------
    InputError, ConstraintError
        What does not fit the atoms, such as rows that were made for another group.

    Warns
    -----
    UserWarning
        Molecules seem to be cut at the edge of a box, which the universe does not have.
    """
    snapshot = _with_bonds_of(_snapshot(universe), constraints)
    _warn_of_cut(snapshot)
    return _held_atoms(snapshot, _rows(constraints))


def _held_atoms(snapshot: Snapshot, rows: Sequence[Constraint]) -> ase.Atoms:
    from kcons.ase import constrain
    from kcons.ase.topology import atoms_of

    atoms = atoms_of(snapshot)
    if rows:
        constrain(atoms, rows, project=True)
    return atoms


class ASEConverter(ConverterBase):  # type: ignore[misc]
    """ASE `Atoms` by MDAnalysis' own mechanism of converters: ``ag.convert_to("ASE", constrain="hbonds")``."""

    lib = "ASE"
    units = {"time": None, "length": "Angstrom"}

    def convert(
        self,
        obj: Any,
        constrain: str | None = None,
        constraints: Constraint | Iterable[Constraint] = (),
        **options: Any,
    ) -> ase.Atoms:
        """ASE `Atoms` of the present frame.

        Parameters
        ----------
        obj : AtomGroup
        constrain : str, optional
            What is held by name: 'hbonds', 'allbonds', 'hangles', 'allangles', 'none' (and rigid water).
        constraints : iterable of Constraint
            Or what is held, in angstrom, its atoms counted in the group.
        **options
            Of `constraints_of`, such as `rigid_water=False`.

        Raises
        ------
        InputError
            Both `constrain` and `constraints`, or options without a name.
        """
        # Rows by name know their atoms; a plain list of them would not.
        given = constraints if isinstance(constraints, HeldRows) else constraints_in(constraints, "constraints")
        if given and constrain is not None:
            raise InputError("give constrain, a name, or constraints, a list; not both", item="constraints")
        if options and constrain is None:
            raise InputError(f"{next(iter(options))} is an option of constrain, which is missing", item="constrain")
        return to_ase(obj, given if constrain is None else constraints_of(obj, constrain, **options))


def from_ase(atoms: ase.Atoms) -> FromMDEngine:
    """A Universe of one frame, and the constraints of the atoms.

    Raises
    ------
    UnsupportedError
        An ASE constraint that kcons cannot express.
    InputError
        A cell that MDAnalysis cannot keep, since its boxes have no orientation.
    """
    from kcons.ase.topology import snapshot_of as snapshot_of_atoms

    return FromMDEngine(universe_of(snapshot_of_atoms(atoms)), _constraints_on(atoms))


def _constraints_on(atoms: ase.Atoms) -> list[Constraint]:
    from kcons.ase import Constraints
    from kcons.ase.translation import translated

    for item in atoms.constraints:
        if isinstance(item, Constraints):
            item.engine(atoms)  # binds targets
    return translated(atoms, atoms.constraints)


# -- Universe and OpenMM --------------------------------------------------------------------------


def to_openmm(
    universe: Any, constraints: Iterable[Constraint] = (), *, force_field: Sequence[str] = (), **options: Any
) -> ToOpenMM:
    """Topology, positions and System of the present frame, with `constraints` held in the System.

    Parameters
    ----------
    universe : Universe or AtomGroup
    constraints : HeldRows or iterable of Constraint
        In angstrom. Distances become constraints of the System, all else is carried by kcons.
    force_field : sequence of str
        Files for openmm.app.ForceField; without them the System has masses, constraints and no forces.
    **options
        For createSystem, beside ``constraints`` and ``rigidWater``, which are given here. Masses are those of the
        universe, unless there is a ``hydrogenMass``.

    Raises
    ------
    InputError
        The force field does not know a residue; a cell that OpenMM does not take; atoms of a residue scattered; rows
        that were made for another group.
    """
    return _openmm(_snapshot(universe), constraints, force_field, options)


def from_openmm(
    topology: Any,
    positions: unit.Quantity,
    system: openmm.System | None = None,
    *,
    velocities: unit.Quantity | None = None,
    part: Any = None,
) -> FromMDEngine:
    """A Universe of one frame, and what the System holds.

    Parameters
    ----------
    topology : openmm.app.Topology
    positions, velocities : Quantity
    system : openmm.System, optional
        For masses, charges and constraints.
    part : CarriedConstraints, optional
        Rows that kcons carries in this System.
    """
    snapshot, rows = _of_openmm(topology, positions, system, velocities, part)
    return FromMDEngine(universe_of(snapshot), rows)


def _of_openmm(
    topology: Any, positions: unit.Quantity, system: openmm.System | None, velocities: unit.Quantity | None, part: Any
) -> tuple[Snapshot, list[Constraint]]:
    """A snapshot, and what a System and a part hold, in angstrom."""
    from kcons.openmm.callback_rows import constraints_about
    from kcons.openmm.quantities import held_without_mass
    from kcons.openmm.topology import snapshot_of as snapshot_of_topology

    rows = [] if system is None else constraints_about(system, np.arange(system.getNumParticles()))
    if part is not None:
        rows += part.motion.constraint_set.constraints
    fixed = [item.atoms.ravel() for item in rows if item.fixes_atoms]
    still = np.setdiff1d([] if system is None else held_without_mass(system), np.concatenate([[], *fixed]))
    rows += [FixedAtoms(still.astype(np.int64))] if len(still) else []
    snapshot = snapshot_of_topology(topology, positions, system=system, velocities=velocities)
    return snapshot, [item.rescaled(1 / NM) for item in rows]


# -- ASE and OpenMM -------------------------------------------------------------------------------


def ase_to_openmm(atoms: ase.Atoms, *, force_field: Sequence[str] = (), **options: Any) -> ToOpenMM:
    """Topology, positions and System of `Atoms`, with what is held on them; see `to_openmm`."""
    from kcons.ase.topology import snapshot_of as snapshot_of_atoms

    return _openmm(snapshot_of_atoms(atoms), _constraints_on(atoms), force_field, options)


def openmm_to_ase(
    topology: Any,
    positions: unit.Quantity,
    system: openmm.System | None = None,
    *,
    velocities: unit.Quantity | None = None,
    part: Any = None,
) -> ase.Atoms:
    """`Atoms` with what a System holds; see `from_openmm`."""
    return _held_atoms(*_of_openmm(topology, positions, system, velocities, part))


# -- pieces ---------------------------------------------------------------------------------------


def universe_of(snapshot: Snapshot) -> Any:
    """A Universe of one frame with names, elements, residues, chains, bonds, masses, charges, velocities and box.

    Raises
    ------
    InputError
        A cell whose first vector is not along x or whose second is not in the xy plane.
    """
    snapshot = snapshot.in_unit(1.0)
    topology, box = snapshot.topology, None
    if snapshot.cell is not None and snapshot.pbc.any():
        box = dimensions_of(snapshot.cell, snapshot.pbc, stacklevel=4)
    # Chains keep their order.
    chains = {chain: k for k, chain in enumerate(dict.fromkeys(topology.chains.tolist()))}
    universe = MDAnalysis.Universe.empty(
        topology.n_atoms,
        n_residues=topology.n_residues,
        n_segments=len(chains),
        atom_resindex=topology.residues,
        residue_segindex=[chains[chain] for chain in topology.chains.tolist()],
        trajectory=True,
        velocities=snapshot.velocities is not None,
    )
    ids = whole_numbers(topology.residue_ids)
    attributes: dict[str, Any] = {
        "names": topology.names.astype(object),
        "types": np.where(topology.elements == "", "X", topology.elements).astype(object),
        "elements": topology.elements.astype(object),
        "masses": topology.masses,
        "resids": ids,
        "resnums": ids,
        "segids": np.array(list(chains), dtype=object),
        "chainIDs": topology.chains[topology.residues].astype(object),
        "resnames": topology.residue_names.astype(object) if topology.residues_known else None,
        "charges": topology.charges,
        "bonds": topology.bonds if len(topology.bonds) else None,
    }
    for name, values in attributes.items():
        if values is not None:
            universe.add_TopologyAttr(name, values)
    universe.atoms.positions = snapshot.positions
    if snapshot.velocities is not None:
        universe.atoms.velocities = snapshot.velocities
    universe.dimensions = box
    return universe


def _rows(constraints: Iterable[Constraint]) -> list[Constraint]:
    """Constraints in angstrom."""
    if isinstance(constraints, HeldRows):
        return [item.rescaled(1.0 / constraints.snapshot.angstrom) for item in constraints]
    return list(constraints)


def _snapshot(universe: Any) -> Snapshot:
    snapshot = snapshot_of(universe)
    reader = universe.atoms.universe.trajectory
    if reader.ts.has_velocities and not velocities_known(reader):
        remedy = "set them where they are needed, or give TRR, H5MD or NetCDF"
        said = f"velocities of {format_of(reader)} files have no unit: they are left out; {remedy}"
        warnings.warn(said, UserWarning, stacklevel=3)
    return snapshot


def _warn_of_cut(snapshot: Snapshot) -> None:
    """Without a cell, bonds across the box are as long as it is, and nothing can make their molecules whole."""
    bonds, x = snapshot.topology.bonds, snapshot.positions
    if len(bonds) == 0 or (snapshot.cell is not None and snapshot.pbc.any()):
        return
    length = np.linalg.norm(x[bonds[:, 0]] - x[bonds[:, 1]], axis=1)
    cut = (length > CUT * np.median(length)) & (length > 0.5 * extent(x))
    if cut.any():
        k = int(np.argmax(length))
        warnings.warn(
            f"{int(cut.sum())} bonds are as long as half of the system, that of atoms {bonds[k, 0]} and {bonds[k, 1]} "
            f"{length[k] / snapshot.angstrom:.1f} angstrom: molecules seem to be cut at the edge of a box, and there "
            "is none to make them whole. Give it (universe.dimensions = [a, b, c, 90, 90, 90]), or unwrap the file",
            stacklevel=4,
        )


def _with_bonds_of(snapshot: Snapshot, constraints: Iterable[Constraint]) -> Snapshot:
    """Bonds that were guessed for the constraints are worth keeping; rows of other atoms are refused."""
    if isinstance(constraints, HeldRows):
        constraints.require_atoms(snapshot.topology.n_atoms, snapshot.indices, snapshot.host)
        return replace(snapshot, topology=snapshot.topology.with_bonds(constraints.topology.bonds))
    return snapshot


def _openmm(
    snapshot: Snapshot, constraints: Iterable[Constraint], force_field: Sequence[str], options: Any
) -> ToOpenMM:
    from openmm import unit

    from kcons.openmm import hold
    from kcons.openmm.topology import openmm_topology

    rows, sites = [item.rescaled(NM) for item in _rows(constraints)], None
    if isinstance(constraints, HeldRows):
        sites = constraints.virtual_sites.in_unit(NM / constraints.snapshot.angstrom)
    snapshot = _with_bonds_of(snapshot, constraints).in_unit(NM)
    if snapshot.cell is not None:
        check_box(snapshot.cell, snapshot.pbc, stacklevel=4)
    _warn_of_cut(snapshot)
    links = np.concatenate(
        [snapshot.topology.bonds, *(item.linked.reshape(-1, 2) for item in rows if item.translation_invariant)]
    )
    in_space = [item.atoms.ravel() for item in rows if not item.translation_invariant]
    firm = np.isin(np.arange(snapshot.topology.n_atoms), np.concatenate([[], *in_space]))
    snapshot = whole_molecules(snapshot, links, np.argsort(~firm, kind="stable"))  # what is held in space stays
    x = snapshot.positions
    if rows:
        held = ConstraintSet(rows, x, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist())
        rows = list(held.constraints)  # with targets
        x = Motion(held, x).restore_positions(x)
        if sites is not None:
            x = sites.place(x)
        snapshot = replace(snapshot, positions=x)
    topology, positions = openmm_topology(snapshot)
    system = _system(snapshot, topology, sites, force_field, options)
    distances = [item for item in rows if isinstance(item, Distance)]
    if distances:
        pairs, lengths = (np.concatenate(part) for part in zip(*((i.atoms, i.target) for i in distances), strict=True))
        pairs = np.sort(pairs)
        for k in np.sort(np.unique(pairs, axis=0, return_index=True)[1]).tolist():  # a pair that is held twice, once
            system.addConstraint(*pairs[k].tolist(), float(lengths[k]))
    others = [item for item in rows if not isinstance(item, Distance)]
    part = hold(system, others, x, periodic=snapshot.cell is not None) if others else None
    speeds = None if snapshot.velocities is None else snapshot.velocities * (unit.nanometer / unit.picosecond)
    return ToOpenMM(topology, positions, speeds, system, part)


def _system(
    snapshot: Snapshot, topology: Any, sites: VirtualSites | None, force_field: Sequence[str], options: Any
) -> openmm.System:
    import openmm
    from openmm import app, unit

    vectors = topology.getPeriodicBoxVectors()
    if force_field:
        try:
            field = app.ForceField(*([force_field] if isinstance(force_field, str) else force_field))
        except Exception as error:  # whatever went wrong inside of OpenMM's reader
            said = f"force field {force_field}: {' '.join(str(error).split())}"
            raise InputError(said, item="force_field") from error
        settings: dict[str, Any] = {"constraints": None, "rigidWater": False}
        for taken in settings.keys() & options:
            raise UnsupportedError(f"{taken} is what `constraints` says here; leave it out")
        settings |= {"removeCMMotion": False, "nonbondedMethod": app.NoCutoff}
        if vectors is not None:
            width = min(float(vectors[k][k].value_in_unit(unit.nanometer)) for k in range(3))
            settings |= {"nonbondedMethod": app.PME, "nonbondedCutoff": min(0.9, 0.45 * width)}
        try:
            system = field.createSystem(topology, **(settings | options))
        except ValueError as error:
            said = f"the force field does not fit: {' '.join(str(error).split())}"
            raise InputError(said, item="force_field") from error
        for k, mass in enumerate(() if "hydrogenMass" in options else snapshot.topology.masses.tolist()):
            if mass and system.getParticleMass(k)._value:  # neither unknown nor a site
                system.setParticleMass(k, mass)
        return system
    if options:
        raise InputError(f"{', '.join(options)} is for a force field; give force_field", item=next(iter(options)))
    system = openmm.System()
    for mass in snapshot.topology.masses.tolist():
        system.addParticle(mass)
    if vectors is not None:
        system.setDefaultPeriodicBoxVectors(*vectors)
    if sites is not None and len(sites):
        columns = sites.sites.tolist(), sites.parents.tolist(), sites.coefficients.tolist()
        for site, parents, (a, b, c) in zip(*columns, strict=True):
            flat = openmm.ThreeParticleAverageSite(*parents, 1 - a - b, a, b)
            system.setParticleMass(site, 0.0)
            system.setVirtualSite(site, openmm.OutOfPlaneSite(*parents, a, b, c) if c else flat)
    return system
