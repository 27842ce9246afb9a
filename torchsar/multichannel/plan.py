"""Reconstruction and focusing for one motion as a precomputed plan.

All that does not depend on the data is computed once, so that an image costs little more than its
FFTs. In each Doppler bin of the aliased channels, `reconstruct` followed by `focus_azimuth` is the
product with one small matrix from channels to Doppler bands, which contains the exact azimuth
filter. Use a plan for Monte Carlo trials or range lines that share one motion; use the stages
`Reconstruct` and `FocusAzimuth` where each trial has its own velocities.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchsar.core import Signal, Stage, block_bytes_of, unit_phasor
from torchsar.core.arguments import names_arguments
from torchsar.multichannel.azimuth import azimuth_filter, image_axis
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import check_condition, doppler_axis, refuse_channels, refuse_shifted
from torchsar.multichannel.response import LeastSquares, Rebuild, doppler_centre_hz, doppler_offsets, shared_response
from torchsar.radar import BistaticRadar


@names_arguments
class AzimuthPlan:
    """Plan that turns channels into focused images of points with one motion.

    The image equals that of `focus_azimuth(reconstruct(data))` times the carrier exp(+j 2 pi f t),
    where f is the Doppler centre, rounded to the nearest bin, and t slow time.

    Args:
        radar: Radar parameters.
        motion: Motion of the points; its tensors have the shape ().
        n_pulse: Number of pulses.
        rebuild: Reconstruction method, `LeastSquares()` by default.
        bandwidth_hz: Processed Doppler bandwidth about the centre in Hz, None for the whole
            spectrum.
        dtype: Complex dtype of the data.

    Raises:
        ValueError: If the motion has trials, or there are too few channels for the bands.
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
        refuse_channels(radar, rebuild)
        if motion.u_r_m_s.ndim or motion.u_a_m_s.ndim or motion.y0_m.ndim or motion.range_m.ndim:
            raise ValueError(
                "a plan serves one motion, got a motion with trial dimensions; use Reconstruct and FocusAzimuth "
                "where each trial has its own velocities"
            )
        self.bands, self.n_pulse = rebuild.bands, n_pulse
        self.matrix = _matrix(radar, motion, n_pulse, rebuild, bandwidth_hz).to(dtype)

    def image(self, data: Tensor) -> Tensor:
        """Focus channels to azimuth images. Differentiable in the data.

        Args:
            data: Channels, shape (..., channel, pulse), complex, of the dtype of the plan.

        Returns:
            Images over slow time, shape (..., bands * pulse), complex, with time zero at sample
            bands * pulse // 2.

        Raises:
            ValueError: If shape or dtype differ from those of the plan.
        """
        if data.dtype != self.matrix.dtype or data.shape[-2:] != self.matrix.shape[-2:]:
            expected = f"(..., {self.matrix.shape[-2]}, {self.matrix.shape[-1]}) of {self.matrix.dtype}"
            raise ValueError(
                f"this plan works on channels and pulses {expected}, got shape {tuple(data.shape)} of {data.dtype}; "
                "build a plan for these data"
            )
        tangent = forward_ad.unpack_dual(data).tangent
        if tangent is not None or (torch.is_grad_enabled() and data.requires_grad):
            spectrum = torch.fft.fft(data)
            return torch.fft.ifft(torch.einsum("bmp,...mp->...bp", self.matrix, spectrum).flatten(-2))
        rows = data.reshape(-1, *data.shape[-2:])
        image = rows.new_empty(len(rows), self.bands * self.n_pulse)
        # blocks of a few trials stay in the cache
        height = max(1, block_bytes_of(data.device) // (self.matrix[0].numel() * data.element_size()))
        for part, out in zip(rows.split(height), image.split(height)):
            torch.fft.ifft(self._bands(torch.fft.fft(part)).flatten(-2), out=out)
        return image.view(*data.shape[:-2], -1)

    def _bands(self, spectrum: Tensor) -> Tensor:
        """Combine spectra (trial, channel, pulse) to bands (trial, band, pulse) in place."""
        bands = spectrum.new_empty(len(spectrum), self.bands, self.n_pulse)
        for weights, band in zip(self.matrix, bands.unbind(1)):
            torch.mul(spectrum[:, 0], weights[0], out=band)
            for channel in range(1, len(weights)):
                band.addcmul_(spectrum[:, channel], weights[channel])
        return bands


def _matrix(radar: BistaticRadar, motion: PointMotion, n: int, rebuild: Rebuild, bandwidth_hz: float | None) -> Tensor:
    """Return weights (band, channel, pulse), complex128, between FFTs of channels and image."""
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
    # slow time zero is the middle of the data and of the image
    turns = torch.remainder(bins, n) * (n // 2) / n - bins * (total // 2) / total
    natural = torch.zeros_like(found)
    natural[bins.long()] = found * unit_phasor(turns, torch.complex128)[:, None]
    return natural.view(bands, n, radar.channels).mT.contiguous()


class FocusPlan(Stage):
    """Stage that focuses channels to the azimuth image of points with one known motion.

    It uses an `AzimuthPlan`, which is kept until the number of pulses, the dtype or the device of
    the data changes. A warning is given where the reconstruction is ill-conditioned.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction method, `LeastSquares()` by default.
        bandwidth_hz: Processed Doppler bandwidth about the centre in Hz, None for the whole
            spectrum.
        u_r_m_s: Slant-range speed in m/s, closing positive.
        u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver.
        y0_m: Along-track position at t = 0 in metres.
        range_m: Closest range in metres, None for the reference range of the radar.

    Raises:
        ValueError: If the motion is impossible, see `PointMotion.of`.
    """

    works_on = ("channel", "pulse")
    takes_empty = False

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
        """Return the focusing plan for data of this shape, dtype and device.

        Raises:
            ValueError: If the reconstruction is singular, or there are too few channels for the
                bands.
        """
        kept = None if self._plan is None else (self._plan.n_pulse, self._plan.matrix.dtype, self._plan.matrix.device)
        if self._plan is None or kept != (data.shape[-1], data.dtype, data.device):
            check_condition(self.radar, self.motion, self.rebuild, data.dtype)
            motion = self.motion.each(lambda value: value.to(data.device))
            self._plan = AzimuthPlan(self.radar, motion, data.shape[-1], self.rebuild, self.bandwidth_hz, data.dtype)
        return self._plan

    def forward(self, signal: Signal) -> Signal:
        """Focus channels (channel, pulse) to an image (azimuth,).

        Returns:
            Image with azimuth x = V_R t in metres, V_R being the speed of the receiver and t slow
            time.

        Raises:
            ValueError: If slow time is not zero at pulse n // 2, the reconstruction is singular, or
                there are too few channels for the bands.
        """
        pulse = signal.axis("pulse")
        refuse_shifted(self.radar, pulse)
        return Signal(
            self.plan(signal.data).image(signal.data),
            (image_axis(self.radar, doppler_axis(self.radar, pulse.n, self.rebuild.bands)),),
        )
