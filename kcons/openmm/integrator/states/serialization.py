"""Integrators in XML, and in CompoundIntegrators: they stay what they are.

On import, methods of OpenMM's `XmlSerializer` and `CompoundIntegrator` are wrapped. OpenMM writes the program of an
integrator of kcons as that of a CustomIntegrator, and knows no class. An attribute that OpenMM passes over says the
rest: so what reads the file with kcons imported gets the integrator back, and what reads it without, the bare program.
In a CompoundIntegrator, members that are written in Python are kept alive, and make their steps with all their checks.
"""

from __future__ import annotations

import json
import re
import weakref
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import openmm

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.ensemble import Ensemble, Value
from kcons.openmm.integrator.states.hearing import live, wrapped
from kcons.openmm.integrator.states.states_on_constraints import StatesOnConstraints

#: The attribute of a node <Integrator>.
_NAME = "kcons"
#: Members of CompoundIntegrators: OpenMM keeps what is compiled of them only.
_MEMBERS: weakref.WeakKeyDictionary[openmm.CompoundIntegrator, list[Any]] = weakref.WeakKeyDictionary()

read_plain: Callable[[str], openmm.Integrator] = openmm.XmlSerializer._deserializeIntegrator


# -- writing ----------------------------------------------------------------------------------------


def _notes(integrator: openmm.Integrator) -> list[dict[str, Any] | None]:
    """What is to be said of an integrator, then of its members, as their nodes stand in the file."""
    if isinstance(integrator, StatesOnConstraints):
        inner = integrator.getNumIntegrators() if isinstance(integrator, openmm.CompoundIntegrator) else 0
        return [integrator._note(), *[None] * inner]
    if not isinstance(integrator, openmm.CompoundIntegrator):
        return [None]
    members = [integrator.getIntegrator(k) for k in range(integrator.getNumIntegrators())]
    return [None, *(note for member in members for note in _notes(live(member) or member))]


def _write(original: Callable[..., str], integrator: openmm.Integrator) -> str:
    notes = iter(_notes(integrator))

    def add(node: re.Match[str]) -> str:
        note = next(notes)
        said = "" if note is None else f'{_NAME}="{escape(json.dumps(note), {chr(34): "&quot;"})}" '
        return node[0] + said

    return re.sub(r"<Integrator ", add, original(integrator))


def note_of(integrator: Any, **more: Any) -> dict[str, Any]:
    """What each integrator says: its class and what its program does not tell."""
    every = None if integrator.spare else integrator.check_every
    return {
        "class": type(integrator).__name__,
        "check_every": every,
        "tolerance": integrator.asked_tolerance,
        **more,
    }


def note_of_ensemble(ensemble: Ensemble) -> list[Any]:
    return [type(ensemble).__name__, dict(vars(ensemble))]


# -- reading ----------------------------------------------------------------------------------------


def note_in(text: str) -> dict[str, Any] | None:
    """What a file says of its integrator; None for those of others.

    Raises
    ------
    InputError
        It cannot be read, or has no class, tolerance or interval of checks.
    """
    found = ElementTree.fromstring(text).get(_NAME)
    if found is None:
        return None
    try:
        note = json.loads(found)
    except ValueError as error:
        raise damaged(f"cannot be read ({error})") from None
    if (
        not isinstance(note, dict)
        or not isinstance(note.get("class"), str)
        or not {"check_every", "tolerance"} <= {*note}
    ):
        raise damaged("lacks class, check_every or tolerance")
    return note


def damaged(words: str) -> InputError:
    """The error for what a file says of its integrator."""
    return InputError(
        f"what the file says of its integrator, the attribute {_NAME!r}, {words}; take a file that "
        "openmm.XmlSerializer has written, or make the integrator anew",
        item="integrator",
    )


def ensemble_in(note: dict[str, Any]) -> Ensemble:
    """The ensemble that a file names, made as by hand, so that its numbers are looked at.

    Raises
    ------
    InputError
        There is no such ensemble, or none of such numbers.
    """
    match note.get("ensemble"):
        case [str(name), dict(values)]:
            kind = _kind(Value, name)
        case _:
            raise damaged("names no ensemble")
    try:
        ensemble: Ensemble = kind.of(values)
    except (TypeError, KeyError) as error:
        raise damaged(f"has other values than {name} takes ({error})") from None
    return ensemble


def _kind(base: type, name: str) -> Any:
    kinds = [base]
    while kinds:
        kind = kinds.pop()
        if kind.__name__ == name:
            return kind
        kinds += kind.__subclasses__()
    raise InputError(f"the file names {name}, which this version of kcons does not have", item="integrator")


def _read(original: Callable[..., openmm.Integrator], text: str) -> openmm.Integrator:
    if f" {_NAME}=" not in text:
        return original(text)
    root = ElementTree.fromstring(text)
    note = note_in(text)
    if note is not None:
        kind = _kind(StatesOnConstraints, note["class"])
        if not hasattr(kind, "_of_note"):
            raise damaged(f"names {kind.__name__}, which is no integrator")
        return kind._of_note(original(text), note)
    compound = openmm.CompoundIntegrator()
    for node in root.findall("Integrator"):
        compound.addIntegrator(_read(original, ElementTree.tostring(node, encoding="unicode")))
    compound.setCurrentIntegrator(int(root.get("currentIntegrator", "0")))
    return compound


def _clone(original: Callable[..., openmm.Integrator], integrator: openmm.Integrator) -> openmm.Integrator:
    if isinstance(integrator, StatesOnConstraints):
        return integrator.__copy__()
    if any(note is not None for note in _notes(integrator)):
        return openmm.XmlSerializer._deserializeIntegrator(openmm.XmlSerializer._serializeIntegrator(integrator))
    return original(integrator)


# -- CompoundIntegrator -----------------------------------------------------------------------------


def _add(original: Callable[..., int], compound: openmm.CompoundIntegrator, integrator: openmm.Integrator) -> int:
    if getattr(integrator, "closed", False):
        raise UnsupportedError(
            f"{integrator!r} is a CompoundIntegrator itself, and OpenMM runs none within another; add a "
            "ProjectedIntegrator, which makes the same steps"
        )
    place = original(compound, integrator)
    if isinstance(integrator, StatesOnConstraints):
        _MEMBERS.setdefault(compound, []).append(integrator)
    return place


def _member(compound: openmm.CompoundIntegrator) -> Any:
    """The current member, if it is one of kcons."""
    return live(compound.getIntegrator(compound.getCurrentIntegrator()))


def _by_member(original: Callable[..., None], compound: openmm.CompoundIntegrator, value: Any) -> None:
    member = _member(compound)
    if member is None:
        original(compound, value)
    else:
        getattr(member, original.__name__)(value)


def _set_state(compound: openmm.CompoundIntegrator, text: str) -> None:
    """From a pickle."""
    made = openmm.XmlSerializer.deserialize(text)
    compound.this = made.this
    if made in _MEMBERS:
        _MEMBERS[compound] = _MEMBERS.pop(made)


def _wrap_all() -> None:
    compound, serializer = openmm.CompoundIntegrator, openmm.XmlSerializer
    compound.addIntegrator = wrapped(compound.addIntegrator, _add)
    for name in ("step", "setConstraintTolerance", "setStepSize"):
        setattr(compound, name, wrapped(getattr(compound, name), _by_member))
    compound.__setstate__ = _set_state
    for name, change in (
        ("_serializeIntegrator", _write),
        ("_deserializeIntegrator", _read),
        ("_cloneIntegrator", _clone),
    ):
        setattr(serializer, name, staticmethod(wrapped(getattr(serializer, name), change)))


_wrap_all()
