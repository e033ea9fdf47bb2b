"""Populations that grow under constraints (notes sections 3 and 4.3).

- `model`: models of growth, the thermodynamics of their species, and what they are held to
- `constrained`: a model with what is held, and its trajectories; hypercycles
"""

from kcons.models.growth import constrained, model
from kcons.models.growth.constrained import *
from kcons.models.growth.model import *

__all__ = constrained.__all__ + model.__all__
