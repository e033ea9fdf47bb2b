"""Models for TorchSim: drops of TIP3P water, and copies of butane with springs; states of both."""

from __future__ import annotations

import numpy as np
import torch
import torch_sim as ts
from ase.build import molecule
from torch_sim.models.interface import ModelInterface
from torch_sim.units import MetalUnits

FS = 1e-3 * MetalUnits.time
K = float(MetalUnits.temperature)
WATER = np.array([[0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]])
COULOMB = 14.39964


class Model(ModelInterface):
    """A model whose forces are the gradient of `energies`."""

    def __init__(self, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self._device, self._dtype = torch.device("cpu"), dtype
        self._compute_forces, self._compute_stress, self._memory_scales_with = True, False, "n_atoms"
        self._known = None

    def forward(self, state, **_):
        with torch.enable_grad():
            x = state.positions.detach().requires_grad_()
            energies = self.energies(x, state.system_idx, state.n_systems)
            (gradient,) = torch.autograd.grad(energies.sum(), x)
        return {"energy": energies.detach(), "forces": -gradient}

    def tables(self, system_idx):
        """What `pairs_of` says of each system, all atoms numbered together."""
        if self._known is None or not torch.equal(self._known[0], system_idx):
            sizes = torch.bincount(system_idx)
            found = [self.pairs_of(n) for n in sizes.tolist()]
            starts = (torch.cumsum(sizes, 0) - sizes).tolist()
            joined = [
                torch.cat([part + a for part, a in zip(parts, starts, strict=True)], 1)
                for parts in zip(*found, strict=True)
            ]
            self._known = system_idx.clone(), joined
        return self._known[1]


def summed(values, systems, n):
    return torch.zeros(n, dtype=values.dtype).index_add(0, systems, values)


class Drops(Model):
    """TIP3P without a cutoff, kept together by a soft wall at 8 angstrom from the middle."""

    def pairs_of(self, n):
        pairs = torch.triu_indices(n, n, 1)
        pairs = pairs[:, pairs[0] // 3 != pairs[1] // 3]
        return pairs, pairs[:, (pairs % 3 == 0).all(0)]

    def energies(self, x, systems, n):
        (i, j), (a, b) = self.tables(systems)
        charge = torch.tensor([-0.834, 0.417, 0.417], dtype=x.dtype).repeat(len(x) // 3)
        energy = summed(COULOMB * charge[i] * charge[j] / (x[i] - x[j]).norm(dim=1), systems[i], n)
        six = (3.1507 / (x[a] - x[b]).norm(dim=1)) ** 6
        energy = energy + summed(4 * 0.0066 * (six * six - six), systems[a], n)
        oxygen, of = x[::3], systems[::3]
        middle = torch.zeros((n, 3), dtype=x.dtype).index_add(0, of, oxygen) / torch.bincount(of)[:, None]
        return energy + summed(0.05 * torch.relu((oxygen - middle[of]).norm(dim=1) - 8.0) ** 2, of, n)


class Free(Drops):
    """No forces."""

    def energies(self, x, systems, n):
        return torch.zeros(n, dtype=x.dtype) + 0.0 * x.sum()


class WithStress(Drops):
    """A stress of 0."""

    def forward(self, state, **_):
        return {**super().forward(state), "stress": torch.zeros((state.n_systems, 3, 3), dtype=state.dtype)}


class Butanes(Model):
    """Springs between atoms one and two bonds apart, Lennard-Jones between the others, and torsions."""

    def __init__(self, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(dtype)
        atoms = molecule("trans-butane")
        x = torch.as_tensor(atoms.positions)
        apart = (x[:, None] - x).norm(dim=2)
        heavy = torch.as_tensor(atoms.numbers > 1)
        near = apart < torch.where(heavy[:, None] & heavy, 1.7, 1.2)
        bonded = near & ~torch.eye(len(x), dtype=torch.bool)
        second = (bonded.float() @ bonded.float() > 0) & ~bonded
        upper = torch.triu(torch.ones_like(bonded), 1)
        self.first, self.second = ((part & upper).nonzero().T for part in (bonded, second))
        self.rest = (upper & ~bonded & ~second).nonzero().T
        size = torch.as_tensor(np.where(atoms.numbers > 1, 1.4, 0.8))
        self.sizes = (size[self.rest[0]] + size[self.rest[1]]).to(dtype)
        self.lengths = [apart[pair[0], pair[1]].to(dtype) for pair in (self.first, self.second)]

    def pairs_of(self, n):
        return self.first, self.second, self.rest

    def energies(self, x, systems, n):
        *springs, (a, b) = self.tables(systems)
        energy = torch.zeros(n, dtype=x.dtype)
        for (i, j), lengths, strength in zip(springs, self.lengths, (25.0, 6.0), strict=True):
            stretch = (x[i] - x[j]).norm(dim=1) - lengths.repeat(n)
            energy = energy + summed(0.5 * strength * stretch**2, systems[i], n)
        six = (self.sizes.repeat(n) / (x[a] - x[b]).norm(dim=1)) ** 6
        return energy + summed(4 * 0.002 * (six * six - six), systems[a], n)


def drop(n, rng=0, dtype=torch.float64):
    """`n` waters of TIP3P's shape on a grid, turned at random."""
    random = np.random.default_rng(rng)
    side = int(np.ceil(n ** (1 / 3)))
    grid = 3.1 * np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)[:n]
    turns = np.linalg.qr(random.normal(size=(n, 3, 3)))[0]
    x = (np.einsum("nij,kj->nki", turns, WATER) + grid[:, None]).reshape(-1, 3)
    return state_of(x, [8, 1, 1] * n, np.tile([15.999, 1.008, 1.008], n), dtype)


def butane(dtype=torch.float64):
    atoms = molecule("trans-butane")
    return state_of(atoms.positions, atoms.numbers, atoms.get_masses(), dtype)


def state_of(x, numbers, masses, dtype=torch.float64, cell=None):
    return ts.SimState(
        positions=torch.as_tensor(x, dtype=dtype),
        masses=torch.as_tensor(masses, dtype=dtype),
        cell=(100 * torch.eye(3, dtype=dtype) if cell is None else torch.as_tensor(cell, dtype=dtype).mT)[None],
        pbc=cell is not None,
        atomic_numbers=torch.as_tensor(np.array(numbers)),
    )


def total_energy(state):
    kinetic = ts.calc_kinetic_energy(masses=state.masses, momenta=state.momenta, system_idx=state.system_idx)
    return state.energy + kinetic


def off(state):
    """The worst |sigma| of each system, by the engine on arrays."""
    (held,) = state.constraints
    worst = np.full(state.n_systems, np.nan)
    for motion, k in zip(held.motions, held.system_idx.tolist(), strict=True):
        x = state.positions[state.system_idx == k].double().numpy()
        worst[k] = np.abs(motion.constraint_set.value(x)).max()
    return worst
