"""What OpenMM itself holds in a System, what of it can be trusted, and what an integrator must refuse.

OpenMM ignores a constraint solver that does not converge; the residuals here are computed from positions and
velocities, independently of it.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import openmm
from numpy.typing import NDArray
from scipy.sparse import csr_array

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.ensemble import Integrator
from kcons.openmm.quantities import masses_of
from kcons.plan.plan import make_plan

IntArray = NDArray[np.int64]

#: How the names of Forces begin that carry rows.
ROW_NAME = "kcons row"

#: Forces that need an integrator of their own.
_FOREIGN = {
    "DrudeForce": "moved like atoms, Drude particles take up the heat of the molecules, and polarisation is lost. Use "
    "openmm.DrudeLangevinIntegrator or openmm.DrudeSCFIntegrator, which keep them cold",
    "RPMDMonteCarloBarostat": "ring polymers need openmm.RPMDIntegrator",
}
_ATOM_BY_ATOM = (
    "MonteCarloFlexibleBarostat with scaleMoleculesAsRigid=False moves the atoms of a molecule apart and breaks what "
    "is held; let it scale molecules as rigid"
)
#: Platforms that place virtual sites where a program ends. GPUs do so wherever positions are constrained.
_LATE = ("Reference", "CPU")
BAROSTATS = frozenset(
    {"MonteCarloBarostat", "MonteCarloAnisotropicBarostat", "MonteCarloMembraneBarostat", "MonteCarloFlexibleBarostat"}
)
#: Forces that know no place in space.
_INVARIANT = frozenset(
    {
        "HarmonicBondForce",
        "HarmonicAngleForce",
        "PeriodicTorsionForce",
        "RBTorsionForce",
        "CMAPTorsionForce",
        "NonbondedForce",
        "CustomNonbondedForce",
        "CustomBondForce",
        "CustomAngleForce",
        "CustomTorsionForce",
        "GBSAOBCForce",
        "GayBerneForce",
        "CMMotionRemover",
        "AndersenThermostat",
        *BAROSTATS,
    }
)


@dataclass(frozen=True)
class SystemRows:
    """The constraints of a System that act, as arrays.

    Attributes
    ----------
    masses : ndarray, shape (n_particles,)
    pairs : ndarray of int, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
        What OpenMM's solvers hold: SETTLE stores its distances in single precision.
    numbers : ndarray of int, shape (n_rows,)
        Which constraint of the System each row is. OpenMM ignores those between massless particles.
    settled : ndarray of bool, shape (n_rows,)
        Rows that SETTLE holds.
    others : ndarray, shape (n_rows,)
        What a GPU's SHAKE holds instead where it is responsible, which stores squares of lengths in single precision.
    slack : ndarray, shape (n_rows,)
        By how much a relative distance may differ from `lengths` although it is held exactly: what a GPU's SETTLE
        makes of its distances in single precision.
    """

    masses: FloatArray
    pairs: IntArray
    lengths: FloatArray
    numbers: IntArray
    settled: NDArray[np.bool_]
    others: FloatArray
    slack: FloatArray

    @classmethod
    def of(cls, system: openmm.System, *, rounded: bool = False) -> SystemRows:
        """Those of a System; `rounded` where a platform computes as GPUs do, see `Precision.rounds_lengths`.

        Raises
        ------
        InputError
            A length that is not above zero.
        """
        masses = masses_of(system)
        pairs, lengths, numbers = [], [], []
        for k in range(system.getNumConstraints()):
            i, j, d = system.getConstraintParameters(k)
            if masses[i] or masses[j]:
                if not 0 < d._value < np.inf:
                    raise InputError(
                        f"constraint {k} of the System (particles {i} and {j}) has a length of {d._value:g} nm, and a "
                        "distance can be held above zero only; give it its length, or make one of the particles a "
                        "virtual site at the place of the other",
                        item="constraints",
                        atoms=(i, j),
                    )
                pairs.append((i, j))
                lengths.append(d._value)
                numbers.append(k)
        table = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        given = np.array(lengths, dtype=float)
        settled = settled_rows(table, given, len(masses))
        held = np.where(settled, given.astype(np.float32).astype(float), given)
        shaken = np.sqrt((given**2).astype(np.float32).astype(float)) if rounded else held
        slack = np.where(settled & rounded, 2.0**-23, 0.0)
        return cls(masses, table, held, np.array(numbers, dtype=np.int64), settled, shaken, slack)

    @property
    def n_rows(self) -> int:
        return len(self.pairs)

    @property
    def rigid(self) -> bool:
        """Whether each molecule that is tied at all is a rigid body: all distances of its particles are held."""
        from scipy.sparse.csgraph import connected_components  # slow to import

        n = len(self.masses)
        i, j = np.unique(np.sort(self.pairs, axis=1), axis=0).T
        count, body = connected_components(csr_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)
        particles, rows = np.bincount(body, minlength=count), np.bincount(body[i], minlength=count)
        return bool((2 * rows == particles * (particles - 1)).all())

    def stretches(self, x: FloatArray) -> FloatArray:
        """(d - d0)/d0 of each row at positions x, shape (n_rows,), d0 being the nearer of what may be held."""
        r = x[self.pairs[:, 0]] - x[self.pairs[:, 1]]
        d = np.sqrt(np.einsum("ij,ij->i", r, r))
        first, second = d / self.lengths - 1, d / self.others - 1
        return np.where(np.abs(second) < np.abs(first), second, first)

    def speeds(self, x: FloatArray, v: FloatArray) -> FloatArray:
        """A v of each row, the rate of its distance, shape (n_rows,)."""
        i, j = self.pairs.T
        r = x[i] - x[j]
        return np.asarray(np.einsum("ij,ij->i", r, v[i] - v[j]) / np.sqrt(np.einsum("ij,ij->i", r, r)))

    def speeds_of_one(self, v: FloatArray) -> FloatArray:
        """What a tolerance of 1 is for each row: OpenMM's solvers look at 2 m_red A v/d in nm/ps, m_red in dalton.

        At least the root mean square velocity, shape (n_rows,).
        """
        with np.errstate(divide="ignore"):
            reduced = 1 / np.sum(1 / self.masses[self.pairs], axis=1)
        return np.maximum(self.lengths / (2 * reduced), np.sqrt(np.mean(v * v)))

    def name(self, row: int) -> str:
        i, j = self.pairs[row]
        return f"constraint {self.numbers[row]} of the System (particles {i} and {j}, {self.lengths[row]:.6g} nm)"

    def rank(self, x: FloatArray) -> int:
        """Independent rows at positions x. Isolated triangles have rank 3."""
        rest = ~self.settled
        count = int(np.sum(self.settled))
        if not rest.any():
            return count
        atoms, pairs = np.unique(self.pairs[rest], return_inverse=True)
        distances = Distance(pairs.reshape(-1, 2), self.lengths[rest])
        rows = ConstraintSet([distances], x[atoms], self.masses[atoms])
        return count + make_plan(rows, np.ascontiguousarray(x[atoms]), 0.0).rank


def worst_length(context: openmm.Context) -> tuple[str, float]:
    """The constraint of the System that is off most at the present positions.

    Of any integrator, so that those of OpenMM can be asked as well. OpenMM stores the lengths of rigid water in single
    precision, and on GPUs those of bonds to hydrogen as well: with any integrator they are off by up to 6e-8.

    Parameters
    ----------
    context : openmm.Context

    Returns
    -------
    name : str
        The constraint, its particles and its length; of a System without constraints, words that say so.
    off : float
        The part of its length by which it is off; 0 without constraints.

    Raises
    ------
    InputError
        No Context.
    """
    require_context(context)
    system = context.getSystem()
    rows = SystemRows.of(system)
    if not rows.n_rows:
        return "no constraint of the System", 0.0
    given = np.array([system.getConstraintParameters(k)[2]._value for k in rows.numbers.tolist()])
    rows = replace(rows, lengths=given, others=given)  # not what OpenMM makes of them
    off = np.abs(rows.stretches(np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)))
    row = int(np.argmax(off))
    return rows.name(row), float(off[row])


def settled_rows(pairs: IntArray, lengths: FloatArray, n: int) -> NDArray[np.bool_]:
    """Which rows are isolated triangles with two equal sides; OpenMM's own rule."""
    count = np.bincount(pairs.ravel(), minlength=n)
    neighbors: dict[int, dict[int, np.float32]] = {}
    for (i, j), d in zip(pairs.tolist(), lengths.astype(np.float32), strict=True):
        if count[i] == 2 and count[j] == 2:
            neighbors.setdefault(i, {})[j] = d
            neighbors.setdefault(j, {})[i] = d
    held = np.zeros(n, bool)
    for i, around in neighbors.items():
        if len(around) == 2:
            j, k = around
            if k in neighbors[j]:
                sides = {around[j], around[k], neighbors[j][k]}
                held[[i, j, k]] = len(sides) < 3
    return held[pairs[:, 0]] & held[pairs[:, 1]] if len(pairs) else np.zeros(0, bool)


