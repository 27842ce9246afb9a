"""Reconstruction and focusing for one motion as a plan: everything that does not depend on the data
is formed once, and an image costs little more than its transforms.

Per alias frequency the chain of `reconstruct` and `focus_azimuth` is one small matrix from channels
to Doppler bands, the exact filter and the places of time zero included. For Monte Carlo trials, for
many range lines, and for whatever else shares its motion; where each trial has its own velocities
the chain of two stages serves.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, block_bytes_of, unit_phasor
from torchsar.multichannel.azimuth import azimuth_filter, image_axis
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import doppler_axis, mind_condition, refuse_shifted
from torchsar.multichannel.response import LeastSquares, Rebuild, doppler_centre_hz, doppler_offsets, shared_response
from torchsar.radar import BistaticRadar


class AzimuthPlan:
    """`image(data)`: channels (..., channel, pulse) to the focused image (..., bands * pulse) of
    points with one motion, slow time zero at sample bands * pulse // 2.

    The image is that of `focus_azimuth(reconstruct(data))` times the carrier of its Doppler centre,
    exp(+j 2 pi f t), the centre taken to the nearest bin. motion: without trials. Raises ValueError
    for a motion with trials, and where the bands cannot be told apart by so many channels.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        motion: PointMotion,
        n_pulse: int,
        rebuild: Rebuild | None = None,
        bandwidth_hz: float | None = None,
        dtype: torch.dtype = torch.complex64,
    ) -> None:
        rebuild = LeastSquares() if rebuild is None else rebuild
        why = rebuild.refusal(radar.channels)
        if why is not None:
            raise ValueError(why)
        if motion.u_r_m_s.ndim or motion.u_a_m_s.ndim or motion.y0_m.ndim or motion.range_m.ndim:
            raise ValueError(
                "a plan serves one motion, got one with trials; use Reconstruct and FocusAzimuth "
                "where each trial has its own velocities"
            )
        self.bands, self.n_pulse = rebuild.bands, n_pulse
        self.matrix = _matrix(radar, motion, n_pulse, rebuild, bandwidth_hz).to(dtype)

    def image(self, data: Tensor) -> Tensor:
        """data: complex (..., channel, pulse) of the plan's dtype. Differentiable in the data."""
        if data.dtype != self.matrix.dtype or data.shape[-2:] != self.matrix.shape[-2:]:
            expected = f"(..., {self.matrix.shape[-2]}, {self.matrix.shape[-1]}) of {self.matrix.dtype}"
            raise ValueError(
                f"this plan works on channels and pulses {expected}, got {tuple(data.shape)} of {data.dtype}"
            )
        if torch.is_grad_enabled() and data.requires_grad:
            spectrum = torch.fft.fft(data)
            return torch.fft.ifft(torch.einsum("bmp,...mp->...bp", self.matrix, spectrum).flatten(-2))
        rows = data.reshape(-1, *data.shape[-2:])
        image = rows.new_empty(len(rows), self.bands * self.n_pulse)
        # a few trials at a time stay in the cache
        height = max(1, block_bytes_of(data.device) // (self.matrix[0].numel() * data.element_size()))
        for part, out in zip(rows.split(height), image.split(height)):
            torch.fft.ifft(self._bands(torch.fft.fft(part)).flatten(-2), out=out)
        return image.view(*data.shape[:-2], -1)

    def _bands(self, spectrum: Tensor) -> Tensor:
        """Spectra (trial, channel, pulse) to bands (trial, band, pulse), in place as far as it
        goes.
        """
        bands = spectrum.new_empty(len(spectrum), self.bands, self.n_pulse)
        for weights, band in zip(self.matrix, bands.unbind(1)):
            torch.mul(spectrum[:, 0], weights[0], out=band)
            for channel in range(1, len(weights)):
                band.addcmul_(spectrum[:, channel], weights[channel])
        return bands


def _matrix(radar: BistaticRadar, motion: PointMotion, n: int, rebuild: Rebuild, bandwidth_hz: float | None) -> Tensor:
    """Weights (band, channel, pulse), complex128, from the FFT of channels to that of the image,
    all bins in FFT order.
    """
    bands, total, step = rebuild.bands, rebuild.bands * n, radar.prf_hz / n
    centre_hz = doppler_centre_hz(radar, motion)
    middle_hz = torch.round(centre_hz / step) * step
    offset = doppler_offsets(n, bands, radar.prf_hz, middle_hz.device)
    weights = rebuild.weights(radar, motion, n)
    weights = (
        (weights if weights.ndim == 3 else weights.expand(n, -1, -1)).transpose(0, 1).reshape(total, radar.channels)
    )
    delay = radar.channels_at(offset.device) / motion.effective_m_s
    seen = (
        shared_response(radar, motion, n, bands, torch.complex128)
        * unit_phasor(-(middle_hz - centre_hz) * delay, torch.complex128)[:, None]
    )
    found = (
        bands
        * weights
        * seen.conj().mT.repeat(bands, 1)
        * azimuth_filter(offset, radar, motion, torch.complex128, middle_hz)[:, None]
    )
    if bandwidth_hz is not None:
        found = found * ((middle_hz + offset - centre_hz).abs() <= bandwidth_hz / 2)[:, None]
    bins = torch.remainder(torch.round((middle_hz + offset) / step), total)
    # slow time is zero in the middle of the data and of the image
    turns = torch.remainder(bins, n) * (n // 2) / n - bins * (total // 2) / total
    natural = torch.zeros_like(found)
    natural[bins.long()] = found * unit_phasor(turns, torch.complex128)[:, None]
    return natural.view(bands, n, radar.channels).mT.contiguous()


class FocusPlan(Stage):
    """Channels (channel, pulse) to the image (azimuth,) of points with one motion told beforehand,
    x = V_R t (m): `AzimuthPlan` as a stage.

    Its plan is kept as long as pulses, dtype and device of the data stay. Arguments as Reconstruct
    and FocusAzimuth have them, velocities as numbers. Refuses motions at which channels sample the
    same places, and warns of poor ones.
    """

    works_on = ("channel", "pulse")

    def __init__(
        self,
        radar: BistaticRadar,
        rebuild: Rebuild | None = None,
        bandwidth_hz: float | None = None,
        u_r_m_s: float = 0.0,
        u_a_m_s: float = 0.0,
        y0_m: float = 0.0,
        range_m: float | None = None,
    ) -> None:
        super().__init__()
        self.radar, self.rebuild, self.bandwidth_hz = radar, rebuild or LeastSquares(), bandwidth_hz
        self.motion = PointMotion.of(radar, torch.zeros(()), u_r_m_s, u_a_m_s, y0_m, range_m)
        self._plan: AzimuthPlan | None = None

    def plan(self, data: Tensor) -> AzimuthPlan:
        """For data like these, formed at the first call."""
        kept = None if self._plan is None else (self._plan.n_pulse, self._plan.matrix.dtype, self._plan.matrix.device)
        if self._plan is None or kept != (data.shape[-1], data.dtype, data.device):
            mind_condition(self.radar, self.motion, self.rebuild, data.dtype)
            motion = self.motion.each(lambda value: value.to(data.device))
            self._plan = AzimuthPlan(self.radar, motion, data.shape[-1], self.rebuild, self.bandwidth_hz, data.dtype)
        return self._plan

    def forward(self, signal: Signal) -> Signal:
        pulse = signal.axis("pulse")
        refuse_shifted(self.radar, pulse)
        return Signal(
            self.plan(signal.data).image(signal.data),
            (image_axis(self.radar, doppler_axis(self.radar, pulse.n, self.rebuild.bands)),),
        )
