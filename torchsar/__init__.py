"""Synthetic aperture radar and ladar in torch: stages that process batches of complex tensors.

    recording = torchsar.io.read_stripmap("raw.npz")
    chain = torchsar.Chain(focus=torchsar.focus.OmegaK(recording.radar))
    image = chain(recording)

Only torch and numpy are required. `torchsar.plot` also needs matplotlib, and `torchsar.study` the
packages of the extra `study`; both are imported on first use.
"""

from __future__ import annotations

import importlib
from types import ModuleType

from torchsar import compensate, core, echo, focus, io, metrics, multichannel, radar, repair, scene
from torchsar.core import Axis, Chain, Draws, Estimate, Recording, Signal, Stage, Trace, Truth, use

__version__ = "0.1.0"
_ON_FIRST_USE = ("plot", "study")


def __getattr__(name: str) -> ModuleType:
    if name in _ON_FIRST_USE:
        return importlib.import_module(f"torchsar.{name}")
    raise AttributeError(f"module 'torchsar' has no attribute {name!r}")


__all__ = [
    "Axis",
    "Chain",
    "Draws",
    "Estimate",
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
    "metrics",
    "multichannel",
    "radar",
    "repair",
    "scene",
    "use",
]
