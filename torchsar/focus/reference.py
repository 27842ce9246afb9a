"""Range compression and its reference spectra."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, checked_samples, real_dtype
from torchsar.radar import LinearFM, StripmapRadar


def matched_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Compute the conjugate pulse spectrum, the matched filter.

    Args:
        pulse: Transmitted pulse.
        n: Number of samples of a line.
        sampling_hz: Sampling rate in Hz.
        device: Device of the result.

    Returns:
        Spectrum in FFT order, shape (n,), complex128; a compressed echo of unit amplitude
        has a peak of 1.
    """
    spectrum = pulse.band_spectrum(n, sampling_hz, device)
    return spectrum.conj() * (n / spectrum.abs().square().sum())


def flat_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Compute the inverse pulse spectrum inside the pulse bandwidth, zero outside.

    The compressed pulse is a pure sinc (PSLR -13.26 dB), without the ripple that the Fresnel
    spectrum of a short pulse causes after the matched filter. Noise outside the pulse bandwidth is
    removed. The signal-to-noise ratio is 0.1 to 0.3 dB below that of the matched filter at usual
    time-bandwidth products.

    Args:
        pulse: Transmitted pulse.
        n: Number of samples of a line.
        sampling_hz: Sampling rate in Hz.
        device: Device of the result.

    Returns:
        Spectrum in FFT order, shape (n,), complex128; a compressed echo of unit amplitude
        has a peak of 1.
    """
    spectrum = pulse.band_spectrum(n, sampling_hz, device)
    frequency = torch.fft.fftfreq(n, 1 / sampling_hz, dtype=torch.float64, device=device)
    inside = frequency.abs() <= pulse.bandwidth_hz / 2
    power = spectrum.abs().square()
    return torch.where(inside, spectrum.conj() / torch.where(inside, power, 1), 0) * (n / inside.sum())


def phase_reference(pulse: LinearFM, n: int, sampling_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Compute the conjugate phase of the pulse spectrum, of constant modulus in the sampled band.

    The filter also uses the part of the pulse spectrum beyond the nominal band edges. Where the
    noise there is low, the response is a few percent narrower than that of the matched filter.

    Args:
        pulse: Transmitted pulse.
        n: Number of samples of a line.
        sampling_hz: Sampling rate in Hz.
        device: Device of the result.

    Returns:
        Spectrum in FFT order, shape (n,), complex128; a compressed echo of unit amplitude
        has a peak of 1.
    """
    spectrum = pulse.band_spectrum(n, sampling_hz, device)
    size = spectrum.abs().clamp_min(torch.finfo(torch.float64).tiny)
    return spectrum.conj() / size * (n / size.sum())


# reference functions by the names that stages accept
REFERENCES = {"matched": matched_reference, "flat": flat_reference, "phase": phase_reference}


def range_compress(raw: Tensor, reference: Tensor) -> Tensor:
    """Compress raw lines in range by circular convolution with a filter, given as its spectrum.

    Args:
        raw: Raw data, shape (..., pulse, range), complex.
        reference: Reference spectrum in FFT order, shape (range,) or (..., 1, range).

    Returns:
        Range-compressed data, same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    raw = checked_samples(raw, "range_compress", "range", finite=False)
    return torch.fft.ifft(torch.fft.fft(raw) * reference.to(raw.dtype))


class RangeCompress(Stage):
    """Stage that compresses pulses in range with the transmitted pulse.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> int(focus.RangeCompress(sensor)(recording.signal).data[64].abs().argmax())  # the peak
    36

    Samples closer to the end of a line than one pulse length are compressed with the recorded part
    of their echo.

    The response of a pulse of duration T and bandwidth B ends in side lobes at a distance of one
    pulse length, which look like a pair of faint ghosts of a bright point. With "matched" they lie
    about 1 / (pi T B) below the peak, -48 dB for T B = 80. Sampling at 1.25 B lets the frequencies
    of the abrupt ends of the pulse alias, which raises them to -39 dB; at 2 B they are at -46 dB.
    "flat" and "phase" make them 3 to 10 dB stronger. Longer pulses lower them: -51 dB for T B of
    320.

    Args:
        radar: Radar of the recording.
        reference: Spectrum of the filter: "matched" for the conjugate pulse spectrum, "flat" for
            the inverse pulse spectrum inside the pulse bandwidth, "phase" for the conjugate phase
            of the pulse spectrum.

    Raises:
        ValueError: If `reference` is none of these.
    """

    def __init__(self, radar: StripmapRadar, reference: str = "matched") -> None:
        super().__init__()
        if reference not in REFERENCES:
            raise ValueError(f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}")
        self.radar, self.reference = radar, reference

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the spectrum of the filter that compresses range lines of n samples.

        Args:
            n: Number of samples of a range line.
            device: Device of the result.

        Returns:
            Spectrum in FFT order, shape (n,), complex128.
        """
        return REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)

    def forward(self, signal: Signal) -> Signal:
        """Compress a signal with axes (pulse, range) in range.

        Args:
            signal: Recording.

        Returns:
            Range-compressed signal on the axes of the recording.
        """
        real_dtype(signal.data.dtype)
        return signal.with_data(range_compress(signal.data, self.spectrum(signal.data.shape[-1], signal.data.device)))
