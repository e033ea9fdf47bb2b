"""The ensembles of `kcons.openmm` that every System can have: a new one is a row here, and these tests run it.

A temperature (K) and a rate (1/ps) make one; `momentum` goes to those that count momenta.
"""

from __future__ import annotations

from kcons.openmm import Isokinetic, Langevin, NoseHoover, NoseHooverMiddle

ENSEMBLES = {
    "Langevin": lambda kelvin, rate=5.0, momentum="auto": Langevin(kelvin, rate),
    "Isokinetic": lambda kelvin, rate=5.0, momentum="auto": Isokinetic(kelvin, momentum=momentum),
    "NoseHoover": lambda kelvin, rate=5.0, momentum="auto": NoseHoover(kelvin, rate, momentum=momentum),
    "NoseHooverMiddle": lambda kelvin, rate=5.0, momentum="auto": NoseHooverMiddle(kelvin, rate, momentum=momentum),
}
