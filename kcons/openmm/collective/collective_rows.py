"""Collective variables as rows: whatever an OpenMM Force can compute, held where it is or moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import Formula
from kcons.constraints.arguments import positive, whole_number
from kcons.constraints.internal import MOST_TURNED
from kcons.errors import (
    CertificateError,
    InputError,
    UnsupportedError,
)
from kcons.openmm.collective.clock import require_holder
from kcons.openmm.collective.formula_rows import as_rows
from kcons.openmm.collective.measured_rows import TOLERANCE
from kcons.openmm.collective.reported_rows import ReportedRows
from kcons.openmm.collective.row_forces import (
    Rigid,
    Row,
    forces_in,
    found_values,
    moved_atoms,
    number,
    period_of,
    place,
    unit_of,
)
from kcons.openmm.collective.small_algebra import PIVOT, blocks
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import virtual_sites

if TYPE_CHECKING:
    from kcons.openmm.integrator.projected import ProjectedIntegrator


class CollectiveRows(ReportedRows):
    """Any OpenMM Forces, each held as one row sigma = q - target = 0.

    The energy of a Force is its coordinate q, its forces are the gradient; each has a force group of its own, which
    the integrator keeps out of the dynamics. Positions land on all rows at once (and on the constraints of the
    System, where the rows touch atoms that it constrains) along the gradients at the start of the drift,

        x1 = xu + M^-1 (sum_k L_k grad q_k(x0) + constraints of the System),    q_k(x1) = target_k,

    by a quasi-Newton iteration on the L that begins with the Gram matrix A M_par^+ A^T at x0. Velocities are projected
    with the Gram matrix at x1.

    Parameters
    ----------
    system : openmm.System
        The Forces that are not part of it are added, each in a free group. Make the Simulation or Context afterwards.
    rows : Row, openmm.Force or Formula, or a sequence of them
        What to hold. A Force alone is held at the value found at `positions`; `each_term` makes one Force of each
        term or variable of a larger one; a `kcons.constraints.Formula` is one of each of its rows.
    positions : array_like or Quantity, shape (n_particles, 3), optional
        In nm if without unit. Needed where a target is to be found.
    box : sequence of three vectors, optional
        Periodic box at these positions, unless it is the System's default.
    tolerance : float, optional
        Of sigma, relative to the scale of each row: the root of the sum of squares over the rows. Left open, 1e-13,
        or 5e-7 where the platform computes forces in single precision (CUDA, HIP and OpenCL, mixed too).
    max_iterations : int
        Bound of the quasi-Newton iteration.
    meets_system : bool, optional
        Whether the rows touch atoms constrained by the System. Found from the Forces; say True where they touch them
        in ways that the Forces do not tell.

    Raises
    ------
    InputError
        A number that is not finite, a particle or context parameter that is not there, a target to find without
        positions, meets_system=False where a row does.
    UnsupportedError
        More rows than free force groups; rows on virtual sites. The System is unchanged then.

    References
    ----------
    Notes, eqs. 99-107; Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977); Andersen, ibid. 52, 24
    (1983); Broyden, Math. Comput. 19, 577 (1965).
    """

    def __init__(
        self,
        system: openmm.System,
        rows: Row | openmm.Force | int | Formula | Sequence[Row | openmm.Force | int | Formula],
        *,
        positions: object | None = None,
        box: Sequence | None = None,
        tolerance: float | None = None,
        max_iterations: int = 20,
        meets_system: bool | None = None,
    ) -> None:
        given = as_rows(rows)
        if not given:
            raise InputError("no rows to hold", item="rows")
        self.asked_tolerance = tolerance
        self.tolerance = positive(TOLERANCE if tolerance is None else tolerance, "tolerance")
        self.max_iterations = whole_number(max_iterations, "max_iterations")
        self.n_rows = len(given)
        forces = [_parts_of(system, row.force, k) for k, row in enumerate(given)]
        self._units = [unit_of(f[0]) if len(f) == 1 else None for f in forces]

        def read(name: str, per: unit.Unit = unit.dimensionless) -> list[Any]:
            """An attribute of all rows: numbers, None, and for targets and rates names."""
            values = [getattr(row, name) for row in given]
            kept = (str, type(None)) if name in ("target", "rate") else type(None)
            return [
                value if isinstance(value, kept) else number(value, f"{name} of row {k}", of, per)
                for k, (value, of) in enumerate(zip(values, self._units, strict=True))
            ]

        self._targets, self._rates = read("target"), read("rate", unit.picosecond)
        periods, scales = read("period"), read("scale")
        for k, (target, rate, scale) in enumerate(zip(self._targets, self._rates, scales, strict=True)):
            if target is None and positions is None:
                raise InputError(f"row {k} has no target; give one, or the positions to find it at", item="positions")
            if isinstance(rate, str) and not isinstance(target, str):
                raise InputError(f"row {k}: a rate with a name needs a target with a name", item="rate")
            if isinstance(target, float) and self._units[k] == unit.radian and abs(target) > MOST_TURNED:
                raise InputError(
                    f"target of row {k} is {target:g}, over three turns, and in radian; give {target:g} * unit.degrees",
                    item="target",
                )
            if scale is not None and not scale > 0:
                raise InputError(f"scale of row {k} is {scale}; give a positive number", item="scale")
        known = _context_parameters(system, [row.force for row in given])
        for name in (n for n in (*self._targets, *self._rates) if isinstance(n, str)):
            if name not in known:
                raise InputError(
                    f"{name!r} is no context parameter of the System (known: {', '.join(sorted(known)) or 'none'}); "
                    "define it by addGlobalParameter of a Force",
                    item="target",
                )
        self.names = tuple(_name(row, f) for row, f in zip(given, forces, strict=True))
        self.periods = tuple(
            (period_of(f[0]) if len(f) == 1 else 0.0) if period is None else period
            for period, f in zip(periods, forces, strict=True)
        )
        atoms = [moved_atoms(system, f) for f in forces]
        self._refuse_sites(system, atoms)
        self.sited = bool(virtual_sites(system))
        #: The particles of each row.
        self.atoms = tuple(tuple(sorted(touched)) for touched in atoms)
        rigid = Rigid(system)
        meets = any(rigid.holds(touched) for touched in atoms)
        if meets and meets_system is False:
            row = next(k for k, touched in enumerate(atoms) if rigid.holds(touched))
            raise InputError(
                f"row {row} ({self.names[row]}) touches atoms that the System constrains; leave out meets_system=False",
                item="meets_system",
            )
        self.meets_system = meets or bool(meets_system)
        if any(target is None for target in self._targets):
            found = found_values(system, forces, positions, box)
            self._targets = [f if t is None else t for t, f in zip(self._targets, found.tolist(), strict=True)]
        placed = place(system, [row.force for row in given])
        self._groups = tuple(placed)
        self.groups = frozenset(placed)
        touched = [rigid.bodies(a) for a in atoms] if self.meets_system else atoms
        #: Rows whose gradients can have a product.
        self._meet = [[bool(a & b) for b in touched] for a in touched]
        self._block_rows = blocks(touched)
        self.scales = tuple(
            (max(1.0, abs(t)) if isinstance(t, float) else 1.0) if scale is None else scale
            for t, scale in zip(self._targets, scales, strict=True)
        )
        self._drives = any(isinstance(t, float) and r != 0.0 for t, r in zip(self._targets, self._rates, strict=True))

    def _refuse_sites(self, system: openmm.System, atoms: Sequence[set[int]]) -> None:
        for k, touched in enumerate(atoms):
            sites = [atom for atom in sorted(touched) if system.isVirtualSite(atom)]
            if sites:
                raise UnsupportedError(
                    f"row {k} ({self.names[k]}) depends on particle {sites[0]}, a virtual site, which OpenMM moves at "
                    "the end of a step only; build the coordinate from the particles that define the site"
                )

    # -- told by an integrator ------------------------------------------------------------------

    @property
    def driven(self) -> bool:
        """Whether targets move."""
        return any(rate != 0.0 for rate in self._rates)

    @property
    def steered(self) -> bool:
        """Whether a target is a context parameter, which others may set for the step to come."""
        return any(isinstance(target, str) for target in self._targets)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """What counts as small is what Forces of the platform can tell."""
        program.set(f"small{self.code}", max(PIVOT, 10 * precision.forces))
        self._forecast.take_precision(program, precision)

    def take_place(self, program: Program, context: openmm.Context) -> None:
        """A tolerance that was left open becomes what Forces can tell of coordinates of this size."""
        if self.asked_tolerance is None:
            self.tolerance = self.at(context).finest
            program.set(f"tolerance{self.code}", self.tolerance)

    def set_target(
        self, integrator: ProjectedIntegrator, row: int, target: float | unit.Quantity, rate: object | None = None
    ) -> None:
        """Hold row `row` at another value from now on; `restore` brings the state there.

        It belongs to this integrator: no State or checkpoint changes it.

        Raises
        ------
        InputError
            No number, no such row; a target that is a context parameter (set that); a rate for a row made without.
        """
        if row not in range(self.n_rows):
            raise InputError(f"there is no row {row}; rows are numbered from 0 to {self.n_rows - 1}", item="row")
        if isinstance(self._targets[row], str):
            raise InputError(f"the target of row {row} is the context parameter {self._targets[row]}", item="target")
        of = self._units[row]
        value = number(target, f"target of row {row}", of)
        slope = None if rate is None else number(rate, f"rate of row {row}", of, unit.picosecond)
        if slope is not None and self._rates[row] == 0.0:
            raise InputError(f"row {row} was made without a rate; give it one then", item="rate")
        require_holder(integrator)
        if slope is not None:
            integrator.program.set(self._of("rate", row, integrator), slope)
        if self._rates[row] != 0.0:
            slope = integrator.getGlobalVariableByName(self._of("rate", row, integrator))
            value -= slope * self._clock(integrator)
        integrator.program.set(self._of("target", row, integrator), value)

    # -- restoring and checking -----------------------------------------------------------------

    def apply_positions(
        self, context: openmm.Context, tolerance: float | None = None, *, bonds: ArrayLike | None = None
    ) -> int:
        """Bring the positions of the context onto the rows and the System's constraints; returns the iterations.

        Newton with step control. Where rows are distances, angles or dihedrals of particles or distances of
        centres of mass and the targets are far, groups are moved whole first, by the same code as `hold`
        (`Motion.restore_positions`): bonds and angles stay as they are. Velocities stay as they are.

        Parameters
        ----------
        context : openmm.Context
        tolerance : float, optional
            That of the rows at the precision of the context unless given.
        bonds : array_like of int, shape (n, 2), optional
            The bonds of the molecules; those of the System's forces and constraints unless given. An empty list:
            Newton's method alone, whatever becomes of bonds and angles.

        Raises
        ------
        ConvergenceError
            No solution; the positions are unchanged.
        InfeasibleError
            Rows that are plain coordinates cannot be reached with bonds and angles as they are; likewise.
        """
        return self.at(context).apply_positions(tolerance, bonds)

    def apply_velocities(self, context: openmm.Context) -> None:
        """Make the velocities of the context tangent to the rows and to the System's constraints.

        Raises
        ------
        SingularGeometryError
            Rows that vanish or depend on others.
        """
        self.at(context).apply_velocities()

    def restore(
        self, context: openmm.Context, tolerance: float | None = None, *, bonds: ArrayLike | None = None
    ) -> None:
        """`apply_positions`, then `apply_velocities`.

        Raises
        ------
        ConvergenceError, InfeasibleError, SingularGeometryError
            As these.
        CertificateError
            The rows say that they are not fulfilled afterwards.
        """
        self.apply_positions(context, tolerance, bonds=bonds)
        self.apply_velocities(context)
        miss = self.worst_miss(context)
        if miss is not None:
            raise CertificateError(
                f"after restoring, the {miss}", row=miss.row, residual=abs(miss.off), atoms=miss.atoms
            )

    def check(self, context: openmm.Context, velocities: bool = True) -> None:
        """Raise unless the state of the context is on the rows.

        Raises
        ------
        InputError
            The context was made before the rows were added to its System.
        SingularGeometryError
            Rows that vanish, or depend on others or on the System's constraints.
        UnsupportedError
            A barostat or CMMotionRemover that would break them.
        ConstraintError
            Positions or velocities are not on the rows; `restore` brings them there.
        """
        self.at(context).check(velocities)

    def __repr__(self) -> str:
        return f"CollectiveRows({', '.join(self.names)})"


def _parts_of(system: openmm.System, force: openmm.Force | int, row: int) -> list[openmm.Force]:
    """The Forces that make one row."""
    if isinstance(force, int):
        return forces_in(system, force)
    if not isinstance(force, openmm.Force):
        raise InputError(
            f"row {row}: {force!r} is neither a Force nor the number of a force group; kcons.openmm.hold holds "
            "constraints of kcons",
            item="force",
        )
    return [force]


def _name(row: Row, forces: Sequence[openmm.Force]) -> str:
    if row.name:
        return row.name
    if not forces:
        return f"group {row.force}"
    force = forces[0]
    text = force.getEnergyFunction() if hasattr(force, "getEnergyFunction") else ""
    return type(force).__name__ + (f" {text}" if 0 < len(text) <= 24 else "")


def _context_parameters(system: openmm.System, forces: Sequence[openmm.Force | int]) -> set[str]:
    """Names of all context parameters that the Forces define."""
    names: set[str] = set()
    for force in (*system.getForces(), *(f for f in forces if isinstance(f, openmm.Force))):
        if hasattr(force, "getNumGlobalParameters"):
            names |= {force.getGlobalParameterName(k) for k in range(force.getNumGlobalParameters())}
    return names
