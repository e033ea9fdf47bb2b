"""Stochastic isokinetic baths: velocities of each cluster stay on spheres, together with auxiliary variables.

y = (u, w), the mass-weighted velocities of g degrees of freedom and L auxiliary variables, keeps |y|^2 = R^2 =
(g + L - 1) k_B T. Kicks turn y, free flight keeps |u|, and the bath moves y on the sphere without changing the uniform
distribution there. Configurations are then canonical, and no degree of freedom can take up more energy than its sphere
has, so that resonances of slow kicks stay bounded.

A cluster's kinetic energy is conserved in free flight, that of its center of mass alone as well unless a row knows a
place in space. Each part that is conserved by itself may have a sphere of its own.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kcons.constraints.arguments import FromZero, Positive, Rng, checked
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.solvers.kernels.aligned_memory import in_one_array
from kcons.solvers.rank_revealing import rank
from kcons.steppers import State, System
from kcons.steppers.compiled_operations import check_finite
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Operation, Program, Project, Row
from kcons.thermostats import sphere_kernels as kernels
from kcons.thermostats.force_groups import SlowKicks
from kcons.thermostats.freedom import MARK, carried, placed_rows, refuse_driven
from kcons.thermostats.langevin import GroupedSteps, SeededBath

Spheres = Literal["split", "axes", "cluster", "global"]

logger = logging.getLogger("kcons.thermostats")

_NO_BATH = "which the spheres of an isokinetic bath do not follow; use Langevin or LangevinRespa"
#: Part of a step whose noise is drawn for the auxiliary variables at the start of a run.
_BEGIN = 2**63


@dataclass(frozen=True, eq=False)
class SphereLayout:
    """The spheres of a system."""

    cluster: IntArray  # of each atom, -1 for fixed ones
    spheres: IntArray  # (n_clusters, 4): of the center of mass along x, y and z (all -1: none of its own); of the rest
    masses: FloatArray  # of the atoms, 0 for fixed ones
    totals: FloatArray  # of the clusters
    freedom: IntArray  # degrees of freedom g on each sphere

    @classmethod
    def of(cls, system: System, positions: FloatArray, kind: Spheres) -> SphereLayout:
        """The spheres of one kind; ranks of clusters with dependent rows are found at the positions.

        Refused are targets that move, rows that hold velocities, ranks of clusters that do not add up, and systems in
        which nothing can move.
        """
        refuse_driven(system, _NO_BATH)
        moving = system.inverse_masses[:, 0] > 0
        if kind == "global":
            cluster, tied = np.where(moving, 0, -1), np.ones(1, dtype=bool)
            free = np.array([system.motion.degrees_of_freedom])
        else:
            cluster, tied, free = _clusters(system, moving, positions)
        n = len(free)
        spheres = np.full((n, 4), -1, dtype=np.int64)
        counts = np.zeros((n, 4), dtype=np.int64)
        open_ = ~tied & (kind in ("split", "axes"))
        if kind == "axes":
            counts[open_, :3] = 1
        else:
            counts[open_, 0] = 3
        counts[:, 3] = free - 3 * open_
        own = counts > 0
        spheres[own] = np.arange(own.sum())
        if kind == "split":
            spheres[open_, 1:3] = spheres[open_, :1]
        if not own.any():
            raise OverdeterminedError("no degree of freedom is left for the thermostat: hold fewer rows")
        masses = np.where(moving, system.masses, 0.0)
        totals = np.zeros(n)
        np.add.at(totals, cluster[moving], masses[moving])
        return cls(cluster.astype(np.int64), spheres, masses, totals, counts[own])

    def squares(self, thermal_energy: float, auxiliary: int) -> FloatArray:
        """R^2 = (g + L - 1) k_B T of each sphere; `InputError` where that is 0."""
        sizes = self.freedom + auxiliary - 1
        if (sizes < 1).any():
            count = int((sizes < 1).sum())
            raise InputError(
                f"{count} spheres of one degree of freedom and no auxiliary variable have the radius 0; "
                "give auxiliary=1 or more",
                item="auxiliary",
            )
        return np.asarray(thermal_energy * sizes)


def _clusters(system: System, moving: BoolArray, positions: FloatArray) -> tuple[IntArray, BoolArray, IntArray]:
    """Cluster of each atom (free atoms are their own), whether a row ties it to space, degrees of freedom."""
    held, labels = system.motion.constraint_set, system.motion.plan.labels
    incidence = held.incidence
    row_of = np.repeat(np.arange(held.n_rows), np.diff(incidence.indptr))
    inside = labels[row_of] >= 0
    atoms, rows = incidence.indices[inside], row_of[inside]
    found = np.full(held.n_atoms, -1, dtype=np.int64)
    movable = moving[atoms]
    found[atoms[movable]] = labels[rows[movable]]
    count = int(labels.max(initial=-1)) + 1
    placed = np.zeros(count, dtype=bool)
    placed[labels[rows[~movable]]] = True
    placed[labels[placed_rows(held) & (labels >= 0)]] = True
    alone = np.flatnonzero(moving & (found < 0))
    found[alone] = count + np.arange(len(alone))
    free = 3 * np.bincount(found[found >= 0], minlength=count + len(alone))
    free[:count] -= _ranks(system, count, positions)
    return found, np.append(placed, np.zeros(len(alone), bool)), free


def _ranks(system: System, count: int, positions: FloatArray) -> IntArray:
    """Independent rows of each cluster."""
    plan = system.motion.plan
    ranks = np.bincount(plan.labels[plan.labels >= 0], minlength=count)
    wanted = plan.rank - len(plan.pinned_rows)
    if ranks.sum() == wanted:
        return ranks
    jacobian = system.motion.constraint_set.jacobian(positions)
    weights = np.sqrt(system.weights.ravel())
    for rows in plan.dependent:
        part = jacobian[rows]
        columns, place = np.unique(part.indices, return_inverse=True)
        dense = np.zeros((1, len(rows), len(columns)))
        dense[0, np.repeat(np.arange(len(rows)), np.diff(part.indptr)), place] = part.data * weights[part.indices]
        ranks[plan.labels[rows[0]]] = rank(dense)
    if ranks.sum() != wanted:
        raise UnsupportedError(
            f"the ranks of the clusters add up to {ranks.sum()}, not to {wanted}: which of them has how many degrees "
            "of freedom is unclear. Leave out dependent rows, or use one sphere for all, spheres='global'"
        )
    return ranks


class IsokineticSpheres(SeededBath):
    """Canonical configurations at long steps: a stochastic isokinetic bath on spheres, with several time steps.

    Dynamics are lost: diffusion, relaxation times and spectra mean nothing. Beside several time steps it needs a
    smaller step than Langevin for the same bias; without them prefer `Langevin`.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    friction : float
        gamma, in inverse units of time, above 0: the rate at which the bath forgets.
    rng : int, numpy.random.Generator or None
        As for `Langevin`.
    steps : mapping of str to int, optional
        As for `LangevinRespa`.
    spheres : {'split', 'axes', 'cluster', 'global'}
        Atoms that constraints tie together are a cluster, a free atom is its own. 'split': one sphere for the center of
        mass of each cluster and one for the motion about it; 'axes': one for each of x, y and z of the center of mass;
        'cluster': one for each cluster; 'global': one for everything. A cluster that a row ties to a place in space
        has one sphere in the first three.
    auxiliary : int
        L, auxiliary variables on each sphere; many of them are Langevin dynamics.
    substeps : int
        RATTLE substeps in each drift.
    slow_kicks : {'ends', 'middle'}
        As for `LangevinRespa`.

    Raises
    ------
    InputError
        As for `LangevinRespa`; friction not positive; spheres of radius 0 (g + L - 1 = 0), at the start of a run.

    Notes
    -----
    `State.thermostat` holds a mark and the auxiliary variables, sphere by sphere. Velocities of the start are scaled to
    their spheres. Kinetic energies average g (G - 1)/G k_B T/2 on a sphere of G = g + L
    (`kinetic_energy`), and say nothing of the temperature.

    References
    ----------
    Minary, Tuckerman and Martyna, Phys. Rev. Lett. 93, 150201 (2004); Leimkuhler, Margul and Tuckerman, Mol. Phys. 111,
    3579 (2013).
    """

    turns = True

    @checked
    def __init__(
        self,
        thermal_energy: float,
        friction: Positive,
        rng: Rng,
        *,
        steps: Mapping[str, int] | None = None,
        spheres: Spheres = "split",
        auxiliary: FromZero = 1,
        substeps: int = 3,
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(thermal_energy, friction, rng, substeps, steps, slow_kicks)
        self.spheres: Spheres = spheres
        self.auxiliary = auxiliary
        self._known: tuple[System, SphereLayout, FloatArray, float] | None = None
        self._told = False

    def __repr__(self) -> str:
        steps, others = self._words
        given = f"{steps}, spheres={self.spheres!r}, auxiliary={self.auxiliary}{others}"
        return f"IsokineticSpheres({self.thermal_energy!r}, {self.friction!r}, rng={self.seed}{given})"

    def _made(self, operations: tuple[Operation, ...]) -> tuple[Program, Program]:
        """One that is compiled, and one that leaves to Python what needs projections."""
        parts: list[Operation] = [_Restore()]
        for operation in operations:
            parts += [operation, _Rescale()] if isinstance(operation, Project) else [operation]
        moved = {"restore": kernels.restore, "rescale": kernels.shorten}
        whole = moved | {"turn": kernels.turn_along, "exchange": kernels.exchange}
        compiled, other = (Program(operations, functions, self.names, parts) for functions in (whole, moved))
        return compiled, other

    def program(self, system: System | None) -> Program:
        made: tuple[Program, Program] = super().program(system)  # type: ignore[assignment]
        return made[system is not None and system.packed is None]

    def check(self, system: System) -> None:
        """Raise where the groups of forces are not those that have steps, for targets that move and velocity rows."""
        if self._known is None or self._known[0] is not system:
            super().check(system)
            refuse_driven(system, _NO_BATH)

    def layout(self, system: System, positions: FloatArray) -> SphereLayout:
        """The spheres of a system."""
        return self._found(system, positions)[1]

    def radii(self, system: System, positions: FloatArray) -> FloatArray:
        """R^2 of each sphere, (g + L - 1) k_B T."""
        return self._found(system, positions)[2]

    def kinetic_energy(self, system: System, positions: FloatArray) -> float:
        """What the kinetic energy is on average, (k_B T/2) times the sum of g (G - 1)/G over the spheres."""
        g = self.layout(system, positions).freedom
        whole = g + self.auxiliary
        return 0.5 * self.thermal_energy * float((g * (whole - 1) / whole).sum())

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        self.refuse_back(system, dt)
        _, layout, squares, _ = self._found(system, state.positions)
        if not self._told:
            self._told = True
            logger.warning("isokinetic spheres sample configurations only: no transport, relaxation times or spectra")
        return SphereStep(system, state, dt, self, layout, squares, 1 if self.middle else steps)

    def _found(self, system: System, positions: FloatArray) -> tuple[System, SphereLayout, FloatArray, float]:
        known, kt = self._known, self.thermal_energy
        if known is None or known[0] is not system or known[3] != kt:
            layout = SphereLayout.of(system, positions, self.spheres)
            known = self._known = system, layout, layout.squares(kt, self.auxiliary), kt
        return known


class _Rescale(Operation):
    """Velocities get the length that they have on their spheres."""

    verb, meaning = "rescale", "velocities back to their length"


class _Restore(Operation):
    """Velocities and auxiliary variables onto their spheres, with which each step begins."""

    verb, meaning = "restore", "onto the spheres"


class SphereStep(GroupedSteps):
    """Steps on their way; velocities are on the constraints and on their spheres but between a drift and `project`."""

    def __init__(
        self,
        system: System,
        start: State,
        dt: float,
        bath: IsokineticSpheres,
        layout: SphereLayout,
        squares: FloatArray,
        steps: int,
    ) -> None:
        drawn = len(squares) * bath.auxiliary
        known = carried(start, 1 + drawn, "IsokineticSpheres", marked=True)
        groups = bath.groups(system, start)
        if known:
            assert start.thermostat is not None
            own = start.thermostat[1:]
        else:
            own = math.sqrt(bath.thermal_energy) * bath.drawn(start.step, (drawn,), _BEGIN)
        program = bath.program(system)
        parts = sum(row.name == "exchange" for row in program.rows)
        head = bath.friction, bath.thermal_energy, *divmod(bath.seed, 2**32), start.step + 1, 0, parts
        atoms = layout.cluster, layout.spheres.ravel(), layout.masses, layout.totals
        roots = system.root_weights.ravel()
        numbers = in_one_array((np.array(head, dtype=float), squares, own, *atoms, roots, np.zeros(roots.size + drawn)))
        super().__init__(system, start, dt, groups, program, steps, numbers, system.packed is not None)
        self.bath = bath
        self.w, self.squares, *self.tables = kernels.unpacked(self.numbers)
        #: Accelerations along the constraints, by groups, of forces that Python has evaluated.
        self.paces: dict[int, FloatArray] = {}
        if not known:
            self.along(self.v, self.place(0), self.time)

    def evaluate(self, row: Row, begun: bool) -> None:
        self.paces.clear()
        super().evaluate(row, begun)

    def turn(self, row: Row, begun: bool) -> None:
        check_finite(self.force_of(row), "force", self.number)
        pace = None if self.simple else self.paces.get(row.group)
        if pace is None:
            pace = self.force_of(row) * self.system.weights
            self.paces[row.group] = self.along(pace, self.place(row.here), self.at(row.end))
        kernels.turn(self.v, self.w, pace, row.length * self.dt, self.squares, *self.tables)

    def exchange(self, row: Row, begun: bool) -> None:
        """Friction and noise on the spheres."""
        system, bath = self.system, self.bath
        n = self.v.size
        drawn = bath.drawn(self.number, (n + self.w.size,), row.number)
        noise = drawn[:n].reshape(self.v.shape) * system.root_weights
        self.along(noise, self.place(row.here), self.at(row.end))
        decay = bath.friction * row.length * self.dt
        keep, spread = math.exp(-decay), math.sqrt(-math.expm1(-2 * decay) * bath.thermal_energy)
        own = drawn[n:].reshape(self.w.shape)
        kernels.stir(self.v, self.w, noise, own, keep, spread, self.squares, *self.tables)

    def variables(self) -> FloatArray:
        check_finite(self.v, "velocity", self.number)
        return np.append(MARK, self.w)
