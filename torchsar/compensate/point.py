"""Doppler centroid of the beam from the position of one point in a focused image.

A focused image shows each point at the time when its Doppler equals the frame Doppler, a constant
that was set when the image was focused. Assume that the time is known at which the beam centre
crosses a point, such as a corner reflector. The azimuth position of the point in the image then
gives its Doppler at that time, which is the Doppler centroid. The standard deviation is 0.39 / (T
sqrt(q)) in Hz, the Cramer-Rao bound of a tone of duration T in seconds with the SNR q after
compression (a power ratio). No estimator that uses the envelope of the beam's spectrum reaches this
accuracy from one point.

Reference: Tsvetkov 2017, text after Fig. 5.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate import doppler_assess
from torchsar.compensate.doppler import nominal_doppler, point_doppler
from torchsar.core import Estimate, Signal, Stage, checked_samples, cis, power_of, settle, unit_level, wrapped
from torchsar.metrics.impulse import impulse_response
from torchsar.radar import StripmapRadar


def doppler_at(
    radar: StripmapRadar,
    azimuth_m: Tensor,
    slant_m: Tensor,
    frame_hz: Tensor | float,
    velocity_m_s: Tensor | float,
    crossing_s: Tensor | float,
) -> Tensor:
    """Compute the Doppler of a point at a given time from its position in an image.

    >>> import torch
    >>> from torchsar import compensate, radar
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> azimuth_m = torch.tensor([0.0, 100.0])  # of two points at a range of 4 km, at time 0
    >>> compensate.doppler_at(strip, azimuth_m, torch.tensor(4000.0), 0.0, 120.0, 0.0).round()
    tensor([ 0., 60.])

    Exact for a straight path; the inverse of `StripmapRadar.image_position`. All arguments
    broadcast.

    Args:
        radar: Radar parameters.
        azimuth_m: Azimuth position in the image in metres.
        slant_m: Slant range position in the image in metres.
        frame_hz: Frame Doppler in Hz: the image holds each point at the time when its Doppler has
            this value.
        velocity_m_s: Effective velocity in m/s.
        crossing_s: Slow time in seconds at which the Doppler is wanted.

    Returns:
        The Doppler in Hz, positive when closing; NaN where no point has the frame Doppler, since it
        exceeds 2 velocity / wavelength.
    """
    sin = radar.sin_squint(frame_hz, velocity_m_s)
    closest = slant_m * torch.sqrt(1 - sin.square())
    zero_doppler_s = azimuth_m / radar.velocity_m_s + sin * slant_m / velocity_m_s
    ahead = velocity_m_s * (zero_doppler_s - crossing_s)
    return 2 * velocity_m_s / radar.wavelength_m * ahead / torch.sqrt(closest.square() + ahead.square())


def peak_time_s(
    image: Tensor,
    prf_hz: float,
    sample: Tensor,
    rate_hz_s: Tensor | float,
    seen_s: tuple[float, float],
    doppler_hz: Tensor,
    start_s: Tensor,
) -> Tensor:
    """Refine the azimuth position of a point in an image, as a slow time, by maximum likelihood.

    The image column at the range of the point is defocused to the azimuth history of the point.
    Only the part of the history in which the point was observed is kept, because an image contains
    the noise of all lines and of the whole PRF. The Doppler of the history, estimated by
    `point_doppler`, then gives the correction of the time.

    Args:
        image: Image, shape (..., azimuth, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        sample: Range position of the peak in samples, fractional, shape (...,). The time of a point
            beside the image stays as it is.
        rate_hz_s: Magnitude of the Doppler rate in Hz/s, shape (...,) or a number.
        seen_s: First and last time at which the record observed the point, in seconds from the time
            when the beam centre crosses it.
        doppler_hz: Doppler of the point in Hz, shape (...,).
        start_s: Slow time of the peak in seconds from the first line, shape (...,).

    Returns:
        The refined slow time in seconds, shape (...,).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    image = checked_samples(image, "peak_time_s", "azimuth, range")
    rate = torch.as_tensor(rate_hz_s, dtype=torch.float64, device=image.device)
    tone, _ = point_history(image, prf_hz, sample, rate, seen_s, doppler_hz, start_s)
    return start_s + (point_doppler(tone, prf_hz, centre_hz=doppler_hz) - doppler_hz) / rate


def point_history(
    image: Tensor,
    prf_hz: float,
    sample: Tensor,
    rate_hz_s: Tensor,
    seen_s: tuple[float, float],
    doppler_hz: Tensor,
    start_s: Tensor,
) -> tuple[Tensor, Tensor]:
    """Cut out the azimuth history of a point in an image.

    Args:
        image: As for `peak_time_s`, like the following arguments.
        prf_hz: Pulse repetition frequency in Hz.
        sample: Range position of the peak in samples.
        rate_hz_s: Magnitude of the Doppler rate in Hz/s.
        seen_s: First and last time at which the record observed the point.
        doppler_hz: Doppler of the point in Hz.
        start_s: Slow time of the peak in seconds.

    Returns:
        The history without its Doppler rate, shape (..., azimuth), zero where the point was not
        observed; and the phasor of its Doppler.
    """
    n = image.shape[-2]
    columns = image.shape[-1]
    weights = torch.sinc(torch.arange(columns, dtype=torch.float64, device=image.device) - sample[..., None])
    # for a point beside the image, the history would consist of side lobes and rounding errors
    weights = weights * ((sample > -1) & (sample < columns))[..., None]
    column = (image * weights[..., None, :].to(image.real.dtype)).sum(-1).to(torch.complex128)
    spectrum = torch.fft.fft(column)
    offset = wrapped(
        torch.fft.fftfreq(n, 1 / prf_hz, dtype=torch.float64, device=image.device) - doppler_hz[..., None], prf_hz
    )
    rate = rate_hz_s[..., None]
    history = torch.fft.ifft(spectrum * cis(math.pi * offset.square() / rate))
    lines = (
        torch.round(start_s[..., None] * prf_hz) - n // 2 + torch.arange(n, dtype=torch.float64, device=image.device)
    )  # pulse numbers relative to the start, with the peak of the response in the middle
    since = lines / prf_hz - start_s[..., None]
    tone = (
        history.gather(-1, torch.remainder(lines, n).long())
        * cis(math.pi * torch.remainder(rate * since.square(), 2))
        * (since >= seen_s[0])
        * (since <= seen_s[1])
    )
    return tone, cis(2 * math.pi * torch.remainder(doppler_hz[..., None] * since, 1))


class PointDoppler(Stage):
    """Doppler centroid of the beam from the brightest point of an image.

    >>> from torchsar import Draws, compensate, echo, focus, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.5), doppler_hz=25.0)
    >>> recording, _ = echo.simulate(strip, world, 256, 64, Draws(1))
    >>> image = focus.OmegaK(strip)(recording.signal, doppler_hz=0.0)
    >>> compensate.PointDoppler(strip)(image, frame_hz=0.0)["doppler_hz"].round(decimals=1)
    tensor(25., dtype=torch.float64)

    Provides `doppler_hz` and `doppler_baseband_hz`. Assumes that the beam centre crosses the point
    at `crossing_s`. The image holds each point at the time when its Doppler equals the frame
    Doppler with which the image was focused. Two limits apply:

    - The Doppler band of the beam must lie within half a PRF of the frame Doppler; frequencies
      outside are aliased in focusing.
    - The centroid must differ from the frame Doppler by less than rate * n / (2 PRF), with the
      Doppler rate in Hz/s and n image lines. Otherwise the point leaves the image at one end and
      appears at the other.

    Args:
        radar: Radar parameters.
        crossing_s: Slow time in seconds at which the beam centre crosses the point; by default that
            of the middle line.
        assess: Whether to add standard deviations, the quality and the outcome.

    Reference:
        Tsvetkov 2017, text after Fig. 5.
    """

    works_on = ("azimuth", "range")
    provides = ("doppler_hz", "doppler_baseband_hz")
    differentiable = "where ok"

    def __init__(self, radar: StripmapRadar, crossing_s: float | None = None, assess: bool = True) -> None:
        super().__init__()
        self.radar, self.crossing_s, self.assess = radar, crossing_s, assess
        self.neutral = nominal_doppler(radar)

    def forward(self, signal: Signal, frame_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Estimate:
        """Estimate the Doppler centroid from an image of axes (azimuth, range).

        Args:
            signal: Focused image, shape (..., azimuth, range), complex.
            frame_hz: Frame Doppler in Hz with which the image was focused; by default
                radar.pointing_doppler_hz.
            velocity_m_s: Effective velocity in m/s with which the image was focused; by default the
                nominal one.

        Returns:
            `doppler_hz` and `doppler_baseband_hz` in Hz, shape (...,), positive when closing.
            The assessment adds their standard deviation, the Cramer-Rao bound of a tone. It uses
            the measured SNR q after compression (info["q"], a power ratio) and the part of the
            dwell that lies in the record, and holds if radar.integration_s is the true dwell.
            `quality` is 1 - 1 / (1 + q). The outcome is EMPTY, or NOISE where noise alone would
            have as high a peak in more than one of 22,000 images; MISFIT where the time at which
            the beam centre crosses the point lies outside the record; and AMBIGUOUS where another
            point has more than a quarter of the power.

        Raises:
            ValueError: If neither `frame_hz` nor radar.pointing_doppler_hz gives the frame Doppler.
        """
        signal = signal.with_data(unit_level(signal.data))
        radar, image, (azimuth, slant) = self.radar, signal.data, signal.axes
        frame = radar.pointing_doppler_hz if frame_hz is None else frame_hz
        if frame is None:
            raise ValueError(
                "PointDoppler: frame_hz, the Doppler (Hz) that the image was focused with, is not known; "
                "connect it with torchsar.use, or set radar.pointing_doppler_hz"
            )
        at, width = power_of(image).flatten(-2).argmax(-1), image.shape[-1]
        line, sample = at // width, at % width
        response = impulse_response(
            signal,
            (azimuth.start + azimuth.step * line.double(), slant.start + slant.step * sample.double()),
            search_m=azimuth.step,
        )
        velocity = radar.velocity_m_s if velocity_m_s is None else velocity_m_s
        position, cos = response["position_range_m"], torch.sqrt(1 - radar.sin_squint(frame, velocity).square())
        rate = (
            radar.azimuth_rate_hz_s(position, velocity) * cos.square()
        )  # Doppler of a point at this slant range in the direction of the frame
        crossing, record = (
            (azimuth.n // 2) / radar.prf_hz
            if self.crossing_s is None
            else self.crossing_s - azimuth.start / radar.velocity_m_s,
            azimuth.n / radar.prf_hz,
        )
        dwell = radar.aperture_s(slant.start)
        seen = max(-dwell / 2, -crossing), min(dwell / 2, record - crossing)
        at_s = (response["position_azimuth_m"] - azimuth.start) / radar.velocity_m_s
        # an image is circular in azimuth: the peak may lie beyond its end
        at_s = crossing + wrapped(at_s - crossing, record)
        value = doppler_at(radar, at_s * radar.velocity_m_s, position, frame, velocity, crossing)
        for _ in range(4):
            at_s = peak_time_s(image, radar.prf_hz, slant.index_of(position), rate, seen, value, at_s)
            value = doppler_at(radar, at_s * radar.velocity_m_s, position, frame, velocity, crossing)
        value, finite = settle(value, 0.0)
        found = Estimate({"doppler_hz": value, "doppler_baseband_hz": wrapped(value, radar.prf_hz)})
        if not self.assess:
            return found
        sees = finite & torch.full_like(finite, 0 <= crossing <= record)
        visible = max(seen[1] - seen[0], 1 / radar.prf_hz)
        cell = radar.prf_hz / (rate * visible), radar.range_resolution_m / slant.step
        history = point_history(image, radar.prf_hz, slant.index_of(position), rate, seen, value, at_s)
        return doppler_assess.of_point(found, image, (line, sample), cell, history, visible, sees)
