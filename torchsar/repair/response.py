"""Phase- and amplitude-frequency response of the whole channel: its form, its correction, and the
amplitude.

A response exp(j psi(u)) A(u) lies over the normalised range frequency u = f / (bandwidth / 2),
-1..1 over the band of the pulse, and is held at its edge values outside. By convention psi has no
constant and no linear part over the band (they are a phase and a shift) and ln A has no mean (a
gain). Responses travel as samples on GRID equally spaced u from -1 to 1. The phase is estimated in
`response_phase`. Source: brief 004, items 6 and 9.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, cis, legendre, real_dtype
from torchsar.radar import StripmapRadar

GRID = 1025


def band_grid(device: torch.device | str | None = None) -> Tensor:
    """The normalised frequencies at which responses are given, float64 (GRID,)."""
    return torch.linspace(-1, 1, GRID, dtype=torch.float64, device=device)


def band_axis(n: int, band: float, device: torch.device | str | None = None) -> Tensor:
    """Normalised frequency u of an n-point FFT, FFT order, float64 (n,).

    band: pulse bandwidth over sampling rate.
    """
    if not 0 < band <= 1:
        raise ValueError(f"band is the pulse bandwidth over the sampling rate and lies in 0..1, got {band}")
    return torch.fft.fftfreq(n, dtype=torch.float64, device=device) / (band / 2)


def unit_legendre(u: Tensor, order: int) -> Tensor:
    """Legendre polynomials of degree 0..order, scaled to unit mean square over -1..1, (order + 1,
    *u.shape) float64.
    """
    degree = torch.arange(order + 1, dtype=torch.float64, device=u.device)
    return (legendre(u, order) * torch.sqrt(2 * degree + 1)).movedim(-1, 0)


def without_line(phase_rad: Tensor) -> Tensor:
    """A phase on the grid less its constant and linear parts of least squares over the band.

    (..., GRID) -> (..., GRID).
    """
    line = unit_legendre(band_grid(phase_rad.device), 1)
    line = line / torch.linalg.vector_norm(line, dim=-1, keepdim=True)
    return phase_rad - (phase_rad @ line.mT) @ line


def on_axis(values: Tensor, u: Tensor) -> Tensor:
    """Values given on the grid, interpolated at u and held outside the band.

    (..., GRID), (n,) -> (..., n). Differentiable in values.
    """
    place = (u.clamp(-1, 1) + 1) / 2 * (values.shape[-1] - 1)
    low = place.floor().to(torch.int64).clamp(0, values.shape[-1] - 2)
    part = place - low
    return values[..., low] * (1 - part) + values[..., low + 1] * part


def response_filter(
    phase_rad: Tensor, amplitude: Tensor | None, n: int, band: float, dtype: torch.dtype = torch.complex128
) -> Tensor:
    """Inverse response exp(-j psi) / A in FFT order, (..., n): multiply it into a range reference
    spectrum, or into range spectra.
    """
    u = band_axis(n, band, phase_rad.device)
    inverse = cis(-on_axis(phase_rad, u).to(real_dtype(dtype)))
    return inverse if amplitude is None else inverse / on_axis(amplitude, u).to(real_dtype(dtype))


def correct_response(x: Tensor, phase_rad: Tensor, amplitude: Tensor | None, band: float) -> Tensor:
    """Remove a response along the last dim.

    x: (..., pulse, range) raw, range-compressed or image; phase_rad, amplitude: (..., GRID).

    The range spectrum of x must be centred, as that of images in beam coordinates is.
    Differentiable.
    """
    inverse = response_filter(phase_rad, amplitude, x.shape[-1], band, x.dtype)
    return torch.fft.ifft(torch.fft.fft(x) * inverse[..., None, :])


def band_power(x: Tensor) -> Tensor:
    """Mean power spectrum along range, FFT order. (..., pulse, range) -> (..., range) float64.

    What `expected` is made of.
    """
    return torch.fft.fft(x).abs().square().to(torch.float64).mean(-2)


def estimate_amplitude_response(power: Tensor, expected: Tensor, band: float, order: int = 32) -> Tensor:
    """Amplitude on the grid that turns `expected` into `power` spectra, both FFT order, (..., n)
    and (..., n') of any lengths.

    Both are averaged over bins of the band; half the log of their ratio is fitted with Legendre
    polynomials up to `order`, whose mean is dropped. expected: of clean data of the same kind, or
    |pulse spectrum|^2 where noise and scene are white. Raises ValueError for an expected spectrum
    that has no power in the band.
    """
    bins = 4 * order
    u = (torch.arange(bins, dtype=torch.float64, device=power.device) + 0.5) * 2 / bins - 1
    wanted = _binned(expected.to(torch.float64), band, bins)
    if not bool((wanted > 0).all()):
        raise ValueError(
            "the expected spectrum has bins without power inside the band; give a spectrum of "
            "the same band and at least four bins an order"
        )
    ratio = _binned(power.to(torch.float64), band, bins) / wanted
    level = ratio.mean(-1, keepdim=True)
    half_log = 0.5 * torch.log((ratio / level.clamp_min(1e-300)).clamp_min(1e-6))
    coefficients = torch.linalg.lstsq(unit_legendre(u, order).mT, half_log[..., None]).solution[..., 1:, 0]
    fitted = torch.exp(coefficients @ unit_legendre(band_grid(power.device), order)[1:])
    return torch.where(level > 0, fitted, 1)


def _binned(power: Tensor, band: float, bins: int) -> Tensor:
    """Mean over equal bins of u, (..., n) -> (..., bins); a bin without a sample takes the value
    between its neighbours.
    """
    u = band_axis(power.shape[-1], band, power.device)
    inside = u.abs() < 1
    if int(inside.sum()) < bins:
        raise ValueError(
            f"a spectrum of {power.shape[-1]} samples holds fewer than {bins} inside the band; "
            "lower the order or give longer lines"
        )
    index = ((u[inside] + 1) / 2 * bins).to(torch.int64).clamp(0, bins - 1)
    total = torch.zeros((*power.shape[:-1], bins), dtype=power.dtype, device=power.device).index_add(
        -1, index, power[..., inside]
    )
    return total / torch.bincount(index, minlength=bins).clamp_min(1)


class CorrectResponse(Stage):
    """Remove a response: `use(CorrectResponse(radar), phase_rad="response", amplitude="response")`.

    on: "image", or "raw" for raw and range-compressed data, where it is the same as folding it into
    the reference spectrum.
    """

    def __init__(self, radar: StripmapRadar, on: str = "image") -> None:
        super().__init__()
        if on not in ("image", "raw"):
            raise ValueError(f"a response is corrected on 'image' or 'raw' data, got {on!r}")
        self.works_on = ("azimuth", "range") if on == "image" else ("pulse", "range")
        self.band = radar.pulse.bandwidth_hz / radar.sampling_hz

    def forward(self, signal: Signal, phase_rad: Tensor, amplitude: Tensor | None = None) -> Signal:
        return signal.with_data(correct_response(signal.data, phase_rad, amplitude, self.band))
