"""Batched optimisers that the estimators share."""

from torchsar.optim.descent import Descent, adam, lbfgs
from torchsar.optim.scalar import gradient_minimum, grid_minimum, parabola_minimum

__all__ = ["Descent", "adam", "gradient_minimum", "grid_minimum", "lbfgs", "parabola_minimum"]
