"""A check from files in one call: what `kcons check` does."""

from __future__ import annotations

import ctypes
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis.check.constraint_check import ConstraintCheck
from kcons.mdanalysis.check.files.file_precision import precision_of
from kcons.mdanalysis.check.files.target_file import TargetFile
from kcons.mdanalysis.check.result import CheckResult
from kcons.mdanalysis.loading import READ_ERRORS, format_of, load_trajectory, open_universe, quiet
from kcons.mdanalysis.topology import constraints_of
from kcons.topology.holding import Options


def check_trajectory(
    trajectory: str | Path,
    topology: str | Path,
    constrain: str | None = "hbonds",
    *,
    targets: str | Path = "first",
    frames: str | None = None,
    format: str | None = None,
    topology_format: str | None = None,
    workers: int = 1,
    backend: str | None = None,
    **options: Any,
) -> CheckResult:
    """How well a trajectory kept its constraints.

    Parameters
    ----------
    trajectory, topology : path
        Files that MDAnalysis reads.
    constrain
        What is held; see `kcons.mdanalysis.constraints_of`.
    targets : {'first', 'mean', 'topology'} or path
        'topology': the coordinates in the topology's file; else as for `ConstraintCheck`.
    frames : str, optional
        'A:B:STEP' as in a slice; all by default.
    format, topology_format : str, optional
        Formats of the files, as MDAnalysis names them; by default what their names tell.
    workers : int
        How many read at the same time.
    backend : {'threads', 'multiprocessing', 'dask'}, optional
        Where there are several workers; by default threads for DCD files and rows that are all lengths, else processes.
    **options
        What is held besides, such as select, rigid_water and rigid_residues, for `kcons.mdanalysis.constraints_of`;
        all others for `ConstraintCheck`.

    Raises
    ------
    InputError
        Files that cannot be read, selections that match nothing, unknown names, atom counts that differ.
    UnreadableError
        A trajectory of which nothing can be told: cut off, or not finite, in its first frame.
    """
    chosen: dict[str, Any] = _slice(frames)
    if workers < 1:
        raise InputError(f"{workers} workers; give 1 or more", item="workers")
    # Complain about the parameter file before anything long.
    file = None if str(targets) in ("first", "mean", "topology") else TargetFile(targets)
    names = (str(trajectory), str(topology))
    held = {name: options.pop(name) for name in Options.__annotations__ if name in options}
    text = None
    if str(targets) == "topology":
        universe = open_universe(topology, topology_format=topology_format)
        if not hasattr(universe, "trajectory"):
            raise InputError(
                f"{topology} has no coordinates to take lengths from; give --targets first, mean, or a TOML file",
                item="targets",
            )
        with quiet():
            reader = universe.trajectory
            precision = precision_of(topology, format_of(reader))
            options["target_error"] = precision.half_step(universe.atoms.positions)
        constraints, guessed = _rows(universe, constrain, held)
        load_trajectory(universe, trajectory, topology, format=format)
        given, text = "given", f"coordinates of {topology}"
    else:
        universe = open_universe(topology, trajectory, format=format, topology_format=topology_format)
        _go_to_first(universe, chosen.get("start"))
        constraints, guessed = _rows(universe, constrain, held)
        given = str(targets)
    check = ConstraintCheck(universe, constraints, targets=file or given, names=names, **options)
    if text is not None:
        check.asked.target_text = text
    if guessed:
        check.asked.remarks.append(
            f"{guessed} bonds were guessed from distances and covalent radii: {topology} does not have them; give a "
            "topology with bonds, such as PSF, PRMTOP or TPR"
        )
    loose = constraints.loose_hydrogens
    if len(loose):
        check.asked.gaps.append(
            f"no bond was found for {len(loose)} hydrogens, the first of which is "
            f"{constraints.topology.atom_name(int(loose[0]))}, so that rows are missing; give files with the cell, at "
            "whose faces molecules may be cut, or a topology with bonds"
        )
    # Sets are made anew at the first frame; this one need not stay in memory.
    del constraints
    give_back()
    parallel: dict[str, Any] = {"backend": backend, "n_workers": workers} if workers > 1 else {}
    with quiet():
        check.run(**chosen, **parallel)
    result = check.check
    # A report is drawn next, with libraries of its own.
    del check, universe
    give_back()
    return result


def _rows(universe: Any, constrain: str | None, held: dict[str, Any]) -> tuple[Any, int]:
    """Constraints, and how many bonds were guessed for them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*bonds were guessed", category=UserWarning)
        warnings.filterwarnings("ignore", message="no bond was guessed", category=UserWarning)  # a gap
        try:
            found = constraints_of(universe, constrain, **held)
        except InputError as error:
            if error.item == "positions" and not np.isfinite(universe.atoms.positions).all():
                reader = universe.trajectory
                raise UnreadableError(
                    f"{reader.filename}: {error}, in frame {reader.frame}, the first to be looked at; begin at a later "
                    "one (--frames A:), or write the file again",
                    item="trajectory",
                ) from None
            raise
    return found, found.bonds_guessed


def _go_to_first(universe: Any, start: int | None) -> None:
    """Bonds are looked for in the first frame that is looked at; one that is not there is for the check to refuse."""
    with quiet(), suppress(*READ_ERRORS):
        _ = universe.trajectory[start or 0]


def _slice(frames: str | None) -> dict[str, int | None]:
    if frames is None:
        return {}
    try:
        numbers = [int(word) if word.strip() else None for word in frames.split(":")]
    except ValueError:
        numbers = []
    if not 2 <= len(numbers) <= 3 or (len(numbers) == 3 and numbers[2] is not None and numbers[2] < 1):
        raise InputError(f"frames are {frames!r}; give them as A:B or A:B:STEP, such as 100::10", item="frames")
    return dict(zip(("start", "stop", "step"), numbers, strict=False))


def give_back() -> None:
    """Let the C library return freed pages; parsing a large topology and setting up leave tens of megabytes of them.

    Does nothing where the library is not glibc, whose heap shrinks by itself only at its end.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
