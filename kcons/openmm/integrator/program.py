"""An integrator as a list of computations, each with the words that explain it."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import openmm

from kcons.constraints.target import FloatArray

_GIVEN = "x, v, m, f, dt: positions, velocities, masses, applied forces, time step"


class Program:
    """Writes the computations of a CustomIntegrator and their listing, line by line.

    Parameters
    ----------
    integrator : openmm.CustomIntegrator
        The computations are added to it as they are written.

    Attributes
    ----------
    settings : dict of float
        Global variables that the integrator was made with, or was told since. They are kept here; the variables of a
        Context are copies of them, which a State or a checkpoint may overwrite, and `push` puts right.
    idle : dict of float
        Global variables that control the program, as they are between two calls of `step`.
    memory : set of str
        Variables that belong to a state as x and v do.
    """

    def __init__(self, integrator: openmm.CustomIntegrator) -> None:
        # Weak, for the integrator owns its program.
        self._integrator = weakref.ref(integrator)
        self.variables: list[str] = []
        self._lines: list[tuple[int, str, str]] = []
        self._depth = 0
        #: Blocks in which nothing is written yet.
        self._unopened: list[tuple[str, str, str, str]] = []
        self._known: set[str] = {"x", "v", "m", "f", "dt", "energy"}
        #: Kind, variable and expression of each computation, for `count_step`; 'loop', 'when' and 'end' make blocks.
        self.operations: list[tuple[str, str, str]] = []
        self.tables: dict[str, tuple[float, ...]] = {}
        self.numbers: dict[str, float] = {}
        self.settings: dict[str, float] = {}
        self.idle: dict[str, float] = {}
        self.memory: set[str] = set()
        #: Variables with a value for each degree of freedom.
        self.vectors: set[str] = set()
        self._vectors: dict[str, FloatArray] = {}

    @property
    def integrator(self) -> openmm.CustomIntegrator:
        integrator = self._integrator()
        assert integrator is not None
        return integrator

    # -- variables ------------------------------------------------------------------------------

    def number(self, name: str, words: str, value: float = 0.0) -> str:
        """Declare a global variable; returns its name."""
        if name not in self._known:
            self._known.add(name)
            self.integrator.addGlobalVariable(name, value)
            self.numbers[name] = float(value)
            self.variables.append(f"{name}: {words}")
        return name

    def setting(self, name: str, words: str, value: float) -> str:
        """Declare a global variable that the integrator was made with; returns its name."""
        if name not in self._known:
            self.settings[name] = float(value)
        return self.number(name, words, value)

    def control(self, name: str, words: str, value: float = 0.0) -> str:
        """Declare a global variable that has this value between two calls of `step`; returns its name."""
        if name not in self._known:
            self.idle[name] = float(value)
        return self.number(name, words, value)

    def remember(self, name: str, words: str) -> str:
        """Declare a global variable that belongs to a state as x and v do, 0 at first; returns its name."""
        self.memory.add(name)
        return self.number(name, words)

    def remembered(self) -> dict[str, Any]:
        """What belongs to the present state besides x and v."""
        one, each = self.integrator.getGlobalVariableByName, self.integrator.getPerDofVariableByName
        return {name: (each if name in self.vectors else one)(name) for name in sorted(self.memory)}

    def recall(self, values: Mapping[str, Any]) -> None:
        """Write what `remembered` gave back into the Context."""
        for name, value in values.items():
            (self.integrator.setPerDofVariableByName if name in self.vectors else self.write)(name, value)

    def vector_setting(self, name: str, words: str, values: FloatArray) -> str:
        """Declare a variable that the integrator was made with, values of shape (n_particles, 3); returns its name."""
        self.vector(name, words)
        self._vectors[name] = np.array(values, dtype=np.float64)
        self._write_vector(name)
        return name

    def vector(self, name: str, words: str) -> str:
        """Declare a variable with a value for each degree of freedom; returns its name."""
        if name not in self._known:
            self._known.add(name)
            self.vectors.add(name)
            self.integrator.addPerDofVariable(name, 0)
            self.variables.append(f"{name}: {words} (each degree of freedom)")
        return name

    def table(self, name: str, values: Sequence[float], words: str) -> str:
        """Declare a table of constants, written name(k) in expressions; returns its name."""
        self._known.add(name)
        self.integrator.addTabulatedFunction(name, openmm.Discrete1DFunction(list(values)))
        self.tables[name] = tuple(values)
        self.variables.append(f"{name}(k): {words}")
        return name

    # -- settings -------------------------------------------------------------------------------

    def set(self, name: str, value: float) -> None:
        """Change a setting, here and in the Context."""
        self.settings[name] = float(value)
        self.write(name, value)

    def write(self, name: str, value: float) -> None:
        """Change a global variable in the Context only."""
        openmm.CustomIntegrator.setGlobalVariableByName(self.integrator, name, float(value))

    def differing(self) -> list[str]:
        """Settings whose variables have other values: something else has written them."""
        read = self.integrator.getGlobalVariableByName
        return [name for name, value in self.settings.items() if read(name) != value]

    def push(self) -> None:
        """Write all settings into the Context, and end what was under way there."""
        for name, value in (self.settings | self.idle).items():
            self.write(name, value)
        for name in self._vectors:
            self._write_vector(name)

    def forget(self) -> None:
        """Put all other global variables back to what they are in a new integrator."""
        for name, value in self.numbers.items():
            if name not in self.settings:
                self.write(name, value)

    def _write_vector(self, name: str) -> None:
        self.integrator.setPerDofVariableByName(name, self._vectors[name].tolist())

    # -- computations ---------------------------------------------------------------------------

    def let(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for one global variable."""
        self._write("let", variable, expression, f"{variable} = {expression}", words)
        self.integrator.addComputeGlobal(variable, expression)

    def each(self, variable: str, expression: str, words: str) -> None:
        """variable = expression for each degree of freedom."""
        self._write("each", variable, expression, f"{variable} = {expression}", words)
        self.integrator.addComputePerDof(variable, expression)

    def sum(self, variable: str, expression: str, words: str) -> None:
        """variable = sum of expression over all degrees of freedom."""
        self._write("sum", variable, expression, f"{variable} = sum({expression})", words)
        self.integrator.addComputeSum(variable, expression)

    def hold_positions(self, words: str) -> None:
        self._write("hold", "x", "", "constrain positions", words)
        self.integrator.addConstrainPositions()

    def hold_velocities(self, words: str) -> None:
        self._write("hold", "v", "", "constrain velocities", words)
        self.integrator.addConstrainVelocities()

    def let_others_act(self) -> None:
        """Barostats, CMMotionRemover, Andersen thermostats change the state here."""
        self._write("others", "", "", "update context state", "barostats and other outside agents may act")
        self.integrator.addUpdateContextState()

    @contextmanager
    def loop(self, condition: str, words: str) -> Iterator[None]:
        """Repeat what is written inside while `condition` holds."""
        with self._block("loop", condition, f"while {condition}:", words):
            yield

    @contextmanager
    def when(self, condition: str, words: str, *, usual: bool = False) -> Iterator[None]:
        """Do what is written inside if `condition` holds; without anything inside, there is no block.

        `usual` tells those who count steps that it mostly does where this depends on positions.
        """
        with self._block("usual" if usual else "when", condition, f"if {condition}:", words):
            yield

    @contextmanager
    def _block(self, kind: str, condition: str, code: str, words: str) -> Iterator[None]:
        outside = len(self._unopened)
        self._unopened.append((kind, condition, code, words))
        yield
        if len(self._unopened) > outside:
            self._unopened.pop()
            return
        self._depth -= 1
        self.integrator.endBlock()
        self.operations.append(("end", "", ""))

    def _write(self, kind: str, variable: str, expression: str, code: str, words: str) -> None:
        """Note a computation, after the blocks that begin with it have been opened."""
        pending, self._unopened = self._unopened, []
        for block, condition, opening, why in pending:
            begin = self.integrator.beginWhileBlock if block == "loop" else self.integrator.beginIfBlock
            begin(condition)
            self.operations.append((block, "", condition))
            self._lines.append((self._depth, opening, why))
            self._depth += 1
        self.operations.append((kind, variable, expression))
        self._lines.append((self._depth, code, words))

    # -- running --------------------------------------------------------------------------------

    def run(self, context: openmm.Context, steps: int, parts: int = 1) -> None:
        """Make steps, each of them in so many executions of the program, of which the global `phase` is the number.

        OpenMM takes each execution for a step; clock and step count are put right.
        """
        integrator = self.integrator
        if parts == 1:
            openmm.CustomIntegrator.step(integrator, steps)
            return
        dt = integrator.getStepSize()._value
        for _ in range(steps):
            time, count = context.getTime()._value, context.getStepCount()
            self.write("phase", 1.0)
            try:
                openmm.CustomIntegrator.step(integrator, parts)
            finally:
                self.write("phase", 0.0)
            context.setTime(time + dt)
            context.setStepCount(count + 1)

    # -- listing --------------------------------------------------------------------------------

    def listing(self) -> str:
        """The variables, and the steps with their words in a column beside."""
        codes = ["    " * depth + code for depth, code, _ in self._lines]
        width = min(max((len(code) for code in codes), default=0), 60)
        steps = [f"  {code:<{width}}  # {words}" for code, (_, _, words) in zip(codes, self._lines, strict=True)]
        return "\n".join(["variables", *(f"  {line}" for line in (_GIVEN, *self.variables)), "each step", *steps])
