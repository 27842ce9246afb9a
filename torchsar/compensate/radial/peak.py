"""Radial velocity from the beat frequencies of the strongest scatterer."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, bands_of, inside, refuse_other_sweeps, window_lines
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.newton import climbed
from torchsar.compensate.radial.verdict import velocity_estimate
from torchsar.core import Axis, Estimate
from torchsar.radar import TriangularLadar

_PAD, _NEWTON, _REACH, _DARK = 2, 3, 2.0, 0.2


def ml_peak(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    window_m: tuple[float, float] | None = None,
    azimuth_m: Tensor | float = 0.0,
) -> Estimate:
    """Radial velocity at the turning points from periodogram peaks, value["velocity_m_s"] (...,
    pulse) (brief 000, section 5b).

    fd = (f'up - f'mirrored down) / 2 with each peak refined by Newton steps: for one scatterer the
    maximum-likelihood estimate with unknown offsets. sweeps: (..., 2, pulse, N). window_m: relative
    ranges (low, high) m to look for it, None for the whole band; nothing is filtered. The peak is
    sought within two range cells of that of the whole record. azimuth_m: x of the scatterer.
    Differentiable around the detached peaks. Raises TypeError or ValueError for other sweeps or a
    window that is none.
    """
    refuse_other_sweeps(sweeps, radar, "ml_peak", pulse)
    window_lines(radar, window_m)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = bands_of(sweeps, radar, video=True)
        up, down, lit = peak_frequencies(bands, window_m)
        bands = replace(bands, lit=bands.lit & lit)
        return velocity_estimate(
            from_beats(up, down, bands), bands, pulse, factor=3.0, azimuth_m=azimuth_m, window_m=window_m
        )

    return by_trials(estimator, sweeps, azimuth_m)


def from_beats(up_hz: Tensor, down_hz: Tensor, bands: Bands) -> Tensor:
    """Velocity (..., pulse) from the beats of up and mirrored down sweeps.

    The range changes between their middles: factor 1 + B / (2 fc), erratum 8.
    """
    radar = bands.radar
    doppler = bands.shift.to(torch.float64) / radar.sweep_s + (up_hz - down_hz) / 2
    return radar.wavelength_m / 2 * doppler * (1 + radar.bandwidth_hz / (2 * radar.carrier_hz))


def shining(up: Tensor, down: Tensor) -> Tensor:
    """Where a scatterer is lit in both sweeps: powers (..., pulse) of a fifth of their mean or
    more.
    """
    return torch.stack([power >= _DARK * power.mean(-1, keepdim=True) for power in (up, down)]).all(0) & (up + down > 0)


def peak_frequencies(bands: Bands, window_m: tuple[float, float] | None) -> tuple[Tensor, Tensor, Tensor]:
    """Beat frequencies (Hz) of the strongest scatterer in the up and the mirrored down sweeps,
    (..., pulse) float64 each, and where it is lit.
    """
    both = torch.stack([bands.up, bands.down], -3)
    m = both.shape[-1]
    spectrum = torch.fft.fft(both.detach(), _PAD * m)
    power = spectrum.real.square() + spectrum.imag.square()
    sought = inside(bands.radar, window_m, _PAD * m, _PAD, both.device)
    centre = torch.where(sought, power.mean((-3, -2), keepdim=True), -1).argmax(-1, keepdim=True)
    away = (torch.arange(_PAD * m, device=both.device) - centre + _PAD * m // 2) % (_PAD * m) - _PAD * m // 2
    peak, best = torch.where(away.abs() <= round(_REACH * _PAD), power, -1).max(-1)
    best = torch.where(best >= _PAD * m // 2, best - _PAD * m, best)
    frequency = best.to(torch.float64) / (_PAD * bands.radar.sweep_s)
    frequency = climbed(both, 2 * math.pi * bands.time_s, frequency, _NEWTON)
    return frequency[..., 0, :], frequency[..., 1, :], shining(peak[..., 0, :], peak[..., 1, :])
