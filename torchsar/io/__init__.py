"""Recorded data in, images out."""

from torchsar.io.recorded import read_stripmap

__all__ = ["read_stripmap"]
