"""Optimisers that minimise one cost function per trial, for all trials at once."""

from torchsar.optim.descent import Descent, adam, lbfgs
from torchsar.optim.evolution import differential_evolution
from torchsar.optim.genetic import genetic
from torchsar.optim.grid import grid_search
from torchsar.optim.newton import newton
from torchsar.optim.population import Searched
from torchsar.optim.scalar import gradient_minimum, grid_minimum, parabola_minimum

__all__ = [
    "Descent",
    "Searched",
    "adam",
    "differential_evolution",
    "genetic",
    "gradient_minimum",
    "grid_minimum",
    "grid_search",
    "lbfgs",
    "newton",
    "parabola_minimum",
]
