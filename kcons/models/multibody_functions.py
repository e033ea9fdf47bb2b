"""The functions that a user gave for a multibody system: called, checked, and differenced where one is missing."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import TAKES_TIME, FloatArray, check_call, lent, numbers, positive
from kcons.constraints.target import WRONG, first_derivative, first_derivative_4, second_derivative
from kcons.errors import InputError, NonFiniteError


class MultibodyFunctions:
    """What the user gave: called, differenced where derivatives are missing, and checked."""

    #: Number of constraints, None until it is seen.
    m: int | None
    mass: FloatArray | Callable[..., ArrayLike]

    def __init__(
        self,
        mass: ArrayLike | Callable[..., ArrayLike],
        force: Callable[..., ArrayLike],
        constraints: Callable[..., ArrayLike] | None,
        jacobian: Callable[..., ArrayLike] | None,
        curvature: Callable[..., ArrayLike] | None,
        time_dependent: bool,
        length: float,
        time_step: float,
    ) -> None:
        functions = {"force": force, "constraints": constraints, "jacobian": jacobian, "curvature": curvature}
        for name, given in functions.items():
            if not callable(given) and (given is not None or name == "force"):
                raise InputError(f"{name} must be a function, not {given!r:.60}", item=name)
            if given is not None and constraints is None and name != "force":
                raise InputError(f"there is a {name} without constraints; give the function g as well", item=name)
        last = ("t",) if time_dependent else ()
        if callable(mass):
            check_call("mass", mass, ("q",))
        check_call("force", force, ("q", "v", "t"))
        check_call("constraints", constraints, ("q", *last), TAKES_TIME)
        check_call("jacobian", jacobian, ("q", *last), TAKES_TIME)
        check_call("curvature", curvature, ("q", "v", *last), TAKES_TIME)
        for name, size in (("length", length), ("time_step", time_step)):
            positive(size, name)
        self.force, self.constraints, self.jacobian, self.curvature = force, constraints, jacobian, curvature
        self.time_dependent, self.length, self.time_step = bool(time_dependent), float(length), float(time_step)
        self.m = 0 if constraints is None else None
        if callable(mass):
            self.mass = mass
        else:
            matrix = np.array(numbers(mass, "mass"))
            self.mass = np.diag(matrix) if matrix.ndim == 1 else matrix
            check_symmetric(self.mass)

    def _called(self, name: str, shape: tuple[int, ...] | None, *arguments: Any) -> FloatArray:
        """What a function of the user returned, of that shape, by default (m,), and finite; a copy.

        Arguments are lent, or nobody else's.
        """
        array = np.array(numbers(getattr(self, name)(*arguments), name))
        if shape is None:
            array = np.atleast_1d(array)
            shape = (array.size,) if self.m is None else (self.m,)
        if array.shape != shape:
            raise InputError(f"{name} returned shape {array.shape}; it must return {shape}", item=name)
        if not np.isfinite(array).all():
            entry = np.argwhere(~np.isfinite(array))[0].tolist()
            raise NonFiniteError(
                f"{name} is not finite at q = {shown(arguments[0])}: entry {entry}; mend the function, or keep the "
                "motion away from there",
                item=name,
            )
        return array

    def _at(self, *arguments: Any) -> tuple[Any, ...]:
        """What functions of the constraints take; the time, which is last, only where they depend on it."""
        return arguments if self.time_dependent else arguments[:-1]

    def _M(self, q: FloatArray) -> FloatArray:
        return self.mass if isinstance(self.mass, np.ndarray) else self._called("mass", (len(q), len(q)), q)

    def _g(self, q: FloatArray, t: float) -> FloatArray:
        return self._called("constraints", None, *self._at(q, t)) if self.m else np.zeros(0)

    def _G(self, q: FloatArray, t: float) -> FloatArray:
        if self.m and self.jacobian is not None:
            return self._called("jacobian", (self.m, len(q)), *self._at(q, t))
        step, axes = 1e-3 * self.length, np.eye(len(q))

        def along(e: FloatArray) -> FloatArray:
            return first_derivative_4(lambda s: self._g(q + s * e, t), 0.0, step)

        return np.stack([along(e) for e in axes], axis=1)

    def _c(self, q: FloatArray, t: float) -> FloatArray:
        """What G v must be, shape (m,) or ()."""
        if not (self.m and self.time_dependent):
            return np.zeros(())
        return -first_derivative(lambda s: self._g(q, s), t, self.time_step)

    def _b(self, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        """What G a must be, shape (m,)."""
        if self.m and self.curvature is not None:
            return -self._called("curvature", None, *self._at(q, v, t))
        speed = max(largest(v) / self.length, 0.02 / self.time_step if self.time_dependent else 0.0)
        if not self.m or speed == 0.0:
            return np.zeros(self.m or 0)
        if self.jacobian is not None and not self.time_dependent:
            return -first_derivative_4(lambda s: self._G(q + s * v, t) @ v, 0.0, 1e-3 / speed)
        return -second_derivative(lambda s: self._g(q + s * v, t + s), 0.0, 0.02 / speed)

    def _state(self, q: ArrayLike, v: ArrayLike, t: float) -> tuple[FloatArray, FloatArray]:
        """A state as arrays, after all functions were seen to fit it."""
        found = []
        for item, given in (("q", q), ("v", v)):
            array = numbers(given, item)
            n = np.size(q) if callable(self.mass) else len(self.mass)
            if array.shape != (n,) or n == 0:
                raise InputError(
                    f"{item} has shape {array.shape}; give a number for each coordinate, ({n},)", item=item
                )
            if not np.isfinite(array).all():
                raise InputError(f"{item}[{int(np.argmin(np.isfinite(array)))}] is not finite", item=item)
            found.append(lent(array))
        self._check_functions(found[0], t)
        return found[0], found[1]

    def _check_functions(self, q: FloatArray, t: float) -> None:
        """Count the constraints; refuse derivatives that differences contradict, which would give wrong motion."""
        if callable(self.mass):
            check_symmetric(self._M(q))
        if self.constraints is None:
            return
        self.m = None
        self.m = len(self._called("constraints", None, *self._at(q, t)))
        bare = copy(self)
        bare.jacobian = bare.curvature = None
        G = bare._G(q, t)
        speed = self.length * (0.02 / self.time_step if self.time_dependent else 1.0)
        along = speed * np.random.default_rng(0).normal(size=len(q))
        for name, given, found, unit in (
            ("jacobian", self._G(q, t), G, 0.0),
            ("curvature", -self._b(q, along, t), -bare._b(q, along, t), speed**2 / self.length),
        ):
            off = np.abs(given - found)
            if off.size and not off.max() <= WRONG * (largest(found) + unit * largest(G)):
                worst = np.unravel_index(int(np.argmax(off)), off.shape)
                raise InputError(
                    f"{name} gives {given[worst]:.6g} for entry {[int(k) for k in worst]}, but differences of the "
                    f"constraints give {found[worst]:.6g}; correct it, or give the length over which they bend "
                    "(length=...)",
                    item=name,
                )


def check_symmetric(M: FloatArray) -> None:
    if M.ndim != 2 or len(M) != M.shape[-1] or len(M) == 0:
        raise InputError(f"mass has shape {M.shape}; give a diagonal (n,) or a matrix (n, n)", item="mass")
    if not np.isfinite(M).all():
        raise InputError(f"mass is not finite in row {int(np.argmin(np.isfinite(M).all(axis=1)))}", item="mass")
    off = np.abs(M - M.T)
    i, j = np.unravel_index(int(np.argmax(off)), off.shape)
    if off[i, j] > 1e-10 * np.abs(M).max():
        raise InputError(
            f"mass is not symmetric: {M[i, j]:.6g} at [{i}, {j}] and {M[j, i]:.6g} at [{j}, {i}]; both are needed",
            item="mass",
        )


def largest(values: FloatArray) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def shown(q: FloatArray) -> str:
    return np.array2string(q, precision=6, threshold=8)
