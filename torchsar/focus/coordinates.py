"""Conversion of slant range to range of closest approach, and focusing with zero-padded records."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Signal, Stage, checked_samples, real_dtype
from torchsar.core.nufft import Nufft
from torchsar.core.select import per_trial
from torchsar.focus.omega_k import Focuser
from torchsar.radar import StripmapRadar


def closest_range(
    image: Tensor,
    radar: StripmapRadar,
    frame_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    eps: float = 1e-5,
) -> Tensor:
    """Resample an image from slant range R to the range of closest approach, r = R cos(squint).

    >>> import torch
    >>> from torchsar import focus, radar
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> image = torch.nn.functional.one_hot(torch.tensor([48]), 96) + 0j
    >>> int(focus.closest_range(image, sensor, frame_hz=200.0).abs().argmax())  # 13 m nearer
    44

    The squint is that of the line of sight that defines the image coordinates. The interpolation is
    band-limited; samples from beyond the record wrap around. A squint of 1.6 degrees moves a target
    at 1000 km by 400 m. Differentiable.

    Args:
        image: Focused image, shape (..., azimuth, range), complex.
        radar: Radar of the recording.
        frame_hz: Doppler frequency of that line of sight in Hz, with which the image was focused, a
            number or shape (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        eps: Relative error of the interpolation.

    Returns:
        Image of the same shape on the same range axis, which now is the range of closest approach.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    image = checked_samples(image, "closest_range", "azimuth, range", finite=False)
    n = image.shape[-1]
    sin = radar.sin_squint(
        per_trial(frame_hz, 2, image), per_trial(radar.velocity_m_s if velocity_m_s is None else velocity_m_s, 2, image)
    )
    cosine = torch.sqrt(1 - sin.square())
    # Column k is at the closest range r = near + k dr, and thus at the slant range r / cos. The
    # value of 1 / cos - 1 is formed without a difference of nearly equal numbers.
    excess = sin.square() / (cosine * (1 + cosine))
    column = torch.arange(n, dtype=torch.float64, device=image.device)
    source = column + (radar.near_range_m / radar.range_step_m + column) * excess
    plan = Nufft(n, eps, image.dtype, image.device)
    spectrum = torch.fft.fftshift(torch.fft.fft(image), dim=-1) / n
    return plan.type2(spectrum, plan.points(-source / n))


class ClosestRange(Stage):
    """Stage that converts the range axis of a focused image to the range of closest approach.

    The range of closest approach is that of a zero-Doppler image; azimuth remains the crossing of
    the beam centre. The beam centre is given by the nominal pointing of the radar, or by the
    centroid `doppler_hz` where the radar has none.

    Args:
        radar: Radar of the recording.
        eps: Relative error of the interpolation.
    """

    works_on = ("azimuth", "range")

    def __init__(self, radar: StripmapRadar, eps: float = 1e-5) -> None:
        super().__init__()
        self.radar, self.eps = radar, eps

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Convert an image with axes (azimuth, range).

        Args:
            signal: Focused image.
            doppler_hz: Doppler centroid in Hz with which the image was focused.
            velocity_m_s: Effective velocity in m/s; None for that of the radar.

        Returns:
            Image on the same axes; range is that of closest approach.

        Raises:
            ValueError: If the radar has no nominal pointing and `doppler_hz` is absent.
        """
        real_dtype(signal.data.dtype)
        pointing = self.radar.pointing_doppler_hz
        frame = pointing if pointing is not None else doppler_hz
        if frame is None:
            raise ValueError(
                "ClosestRange needs the doppler_hz that the image was focused with, got None; connect it: "
                "use(ClosestRange(radar), doppler_hz='doppler')"
            )
        return signal.with_data(closest_range(signal.data, self.radar, frame, velocity_m_s, self.eps))


class PaddedLines(Stage):
    """Stage that appends zero lines to the record before focusing.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([18.0], [0.0]), scene.Dwell(0.2))  # at the end
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> stages = focus.OmegaK(sensor), focus.PaddedLines(focus.OmegaK(sensor))
    >>> [round(float(stage(recording.signal).data[:30].abs().max()), 1) for stage in stages]
    [0.9, 0.1]

    Targets whose aperture is cut off by the end of the record then do not wrap around to its start.
    The image has the lines of the record. Time and memory grow in proportion to the padded length.

    Args:
        focuser: Focusing stage.
        lines: Number of added lines; None for one aperture: the integration time of the radar, or
            where it has none, the time in which the Doppler of a target sweeps one PRF.

    Raises:
        ValueError: If `lines` is negative.
    """

    def __init__(self, focuser: Focuser, lines: int | None = None) -> None:
        super().__init__()
        if lines is not None and lines < 0:
            raise ValueError(f"lines of PaddedLines must be 0 or more, got {lines}")
        self.focuser, self.lines = focuser, lines

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Focus a signal with axes (pulse, range).

        Args:
            signal: Recording.
            doppler_hz: Doppler centroid in Hz; None for that of the focuser.
            velocity_m_s: Effective velocity in m/s; None for that of the focuser.

        Returns:
            Image with axes (azimuth, range). It has as many lines as the recording, or the multiple
            of them that the focuser makes.
        """
        n, radar = signal.axis("pulse").n, self.focuser.radar
        more = radar.aperture_lines(signal.axis("range").stop) if self.lines is None else self.lines
        padded = signal.with_axis(pad(signal.data, (0, 0, 0, more)), pulse=signal.axis("pulse").part(0, n + more))
        image = self.focuser(padded, doppler_hz=doppler_hz, velocity_m_s=velocity_m_s)
        return image.isel(azimuth=slice(0, n * (image.axis("azimuth").n // (n + more))))
