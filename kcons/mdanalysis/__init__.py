"""MDAnalysis: constraints from any topology it reads, and conversions to ASE and OpenMM.

Lengths are in angstrom, times in ps, masses in dalton, as everywhere in MDAnalysis.
"""

from kcons.mdanalysis.universe import constraints_of, selected, snapshot_of

__all__ = ["constraints_of", "selected", "snapshot_of"]
