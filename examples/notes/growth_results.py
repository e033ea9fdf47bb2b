"""Measurements behind docs/growth.md: random systems, work against precision, and where the plain equation fails.

python examples/notes/growth_results.py               some seconds
python examples/notes/growth_results.py --full        the numbers of the page
"""

import argparse
from time import process_time

import numpy as np
from scipy.integrate import solve_ivp

from kcons.models.growth import Hypercycle, Populations, solve

START, TAU = np.array([0.6, 0.1, 0.1, 0.1, 0.1]), 30.0


def random_system(rng, n, kind):
    """A hypercycle with parameters over decades, held in one way, and a start down to ln x = -700."""
    k_h, kT = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-1, 1)
    model = Hypercycle(n, k_h, rng.normal(size=n) * kT * 10 ** rng.uniform(-1, 0.5), kT)
    tau, total = 10 ** rng.uniform(-1, 2) / k_h, 10 ** rng.uniform(-0.5, 0.5)
    log_x = [np.log(rng.dirichlet(np.ones(n))), rng.uniform(-5, 0, n), rng.uniform(-700, 0, n)][rng.integers(3)]
    held = {
        "a": model.with_fixed_total,
        "b": lambda: model.with_entropy_production(tau),
        "c": model.without_entropy_production,
    }[kind]()
    return held, log_x + np.log(total) - np.log(np.sum(np.exp(log_x)))


def random_systems(count, seed=1):
    """How many of `count` systems a number of species and a kind run to t = 10/k_h, and what is left of rows there."""
    print("species  kind  systems  at the end  least ln x  largest residual  CPU s")
    for n in (2, 3, 4, 5, 6, 8):
        for kind in "abc":
            rng, begin, ended, least, worst = np.random.default_rng([seed, n, ord(kind)]), process_time(), 0, 0.0, 0.0
            for _ in range(count):
                held, log_x = random_system(rng, n, kind)
                found = solve(held, (0, 10 / held.model.k_h), np.exp(log_x), rtol=1e-6, atol=1e-8)
                ended += found.success and bool(np.all(np.isfinite(found.log_y)))
                end = Populations.from_logarithms(found.t[-1], found.log_y[:, -1])
                least, worst = min(least, found.log_y.min()), max(worst, abs(found.system.residuals(end)).max())
            seconds = process_time() - begin
            print(f"{n:7} {kind:>5} {count:8} {ended:11} {least:11.1e} {worst:17.1e} {seconds:6.0f}", flush=True)


def by_hand(model, budget):
    """dx/dt with the multipliers of (153) put in by hand, b as a function of time: what one would give to SciPy."""

    def velocity(t, x):
        mu = model.mixture.mu0 + np.log(x / x.sum())
        total, M1, M2 = x.sum(), x @ mu, x @ mu**2
        rates = model.k_h * np.roll(x, -1)
        eta0, eta1 = x @ rates, -budget / TAU * np.exp(-t / TAU) - (x * rates) @ mu
        return x * (rates + ((total * eta1 + eta0 * M1) * mu - (eta1 * M1 + eta0 * M2)) / (total * M2 - M1**2))

    return velocity


def work_precision(name, start, end, tolerances):
    """Evaluations and errors of kcons and of SciPy's methods, figure 11 (b)."""
    model = Hypercycle()
    system = model.with_entropy_production(TAU)
    exact = solve(system, (0, end), start, rtol=1e-11, atol=1e-12).log_y[:, -1]
    budget = float(model.mixture.excess(Populations.from_values(0.0, start), 1.0))
    velocity = by_hand(model, budget)
    print(f"{name}\n  method            rtol   evaluations  CPU s     error   |sum x - 1|  g - g_eq off by")
    for rtol in tolerances:
        for method in ("kcons DOP853", "kcons Radau", "SciPy DOP853", "SciPy Radau", "SciPy LSODA"):
            begin, (owner, solver) = process_time(), method.split()

            def patient(t, x, begin=begin):
                if process_time() - begin > 10.0:
                    raise TimeoutError
                return velocity(t, x)

            try:
                with np.errstate(all="ignore"):
                    if owner == "kcons":
                        found = solve(system, (0, end), start, solver, rtol=rtol, atol=rtol)
                    else:
                        found = solve_ivp(patient, (0, end), start, solver, rtol=rtol, atol=1e-3 * rtol)
                    log_x = found.log_y[:, -1] if owner == "kcons" else np.log(found.y[:, -1])
            except (TimeoutError, ValueError):  # Radau: NaN in its matrix
                found = None
            line = f"  {method:14} {rtol:8.0e}"
            if found is None or found.t[-1] != end or not np.all(np.isfinite(log_x)):
                print(line, "  does not arrive")
                continue
            excess = float(model.mixture.excess(Populations.from_logarithms(end, log_x), 1.0))
            off, law = abs(np.expm1(log_x - exact)).max(), budget * np.exp(-end / TAU)
            print(
                f"{line} {found.nfev:12,} {process_time() - begin:6.2f} {off:10.1e} "
                f"{abs(np.exp(log_x).sum() - 1):12.1e} {abs(excess / law - 1):14.1e}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the sample sizes of docs/growth.md")
    full = parser.parse_args().full
    random_systems(100 if full else 2)
    if full:
        work_precision("to t = 100", START, 100.0, (1e-4, 1e-6, 1e-8, 1e-10))
        work_precision("to equilibrium, t = 900", START, 900.0, (1e-8,))
        work_precision("near extinction, t = 10", np.array([0.9, 0.04, 0.03, 0.02, 0.01]), 10.0, (1e-8,))
    else:
        work_precision("to t = 5", START, 5.0, (1e-6,))
