"""Ideal mixtures to forty digits, from ln x."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np


def exact_energies(mu0: np.ndarray, kT: float, log_x: np.ndarray) -> tuple[Decimal, Decimal, Decimal]:
    """The sum of x, its Gibbs energy, and the least Gibbs energy of a mixture whose sum is 1."""
    with localcontext() as context:
        context.prec = 40
        T, levels = Decimal(float(kT)), [Decimal(float(level)) for level in mu0]
        y = [Decimal(float(value)) for value in log_x]
        x = [value.exp() for value in y]
        total = sum(x, Decimal(0))
        energy = sum((a * (level + T * (b - total.ln())) for a, b, level in zip(x, y, levels, strict=True)), Decimal(0))
        return total, energy, -T * sum(((-level / T).exp() for level in levels), Decimal(0)).ln()
