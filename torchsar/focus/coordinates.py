"""From beam coordinates to the range of closest approach, and room for apertures that begin or end
outside of the record.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Signal, Stage, real_dtype
from torchsar.core.select import per_trial
from torchsar.focus.nufft import Nufft
from torchsar.focus.omega_k import Focuser
from torchsar.radar import StripmapRadar


def closest_range(
    image: Tensor,
    radar: StripmapRadar,
    frame_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    eps: float = 1e-5,
) -> Tensor:
    """Resample an image so that its range axis holds the range of closest approach r = R
    cos(squint) instead of the slant range R.

    image: (..., azimuth, range) in the frame Doppler frame_hz (...,). Band-limited interpolation
    with one set of points per trial, of relative error eps; samples from beyond the record wrap. A
    squint of 1.6 degrees moves a target at 1000 km by 400 m. Differentiable.
    """
    n = image.shape[-1]
    sin = radar.sin_squint(
        per_trial(frame_hz, 2, image), per_trial(radar.velocity_m_s if velocity_m_s is None else velocity_m_s, 2, image)
    )
    cosine = torch.sqrt(1 - sin.square())
    # column k shows r = near + k dr, which lies at the slant range r / cos; 1 / cos - 1 is formed
    # without a difference of near ones
    excess = sin.square() / (cosine * (1 + cosine))
    column = torch.arange(n, dtype=torch.float64, device=image.device)
    source = column + (radar.near_range_m / radar.range_step_m + column) * excess
    plan = Nufft(n, eps, image.dtype, image.device)
    spectrum = torch.fft.fftshift(torch.fft.fft(image), dim=-1) / n
    return plan.type2(spectrum, plan.points(-source / n))


class ClosestRange(Stage):
    """Turn the range axis of a focused image into the range of closest approach (zero-Doppler
    range); azimuth stays the beam crossing.

    frame: the radar's nominal pointing where it is known, else the centroid `doppler_hz` that the
    image was focused with.
    """

    works_on = ("azimuth", "range")

    def __init__(self, radar: StripmapRadar, eps: float = 1e-5) -> None:
        super().__init__()
        self.radar, self.eps = radar, eps

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        real_dtype(signal.data.dtype)
        pointing = self.radar.pointing_doppler_hz
        frame = pointing if pointing is not None else doppler_hz
        if frame is None:
            raise ValueError(
                "ClosestRange needs the doppler_hz that the image was focused with; connect it: "
                "use(ClosestRange(radar), doppler_hz='doppler')"
            )
        return signal.with_data(closest_range(signal.data, self.radar, frame, velocity_m_s, self.eps))


class PaddedLines(Stage):
    """Focus with empty lines behind the record, so that apertures cut by its ends do not wrap round
    into the other end.

    lines: how many; None adds one aperture, the time in which a target sweeps one PRF (or the
    nominal dwell). The image keeps the record's lines. Costs the share of added lines in time and
    memory.
    """

    def __init__(self, focuser: Focuser, lines: int | None = None) -> None:
        super().__init__()
        if lines is not None and lines < 0:
            raise ValueError(f"a record is padded by 0 or more lines, got {lines}")
        self.focuser, self.lines = focuser, lines

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        n, radar = signal.axis("pulse").n, self.focuser.radar
        more = radar.aperture_lines(signal.axis("range").stop) if self.lines is None else self.lines
        padded = signal.with_axis(pad(signal.data, (0, 0, 0, more)), pulse=signal.axis("pulse").part(0, n + more))
        return self.focuser(padded, doppler_hz=doppler_hz, velocity_m_s=velocity_m_s).crop(azimuth=(0, n))
