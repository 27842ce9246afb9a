"""Azimuth focusing of a moving point by the exact range history of an airborne receiver, and the
correction of its place.

Source: brief 001, Algorithm 7 (the exact spectrum of a hyperbola with y0); Remote Sens. 2020, 12,
1703, Eq. (30) with the sign corrected.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, centred_ifft, per_trial, real_dtype, unit_phasor
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import doppler_centre_hz
from torchsar.radar import BistaticRadar


def azimuth_filter(
    offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion, dtype: torch.dtype, centre_hz: Tensor | None = None
) -> Tensor:
    """exp(+j 2 pi / lambda (Rmin sqrt(1 - (lambda f / V)^2) - R_ref)), (..., bin) of `dtype`: takes
    the curvature out of the spectrum of a point with this motion.

    offset_hz: float64 (bin,), Doppler against the centre; R_ref: the radar's reference range,
    against which phases of echoes are counted. centre_hz: (...,), by default that of the motion.
    Zero at Doppler that no point of this speed has. Differentiable in the motion.
    """
    centre_hz = doppler_centre_hz(radar, motion) if centre_hz is None else centre_hz
    sine = radar.wavelength_m * (centre_hz[..., None] + offset_hz) / motion.square_m2_s2.sqrt()[..., None]
    real = sine.detach().abs() < 1
    square = torch.where(real, sine, 0.0).square()
    closest = motion.closest_m[..., None]
    # Rmin sqrt(1 - s^2) - R_ref as a sum of differences
    path = (closest - radar.reference_range_m) - closest * square / (1 + torch.sqrt(1 - square))
    return unit_phasor(path / radar.wavelength_m, dtype) * real.to(real_dtype(dtype))


def focus_azimuth(
    spectrum: Tensor, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion, bandwidth_hz: float | None = None
) -> Tensor:
    """Rebuilt spectra (..., bin) about the Doppler centre of the motion to images over slow time
    (..., bin), zero at bin n // 2, a point at `motion.image_s`.

    bandwidth_hz: processed Doppler bandwidth about the centre, None for all. Differentiable in
    spectrum and motion.
    """
    matched = azimuth_filter(offset_hz, radar, motion, spectrum.dtype)
    if bandwidth_hz is not None:
        matched = matched * (offset_hz.abs() <= bandwidth_hz / 2)
    return centred_ifft(spectrum * matched)


class FocusAzimuth(Stage):
    """Spectra (doppler[, range]) of `Reconstruct` to the image (azimuth[, range]) of one target per
    trial with the velocities given, x = V_R t (m) in the frame of the scene.

    Along the track that the target itself sees, x = (speed - u_a) t, everything is (speed - u_a) /
    speed as wide. All lines are focused for one range, that of forward (...,), else that of the
    strongest line, or the radar's reference range where there is no range axis: to focus each for
    its own would bend the range side lobes of the target. (A whole scene at rest:
    `StationaryImage`.) bandwidth_hz: processed Doppler bandwidth about the centre, None for all.
    """

    works_on = ("doppler",)
    also_on = (("doppler", "range"),)

    def __init__(self, radar: BistaticRadar, bandwidth_hz: float | None = None) -> None:
        super().__init__()
        self.radar, self.bandwidth_hz = radar, bandwidth_hz
        if bandwidth_hz is not None and not 0 < bandwidth_hz < float("inf"):
            raise ValueError(f"bandwidth_hz must be positive, or None for all that is rebuilt, got {bandwidth_hz}")

    def forward(
        self,
        signal: Signal,
        u_r_m_s: Number = 0.0,
        u_a_m_s: Number = 0.0,
        y0_m: Number = 0.0,
        range_m: Number | None = None,
    ) -> Signal:
        lines, doppler = "range" in signal.names, signal.axis("doppler")
        near = self._range(signal) if range_m is None else range_m
        u_r, u_a, y0, near = (per_trial(value, int(lines), signal.data) for value in (u_r_m_s, u_a_m_s, y0_m, near))
        motion = PointMotion.of(self.radar, signal.data, u_r, u_a, y0, near)
        data = signal.data.mT if lines else signal.data
        image = focus_azimuth(data, doppler.values(data.device), self.radar, motion, self.bandwidth_hz)
        return Signal(image.mT if lines else image, (image_axis(self.radar, doppler), *signal.axes[1:]))

    def _range(self, signal: Signal) -> Number:
        """Of the strongest line, or of the scene."""
        if "range" not in signal.names:
            return self.radar.reference_range_m
        across = signal.axis("range")
        return across.start + across.step * signal.data.detach().abs().square().sum(-2).argmax(-1).to(torch.float64)


def image_axis(radar: BistaticRadar, doppler: Axis) -> Axis:
    """x = V_R t (m) of the image of a spectrum."""
    time = doppler.dual()
    return Axis("azimuth", time.n, time.start * radar.speed_m_s, time.step * radar.speed_m_s, "m")
