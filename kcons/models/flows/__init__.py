"""Dynamical systems as flows (notes sections 1 to 3).

- `flow`: a flow and its phase-space volume; from a Lagrangian to Hamilton's equations
- `linear`: linear flows: eigenvalues as far as they can be told, Jordan form, stability; where a flow rests
- `known_flows`: flows with known solutions
"""

from kcons.models.flows import flow, known_flows, linear
from kcons.models.flows.flow import *
from kcons.models.flows.known_flows import *
from kcons.models.flows.linear import *

__all__ = flow.__all__ + known_flows.__all__ + linear.__all__
