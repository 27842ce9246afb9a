"""Waveforms of transmitted pulses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import unit_phasor


@dataclass(frozen=True)
class LinearFM:
    """Linear frequency-modulated pulse exp(j pi k (t - T / 2)^2) for 0 <= t < T.

    >>> from torchsar import radar
    >>> pulse = radar.LinearFM(bandwidth_hz=40e6, duration_s=0.5e-6)
    >>> round(pulse.rate_hz_s / 1e12), pulse.samples(sampling_hz=50e6).shape
    (80, torch.Size([25]))

    T is the duration, and k = direction * bandwidth / duration is the chirp rate. The time t counts
    from the leading edge of the pulse, so that the frequency passes zero at t = T / 2. The first
    sample lies exactly on the leading edge: sample i is taken at t = i / fs, where fs is the
    sampling rate. The pulse has all samples with t < T, and T fs need not be a whole number. The
    leading edge of the echo of a target at range R arrives at the fast time 2 R / c.

    Args:
        bandwidth_hz: Swept bandwidth in Hz.
        duration_s: Length of the pulse in seconds.
        direction: +1 for an up-chirp, -1 for a down-chirp.

    Raises:
        ValueError: If the bandwidth or the duration is not positive and finite, or `direction` is
            neither +1 nor -1.
    """

    bandwidth_hz: float
    duration_s: float
    direction: int = 1

    def __post_init__(self) -> None:
        if not (0 < self.bandwidth_hz < math.inf and 0 < self.duration_s < math.inf and self.direction in (-1, 1)):
            raise ValueError(
                f"a pulse needs bandwidth_hz and duration_s above 0 and finite, and direction +1 or -1, got {self}"
            )

    @property
    def rate_hz_s(self) -> float:
        """Chirp rate k in Hz/s, negative for a down-chirp."""
        return self.direction * self.bandwidth_hz / self.duration_s

    def n_samples(self, sampling_hz: float) -> int:
        """Return the number of samples of a pulse whose leading edge lies on a sample, at least 1.

        Args:
            sampling_hz: Complex sampling rate fs in Hz.

        Returns:
            Number of samples i = 0, 1, ... with i / fs < duration: the product of duration and fs,
            rounded up.

        Raises:
            ValueError: If the rate is not positive and finite.
        """
        if not 0 < sampling_hz < math.inf:
            raise ValueError(f"sampling_hz must be positive and finite, got {sampling_hz}")
        # a product above a whole number only by rounding counts as this number
        return max(1, math.ceil(self.duration_s * sampling_hz * (1 - 1e-12)))

    def samples(
        self, sampling_hz: float, dtype: torch.dtype = torch.complex128, device: torch.device | str | None = None
    ) -> Tensor:
        """Return the samples of the pulse, the first of which lies on its leading edge.

        Args:
            sampling_hz: Complex sampling rate in Hz.
            dtype: Complex dtype of the result; the phase is formed in float64.
            device: Device of the result.

        Returns:
            The sampled pulse, shape (n_samples,), complex, of amplitude 1.
        """
        n = self.n_samples(sampling_hz)
        t = torch.arange(n, dtype=torch.float64, device=device) / sampling_hz - self.duration_s / 2
        return unit_phasor(0.5 * self.rate_hz_s * t.square(), dtype)

    def refuse_aliased(self, sampling_hz: float) -> None:
        """Raise ValueError if the bandwidth exceeds a complex sampling rate in Hz."""
        if self.bandwidth_hz > sampling_hz:
            raise ValueError(
                f"pulse bandwidth {self.bandwidth_hz:g} Hz exceeds the complex sampling rate "
                f"{sampling_hz:g} Hz; sample at least as fast as the bandwidth"
            )

    def _refuse_short(self, n: int, sampling_hz: float) -> None:
        """Raise ValueError for range lines shorter than the pulse."""
        if n < self.n_samples(sampling_hz):
            raise ValueError(
                f"a line of {n} samples does not hold the pulse of {self.n_samples(sampling_hz)} samples; "
                "record longer lines or shorten the pulse"
            )

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
        self._refuse_short(n, sampling_hz)
        return torch.fft.fft(self.samples(sampling_hz, device=device), n)

    def band_spectrum(self, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
        """Return the spectrum of the pulse before sampling, in the band of the sampling rate.

        The edges of an echo lie anywhere between samples. The spectrum of its samples therefore
        differs from echo to echo, because the pulse, which begins and ends abruptly, has
        frequencies beyond the sampled band that alias. `spectrum` is that of an echo whose leading
        edge lies on a sample. This spectrum is the mean over all positions of the edge, and
        range compression with it finds each of them without bias.

        Args:
            n: Number of samples of a range line.
            sampling_hz: Complex sampling rate in Hz.
            device: Device of the result.

        Returns:
            The spectrum in FFT order, scaled like `spectrum`, shape (n,), complex128.

        Raises:
            ValueError: If a range line of n samples is shorter than the pulse.
        """
        self._refuse_short(n, sampling_hz)
        # by choice: number of fine samples per sample, from which the spectrum is computed
        finer, duration = 16, self.duration_s
        rate = finer * sampling_hz
        t = torch.arange(math.ceil(duration * rate * (1 - 1e-12)) + 1, dtype=torch.float64, device=device) / rate
        # weight of a fine sample: length of the pulse within half a fine step on both sides
        inside = (t + 0.5 / rate).clamp(max=duration) - (t - 0.5 / rate).clamp(min=0)
        fine = unit_phasor(0.5 * self.rate_hz_s * (t - duration / 2).square(), torch.complex128) * inside.clamp(min=0)
        whole = torch.fft.fft(fine, finer * n) * sampling_hz
        band = torch.cat([whole[: n - n // 2], whole[whole.numel() - n // 2 :]])
        # corrects the attenuation of the band edges by averaging over a fine step
        return band / torch.sinc(torch.fft.fftfreq(n, dtype=torch.float64, device=device) / finer)
