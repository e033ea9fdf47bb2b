"""Andrews' squeezing mechanism: seven bodies, stated as it is published, and solved.

    python examples/27_squeezer.py             a few seconds
    python examples/27_squeezer.py --compare   processor times beside SciPy's integrators alone, half a minute

Coordinates are seven angles; constraints close three loops. Constants and the solution at 0.03 s are those of Mazzia
and Magherini, Test Set for Initial Value Problem Solvers, release 2.4 (2008); see also Hairer and Wanner, Solving
Ordinary Differential Equations II, VII.7. Lengths in m, times in s, angles in rad.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from kcons.models import Multibody

M1, M2, M3, M4, M5, M6, M7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
I1, I2, I3, I4, I5, I6, I7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
XA, YA, XB, YB, XC, YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
D, DA, E, EA, RR, RA, L0, C0, MOM = 28e-3, 115e-4, 2e-2, 1421e-5, 7e-3, 92e-5, 7785e-5, 4530.0, 0.033
SS, SA, SB, SC, SD, TA, TB, U, UA, UB = 35e-3, 1874e-5, 1043e-5, 18e-3, 2e-2, 2308e-5, 916e-5, 4e-2, 1228e-5, 449e-5
ZF, ZT, FA = 2e-2, 4e-2, 1421e-5

#: Angles beta, Theta, gamma, Phi, delta, Omega, epsilon at the start, which is at rest.
START = np.array(
    [
        -0.0617138900142764496358948458001,
        0.0,
        0.455279819163070380255912382449,
        0.222668390165885884674473185609,
        0.487364979543842550225598953530,
        -0.222668390165885884674473185609,
        1.23054744454982119249735015568,
    ]
)
END = 0.03
#: As published for END: angles, velocities, and multipliers, whose sign is that of M q'' = f - G^T lambda.
ANGLES = np.array(
    [
        0.1581077119629904e2,
        -0.1575637105984298e2,
        0.4082224013073101e-1,
        -0.5347301163226948,
        0.5244099658805304,
        0.5347301163226948,
        0.1048080741042263e1,
    ]
)
VELOCITIES = np.array(
    [
        0.1139920302151208e4,
        -0.1424379294994111e4,
        0.1103291221937134e2,
        0.1929337464421385e2,
        0.5735699284790808,
        -0.1929337464421385e2,
        0.3231791658026955,
    ]
)
MULTIPLIERS = np.array(
    [
        0.1991753333731910e3,
        -0.2975531228015052e2,
        0.2306654119098399e2,
        0.3145271365475927e2,
        0.2264249232082739e2,
        0.1161740700019673e2,
    ]
)


def mass(q):
    _, theta, _, phi, _, omega, _ = q
    M = np.zeros((7, 7))
    a, b = E - EA, ZF - FA
    M[0, 0] = M1 * RA**2 + M2 * (RR**2 - 2 * DA * RR * np.cos(theta) + DA**2) + I1 + I2
    M[1, 0] = M[0, 1] = M2 * (DA**2 - DA * RR * np.cos(theta)) + I2
    M[1, 1] = M2 * DA**2 + I2
    M[2, 2] = M3 * (SA**2 + SB**2) + I3
    M[3, 3] = M4 * a**2 + I4
    M[4, 3] = M[3, 4] = M4 * (a**2 + ZT * a * np.sin(phi)) + I4
    M[4, 4] = M4 * (ZT**2 + 2 * ZT * a * np.sin(phi) + a**2) + M5 * (TA**2 + TB**2) + I4 + I5
    M[5, 5] = M6 * b**2 + I6
    M[6, 5] = M[5, 6] = M6 * (b**2 - U * b * np.sin(omega)) + I6
    M[6, 6] = M6 * (b**2 - 2 * U * b * np.sin(omega) + U**2) + M7 * (UA**2 + UB**2) + I6 + I7
    return M


def force(q, v, t):
    _, theta, gamma, phi, _, omega, _ = q
    beta_, theta_, _, phi_, delta_, omega_, epsilon_ = v
    s, c = np.sin(gamma), np.cos(gamma)
    x, y = SD * c + SC * s + XB - XC, SD * s - SC * c + YB - YC
    length = np.hypot(x, y)
    pull = -C0 * (length - L0) / length
    a, b = M4 * ZT * (E - EA) * np.cos(phi), M6 * U * (ZF - FA) * np.cos(omega)
    turn = M2 * DA * RR * np.sin(theta)
    return np.array(
        [
            MOM - turn * theta_ * (theta_ + 2 * beta_),
            turn * beta_**2,
            pull * (x * (SC * c - SD * s) + y * (SD * c + SC * s)),
            a * delta_**2,
            -a * phi_ * (phi_ + 2 * delta_),
            -b * epsilon_**2,
            b * omega_ * (omega_ + 2 * epsilon_),
        ]
    )


def loops(q):
    beta, theta, gamma, phi, delta, omega, epsilon = q
    x = RR * np.cos(beta) - D * np.cos(beta + theta)
    y = RR * np.sin(beta) - D * np.sin(beta + theta)
    return np.array(
        [
            x - SS * np.sin(gamma) - XB,
            y + SS * np.cos(gamma) - YB,
            x - E * np.sin(phi + delta) - ZT * np.cos(delta) - XA,
            y + E * np.cos(phi + delta) - ZT * np.sin(delta) - YA,
            x - ZF * np.cos(omega + epsilon) - U * np.sin(epsilon) - XA,
            y - ZF * np.sin(omega + epsilon) + U * np.cos(epsilon) - YA,
        ]
    )


def gradients(q):
    beta, theta, gamma, phi, delta, omega, epsilon = q
    G = np.zeros((6, 7))
    G[0::2, 1] = D * np.sin(beta + theta)
    G[1::2, 1] = -D * np.cos(beta + theta)
    G[0::2, 0] = G[0::2, 1] - RR * np.sin(beta)
    G[1::2, 0] = G[1::2, 1] + RR * np.cos(beta)
    G[:2, 2] = -SS * np.cos(gamma), -SS * np.sin(gamma)
    G[2:4, 3] = -E * np.cos(phi + delta), -E * np.sin(phi + delta)
    G[2:4, 4] = G[2:4, 3] + [ZT * np.sin(delta), -ZT * np.cos(delta)]
    G[4:, 5] = ZF * np.sin(omega + epsilon), -ZF * np.cos(omega + epsilon)
    G[4:, 6] = G[4:, 5] - [U * np.cos(epsilon), U * np.sin(epsilon)]
    return G


def bending(q, v):
    """v^T (d2g/dq2) v: each arm that turns by an angle gives minus itself, times the square of its rate."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    b, bt, g, pd, d, oe, e = np.array([v[0], v[0] + v[1], v[2], v[3] + v[4], v[4], v[5] + v[6], v[6]]) ** 2
    x = -RR * np.cos(beta) * b + D * np.cos(beta + theta) * bt
    y = -RR * np.sin(beta) * b + D * np.sin(beta + theta) * bt
    return np.array(
        [
            x + SS * np.sin(gamma) * g,
            y - SS * np.cos(gamma) * g,
            x + E * np.sin(phi + delta) * pd + ZT * np.cos(delta) * d,
            y - E * np.cos(phi + delta) * pd + ZT * np.sin(delta) * d,
            x + ZF * np.cos(omega + epsilon) * oe + U * np.sin(epsilon) * e,
            y + ZF * np.sin(omega + epsilon) * oe - U * np.cos(epsilon) * e,
        ]
    )


