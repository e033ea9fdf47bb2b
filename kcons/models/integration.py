"""What the models share: SciPy's integrators with a projection after each step, and differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import BDF, DOP853, RK23, RK45, DenseOutput, OdeSolver, Radau, solve_ivp

from kcons.constraints.arguments import FloatArray, as_float_array, read_only_view
from kcons.constraints.target import WRONG, first_derivative_4
from kcons.errors import ContradictionError, InputError, NonFiniteError, SingularGeometryError

METHODS: dict[str, type[OdeSolver]] = {"RK23": RK23, "RK45": RK45, "DOP853": DOP853, "Radau": Radau, "BDF": BDF}
#: What SciPy takes where less is asked for.
LEAST_RTOL = 100 * float(np.finfo(float).eps)
#: h of `jacobian_by_differences`.
STEP = 0.02


class _Along(DenseOutput):
    """A solution between two times, by a function of time."""

    def __init__(self, t_old: float, t: float, at: Callable[[float], FloatArray]) -> None:
        super().__init__(t_old, t)
        self._at = at

    def _call_impl(self, t: Any) -> FloatArray:
        return np.asarray(self._at(t) if t.ndim == 0 else np.stack([self._at(s) for s in t], axis=1))


def integrate(
    slope: Callable[[float, FloatArray], FloatArray],
    span: tuple[float, float],
    start: FloatArray,
    method: type[OdeSolver],
    project: Callable[[float, FloatArray], FloatArray],
    **options: Any,
) -> Any:
    """What SciPy's ``solve_ivp`` gives, with a projection of values between steps and of ends, where the next begins.

    A trial step may go too far, to a singular place or to numbers that are not finite, and is then made shorter. What
    was wrong there is raised if the run ends there.
    """
    told: list[Exception] = []

    def tried(t: float, y: FloatArray) -> FloatArray:
        if np.isfinite(y).all():
            try:
                return slope(t, y)
            except (ContradictionError, NonFiniteError, SingularGeometryError) as error:
                told[:] = [error]
        return np.full(len(y), np.nan)

    class Projecting(method):  # type: ignore[misc, valid-type]
        t: float
        y: FloatArray

        def _step_impl(self) -> tuple[bool, str | None]:
            success, message = super()._step_impl()
            if success:
                y = project(self.t, self.y)
                told.clear()
                if isinstance(self, BDF):
                    self.D[0] += y - self.y
                else:
                    self.f = self.fun(self.t, y)
                self.y = y
            return success, message

        def _dense_output_impl(self) -> DenseOutput:
            between = super()._dense_output_impl()
            return _Along(self.t_old, self.t, lambda t: project(t, between(t)))

    try:
        found = solve_ivp(tried, span, start, Projecting, **options)
    except ValueError:  # implicit methods: no numbers in their matrix
        if not told:
            raise
    else:
        if found.status >= 0 or not told:
            return found
    raise told[0]


def check_run(
    t_span: Sequence[float], t_eval: ArrayLike | None, method: str, sizes: dict[str, Any], n: int
) -> tuple[type[OdeSolver], tuple[float, float], FloatArray | None]:
    """The method, the span and the times of a run of `n` variables.

    Refused is also what SciPy goes on with for ever, or otherwise than was asked for: rtol below rounding, a negative
    atol, NaN.
    """
    if not isinstance(method, str) or method not in METHODS:
        raise InputError(
            f"{method!r} is not among the methods {', '.join(METHODS)}; for stiff systems take Radau", item="method"
        )
    ends = as_float_array(t_span, "t_span")
    if ends.shape != (2,) or not np.all(np.isfinite(ends)):
        raise InputError(f"t_span is a pair of finite times, not {t_span!r:.80}", item="t_span")
    t0, t1 = ends.tolist()
    times = None if t_eval is None else as_float_array(t_eval, "t_eval")
    if times is not None:
        forward = times if t1 >= t0 else -times
        inside = times.ndim == 1 and np.all((times >= min(t0, t1)) & (times <= max(t0, t1)))
        if not (inside and np.all(np.diff(forward) > 0)):
            raise InputError(
                "t_eval is one-dimensional and within t_span, sorted from its start to its end", item="t_eval"
            )
    for name, least in (("rtol", LEAST_RTOL), ("atol", 0.0), ("max_step", 0.0), ("first_step", 0.0)):
        if sizes.get(name) is None:
            continue
        given, step = as_float_array(sizes[name], name), name.endswith("step")
        if given.shape not in ((), () if step else (n,)) or not np.all(given > least if step else given >= least):
            wanted = "positive number" if step else f"number of {least:g} or more, or {n} of them"
            raise InputError(f"{name} is {sizes[name]!r:.60}; give a {wanted}", item=name)
    return METHODS[method], (t0, t1), times


def called(
    item: str, function: Callable[..., ArrayLike], shape: tuple[int, ...], *arguments: Any, scalar: bool = False
) -> FloatArray:
    """What a function of the user gives, of that shape, or with `scalar` one number for all.

    It can read arrays among its arguments and not change them.
    """
    value = as_float_array(function(*(read_only_view(a) if isinstance(a, np.ndarray) else a for a in arguments)), item)
    if value.shape == shape:
        return read_only_view(value)
    if not scalar or value.shape:
        raise InputError(f"{item} returned shape {value.shape}, not {shape}", item=item)
    return np.broadcast_to(value, shape)


def jacobian_by_differences(
    velocity: Callable[[float, FloatArray], ArrayLike], t: float, X: ArrayLike, step: float | FloatArray = STEP
) -> FloatArray:
    """dV/dX by central differences of fourth order, shape (m, n).

    Their steps are h/16; h is `step`, times the size of a variable where that is larger than 1, or an array of one h a
    variable.
    """
    X = as_float_array(X, "X")
    steps = step if isinstance(step, np.ndarray) else step * np.maximum(1.0, np.abs(X))

    def along(e: FloatArray, h: float) -> FloatArray:
        return first_derivative_4(
            lambda s: as_float_array(velocity(t, read_only_view(X + s * e)), "velocity"), 0.0, h / 16
        )

    return np.stack([along(e, h) for e, h in zip(np.eye(len(X)), steps, strict=True)], axis=-1)


def check_derivative(
    item: str,
    of: str,
    given: FloatArray | None,
    coarse: FloatArray,
    fine: FloatArray,
    *,
    rounding: float = 0.0,
    smooth: float = WRONG,
) -> None:
    """Refuse a derivative that differences with a step and with half of it contradict.

    Where none was given, refuse differences that half the step changes by more than the part `smooth` and `rounding`.
    """
    size = float(np.max(np.abs(fine), initial=0.0))
    apart = np.abs(fine - coarse)
    if given is None:
        if np.any(apart > smooth * size + rounding):
            raise InputError(
                f"{of} changes too fast for differences: give its {item}, or variables of order 1", item=item
            )
        return
    wrong = (np.abs(given - fine) > WRONG * size + rounding) & (apart <= WRONG * size + rounding)
    if np.any(wrong):
        k = tuple(np.argwhere(wrong)[0].tolist())
        raise InputError(
            f"{item} gives {given[k]:.6g} for entry {list(k)}, but differences of {of} give {fine[k]:.6g}; "
            "correct it, or leave it out",
            item=item,
        )
