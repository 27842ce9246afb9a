"""Batched optimisers that the estimators share."""

from torchsar.optim.scalar import gradient_minimum, grid_minimum, parabola_minimum

__all__ = ["gradient_minimum", "grid_minimum", "parabola_minimum"]
