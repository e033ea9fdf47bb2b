"""Dynamics on constraints for `torch_sim.integrate`: constant energy, Langevin dynamics, Nosé-Hoover chains.

Each is a pair (init, step) with the arguments and units of TorchSim's own. A step gives a new state, and leaves the one
that it is given as it was, but for its random numbers.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch_sim import SimState, calc_kinetic_energy
from torch_sim.integrators import INTEGRATOR_KWARG_UNITS, IntegratorKwargUnits, MDState
from torch_sim.integrators.md import InverseTimeArg, NoseHooverChain, TimeArg, construct_nose_hoover_chain
from torch_sim.models.interface import ModelInterface
from torch_sim.units import unit_factor_from_annotation

from kcons.batched.steps import drift_in_bath, kick, rattle
from kcons.constraints.arguments import finite_number, not_negative, positive, whole_number
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.thermostats.freedom import open_directions
from kcons.torchsim.holding import AGAIN, array_of, constraints_of

#: Without other settings, as in TorchSim: tau over time step, and friction times time step.
PERIODS, FRICTION = 10.0, 0.01
#: Farther from the constraints (in TorchSim's unit) atoms are not brought onto them without a word.
FAR = 1e-3


class Integrator(NamedTuple):
    """What `torch_sim.integrate` takes: ``init(state, model, kT=...)``, then ``step(state, model, dt=..., kT=...)``."""

    init: Callable[..., Any]
    step: Callable[..., Any]


@dataclass(kw_only=True)
class RestingState(MDState):
    """State with 3 degrees of freedom less where no row knows a place in space: the center of mass rests there."""

    def get_number_of_degrees_of_freedom(self) -> torch.Tensor:
        return super().get_number_of_degrees_of_freedom() - 3 * _free(self)


@dataclass(kw_only=True)
class NoseHooverState(RestingState):
    """State of dynamics with a chain of thermostats for each system; slices and joins keep the right chains.

    Attributes
    ----------
    chain_positions, chain_momenta : torch.Tensor, shape (n_systems, chain_length)
    tau, target_kT : torch.Tensor, shape (n_systems,)
        Period of the first thermostat, and the thermal energy of the last step.
    """

    chain_positions: torch.Tensor
    chain_momenta: torch.Tensor
    tau: torch.Tensor
    target_kT: torch.Tensor

    _system_attributes = {*MDState._system_attributes, "chain_positions", "chain_momenta", "tau", "target_kT"}

    @property
    def chain(self) -> NoseHooverChain:
        """The chain in the form of TorchSim, for example for `torch_sim.nvt_nose_hoover_invariant`."""
        freedom = self.get_number_of_degrees_of_freedom()
        masses = (self.target_kT * self.tau**2)[:, None].repeat(1, self.chain_positions.shape[1])
        masses[:, 0] *= freedom
        kinetic = calc_kinetic_energy(masses=self.masses, momenta=self.momenta, system_idx=self.system_idx)
        # Functions of TorchSim write into the momenta.
        return NoseHooverChain(self.chain_positions, self.chain_momenta.clone(), masses, self.tau, kinetic, freedom)


def _start(state: SimState, model: ModelInterface, *, kT: Any, dt: Any = None, at_rest: bool | None = None) -> MDState:
    """A state with forces, on the constraints, its momenta projected, or drawn if it has none."""
    start, energy = copy.copy(state), _each(state, kT, "kT", not_negative, True)
    start.positions = _placed(state)
    masses, given = state.masses[:, None], getattr(state, "momenta", None)
    rests = given is None or isinstance(state, RestingState) if at_rest is None else at_rest
    if given is None:
        given = torch.randn(start.positions.shape, device=state.device, dtype=state.dtype, generator=start.rng)
        given = torch.sqrt(energy * masses) * given
    if rests:
        # Rows of systems that are free to move know no place in space: this leaves velocities on them.
        sums = torch.zeros((state.n_systems, 4), dtype=state.dtype, device=state.device)
        sums = sums.index_add(0, state.system_idx, torch.cat([given, masses], dim=1))
        given = given - masses * (_free(state)[:, None] * sums[:, :3] / sums[:, 3:])[state.system_idx]
    momenta = masses * constraints_of(state).batch(state).project_velocities(start.positions, given / masses)
    output = model(start)
    _check_forces(state, output["forces"])
    kind = RestingState if rests else MDState
    made = kind.from_state(start, momenta=momenta, energy=output["energy"], forces=output["forces"])
    made.store_model_extras(output)
    return made


def _placed(state: SimState) -> torch.Tensor:
    """Positions on the constraints; refuses those that somebody has moved off them."""
    batch = constraints_of(state).batch(state)
    found = batch.project_positions(state.positions, state.positions)
    batch.check()
    away = (found - state.positions).abs().amax(1)
    if bool(away.max() > FAR):
        atom = int(away.argmax())
        off = f"system {int(state.system_idx[atom])} has atom {atom} {float(away[atom]):.3g} off its constraints"
        raise InputError(f"{off}, moved since these were made; put it back, or {AGAIN}", item="state")
    return found


def _check_forces(state: SimState, forces: torch.Tensor) -> None:
    bad = (~torch.isfinite(forces).all(dim=1)).nonzero().ravel()
    if len(bad):
        atom, remedy = int(bad[0]), "look at what the model returned; the state is as before the step"
        said = f"force of atom {atom} (in system {int(state.system_idx[atom])}) is not finite: {remedy}"
        raise NonFiniteError(said, item="force", atom=atom)


def _free(state: SimState) -> torch.Tensor:
    """1 for systems whose rows know no place in space, else 0; shape (n_systems,)."""
    held, free = constraints_of(state), torch.ones(state.n_systems, dtype=torch.long, device=state.device)
    for motion, k in zip(held.motions, held.system_idx.tolist(), strict=True):
        free[k] = all(item.translation_invariant for item in motion.constraint_set.constraints)
    return free


def _each(state: SimState, value: Any, item: str, rule: Any = positive, atoms: bool = False) -> torch.Tensor:
    """A number or one for each system, shape (n_systems,), or as a column for all atoms."""
    numbers = torch.as_tensor(value, device=state.device, dtype=state.dtype)
    for extreme in torch.stack(numbers.aminmax()).tolist():
        rule(extreme, item)
    if numbers.shape not in ((), (1,), (state.n_systems,)):
        raise InputError(f"{item} has shape {tuple(numbers.shape)}; give a number or one for each system", item=item)
    numbers = numbers.expand(state.n_systems)
    return numbers[state.system_idx, None] if atoms else numbers.clone()


def _whole(step: Callable[..., Any]) -> Callable[..., Any]:
    """A step that leaves the state that it is given as it was, and gives another."""

    @functools.wraps(step)
    def made(state: MDState, model: ModelInterface, **settings: Any) -> Any:
        left = constraints_of(state).left
        if left is None or state.positions is not left[0] or state.positions._version != left[1]:
            _placed(state)
        return step(copy.copy(state), model, **settings)

    return made


def _evaluate(state: MDState, model: ModelInterface, positions: torch.Tensor) -> torch.Tensor:
    """Forces at the end of a step, at positions that are on the constraints: looked at here, once a step."""
    held = constraints_of(state)
    held.batch(state).check()
    state.positions = positions
    output = model(state)
    _check_forces(state, output["forces"])
    held.left = positions, positions._version
    state.energy, state.forces = output["energy"], output["forces"]
    state.store_model_extras(output)
    return state.forces


def _rattle(state: MDState, model: ModelInterface, *, dt: Any, kT: Any = None) -> MDState:
    batch, force = constraints_of(state).batch(state), functools.partial(_evaluate, state, model)
    given = state.positions, state.velocities, state.forces, _each(state, dt, "dt", finite_number, True)
    state.momenta = state.masses[:, None] * rattle(batch, force, *given)[1]
    return state


@_whole
def _langevin_step(state: MDState, model: ModelInterface, *, dt: Any, kT: Any, gamma: Any = None) -> MDState:
    batch, dt = constraints_of(state).batch(state), _each(state, dt, "dt", atoms=True)
    friction = FRICTION / dt if gamma is None else _each(state, gamma, "gamma", not_negative, True)
    kT = _each(state, kT, "kT", not_negative, True)
    v = kick(batch, state.positions, state.velocities, state.forces, dt)
    x, v = drift_in_bath(batch, state.positions, v, dt, (kT, friction, state.rng))
    state.momenta = state.masses[:, None] * batch.project_velocities(x, v)
    _evaluate(state, model, x)
    return state


def _nose_hoover_init(
    state: SimState, model: ModelInterface, *, kT: Any, dt: Any, tau: Any = None, chain_length: int = 3
) -> NoseHooverState:
    held, free = constraints_of(state), _free(state)
    if len(still := (3 * (state.n_atoms_per_system - free) <= held.get_removed_dof(state)).nonzero().ravel()):
        raise UnsupportedError(f"system {int(still[0])} has no degrees of freedom left; take it out of the state")
    for motion, k in zip(held.motions, held.system_idx.tolist(), strict=True):
        x = array_of(state.positions[state.system_idx == k])
        if not free[k] and len(axes := open_directions(motion, x)):
            said = f"rows of system {k} leave its total momentum conserved along {len(axes)} of three axes"
            raise UnsupportedError(f"{said}, which a Nose-Hoover chain does not sample; use kcons.torchsim.langevin")
    length, period = whole_number(chain_length, "chain_length"), PERIODS * dt if tau is None else tau
    settings = {"tau": _each(state, period, "tau"), "target_kT": _each(state, kT, "kT")}
    rest = torch.zeros((state.n_systems, length), dtype=state.dtype, device=state.device)
    made = _start(state, model, kT=kT, at_rest=True)
    return NoseHooverState.from_state(made, chain_positions=rest, chain_momenta=rest.clone(), **settings)


@_whole
def _nose_hoover_step(state: NoseHooverState, model: ModelInterface, *, dt: Any, kT: Any) -> NoseHooverState:
    state.target_kT, dt = _each(state, kT, "kT"), finite_number(dt, "dt")
    half_step = construct_nose_hoover_chain(dt, state.chain_positions.shape[1], 3, 3, state.tau).half_step
    for first in (True, False):
        momenta, chain = half_step(state.momenta, state.chain, state.target_kT, state.system_idx)
        state.momenta, state.chain_positions, state.chain_momenta = momenta, chain.positions, chain.momenta
        if first:
            _rattle(state, model, dt=dt)
    return state


#: Constant energy by RATTLE. Momenta are drawn without that of the center of mass.
nve = Integrator(_start, _whole(_rattle))
#: Langevin dynamics by geodesic BAOAB, with ``gamma`` as in TorchSim. Momenta are those before the kick, which have the
#: right temperature.
langevin = Integrator(functools.partial(_start, at_rest=False), _langevin_step)
#: Nosé-Hoover chains around RATTLE; ``tau`` and ``chain_length`` in ``init_kwargs``, as in TorchSim.
nose_hoover = Integrator(_nose_hoover_init, _nose_hoover_step)

# `torch_sim.integrate` converts settings of the integrators that are listed: from 1/ps and ps, as for its own.
for pair, name, call, unit in ((langevin, "gamma", "step", InverseTimeArg), (nose_hoover, "tau", "init", TimeArg)):
    factors = ((call, unit_factor_from_annotation(unit)),)
    INTEGRATOR_KWARG_UNITS.update({pair: {name: IntegratorKwargUnits(factors)}})  # type: ignore[dict-item]
