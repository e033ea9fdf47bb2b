"""What an integrator looks at: its System, which it may have to refuse, and the state of its Context; and the way back.

OpenMM ignores a constraint solver that does not converge; the residuals here are computed from positions and
velocities, independently of it.
"""

from __future__ import annotations

import copy
import gc
import logging
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, cast

import numpy as np
import openmm
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import CertificateError, ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.motion.certificate import MOST, SHARE
from kcons.motion.motion import Motion
from kcons.openmm.integrator.part import NEAR, SINGLE, Part, Precision, Violation
from kcons.openmm.integrator.program import Integrator, forces_at_old_positions
from kcons.openmm.quantities import (
    box_of,
    held_pairs,
    held_without_mass,
    masses_of,
    motion_of,
    positions_of,
    velocities_of,
    width_of,
)

logger = logging.getLogger("kcons.openmm")

#: With a note in the log, unless it is what a looser tolerance or single precision leaves.
TIDY = 1e-4
#: Spacing of coordinates, of the length of a row, beyond which a warning is given.
COARSE = 1e-11
#: Speed of light, nm/ps: a System whose particles are faster on average has exploded.
_LIGHT = 299792.458
#: How often OpenMM's solver is asked for positions: that of OpenCL may need a second call from starts that are off.
_CALLS = 4
_REMEDY = "let kcons hold these constraints: take them out of the System and hand them over as constraint objects"
#: Relative difference of two temperatures that is taken for rounding.
_ROUNDING = 1e-6
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


# -- a System -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SystemRows:
    """The constraints of a System that act, as arrays, the first of n_particles and the others of n_rows."""

    masses: FloatArray
    pairs: IntArray
    #: What OpenMM's solvers hold: SETTLE stores its distances in single precision.
    lengths: FloatArray
    #: Which constraint of the System each row is. OpenMM ignores those between massless particles.
    numbers: IntArray
    #: Rows that SETTLE holds.
    settled: NDArray[np.bool_]
    #: What a GPU's SHAKE holds instead where it is responsible, which stores squares of lengths in single precision.
    others: FloatArray
    #: By how much a relative distance that is held exactly may differ from `lengths`: a GPU's SETTLE rounds.
    slack: FloatArray

    @classmethod
    def of(cls, system: openmm.System, *, rounded: bool = False) -> SystemRows:
        """Those of a System, `rounded` as on GPUs; `InputError` for lengths of 0 and less."""
        masses, (pairs, lengths) = masses_of(system), held_pairs(system)
        numbers = np.flatnonzero((masses[pairs] != 0).any(axis=1))
        pairs, given = pairs[numbers], lengths[numbers]
        for k in np.flatnonzero(~((given > 0) & (given < np.inf)))[:1]:
            i, j = pairs[k].tolist()
            raise InputError(
                f"constraint {numbers[k]} of the System (particles {i} and {j}) has a length of {given[k]:g} nm, and a "
                "distance can be held above zero only; give it its length, or make one of the particles a virtual site "
                "at the place of the other",
                item="constraints",
                atoms=(i, j),
            )
        settled = settled_rows(pairs, given, len(masses))
        held = np.where(settled, given.astype(np.float32).astype(float), given)
        shaken = np.sqrt((given**2).astype(np.float32).astype(float)) if rounded else held
        slack = np.where(settled & rounded, 2.0**-23, 0.0)
        return cls(masses, pairs, held, numbers, settled, shaken, slack)

    @property
    def n_rows(self) -> int:
        return len(self.pairs)

    @property
    def rigid(self) -> bool:
        """Whether each molecule that is tied at all is a rigid body: all distances of its particles are held."""
        pairs = np.unique(np.sort(self.pairs, axis=1), axis=0)
        body = components(len(self.masses), pairs)
        particles = np.bincount(body)
        rows = np.bincount(body[pairs[:, 0]], minlength=len(particles))
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
        """Independent rows at positions x; of straight and flat groups all that hold them so, as `Motion` counts."""
        if not self.n_rows:
            return 0
        atoms, pairs = np.unique(self.pairs, return_inverse=True)
        rows = ConstraintSet([Distance(pairs.reshape(-1, 2), self.lengths)], x[atoms], self.masses[atoms])
        return Motion(rows, x[atoms]).rank


