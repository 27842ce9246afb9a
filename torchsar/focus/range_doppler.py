"""Range-Doppler focusing: the textbook baseline that omega-K is measured against."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import linear_phasor, real_dtype, unit_phasor
from torchsar.focus.nufft import Nufft, Points
from torchsar.focus.omega_k import STATIONARY_TURNS, Focuser, FrameGeometry, refocus_turns_per_sample, through_doppler
from torchsar.radar import StripmapRadar


def migration(at: FrameGeometry) -> Tensor:
    """Relative range migration of each Doppler row, cos(squint of the frame) / cos(squint of the
    row) - 1, float64 (..., d).

    A target at slant range R appears at R (1 + migration): the slope of the wavenumber mapping at
    the carrier. Formed as a difference.
    """
    velocity, frame = at.velocity_m_s[..., None], at.frame_hz[..., None]
    sin, sin_frame = (at.radar.wavelength_m * f / (2 * velocity) for f in (at.doppler_hz, frame))
    cos, cos_frame = (torch.sqrt((1 - s.square()).clamp_min(1e-12)) for s in (sin, sin_frame))
    return (sin - sin_frame) * (sin + sin_frame) / (cos * (cos + cos_frame))


def range_doppler(
    raw: Tensor,
    radar: StripmapRadar,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    frame_hz: Tensor | float | None = None,
    reference: Tensor | None = None,
    band_hz: float | None = None,
    eps: float = 2e-4,
) -> Tensor:
    """Range-Doppler algorithm: azimuth FFT, migration taken out by interpolation, hyperbolic
    azimuth phase per range, inverse FFT.

    raw, result: (..., pulse, range) complex; arguments, coordinates and phases as `omega_k`. Exact
    for the whole swath in migration and azimuth phase; neglects the coupling of range and azimuth
    beyond the carrier (no secondary range compression), which broadens wide bands, long apertures
    and squinted beams: `focus.requirements` says by how much. eps: relative error of the
    interpolation.
    """
    geometry = FrameGeometry.of(radar, raw, doppler_hz, velocity_m_s, frame_hz, band_hz=band_hz)
    n, centre, real = raw.shape[-1], raw.shape[-1] // 2, real_dtype(raw.dtype)
    plan = Nufft(n, eps, raw.dtype, raw.device)
    per_sample = plan.length / n
    cell = torch.arange(n, dtype=torch.float64, device=raw.device)
    range_cells = cell + radar.near_range_m / radar.range_step_m
    centre_cells = centre + radar.near_range_m / radar.range_step_m

    def focus_rows(rows: Tensor, part: slice) -> Tensor:
        at = geometry.rows(part)
        spectrum = rows if reference is None else rows * reference.to(rows.dtype)
        # cell i of the image lies at cell i + range_cells * migration of the row; exp(+2j pi k q /
        # n) asks for points of the other sign
        start = migration(at) * centre_cells
        shift = start[..., None] + migration(at)[..., None] * (range_cells - centre_cells)
        points = Points.of(plan.kernel, -per_sample * cell, plan.length, real, (-per_sample * shift).to(real))
        turns = refocus_turns_per_sample(at)
        constant = unit_phasor(turns * centre_cells + STATIONARY_TURNS, raw.dtype) / n
        lines = plan.type2(torch.fft.fftshift(spectrum, dim=-1), points)
        return at.weighted(lines * linear_phasor(turns, -centre, n, raw.dtype) * constant[..., None])

    return through_doppler(raw, focus_rows, differentiable=geometry.requires_grad or raw.requires_grad)


class RangeDoppler(Focuser):
    """Focus by the range-Doppler algorithm, the baseline; arguments as `Focuser`."""

    form = staticmethod(range_doppler)
