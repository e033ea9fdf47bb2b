"""Geodesic Langevin dynamics in OpenMM: friction and noise in the tangent plane, in the middle of the drift.

`LangevinRespa` makes several time steps: force groups at steps of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby

import openmm
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.guard import groups_in, groups_of, virtual_sites
from kcons.openmm.integrator.program import BetweenHalves, Integrator, Program
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, number
from kcons.steppers.operations import Exchange, Fly, Kick, Operation, Project
from kcons.steppers.splitting import Splitting
from kcons.thermostats.force_groups import SlowKicks, levels_of, middle_of, nested

#: Operations of an inner step: a kick, half a drift, the bath, half a drift, forces, a kick.
_INNER = 6


class Langevin(BetweenHalves):
    """Canonical ensemble, for `ProjectedIntegrator(ensemble=...)`: half a kick, half a drift along the constraints,

        v = P (exp(-gamma h) v + sqrt((1 - exp(-2 gamma h)) kT/m) noise),    P = M_par^+ M,

    half a drift, half a kick (g-BAOAB). One force evaluation a step. `setRandomNumberSeed` of the integrator, before
    its Context is made, makes a run reproducible, as far as the platform's forces are. A value: to change temperature
    or friction of a run, call `setTemperature` and `setFriction` of its integrator. The kinetic energy of a State is
    that of the middle of the step, after friction and noise.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float; 0 for friction without noise.
    friction : Quantity or float
        gamma in 1/ps if a float; 0 for none.

    Raises
    ------
    InputError
        A temperature or a friction below zero.

    Warns
    -----
    UserWarning
        At the first step: a barostat has another temperature. So do the other ensembles, and `setTemperature`.

    Notes
    -----
    Scheme: 'rattle'.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    noisy = True
    temperature: float
    friction: float

    def __init__(self, temperature: unit.Quantity | float, friction: unit.Quantity | float) -> None:
        gamma = number(friction, unit.picosecond**-1, "friction")
        if not 0 <= gamma < float("inf"):
            raise InputError(f"friction is {friction}; give a number in 1/ps, not below zero", item="friction")
        self._keep(temperature=kelvins(temperature), friction=gamma)

    def __repr__(self) -> str:
        return f"Langevin({self.temperature:g} K, {self.friction:g}/ps)"

    def declare(self, p: Program) -> None:
        kT, friction = self.settings().values()
        p.setting("kT", "Boltzmann's constant times the temperature, kJ/mol", kT)
        p.setting("friction", "1/ps", friction)

    def middle(self, p: Program, u: str) -> None:
        friction_and_noise(p, u, "dt")
        if p.parts:
            # Multipliers are those of the drifts: what noise has across the constraints is none of theirs.
            p.project()

    def settings(self) -> dict[str, float]:
        return {"kT": GAS_CONSTANT * self.temperature, "friction": self.friction}


def friction_and_noise(p: Program, u: str, h: str) -> None:
    """From velocities u to v, through a bath for a time h."""
    p.let("kept_share", f"exp(-friction*{h})", "friction")
    # 1 - exp(-2y) = 2 exp(-y) sinh(y) loses no digits for small y.
    p.let("spread", f"sqrt(2*kT*kept_share*sinh(friction*{h}))", "noise")
    p.each("v", f"kept_share*({u})+spread*gaussian/sqrt(m)", "constraint forces, friction and noise act")


# -- several time steps -----------------------------------------------------------------------------


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


def by_group(steps: Mapping[int, int]) -> dict[int, int]:
    """Steps of each force group of OpenMM; `InputError` for what is no such group."""
    try:
        steps = dict(steps)
    except (TypeError, ValueError):
        raise InputError("steps must name each force group, as {0: 1, 1: 4}", item="steps") from None
    for group in steps:
        if isinstance(group, bool) or not isinstance(group, int) or not 0 <= group < 32:
            raise InputError(f"force group {group!r} is no number from 0 to 31", item="steps")
    return steps


