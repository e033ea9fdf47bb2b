"""Linear and planar rigid groups inside a block of rows, and the linear rows that hold them.

`find_flat_bodies` says which atoms a block that is singular at second order keeps on a line or in a
plane, and what holds them there regularly; `with_flat_bodies` puts that in place of the old rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.internal import Distance
from kcons.constraints.linear import LinearRelation
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import SingularGeometryError
from kcons.plan.second_order.singular_rows import STEP_CUT, UNSOLVABLE, BoolArray, LocalRows, extent_of

#: Extent across a line or plane, relative to the extent along it, that still counts as flat.
FLAT = 1e-6
#: Relative misfit between the targets and a flat geometry above which the conversion is refused.
MISFIT = 1e-6


@dataclass(frozen=True)
class FlatBody:
    """Atoms on a line (two bases) or in a plane (three), and what holds them regularly.

    Attributes
    ----------
    atoms, rows : ndarray of int
        The atoms, and the rows that the linear ones replace.
    bases : ndarray of int, shape (2,) or (3,)
    pairs, lengths : ndarray, shape (1, 2), (1,) or (3, 2), (3,)
        Distances between the bases.
    tied : ndarray of int, shape (n,)
        The other atoms.
    weights : ndarray, shape (n, n_bases)
        x_tied = weights @ x_bases.
    linearized : int
        Degrees of freedom that the replaced rows leave at first order; the body itself has 5 or 6.
    """

    atoms: IntArray
    rows: IntArray
    bases: IntArray
    pairs: IntArray
    lengths: FloatArray
    tied: IntArray
    weights: FloatArray
    linearized: int

    def __str__(self) -> str:
        """For example 'atoms 0, 1, 2 on a line: 1 distance and 3 linear rows in place of 3 rows'."""
        distances, linear = len(self.pairs), 3 * len(self.tied)
        return (
            f"atoms {_listed(self.atoms)} {'on a line' if len(self.bases) == 2 else 'in a plane'}: {distances} "
            f"distance{'s' if distances > 1 else ''} and {linear} linear rows in place of {len(self.rows)} rows"
        )

    def renumbered(self, atoms: IntArray, rows: IntArray) -> FlatBody:
        """The same body where atom a is called atoms[a] and row k rows[k]."""
        return replace(
            self,
            atoms=atoms[self.atoms],
            rows=rows[self.rows],
            bases=atoms[self.bases],
            pairs=atoms[self.pairs],
            tied=atoms[self.tied],
        )


def find_flat_bodies(block: LocalRows) -> list[FlatBody]:
    """Linear and planar rigid groups that make a block singular at second order.

    Raises
    ------
    SingularGeometryError
        If the block is singular for another reason, or a group's targets do not fit its flat geometry.
    """
    rigid, generic = block.rigid_pairs()
    x = block.unwrapped(block.x)
    stressed = block.stressed(block.x)
    loaded = np.unique(np.concatenate([block.row_atoms[k] for k in stressed]))
    found: list[IntArray] = []
    for body in _cliques(rigid):
        subsets = [body] if affine_dimension(x[body]) <= 2 else _flat_subsets(x, np.intersect1d(body, loaded))
        found += [atoms for atoms in subsets if block.singular(block.x, block.inside(atoms))]
    groups = _merged(found, x)
    if not groups:
        raise _unresolved(block, generic)
    bodies = [_body(block, atoms, x) for atoms in groups]
    bodies = _without_repeats(block, bodies)
    _check_result(block, bodies, generic)
    return [body.renumbered(block.atoms, block.rows) for body in bodies]


def affine_dimension(x: FloatArray) -> int:
    """1 for points on a line, 2 in a plane, 3 otherwise, up to `FLAT`."""
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return max(1, int(np.sum(s > FLAT * s[0])))


def _cliques(rigid: BoolArray) -> list[IntArray]:
    """Rigid bodies of three atoms and more: two of them share a hinge (two atoms) at most."""
    bodies: list[BoolArray] = []
    for i, j in np.argwhere(np.triu(rigid, 1)):
        common = rigid[i] & rigid[j]
        common[[i, j]] = False
        for body in bodies:
            if body[i] and body[j]:
                common &= ~body
        while common.any():
            k = int(np.argmax(common))
            body = rigid[i] & rigid[j] & rigid[k]
            bodies.append(body)
            common &= ~body
    return [np.flatnonzero(b) for b in bodies]


def _flat_subsets(x: FloatArray, atoms: IntArray) -> list[IntArray]:
    """Largest coplanar (four atoms and more) and collinear (three and more) subsets of a rigid body."""
    y = x[atoms]
    size = extent_of(y)
    found: dict[bytes, IntArray] = {}
    for i, j in combinations(range(len(atoms)), 2):
        axis = (y[j] - y[i]) / np.linalg.norm(y[j] - y[i])
        away = y - y[i]
        across = away - np.outer(away @ axis, axis)
        off = np.linalg.norm(across, axis=1)
        line = off < FLAT * size
        if line.sum() >= 3:
            found.setdefault(line.tobytes(), atoms[line])
        for k in range(j + 1, len(atoms)):
            if line[k]:
                continue
            normal = np.cross(axis, across[k] / off[k])
            plane = np.abs(away @ normal) < FLAT * size
            if plane.sum() >= 4:
                found.setdefault(plane.tobytes(), atoms[plane])
    return list(found.values())


def _merged(found: list[IntArray], x: FloatArray) -> list[IntArray]:
    """Groups on the same line (two common atoms) or in the same plane (three off a line) become one."""
    groups = [set(atoms.tolist()) for atoms in found]
    changed = True
    while changed:
        changed = False
        for a, b in combinations(range(len(groups)), 2):
            shared = sorted(groups[a] & groups[b])
            if len(shared) < 2:
                continue
            union = sorted(groups[a] | groups[b])
            same_line = affine_dimension(x[union]) == 1
            same_plane = len(shared) >= 3 and affine_dimension(x[union]) == 2 and affine_dimension(x[shared]) == 2
            contained = groups[a] <= groups[b] or groups[b] <= groups[a]
            if same_line or same_plane or contained:
                groups[a] = set(union)
                del groups[b]
                changed = True
                break
    return [np.array(sorted(g), dtype=np.int64) for g in groups]


def _body(block: LocalRows, atoms: IntArray, x: FloatArray) -> FlatBody:
    """What holds a flat group: bases, their distances, and the weights of the other atoms."""
    inside = block.inside(atoms)
    moving = [k for k in inside if isinstance(block.part.locate(int(k))[0].target, MovingTarget)]
    linearized = 3 * len(atoms) - int(block.pinned[atoms].sum()) * 3 - block.rank(block.x, inside)
    flat = affine_dimension(x[atoms])
    if moving:
        raise SingularGeometryError(
            _sentence(linearized, flat, block.atoms[atoms])
            + "; it cannot be converted, since a target among these atoms is a function of time",
            rows=block.rows[inside],
            atoms=block.atoms[atoms],
        )
    plane = _fitted(block, atoms, inside, x, flat, linearized)
    bases, weights = _bases(block, atoms, inside, plane)
    others = np.setdiff1d(np.arange(len(atoms)), bases)
    held = np.array(list(combinations(bases, 2)))
    lengths = np.linalg.norm(plane[held[:, 0]] - plane[held[:, 1]], axis=1)
    pairs = atoms[held]
    for k in inside:
        item, row = block.part.locate(int(k))
        if item.holds_length:
            same = np.flatnonzero((np.sort(pairs, axis=1) == np.sort(item.atoms[row])).all(axis=1))
            # A base distance that was held stays at its own target, to the last bit.
            lengths[same] = np.asarray(item.target)[row]
    return FlatBody(
        atoms=atoms,
        rows=inside,
        bases=atoms[list(bases)],
        pairs=pairs,
        lengths=lengths,
        tied=atoms[others],
        weights=weights[others],
        linearized=linearized,
    )


def _fitted(
    block: LocalRows, atoms: IntArray, inside: IntArray, x: FloatArray, flat: int, linearized: int
) -> FloatArray:
    """Coordinates along the line or in the plane that fulfil the targets, shape (n, 1) or (n, 2).

    Gauss-Newton within the plane, where the rows are regular; starts from the present positions.
    """
    y = x[atoms]
    center = y.mean(axis=0)
    axes = np.linalg.svd(y - center)[2][:flat]
    plane = (y - center) @ axes.T
    columns = (3 * atoms[:, None] + np.arange(3)).ravel()
    scale = block.part.scale[inside]
    whole = x.copy()
    best, miss = plane, np.inf
    for _ in range(30):
        whole[atoms] = center + plane @ axes
        sigma = block.part.value(whole, block.time)[inside]
        size = float(np.max(np.abs(sigma) / scale))
        if not size < miss:
            break
        best, miss = plane, size
        if size < 1e-16:
            break
        a = block.part.jacobian(whole, block.time)[inside][:, columns].toarray()
        a = np.einsum("rnc,fc->rnf", a.reshape(len(inside), len(atoms), 3), axes).reshape(len(inside), -1)
        step = np.linalg.lstsq(a / scale[:, None], -sigma / scale, rcond=STEP_CUT)[0]
        plane = plane + step.reshape(plane.shape)
    if not miss <= MISFIT:
        whole[atoms] = center + best @ axes
        worst = int(np.argmax(np.abs(block.part.value(whole, block.time)[inside]) / scale))
        row = int(block.rows[inside[worst]])
        raise SingularGeometryError(
            _sentence(linearized, flat, block.atoms[atoms])
            + f"; it cannot be converted, since the targets do not fit a {('linear', 'planar')[flat - 1]} group: "
            f"row {block.set.row_name(row)} stays off by {miss:.2g} (relative)",
            rows=block.rows[inside],
            atoms=block.atoms[atoms],
        )
    return best


def _bases(
    block: LocalRows, atoms: IntArray, inside: IntArray, plane: FloatArray
) -> tuple[tuple[int, ...], FloatArray]:
    """Two or three bases far apart (fixed atoms and pairs already held preferred), and all atoms' weights."""
    n, flat = plane.shape
    held = {tuple(sorted(block.row_atoms[k])) for k in inside if len(block.row_atoms[k]) == 2}
    fixed = block.pinned[atoms]
    candidates = list(range(n))
    if flat == 2 and n > 40:
        # The outermost atoms in a few directions; all triples of a large sheet would be too many.
        angles = np.linspace(0, np.pi, 16, endpoint=False)
        reach = plane @ np.stack([np.cos(angles), np.sin(angles)])
        outer = np.concatenate([np.argmax(reach, 0), np.argmin(reach, 0), np.flatnonzero(fixed)[:8]])
        candidates = np.unique(outer).tolist()
    choices = list(combinations(candidates, flat + 1))
    corners = plane[np.array(choices)]
    edges = corners[:, 1:] - corners[:, :1]
    size = np.abs(edges[:, 0, 0]) if flat == 1 else np.abs(np.linalg.det(edges))
    good = np.flatnonzero(size >= 0.5 * size.max()) if flat == 2 else np.flatnonzero(size >= 0.999 * size.max())

    def merit(k: int) -> tuple[int, int, float]:
        pairs = combinations(choices[k], 2)
        kept = sum(tuple(sorted((atoms[i], atoms[j]))) in held for i, j in pairs)
        return int(fixed[list(choices[k])].sum()), kept, float(size[k])

    bases = choices[max(good.tolist(), key=merit)]
    corner = plane[list(bases)]
    system = np.vstack([corner.T, np.ones(flat + 1)])
    weights = np.linalg.solve(system, np.vstack([plane.T, np.ones(n)])).T
    # Round so that the weights sum to one: the relation then does not depend on the origin.
    weights[:, -1] = 1.0 - weights[:, :-1].sum(axis=1)
    return bases, weights


