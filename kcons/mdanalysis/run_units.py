"""The units of a run, in those of MDAnalysis."""

from __future__ import annotations

from dataclasses import dataclass

from kcons.constraints.arguments import positive


@dataclass(frozen=True)
class RunUnits:
    """What 1 is in a run, in the units of MDAnalysis.

    Attributes
    ----------
    length : float
        In angstrom.
    time : float
        In ps.
    energy : float
        In kJ/mol.
    name : str
        For headers.
    """

    length: float = 1.0
    time: float = 1.0
    energy: float = 1.0
    name: str = "Å, ps, kJ/mol"

    def __post_init__(self) -> None:
        for name in ("length", "time", "energy"):
            positive(getattr(self, name), name)

    @property
    def velocity(self) -> float:
        return self.length / self.time

    @property
    def force(self) -> float:
        return self.energy / self.length


#: ASE: Å, Å √(u/eV), eV. OpenMM: nm, ps, kJ/mol.
ASE_UNITS = RunUnits(1.0, 0.010180505717, 96.4853321233, "Å, Å √(u/eV), eV")
OPENMM_UNITS = RunUnits(10.0, 1.0, 1.0, "nm, ps, kJ/mol")
