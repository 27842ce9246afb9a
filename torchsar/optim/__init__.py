"""Optimisers that minimise one cost function per trial, for all trials at once.

================================  ===================================
cost function                     what to use
================================  ===================================
smooth, many unknowns             `lbfgs`
smooth, few unknowns              `newton`
noisy, or rough on a small scale  `adam`
several minima, few unknowns      `grid_search`
several minima, within bounds     `differential_evolution`, `genetic`
derivatives of a minimum          `implicit`
================================  ===================================

The first three return a `Descent`, the searches a `Searched`.
"""

from torchsar.core.kinds import check_kinds
from torchsar.optim.descent import Descent, adam, lbfgs
from torchsar.optim.newton import implicit, newton
from torchsar.optim.search import Searched, differential_evolution, genetic, grid_search

__all__ = [
    "Descent",
    "Searched",
    "adam",
    "differential_evolution",
    "genetic",
    "grid_search",
    "implicit",
    "lbfgs",
    "newton",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
