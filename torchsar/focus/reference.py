"""Range compression and the reference spectra that it uses."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, real_dtype
from torchsar.radar import LinearFM, StripmapRadar


def matched_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Conjugate pulse spectrum in FFT order, complex128 (n,), scaled so that a unit echo compresses
    to a unit peak.
    """
    spectrum = pulse.spectrum(n, sampling_hz, device)
    return spectrum.conj() * (n / spectrum.abs().square().sum())


def flat_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Inverse pulse spectrum inside the pulse bandwidth and zero outside, complex128 (n,): an
    exactly rectangular band.

    The response is a pure sinc (PSLR -13.26 dB) where the matched one carries the Fresnel ripple of
    a short pulse; noise outside the band is removed. Costs 0.1 to 0.3 dB of signal-to-noise ratio
    at usual time-bandwidth products.
    """
    spectrum = pulse.spectrum(n, sampling_hz, device)
    frequency = torch.fft.fftfreq(n, 1 / sampling_hz, dtype=torch.float64, device=device)
    inside = frequency.abs() <= pulse.bandwidth_hz / 2
    power = spectrum.abs().square()
    return torch.where(inside, spectrum.conj() / torch.where(inside, power, 1), 0) * (n / inside.sum())


def phase_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Conjugate phase of the pulse spectrum, modulus constant over the whole sampled band,
    complex128 (n,), unit peak for a unit echo.

    Keeps what little signal there is beyond the nominal band edges: a few percent sharper than
    matched where the noise allows it.
    """
    spectrum = pulse.spectrum(n, sampling_hz, device)
    size = spectrum.abs().clamp_min(torch.finfo(torch.float64).tiny)
    return spectrum.conj() / size * (n / size.sum())


REFERENCES = {"matched": matched_reference, "flat": flat_reference, "phase": phase_reference}


def range_compress(raw: Tensor, reference: Tensor) -> Tensor:
    """Circular convolution along the last dim.

    raw: (..., pulse, range); reference: spectrum in FFT order, (range,) or (..., 1, range).
    """
    return torch.fft.ifft(torch.fft.fft(raw) * reference.to(raw.dtype))


class RangeCompress(Stage):
    """Range compression with the transmitted pulse (brief 004, item 6).

    reference: "matched", "flat" or "phase".

    Samples closer to the end of a line than one pulse length are compressed with the part of the
    echo that was recorded.
    """

    def __init__(self, radar: StripmapRadar, reference: str = "matched") -> None:
        super().__init__()
        if reference not in REFERENCES:
            raise ValueError(f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}")
        self.radar, self.reference = radar, reference

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """The reference spectrum for lines of n samples, complex128 (n,)."""
        return REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)

    def forward(self, signal: Signal) -> Signal:
        real_dtype(signal.data.dtype)
        return signal.with_data(range_compress(signal.data, self.spectrum(signal.data.shape[-1], signal.data.device)))
