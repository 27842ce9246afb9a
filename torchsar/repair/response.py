"""Frequency response of the channel along range: correction, and estimation of the amplitude.

The response is A(u) exp(j psi(u)), where u = f / (bandwidth / 2) is the normalised range frequency,
-1..1 over the band of the pulse. Outside the band it keeps its values at the edges. By convention
psi has no constant part (a phase) and no linear part (a shift) over the band, and ln A has mean
zero (no gain). Responses are sampled at GRID = 1025 equally spaced u from -1 to 1. The module
`response_phase` estimates the phase.

Reference:
    Tsvetkov 2017, Figs. 8 and 9.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, checked_samples, cis, legendre, real_dtype, refuse_non_finite_values
from torchsar.radar import StripmapRadar

# Number of samples of a response, by choice. It is odd, so that u = 0 is one of them. There are
# about 80 for each period of the highest Legendre degree (40) at the middle of the band.
GRID = 1025


def band_grid(device: torch.device | str | None = None) -> Tensor:
    """Return the normalised range frequencies, -1..1 over the band, at which responses are sampled.

    Args:
        device: Device of the result.

    Returns:
        Frequencies, shape (GRID,) with GRID = 1025, float64.
    """
    return torch.linspace(-1, 1, GRID, dtype=torch.float64, device=device)


def band_axis(n: int, band: float, device: torch.device | str | None = None) -> Tensor:
    """Return the frequencies of an FFT, normalised to -1..1 over the band of the pulse.

    Args:
        n: Length of the FFT.
        band: Bandwidth of the pulse over the sampling rate, above 0 and up to 1.
        device: Device of the result.

    Returns:
        Normalised frequency u in FFT order, shape (n,), float64.

    Raises:
        ValueError: If `band` is outside its limits.
    """
    if not 0 < band <= 1:
        raise ValueError(f"band, the pulse bandwidth over the sampling rate, must be above 0 and up to 1, got {band}")
    return torch.fft.fftfreq(n, dtype=torch.float64, device=device) / (band / 2)


def unit_legendre(u: Tensor, order: int) -> Tensor:
    """Return Legendre polynomials with unit mean square over -1..1.

    Args:
        u: Normalised frequencies, any shape, float64.
        order: Highest degree.

    Returns:
        Shape (order + 1, *u.shape), float64.
    """
    degree = torch.arange(order + 1, dtype=torch.float64, device=u.device)
    return (legendre(u, order) * torch.sqrt(2 * degree + 1)).movedim(-1, 0)


def on_axis(values: Tensor, u: Tensor) -> Tensor:
    """Interpolate a sampled response linearly at other frequencies.

    Outside the band the values at its edges are kept. Differentiable in the values.

    Args:
        values: Values at GRID = 1025 equally spaced frequencies of the band, shape (..., GRID).
        u: Frequencies, normalised to -1..1 over the band, shape (n,).

    Returns:
        Values at these frequencies, shape (..., n).
    """
    position = (u.clamp(-1, 1) + 1) / 2 * (values.shape[-1] - 1)
    low = position.floor().to(torch.int64).clamp(0, values.shape[-1] - 2)
    part = position - low
    return values[..., low] * (1 - part) + values[..., low + 1] * part


def correct_response(x: Tensor, phase_rad: Tensor, amplitude: Tensor | None, band: float) -> Tensor:
    """Remove the phase and amplitude response of the channel along range.

    >>> import torch
    >>> from torchsar import repair
    >>> point = torch.zeros(64, 64, dtype=torch.complex64)
    >>> point[32, 20] = 1
    >>> phase_rad = 3 * torch.pi * torch.linspace(-1, 1, 1025).double()  # linear: 3 samples
    >>> repair.correct_response(point, phase_rad, None, band=1.0)[32].abs().argmax().item()
    23

    The middle of the pulse band must be at zero range frequency. Differentiable.

    Args:
        x: Raw or range-compressed lines or image, shape (..., pulse, range), complex.
        phase_rad: Phase of the response in radians at GRID = 1025 equally spaced frequencies of the
            band, shape (..., GRID), float64.
        amplitude: Amplitude of the response at the same frequencies, shape (..., GRID), or None for
            one.
        band: Bandwidth of the pulse over the sampling rate.

    Returns:
        Corrected data, same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "correct_response", "range", finite=False)
    refuse_non_finite_values("correct_response", phase_rad=phase_rad, amplitude=amplitude)
    u, real = band_axis(x.shape[-1], band, phase_rad.device), real_dtype(x.dtype)
    inverse = cis(-on_axis(phase_rad, u).to(real))
    if amplitude is not None:
        inverse = inverse / on_axis(amplitude, u).to(real)
    return torch.fft.ifft(torch.fft.fft(x) * inverse[..., None, :])


