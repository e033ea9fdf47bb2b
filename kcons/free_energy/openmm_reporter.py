"""Held coordinates reported in OpenMM's simulations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from os import PathLike
from typing import Any, TextIO

import numpy as np
import openmm

from kcons.constraints import Constraint
from kcons.constraints.arguments import whole_number
from kcons.constraints.constraint_set import ConstraintSet, same_rows
from kcons.errors import InputError
from kcons.free_energy.held_coordinates import HeldCoordinates, named
from kcons.free_energy.series import Series
from kcons.openmm.callback_rows.callbacks import cell_of
from kcons.openmm.callback_rows.carried_constraints import CarriedConstraints, refuse_virtual_sites, with_massless_atoms
from kcons.openmm.callback_rows.hold import constraints_about
from kcons.openmm.collective.collective_rows import CollectiveRows
from kcons.openmm.ensembles.isokinetic_ensemble import Isokinetic
from kcons.openmm.quantities import accepted, masses_of
from kcons.openmm.topology import bonds_of


class HeldCoordinatesReporter:
    """Writes held coordinates, their multipliers and ln det Z, in the manner of `openmm.app.StateDataReporter`.

    However a coordinate is held (by the System, by `CollectiveRows`, by `hold`), it is named by the constraint of kcons
    that measures it. What else is held on its atoms counts too: constraints of the System and those of `hold` are
    found, other rows of `CollectiveRows` have to be named, or given as `beside`.

    Parameters
    ----------
    file : path or text file
        Comma-separated columns: step, time in ps, then value and multiplier of each coordinate in kJ/mol, nm and
        radian, ln det Z, and the work that moving targets did since the first report of this reporter.
    reportInterval : int
        Steps from one report to the next.
    coordinates : mapping of str to Constraint
        Quantities, or plain numbers of nm, ps, dalton, radian.
    beside : iterable of Constraint
        Other rows that are held on the same atoms.
    append : bool
        Whether to go on in a file that exists, without a new line of names.

    Attributes
    ----------
    series : Series
        All that was reported.

    Raises
    ------
    InputError
        At the first report: rows of `CollectiveRows` that are neither named nor given as `beside`.
        A report of another simulation than the first.
    UnsupportedError
        At the first report: a coordinate of a virtual site.

    Notes
    -----
    Velocities of the integrators of kcons belong to the positions. Those of OpenMM's leapfrog integrators are half a
    step off, and the part of the multipliers that is quadratic in them is then of first order only.
    """

    def __init__(
        self,
        file: str | PathLike[str] | TextIO,
        reportInterval: int,
        coordinates: Mapping[str, Constraint],
        *,
        beside: Iterable[Constraint] = (),
        append: bool = False,
    ) -> None:
        interval = whole_number(reportInterval, "reportInterval")
        names = list(named(coordinates))
        self._coordinates = dict(zip(names, accepted(coordinates.values()), strict=True))
        self._beside = accepted(beside)
        self._interval = interval
        self._own = not hasattr(file, "write")
        self._file: TextIO = open(file, "a" if append else "w", encoding="utf-8") if self._own else file  # type: ignore[arg-type, assignment] # noqa: SIM115
        self._titled = append
        self._work = 0.0
        self._held: HeldCoordinates | None = None
        self._set: ConstraintSet | None = None
        self.series = Series(names)

    def describeNextReport(self, simulation: Any) -> tuple[int, bool, bool, bool, bool, bool]:
        """Steps to the next report, and that it takes positions, velocities and forces, not wrapped."""
        return (self._interval - simulation.currentStep % self._interval, True, True, True, False, False)

    def report(self, simulation: Any, state: openmm.State) -> None:
        """Write a line."""
        # A State is in nm and ps; its Quantities take longer to make than the sample.
        kinds = (openmm.State.Positions, openmm.State.Velocities, openmm.State.Forces)
        x, v, f = arrays = [np.empty((simulation.system.getNumParticles(), 3)) for _ in kinds]
        for kind, array in zip(kinds, arrays, strict=True):
            state._getVectorAsNumpy(kind, array)
        time = state.getTime()._value
        if self._held is None:
            self._begin(simulation, x, time)
        elif simulation.context is not self._context:
            raise InputError("this reporter belongs to another simulation; make a new one for this", item="simulation")
        assert self._held is not None and self._set is not None
        if self._set.lattice is not None:
            self._set.with_cell(cell_of(state.getPeriodicBoxVectors()))
        ensemble = getattr(simulation.integrator, "ensemble", None)
        if isinstance(ensemble, Isokinetic):
            self.series.isokinetic_degrees_of_freedom = ensemble.count(simulation.integrator)
        sample = self._held.sample(x, v, f, time)
        self._work += self.series.append(sample)
        pairs = [n for pair in zip(sample.value.tolist(), sample.multiplier.tolist(), strict=True) for n in pair]
        numbers = [time, *pairs, sample.log_det_z, self._work]
        self._file.write(",".join([str(simulation.currentStep), *(f"{number:.12g}" for number in numbers)]) + "\n")
        self._file.flush()

    def _begin(self, simulation: Any, x: np.ndarray, time: float) -> None:
        system, integrator = simulation.system, simulation.integrator
        masses = masses_of(system)
        rows = [*self._beside, *self._coordinates.values()]
        parts = getattr(integrator, "parts", ())
        collective = sum(part.n_rows for part in parts if isinstance(part, CollectiveRows))
        carried = [c for p in parts if isinstance(p, CarriedConstraints) for c in p.motion.sources[0].constraints]
        if collective > sum(row.n_rows for row in rows):
            raise InputError(
                f"CollectiveRows holds {collective} rows, and {sum(row.n_rows for row in rows)} are named here; name "
                "them all, or give the others as beside: what is held beside a coordinate changes its mean force",
                item="beside",
            )
        # Those of `hold` know how their targets move.
        for row in rows:
            new = [k for k in range(row.n_rows) if not any(same_rows(item, row, k).any() for item in carried)]
            if new:
                carried.append(row.select(new))
        rows = carried
        touched = np.unique(np.concatenate([row.atoms.ravel() for row in rows]))
        refuse_virtual_sites(system, touched, masses)
        named = {(min(pair), max(pair)) for row in rows if row.holds_length for pair in row.atoms.tolist()}
        for item in constraints_about(system, touched):
            other = np.array([tuple(sorted(pair)) not in named for pair in item.atoms.tolist()])
            if other.any():
                rows.insert(0, item.select(np.flatnonzero(other)))
        wraps = system.usesPeriodicBoundaryConditions()
        box = simulation.context.getState().getPeriodicBoxVectors() if wraps else None
        self._set = ConstraintSet(
            with_massless_atoms(tuple(rows), masses),
            x,
            np.where(masses > 0, masses, 1.0),
            cell=None if box is None else cell_of(box),
            time=time,
        )
        # A turn of a group must move what is free to move, and nothing that is held in another way.
        known = all(isinstance(part, CollectiveRows | CarriedConstraints) for part in parts)
        virtual = np.array([system.isVirtualSite(k) for k in range(len(masses))])
        free = known and bool(np.all((masses > 0) | virtual))
        # Forces on virtual sites are in those of the particles that they depend on: sites belong to no group.
        bonds = bonds_of(system, x)
        turned = bonds[~virtual[bonds].any(axis=1)] if free else None
        self._held = HeldCoordinates(self._set, self._coordinates, x, time=time, bonds=turned)
        self._context = simulation.context
        self.series = Series(self._held.names, self._held.periods)
        if not self._titled:
            titles = [title for name in self._held.names for title in (name, f"multiplier of {name}")]
            titles = ["Step", "Time (ps)", *titles, "ln det Z", "work (kJ/mol)"]
            self._file.write("#" + ",".join(f'"{title}"' for title in titles) + "\n")

    def __del__(self) -> None:
        if getattr(self, "_own", False) and hasattr(self, "_file"):
            self._file.close()
