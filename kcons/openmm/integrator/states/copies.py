"""Copies of an integrator, and the way back from XML, where OpenMM forgets the class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, Self, TypeVar

import openmm

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.ensemble import Ensemble
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.schemes import LEAPFROG, SCHEMES
from kcons.openmm.integrator.states.serialization import ensemble_in, note_in, note_of, note_of_ensemble, read_plain
from kcons.openmm.integrator.step_variables import VARIABLES
from kcons.openmm.quantities import relative_tolerance
from kcons.steppers.splitting import Splitting

_Kind = TypeVar("_Kind", bound=Integrator)
#: Globals that belong to a run, not to the integrator: a copy starts without them. (Clocks of targets that move, which
#: it has, go by the number of good steps.)
_RUN = {name for name, kind in VARIABLES.items() if kind.kind == "number"}
RUN_STATE = frozenset(_RUN - {"good_steps"} | {"lost", "two_k"})


def settings_of(integrator: openmm.CustomIntegrator) -> dict[str, Any]:
    """What a user may have set: seed, force groups, global variables."""
    names = [integrator.getGlobalVariableName(k) for k in range(integrator.getNumGlobalVariables())]
    program = getattr(integrator, "program", None)
    return {
        "seed": integrator.getRandomNumberSeed(),
        "groups": integrator.getIntegrationForceGroups(),
        "globals": {name: integrator.getGlobalVariableByName(name) for name in names if name not in RUN_STATE},
        "settings": {} if program is None else dict(program.settings),
    }


def apply_settings(integrator: Integrator, settings: dict[str, Any]) -> None:
    """What was set, but no setting of the ensemble or of a part that the integrator itself has kept."""
    program = integrator.program
    integrator.setRandomNumberSeed(settings["seed"])
    openmm.Integrator.setIntegrationForceGroups(integrator, settings["groups"])
    for name, value in settings["globals"].items():
        if name not in program.settings and name not in program.idle and name not in program.memory:
            program.write(name, value)
    for name, value in settings["settings"].items():
        program.set(name, value)


def remade(kind: type[_Kind], making: tuple[Any, ...], settings: dict[str, Any]) -> _Kind:
    """The integrator of these arguments and settings; what pickles call."""
    dt, scheme, parts, tolerance, check_every, ensemble = making
    made = kind(dt, scheme, parts=parts, tolerance=tolerance, check_every=check_every, ensemble=ensemble)
    apply_settings(made, settings)
    return made


def as_projected(
    kind: type[_Kind],
    integrator: openmm.CustomIntegrator,
    parts: Sequence[Part] = (),
    check_every: int | None = None,
    ensemble: Ensemble | None = None,
) -> _Kind:
    """The integrator of this class that has the program of `integrator`.

    Raises
    ------
    InputError
        It is no program of this class with these parts.
    """
    if not isinstance(integrator, openmm.CustomIntegrator):
        raise InputError(f"{type(integrator).__name__} is no CustomIntegrator", item="integrator")
    wanted = program_of(integrator)
    for scheme in _candidates(integrator, bool(parts)):
        making = (integrator.getStepSize(), scheme, parts, integrator.getConstraintTolerance(), check_every, ensemble)
        try:
            made = kind(making[0], scheme, parts=parts, tolerance=making[3], check_every=check_every, ensemble=ensemble)
        except UnsupportedError:  # no integrator of this ensemble and these parts has this scheme
            continue
        if program_of(made) == wanted:
            apply_settings(made, settings_of(integrator) | {"settings": {}})  # the ensemble is the one that is given
            return made
    raise InputError(
        f"this CustomIntegrator has no program of {kind.__name__} with "
        f"{f'these {len(parts)} parts' if parts else 'no parts'}; give the same parts as when it was made",
        item="integrator",
    )


def program_of(integrator: openmm.CustomIntegrator) -> tuple[Any, ...]:
    """Everything that decides what the integrator does."""
    names = range(integrator.getNumPerDofVariables())
    tables = []
    for k in range(integrator.getNumTabulatedFunctions()):
        table = integrator.getTabulatedFunction(k)
        values = table.getFunctionParameters() if isinstance(table, openmm.Discrete1DFunction) else ()
        tables.append((integrator.getTabulatedFunctionName(k), tuple(values)))
    return (
        tuple(tuple(integrator.getComputationStep(k)) for k in range(integrator.getNumComputations())),
        tuple(integrator.getGlobalVariableName(k) for k in range(integrator.getNumGlobalVariables())),
        tuple(integrator.getPerDofVariableName(k) for k in names),
        tuple(tables),
        integrator.getKineticEnergyExpression(),
    )


def _candidates(integrator: openmm.CustomIntegrator, parts: bool) -> Iterable[str | Splitting]:
    """Schemes by name, then what the tables say, for splittings of one's own."""
    yield from SCHEMES
    yield LEAPFROG
    tables = dict(program_of(integrator)[3])
    if "drift_share" in tables:
        drifts, kicks = list(tables["drift_share"]), list(tables["kick_share"])
        if parts:  # two entries more, for applying constraints alone
            drifts, kicks = drifts[:-2], kicks[:-2]
        if kicks[0]:
            yield Splitting(kicks, drifts)
        yield Splitting(kicks[1:-1], drifts)


