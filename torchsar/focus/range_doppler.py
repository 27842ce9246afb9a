"""Range-Doppler focusing, the textbook baseline for omega-K."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import (
    Signal,
    Stage,
    checked_samples,
    from_frequency,
    host_largest,
    outer_phasor,
    phasor_tables,
    real_dtype,
    to_frequency,
    unit_phasor,
)
from torchsar.core.nufft import Nufft
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import STATIONARY_TURNS, Focuser, refocus_turns_per_sample, tabulated, through_doppler
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
    n = raw.shape[-1]
    plan = Nufft(n, eps, raw.dtype, raw.device)
    reference = None if reference is None else reference.to(raw.dtype)
    align = tabulated(lambda at: _alignment(at, raw), geometry)
    compress = tabulated(lambda at: _compression(at, raw, n), geometry)

    def focus_rows(rows: Tensor, part: slice) -> Tensor:
        spectrum = rows if reference is None else rows * reference
        lines = _aligned(spectrum, plan, *align(part))
        return geometry.rows(part).weighted(_compressed(lines, *compress(part)))

    return through_doppler(raw, focus_rows, differentiable=geometry.requires_grad or raw.requires_grad)


def _alignment(at: FrameGeometry, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tables of `_aligned`: relative migration of each row, and two of the phasors of its shift."""
    n, near = raw.shape[-1], at.radar.near_range_m / at.radar.range_step_m
    turns = migration(at) * ((n // 2 + near) / n)
    return (migration(at)[..., None], *phasor_tables(turns, -(n // 2), n, raw.dtype))


def _aligned(spectrum: Tensor, plan: Nufft, relative: Tensor, fine: Tensor, coarse: Tensor) -> Tensor:
    """Lines (..., d, range) without range migration, times their number of samples, from their
    spectra over range frequency.
    """
    n = spectrum.shape[-1]
    # Cell i of the image lies at cell i + (i + near) * migration of the row.
    single = spectrum.dtype == torch.complex64
    reach = n / 2 * host_largest(relative.detach().abs(), math.inf) if single else math.inf
    real = real_dtype(spectrum.dtype) if reach < 100 else torch.float64
    cell = torch.arange(n, dtype=real, device=spectrum.device) - n // 2
    shifted = spectrum * torch.fft.ifftshift(outer_phasor(fine, coarse, n), dim=-1)
    return plan.shift_samples(shifted, relative.to(real) * cell, reach)


def _compression(at: FrameGeometry, raw: Tensor, scale: int = 1) -> tuple[Tensor, Tensor]:
    """Tables of `_compressed`, whose product is the azimuth filter of each row over a number."""
    n, near = raw.shape[-1], at.radar.near_range_m / at.radar.range_step_m
    turns = refocus_turns_per_sample(at)
    fine, coarse = phasor_tables(turns, -(n // 2), n, raw.dtype)
    constant = unit_phasor(turns * (n // 2 + near) + STATIONARY_TURNS, raw.dtype)
    return fine, coarse * constant[..., None] / scale


def _compressed(lines: Tensor, fine: Tensor, coarse: Tensor) -> Tensor:
    """Lines (..., d, range) times the azimuth filter of each range."""
    return lines * outer_phasor(fine, coarse, lines.shape[-1])


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


class DopplerTransform(Stage):
    """Stage that transforms range-compressed lines along azimuth: step 2 of range-Doppler.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> lines = Signal(torch.ones(4, 2, dtype=torch.complex64), sensor.raw_axes(4, 2))
    >>> focus.DopplerTransform()(lines).axes[0].values()
    tensor([-200., -100.,    0.,  100.], dtype=torch.float64)

    The Doppler axis is that of baseband, within one PRF about zero: the absolute frequency differs
    from it by whole PRFs, and lies within half of one of the Doppler centroid. Step 1 is
    `RangeCompress`, step 3 `CorrectRangeMigration`, and step 4 `AzimuthCompress`.
    """

    def forward(self, signal: Signal) -> Signal:
        """Transform a signal along its pulses.

        Args:
            signal: Signal with axes (pulse, range).

        Returns:
            Signal with axes (doppler, range).
        """
        return to_frequency(signal, "pulse")


class _DopplerStep(Stage):
    """Base of the steps of range-Doppler that work on Doppler rows."""

    works_on = ("doppler", "range")
    takes_empty = False
    velocity_m_s: Tensor
    doppler_hz: Tensor

    def __init__(
        self,
        radar: StripmapRadar,
        velocity_m_s: Tensor | float | None = None,
        doppler_hz: Tensor | float | None = None,
        frame_hz: float | None = None,
        band_hz: float | None = None,
    ) -> None:
        super().__init__()
        self.radar, self.frame_hz, self.band_hz = radar, frame_hz, band_hz
        self.hold("velocity_m_s", radar.velocity_m_s if velocity_m_s is None else velocity_m_s)
        self.hold("doppler_hz", (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else doppler_hz)

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Process Doppler rows.

        Args:
            signal: Signal with axes (doppler, range), from `DopplerTransform`.
            doppler_hz: Doppler centroid in Hz; None for that of the stage.
            velocity_m_s: Effective velocity in m/s; None for that of the stage.

        Returns:
            The rows after this step.

        Raises:
            ValueError: If a Doppler frequency, the velocity or the processed band is not valid, see
                `range_doppler`.
        """
        of = FrameGeometry.of(
            replace(self.radar, near_range_m=signal.axes[-1].start),
            signal.data,
            self.doppler_hz if doppler_hz is None else doppler_hz,
            self.velocity_m_s if velocity_m_s is None else velocity_m_s,
            self.frame_hz,
            band_hz=self.band_hz,
        )
        # from the order of an FFT to that of the axis
        weight = None if of.weight is None else torch.fft.fftshift(of.weight, dim=-1)
        return self._done(signal, replace(of, doppler_hz=torch.fft.fftshift(of.doppler_hz, dim=-1), weight=weight))

    def _done(self, signal: Signal, at: FrameGeometry) -> Signal:
        raise NotImplementedError


class CorrectRangeMigration(_DopplerStep):
    """Stage that corrects range cell migration (RCMC): step 3 of range-Doppler.

    >>> from torchsar import Chain, Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.6))
    >>> chain = Chain(
    ...     echo=echo.Simulate(sensor, world, n_pulse=256, n_range=96),
    ...     compress=focus.RangeCompress(sensor),
    ...     doppler=focus.DopplerTransform(),
    ...     rcmc=focus.CorrectRangeMigration(sensor),
    ...     azimuth=focus.AzimuthCompress(sensor),
    ... )
    >>> divmod(int(chain(draws=Draws(1)).data.abs().argmax()), 96)  # line and sample of the peak
    (128, 36)

    In each Doppler row a target lies at a longer range than at the Doppler frequency of the image
    coordinates. The rows are resampled, by interpolation of relative error `eps`, so that every
    target lies in one range cell. Together the four steps equal `RangeDoppler`.

    Args:
        radar: Radar of the recording.
        velocity_m_s: Effective velocity in m/s; None for that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz, about which the rows are unwrapped; None for
            the nominal pointing of the radar, or 0 where it has none.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates;
            None for the nominal pointing of the radar, or for the centroid where it has none.
        eps: Relative error of the interpolation.
    """

    def __init__(
        self,
        radar: StripmapRadar,
        velocity_m_s: Tensor | float | None = None,
        doppler_hz: Tensor | float | None = None,
        frame_hz: float | None = None,
        eps: float = 2e-4,
    ) -> None:
        super().__init__(radar, velocity_m_s, doppler_hz, frame_hz)
        self.eps = eps

    def _done(self, signal: Signal, at: FrameGeometry) -> Signal:
        n, data = signal.data.shape[-1], signal.data
        plan = Nufft(n, self.eps, data.dtype, data.device)
        return signal.with_data(_aligned(torch.fft.fft(data), plan, *_alignment(at, data)) / n)


class AzimuthCompress(_DopplerStep):
    """Stage that compresses azimuth and forms the image: step 4 of range-Doppler.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> lines = Signal(torch.ones(8, 4, dtype=torch.complex64), sensor.raw_axes(8, 4))
    >>> focus.AzimuthCompress(sensor)(focus.DopplerTransform()(lines)).names
    ('azimuth', 'range')

    Each row is multiplied by the conjugate phase of the echo of each range, and transformed back.

    Args:
        radar: Radar of the recording.
        velocity_m_s: Effective velocity in m/s; None for that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz, about which the rows are unwrapped; None for
            the nominal pointing of the radar, or 0 where it has none.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates;
            None for the nominal pointing of the radar, or for the centroid where it has none.
        band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.
    """

    def _done(self, signal: Signal, at: FrameGeometry) -> Signal:
        data = at.weighted(_compressed(signal.data, *_compression(at, signal.data)))
        lines = from_frequency(signal.with_data(data), "doppler")
        return Signal(lines.data, self.radar.image_axes(lines.axes))
