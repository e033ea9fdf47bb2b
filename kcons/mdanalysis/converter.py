"""`ag.convert_to("ASE")`: ASE `Atoms` by MDAnalysis' own mechanism of converters, with constraints."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from MDAnalysis.converters.base import ConverterBase

from kcons.constraints.constraint import Constraint, constraints_in
from kcons.errors import InputError
from kcons.mdanalysis.conversions import to_ase
from kcons.mdanalysis.topology import constraints_of
from kcons.topology.rows_by_name import HeldRows

if TYPE_CHECKING:
    import ase


class ASEConverter(ConverterBase):  # type: ignore[misc]
    """Registers itself with MDAnalysis where this module is imported; `import kcons.mdanalysis` does it."""

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
