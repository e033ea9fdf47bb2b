"""The temperature of a barostat beside a thermostat, which OpenMM keeps apart."""

from __future__ import annotations

import warnings

import openmm

from kcons.openmm.integrator.system_checks import BAROSTATS, forces_of

#: Relative difference of two temperatures that is taken for rounding.
_ROUNDING = 1e-6


def warn_of_barostat(context: openmm.Context, temperature: float | None, stacklevel: int) -> None:
    """Say so where a barostat judges its trials by another temperature (K) than the thermostat keeps.

    Parameters
    ----------
    context : openmm.Context
    temperature : float or None
        Of the thermostat; None where it has none.
    stacklevel : int
    """
    if temperature is None:
        return
    for force in forces_of(context.getSystem()):
        if type(force).__name__ not in BAROSTATS:
            continue
        name = type(force).Temperature()
        found = float(context.getParameter(name))
        if abs(found - temperature) > _ROUNDING * temperature:
            warnings.warn(
                f"the {type(force).__name__} has a temperature of {found:g} K, and the integrator one of "
                f"{temperature:g} K: volumes belong to neither. Call context.setParameter({name!r}, {temperature:g})",
                stacklevel=stacklevel,
            )
