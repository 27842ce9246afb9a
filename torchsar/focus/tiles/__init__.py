"""Images from phase histories of any path, by tiles that are imaged in polar format."""

from torchsar.focus.tiles.plan import TilePlan, image_tiles

__all__ = ["TilePlan", "image_tiles"]
__dir__ = __all__.copy
