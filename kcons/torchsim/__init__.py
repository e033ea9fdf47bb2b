"""TorchSim: constraints on batches of systems, for machine-learned potentials.

`hold` puts what is to be held on a `SimState`. `nve`, `langevin` and `nose_hoover` are integrators for
`torch_sim.integrate`, in place of its own, which tell constraints the positions but not the momenta. Optimizers,
slices, joins, autobatching, reporters and trajectories of TorchSim work as they are. Units are TorchSim's.

- `holding`: what is held by name, the object on a state that TorchSim calls, and a report
- `dynamics`: constant energy, Langevin dynamics, Nosé-Hoover chains
"""

from kcons.errors import with_extra

try:
    from kcons.torchsim.dynamics import Integrator, NoseHooverState, langevin, nose_hoover, nve
    from kcons.torchsim.holding import Constraints, hold, report
except ModuleNotFoundError as error:
    raise with_extra(error, "kcons.torchsim") from error

__all__ = ["Constraints", "Integrator", "NoseHooverState", "hold", "langevin", "nose_hoover", "nve", "report"]
