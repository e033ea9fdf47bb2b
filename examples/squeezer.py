"""Andrews' squeezing mechanism: seven bodies in a plane, whose seven angles close three loops.

Run with ``python examples/squeezer.py``. The data are from Mazzia and Magherini, Test Set for Initial Value Problem
Solvers, release 2.4 (2008), in m, kg and s. Places are complex numbers, x + iy; arms lead there one after another."""

import numpy as np

from kcons.models import Multibody

beta, theta, gamma, phi, delta, omega, epsilon = np.eye(7)
fixed = np.zeros(7)
A, B, C = (-0.06934 - 0.00227j, fixed), (-0.03635 + 0.03273j, fixed), 0.014 + 0.072j  # points that do not move
joint = [(0.007, beta), (-0.028, beta + theta)]  # crank and rod: each an arm, and the angle that turns it
ways = [  # three other ways to the same joint
    [B, (-0.035j, gamma)],
    [A, (0.04, delta), (-0.02j, phi + delta)],
    [A, (-0.04j, epsilon), (0.02, omega + epsilon)],
]
bodies = [  # mass, moment of inertia, the angle that turns the body, arms to its center of mass
    (0.04325, 2.194e-6, beta, [(0.00092, beta)]),
    (0.00365, 4.410e-7, beta + theta, [(0.007, beta), (-0.0115, beta + theta)]),
    (0.02373, 5.255e-6, gamma, [B, (0.01043 - 0.01874j, gamma)]),
    (0.00706, 5.667e-7, phi + delta, [A, (0.04, delta), (-0.00579j, phi + delta)]),
    (0.07050, 1.169e-5, delta, [A, (0.02308 + 0.00916j, delta)]),
    (0.00706, 5.667e-7, omega + epsilon, [A, (-0.04j, epsilon), (0.00579, omega + epsilon)]),
    (0.05498, 1.912e-5, epsilon, [A, (-0.00449 - 0.01228j, epsilon)]),
]


def end(arms, q, v=fixed):
    """The place where arms end, its derivatives by the angles, and its acceleration where the rates v stay."""
    turns = np.array([angle for _, angle in arms])
    turned = np.array([arm for arm, _ in arms]) * np.exp(1j * turns @ q)
    return turned.sum(), 1j * turned @ turns, -turned @ (turns @ v) ** 2


def mass(q):
    moved = [(m, I, angle, end(arms, q)[1]) for m, I, angle, arms in bodies]
    return sum(m * np.outer(by, by.conj()).real + I * np.outer(angle, angle) for m, I, angle, by in moved)


def force(q, v, t):
    place, slope, _ = end([B, (0.02 - 0.018j, gamma)], q)  # from here a spring leads to C; a motor turns the crank
    pull = 4530 * (0.07785 / abs(place - C) - 1) * (place - C)
    moved = [(m, *end(arms, q, v)[1:]) for m, _, _, arms in bodies]
    return 0.033 * beta + (pull * slope.conj()).real - sum(m * (by.conj() * bent).real for m, by, bent in moved)


def gaps(q, v=fixed, which=0):  # of the three loops; which=1: their derivatives, which=2: their accelerations
    gap = np.array([end(joint, q, v)[which] - end(way, q, v)[which] for way in ways])
    return np.concatenate([gap.real, gap.imag])


body = Multibody(mass, force, gaps, lambda q: gaps(q, which=1), curvature=lambda q, v: gaps(q, v, 2))
q, v = body.project([-0.0617138901, 0, 0.4552798192, 0.2226683902, 0.4873649795, -0.2226683902, 1.2305474445], fixed)
found = body.solve(q, v, (0.0, 0.03), rtol=1e-9, atol=1e-11)
off = found.q[-1] - [15.81077120, -15.75637106, 0.0408222401, -0.5347301163, 0.5244099659, 0.5347301163, 1.0480807410]
print(f"{body.degrees_of_freedom(q)} degree of freedom; the crank turned by {found.q[-1, 0]:.3f} rad in 0.03 s")
print(f"off the published angles by {abs(off).max():.0e} rad, off the joint by {abs(gaps(found.q[-1])).max():.0e} m")
assert abs(off).max() < 1e-6 and abs(gaps(found.q[-1])).max() < 1e-15
