"""Remote Sens. 2024, 16, 793: synthetic aperture ladar with a triangular sweep."""

from __future__ import annotations

from torchsar.reproduce.item import Item, Paper, in_order
from torchsar.reproduce.sal import ground, letter, points

__all__ = ["PAPER"]
__dir__ = __all__.copy

PAPER = Paper(
    "sal",
    "SAL motion compensation by segmented interference of triangular sweeps, Remote Sens. 2024, 16, 793",
    in_order(
        Item("Figure 1", "structure of the system", "diagram"),
        Item("Figure 3", "flow of the processing", "diagram"),
        Item("Figure 13", "geometry of the observation", "diagram"),
        Item("Figure 14", "the instrument, the laboratory and the target", "photograph"),
        *points.ITEMS,
        *letter.ITEMS,
        *ground.ITEMS,
    ),
)
