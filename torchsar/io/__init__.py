"""Readers of recorded radar data in `.npz` files."""

from torchsar.io.inverse import read_inverse
from torchsar.io.path import read_path
from torchsar.io.recorded import read_stripmap

__all__ = ["read_inverse", "read_path", "read_stripmap"]
