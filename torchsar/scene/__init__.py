"""The truth: targets, path, beam."""

from torchsar.scene.path import AlwaysLit, Antenna, Beam, Dwell, Hyperbola, Parabola, Path
from torchsar.scene.targets import Points, RandomPoints, Scatterers, Scene, Speckle, Together
from torchsar.scene.world import StripmapWorld

__all__ = [
    "AlwaysLit",
    "Antenna",
    "Beam",
    "Dwell",
    "Hyperbola",
    "Parabola",
    "Path",
    "Points",
    "RandomPoints",
    "Scatterers",
    "Scene",
    "Speckle",
    "StripmapWorld",
    "Together",
]
