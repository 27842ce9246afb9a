"""Range compression of the full chirps of several channels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage
from torchsar.focus import range_compress
from torchsar.focus.reference import REFERENCES
from torchsar.radar import BistaticRadar


class CompressChannels(Stage):
    """Range compression with the transmitted pulse; a unit echo has a unit peak at its range.

    An echo whose pulse is cut by an end of the range line is compressed with the samples that
    remain.

    Args:
        radar: Radar parameters.
        reference: Reference spectrum "matched", "flat" or "phase", see `focus.RangeCompress`.
            "flat" gives an exactly rectangular band and thus the response of data that are
            simulated directly in range-compressed form.

    Raises:
        ValueError: If `reference` is unknown.
    """

    works_on = ("channel", "pulse", "range")

    def __init__(self, radar: BistaticRadar, reference: str = "matched") -> None:
        super().__init__()
        if reference not in REFERENCES:
            raise ValueError(f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}")
        self.radar, self.reference = radar, reference

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the reference spectrum of compression for lines of n samples, complex128 (n,)."""
        return REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)

    def forward(self, signal: Signal) -> Signal:
        """Compress full chirps (channel, pulse, range) in range; the axes stay the same."""
        return signal.with_data(range_compress(signal.data, self.spectrum(signal.data.shape[-1], signal.data.device)))
