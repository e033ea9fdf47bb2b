"""Reads a reference case: constraints, masses, forces and the stored solution. See README.md beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons import constraints as held

Array = NDArray[np.float64]
Spec = Mapping[str, Any]

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
    friction : float
        The forces depend on the velocities where it is not 0.
    """

    name: str
    constraints: tuple[held.Constraint, ...]
    masses: Array
    initial: Snapshot
    solution: tuple[Snapshot, ...]
    isokinetic: bool
    friction: float
    _forces: tuple[Spec, ...]

    @property
    def velocity_dependent(self) -> bool:
        return self.friction > 0

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """All times for which accelerations are known, the initial one included."""
        known = np.isfinite(self.initial.accelerations).all()
        return ((self.initial,) if known else ()) + self.solution

    def force(self, x: Array, v: Array) -> Array:
        """Applied forces, without the thermostat, shape (n_atoms, 3)."""
        shifted = x + 1e-30j * np.eye(x.size).reshape(x.size, *x.shape)
        slopes = self._potential(shifted).imag.reshape(x.shape) / 1e-30
        return -slopes - self.friction * self.masses[:, None] * v

    def potential(self, x: Array) -> float:
        return float(self._potential(x))

    def _potential(self, x: Array) -> Array:
        nothing = np.zeros(x.shape[:-2], x.dtype)
        return sum((POTENTIALS[spec["type"]](x, spec, self.masses) for spec in self._forces), nothing)

    def energy(self, x: Array, v: Array) -> float:
        return self.potential(x) + 0.5 * float(np.sum(self.masses[:, None] * v**2))


@cache
def load(name: str) -> Case:
    """Read one case by its name, for example 'A01_sphere_free'."""
    data = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    assert data["schema"] == "kcons-ref-1" and data["kind"] == "mechanics"
    masses = np.array(data["masses"], dtype=np.float64)
    forces = [spec for spec in data["forces"] if spec["type"] != "friction"]
    case = Case(
        name=name,
        constraints=tuple(constraint for spec in data["constraints"] for constraint in CONSTRAINTS[spec["type"]](spec)),
        masses=masses,
        initial=_initial(data),
        solution=(),
        isokinetic=bool(data["isokinetic"]),
        friction=sum(spec["gamma"] for spec in data["forces"] if spec["type"] == "friction"),
        _forces=tuple(forces),
    )
    solution = [_snapshot(data, k, masses, case.force) for k in range(len(data["times"]))]
    return replace(case, solution=tuple(sorted(solution, key=lambda s: s.time)))


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


def _snapshot(data: Spec, k: int, masses: Array, force: Callable[[Array, Array], Array]) -> Snapshot:
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


def _ellipse_xz(spec: Spec) -> list[held.Constraint]:
    return [held.Formula("(x1/a)**2 + (z1/b)**2 - 1", spec["atom"], {"a": spec["a"], "b": spec["b"]})]


def _rotating_plane(spec: Spec) -> list[held.Constraint]:
    return [held.Formula("y1*cos(w*t) - x1*sin(w*t)", spec["atom"], {"w": spec["omega"]})]


def _rotating_ellipse(spec: Spec) -> list[held.Constraint]:
    """The plane, and an ellipse that turns with it."""
    numbers = {"w": spec["omega"], "a": spec["a"], "b": spec["b"]}
    ellipse = "((x1*cos(w*t) + y1*sin(w*t))/a)**2 + (z1/b)**2 - 1"
    return [*_rotating_plane(spec), held.Formula(ellipse, spec["atom"], numbers)]


CONSTRAINTS: dict[str, Callable[[Spec], list[held.Constraint]]] = {
    "distance": lambda spec: [held.Distance(spec["atoms"], spec["target"])],
    "distance_to_point": lambda spec: [held.Sphere(spec["atom"], spec["point"], spec["target"])],
    "angle_cos": lambda spec: [held.Angle(spec["atoms"], spec["angle_rad"])],
    "plane": lambda spec: [held.Plane(spec["atom"], spec["normal"], spec["target"])],
    "ellipse_xz": _ellipse_xz,
    "torus": lambda spec: [held.Torus(spec["atom"], np.zeros(3), [0.0, 0.0, 1.0], spec["R"], spec["r"])],
    "rotating_plane": _rotating_plane,
    "rotating_ellipse": _rotating_ellipse,
    "linear_vector": lambda spec: [held.LinearRelation(spec["atoms"][0], spec["atoms"][1:], spec["weights"])],
}


# -- potentials, which must be analytic: forces are steps of positions into the complex plane -----------


def _lengths(x: Array, pairs: Any) -> Array:
    first, second = np.array(pairs).T
    return np.sqrt(np.sum((x[..., first, :] - x[..., second, :]) ** 2, axis=-1))


def _uniform(x: Array, forces: Any) -> Array:
    return -np.sum(forces * x, axis=(-1, -2))


def _quartic_site(x: Array, spec: Spec, masses: Array) -> Array:
    r = x[..., spec["atom"], :]
    return 0.25 * r**4 @ np.array(spec["k4"]) + 0.5 * spec["kxy"] * r[..., 0] ** 2 * r[..., 1] ** 2


def _lj(x: Array, spec: Spec, masses: Array) -> Array:
    s6 = (spec["sigma"] / _lengths(x, spec["pairs"])) ** 6
    return np.sum(4 * spec["epsilon"] * (s6 * s6 - s6), axis=-1)


def _torsion_cos3(x: Array, spec: Spec, masses: Array) -> Array:
    i, j, k, l = (x[..., atom, :] for atom in spec["atoms"])
    a, b = np.cross(i - j, j - k), np.cross(l - k, j - k)
    cosine = np.sum(a * b, axis=-1) / np.sqrt(np.sum(a * a, axis=-1) * np.sum(b * b, axis=-1))
    return spec["k"] * (1 + 4 * cosine**3 - 3 * cosine)


POTENTIALS: dict[str, Callable[[Array, Spec, Array], Array]] = {
    "uniform_acceleration": lambda x, spec, masses: _uniform(x, masses[:, None] * spec["g"]),
    "uniform_force": lambda x, spec, masses: _uniform(x[..., [spec["atom"]], :], spec["F"]),
    "uniform_field": lambda x, spec, masses: _uniform(x, np.outer(spec["charges"], spec["E"])),
    "harmonic_site": lambda x, spec, masses: (
        0.5 * (x[..., spec["atom"], :] - spec.get("center", np.zeros(3))) ** 2 @ np.array(spec["k"])
    ),
    "quartic_site": _quartic_site,
    "harmonic_bond": lambda x, spec, masses: 0.5 * spec["k"] * (_lengths(x, [spec["atoms"]])[..., 0] - spec["r0"]) ** 2,
    "lj": _lj,
    "torsion_cos3": _torsion_cos3,
}
