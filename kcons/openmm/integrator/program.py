"""The program of an integrator as plain data: variables, and computations with the words that explain them."""

from __future__ import annotations

import re
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import openmm

_GIVEN = "x, v, m, f, dt: positions, velocities, masses, applied forces, time step"
_FORCES = re.compile(r"\b(f|energy)(\d*)\b")


class Line(NamedTuple):
    """One computation.

    Attributes
    ----------
    kind : str
        'let' for a global variable, 'each' for one of each degree of freedom, 'sum'; 'hold' x or v; 'others';
        'loop', 'when' and 'end' make blocks.
    variable, expression, words : str
    """

    kind: str
    variable: str
    expression: str
    words: str

    @property
    def code(self) -> str:
        """As `listing` shows it."""
        match self.kind:
            case "hold":
                return f"constrain {'positions' if self.variable == 'x' else 'velocities'}"
            case "others":
                return "update context state"
            case "loop" | "when":
                return f"{'while' if self.kind == 'loop' else 'if'} {self.expression}:"
            case "sum":
                return f"{self.variable} = sum({self.expression})"
        return f"{self.variable} = {self.expression}"


class Program:
    """Variables and lines of a program; `hand_over` gives them to a CustomIntegrator.

    Attributes
    ----------
    lines : list of Line
    numbers : dict of float
        Global variables, and their values in a new integrator.
    settings : dict of float
        Those that the integrator was made with, or was told since. They are kept here and written at each call of
        `step`: whatever a State or a checkpoint brings is a copy.
    idle : dict of float
        Those that control the program, as they are where nothing is asked of it; written at each call as well.
    memory : set of str
        Variables that belong to a state as x and v do.
    vectors : list of str
        Variables with a value for each degree of freedom.
    tables : dict
        Constants, written name(k) in expressions.
    kinetic_energy : str
        Expression of the kinetic energy that a State tells.
    """

    #: Whether a plugin has kernels in place of the lines.
    on_device = False

    def __init__(self, integrator: openmm.CustomIntegrator) -> None:
        # Weak, for the integrator owns its program.
        self._integrator = weakref.ref(integrator)
        self.lines: list[Line] = []
        self.numbers: dict[str, float] = {}
        self.settings: dict[str, float] = {}
        self.idle: dict[str, float] = {}
        self.memory: set[str] = set()
        self.vectors: list[str] = []
        self.tables: dict[str, tuple[float, ...]] = {}
        self.kinetic_energy = "m*v*v/2"
        self._words: dict[str, str] = {}

    @property
    def integrator(self) -> Any:
        integrator = self._integrator()
        assert integrator is not None
        return integrator

    # -- variables ------------------------------------------------------------------------------

    def number(self, name: str, words: str, value: float = 0.0) -> str:
        """Declare a global variable; returns its name."""
        if name not in self._words:
            self._words[name] = words
            self.numbers[name] = float(value)
        return name

    def setting(self, name: str, words: str, value: float) -> str:
        """Declare a global variable that the integrator was made with; returns its name."""
        if name not in self._words:
            self.settings[name] = float(value)
        return self.number(name, words, value)

    def control(self, name: str, words: str, value: float = 0.0) -> str:
        """Declare a global variable that has this value between two calls of `step`; returns its name."""
        if name not in self._words:
            self.idle[name] = float(value)
        return self.number(name, words, value)

    def remember(self, name: str, words: str) -> str:
        """Declare a global variable that belongs to a state as x and v do, 0 at first; returns its name."""
        self.memory.add(name)
        return self.number(name, words)

    def vector(self, name: str, words: str) -> str:
        """Declare a variable with a value for each degree of freedom; returns its name."""
        if name not in self._words:
            self._words[name] = f"{words} (each degree of freedom)"
            self.vectors.append(name)
        return name

    def table(self, name: str, values: Sequence[float], words: str) -> str:
        """Declare a table of constants, written name(k) in expressions; returns its name."""
        self._words[f"{name}(k)"] = words
        self.tables[name] = tuple(float(value) for value in values)
        return name

    # -- computations ---------------------------------------------------------------------------

    def let(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for one global variable."""
        self.lines.append(Line("let", variable, expression, words))

    def each(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for each degree of freedom."""
        self.lines.append(Line("each", variable, expression, words))

    def sum(self, variable: str, expression: str, words: str) -> None:
        """variable = sum of expression over all degrees of freedom."""
        self.lines.append(Line("sum", variable, expression, words))

    def hold_positions(self, words: str) -> None:
        self.lines.append(Line("hold", "x", "", words))

    def hold_velocities(self, words: str) -> None:
        self.lines.append(Line("hold", "v", "", words))

    def let_others_act(self) -> None:
        """Barostats, CMMotionRemover, Andersen thermostats change the state here."""
        self.lines.append(Line("others", "", "", "barostats and other outside agents may act"))

    @contextmanager
    def loop(self, condition: str, words: str) -> Iterator[None]:
        """Repeat what is written inside while `condition` holds."""
        with self._block("loop", condition, words):
            yield

    @contextmanager
    def when(self, condition: str, words: str) -> Iterator[None]:
        """Do what is written inside if `condition` holds; without anything inside, there is no block."""
        with self._block("when", condition, words):
            yield

    @contextmanager
    def _block(self, kind: str, condition: str, words: str) -> Iterator[None]:
        self.lines.append(Line(kind, "", condition, words))
        begun = len(self.lines)
        yield
        if len(self.lines) == begun:
            self.lines.pop()
        else:
            self.lines.append(Line("end", "", "", ""))

    # -- the integrator -------------------------------------------------------------------------

    def hand_over(self) -> None:
        """Give variables and lines to the integrator: the only place where a program of OpenMM is made."""
        integrator = self.integrator
        for name, value in self.numbers.items():
            integrator.addGlobalVariable(name, value)
        for name in self.vectors:
            integrator.addPerDofVariable(name, 0)
        for name, table in self.tables.items():
            integrator.addTabulatedFunction(name, openmm.Discrete1DFunction(list(table)))
        integrator.setKineticEnergyExpression(self.kinetic_energy)
        add = {
            "let": integrator.addComputeGlobal,
            "each": integrator.addComputePerDof,
            "sum": integrator.addComputeSum,
            "hold": lambda x, _: (
                integrator.addConstrainPositions() if x == "x" else integrator.addConstrainVelocities()
            ),
            "others": lambda *_: integrator.addUpdateContextState(),
            "loop": lambda _, condition: integrator.beginWhileBlock(condition),
            "when": lambda _, condition: integrator.beginIfBlock(condition),
            "end": lambda *_: integrator.endBlock(),
        }
        for line in self.lines:
            add[line.kind](line.variable, line.expression)

    def set(self, name: str, value: float) -> None:
        """Change a setting, here and in the Context."""
        self.settings[name] = float(value)
        self.write(name, value)

    def write(self, name: str, value: float) -> None:
        """Change a global variable in the Context only."""
        openmm.CustomIntegrator.setGlobalVariableByName(self.integrator, name, float(value))

    def push(self) -> None:
        """Write all settings into the Context, and end what was under way there."""
        for name, value in (*self.settings.items(), *self.idle.items()):
            self.write(name, value)

    def remembered(self) -> dict[str, Any]:
        """What belongs to the present state besides x and v."""
        return {name: self.integrator.getGlobalVariableByName(name) for name in sorted(self.memory)}

    def recall(self, values: Mapping[str, Any]) -> None:
        """Write what `remembered` gave back into the Context."""
        for name, value in values.items():
            self.write(name, value)

    def listing(self) -> str:
        """The variables, and the steps with their words in a column beside."""
        rows, depth = [], 0
        for line in self.lines:
            if line.kind == "end":
                depth -= 1
                continue
            rows.append(("    " * depth + line.code, line.words))
            depth += line.kind in ("loop", "when")
        width = min(max((len(code) for code, _ in rows), default=0), 60)
        steps = [f"  {code:<{width}}  # {words}" for code, words in rows]
        known = [f"{name}: {words}" for name, words in self._words.items()]
        return "\n".join(["variables", *(f"  {line}" for line in (_GIVEN, *known)), "each step", *steps])


def forces_at_old_positions(lines: Sequence[Line]) -> bool:
    """Whether GPUs compute forces at old positions where the System has constraints.

    They keep what a computation makes of x as a difference, which forces do not see, until the next constraints are
    applied to positions; where no such line follows anywhere below, x is changed at once.
    """
    holds = [k for k, line in enumerate(lines) if line[:2] == ("hold", "x")]
    kept = False
    for k, line in enumerate(lines):
        if kept and _FORCES.search(line.expression):
            return True
        if line.kind == "hold" and line.variable == "x":
            kept = False
        elif line.kind == "each" and line.variable == "x":
            kept = bool(holds) and k < holds[-1]
    return False