def _without_repeats(block: LocalRows, bodies: list[FlatBody]) -> list[FlatBody]:
    """Leave out base distances that other bodies hold already (two planar groups with a common edge)."""
    if len(bodies) < 2:
        return bodies
    for b in range(len(bodies)):
        for k in reversed(range(len(bodies[b].pairs))):
            body = bodies[b]
            fewer = replace(body, pairs=np.delete(body.pairs, k, axis=0), lengths=np.delete(body.lengths, k))
            trial = [*bodies[:b], fewer, *bodies[b + 1 :]]
            if _rebuilt(block, trial).rank(block.x) == _rebuilt(block, bodies).rank(block.x):
                bodies = trial
    return bodies


def _rebuilt(block: LocalRows, bodies: list[FlatBody]) -> LocalRows:
    rebuilt = with_flat_bodies(block.part, bodies, block.x, block.time)
    return LocalRows(rebuilt, np.arange(rebuilt.n_rows), block.x, block.time, pinned=block.pinned)


def _check_result(block: LocalRows, bodies: list[FlatBody], generic: int) -> None:
    """The new rows must be regular, and the replaced ones must follow from them, to second order.

    First order is not enough: flat plates hinged in a ring can fold as long as each is held alone, while the
    distances between them resist the fold at second order.
    """
    new = _rebuilt(block, bodies)
    u, s, vt, rank = new.decomposed(block.x)
    old, _ = block.unit_jacobian(block.x)
    if np.abs(old @ vt[rank:].T).max(initial=0.0) > 1e-4 or new.singular(block.x):
        raise _unresolved(block, generic)
    rng = np.random.default_rng(20060921)
    for _ in range(3):
        v = rng.standard_normal(len(vt) - rank) @ vt[rank:]
        a = -((u[:, :rank].T @ new.unit_curvature(block.x, v)) / s[:rank]) @ vt[:rank]
        bent = block.unit_curvature(block.x, v)
        miss = old @ a + bent
        # Rigid motion has no curvature but rounding.
        size = np.linalg.norm(bent) + 1e-5 * (v @ v) / extent_of(block.x)
        if np.linalg.norm(miss) > UNSOLVABLE * size:
            raise _unresolved(block, generic)


