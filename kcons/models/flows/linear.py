"""Linear flows: exp(At), Jordan form, stability as far as double precision tells; equilibria (notes sections 1.2, 1.3).

**Eigenvalues** are those of the balanced matrix (Parlett and Reinsch) in Schur form; how far one may be off follows
from the backward error of that, which is of the size of the rounding of the entries.

**Jordan blocks** are not continuous in the matrix: next to any matrix lie others whose eigenvalues are all different.
What can be said is that a matrix lies within its rounding of one with the structure found. Eigenvalues that rounding
may make equal are brought to the top of the Schur form; what is left there after their mean is nilpotent up to
rounding, and its null spaces give the sizes (Kublanovskaya's staircase) and chains of generalized eigenvectors.

**Stability.** The notes' criterion Re lambda <= 0 (eq. 14) is completed: where Re lambda = 0, the Jordan blocks must be
1 x 1, or the solution grows like a power of t. Whether a real part within its error is zero is decided in rational
numbers, by SymPy: the entries are taken as they stand. Where they have errors of their own, stability cannot be told.

References
----------
Golub and Van Loan, Matrix Computations, section 7.2. Demmel, Applied Numerical Linear Algebra, section 4.3. Golub and
Wilkinson, SIAM Review 18, 578 (1976). Kagstrom and Ruhe, ACM Trans. Math. Softw. 6, 398 (1980).
"""

from __future__ import annotations

from enum import Enum
from functools import partial
from importlib.util import find_spec
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root
from scipy.sparse.csgraph import connected_components

from kcons.constraints.arguments import FloatArray, Rng, as_float_array, generator_of, whole_number
from kcons.errors import InputError
from kcons.models.flows.flow import Flow

__all__ = ["Classification", "Equilibrium", "JordanBlocks", "JordanForm", "Kind", "LinearFlow", "Stability", "classify"]
__all__ += ["equilibrium_at", "find_equilibria", "jordan_block", "jordan_block_propagator", "jordan_form"]

ComplexArray: TypeAlias = NDArray[np.complex128]
EPSILON = float(np.finfo(np.float64).eps)
#: Singular values below this many times the noise of a block count as zero.
NULL = 100.0
#: Structures stand out where the least singular value that counts is so many times the largest that does not.
STANDS_OUT = 10.0
#: Eigenvalues that have no common structure are tried again as if known this many times better.
CLOSER = 8.0
#: Variables of the largest matrix whose eigenvalues on the imaginary axis are counted exactly.
LARGEST = 24
#: Equilibria closer than this, in parts of the size of the box, are one.
SAME = 1e-6
#: |V| counts as zero below this part of its size in the box.
ZERO = 1e-10


class LinearFlow(Flow):
    """dX/dt = A X (notes eq. 7).

    exp(At) is computed by scaling and squaring of a Pade approximant, which serves defective matrices as well.

    Parameters
    ----------
    matrix : array_like, shape (n, n)
    """

    def __init__(self, matrix: ArrayLike) -> None:
        self.matrix: FloatArray = _square(matrix).copy()
        super().__init__(lambda t, X: self.matrix @ X, len(self.matrix), lambda t, X: self.matrix)

    def propagator(self, t: float) -> FloatArray:
        """exp(At), shape (n, n) (notes eq. 9)."""
        return np.asarray(scipy.linalg.expm(self.matrix * t))

    def exact(self, t: ArrayLike, X0: ArrayLike) -> FloatArray:
        """X(t) = exp(At) X(0), shape (n,) or (k, n) (notes eq. 8)."""
        return np.asarray(scipy.linalg.expm(self.matrix * as_float_array(t, "t")[..., None, None]) @ self._state(X0))


# -- eigenvalues --------------------------------------------------------------------------------------


class Spectrum(NamedTuple):
    """A = S T S^-1 with T upper triangular; eigenvalues in the order of its diagonal."""

    values: ComplexArray
    #: How far each may be off, for all changes of the entries by their rounding and by the errors given.
    errors: FloatArray
    #: Norm of the change of the balanced matrix that was allowed for.
    noise: float
    triangular: ComplexArray
    #: S: a scaling by powers of two, and a unitary matrix.
    basis: ComplexArray


