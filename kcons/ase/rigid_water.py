"""Rigid water in an `Atoms` object."""

from __future__ import annotations

from typing import Literal

import numpy as np
from ase import Atoms
from ase.geometry import find_mic
from ase.neighborlist import neighbor_list

from kcons.ase.topology import require_atoms
from kcons.constraints import Distance
from kcons.constraints.arguments import positive
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.topology.holding import water_geometry
from kcons.topology.rigid_groups import water_rows

#: O-H length in Angstrom and H-O-H angle in degrees. Jorgensen et al., J. Chem. Phys. 79, 926 (1983).
TIP3P = (0.9572, 104.52)
#: An O-H length that no water has, in Angstrom.
_SHORTEST = 0.5


def rigid_water(
    atoms: Atoms, geometry: Literal["tip3p"] | tuple[float, float] | None = None, *, reach: float = 1.3
) -> Distance:
    """Hold all water molecules rigid: three distances each.

    A water is an oxygen followed in the list of atoms by two hydrogens that are within `reach` of it
    (minimum image), and not by a third.

    Parameters
    ----------
    atoms : ase.Atoms
    geometry : 'tip3p', (float, float) or None
        O-H length and H-O-H angle in degrees; 'tip3p' is (0.9572, 104.52). None holds each molecule as it
        is.
    reach : float
        Longest O-H distance that counts as a bond, in Angstrom.

    Raises
    ------
    InputError
        No `Atoms`, no water in it, or one whose hydrogens do not follow or are nearer than any are (positions in nm); a
        geometry or a reach that is none.
    """
    require_atoms(atoms)
    reach = positive(reach, "reach")
    z = atoms.numbers
    oxygen = np.flatnonzero((z[:-2] == 8) & (z[1:-1] == 1) & (z[2:] == 1)) if len(z) > 2 else np.zeros(0, int)

    def apart(hydrogen: IntArray) -> FloatArray:
        vectors = atoms.positions[hydrogen] - atoms.positions[oxygen]
        return np.asarray(find_mic(vectors, atoms.cell, atoms.pbc)[1])

    if len(oxygen):
        third = np.minimum(oxygen + 3, len(z) - 1)
        more = (oxygen + 3 < len(z)) & (z[third] == 1)
        more &= apart(third) <= reach
        oxygen = oxygen[(np.maximum(apart(oxygen + 1), apart(oxygen + 2)) <= reach) & ~more]
    if len(oxygen) == 0:
        raise InputError(
            "no water found: an oxygen must be followed by its two hydrogens in the list of atoms "
            f"(within {reach:g} Angstrom); reorder the atoms, or hold them with Distance",
            item="atoms",
        )
    closest = np.minimum(apart(oxygen + 1), apart(oxygen + 2))
    if closest.min() < _SHORTEST:
        raise InputError(
            f"water of oxygen {oxygen[np.argmin(closest)]}: its hydrogen is {closest.min():.3g} Angstrom away; "
            "positions of Atoms are in Angstrom: multiply by 10 where these are in nm",
            item="atoms",
            atoms=oxygen[closest < _SHORTEST],
        )
    rest = np.setdiff1d(np.flatnonzero(np.isin(z, (1, 8))), oxygen[:, None] + np.arange(3))
    others = Atoms(z[rest], atoms.positions[rest], cell=atoms.cell, pbc=atoms.pbc)
    hydrogens = np.bincount(neighbor_list("i", others, {("O", "H"): reach}), minlength=len(rest))
    missed = rest[(z[rest] == 8) & (hydrogens == 2)]
    if len(missed):
        raise InputError(
            f"the water of oxygen {missed[0]} is not followed by its two hydrogens in the list of atoms ({len(missed)} "
            "such in all), and would stay flexible; reorder the atoms, or hold all by constraints_of(atoms, 'none')",
            item="atoms",
            atoms=missed,
        )
    if isinstance(geometry, str):
        if geometry.lower() != "tip3p":
            raise InputError(f"unknown water geometry {geometry!r}; give 'tip3p' or (length, angle)", item="geometry")
        geometry = TIP3P
    elif geometry is not None:
        geometry = water_geometry(geometry, "geometry")
    return water_rows(oxygen[:, None] + np.arange(3), geometry)
