"""Transmitted pulses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import unit_phasor


@dataclass(frozen=True)
class LinearFM:
    """Linear frequency-modulated pulse exp(j pi k t^2), |t| < duration/2, with chirp rate k =
    direction * bandwidth / duration.

    direction: +1 up-chirp, -1 down-chirp. The echo of a target at range R starts at fast time 2 R /
    c.
    """

    bandwidth_hz: float
    duration_s: float
    direction: int = 1

    def __post_init__(self) -> None:
        if not (self.bandwidth_hz > 0 and self.duration_s > 0 and self.direction in (-1, 1)):
            raise ValueError(f"a pulse needs bandwidth > 0, duration > 0 and direction +1 or -1, got {self}")

    @property
    def rate_hz_s(self) -> float:
        return self.direction * self.bandwidth_hz / self.duration_s

    def n_samples(self, sampling_hz: float) -> int:
        """Samples of the pulse at this sampling rate."""
        return max(1, round(self.duration_s * sampling_hz))

    def samples(
        self, sampling_hz: float, dtype: torch.dtype = torch.complex128, device: torch.device | str | None = None
    ) -> Tensor:
        """The sampled pulse from its leading edge on, (n_samples,)."""
        n = self.n_samples(sampling_hz)
        t = (torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2) / sampling_hz
        return unit_phasor(0.5 * self.rate_hz_s * t.square(), dtype)

    def spectrum(self, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
        """FFT of the zero-padded sampled pulse, complex128 (n,), in FFT order, leading edge at
        sample 0.
        """
        if n < self.n_samples(sampling_hz):
            raise ValueError(
                f"a line of {n} samples does not hold the pulse of {self.n_samples(sampling_hz)}; "
                "record longer lines or shorten the pulse"
            )
        return torch.fft.fft(self.samples(sampling_hz, device=device), n)
