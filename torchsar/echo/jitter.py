"""A converter with periodic jitter, and its pilot record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, linear_phasor, unit_phasor


def sample_unevenly(x: Tensor, offset_samples: Tensor) -> Tensor:
    """Samples of x at the instants n + e[n mod M].

    x: (..., pulse, range), taken as band-limited and periodic; offset_samples: (M,) or (..., M).
    """
    n, m = x.shape[-1], offset_samples.shape[-1]
    spectrum = torch.fft.fft(x)
    y = torch.empty_like(x)
    for i in range(min(m, n)):
        turns = offset_samples[..., i].to(torch.float64) / n
        shift = torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, x.dtype), dim=-1)
        y[..., i::m] = torch.fft.ifft(spectrum * shift[..., None, :])[..., i::m]
    return y


@dataclass(frozen=True)
class PeriodicJitter:
    """Sample n of every line is taken at n + e[n mod M]; a pilot tone through the same converter is
    recorded in aux["pilot"].

    offset_samples: e_0 .. e_{M-1}, numbers or a tensor (..., M) with one row per trial. Only
    differences can be seen in a pilot: choose offsets of mean zero (or e_0 = 0, with an estimator
    of that origin) where images are compared in position. pilot_cycles: frequency of the tone in
    cycles per sample; pilot_snr_db: tone power over noise variance, None for no noise;
    pilot_samples: length, 0 for no record.
    """

    offset_samples: Sequence[float] | Tensor
    pilot_cycles: float = 0.2137
    pilot_samples: int = 4096
    pilot_snr_db: float | None = 60.0

    def __post_init__(self) -> None:
        if not len(self.offset_samples) or self.pilot_samples < 0:
            raise ValueError(
                "jitter needs at least one offset and pilot_samples of 0 or more, got offsets "
                f"{self.offset_samples} and {self.pilot_samples} samples"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        data = recording.signal.data
        offsets = torch.as_tensor(self.offset_samples, dtype=torch.float64, device=data.device)
        instants = torch.arange(offsets.shape[-1], device=data.device) + offsets
        if not bool((torch.cat([instants, instants[..., :1] + offsets.shape[-1]], -1).diff(dim=-1) > 0).all()):
            raise ValueError(
                f"jitter offsets {offsets.tolist()} make sample instants coincide or cross; keep "
                "neighbouring offsets less than one sample apart"
            )
        impaired = replace(recording, signal=recording.signal.with_data(sample_unevenly(data, offsets)))
        if self.pilot_samples:
            impaired = replace(impaired, aux={**impaired.aux, "pilot": self.pilot(offsets, draws, data)})
        return impaired, {
            "offset_samples": offsets,
            "pilot_cycles": torch.tensor(self.pilot_cycles, dtype=torch.float64),
        }

    def pilot(self, offsets: Tensor, draws: Draws, like: Tensor) -> Tensor:
        """The recorded tone, (..., pilot_samples), with a random phase at its start."""
        index = torch.arange(self.pilot_samples, device=like.device)
        turns = self.pilot_cycles * (index + offsets[..., index % offsets.shape[-1]])
        tone = unit_phasor(turns + draws.uniform("pilot.phase", device=like.device)[..., None], like.dtype)
        if self.pilot_snr_db is None:
            return tone
        return tone + 10 ** (-self.pilot_snr_db / 20) * draws.normal(
            "pilot.noise", (self.pilot_samples,), like.dtype, like.device
        )
