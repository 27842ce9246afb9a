"""Azimuth images of points that share one known motion, with filters that are computed once.

In each Doppler bin of the aliased channels, `reconstruct` followed by `focus_azimuth` is the
product with one small matrix from channels to Doppler bands, which contains the exact azimuth
filter. An image then costs little more than its FFTs: use it for Monte Carlo trials or range lines
that share one motion, and the stages `Reconstruct` and `FocusAzimuth` where each trial has its own
velocities.

Reference:
    Remote Sens. 2020, 12, 1703, sections 4.1 and 4.3.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchsar.core import Signal, Stage, unit_phasor
from torchsar.core.fft import block_bytes_of
from torchsar.multichannel.azimuth import azimuth_filter, image_axis
from torchsar.multichannel.channels import refuse_shifted
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import LeastSquares, Rebuild, check_condition, doppler_axis
from torchsar.multichannel.response import doppler_centre_hz, doppler_offsets, shared_response
from torchsar.radar import BistaticRadar


class FocusPlan(Stage):
    """Stage that focuses channels to the azimuth image of points with one known motion.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [30], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 360, None, Draws(seed=1))[0].signal
    >>> image = multichannel.FocusPlan(receiver)(channels)
    >>> image.axis("azimuth").values()[image.data.abs().argmax()].round().item()
    30.0

    The image equals that of `focus_azimuth(reconstruct(data))` times the carrier exp(+j 2 pi f t),
    where f is the Doppler centre, rounded to the nearest bin, and t slow time. The matrices from
    channels to Doppler bands are kept until the number of pulses, the dtype or the device of the
    data changes. A warning is given where the reconstruction is ill-conditioned. Differentiable in
    the data.

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
        self._matrix: Tensor | None = None

    def matrix(self, data: Tensor) -> Tensor:
        """Return the weights for data of this shape, dtype and device, (band, channel, pulse).

        They combine the FFTs of the channels to the FFT of the image.

        Raises:
            ValueError: If the reconstruction is singular, or there are too few channels for the
                bands.
        """
        kept, needed = self._matrix, (data.shape[-1], data.dtype, data.device)
        if kept is None or (kept.shape[-1], kept.dtype, kept.device) != needed:
            check_condition(self.radar, self.motion, self.rebuild, data.dtype)
            motion = self.motion.each(lambda value: value.to(data.device))
            made = _matrix(self.radar, motion, data.shape[-1], self.rebuild, self.bandwidth_hz)
            kept = self._matrix = made.to(data.dtype)
        return kept

    def forward(self, signal: Signal) -> Signal:
        """Focus channels (channel, pulse) to an image (azimuth,).

        Returns:
            Image with azimuth x = V_R t in metres, V_R being the speed of the receiver and t slow
            time.

        Raises:
            ValueError: If slow time is not zero at pulse n // 2, the reconstruction is singular, or
                there are too few channels for the bands.
        """
        data, pulse = signal.data, signal.axis("pulse")
        refuse_shifted(self.radar, pulse)
        axis, matrix = image_axis(self.radar, doppler_axis(self.radar, pulse.n, self.rebuild.bands)), self.matrix(data)
        if data.shape[-2] != matrix.shape[1]:
            raise ValueError(
                f"FocusPlan: the radar has {matrix.shape[1]} channels, got data of {data.shape[-2]}; give all channels"
            )
        tangent = forward_ad.unpack_dual(data).tangent
        if tangent is not None or (torch.is_grad_enabled() and data.requires_grad):
            bands = torch.einsum("bmp,...mp->...bp", matrix, torch.fft.fft(data))
            return Signal(torch.fft.ifft(bands.flatten(-2)), (axis,))
        rows = data.reshape(-1, *data.shape[-2:])
        image = rows.new_empty(len(rows), axis.n)
        # blocks of a few trials fit into the cache
        height = max(1, block_bytes_of(data.device) // (matrix[0].numel() * data.element_size()))
        for part, out in zip(rows.split(height), image.split(height)):
            torch.fft.ifft(_combined(matrix, torch.fft.fft(part)).flatten(-2), out=out)
        return Signal(image.view(*signal.trials, -1), (axis,))


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
    # slow time zero is in the middle of the data and of the image
    turns = torch.remainder(bins, n) * (n // 2) / n - bins * (total // 2) / total
    natural = torch.zeros_like(found)
    natural[bins.long()] = found * unit_phasor(turns, torch.complex128)[:, None]
    return natural.view(bands, n, radar.channels).mT.contiguous()


def _combined(matrix: Tensor, spectrum: Tensor) -> Tensor:
    """Combine spectra (trial, channel, pulse) to bands (trial, band, pulse) in place."""
    bands = spectrum.new_empty(len(spectrum), *matrix.shape[::2])
    for weights, band in zip(matrix, bands.unbind(1)):
        torch.mul(spectrum[:, 0], weights[0], out=band)
        for channel in range(1, len(weights)):
            band.addcmul_(spectrum[:, channel], weights[channel])
    return bands
