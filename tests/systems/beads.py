"""A bead of mass m on a curve or a surface: a vertical ellipse, the same turning about the vertical, and a torus.

Solutions: the equation of motion of the angle along the ellipse, and of the two angles on the torus.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kcons.comparison import add_system
from kcons.comparison.test_systems.minimal import integrated
from kcons.comparison.test_systems.potential import Potential, uniform_field
from kcons.comparison.test_systems.system import BARE, Reference, TestSystem
from kcons.constraints import Ellipsoid, ImplicitSurface, Plane, Torus
from kcons.constraints.constraint import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

#: Semi-axes of the ellipse, across and along the vertical.
ACROSS, UP = 2.0, 1.0
#: Radii of the torus about the z axis.
MAJOR, MINOR = 2.0, 0.7
GRAVITY = 1.0
#: Angular velocity of the turning ellipse.
OMEGA = 1.1

NO_SURFACE = "ASE has no constraint that holds an atom on {}"
NO_TIME = "ASE tells constraints no time: they cannot move"


def build(size: int, seed: int, *, on: str) -> TestSystem:
    """One bead; its start is fixed."""
    if on == "torus":
        return _on_torus()
    return _on_ellipse(OMEGA if on == "rotating-ellipse" else 0.0)


def _on_ellipse(omega: float) -> TestSystem:
    mass, angle, rate = (1.0, 0.4, 0.2) if omega else (1.5, 1.0, 0.7)
    x = ellipse_place(angle, 0.0)
    v = np.array([[ACROSS * np.cos(angle) * rate, omega * x[0, 0], UP * np.sin(angle) * rate]])
    held: list[Constraint]
    if omega:
        # On the turning plane, the ellipse is where this resting body of revolution is cut.
        held = [_turning_plane(omega), Ellipsoid(0, np.zeros(3), [ACROSS, ACROSS, UP])]
        title = f"bead on an ellipse that turns about the vertical, a = {ACROSS:g}, b = {UP:g}, ω = {omega:g}, g = 1"
        refusals = dict.fromkeys(("ase-kcons", "ase-bonds", "ase-internals"), NO_TIME)
    else:
        held = [Plane(0, [0.0, 1.0, 0.0], 0.0), Ellipsoid(0, np.zeros(3), [ACROSS, np.inf, UP])]
        title = f"bead on a vertical ellipse, a = {ACROSS:g}, b = {UP:g}, g = 1"
        refusals = dict.fromkeys(("ase-bonds", "ase-internals"), NO_SURFACE.format("an ellipse"))
    return TestSystem(
        name="bead-rotating" if omega else "bead-ellipse",
        title=title,
        constraint_set=ConstraintSet(held, x, [mass]),
        positions=x,
        velocities=v,
        potential=Potential(uniform_field(np.array([mass]), GRAVITY), "uniform field"),
        refusals=refusals,
        solution=lambda time: along_ellipse(angle, rate, omega, time),
        **_COMMON,
    )


def ellipse_place(angle: float, turn: float) -> FloatArray:
    """The point at `angle` from the bottom, the plane of the ellipse turned by `turn`; shape (1, 3)."""
    across = ACROSS * np.sin(angle)
    return np.array([[across * np.cos(turn), across * np.sin(turn), -UP * np.cos(angle)]])


def along_ellipse(angle: float, rate: float, omega: float, time: float) -> Reference:
    """(a^2 cos^2 s + b^2 sin^2 s) s'' + (b^2 - a^2) sin s cos s s'^2 = omega^2 a^2 sin s cos s - g b sin s."""

    def change(_: float, y: FloatArray) -> FloatArray:
        s, c = np.sin(y[0]), np.cos(y[0])
        push = (omega**2 * ACROSS**2 - (UP**2 - ACROSS**2) * y[1] ** 2) * s * c - GRAVITY * UP * s
        return np.array([y[1], push / (ACROSS**2 * c**2 + UP**2 * s**2)])

    def place(y: FloatArray) -> FloatArray:
        return ellipse_place(y[0], omega * time)

    return integrated(change, [angle, rate], time, place, "Lagrange's equation of the angle")


def _turning_plane(omega: float) -> ImplicitSurface:
    """x . n = 0 with n = (-sin wt, cos wt, 0); n' = -w e with e = (cos wt, sin wt, 0), n'' = -w^2 n."""

    def normal(t: float) -> FloatArray:
        return np.array([-np.sin(omega * t), np.cos(omega * t), 0.0])

    def along(t: float) -> FloatArray:
        return np.array([np.cos(omega * t), np.sin(omega * t), 0.0])

    return ImplicitSurface(
        0,
        lambda x, t: x @ normal(t),
        lambda x, t: np.broadcast_to(normal(t), x.shape),
        lambda x, v, t: np.zeros_like(x),
        time_dependent=True,
        time_derivatives=lambda x, v, t: (
            -omega * x @ along(t),
            -2.0 * omega * v @ along(t) - omega**2 * x @ normal(t),
        ),
    )


def _on_torus() -> TestSystem:
    turn, angle = 0.6, 0.5
    x = torus_place(0.0, angle)
    v = np.array([[-MINOR * np.sin(angle), x[0, 0] * turn, MINOR * np.cos(angle)]])
    return TestSystem(
        name="bead-torus",
        title=f"free bead on a torus, R = {MAJOR:g}, r = {MINOR:g}",
        constraint_set=ConstraintSet(Torus(0, np.zeros(3), [0.0, 0.0, 1.0], MAJOR, MINOR), x, [1.0]),
        positions=x,
        velocities=v,
        potential=Potential(lambda x: (0.0, np.zeros_like(x)), "no forces"),
        refusals=dict.fromkeys(("ase-bonds", "ase-internals"), NO_SURFACE.format("a torus")),
        solution=lambda time: along_torus(angle, 1.0, turn, time),
        **_COMMON,
    )


def torus_place(around: float, angle: float) -> FloatArray:
    """The point at `around` the axis and `angle` around the tube, from its outermost circle; shape (1, 3)."""
    rho = MAJOR + MINOR * np.cos(angle)
    return np.array([[rho * np.cos(around), rho * np.sin(around), MINOR * np.sin(angle)]])


def along_torus(angle: float, rate: float, turn: float, time: float) -> Reference:
    """Geodesic: rho^2 phi' is constant (Clairaut), r theta'' = -rho sin(theta) phi'^2, rho = R + r cos(theta)."""
    momentum = (MAJOR + MINOR * np.cos(angle)) ** 2 * turn

    def change(_: float, y: FloatArray) -> FloatArray:
        rho = MAJOR + MINOR * np.cos(y[1])
        return np.array([momentum / rho**2, y[2], -(momentum**2) * np.sin(y[1]) / (MINOR * rho**3)])

    return integrated(
        change, [0.0, angle, rate], time, lambda y: torus_place(y[0], y[1]), "equations of the two angles"
    )


_COMMON: dict[str, Any] = dict(
    symbols=["X"],
    horizon=10.0,
    time_steps=(0.1, 0.05, 0.025, 0.0125),
    tolerances=(1e-3, 1e-6, 1e-9),
    units=BARE,
)

for _name, _on in (("bead-ellipse", "ellipse"), ("bead-rotating", "rotating-ellipse"), ("bead-torus", "torus")):
    add_system(_name, build, f"a bead on a curve or surface: {_on}", unit="bead", only=True, on=_on)
