"""Built-in scenes: systems with known solutions, small or at size N."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from kcons.errors import InputError
from kcons.scenes.scene import Reference, Scene, Units

if TYPE_CHECKING:
    from kcons.scenes.fluid import Fluid

__all__ = ["FLUIDS", "SCENES", "Entry", "Reference", "Scene", "Units", "build", "build_fluid"]


@dataclass(frozen=True)
class Entry:
    """One line of `kcons compare --list`."""

    module: str
    text: str
    size: int
    quick_size: int
    unit: str
    options: Mapping[str, Any] = field(default_factory=dict)


SCENES: Mapping[str, Entry] = {
    "water": Entry("water", "box of rigid TIP3P water, PME forces", 64, 8, "molecules"),
    "chain": Entry("chain", "zigzag chain, all bonds held", 100, 20, "bonds"),
    "chain-straight": Entry("chain", "straight chain", 100, 20, "bonds", {"shape": "straight"}),
    "chain-175": Entry("chain", "nearly straight chain, 175°", 100, 20, "bonds", {"shape": "175"}),
    "chain-free": Entry("chain", "freely jointed chain", 100, 20, "bonds", {"shape": "free"}),
    "sphere": Entry("sphere", "free particles on spheres; closed form", 10, 2, "particles"),
    "sphere-pendulum": Entry("sphere", "spherical pendulums", 10, 2, "particles", {"gravity": 1.0}),
    "ethanol": Entry("molecule", "ethanol, all bonds and angles, GFN2-xTB forces", 1, 1, "molecule"),
    "butane": Entry("butane", "four-atom chain, bonds and angles held, free torsion", 1, 1, "molecule"),
    "dumbbells": Entry("dumbbells", "collision of two rigid dumbbells; a periodic box from 8 on", 2, 2, "dumbbells"),
    "rotor": Entry("rotor", "asymmetric top of 4 atoms; Euler's equations", 1, 1, "body"),
    "tennis-racket": Entry("rotor", "the same, about its middle axis", 1, 1, "body", {"start": "tennis-racket"}),
    "pendulum": Entry("pendulums", "planar pendulum from 179.9°; closed form", 1, 1, "pendulum"),
    "double-pendulum": Entry("pendulums", "planar double pendulum", 1, 1, "pendulum", {"kind": "double-pendulum"}),
    "triple-pendulum": Entry("pendulums", "planar triple pendulum", 1, 1, "pendulum", {"kind": "triple-pendulum"}),
    "bead-ellipse": Entry("bead", "bead on a vertical ellipse", 1, 1, "bead"),
    "bead-rotating": Entry(
        "bead", "the same while the ellipse turns: a constraint that moves", 1, 1, "bead", {"on": "rotating-ellipse"}
    ),
    "bead-torus": Entry("bead", "free bead on a torus", 1, 1, "bead", {"on": "torus"}),
    "slab": Entry("slab", "rigid CO on Cu(111), lower layers fixed, EMT forces", 1, 1, "molecules"),
}

#: Where averages are compared instead of trajectories.
FLUIDS: Mapping[str, Entry] = {
    "thermostat": Entry("fluid", "Lennard-Jones atoms at a temperature", 32, 16, "atoms"),
    "thermostat-dumbbells": Entry(
        "fluid", "rigid dumbbells at a temperature", 16, 8, "dumbbells", {"kind": "dumbbells"}
    ),
    "thermostat-water": Entry("fluid", "rigid TIP3P water at 400 K", 27, 27, "molecules", {"kind": "water"}),
}


def build_fluid(name: str, size: int | None = None, seed: int = 1, *, quick: bool = False) -> Fluid:
    """The fluid called `name`.

    Parameters
    ----------
    name : str
        A key of `FLUIDS`.
    size : int, optional
        Number of molecules.
    seed : int
        Of the orientations on the lattice.
    quick : bool
        A smaller default size.

    Raises
    ------
    InputError
        Unknown name; a size the fluid cannot be built at.
    """
    if name not in FLUIDS:
        raise InputError(f"there is no fluid {name!r}; there are {', '.join(FLUIDS)}", item="scene")
    entry = FLUIDS[name]
    if size is None:
        size = entry.quick_size if quick else entry.size
    fluid: Fluid = import_module(f"kcons.scenes.{entry.module}").build(size, seed, **entry.options)
    return fluid


def build(name: str, size: int | None = None, seed: int = 1, *, quick: bool = False, **options: Any) -> Scene:
    """The scene called `name`.

    Parameters
    ----------
    name : str
        A key of `SCENES`.
    size : int, optional
        Number of molecules, bonds or particles.
    seed : int
    quick : bool
        A smaller default size, half the horizon.
    **options
        What the scene's own `build` takes, for example ``forces='ase'`` for water.

    Raises
    ------
    InputError
        Unknown name; a size the scene cannot be built at.
    """
    try:
        entry = SCENES[name]
    except KeyError:
        raise InputError(f"there is no scene {name!r}; there are {', '.join(SCENES)}", item="scene") from None
    if size is None:
        size = entry.quick_size if quick else entry.size
    module = import_module(f"kcons.scenes.{entry.module}")
    scene: Scene = module.build(size, seed, **{**entry.options, **options})
    return scene.shortened(2) if quick else scene
