"""Backprojection of stripmap data on the axes of a focused image, with a choice of the pulses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Signal, checked_samples, per_trial, unit_phasor
from torchsar.focus.backprojection import direct_sum
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import Focuser
from torchsar.radar import StripmapRadar

# Function that returns the weight of each pulse at each pixel, of two tensors of one shape (...,
# pulse, pixel). The first is the slow time in seconds since the line of sight that defines the
# image coordinates crossed the pixel; by default it is that of the beam centre. The second is the
# Doppler of the pixel relative to the centroid in Hz.
Aperture = Callable[[Tensor, Tensor], Tensor]


def backproject_strip(
    raw: Tensor,
    radar: StripmapRadar,
    azimuth_m: Tensor,
    range_m: Tensor,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    frame_hz: Tensor | float | None = None,
    reference: Tensor | None = None,
    aperture: Aperture | None = None,
    start_s: float = 0.0,
    eps: float = 1e-10,
    block_bytes: int = 1 << 23,
) -> Tensor:
    """Sum the compressed echo coherently over the pulses at the range of each pixel.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> pulse, range_ = recording.signal.axes
    >>> focus.backproject_strip(recording.signal.data, sensor, pulse.values()[64:128:40] * 120.0,
    ...     range_.values()[36], doppler_hz=0.0, start_s=pulse.start,
    ...     reference=focus.RangeCompress(sensor).spectrum(96)).abs().round()  # on it, 12 m off
    tensor([80., 17.])

    The range history is the exact hyperbola, computed as the difference from the range at which the
    line of sight of `frame_hz` crosses the pixel; `direct_sum` sums along it. A focused target at
    slant range R has the phase -4 pi R / lambda; its amplitude is the sum over its pulses. Echoes
    outside the record count as zero. The sum takes about 50 operations per pulse and pixel, so use
    it for small patches.
    Differentiable in the raw data, the velocity, `frame_hz` and the pixel positions.

    Args:
        raw: Raw or range-compressed data, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        azimuth_m: Azimuth of the pixels in metres: nominal velocity x the slow time at which the
            line of sight of `frame_hz` crosses the pixel; float64, broadcasts against `range_m`.
        range_m: Slant range of the pixels at that crossing in metres; float64.
        doppler_hz: Absolute Doppler centroid in Hz, a number or shape (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        reference: Spectrum of the range compression filter, shape (range,); None for
            range-compressed data.
        aperture: Function of slow time in seconds since that line of sight crossed the pixel, and
            of the Doppler relative to the centroid in Hz, both float64 (..., pulse, pixel), that
            returns the weights of the pulses in this shape; None for all alike. Common are
            `lambda since_s, offset_hz: since_s.abs() <= T / 2` for an integration time T in
            seconds, and `lambda since_s, offset_hz: offset_hz.abs() <= B / 2` for a Doppler band of
            B Hz.
        start_s: Slow time of the first pulse in seconds.
        eps: Relative error of the interpolation in range.
        block_bytes: Size of a working array in bytes.

    Returns:
        Image, shape (..., *pixels), complex, where `pixels` is the broadcast shape of the
        coordinates.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `doppler_hz` or `velocity_m_s` is neither a
            number nor a tensor in the shape of the leading dims of the data, the velocity is not
            positive, or the magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity /
            wavelength.
    """
    raw = checked_samples(raw, "backproject_strip", "pulse, range", finite=False)
    at = FrameGeometry.of(radar, raw, doppler_hz, velocity_m_s, frame_hz)
    x, r = torch.broadcast_tensors(
        *(torch.as_tensor(v, dtype=torch.float64, device=raw.device) for v in (azimuth_m, range_m))
    )
    shape, x, r = x.shape, x.reshape(-1), r.reshape(-1)
    geometry = _PixelGeometry(radar, at.velocity_m_s, at.frame_hz, per_trial(doppler_hz, 2, x), aperture)
    lines, n = raw.shape[-2:]
    pulse_s = start_s + torch.arange(lines, dtype=torch.float64, device=raw.device)[:, None] / radar.prf_hz
    beyond = r - radar.near_range_m

    def path(pulses: slice, pixels: slice) -> tuple[Tensor, Tensor]:
        difference, weight = geometry(pulse_s[pulses], x[pixels], r[pixels])
        range_m = beyond[pixels] + difference
        cell = range_m / radar.range_step_m
        return 2 * range_m, weight * ((cell >= 0) & (cell <= n - 1))

    history = torch.fft.fft(raw) / n
    if reference is not None:
        history = history * reference.to(history.dtype)
    step_hz = radar.wave_speed_m_s / (2 * radar.range_step_m * n)
    offset = torch.arange(n, dtype=torch.float64, device=raw.device) - n // 2
    image = direct_sum(
        torch.fft.fftshift(history, dim=-1),
        radar.carrier_hz + step_hz * offset,
        path,
        x.numel(),
        eps=eps,
        wave_speed_m_s=radar.wave_speed_m_s,
        block_bytes=block_bytes,
    )
    # the phase of the carrier follows the whole range, also beyond the first sample
    image = image * unit_phasor(-2 * radar.carrier_hz / radar.wave_speed_m_s * beyond, image.dtype)
    return image.unflatten(-1, shape) if shape else image[..., 0]


@dataclass(frozen=True)
class _PixelGeometry:
    """Range of pixels relative to that at the crossing of the line of sight `frame_hz`, and weights
    of the pulses.
    """

    radar: StripmapRadar
    velocity_m_s: Tensor
    frame_hz: Tensor
    centroid_hz: Tensor
    aperture: Aperture | None

    def __call__(self, pulse_s: Tensor, azimuth_m: Tensor, range_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return r(t) - R in metres and the weight, float64 (..., pulse, pixel), for pulses (pulse,
        1) and pixels (pixel,).
        """
        velocity, frame = (per_trial(v, 2, pulse_s) for v in (self.velocity_m_s, self.frame_hz))
        sin = self.radar.wavelength_m * frame / (2 * velocity)
        since = pulse_s - azimuth_m / self.radar.velocity_m_s
        along = velocity * since
        excess = along * (along - 2 * range_m * sin)
        slant = torch.sqrt(range_m.square() + excess)
        doppler = 2 * velocity * (range_m * sin - along) / (slant * self.radar.wavelength_m)
        since, offset = torch.broadcast_tensors(since, doppler - self.centroid_hz)
        weight = torch.ones_like(since) if self.aperture is None else self.aperture(since, offset)
        return excess / (slant + range_m), weight.to(since.dtype)


class Backproject(Focuser):
    """Stage that focuses a patch by backprojection, on the image axes of focusers such as `OmegaK`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> image = focus.Backproject(sensor, lines=(60, 69), cells=(32, 41))(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 9)  # line and sample in the patch
    (4, 4)

    Args:
        radar: Radar of the recording.
        reference: Filter that compresses the pulses in range: "matched", "flat" or "phase"; None
            for range-compressed data.
        velocity_m_s: Effective velocity in m/s; None for that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz; None for the nominal pointing of the radar, or
            0 where it has none.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        lines: First raw line of the patch and the line after its last; None for all lines.
        cells: First range cell of the patch and the cell after its last; None for all cells.
        oversampling: Pixels per raw sample along either axis.
        aperture: Function of slow time in seconds since that line of sight crossed the pixel, and
            of the Doppler relative to the centroid in Hz, both float64 (..., pulse, pixel), that
            returns the weights of the pulses in this shape; None for all alike. Common are
            `lambda since_s, offset_hz: since_s.abs() <= T / 2` for an integration time T in
            seconds, and `lambda since_s, offset_hz: offset_hz.abs() <= B / 2` for a Doppler band of
            B Hz.
        eps: Relative error of the interpolation in range.

    Raises:
        ValueError: If `reference` is not known.
    """

    form = staticmethod(backproject_strip)

    def __init__(
        self,
        radar: StripmapRadar,
        reference: str | None = "matched",
        velocity_m_s: Tensor | float | None = None,
        doppler_hz: Tensor | float | None = None,
        frame_hz: float | None = None,
        lines: tuple[int, int] | None = None,
        cells: tuple[int, int] | None = None,
        oversampling: int = 1,
        aperture: Aperture | None = None,
        eps: float = 1e-10,
    ) -> None:
        super().__init__(radar, reference, velocity_m_s, doppler_hz, frame_hz)
        self.lines, self.cells, self.oversampling, self.aperture, self.eps = lines, cells, oversampling, aperture, eps

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Focus the patch of the stage from a signal with axes (pulse, range).

        Args:
            signal: Recording.
            doppler_hz: Doppler centroid in Hz; None for that of the stage.
            velocity_m_s: Effective velocity in m/s; None for that of the stage.

        Returns:
            Image of the patch with axes (azimuth, range).
        """
        azimuth, range_ = self.radar.image_axes(signal.axes)
        azimuth, range_ = (
            axis.part(*(bounds or (0, axis.n))).resampled(self.oversampling)
            for axis, bounds in ((azimuth, self.lines), (range_, self.cells))
        )
        data = backproject_strip(
            signal.data,
            replace(self.radar, near_range_m=signal.axes[-1].start),
            azimuth.values(signal.data.device)[:, None],
            range_.values(signal.data.device),
            doppler_hz=self.doppler_hz if doppler_hz is None else doppler_hz,
            velocity_m_s=self.velocity_m_s if velocity_m_s is None else velocity_m_s,
            frame_hz=self.frame_hz,
            reference=self.spectrum(signal.data.shape[-1], signal.data.device),
            aperture=self.aperture,
            start_s=signal.axes[-2].start,
            eps=self.eps,
        )
        return Signal(data, (azimuth, range_))
