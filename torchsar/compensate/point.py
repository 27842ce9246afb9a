"""Doppler of the beam from the place of one point in a focused image (Tsvetkov 2017, text after
Fig. 5).

A point whose crossing of the beam centre is known, such as a corner reflector, tells the Doppler at
that time by where it lies along azimuth: an image holds it at the time when its Doppler is that of
the image's frame. The place of a peak is known to 0.39 / (T sqrt(q)) in Doppler, the Cramer-Rao
bound of a tone, which no estimator of the beam's envelope can reach through one point.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.doppler import point_doppler, wrap_hz
from torchsar.core import Estimate, Signal, Stage, cis, settle
from torchsar.metrics.bounds import tone_frequency_bound_hz
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
    """Doppler at the slow time crossing_s of a point that an image of frame frame_hz holds at
    (azimuth_m, slant_m), Hz, positive when closing.

    All arguments broadcast. Exact for a straight path; the inverse of StripmapRadar.image_position.
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
    """Refine the slow time start_s (...,), counted from the first line, of a peak at one range
    position; maximum likelihood.

    image: (..., azimuth, range); sample: range position (...,), fractional. The column is spread
    out again to the azimuth history of the point about its Doppler doppler_hz (...,), of which only
    seen_s is kept: an image passes the noise of all lines and of the whole PRF. rate_hz_s:
    magnitude of the Doppler rate; seen_s: when the record saw the point, from and to, counted from
    the beam's crossing.
    """
    n = image.shape[-2]
    weights = torch.sinc(torch.arange(image.shape[-1], dtype=torch.float64, device=image.device) - sample[..., None])
    spectrum = torch.fft.fft((image * weights[..., None, :].to(image.real.dtype)).sum(-1).to(torch.complex128))
    offset = wrap_hz(
        torch.fft.fftfreq(n, 1 / prf_hz, dtype=torch.float64, device=image.device) - doppler_hz[..., None], prf_hz
    )
    rate = torch.as_tensor(rate_hz_s, dtype=torch.float64, device=image.device)[..., None]
    history = torch.fft.ifft(spectrum * cis(math.pi * offset.square() / rate))
    lines = (
        torch.round(start_s[..., None] * prf_hz) - n // 2 + torch.arange(n, dtype=torch.float64, device=image.device)
    )  # the peak in the middle
    since = lines / prf_hz - start_s[..., None]
    tone = (
        history.gather(-1, torch.remainder(lines, n).long())
        * cis(math.pi * torch.remainder(rate * since.square(), 2))
        * (since >= seen_s[0])
        * (since <= seen_s[1])
    )
    return start_s + (point_doppler(tone, prf_hz, centre_hz=doppler_hz) - doppler_hz) / rate[..., 0]


class PointDoppler(Stage):
    """`doppler_hz` (...,) of the beam from the brightest point of an image (..., azimuth, range),
    which the beam centre crosses at crossing_s.

    Tsvetkov 2017, text after Fig. 5. crossing_s: slow time, the middle line by default.

    frame_hz, velocity_m_s: those of the image; by default the radar's pointing and its nominal
    velocity. The band of the beam must lie within half a PRF of the frame (focusing folds what does
    not), and its Doppler within half the length of the image, rate * n / (2 PRF). std: the bound of
    a tone at the measured q (info), for the part of the dwell that the record saw; it holds where
    radar.integration_s is the true dwell. ok where the crossing lies within the record and the peak
    is higher than noise alone would have it once in 10,000 images. Raises ValueError where neither
    the radar nor a connected value says what the frame is.
    """

    works_on = ("azimuth", "range")
    provides = ("doppler_hz", "doppler_baseband_hz")

    def __init__(self, radar: StripmapRadar, crossing_s: float | None = None) -> None:
        super().__init__()
        self.radar, self.crossing_s = radar, crossing_s

    @torch.no_grad()
    def forward(self, signal: Signal, frame_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Estimate:
        radar, image, (azimuth, slant) = self.radar, signal.data, signal.axes
        frame = radar.pointing_doppler_hz if frame_hz is None else frame_hz
        if frame is None:
            raise ValueError(
                "PointDoppler needs the frame of the image: set radar.pointing_doppler_hz, or "
                "connect frame_hz with the Doppler that the image was focused with"
            )
        power = image.real.square() + image.imag.square()
        line, sample = torch.unravel_index(power.flatten(-2).argmax(-1), power.shape[-2:])
        found = impulse_response(
            signal,
            (azimuth.start + azimuth.step * line.double(), slant.start + slant.step * sample.double()),
            search_m=azimuth.step,
        )
        velocity = radar.velocity_m_s if velocity_m_s is None else velocity_m_s
        position, cos = found["position_range_m"], torch.sqrt(1 - radar.sin_squint(frame, velocity).square())
        rate = (
            radar.azimuth_rate_hz_s(position, velocity) * cos.square()
        )  # of a point at this slant range in the direction of the frame
        crossing, record = (
            (azimuth.n // 2) / radar.prf_hz
            if self.crossing_s is None
            else self.crossing_s - azimuth.start / radar.velocity_m_s,
            azimuth.n / radar.prf_hz,
        )
        dwell = radar.aperture_s(slant.start)
        seen = max(-dwell / 2, -crossing), min(dwell / 2, record - crossing)
        at_s = (found["position_azimuth_m"] - azimuth.start) / radar.velocity_m_s
        # an image is circular: the peak may lie beyond its end
        at_s = crossing + wrap_hz(at_s - crossing, record)
        value = doppler_at(radar, at_s * radar.velocity_m_s, position, frame, velocity, crossing)
        for _ in range(4):
            at_s = peak_time_s(image, radar.prf_hz, slant.index_of(position), rate, seen, value, at_s)
            value = doppler_at(radar, at_s * radar.velocity_m_s, position, frame, velocity, crossing)
        value, finite = settle(value, 0.0)
        # the mean of an exponential law
        floor = power.flatten(-2).median(-1).values.double() / math.log(2)
        peak_to_noise = found["peak"].abs().square() / torch.where(floor > 0, floor, 1)
        visible = max(seen[1] - seen[0], 1 / radar.prf_hz)
        # the image holds the noise of the whole PRF
        q = peak_to_noise * (radar.prf_hz / (rate * visible)).clamp_min(1)
        std = tone_frequency_bound_hz(q.clamp_min(1e-12), visible)
        return Estimate(
            {"doppler_hz": value, "doppler_baseband_hz": wrap_hz(value, radar.prf_hz)},
            1 - 1 / (1 + q),
            finite & (floor > 0) & (0 <= crossing <= record) & (peak_to_noise > math.log(azimuth.n * slant.n) + 10),
            {"doppler_hz": std, "doppler_baseband_hz": std},
            {"q": q},
        )