def squeezer() -> Multibody:
    return Multibody(mass, force, loops, gradients, curvature=bending)


def alone(method: str, rtol: float) -> tuple[np.ndarray, int]:
    """The angles at END by SciPy alone, on the equations of index 1, and evaluations."""

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:7], y[7:]
        G = gradients(q)
        K = np.block([[mass(q), G.T], [G, np.zeros((6, 6))]])
        return np.concatenate([v, np.linalg.solve(K, np.concatenate([force(q, v, t), -bending(q, v)]))[:7]])

    found = solve_ivp(slope, (0.0, END), np.concatenate([START, np.zeros(7)]), method, rtol=rtol, atol=1e-2 * rtol)
    return found.y[:7, -1], found.nfev


def by_kcons(method: str, rtol: float) -> tuple[np.ndarray, int]:
    found = squeezer().solve(START, np.zeros(7), (0.0, END), method=method, rtol=rtol, atol=1e-2 * rtol)
    return found.q[-1], found.evaluations


def relative(q: np.ndarray) -> float:
    return float(np.max(np.abs(q / ANGLES - 1)))


def compare(rounds: int = 5) -> None:
    """Errors, evaluations and processor times, taken in turn in one process; medians."""
    ways: dict[str, Callable[[str, float], tuple[np.ndarray, int]]] = {"kcons": by_kcons, "SciPy alone": alone}
    print(f"{'':26}{'rtol':>8}{'error':>10}{'|g|':>10}{'evaluations':>13}{'ms':>8}")
    for method, tolerances in (("DOP853", (1e-6, 1e-9, 1e-12)), ("Radau", (1e-6,))):
        for rtol in tolerances:
            times: dict[str, list[float]] = {name: [] for name in ways}
            for _ in range(rounds if method == "DOP853" else 1):
                for name, way in ways.items():
                    begin = time.process_time()
                    way(method, rtol)
                    times[name].append(time.process_time() - begin)
            for name, way in ways.items():
                q, evaluations = way(method, rtol)
                row = f"{name + ', ' + method:26}{rtol:8.0e}{relative(q):10.1e}{np.abs(loops(q)).max():10.1e}"
                print(f"{row}{evaluations:13,}{1e3 * float(np.median(times[name])):8.0f}")


def main() -> None:
    if "--compare" in sys.argv[1:]:
        compare()
        return
    body = squeezer()
    found = body.solve(START, np.zeros(7), (0.0, END))
    g, slip = np.abs([body.residuals(q, v) for q, v in zip(found.q, found.v, strict=True)]).max(axis=(0, 2))
    print(f"{found.steps} steps, {found.evaluations} evaluations, {body.degrees_of_freedom(START)} degree of freedom")
    print(f"at each step |g| <= {g:.1e} m, |g'| <= {slip:.1e} m/s")
    print(f"off the published solution at {END} s, relative:")
    print(f"  angles      {relative(found.q[-1]):.1e}")
    print(f"  velocities  {np.max(np.abs(found.v[-1] / VELOCITIES - 1)):.1e}")
    print(f"  multipliers {np.max(np.abs(-found.multipliers[-1] / MULTIPLIERS - 1)):.1e}")


if __name__ == "__main__":
    main()