def band_power(x: Tensor) -> Tensor:
    """Return the mean power spectrum along range, such as `estimate_amplitude_response` takes.

    Args:
        x: Lines or image, shape (..., pulse, range), complex.

    Returns:
        Power averaged over the lines, in FFT order, shape (..., range), float64.
    """
    return torch.fft.fft(x).abs().square().to(torch.float64).mean(-2)


def estimate_amplitude_response(power: Tensor, expected: Tensor, band: float, order: int = 32) -> Tensor:
    """Estimate the amplitude response that converts an expected power spectrum into a measured one.

    Both spectra are averaged over bins of the band, and half the logarithm of their ratio is fitted
    with Legendre polynomials, without its mean.

    Args:
        power: Measured power spectrum along range, FFT order, shape (..., n).
        expected: Power spectrum of data of the same kind without the response, FFT order, shape
            (..., n') of any length; |pulse spectrum|^2 if noise and scene are white.
        band: Bandwidth of the pulse over the sampling rate.
        order: Highest degree of the polynomials.

    Returns:
        Amplitude at GRID = 1025 equally spaced frequencies of the band, shape (..., GRID); one
        where a trial has no power.

    Raises:
        ValueError: If the expected spectrum has a bin without power, or a spectrum has too few
            samples in the band for the order.
    """
    bins = 4 * order
    u = (torch.arange(bins, dtype=torch.float64, device=power.device) + 0.5) * 2 / bins - 1
    refuse_non_finite_values("estimate_amplitude_response", power=power, expected=expected)
    wanted = _binned(expected.to(torch.float64), band, bins)
    if not bool((wanted > 0).all()):
        raise ValueError(
            "expected must be a power spectrum that is positive over the whole pulse band, but part of the band "
            "has no power; give a spectrum of the same band"
        )
    ratio = _binned(power.to(torch.float64), band, bins) / wanted
    level = ratio.mean(-1, keepdim=True)
    half_log = 0.5 * torch.log((ratio / level.clamp_min(1e-300)).clamp_min(1e-6))
    terms = unit_legendre(u, order).mT.expand(*half_log.shape[:-1], -1, -1)
    coefficients = torch.linalg.lstsq(terms, half_log[..., None], driver="gels").solution[..., 1:, 0]
    fitted = torch.exp(coefficients @ unit_legendre(band_grid(power.device), order)[1:])
    return torch.where(level > 0, fitted, 1)


def _binned(power: Tensor, band: float, bins: int) -> Tensor:
    """Mean of a power spectrum over equal bins of u in the band, (..., bins)."""
    u = band_axis(power.shape[-1], band, power.device)
    inside = u.abs() < 1
    if int(inside.sum()) < bins:
        raise ValueError(
            f"a power spectrum must have {bins} samples or more inside the pulse band, but a spectrum of "
            f"{power.shape[-1]} samples has fewer; lower the order or give longer lines"
        )
    index = ((u[inside] + 1) / 2 * bins).to(torch.int64).clamp(0, bins - 1)
    total = power.new_zeros(*power.shape[:-1], bins).index_add(-1, index, power[..., inside])
    return total / torch.bincount(index, minlength=bins).clamp_min(1)


class CorrectResponse(Stage):
    """Correction of the phase and amplitude response of the channel along range.

    In a chain, `use(CorrectResponse(radar), phase_rad="response", amplitude="response")` takes the
    response from an earlier stage named "response" that estimates it.

    Args:
        radar: Radar; gives bandwidth and sampling rate.
        on: "image" if the stage receives images, "raw" if it receives raw or range-compressed
            lines.

    Raises:
        ValueError: If `on` is neither "image" nor "raw".
    """

    def __init__(self, radar: StripmapRadar, on: str = "image") -> None:
        super().__init__()
        if on not in ("image", "raw"):
            raise ValueError(f"on must be 'image' or 'raw', the kind of data to be corrected, got {on!r}")
        self.works_on = ("azimuth", "range") if on == "image" else ("pulse", "range")
        self.band = radar.pulse.bandwidth_hz / radar.sampling_hz

    def forward(self, signal: Signal, phase_rad: Tensor, amplitude: Tensor | None = None) -> Signal:
        """Remove the phase and amplitude response along range; see `correct_response`.

        Args:
            signal: Image, shape (..., azimuth, range), or lines, shape (..., pulse, range).
            phase_rad: Phase of the response in radians at GRID = 1025 equally spaced frequencies of
                the band, shape (..., GRID).
            amplitude: Amplitude at the same frequencies, shape (..., GRID), or None for one.

        Returns:
            Corrected signal.
        """
        return signal.with_data(correct_response(signal.data, phase_rad, amplitude, self.band))