def spectrum(matrix: ArrayLike, error: ArrayLike = 0.0) -> Spectrum:
    """The eigenvalues of a real matrix and what is known about them; arguments as of `classify`."""
    A, E = _square(matrix), as_float_array(error, "error")
    if E.ndim and E.shape != A.shape:
        raise InputError(f"errors are a number or of the shape of the matrix, {A.shape}, not {E.shape}", item="error")
    if not np.all(np.isfinite(E) & (E >= 0)):
        raise InputError("errors of entries are finite and not negative", item="error")
    balanced, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    noise = len(A) * EPSILON * float(np.linalg.norm(balanced)) + float(np.linalg.norm(E * (scale / scale[:, None])))
    T, U = _schur(balanced)
    values, bounds = np.diag(T).copy(), _bounds(T, noise)
    # Conjugates are known equally well.
    errors = np.max(np.where(values[:, None].conj() == values, bounds, 0.0), axis=1)
    return Spectrum(values, errors, noise, T, scale[:, None] * U)


def _square(matrix: ArrayLike) -> FloatArray:
    A = as_float_array(matrix, "matrix")
    if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
        raise InputError(f"the matrix of a linear flow is square, not of shape {A.shape}", item="matrix")
    if not np.all(np.isfinite(A)):
        raise InputError("the matrix is not finite", item="matrix")
    return A