class Copies(Integrator):
    """An integrator that is copied, pickled and written to XML with what it was made with."""

    check_every: int
    asked_tolerance: float | None
    ensemble: Ensemble

    @property
    def _dt(self) -> float:
        raise NotImplementedError

    @classmethod
    def from_xml(cls, xml: str, **arguments: Any) -> Self:
        """The integrator that XmlSerializer wrote, with its parts.

        Without parts XmlSerializer.deserialize does the same.

        Parameters
        ----------
        xml : str
            The text of the file.
        **arguments
            `parts`, which the file does not contain; `check_every` and `ensemble` where they are to be others.

        Raises
        ------
        InputError
            The file has no program of this class with these parts.
        """
        return cls._of_note(read_plain(xml), note_in(xml) or {}, **arguments)

    def _note(self) -> dict[str, Any]:
        return note_of(self, ensemble=note_of_ensemble(self.ensemble), parts=len(self.parts))

    @classmethod
    def _of_note(cls, plain: openmm.CustomIntegrator, note: dict[str, Any], **arguments: Any) -> Self:
        if not note:
            return as_projected(cls, plain, **arguments)
        if note.get("parts") and not arguments.get("parts"):
            raise InputError(
                f"the integrator in the file holds {note['parts']} parts, which no file contains; read it by "
                "ProjectedIntegrator.from_xml(text, parts=[...]) with the same parts as when it was made",
                item="parts",
            )
        asked = None if note["tolerance"] is None else relative_tolerance(note["tolerance"])
        ensemble = arguments.get("ensemble") or ensemble_in(note)
        made = as_projected(cls, plain, **{"check_every": note["check_every"], **arguments, "ensemble": ensemble})
        made.asked_tolerance = asked
        return made

    @classmethod
    def as_projected(cls, integrator: openmm.CustomIntegrator, **arguments: Any) -> Self:
        """A plain CustomIntegrator that was one of these once, see `from_xml`."""
        return as_projected(cls, integrator, **arguments)

    def _making(self) -> tuple[Any, ...]:
        scheme = LEAPFROG if self.scheme is None else self.scheme
        every = None if self.spare else self.check_every
        return self.getStepSize(), scheme, self.parts, self.asked_tolerance, every, self.ensemble

    def __reduce__(self) -> tuple[Any, ...]:
        return remade, (type(self), self._making(), settings_of(self))

    def __copy__(self) -> Self:
        """Without the Context, and with copies of the parts; rows of `hold`, which the System has, are shared."""
        return remade(type(self), deepcopy(self._making()), settings_of(self))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.__copy__()
