"""Recorded data in, images out."""

from torchsar.io.recorded import read_stripmap, recording_from_arrays

__all__ = ["read_stripmap", "recording_from_arrays"]
