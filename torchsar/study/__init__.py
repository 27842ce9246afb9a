"""Experiments from a config: run, sweep, judge, store and report. Needs the extra `study`.

From a script: `torchsar.study.sweep(trial, grid, ...)` runs any function over a grid of parameters
(torchsar.study.montecarlo).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchsar.study.montecarlo import Difference, Interrupted, Record, Stop, differences, read_sweep, sweep

__all__ = ["Difference", "Interrupted", "Record", "Stop", "differences", "read_sweep", "sweep"]


def __getattr__(name: str) -> Any:
    """The names above on first use: zarr and the rest take a second to import."""
    if name in __all__:
        from torchsar.study import montecarlo

        return getattr(montecarlo, name)
    raise AttributeError(f"module 'torchsar.study' has no attribute {name!r}")