def refuse_other_groups(integrator: Integrator, context: openmm.Context, steps: Iterable[tuple[int, int]]) -> None:
    """Refuse groups with a number of steps that do not act, and forces of others, which nobody would compute."""
    known, carried = dict(steps), frozenset[int]().union(*(part.groups for part in integrator.parts))
    idle = set(known) - groups_in(integrator)
    if idle:
        raise InputError(
            f"force group {min(idle)} is left out by setIntegrationForceGroups, and steps give it "
            f"{known[min(idle)]}: all groups in steps act; take those forces out of the System",
            item="steps",
        )
    for force in context.getSystem().getForces():
        left = groups_of(force) - set(known) - carried
        if left:
            raise InputError(
                f"{type(force).__name__} is in force group {min(left)}, which has no number of steps; "
                f"there are {', '.join(map(str, known))}",
                item="steps",
            )


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

    adds_up = False
    steps: tuple[tuple[int, int], ...]
    slow_kicks: SlowKicks

    def __init__(
        self,
        temperature: unit.Quantity | float,
        friction: unit.Quantity | float,
        steps: Mapping[int, int],
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(temperature, friction)
        steps = by_group(steps)
        levels = levels_of({str(group): count for group, count in steps.items()})
        if len(levels) < 2:
            raise InputError(f"steps are of {len(levels)} force group; give two or more, or use Langevin", item="steps")
        middle_of(levels, slow_kicks)
        self._keep(steps=tuple((int(level.group), level.steps) for level in levels), slow_kicks=slow_kicks)

    def __repr__(self) -> str:
        middle = ", slow kicks in the middle" if self.slow_kicks == "middle" else ""
        return f"{type(self).__name__}({self.temperature:g} K, {self.friction:g}/ps, steps {dict(self.steps)}{middle})"

    @property
    def levels(self) -> tuple:  # type: ignore[type-arg]
        """Groups from the slowest to the fastest, see `kcons.thermostats.force_groups`."""
        return levels_of({str(group): count for group, count in self.steps})

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        return nested(self.levels, (1.0,), middle=self.slow_kicks == "middle")

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """Refuse groups that do not act, and virtual sites, which are placed at the end of a step only."""
        refuse_other_groups(integrator, context, self.steps)
        if virtual_sites(context.getSystem()):
            raise UnsupportedError(f"{self!r} has no virtual sites: they are placed at the end of a step; use Langevin")

    def verify(self, integrator: Integrator) -> None:
        """Refuse forces of other groups: a Context takes a new group at once."""
        refuse_other_groups(integrator, integrator.context, self.steps)

    # -- program --------------------------------------------------------------------------------

    def write(self, p: Program) -> None:
        """The operations of a step, inner steps alike as loops."""
        if p.parts:
            raise UnsupportedError(
                f"{self!r} holds the constraints of the System only, and no parts: use one time step, or "
                "kcons.thermostats.LangevinRespa with forces from OpenMM"
            )
        p.filtered = False
        p.let_others_act()
        done = p.operations
        last = max(k for k, operation in enumerate(done) if isinstance(operation, Fly)) - (_INNER - 3)
        for block, times in _loops(done[:last], self.levels[-1].group):
            if times == 1:
                _write_all(p, block)
                continue
            p.let("inner_left", str(times), "inner steps alike follow")
            with p.loop("inner_left > 0", "inner steps"):
                _write_all(p, block)
                p.let("inner_left", "inner_left-1", "one is made")
        ends = last + _INNER - 2
        _write_all(p, done[last:ends])
        p.note_middle("v")
        _write_all(p, done[ends:])
        p.note_end()


def _write_all(p: Program, operations: Sequence[Operation]) -> None:
    for operation in operations:
        if isinstance(operation, Kick):
            force, h = f"f{operation.group}", f"{operation.fraction!r}*dt"
            p.each("v", f"v+{h}*{force}/m", f"forces of group {operation.group} act (kick)")
        elif isinstance(operation, Fly):
            for length in operation.flights:
                impulse = p.drift(f"({length!r}*dt)")
                p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
        elif isinstance(operation, Exchange):
            # The drift that follows absorbs what noise has across constraints.
            friction_and_noise(p, "v", f"{operation.fraction!r}*dt")
        elif isinstance(operation, Project):
            p.project()
