"""Waveforms of transmitted pulses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import unit_phasor


@dataclass(frozen=True)
class LinearFM:
    """Linear frequency-modulated pulse exp(j pi k t^2) for |t| < duration / 2.

    The chirp rate is k = direction * bandwidth / duration. The echo of a target at range R starts
    at the fast time 2 R / c.

    Args:
        bandwidth_hz: Swept bandwidth in Hz.
        duration_s: Length of the pulse in seconds.
        direction: +1 for an up-chirp, -1 for a down-chirp.

    Raises:
        ValueError: If the bandwidth or the duration is not positive, or `direction` is neither +1
            nor -1.
    """

    bandwidth_hz: float
    duration_s: float
    direction: int = 1

    def __post_init__(self) -> None:
        if not (self.bandwidth_hz > 0 and self.duration_s > 0 and self.direction in (-1, 1)):
            raise ValueError(f"a pulse needs bandwidth_hz > 0, duration_s > 0 and direction +1 or -1, got {self}")

    @property
    def rate_hz_s(self) -> float:
        """Chirp rate k in Hz/s, negative for a down-chirp."""
        return self.direction * self.bandwidth_hz / self.duration_s

    def n_samples(self, sampling_hz: float) -> int:
        """Return the number of samples of the pulse at a sampling rate, at least 1.

        Raises:
            ValueError: If the rate is not positive and finite.
        """
        if not 0 < sampling_hz < math.inf:
            raise ValueError(f"sampling_hz must be positive and finite, got {sampling_hz}")
        return max(1, round(self.duration_s * sampling_hz))

    def samples(
        self, sampling_hz: float, dtype: torch.dtype = torch.complex128, device: torch.device | str | None = None
    ) -> Tensor:
        """Return the samples of the pulse, from its leading edge on.

        Args:
            sampling_hz: Complex sampling rate in Hz.
            dtype: Complex dtype of the result; the phase is formed in float64.
            device: Device of the result.

        Returns:
            The sampled pulse, shape (n_samples,), complex, of amplitude 1.
        """
        n = self.n_samples(sampling_hz)
        t = (torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2) / sampling_hz
        return unit_phasor(0.5 * self.rate_hz_s * t.square(), dtype)

    def spectrum(self, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
        """Return the FFT of the zero-padded pulse, whose leading edge is at sample 0.

        Args:
            n: Number of samples of a range line.
            sampling_hz: Complex sampling rate in Hz.
            device: Device of the result.

        Returns:
            The spectrum in FFT order, shape (n,), complex128.

        Raises:
            ValueError: If a range line of n samples is shorter than the pulse.
        """
        if n < self.n_samples(sampling_hz):
            raise ValueError(
                f"a line of {n} samples does not hold the pulse of {self.n_samples(sampling_hz)} samples; "
                "record longer lines or shorten the pulse"
            )
        return torch.fft.fft(self.samples(sampling_hz, device=device), n)
