"""Monte Carlo sweeps: `sweep(trial, grid, ...)` runs any callable over a grid of parameters,
vectorised, resumable, in one process or many.
"""

from torchsar.study.montecarlo.loop import Interrupted, Stop, sweep
from torchsar.study.montecarlo.record import Difference, Record, differences
from torchsar.study.montecarlo.store import read_sweep

__all__ = ["Difference", "Interrupted", "Record", "Stop", "differences", "read_sweep", "sweep"]
__dir__ = __all__.copy
