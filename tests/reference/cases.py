"""Reads a reference case: constraints, masses, forces and the stored solution. See README.md beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons import constraints as held

Array = NDArray[np.float64]
Spec = Mapping[str, Any]
Force = Callable[[Array, Array], Array]
Potential = Callable[[Array], float]

DATA = Path(__file__).parent / "data"
#: Every case, in order.
NAMES: tuple[str, ...] = tuple(sorted(path.stem for path in DATA.glob("*.json")))


@dataclass(frozen=True)
class Snapshot:
    """The reference solution at one time; arrays of shape (n_atoms, 3)."""

    time: float
    positions: Array
    velocities: Array
    accelerations: Array
    constraint_forces: Array
    energy: float | None
    #: Friction coefficient of the isokinetic thermostat, 0 without one.
    alpha: float = 0.0
    #: 2-norm of the sensitivity of this state to the initial one, NaN where it is not stored.
    condition: float = float("nan")
    #: Difference to an independent integration in double precision (DOP853), NaN where it is not stored.
    difference: float = float("nan")

    @property
    def tolerance(self) -> float:
        """What a high-order integration in double precision can be expected to reach (position, absolute)."""
        return float(np.nanmax([1e-13, 1e-14 * self.condition, 10 * self.difference]))


@dataclass(frozen=True)
class Case:
    """One reference case.

    Attributes
    ----------
    constraints : tuple of Constraint
        With explicit targets.
    masses : ndarray, shape (n_atoms,)
    initial : Snapshot
        Accelerations and constraint forces are NaN where they are not stored (A03).
    solution : tuple of Snapshot
        At the stored times, in order of time.
    isokinetic : bool
        Whether the kinetic energy is held as well.
    velocity_dependent : bool
        Whether the forces depend on the velocities (friction).
    """

    name: str
    constraints: tuple[held.Constraint, ...]
    masses: Array
    initial: Snapshot
    solution: tuple[Snapshot, ...]
    isokinetic: bool
    velocity_dependent: bool
    _terms: tuple[tuple[Force, Potential], ...]

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """All times for which accelerations are known, the initial one included."""
        known = np.isfinite(self.initial.accelerations).all()
        return ((self.initial,) if known else ()) + self.solution

    def force(self, x: Array, v: Array) -> Array:
        """Applied forces, without the thermostat, shape (n_atoms, 3)."""
        total = np.zeros_like(x)
        for force, _ in self._terms:
            total += force(x, v)
        return total

    def potential(self, x: Array) -> float:
        return float(sum(potential(x) for _, potential in self._terms))

    def energy(self, x: Array, v: Array) -> float:
        return self.potential(x) + 0.5 * float(np.sum(self.masses[:, None] * v**2))


@cache
def load(name: str) -> Case:
    """Read one case by its name, for example 'A01_sphere_free'."""
    data = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    assert data["schema"] == "kcons-ref-1" and data["kind"] == "mechanics"
    masses = np.array(data["masses"], dtype=np.float64)
    terms = tuple(FORCES[spec["type"]](spec, masses) for spec in data["forces"])

    def force(x: Array, v: Array) -> Array:
        return sum((f(x, v) for f, _ in terms), np.zeros_like(x))

    times = data["times"]
    solution = [_snapshot(data, k, masses, force) for k in range(len(times))]
    return Case(
        name=name,
        constraints=tuple(constraint for spec in data["constraints"] for constraint in CONSTRAINTS[spec["type"]](spec)),
        masses=masses,
        initial=_initial(data),
        solution=tuple(sorted(solution, key=lambda s: s.time)),
        isokinetic=bool(data["isokinetic"]),
        velocity_dependent=any(spec["type"] == "friction" for spec in data["forces"]),
        _terms=terms,
    )


def _initial(data: Spec) -> Snapshot:
    start, known = data["initial"], data.get("initial_reference") or {}
    x = np.array(start["positions"], dtype=np.float64)
    unknown = np.full_like(x, np.nan)
    return Snapshot(
        time=float(start["time"]),
        positions=x,
        velocities=np.array(start["velocities"], dtype=np.float64),
        accelerations=np.array(known.get("accelerations", unknown), dtype=np.float64),
        constraint_forces=np.array(known.get("constraint_forces", unknown), dtype=np.float64),
        energy=known.get("total_energy"),
        alpha=float(known.get("alpha", 0.0)),
        condition=1.0,
        difference=0.0,
    )


def _snapshot(data: Spec, k: int, masses: Array, force: Force) -> Snapshot:
    reference, quality = data["reference"], data.get("quality") or {}
    x, v = (np.array(reference[item][k], dtype=np.float64) for item in ("positions", "velocities"))
    if "accelerations" in reference:
        a, z = (np.array(reference[item][k], dtype=np.float64) for item in ("accelerations", "constraint_forces"))
    else:  # a pendulum: the rod pulls with its tension towards the origin
        z = -reference["rod_tension"][k] * x / np.linalg.norm(x)
        a = (force(x, v) + z) / masses[:, None]
    return Snapshot(
        time=float(data["times"][k]),
        positions=x,
        velocities=v,
        accelerations=a,
        constraint_forces=z,
        energy=_at(reference.get("total_energy"), k),
        alpha=_at(reference.get("alpha"), k) or 0.0,
        condition=_or_nan(_at(quality.get("condition_number_flow"), k)),
        difference=_or_nan(_at(quality.get("max_diff_to_scipy_DOP853_double"), k)),
    )


def _at(values: Any, k: int) -> float | None:
    return None if values is None else float(values[k])


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


# -- constraints ------------------------------------------------------------------------------------


def _sphere(spec: Spec) -> list[held.Constraint]:
    return [held.Sphere(spec["atom"], spec["point"], spec["target"])]


def _ellipse_xz(spec: Spec) -> list[held.Constraint]:
    weights = np.array([1 / spec["a"] ** 2, 0.0, 1 / spec["b"] ** 2])
    return [
        held.ImplicitSurface(
            spec["atom"],
            lambda x: x**2 @ weights - 1,
            lambda x: 2 * weights * x,
        )
    ]


def _rotating_plane(spec: Spec) -> list[held.Constraint]:
    return [held.Formula("y1*cos(w*t) - x1*sin(w*t)", spec["atom"], {"w": spec["omega"]})]


def _rotating_ellipse(spec: Spec) -> list[held.Constraint]:
    """The plane, and an ellipse that turns with it."""
    numbers = {"w": spec["omega"], "a": spec["a"], "b": spec["b"]}
    ellipse = "((x1*cos(w*t) + y1*sin(w*t))/a)**2 + (z1/b)**2 - 1"
    return [*_rotating_plane(spec), held.Formula(ellipse, spec["atom"], numbers)]


CONSTRAINTS: dict[str, Callable[[Spec], list[held.Constraint]]] = {
    "distance": lambda spec: [held.Distance(spec["atoms"], spec["target"])],
    "distance_to_point": _sphere,
    "angle_cos": lambda spec: [held.Angle(spec["atoms"], spec["angle_rad"])],
    "plane": lambda spec: [held.Plane(spec["atom"], spec["normal"], spec["target"])],
    "ellipse_xz": _ellipse_xz,
    "torus": lambda spec: [held.Torus(spec["atom"], np.zeros(3), [0.0, 0.0, 1.0], spec["R"], spec["r"])],
    "rotating_plane": _rotating_plane,
    "rotating_ellipse": _rotating_ellipse,
    "linear_vector": lambda spec: [held.LinearRelation(spec["atoms"][0], spec["atoms"][1:], spec["weights"])],
}


# -- forces: each gives (force of x and v, potential of x) ------------------------------------------


def _uniform_acceleration(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    f = masses[:, None] * np.array(spec["g"], dtype=np.float64)
    return lambda x, v: f, lambda x: -float(np.sum(f * x))


def _uniform_field(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    f = np.array(spec["charges"])[:, None] * np.array(spec["E"], dtype=np.float64)
    return lambda x, v: f, lambda x: -float(np.sum(f * x))


def _uniform_force(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    f = np.zeros((len(masses), 3))
    f[spec["atom"]] = spec["F"]
    return lambda x, v: f, lambda x: -float(np.sum(f * x))


def _harmonic_site(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    k, center = np.array(spec["k"]), np.array(spec.get("center", np.zeros(3)))
    return _on_one_atom(spec["atom"], lambda r: -k * (r - center)), lambda x: float(
        0.5 * k @ (x[spec["atom"]] - center) ** 2
    )


def _quartic_site(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    k4, kxy = np.array(spec["k4"]), spec["kxy"]

    def force(r: Array) -> Array:
        return -k4 * r**3 - kxy * np.array([r[0] * r[1] ** 2, r[0] ** 2 * r[1], 0.0])

    def potential(x: Array) -> float:
        r = x[spec["atom"]]
        return float(0.25 * k4 @ r**4 + 0.5 * kxy * r[0] ** 2 * r[1] ** 2)

    return _on_one_atom(spec["atom"], force), potential


def _harmonic_bond(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    k, r0 = spec["k"], spec["r0"]
    return _between([spec["atoms"]], lambda r: -k * (r - r0), lambda r: 0.5 * k * (r - r0) ** 2)


def _lj(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    epsilon, sigma = spec["epsilon"], spec["sigma"]
    return _between(
        spec["pairs"],
        lambda r: 24 * epsilon / r * (2 * (sigma / r) ** 12 - (sigma / r) ** 6),
        lambda r: 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6),
    )


def _torsion_cos3(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    """k (1 + cos 3 phi), with the gradient of phi by Blondel and Karplus (1996)."""
    i, j, k, l = spec["atoms"]
    strength = spec["k"]

    def parts(x: Array) -> tuple[Array, Array, Array, Array, Array, float]:
        F, G, H = x[i] - x[j], x[j] - x[k], x[l] - x[k]
        A, B = np.cross(F, G), np.cross(H, G)
        phi = np.arctan2(np.cross(B, A) @ G / np.linalg.norm(G), A @ B)
        return F, G, H, A, B, float(phi)

    def force(x: Array, v: Array) -> Array:
        F, G, H, A, B, phi = parts(x)
        g = np.linalg.norm(G)
        a, b = A / (A @ A), B / (B @ B)
        middle = (F @ G) / g * a - (H @ G) / g * b
        f = np.zeros_like(x)
        f[i], f[j], f[k], f[l] = -g * a, g * a + middle, -g * b - middle, g * b
        return 3 * strength * np.sin(3 * phi) * f

    return force, lambda x: strength * (1 + float(np.cos(3 * parts(x)[5])))


def _friction(spec: Spec, masses: Array) -> tuple[Force, Potential]:
    return lambda x, v: -spec["gamma"] * masses[:, None] * v, lambda x: 0.0


def _on_one_atom(atom: int, force: Callable[[Array], Array]) -> Force:
    def spread(x: Array, v: Array) -> Array:
        f = np.zeros_like(x)
        f[atom] = force(x[atom])
        return f

    return spread


def _between(
    pairs: list[list[int]], push: Callable[[Array], Array], energy: Callable[[Array], Array]
) -> tuple[Force, Potential]:
    """Central forces: `push` is -dU/dr of the distances, positive where the atoms repel."""
    first, second = np.array(pairs).T

    def force(x: Array, v: Array) -> Array:
        d = x[first] - x[second]
        r = np.linalg.norm(d, axis=1)
        along = (push(r) / r)[:, None] * d
        f = np.zeros_like(x)
        np.add.at(f, first, along)
        np.add.at(f, second, -along)
        return f

    return force, lambda x: float(np.sum(energy(np.linalg.norm(x[first] - x[second], axis=1))))


FORCES: dict[str, Callable[[Spec, Array], tuple[Force, Potential]]] = {
    "uniform_acceleration": _uniform_acceleration,
    "uniform_force": _uniform_force,
    "uniform_field": _uniform_field,
    "harmonic_site": _harmonic_site,
    "quartic_site": _quartic_site,
    "harmonic_bond": _harmonic_bond,
    "lj": _lj,
    "torsion_cos3": _torsion_cos3,
    "friction": _friction,
}
