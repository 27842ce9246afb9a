"""Optimisers that minimise one cost function per trial, for all trials at once."""

from torchsar.optim.descent import Descent, adam, lbfgs
from torchsar.optim.newton import newton
from torchsar.optim.search import Searched, differential_evolution, genetic, grid_search

__all__ = [
    "Descent",
    "Searched",
    "adam",
    "differential_evolution",
    "genetic",
    "grid_search",
    "lbfgs",
    "newton",
]
__dir__ = __all__.copy