def with_flat_bodies(
    constraint_set: ConstraintSet, bodies: Sequence[FlatBody], positions: FloatArray, time: float
) -> ConstraintSet:
    """The set with the bodies' rows replaced: what is kept, then distances between bases, then relations."""
    drop = np.unique(np.concatenate([b.rows for b in bodies]))
    pieces: list[Constraint] = []
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        lo, hi = np.searchsorted(drop, [start, start + item.n_rows])
        if lo == hi:
            pieces.append(item)
        elif hi - lo < item.n_rows:
            pieces.append(item.select(np.setdiff1d(np.arange(item.n_rows), drop[lo:hi] - start)))
    pairs = np.concatenate([b.pairs for b in bodies])
    lengths = np.concatenate([b.lengths for b in bodies])
    # Bodies that share an edge hold it once.
    _, first = np.unique(np.sort(pairs, axis=1), axis=0, return_index=True)
    first.sort()
    if len(first):
        pieces.append(Distance(pairs[first], lengths[first]))
    for n_bases in (2, 3):
        same = [b for b in bodies if len(b.bases) == n_bases and len(b.tied)]
        if same:
            pieces.append(
                LinearRelation(
                    np.concatenate([b.tied for b in same]),
                    np.concatenate([np.tile(b.bases, (len(b.tied), 1)) for b in same]),
                    np.concatenate([b.weights for b in same]),
                )
            )
    new = constraint_set.replaced(pieces, positions, time)
    new.conversions = tuple(bodies)
    return new


