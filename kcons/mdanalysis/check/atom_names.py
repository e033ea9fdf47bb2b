"""What atoms are called, in messages and tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import MDAnalysis.exceptions
import numpy as np
from numpy.typing import NDArray

from kcons.mdanalysis.topology import topology_of


class AtomNames:
    """Names of all atoms of a Universe, as far as its topology has them.

    Attributes
    ----------
    names, elements, residues : ndarray of str, shape (n_atoms,)
        '' where the topology does not say; elements are then what names and masses tell, or first letters.
    """

    def __init__(self, universe: Any) -> None:
        atoms = universe.atoms
        n = len(atoms)
        self.names: NDArray[np.str_] = _column(atoms, "names", n)
        self.residues: NDArray[np.str_] = _column(atoms, "resnames", n)
        self._numbers = _column(atoms, "resids", n)
        elements = _column(atoms, "elements", n)
        if not np.all(elements != ""):
            known = topology_of(universe).elements
            first = np.char.lstrip(self.names, "0123456789'\"*").astype("U1")
            elements = np.where(elements == "", np.where(known == "", first, known), elements)
        self.elements: NDArray[np.str_] = elements

    def atom(self, index: int) -> str:
        """For example 'SOL12:OW', or 'atom 35' where there are no names."""
        name = self.names[index]
        if not name:
            return f"atom {index}"
        residue = f"{self.residues[index]}{self._numbers[index]}"
        return f"{residue}:{name}" if residue else str(name)

    def row(self, atoms: Iterable[int], most: int = 4) -> str:
        """Atoms of a row; a residue is named once."""
        numbers = [int(a) for a in atoms]
        shown, previous = [], ""
        for a in numbers[:most]:
            label = self.atom(a)
            head, colon, name = label.rpartition(":")
            shown.append(name if colon and head == previous else label)
            previous = head
        return "–".join(shown) + ("–…" if len(numbers) > most else "")


def _column(atoms: Any, attribute: str, n: int) -> NDArray[np.str_]:
    try:
        return np.asarray(getattr(atoms, attribute)).astype(str)
    except (AttributeError, MDAnalysis.exceptions.NoDataError):
        return np.full(n, "", dtype="U1")
