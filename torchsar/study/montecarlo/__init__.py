"""Monte Carlo sweeps: `sweep(trial, grid, ...)` runs any callable over a grid of parameters,
vectorised, resumable, in one process or many.
"""

from torchsar.study.montecarlo.compare import Difference, differences
from torchsar.study.montecarlo.loop import Interrupted, sweep
from torchsar.study.montecarlo.record import Record
from torchsar.study.montecarlo.stopping import Stop
from torchsar.study.montecarlo.store import read_sweep

__all__ = ["Difference", "Interrupted", "Record", "Stop", "differences", "read_sweep", "sweep"]