def refusal(body: FlatBody) -> SingularGeometryError:
    """The error for second-order-singular rows that may not be converted."""
    return SingularGeometryError(
        _sentence(body.linearized, len(body.bases) - 1, body.atoms), rows=body.rows, atoms=body.atoms
    )


def _listed(atoms: IntArray) -> str:
    return ", ".join(str(a) for a in atoms[:8]) + (", ..." if len(atoms) > 8 else "")


def _sentence(linearized: int, flat: int, atoms: IntArray) -> str:
    shown = _listed(atoms)
    freedom, shape, remedy = (
        (5, "collinear", "hold one distance and x_b = c x_a + (1-c) x_c (LinearRelation) instead")
        if flat == 1
        else (
            6,
            "coplanar",
            "hold three distances and x_a = c_i x_i + c_j x_j + c_k x_k (LinearRelation) for the other atoms instead",
        )
    )
    return (
        f"constraint set singular at this geometry: {linearized} linearized degrees of freedom but the rigid body "
        f"has {freedom} (atoms {shown} are {shape}); {remedy}"
    )


def _unresolved(block: LocalRows, generic: int) -> SingularGeometryError:
    names = ", ".join(block.set.row_name(int(r)) for r in block.rows[:4]) + (", ..." if len(block.rows) > 4 else "")
    here = block.rank(block.x)
    free = 3 * int(np.sum(~block.pinned))
    return SingularGeometryError(
        f"constraint set singular at this geometry: {free - here} linearized degrees of freedom here but "
        f"{free - generic} at positions nearby; rows {names} resist some motion only at second order, and no linear "
        "or planar rigid group explains it. Leave out the rows that do this, start from another geometry, or hold "
        "the atoms by x_a = sum c_i x_i (LinearRelation)",
        rows=block.rows,
        atoms=block.atoms,
    )