def require_context(context: openmm.Context) -> None:
    """Refuse a Simulation, an integrator or whatever else is given for a Context.

    Raises
    ------
    InputError
    """
    if not isinstance(context, openmm.Context):
        raise InputError(
            f"context is a {type(context).__name__}; give the Context, such as simulation.context", item="context"
        )


def groups_of(force: openmm.Force) -> set[int]:
    """The force groups of a Force: that of its sum in reciprocal space may be another."""
    reciprocal = force.getReciprocalSpaceForceGroup() if hasattr(force, "getReciprocalSpaceForceGroup") else -1
    return {force.getForceGroup(), reciprocal} - {-1}


def groups_in(integrator: openmm.Integrator) -> set[int]:
    """The force groups that act on what an integrator moves."""
    groups = integrator.getIntegrationForceGroups()
    return {group for group in range(32) if groups >> group & 1}


def forces_alone(
    system: openmm.System,
    forces: Sequence[openmm.Force],
    box: Sequence | None = None,
    parameters: Mapping[str, float] | None = None,
) -> openmm.Context:
    """A Context of copies of some Forces alone, each in the group of its number, in double precision.

    Parameters
    ----------
    system : openmm.System
        Of its particles.
    forces : sequence of Force
    box : sequence of three vectors, optional
        In place of the System's default.
    parameters : mapping of str to float, optional
        Those of a Context.

    Raises
    ------
    UnsupportedError
        A PythonForce whose function cannot be copied.
    """
    alone = openmm.System()
    for k in range(system.getNumParticles()):
        alone.addParticle(system.getParticleMass(k))
    alone.setDefaultPeriodicBoxVectors(*(system.getDefaultPeriodicBoxVectors() if box is None else box))
    for group, force in enumerate(forces):
        try:
            taken = copy.deepcopy(force)
        except openmm.OpenMMException as error:
            raise UnsupportedError(f"{force.getName()}: {error} Define the function in a module") from error
        taken.setForceGroup(group)
        alone.addForce(taken)
    context = openmm.Context(alone, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    for name in context.getParameters():
        if parameters is not None:
            context.setParameter(name, parameters[name])
    return context


def forces_of(system: openmm.System) -> Iterable[openmm.Force]:
    return (system.getForce(k) for k in range(system.getNumForces()))


def removes_center_of_mass_motion(system: openmm.System) -> bool:
    return any(isinstance(force, openmm.CMMotionRemover) for force in forces_of(system))


def knows_a_place(force: openmm.Force) -> bool:
    """Whether a force may depend on where in space particles are, beyond distances and angles between them."""
    return type(force).__name__ not in _INVARIANT


def refuse_forgotten_parts(system: openmm.System, row_groups: Iterable[int]) -> None:
    """Refuse Forces that carry rows, where the integrator does not have the part that they belong to.

    Raises
    ------
    InputError
        There is one: it would act as a force, or do nothing, and nothing would be held.
    """
    known = set(row_groups)
    for force in forces_of(system):
        if force.getName().startswith(ROW_NAME) and force.getForceGroup() not in known:
            raise InputError(
                f"the System has a force {force.getName()!r}, which carries rows that are held, and the integrator has "
                "no part for it: pass what hold or CollectiveRows returned, "
                "ProjectedIntegrator(..., parts=[rows])",
                item="parts",
            )


def check_system(system: openmm.System) -> None:
    """Refuse Systems that a CustomIntegrator of kicks and drifts cannot propagate.

    Raises
    ------
    UnsupportedError
        Particles or forces that need an integrator of their own, more than one barostat, one that scales atoms one by
        one although bonds are held, rigid triangles that OpenMM's solver gets wrong.
    InputError
        The pressure of a barostat is not finite, the length of a constraint not above zero.
    """
    _refuse_lopsided(SystemRows.of(system))
    found = [force for force in forces_of(system) if type(force).__name__ in BAROSTATS]
    acting = [type(force).__name__ for force in found if force.getFrequency() > 0]
    if len(acting) > 1:
        raise UnsupportedError(
            f"the System has {len(acting)} barostats ({', '.join(acting)}): the volume would follow all of them, and "
            "belong to no ensemble. Remove all but one: system.removeForce(index)"
        )
    for force in forces_of(system):
        name = type(force).__name__
        if name in _FOREIGN:
            raise UnsupportedError(f"the System has a {name}: {_FOREIGN[name]}")
        if name in BAROSTATS and not np.isfinite(force.getDefaultPressure()._value).all():
            raise InputError(
                f"the {name} has a pressure of {force.getDefaultPressure()}, by which it would accept every trial; "
                "give a finite one",
                item="pressure",
            )
        if system.getNumConstraints() and _scales_atoms(force):
            raise UnsupportedError(f"the System has constraints, and {_ATOM_BY_ATOM}")


def _refuse_lopsided(rows: SystemRows) -> None:
    """OpenMM's SETTLE takes the two particles beside the apex to have one mass, and moves others wildly."""
    sides: dict[int, dict[int, float]] = {}
    for (i, j), d in zip(rows.pairs[rows.settled].tolist(), rows.lengths[rows.settled].tolist(), strict=True):
        sides.setdefault(min(i, j), {})[max(i, j)] = d
    for i, of in sides.items():
        if len(of) < 2:
            continue
        j, k = sorted(of)
        apex = i if of[j] == of[k] else j if of[j] == sides[j][k] else k
        first, second = (n for n in (i, j, k) if n != apex)
        if rows.masses[first] != rows.masses[second]:
            raise UnsupportedError(
                f"particles {i}, {j} and {k} are a rigid triangle, of which {first} and {second} have the masses "
                f"{rows.masses[first]:g} and {rows.masses[second]:g}: OpenMM's SETTLE needs equal ones, and moves "
                "others wildly. Hold it with kcons: move_constraints(system, keep_water=False), then hold"
            )


def _scales_atoms(force: openmm.Force) -> bool:
    return isinstance(force, openmm.MonteCarloFlexibleBarostat) and not force.getScaleMoleculesAsRigid()


def virtual_sites(system: openmm.System) -> list[int]:
    """The particles that OpenMM places by others."""
    return [k for k in range(system.getNumParticles()) if system.isVirtualSite(k)]


def parts_of_steps(context: openmm.Context, integrator: Integrator) -> bool:
    """Whether steps must be made in parts: forces are needed within the step, and virtual sites are placed at its end.

    Raises
    ------
    UnsupportedError
        There are such sites, and steps cannot be made in parts.
    """
    system, platform = context.getSystem(), context.getPlatform().getName()
    sites = virtual_sites(system)
    if not sites:
        return False
    late = platform in _LATE
    where = f"particle {sites[0]} is a virtual site"
    if integrator.parts and not any(part.sited for part in integrator.parts):
        raise UnsupportedError(
            f"{where}, of which {integrator.parts[0]!r} does not know; hold rows after the sites were added, by hold "
            "or CollectiveRows"
        )
    if integrator.parts and late and "phase" not in integrator.program.idle:
        raise UnsupportedError(
            f"{where}: {platform} places virtual sites at the end of a program only, and beside parts= steps of "
            f"several drifts ({integrator.scheme!r}) are not made in parts; use scheme='rattle'"
        )
    if late and type(context.getIntegrator()) is openmm.CompoundIntegrator:
        raise UnsupportedError(
            f"{where}: {platform} places virtual sites at the end of a program only, and within a CompoundIntegrator "
            "OpenMM runs it as a whole, with forces of sites that are one step old. Use the integrator alone"
        )
    return late


def refuse_agents(
    system: openmm.System,
    bound: str | None,
    rows: Iterable[tuple[IntArray, Callable[[int], str]]] = (),
    molecules: Callable[[], Iterable[Sequence[int]]] = tuple,
) -> None:
    """Refuse what moves particles off rows between steps: barostats, and a CMMotionRemover.

    Parameters
    ----------
    system : openmm.System
    bound : str, optional
        A row that holds particles in space.
    rows : iterable of (ndarray of int of shape (n, width), function)
        The particles of rows of one kind, and their names by number.
    molecules : callable
        The molecules, which barostats move as wholes, each by a vector of its own.

    Raises
    ------
    UnsupportedError
    """
    for force in forces_of(system):
        name = type(force).__name__
        moves = isinstance(force, openmm.CMMotionRemover)
        if bound is not None and (moves or name in BAROSTATS):
            what = "shifts all velocities" if moves else "moves molecules"
            raise UnsupportedError(
                f"{name} {what}, and {bound} holds particles in space, so that momentum is not conserved: take it out "
                "of the System (createSystem(..., removeCMMotion=False)), or hold differences of positions only"
            )
        if name not in BAROSTATS:
            continue
        if _scales_atoms(force):
            raise UnsupportedError(f"rows are held, and {_ATOM_BY_ATOM}")
        label = np.empty(system.getNumParticles(), dtype=np.int64)
        for number, members in enumerate(molecules()):
            label[list(members)] = number
        for atoms, name_of in rows:
            apart = (label[atoms] != label[atoms[:, :1]]).any(axis=1)
            if apart.any():
                raise UnsupportedError(
                    f"{name} moves molecules apart, but row {name_of(int(np.argmax(apart)))} holds atoms of several; "
                    "let them count as one molecule by hold(system, ..., join=True) or by bonds of no strength, or run "
                    "at constant volume"
                )


#: Relative difference of two temperatures that is taken for rounding.
_ROUNDING = 1e-6


def warn_of_barostat(context: openmm.Context, temperature: float | None, stacklevel: int) -> None:
    """Warn where a barostat judges its trials by another temperature (K) than the thermostat keeps, if there is one."""
    for force in forces_of(context.getSystem()):
        if temperature is None or type(force).__name__ not in BAROSTATS:
            continue
        name = type(force).Temperature()
        found = float(context.getParameter(name))
        if abs(found - temperature) > _ROUNDING * temperature:
            warnings.warn(
                f"the {type(force).__name__} has a temperature of {found:g} K, and the integrator one of "
                f"{temperature:g} K: volumes belong to neither. Call context.setParameter({name!r}, {temperature:g})",
                stacklevel=stacklevel,
            )
