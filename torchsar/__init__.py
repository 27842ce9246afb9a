"""Synthetic aperture radar and ladar in torch: stages that process batches of complex tensors.

    recording = torchsar.io.read_stripmap("raw.npz")
    chain = torchsar.Chain(focus=torchsar.focus.OmegaK(recording.radar))
    image = chain(recording)

Only torch and numpy are required. `torchsar.plot` also needs matplotlib, and `torchsar.study` the
packages of the extra `study`. Every subpackage is imported on first use, so that the command line
answers at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchsar import compensate, core, echo, focus, io, metrics, multichannel, radar, repair, scene
    from torchsar.core import (
        Axis,
        Chain,
        Draws,
        Estimate,
        Outcome,
        Recording,
        Signal,
        Stage,
        Trace,
        Truth,
        use,
    )
    from torchsar.study.memory import keep_freed_memory

__version__ = "0.1.0"
# subpackages outside `__all__`, because some need packages that are not always installed
_ON_REQUEST = ("data", "datasets", "optim", "plot", "reproduce", "study")

__all__ = [
    "Axis",
    "Chain",
    "Draws",
    "Estimate",
    "Outcome",
    "Recording",
    "Signal",
    "Stage",
    "Trace",
    "Truth",
    "compensate",
    "core",
    "echo",
    "focus",
    "io",
    "keep_freed_memory",
    "metrics",
    "multichannel",
    "radar",
    "repair",
    "scene",
    "use",
]


def __getattr__(name: str) -> Any:
    if name in __all__ or name in _ON_REQUEST:
        if name == "keep_freed_memory":
            return importlib.import_module("torchsar.study.memory").keep_freed_memory
        core = importlib.import_module("torchsar.core")
        return getattr(core, name) if name in core.__all__ else importlib.import_module(f"torchsar.{name}")
    raise AttributeError(f"module 'torchsar' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *_ON_REQUEST]