def _schur(block: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """T and the unitary matrix of the complex Schur form, with eigenvalues in exactly conjugate pairs."""
    R, Q = scipy.linalg.schur(block, output="real")
    T, U = R.astype(np.complex128), Q.astype(np.complex128)
    for k in np.flatnonzero(np.diag(R, -1)):
        # [[a, b], [c, a]] with b and c of opposite signs: a +- iw, w^2 = -bc, and (b, iw) is an eigenvector.
        b, c = np.sqrt(abs(R[k, k + 1])), np.copysign(np.sqrt(abs(R[k + 1, k])), R[k, k + 1])
        turn = np.array([[b, 1j * c], [1j * c, b]]) / np.hypot(b, c)
        two = slice(k, k + 2)
        T[:, two], U[:, two] = T[:, two] @ turn, U[:, two] @ turn
        T[two] = turn.conj().T @ T[two]
        T[k + 1, k] = 0.0
        T[k, k], T[k + 1, k + 1] = R[k, k] + 1j * b * abs(c), R[k, k] - 1j * b * abs(c)
    return T, U


def _bounds(T: ComplexArray, noise: float) -> FloatArray:
    """How far the eigenvalues of a triangular matrix move when it is changed by no more than `noise`.

    The smaller of two bounds: n cond_k noise (Demmel, theorem 4.5), and the one of Golub and Van Loan, theorem 7.2.3,
    which goes with a root of the noise and holds for defective matrices as well.
    """
    n, size = len(T), max(float(np.linalg.norm(T)), noise) or 1.0
    departure = float(np.linalg.norm(np.triu(T, 1))) / size
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        theta = noise / size * float(np.sum(departure ** np.arange(n)))
        # 1/|y^H x| of each eigenvalue, in the order of the diagonal.
        _, left, right = scipy.linalg.eig(T, left=True, right=True)
        condition = np.maximum(1.0, 1.0 / np.abs(np.einsum("ij,ij->j", left.conj(), right)))
        return np.minimum(n * condition * noise, size * max(theta, theta ** (1.0 / n)))


def _clusters(values: ComplexArray, errors: FloatArray) -> list[NDArray[np.intp]]:
    """Groups of eigenvalues whose discs overlap, one with another."""
    near = np.abs(values[:, None] - values) <= errors[:, None] + errors
    count, label = connected_components(near, directed=False)
    return [np.flatnonzero(label == k) for k in range(count)]


# -- the Jordan form ----------------------------------------------------------------------------------


class JordanBlocks(NamedTuple):
    """One eigenvalue and the sizes of its blocks (notes eqs. 11, 12)."""

    #: The mean of those that were taken as one.
    eigenvalue: complex
    #: Largest first; (1, 1) is two blocks of size 1.
    sizes: tuple[int, ...]
    #: Whether the structure stands out from rounding: no other eigenvalue lies so near that it might belong to these,
    #: and no coupling is so weak that it might be none. If not, it is one of several that the matrix may have.
    certain: bool = True


class JordanForm(NamedTuple):
    """A = T J T^-1 (notes eq. 10); T has chains of generalized eigenvectors, those of a block side by side."""

    T: ComplexArray
    J: ComplexArray
    #: In the order of J.
    blocks: list[JordanBlocks]

    def propagator(self, t: float) -> ComplexArray:
        """T exp(Jt) T^-1, block by block, shape (n, n) (notes eq. 13).

        Off exp(At) by the rounding times the condition number of T, which is large for matrices that are nearly
        defective; `LinearFlow.propagator` has no such error.
        """
        parts = [jordan_block_propagator(b.eigenvalue, size, t) for b in self.blocks for size in b.sizes]
        return np.asarray(np.linalg.solve(self.T.T, (self.T @ scipy.linalg.block_diag(*parts)).T).T)


def jordan_block(eigenvalue: complex, size: int) -> NDArray[np.inexact]:
    """lambda on the diagonal, ones above it, shape (size, size) (notes eq. 12)."""
    return np.asarray(eigenvalue * np.eye(size) + np.eye(size, k=1))


def jordan_block_propagator(eigenvalue: complex, size: int, t: float) -> NDArray[np.inexact]:
    """exp(J t) of one block in closed form: e^(lambda t) t^k/k! on the k-th diagonal, shape (size, size)."""
    terms = np.cumprod(np.concatenate([[1.0], t / np.arange(1.0, size)]))
    return np.asarray(np.exp(eigenvalue * t) * scipy.linalg.toeplitz(np.eye(size)[0], terms))


def jordan_form(matrix: ArrayLike) -> JordanForm:
    """T and J of a real matrix (notes eqs. 10-12), largest real parts first."""
    found = spectrum(matrix)
    pieces: list[tuple[JordanBlocks, ComplexArray]] = []
    for members in _clusters(found.values, found.errors):
        mean = _mean(found.values[members])
        if mean.imag < 0:
            continue  # comes with its conjugate
        for blocks, chains in _structures(found, members):
            pieces.append((blocks, chains))
            if mean.imag > 0:
                pieces.append((blocks._replace(eigenvalue=blocks.eigenvalue.conjugate()), chains.conj()))
    pieces.sort(key=lambda piece: (-piece[0].eigenvalue.real, -piece[0].eigenvalue.imag))
    J = scipy.linalg.block_diag(*[jordan_block(b.eigenvalue, size) for b, _ in pieces for size in b.sizes])
    return JordanForm(np.concatenate([c for _, c in pieces], axis=1), J.astype(np.complex128), [b for b, _ in pieces])


def _mean(values: ComplexArray) -> complex:
    """The mean of some eigenvalues: exactly real where they come in conjugate pairs, exact where all are equal."""
    if np.all(values == values[0]):
        return complex(values[0])
    return complex(np.mean(values.real), 0.0 if abs(np.sum(values.imag)) == 0.0 else np.mean(values.imag))


def _structures(
    found: Spectrum, members: NDArray[np.intp], closer: float = 1.0
) -> list[tuple[JordanBlocks, ComplexArray]]:
    """Blocks and chains of eigenvalues that may be one; of parts of them where they have no common structure."""
    values, m = found.values[members], len(members)
    mean = _mean(values)
    chosen = np.isin(np.arange(len(found.values)), members).astype(np.int32)
    T, Q, *_ = scipy.linalg.lapack.ztrsen(chosen, found.triangular, np.eye(len(chosen), dtype=np.complex128), job="N")
    top, basis = T[:m, :m], found.basis @ Q[:, :m]
    # What the entries of `top` may be off by: from the Schur form, from the exchanges, and from the mean.
    noise = m * EPSILON * float(scipy.linalg.norm(np.triu(top, 1))) + found.noise
    found_chains = _chains(top - mean * np.eye(m), NULL * noise)
    if found_chains is None:
        parts = _clusters(values, found.errors[members] / (CLOSER * closer))
        return [piece for part in parts for piece in _structures(found, members[part], CLOSER * closer)]
    chains, kept = found_chains
    certain = closer == 1.0 and bool(kept > STANDS_OUT * NULL * noise)
    blocks = JordanBlocks(mean, tuple(chain.shape[1] for chain in chains), certain)
    return [(blocks, np.hstack([_of_unit_length(basis @ chain) for chain in chains]))]


def _of_unit_length(chain: ComplexArray) -> ComplexArray:
    """A chain of which the largest number is real."""
    largest = chain.ravel()[np.argmax(np.abs(chain))]
    return np.asarray(chain * (abs(largest) / largest) / scipy.linalg.norm(chain))


def _chains(N: ComplexArray, zero: float) -> tuple[list[ComplexArray], float] | None:
    """Chains ..., N N x, N x, x of a nilpotent matrix, which end where N does, as columns; longest first.

    And the least singular value that was not taken as zero. None if N is not nilpotent to this accuracy.
    """
    levels, kept, rest = [], np.inf, np.eye(len(N), dtype=np.complex128)
    while rest.shape[1]:  # null spaces of N and of what is left of it, whose dimensions never grow
        _, singular, vh = np.linalg.svd(rest.conj().T @ N @ rest)
        null = singular <= zero
        if not null.any():
            return None
        kept = min([kept, *singular[~null]])
        levels.append(rest @ vh[null].conj().T)
        rest = rest @ vh[~null].conj().T
    chains: list[ComplexArray] = []
    for level in reversed(levels):
        chains = [np.column_stack([N @ chain[:, 0], chain]) for chain in chains]
        # What the chains that came down leave free at this level: ends of new chains.
        taken = np.array([level.conj().T @ chain[:, 0] for chain in chains]).reshape(-1, level.shape[1])
        free = np.linalg.qr(taken.T, mode="complete")[0][:, len(chains) :]
        chains += [column[:, None] for column in (level @ free).T]
    return chains, kept


# -- stability ----------------------------------------------------------------------------------------


class Kind(Enum):
    """What the flow looks like around an equilibrium; a real part within its error counts as zero."""

    NODE = "node"
    FOCUS = "focus"
    SADDLE = "saddle"
    CENTER = "center"
    DEGENERATE = "degenerate"


class Stability(Enum):
    """What becomes of a small deviation."""

    ASYMPTOTIC = "asymptotically stable"
    STABLE = "stable"
    UNSTABLE = "unstable"
    #: No eigenvalue is known to lie right of the axis, nor all left of it or on it (which SymPy tells, if it is there).
    UNKNOWN = "cannot be told"


class Classification(NamedTuple):
    """Kind and stability of a linear flow."""

    kind: Kind
    stability: Stability
    #: Sorted by real part, largest first.
    eigenvalues: ComplexArray
    #: Whether all real parts are known not to vanish. Only then does the linear flow decide about the stability of an
    #: equilibrium of a flow that is not linear.
    hyperbolic: bool
    #: How far each eigenvalue may be off.
    errors: FloatArray

    def __str__(self) -> str:
        if self.stability is Stability.UNKNOWN:
            return f"{self.kind.value} whose stability {self.stability.value}"
        return f"{self.stability.value} {self.kind.value}"


def classify(matrix: ArrayLike, error: ArrayLike = 0.0) -> Classification:
    """Name the flow dX/dt = A X (notes eq. 14, completed).

    Node: all eigenvalues real and of one sign; focus: real parts of one sign, some eigenvalues complex; saddle: real
    parts of both signs; center: all purely imaginary; degenerate: an eigenvalue 0, or zero real parts among others.

    Parameters
    ----------
    matrix : array_like, shape (n, n)
    error : array_like, shape (n, n) or a number
        How far the entries may be off, beyond their rounding: of a Jacobian by differences, for example. Without any,
        real parts of exactly zero are found, for up to 24 variables; for more than two this needs SymPy.
    """
    A, found = _square(matrix), spectrum(matrix, error)
    groups = _clusters(found.values, found.errors)
    signs = np.zeros(len(A), dtype=int)
    zero = turning = False
    for g in groups:
        real, mean, off = found.values[g].real, complex(np.mean(found.values[g])), found.errors[g]
        signs[g] = 1 if np.all(real > off) else -1 if np.all(real < -off) else 0
        zero, turning = zero or abs(mean) <= max(off), turning or abs(mean.imag) > max(off)
    present = set(signs.tolist())
    if zero or (0 in present and len(present) == 2):
        kind = Kind.DEGENERATE
    elif len(present) > 1:
        kind = Kind.SADDLE
    else:
        kind = Kind.CENTER if present == {0} else Kind.FOCUS if turning else Kind.NODE
    stability = Stability.UNSTABLE if 1 in present else Stability.ASYMPTOTIC if present == {-1} else Stability.UNKNOWN
    if stability is Stability.UNKNOWN and not np.any(error):
        axis = (2, True) if len(A) == 2 and not zero and np.trace(A) == 0.0 else on_axis(A)
        if axis is not None and axis[0] == np.sum(signs == 0):
            stability = Stability.STABLE if axis[1] else Stability.UNSTABLE
    order = np.lexsort((-found.values.imag, -found.values.real))
    return Classification(kind, stability, found.values[order], 0 not in present, found.errors[order])


def on_axis(matrix: FloatArray) -> tuple[int, bool] | None:
    """How many eigenvalues lie on the imaginary axis exactly, and whether all their Jordan blocks have size 1.

    Entries count as they stand, as doubles are rational numbers. Eigenvalues on the axis are common roots of the
    characteristic polynomials of A and -A. None where common roots lie off the axis, with too many variables, or
    without SymPy.
    """
    if len(matrix) > LARGEST or not find_spec("sympy"):
        return None
    from sympy import QQ, Poly, Symbol
    from sympy.polys.matrices import DomainMatrix

    x, shape = Symbol("x"), matrix.shape
    A = DomainMatrix([[QQ(*float(v).as_integer_ratio()) for v in row] for row in matrix], shape, QQ)
    p = Poly(A.charpoly(), x, domain=QQ)
    common = p.gcd(p.compose(Poly(-x, x, domain=QQ)))
    once = common.sqf_part()
    squares = Poly(once.all_coeffs()[::2], x, domain=QQ)
    if squares.degree() > 0 and squares.count_roots(None, 0) < squares.degree():
        return None
    # The least polynomial of A has simple roots on the axis if this one vanishes at A.
    least, value = p.quo(common) * once, DomainMatrix.zeros(shape, QQ)
    for c in least.all_coeffs() if once.degree() < common.degree() else ():
        value = value * A + QQ(c.p, c.q) * DomainMatrix.eye(shape, QQ)
    return common.degree(), value.is_zero_matrix


# -- equilibria ---------------------------------------------------------------------------------------


class Equilibrium(NamedTuple):
    """A point where V vanishes."""

    position: FloatArray
    jacobian: FloatArray
    #: Of the linear flow around it; it decides about stability only where it is `hyperbolic`.
    classification: Classification
    #: |V| there.
    residual: float


def find_equilibria(
    flow: Flow, box: ArrayLike, *, starts: int = 100, time: float = 0.0, rng: Rng = 0
) -> list[Equilibrium]:
    """Search for equilibria within a box, by Powell's method from many starts.

    They come sorted by position. A search can miss one; more starts make that less likely.

    Parameters
    ----------
    flow : Flow
    box : array_like, shape (n, 2)
        Least and largest value of each variable.
    starts : int
        Starts: the corners and the middle of the box, the rest spread at random.
    time : float
        V is taken at this time.
    rng : int, numpy.random.Generator or None
    """
    edges, starts, n = as_float_array(box, "box"), whole_number(starts, "starts"), flow.n
    if edges.shape != (n, 2) or not np.all(np.isfinite(edges)) or np.any(edges[:, 0] >= edges[:, 1]):
        raise InputError(f"the box has shape ({n}, 2), its lower edges first", item="box")
    low, width = edges[:, 0], edges[:, 1] - edges[:, 0]
    fixed = [[0.5] * n, *(product((0.0, 1.0), repeat=n) if n <= 6 else ())]
    spread = generator_of(rng).random((max(starts - len(fixed), 0), n))
    points = low + width * np.array([*fixed, *spread])[:starts]
    found: list[FloatArray] = []
    velocity, jacobian = partial(flow.velocity, time), partial(flow.jacobian, time)
    with np.errstate(all="ignore"):
        speeds = [float(np.linalg.norm(velocity(p))) for p in points]
        size = float(np.median([s for s in speeds if np.isfinite(s)] or [1.0])) or 1.0
        for point in points:
            try:
                X = np.asarray(root(velocity, point, jac=jacobian, options={"xtol": 1e-13}).x)
                place, left = (X - low) / width, float(np.linalg.norm(velocity(X)))
            except InputError:  # the search has left all numbers
                continue
            inside = np.min(place) >= -SAME and np.max(place) <= 1 + SAME and left <= ZERO * size
            if inside and all(np.max(np.abs(X - other) / width) > SAME for other in found):
                found.append(X)
    found.sort(key=lambda X: [round(float(value), 9) for value in X])
    return [equilibrium_at(flow, X, time) for X in found]


def equilibrium_at(flow: Flow, position: ArrayLike, time: float = 0.0) -> Equilibrium:
    """What the flow does around a point where it vanishes.

    The Jacobian counts as known to the accuracy of its differences and of the point. So a center of a flow that is
    given without its Jacobian is a center whose stability cannot be told.
    """
    X = as_float_array(position, "position")
    A, V = flow.jacobian(time, X), flow.velocity(time, X)
    # One more Newton step says how far the point may be off, and that what the Jacobian would be there; at a root of
    # order k it goes only a k-th part of the way.
    there = X - np.linalg.lstsq(A, V, rcond=1e-10)[0]
    moved = 4.0 * np.abs(flow.jacobian(time, there) - A) if np.all(np.isfinite(there)) else np.zeros_like(A)
    return Equilibrium(X, A, classify(A, moved + flow.jacobian_error(time, X)), float(np.linalg.norm(V)))
