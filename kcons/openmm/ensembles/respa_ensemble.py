"""Several time steps in OpenMM: force groups at steps of their own, under Langevin dynamics and on spheres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Self

import openmm
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.ensembles.langevin_ensemble import Langevin
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.step_variables import use
from kcons.openmm.integrator.system_checks import groups_in, groups_of
from kcons.steppers.operations import Exchange, Fly, Kick, Operation, Project
from kcons.steppers.splitting import Splitting
from kcons.thermostats.multistep.nesting import SlowKicks, levels_of, middle_of, nested

#: Operations of an inner step: a kick, half a drift, the bath, half a drift, forces, a kick.
_INNER = 6


class RespaWriter(LeanStepWriter):
    """Writes the operations of an ensemble with several time steps, inner steps alike as loops."""

    ensemble: LangevinRespa

    def write(self) -> None:
        if self.parts:
            raise UnsupportedError(
                f"{self.ensemble!r} holds the constraints of the System only, and no parts: use one time step, or "
                "kcons.thermostats.LangevinRespa with forces from OpenMM"
            )
        p = self.program
        use(p, "xu")
        p.number("inner_left", "inner steps that are left")
        self._declare_ensemble()
        p.let_others_act()
        done = self.operations
        last = max(k for k, operation in enumerate(done) if isinstance(operation, Fly)) - (_INNER - 3)
        fastest = self.ensemble.levels[-1].group
        for block, times in _loops(done[:last], fastest):
            if times == 1:
                self._write_all(block)
                continue
            p.let("inner_left", str(times), "inner steps alike follow")
            with p.loop("inner_left > 0", "inner steps"):
                self._write_all(block)
                p.let("inner_left", "inner_left-1", "one is made")
        ends = last + _INNER - 2
        self._write_all(done[last:ends])
        self._note_middle("v")
        self._write_all(done[ends:])
        self._note_end()

    def _write_all(self, operations: Sequence[Operation]) -> None:
        p = self.program
        for operation in operations:
            if isinstance(operation, Kick):
                self.ensemble.push(p, f"f{operation.group}", f"{operation.fraction!r}*dt", operation.group)
            elif isinstance(operation, Fly):
                for length in operation.flights:
                    impulse = self._drift(f"({length!r}*dt)")
                    p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
            elif isinstance(operation, Exchange):
                self.ensemble.exchange(p, f"{operation.fraction!r}*dt")
            elif isinstance(operation, Project):
                self._project()


def _loops(operations: Sequence[Operation], fastest: str) -> Iterator[tuple[Sequence[Operation], int]]:
    """Blocks of operations, and how often each comes in a row: inner steps, and single operations between them."""
    blocks: list[tuple[Operation, ...]] = []
    at = 0
    while at < len(operations):
        first = operations[at]
        size = _INNER if isinstance(first, Kick) and first.group == fastest else 1
        blocks.append(tuple(operations[at : at + size]))
        at += size
    for _, alike in groupby(blocks, key=lambda block: [str(operation) for operation in block]):
        row = list(alike)
        if len(row[0]) == _INNER:
            yield row[0], len(row)
        else:
            for block in row:
                yield block, 1


class LangevinRespa(Langevin):
    """Langevin dynamics with several time steps, for `ProjectedIntegrator(timestep, ensemble=...)`.

    The System's constraints are held in each inner step. As `kcons.thermostats.LangevinRespa`, with force groups of
    OpenMM in place of functions; friction and noise act in the middle of each inner step.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float.
    friction : Quantity or float
        In 1/ps if a float; 0 for none.
    steps : mapping of int to int
        Steps of each force group in a step of the integrator, ``{0: 1, 1: 4}``; each divides the next. All forces of
        the System belong to one of these groups.
    slow_kicks : {'ends', 'middle'}
        See `kcons.thermostats.LangevinRespa`.

    Raises
    ------
    InputError
        Groups that are no numbers from 0 to 31; numbers of steps that do not divide each other.

    Notes
    -----
    Scheme 'rattle', without parts. Fast forces are evaluated once more after each kick of slower ones, since OpenMM
    keeps those of one group only.
    """

    writer = RespaWriter
    adds_up = False
    groups: tuple[int, ...]
    counts: tuple[int, ...]
    slow_kicks: SlowKicks

    def __init__(
        self,
        temperature: unit.Quantity | float,
        friction: unit.Quantity | float,
        steps: Mapping[int, int],
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(temperature, friction)
        if not isinstance(steps, Mapping):
            raise InputError("steps must name each force group, as {0: 1, 1: 4}", item="steps")
        for group in steps:
            if isinstance(group, bool) or not isinstance(group, int) or not 0 <= group < 32:
                raise InputError(f"force group {group!r} is no number from 0 to 31", item="steps")
        levels = levels_of({str(group): count for group, count in steps.items()})
        if len(levels) < 2:
            raise InputError(f"steps are of {len(levels)} force group; give two or more, or use Langevin", item="steps")
        middle_of(levels, slow_kicks)
        counts = tuple(level.steps for level in levels)
        self._keep(groups=tuple(int(level.group) for level in levels), counts=counts, slow_kicks=slow_kicks)

    @classmethod
    def of(cls, values: dict[str, Any]) -> Self:
        rest = dict(values)
        steps = dict(zip(rest.pop("groups"), rest.pop("counts"), strict=True))
        return cls(**rest, steps=steps)

    def __repr__(self) -> str:
        steps = dict(zip(self.groups, self.counts, strict=True))
        middle = ", slow kicks in the middle" if self.slow_kicks == "middle" else ""
        return f"{type(self).__name__}({self.temperature:g} K, {self.friction:g}/ps, steps {steps}{middle})"

    @property
    def levels(self) -> tuple:  # type: ignore[type-arg]
        """Groups from the slowest to the fastest, see `kcons.thermostats.multistep.nesting`."""
        return levels_of({str(group): count for group, count in zip(self.groups, self.counts, strict=True)})

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        return nested(self.levels, 2, (1.0,), middle=self.slow_kicks == "middle")

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """Refuse forces of other groups, and virtual sites, which are placed at the end of a step only."""
        super().begin(integrator, context)
        idle = set(self.groups) - groups_in(integrator)
        if idle:
            raise InputError(
                f"force group {min(idle)} is left out by setIntegrationForceGroups, and steps give it "
                f"{dict(zip(self.groups, self.counts, strict=True))[min(idle)]}: all groups in steps act; take those "
                "forces out of the System",
                item="steps",
            )
        system = context.getSystem()
        for force in system.getForces():
            left = groups_of(force) - set(self.groups)
            if left:
                raise InputError(
                    f"{type(force).__name__} is in force group {min(left)}, which has no number of steps; "
                    f"there are {', '.join(map(str, self.groups))}",
                    item="steps",
                )
        if any(system.isVirtualSite(k) for k in range(system.getNumParticles())):
            raise UnsupportedError(f"{self!r} has no virtual sites: they are placed at the end of a step; use Langevin")

    def push(self, program: Program, force: str, h: str, name: str) -> None:
        """Write a kick."""
        program.each("v", f"v+{h}*{force}/m", f"forces of group {name} act (kick)")

    def exchange(self, program: Program, h: str) -> None:
        """Write friction and noise for a time; the drift that follows absorbs what noise has across constraints."""
        p = program
        p.let("kept_share", f"exp(-friction*{h})", "friction")
        p.let("spread", f"sqrt(2*kT*kept_share*sinh(friction*{h}))", "noise")
        p.each("v", "kept_share*v+spread*gaussian/sqrt(m)", "friction and noise act")

    def at(self, temperature: float) -> LangevinRespa:
        return type(self)(temperature, self.friction, dict(zip(self.groups, self.counts, strict=True)), self.slow_kicks)

    def with_friction(self, friction: unit.Quantity | float) -> LangevinRespa:
        steps = dict(zip(self.groups, self.counts, strict=True))
        return type(self)(self.temperature, friction, steps, self.slow_kicks)


class IsokineticCircles(LangevinRespa):
    """A stochastic isokinetic bath for each coordinate of free atoms, with several time steps.

    Each mass-weighted velocity u and an auxiliary variable w keep u^2 + w^2 = k_B T, so that no kick drives an atom
    faster than that: `IsokineticSpheres(spheres="axes", auxiliary=1)` of `kcons.thermostats` for atoms without
    constraints. Spheres of molecules need sums over each molecule, which programs of OpenMM do not have: run these by
    `kcons.thermostats.IsokineticSpheres`, with forces from OpenMM. Configurations only: dynamics are lost.

    Parameters
    ----------
    temperature, friction, steps, slow_kicks
        As for `LangevinRespa`; temperature and friction above 0.

    Raises
    ------
    InputError
        Temperature or friction not above 0. At the first step: the System has constraints (`UnsupportedError`).
    """

    def __init__(
        self,
        temperature: unit.Quantity | float,
        friction: unit.Quantity | float,
        steps: Mapping[int, int],
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(temperature, friction, steps, slow_kicks)
        for name, value in (("temperature", self.temperature), ("friction", self.friction)):
            if not value > 0:
                raise InputError(f"{name} is {value}; circles need one above 0", item=name)

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        super().begin(integrator, context)
        rows = context.getSystem().getNumConstraints()
        if rows:
            raise UnsupportedError(
                f"{self!r} is for free atoms, and the System holds {rows} constraints: their spheres need sums over "
                "each molecule, which programs of OpenMM do not have. Use LangevinRespa, or "
                "kcons.thermostats.IsokineticSpheres with forces from OpenMM"
            )

    def declare(self, program: Program) -> None:
        super().declare(program)
        program.memory.add(program.vector("w", "auxiliary variables"))
        program.vector("keep", "what is left of u in a kick")

    def push(self, program: Program, force: str, h: str, name: str) -> None:
        """u' = (1 - u^2/R^2) F and w' = -(u w/R^2) F in closed form, as `kcons.thermostats.multistep` has it."""
        p = program
        along = f"c=max(-1, min(1, sqrt(m/kT)*v*s)); s=select(step({force}), 1, -1)"
        strength = f"z=abs({force})*{h}/sqrt(m*kT)"
        share = "d=0.5*((1+c)+(1-c)*exp(-2*z))"
        p.each("keep", f"exp(-z)/d; {share}; {strength}; {along}", "of the kick")
        lead = "0.5*s*sqrt(kT/m)*((1-exp(-2*z))+c*(1-exp(-z))^2)/d"
        p.each("v", f"keep*v+{lead}; {share}; {strength}; {along}", f"forces of group {name} turn v and w (kick)")
        p.each("w", "keep*w", "both")
        self._onto_circles(p)

    def exchange(self, program: Program, h: str) -> None:
        super().exchange(program, h)
        program.each("w", "kept_share*w+spread*gaussian", "the bath acts on both")
        self._onto_circles(program)

    def _onto_circles(self, p: Program) -> None:
        p.each("keep", "select(m*v*v+w*w, sqrt(kT/(m*v*v+w*w)), 1)", "onto the circle")
        p.each("v", "keep*v", "onto the circle")
        p.each("w", "keep*w", "onto the circle")

    def warmth(self, integrator: Integrator) -> float:
        """u^2 is half of k_B T on average."""
        return 2.0
