"""Figures of images, curves and parameter sweeps; the only package that imports matplotlib.

Each function that draws takes signals or arrays and returns a matplotlib Figure, or a list of
Figures with one for each panel. A page can therefore set the panels side by side or below each
other. `save` writes a Figure or such a list into one file, and notebooks show both as pictures.
"""

try:
    import matplotlib as matplotlib
except ImportError as error:
    raise ImportError("torchsar.plot needs matplotlib: pip install 'torchsar-lab[study]'") from error

from torchsar.core.kinds import check_kinds
from torchsar.plot.curves import alike, curves, marks, panels, scatterers, trade
from torchsar.plot.images import (
    boxes,
    contours,
    decibel,
    image,
    images,
    level,
    overlays,
    quicklook,
    response,
    short_time_spectrum,
    span,
    within,
)
from torchsar.plot.style import array, axis_label, name_and_unit, save
from torchsar.plot.sweeps import error_curves, heat_map

__all__ = [
    "alike",
    "array",
    "axis_label",
    "boxes",
    "contours",
    "curves",
    "decibel",
    "error_curves",
    "heat_map",
    "image",
    "images",
    "level",
    "marks",
    "name_and_unit",
    "overlays",
    "panels",
    "quicklook",
    "response",
    "save",
    "scatterers",
    "short_time_spectrum",
    "span",
    "trade",
    "within",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
