"""Samplers of windows that need no MD engine, for tests of what runs them; other processes import them from here."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kcons.free_energy import Sample, Series

NONE = np.full(1, np.nan)  # no torsion that could be turned
KT = 2.4943387854459713  # kJ/mol at 300 K


def slope(q):
    """dF/dq of F = 3 cos 2q + 2 cos q."""
    return -6 * np.sin(2 * q) - 2 * np.sin(q)


@dataclass
class Fake:
    """Multipliers of a torsion with noise; notes in `diary` that a window was begun.

    `fails` lists windows that raise, `kills` those whose process is killed the first time. `hot` is by how much
    velocities make the multipliers of pulls too large.
    """

    diary: str
    fails: tuple[str, ...] = ()
    kills: tuple[str, ...] = ()
    wait: float = 0.0
    noise: float = 2.0
    shift: float = 0.0
    hot: float = 0.0
    names: tuple[str, ...] = ("torsion",)
    digest: str = "one system"
    angles: tuple[bool, ...] = (True,)
    kJ: float = 1.0
    scales: np.ndarray = field(default_factory=lambda: np.ones(1))
    start: np.ndarray = field(default_factory=lambda: np.zeros(1))
    periods: np.ndarray = field(default_factory=lambda: np.full(1, 2 * np.pi))

    def sample(self, window, settings, file):
        with Path(self.diary).open("a") as diary:
            diary.write(f"{window.name}\n")
        if window.name in self.kills and Path(self.diary).read_text().count(window.name) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        if window.name in self.fails:
            raise RuntimeError("the calculator did not converge")
        time.sleep(self.wait)
        rng = np.random.default_rng(window.seed)
        series = Series(self.names, 2 * np.pi)
        (q,) = window.target
        apart = self.shift if window.side == "up" else -self.shift
        for k in range(settings.production // settings.every):
            force = slope(q) + apart + self.noise * rng.normal()
            at, zero = np.array([q]), np.zeros(1)
            series.append(Sample(float(k), at, np.array([force]), zero, 0.0, zero, 0.0, NONE, NONE))
        series.save(file)

    def pull(self, window, settings, file):
        """Normal works that fulfil Crooks' theorem, 4 kJ/mol up; Z is four times as large at the upper end."""
        with Path(self.diary).open("a") as diary:
            diary.write(f"{window.name}\n")
        if window.name in self.fails:
            raise RuntimeError("the calculator did not converge")
        up = window.target[0] > window.start[0]
        work = np.random.default_rng(window.seed).normal((4.0 if up else -4.0) + 4 / (2 * KT), 2.0)
        series = Series(self.names)
        for q in (window.start[0], window.target[0]):
            force, log_z = work / self.kJ / (window.target[0] - window.start[0]), np.log(4.0) if q > 0 else 0.0
            at, force, kinetic, mean = np.array([[q], [force + self.hot], [1.0 + self.hot], [self.kJ / KT]])
            series.append(Sample(q, at, force, kinetic, log_z, np.zeros(1), 0.0, NONE, mean))
        series.save(file)
