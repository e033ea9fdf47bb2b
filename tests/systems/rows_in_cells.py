"""Rows of all kinds on a chain of six atoms."""

import numpy as np

from kcons.constraints import (
    Angle,
    CenterDistance,
    Dihedral,
    Distance,
    DistanceDifference,
    FixedAtoms,
    LinearCombination,
    LinearRelation,
)

MASSES = np.array([1.0, 16.0, 12.0, 2.0, 30.0, 1.0])


CHAIN = np.array([[0, 0, 0], [1.1, 0.2, 0], [1.5, 1.3, 0.3], [2.6, 1.5, 1.1], [3.0, 2.7, 1.0], [2.2, 3.5, 1.6]])


ROWS = {
    "relation": [LinearRelation(0, [1, 2], [0.7, 0.3], None)],
    "relation of bonded atoms": [Distance([[0, 1], [1, 2]]), LinearRelation(0, [1, 2], [0.7, 0.3], None)],
    "combination": [LinearCombination([0, 1, 2], [[1.0, 0.5, 0.2], [-0.4, -0.5, 0.3], [-0.6, 0, -0.5]])],
    "free angle": [Angle([[0, 1, 2]])],
    "free dihedral": [Dihedral([[0, 1, 2, 3]]), Distance([[3, 4]])],
    "centers": [CenterDistance([0, 1, 2], [3, 4, 5])],
    "difference of lengths": [DistanceDifference([[0, 1], [1, 2]]), Distance([[3, 4]])],
    "difference of held lengths": [Distance([[0, 1], [1, 2]]), DistanceDifference([[1, 2], [2, 3]])],
    "difference of a star and a pair": [
        DistanceDifference([[0, 2], [2, 3], [1, 2], [4, 5]], weights=[1.0, -1.0, 0.5, -2.0]),
        Distance([[0, 1]]),
    ],
    "center of a molecule": [
        Distance([[0, 1], [1, 2], [2, 3]]),
        Dihedral([[0, 1, 2, 3]]),
        CenterDistance([0, 3], [4, 5]),
    ],
    "moving length": [Distance([[0, 1]], lambda t: 1.1180339887498950 + 0.1 * t), Distance([[1, 2]])],
    "all": [
        FixedAtoms([2]),
        Distance([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]),
        Angle([[0, 1, 2]]),
        Dihedral([[2, 3, 4, 5]]),
        LinearCombination([0, 5], [[1.0, 1.0, 0], [-1.0, -1.0, 0]]),
    ],
}