def components(n: int, pairs: ArrayLike) -> IntArray:
    """Number of the component of each of n things that pairs join, shape (n,)."""
    i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    links = coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


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
    given = held_pairs(system)[1][rows.numbers]
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
    """Raise `InputError` for a Simulation, an integrator or whatever else is given for a Context."""
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
    box: Any = None,
    parameters: Mapping[str, float] | None = None,
) -> openmm.Context:
    """A Context of copies of some Forces alone, each in the group of its number, in double precision.

    In a box other than the System's default, and with the parameters of another Context, if these are given;
    `UnsupportedError` for a PythonForce whose function cannot be copied.
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


def check_system(system: openmm.System, row_groups: Iterable[int]) -> None:
    """Refuse Systems that a CustomIntegrator of kicks and drifts cannot propagate.

    `UnsupportedError` for particles or forces that need an integrator of their own, more than one barostat, one that
    scales atoms one by one although bonds are held, rigid triangles that OpenMM's solver gets wrong. `InputError` for a
    pressure that is not finite, a length not above zero, and Forces that carry rows in a group that is not among
    `row_groups`: they would act as forces, or do nothing, and nothing would be held.
    """
    _refuse_lopsided(SystemRows.of(system))
    taken: set[int] = set()
    acting = [type(f).__name__ for f in forces_of(system) if type(f).__name__ in BAROSTATS and f.getFrequency() > 0]
    if len(acting) > 1:
        raise UnsupportedError(
            f"the System has {len(acting)} barostats ({', '.join(acting)}): the volume would follow all of them, and "
            "belong to no ensemble. Remove all but one: system.removeForce(index)"
        )
    for force in forces_of(system):
        name = type(force).__name__
        if force.getName().startswith(ROW_NAME) and force.getForceGroup() not in row_groups:
            raise InputError(
                f"the System has a force {force.getName()!r}, which carries rows that are held, and the integrator has "
                "no part for it: pass what hold or CollectiveRows returned, ProjectedIntegrator(..., parts=[rows])",
                item="parts",
            )
        if shared := groups_of(force) & taken & set(row_groups):
            raise InputError(f"force group {min(shared)} carries a row: give other forces in it another", item="groups")
        taken |= groups_of(force)
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
    """Whether steps are made in parts: forces are needed within a step, and virtual sites are placed at its end.

    `UnsupportedError` where there are such sites, and steps cannot be made in parts.
    """
    system, platform = context.getSystem(), context.getPlatform().getName()
    sites = virtual_sites(system)
    if not sites or integrator.program.on_device:  # which places them itself before it evaluates forces
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
    rows: Iterable[tuple[IntArray, Callable[[int], str], NDArray[np.bool_]]] = (),
    molecules: Callable[[], Iterable[Sequence[int]]] = tuple,
) -> None:
    """Refuse, by `UnsupportedError`, what disturbs rows between steps: barostats, CMMotionRemover, AndersenThermostat.

    `bound` names a row that holds particles in space; `rows` are the particles of rows of one kind, shape (n, width),
    their names by number, and which go through faces of the box; barostats move each molecule by a vector of its own.
    """
    for force in forces_of(system):
        name = type(force).__name__
        moves, scales = isinstance(force, openmm.CMMotionRemover), name in BAROSTATS and force.getFrequency() > 0
        if bound is not None and (moves or scales):
            way = "createSystem(..., removeCMMotion=False)" if moves else "constant volume"
            raise UnsupportedError(
                f"{name} moves what {bound} holds in space: take it out of the System ({way}), or hold differences of "
                "positions only"
            )
        if isinstance(force, openmm.AndersenThermostat):
            raise UnsupportedError(f"{name} draws velocities of single atoms, which makes rows cold; use Langevin")
        if not scales:
            continue
        if _scales_atoms(force):
            raise UnsupportedError(f"rows are held, and {_ATOM_BY_ATOM}")
        label = np.empty(system.getNumParticles(), dtype=np.int64)
        for number, members in enumerate(molecules()):
            label[list(members)] = number
        for atoms, name_of, cut in rows:
            if cut.any():
                raise UnsupportedError(
                    f"{name} changes the box, and row {name_of(int(np.argmax(cut)))} goes through its faces; shift "
                    "molecules by box vectors until the atoms of each row lie side by side, or run at constant volume"
                )
            apart = (label[atoms] != label[atoms[:, :1]]).any(axis=1)
            if apart.any():
                raise UnsupportedError(
                    f"{name} moves molecules apart, but row {name_of(int(np.argmax(apart)))} holds atoms of several; "
                    "let them count as one molecule by hold(system, ..., join=True) or by bonds of no strength, or run "
                    "at constant volume"
                )


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


# -- a Context ------------------------------------------------------------------------------------


def find_context(integrator: openmm.Integrator) -> openmm.Context | None:
    """The Context that was made with this integrator: the one that refers to it. Asked once for each Context.

    OpenMM tells an integrator nothing of its Context, which has the integrator as an attribute.
    """
    for holder in gc.get_referrers(integrator):
        # Attributes are a dictionary of their own where somebody has asked for it.
        kept = type(holder) is dict and holder.get("_integrator") is integrator
        for owner in gc.get_referrers(holder) if kept else [holder]:
            if issubclass(type(owner), openmm.Context) and owner.getIntegrator() is integrator:
                return owner
    return None


class Guard:
    """Watches over one Context of an integrator; `UnsupportedError` for a System that it cannot propagate."""

    def __init__(self, context: openmm.Context, integrator: Integrator) -> None:
        self._context, self._integrator = weakref.ref(context), weakref.ref(integrator)
        self.system = context.getSystem()
        self._size = _size(self.system)
        check_system(self.system, integrator.row_groups)
        self.in_parts = parts_of_steps(context, integrator)  # whether steps are made in parts
        self.precision = precision = Precision.of(context)
        #: The constraints of the System.
        self.rows = SystemRows.of(self.system, rounded=precision.rounds_lengths)
        integrator.take_precision(precision)
        self._refuse_old_positions()
        #: Whether something in the System moves x between steps.
        self.moving = any("Barostat" in type(force).__name__ for force in forces_of(self.system))
        for name, value in (("coarse", precision.name == "single"), ("moving", self.moving)):
            if name in integrator.program.settings:
                integrator.program.set(name, float(value))
        #: Whether velocities may lack half a kick and a projection until they are read: a thermostat reads them, and
        #: a CMMotionRemover, to which half a kick matters where forces add up to something, on what has mass.
        applied = [force for force in forces_of(self.system) if force.getForceGroup() not in integrator.row_groups]
        self.undisturbed = not (
            any(isinstance(force, openmm.AndersenThermostat) for force in applied)
            or (removes_center_of_mass_motion(self.system) and (any(map(knows_a_place, applied)) or self.bound()))
        )
        #: Whether the start was looked at.
        self.started = False
        #: g of the thermostat, and the momenta that are conserved, once they are known.
        self.thermal: int | None = None
        self.momenta: Any = None
        self.since_check = 0
        self._explosive = len(self.rows.masses) * _LIGHT**2
        #: Whether the program sums squares of velocities where a call ends. Reference and CPU would make other noise,
        #: since they draw random numbers with each sum.
        self.sums = precision.rounds_lengths or not integrator.ensemble.noisy
        self._good: openmm.State | None = None
        #: When the last check ended, what it took, and how many were put off since.
        self._checked, self._cost, self._put_off = perf_counter(), 0.0, 0
        self._freedom: int | None = None
        self._left: tuple[Any, ...] | None = None
        self._parameters: dict[str, float] | None = None

    @property
    def alive(self) -> openmm.Context | None:
        return self._context()

    @property
    def context(self) -> openmm.Context:
        return cast(openmm.Context, self._context())

    @property
    def integrator(self) -> Integrator:
        return self._integrator()

    def _refuse_old_positions(self) -> None:
        """Raise where rows would be computed at old positions."""
        integrator, precision = self.integrator, self.precision
        concerned = integrator.parts and precision.rounds_lengths and self.system.getNumConstraints()
        if concerned and forces_at_old_positions(integrator.program.lines):
            raise UnsupportedError(
                f"{precision} computes these rows at old positions where the System has constraints as well; give "
                "CollectiveRows meets_system=True; with constraint objects take scheme 'rattle' at constant energy or "
                "let kcons hold all constraints (hold(system, ..., take='all', keep_water=False)); or run on the CPU "
                "platform"
            )

    # -- constraints of the System ---------------------------------------------------------------

    def limit(self, x: FloatArray) -> FloatArray:
        """What each relative residual may be, given the tolerance and the size of the coordinates.

        In mixed precision OpenMM rounds positions of molecules that it moves back into the box to single numbers, until
        the next step.
        """
        coarse = self.precision.name == "mixed" and self.system.usesPeriodicBoundaryConditions()
        place = SINGLE if coarse else self.precision.place
        inside = width_of(self.context) if coarse else 0.0
        reach = np.maximum(np.abs(x[self.rows.pairs]).max(axis=(1, 2), initial=0.0), inside) / self.rows.lengths
        # The tolerance is that of the solver; OpenMM checks the squares of the distances. The coordinates of two
        # particles are rounded.
        rounding = self.precision.solvers + 2 * np.sqrt(3) * place * reach
        return np.asarray(2 * self.integrator.getConstraintTolerance() + rounding + self.rows.slack)

    def check_lengths(self, x: FloatArray, step: int | None) -> None:
        """Raise if a constraint of the System is not fulfilled at positions x."""
        if not self.rows.n_rows:
            return
        miss = np.abs(self.rows.stretches(x))
        limit = self.limit(x)
        excess = miss / limit
        row = int(np.argmax(excess))
        if not excess[row] <= 1:  # also NaN
            if self._read_again():
                self.check_lengths(x, step)
                return
            tolerance = self.integrator.getConstraintTolerance()
            raise ConvergenceError(
                f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative), at a tolerance of {tolerance:g} "
                f"({self.precision}, which holds {limit[row]:.2g}): the solvers of OpenMM did not converge and "
                f"do not tell. Take a smaller time step, or {_REMEDY}",
                residual=float(miss[row]),
                tolerance=tolerance,
                row=int(self.rows.numbers[row]),
                atoms=self.rows.pairs[row],
                step=step,
            )

    def hold_positions(self, tolerance: float) -> None:
        """Bring the positions of the Context onto the constraints of the System."""
        for _ in range(_CALLS):
            self.context.applyConstraints(tolerance)
            x = positions_of(self.context)
            if not self.rows.n_rows or np.all(np.abs(self.rows.stretches(x)) <= self.limit(x)):
                return

    def speed_violation(self, x: FloatArray, v: FloatArray) -> Violation | None:
        """A constraint of the System along which particles move."""
        rows, tolerance = self.rows, self.integrator.getConstraintTolerance()
        if not rows.n_rows:
            return None
        allowed = (10 * tolerance + self.precision.solvers) * rows.speeds_of_one(v)
        allowed += (self.limit(x) + self.precision.speeds) * np.sqrt(np.mean(v * v))
        found = Violation.worst("velocities", rows.speeds(x, v), allowed, rows.name, lambda k: rows.pairs[k].tolist())
        return self.speed_violation(x, v) if found is not None and self._read_again() else found

    def _read_again(self) -> bool:
        """Whether the System has other constraints or masses since it was read, as before `Context.reinitialize`."""
        now = SystemRows.of(self.system, rounded=self.precision.rounds_lengths)
        if all(np.array_equal(value, vars(self.rows)[name]) for name, value in vars(now).items()):
            return False
        self.rows, self._freedom, self.thermal, self.momenta = now, None, None, None
        self.started = False  # the next call finds g anew
        return True

    # -- calls ----------------------------------------------------------------------------------

    @property
    def knows(self) -> bool:
        """Whether the Context is where the last call left it, as far as clock, box, and what the System has tell."""
        context = self._context()
        return context is not None and self._size == _size(self.system) and self._left in (None, self._place(context))

    def _place(self, context: openmm.Context) -> tuple[Any, ...]:
        """Where a call ends: step count, box, and the time, where targets depend on it."""
        driven = any(part.driven for part in self.integrator.parts)
        return context.getStepCount(), box_of(context), context.getTime()._value if driven else 0.0

    @property
    def in_run(self) -> bool:
        """Whether a call of `step` has ended, or failed, before this one."""
        return self._left is not None

    def enter(self) -> None:
        """A call of `step` begins."""
        if self.started and self._parameters != dict(self.context.getParameters()):
            self.integrator.refresh()
            if self.momenta is not None:  # a field may have been switched on, and g is another
                before, self.thermal, self.momenta = self.thermal, None, None
                self.started = before == cast(Any, self.integrator.ensemble).count(self.integrator)
        if not self.started:
            self.begin()

    def leave(self) -> None:
        """A call of `step` ends."""
        self._left, self._parameters = self._place(self.context), dict(self.context.getParameters())

    def begin(self) -> None:
        """Before the first step, and where others have moved x: x and v on the constraints, or refused.

        `InputError` for positions off the constraints by more than `NEAR`, `NonFiniteError` for a NaN, and what a part
        finds wrong.
        """
        context, integrator = self.context, self.integrator
        x, v = motion_of(context)
        check_finite(x, v, context.getStepCount(), self.rows.n_rows > 0)
        if self.started:
            integrator.refresh()
        else:
            self._read_again()  # `Context.reinitialize` may have come since this Context was seen first
            # OpenMM keeps the forces of a CustomIntegrator whatever has happened to the box.
            context.setVelocities(v)
        try:
            for part in integrator.parts:
                part.attach(integrator.program, context)
            self._put_right(x)
            off = self.speed_violation(*motion_of(context)) is not None
            # Velocities of a run that is continued stay bit for bit.
            if off or any(part.worst_violation(context) is not None for part in integrator.parts):
                integrator.applyVelocityConstraints(context)
            for part in integrator.parts:
                if not self.started:
                    part.check(context)
                elif (miss := part.worst_violation(context)) is not None:
                    raise InputError(
                        f"the {miss}. What moved them does not know the rows that are held (OpenMM's minimizer is one: "
                        "take integrator.minimizeEnergy); call integrator.applyConstraints(context) and "
                        "integrator.applyVelocityConstraints(context)",
                        item=miss.what,
                        atoms=miss.atoms,
                    )
            if not self.started:
                self._tell_of_rounding(positions_of(context))
                warn_of_barostat(context, getattr(integrator.ensemble, "temperature", None), stacklevel=5)
                integrator.ensemble.begin(integrator, context)
        except Exception:
            context.setPositions(x)
            context.setVelocities(v)
            raise
        self.started = True
        self._remember(context.getState(positions=True, velocities=True))

    def _tell_of_rounding(self, x: FloatArray) -> None:
        """Warn of coordinates so large that their rounding adds noise to the velocities."""
        for motion in (part.motion for part in self.integrator.parts if hasattr(part, "motion")):
            held = motion.constraint_set
            reach = float(np.abs(x[held.touched]).max(initial=0.0))
            grain = 2 * self.precision.place * reach
            if self.precision.name != "single" and held.n_rows and grain > COARSE * held.scale.min():
                warnings.warn(
                    f"held particles are {reach:.3g} nm from the origin, where OpenMM rounds positions to {grain:.1g} "
                    "nm; each step turns this into velocity, and the energy wanders. Move the origin nearer",
                    stacklevel=5,
                )

    def _put_right(self, x: FloatArray) -> None:
        """Bring positions that are near the constraints onto them."""
        integrator, context = self.integrator, self.context
        miss = np.abs(self.rows.stretches(x))
        row = int(np.argmax(miss)) if len(miss) else 0
        if len(miss) and not miss[row] <= NEAR:
            remedy = "minimize the energy or call integrator.applyConstraints(context)" if x.any() else "set positions"
            raise InputError(
                f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative) at the start; {remedy} first",
                item="positions",
                atoms=self.rows.pairs[row],
            )
        misses = _misses(integrator.parts, context)
        near = bool(misses) and all(found.near for found in misses)  # those that are far are refused later
        if not near and not np.any(miss > self.limit(x)):
            return
        if not near:
            self.hold_positions(integrator.getConstraintTolerance())
            near = not misses and bool(_misses(integrator.parts, context))  # the System pulled them off
        if near:
            integrator.applyConstraints(context)
        now = positions_of(context)
        self.check_lengths(now, None)
        if near or miss[row] > TIDY:
            moved = float(np.sqrt(np.max(np.sum((now - x) ** 2, axis=1))))
            worst = f"{self.rows.name(row)} was off by {miss[row]:.2g} of its length" if len(miss) else ""
            worst = f"the {misses[0]}" if misses else worst
            logger.warning("the start was put right: %s; particles were moved by up to %.3g nm", worst, moved)

    # -- after steps ----------------------------------------------------------------------------

    def look(self) -> None:
        """The end of a call: whether velocities are finite and slower than light, root mean square.

        That is what can be seen at next to no cost. If not, the Context is put back to where it was checked last.
        """
        v = None if self.sums else velocities_of(self.context)
        squares = self.integrator.getGlobalVariableByName("motion") if v is None else float(np.vdot(v, v))
        if squares <= self._explosive:
            return
        context, held = self.context, self.rows.n_rows > 0
        step, v = context.getStepCount(), velocities_of(context)
        try:
            self.integrator.ensemble.verify(self.integrator)
            check_finite(positions_of(context), v, step, held)
            speeds = np.sqrt(np.einsum("ij,ij->i", v, v))
            atom = int(np.argmax(speeds))
            raise NonFiniteError(
                f"particle {atom} has a velocity of {speeds[atom]:.3g} nm/ps at step {step}: the System has exploded; "
                f"{_smaller_step(held)}",
                item="velocity",
                atom=atom,
                step=step,
            )
        except (ConvergenceError, InputError, NonFiniteError) as error:
            self.go_back(error)
            raise

    def count(self, steps: int) -> None:
        """Count steps that were made; check where a check is due, and put the Context back where that fails.

        Where the integrator may spare them, checks wait while they would take more than `SHARE` of the time.
        """
        self.since_check += steps
        if not 0 < self.integrator.check_every <= self.since_check:
            return
        spare = self.integrator.spare and self._put_off < MOST
        if spare and self._cost > SHARE * (perf_counter() - self._checked):
            self._put_off += 1
            self.since_check = 0
            return
        begun = perf_counter()
        try:
            self.check()
        except (CertificateError, ConvergenceError, InputError, NonFiniteError) as error:
            if isinstance(error, CertificateError):
                error.state = self._good
            self.go_back(error)
            raise
        self._cost = self._checked - begun

    def check(self) -> None:
        """Whether positions and velocities are finite and on all that is held: the state to come back to.

        What is held is asked itself: the constraints of the System and the rows of the parts at the positions and
        velocities of the Context, whatever the solvers have found.
        """
        context, integrator = self.context, self.integrator
        step = context.getStepCount()
        try:
            integrator.ensemble.verify(integrator)
            now = context.getState(positions=True, velocities=True)
            x = np.asarray(now.getPositions(asNumpy=True)._value)
            v = np.asarray(now.getVelocities(asNumpy=True)._value)
            check_finite(x, v, step, self.rows.n_rows > 0)
            for part in integrator.parts:
                part.check_masses(self.system)
            if (self.thermal or self._freedom) and not np.array_equal(masses_of(self.system), self.rows.masses):
                self._read_again()
            self.check_lengths(x, step)
            for miss in (self.speed_violation(x, v), *(part.worst_violation(context) for part in integrator.parts)):
                self.certify(miss, f"at step {step} ")
        except (CertificateError, ConvergenceError, NonFiniteError) as error:
            error.step = step
            raise
        self._remember(now)

    def go_back(self, error: KconsError) -> None:
        """The state that was checked last, and the error says so."""
        if self._good is not None:
            self.put_back()
            good = self.context.getStepCount()
            error.args = (f"{error}. The Context is back at step {good}, the last that was checked", *error.args[1:])

    def certify(self, miss: Violation | None, where: str = "") -> None:
        """Raise `CertificateError` for a miss that the solvers have not told of."""
        if miss is not None:
            raise CertificateError(
                f"{where}the {miss}, allowed {miss.allowed:.3g}. The solvers reported success; take a smaller time "
                "step, or find what else changed the state or the constraints",
                row=miss.row,
                residual=abs(miss.off),
                atoms=miss.atoms,
            )

    def _remember(self, now: openmm.State) -> None:
        self.since_check = self._put_off = 0
        self._good, self._memory = now, self.integrator.program.remembered()
        self._checked = perf_counter()

    def put_back(self) -> None:
        """The state that was checked last."""
        if self._good is not None:
            good, context = self._good, self.context
            context.setPeriodicBoxVectors(*good.getPeriodicBoxVectors())
            context.setPositions(good.getPositions(asNumpy=True))
            context.setVelocities(good.getVelocities(asNumpy=True))
            context.setTime(good.getTime())
            context.setStepCount(good.getStepCount())
            self.integrator.program.recall(self._memory)
            self.integrator.refresh()
            self.since_check = 0
            self.leave()

    def explosion(self, words: str, step: int) -> NonFiniteError:
        """The error for a NaN that OpenMM met after `step`, once the state is put back."""
        remedy = _smaller_step(self.rows.n_rows > 0)
        return NonFiniteError(
            f"{words} It appeared after step {step}; positions and velocities are those of step "
            f"{self.context.getStepCount()}. {remedy[0].upper()}{remedy[1:]}",
            item="position",
            step=step,
        )

    # -- degrees of freedom ---------------------------------------------------------------------

    def bound(self) -> list[int]:
        """Particles that stay or go elsewhere as others are shifted: without mass, and images by symmetry."""
        system, kinds = self.system, ("SymmetrySite", "VirtualSite")  # OpenMM's Python tells the class of all others
        images = [k for k in virtual_sites(system) if type(system.getVirtualSite(k)).__name__ in kinds]
        return held_without_mass(system) + images

    def independent_momenta(self) -> int:
        """Three for each particle with a mass, less the rank of all constraints."""
        if self._freedom is None:
            moving = 3 * int(np.sum(self.rows.masses > 0))
            held = sum(part.rank(self.context) for part in self.integrator.parts)
            self._freedom = moving - held - self.rows.rank(positions_of(self.context))
        return self._freedom

    def degrees_of_freedom(self) -> int:
        """Also less three where a CMMotionRemover acts."""
        return self.independent_momenta() - (3 if removes_center_of_mass_motion(self.system) else 0)


def _size(system: openmm.System) -> tuple[int, int, list[Any]]:
    acting = [(type(force), getattr(force, "getFrequency", bool)()) for force in forces_of(system)]
    return system.getNumParticles(), system.getNumConstraints(), acting


def _misses(parts: Iterable[Part], context: openmm.Context) -> list[Violation]:
    """Rows whose positions are off, the worst of each part."""
    return [found for part in parts if (found := part.worst_violation(context, velocities=False)) is not None]


def _smaller_step(held: bool) -> str:
    """The remedy for what explodes; `held` where the System has constraints."""
    solver = f". Where the solvers of OpenMM diverge, {_REMEDY}" if held else ""
    return f"take a smaller time step, or minimize the energy first{solver}"


def check_finite(x: FloatArray, v: FloatArray, step: int, held: bool) -> None:
    """Raise `NonFiniteError` for a NaN or infinity; `held` where the System has constraints."""
    for array, item in ((x, "position"), (v, "velocity")):
        finite = np.isfinite(array)
        if not finite.all():
            atom = int(np.argmin(finite.all(axis=1)))
            raise NonFiniteError(
                f"the {item} of particle {atom} is not finite at step {step}; {_smaller_step(held)}",
                item=item,
                atom=atom,
                step=step,
            )
