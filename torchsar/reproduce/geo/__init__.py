"""Remote Sens. 2020, 12, 1703: moving targets of a bistatic radar with several azimuth channels."""

from __future__ import annotations

from torchsar.reproduce.geo import reconstruction, sensor, targets, velocity
from torchsar.reproduce.item import Item, Paper, in_order

__all__ = ["PAPER"]
__dir__ = __all__.copy

PAPER = Paper(
    "geo",
    "Azimuth multichannel reconstruction for moving targets in GEO-SA-BiSAR, Remote Sens. 2020, 12, 1703",
    in_order(
        Item("Figure 1", "geometry of the observation", kind="diagram"),
        Item("Figure 9", "flow of the reconstruction", kind="diagram"),
        Item("Figure 13", "flow of the imaging of moving targets", kind="diagram"),
        *(item for part in (sensor, targets, reconstruction, velocity) for item in part.ITEMS),
    ),
)
