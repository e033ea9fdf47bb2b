"""Built-in scenes: systems with known solutions, small or at size N."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from kcons.errors import InputError
from kcons.scenes.scene import Reference, Scene, Units

__all__ = ["SCENES", "Entry", "Reference", "Scene", "Units", "build"]


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
}


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
