"""Range-Doppler focusing, the textbook baseline for omega-K."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import checked_samples, linear_phasor, real_dtype, unit_phasor
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.nufft import Nufft, Points
from torchsar.focus.omega_k import STATIONARY_TURNS, Focuser, refocus_turns_per_sample, through_doppler
from torchsar.radar import StripmapRadar


def migration(at: FrameGeometry) -> Tensor:
    """Compute the relative range migration of each Doppler row.

    It is cos(s_frame) / cos(s) - 1, where s is the squint at the Doppler of the row and s_frame
    that of the line of sight that defines the image coordinates. In this row a target at slant
    range R appears at range R (1 + migration).

    Args:
        at: Geometry of the Doppler rows.

    Returns:
        Relative migration of each row, shape (..., d), float64.
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
    """Focus raw data by the range-Doppler algorithm.

    The steps are an azimuth FFT, correction of range migration by interpolation, multiplication by
    the hyperbolic azimuth phase of each range, and an inverse FFT. Migration and azimuth phase are
    exact over the whole swath. There is no secondary range compression: the neglected coupling of
    range and azimuth broadens responses for wide bands, long apertures and squinted beams;
    `requirements` predicts its phase.

    Args:
        raw: Raw or range-compressed data, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler centroid in Hz, a number or shape (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        reference: Spectrum of the range compression filter, shape (range,); None for
            range-compressed data.
        band_hz: Processed Doppler bandwidth about the centroid in Hz; None for the whole PRF.
        eps: Relative error of the interpolation.

    Returns:
        Image, shape (..., azimuth, range), complex, with coordinates and phases as in `omega_k`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `doppler_hz` or `velocity_m_s` is neither a
            number nor a tensor in the shape of the leading dims of the data. Also if the velocity
            is not positive, the magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity /
            wavelength, or `band_hz` is not positive.
    """
    raw = checked_samples(raw, "range_doppler", "pulse, range", finite=False)
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
        # Cell i of the image lies at cell i + range_cells * migration of the row. The exponent is
        # +2j pi k q / n, so that points have the opposite sign.
        start = migration(at) * centre_cells
        shift = start[..., None] + migration(at)[..., None] * (range_cells - centre_cells)
        points = Points.of(plan.kernel, -per_sample * cell, plan.length, real, -per_sample * shift)
        turns = refocus_turns_per_sample(at)
        constant = unit_phasor(turns * centre_cells + STATIONARY_TURNS, raw.dtype) / n
        lines = plan.type2(torch.fft.fftshift(spectrum, dim=-1), points)
        return at.weighted(lines * linear_phasor(turns, -centre, n, raw.dtype) * constant[..., None])

    return through_doppler(raw, focus_rows, differentiable=geometry.requires_grad or raw.requires_grad)


class RangeDoppler(Focuser):
    """Stage that focuses by the range-Doppler algorithm; arguments as in `Focuser`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> image = focus.RangeDoppler(sensor)(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 96)  # line and sample of the peak
    (64, 36)
    """

    form = staticmethod(range_doppler)
