"""When Newton's method has arrived, when it gives up, and which rows count as dependent: every number, and why.

Errors are relative to the scale of a row (a length, 1 for angles) unless said otherwise. What rounding leaves of a row
is max(`ROUNDING` of its scale, 2 eps sum |dq/dx_i| |x_i|), the second for atoms far from the origin.
"""

from __future__ import annotations

import numpy as np

# Compiled into kernels, which are made anew where something here changes.

EPS = float(np.finfo(float).eps)

# -- positions ------------------------------------------------------------------------------------------------

#: Part of its scale that rounding may leave of a row; all Newton tolerances follow from it.
ROUNDING = 1e-14
#: Newton stops at this relative error in relative coordinates: a few roundings, of which a bond vector has 1e-15.
NEWTON_TOLERANCE = 0.4 * ROUNDING
#: Roundings of its positions that a row may be left with where Newton's method gains no more, for a cluster of one row;
#: they add up like errors at random. Rows that depend on each other miss each other's targets by them.
ROUNDINGS = 4.0
#: Error below which a step that gains nothing is rounding, and not a step too long.
NEAR = 1e-10
#: Newton iterations after which there is no solution near: a time step takes three.
MAX_ITERATIONS = 50
#: Halvings of one step: 1e-9 of it is left.
MAX_HALVINGS = 30
#: More Newton iterations than a time step of any use takes: the start was far off, and a second solve from the near end
#: takes away the rounding of its size.
MANY_ITERATIONS = 6
#: Rounds of Newton until the stored positions show the lengths: multipliers of long stretched chains are large.
MAX_ROUNDS = 4
#: Part of itself that a gradient must have along it where more than `MANY_ITERATIONS` end: where it has less, the row
#: has flattened out on the way, as a dihedral that is to turn over does far away, and the positions are none near the
#: given ones.
FLAT = 0.01

# -- velocities and forces ------------------------------------------------------------------------------------

#: |A v - c| that refinement aims at, in parts of the largest relative speed of a cluster ...
SPEED_TOLERANCE = 1e-15
#: ... in parts of the root mean square of a chain's, which has more roundings ...
CHAIN_SPEED_TOLERANCE = 2e-15
#: ... and how many times the first is accepted where sparse elimination gains no more.
SPEED_ROUNDINGS = 1e3
#: The same with dense algebra, whose rows are combined by singular vectors.
DENSE_SPEED_TOLERANCE = 1e-11
#: Where masses differ more, the force over the mass of a light atom is so many times its acceleration on the rows that
#: accelerations are refined.
UNEVEN = 1e3
#: Smallest scalar product taken for positive: of a bond with its reference, or with itself.
TINY = 1e-300

# -- rank -----------------------------------------------------------------------------------------------------

#: Singular values below this part of the largest belong to rows that depend on others. It is the square root of the
#: rounding error, 1.5e-8: the matrix A M^-1 A^T of a projection has the squares of these values, so that what lies
#: below is rounding there, and as a condition number it leaves multipliers half of their digits. Rows that do depend
#: on each other come out at the rounding of their gradients, eps |x| / d for rows of the size d at the place x, which
#: stays below it up to 10^7 bond lengths from the origin.
RANK_TOLERANCE = 1e-8
#: A pivot below this part of its diagonal marks a row that depends on earlier ones: the square of the sine of the angle
#: between the row and these. Where rank counts and clusters are not large it is counted by singular values, and
#: dependent rows are eliminated last, where their pivots vanish to rounding.
PIVOT_TOLERANCE = 1e-10
#: Singular values of the row-normalized A, without masses, below this part of the largest are directions that a
#: geometry has lost: an angle from the straight or flat one, and no measure of rank. A triatomic at 179.9 degrees has
#: 8.7e-4 and is held as it is.
LOST = 1e-6
