"""Experiments that are defined by configs, which are YAML files.

This package needs optional dependencies: pip install 'torchsar-lab[study]'. The function
`torchsar.study.sweep(trial, grid, ...)` runs any Python function over a grid of parameters, without
a config; see `torchsar.study.montecarlo`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchsar.study.montecarlo import Difference, Interrupted, Record, Stop, differences, read_sweep, sweep

__all__ = ["Difference", "Interrupted", "Record", "Stop", "differences", "read_sweep", "sweep"]
__dir__ = __all__.copy


def __getattr__(name: str) -> Any:
    """Import `montecarlo` on first use, because zarr and other packages take a second to import."""
    if name in __all__:
        from torchsar.study import montecarlo

        return getattr(montecarlo, name)
    raise AttributeError(f"module 'torchsar.study' has no attribute {name!r}")
