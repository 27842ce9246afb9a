"""Azimuth focusing of a moving point with the exact range history of an airborne receiver.

`known_motion_chain` builds the chain of stages that leads to it.

Azimuth images of points that share one known motion, with filters that are computed once.

In each Doppler bin of the aliased channels, `reconstruct` followed by `focus_azimuth` is the
product with one small matrix from channels to Doppler bands, which contains the exact azimuth
filter. An image then costs little more than its FFTs: use it for Monte Carlo trials or range lines
that share one motion, and the stages `Reconstruct` and `FocusAzimuth` where each trial has its own
velocities.

Reference:
    Remote Sens. 2020, 12, 1703, sections 4.1 and 4.3. The filter is the exact spectrum of the
    hyperbolic range history, including an along-track position y0 of the point at slow time zero.
    Remote Sens. 2020, 12, 1703, sections 4.1 and 4.3.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchsar.core import (
    Axis,
    Chain,
    Signal,
    Stage,
    centred_ifft,
    checked_samples,
    per_trial,
    real_dtype,
    unit_phasor,
    use,
)
from torchsar.core.fft import block_bytes_of
from torchsar.multichannel.migration import CorrectMigration, Migration
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.reconstruct import LeastSquares, Rebuild, Reconstruct, check_condition, doppler_axis
from torchsar.multichannel.response import doppler_centre_hz, doppler_offsets, refuse_shifted, shared_response
from torchsar.multichannel.transmit import CompressChannels, RemoveTransmitRange
from torchsar.radar import BistaticRadar


def azimuth_filter(
    offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion, dtype: torch.dtype, centre_hz: Tensor | None = None
) -> Tensor:
    """Return the matched filter of a point with a given motion over Doppler.

    The filter exp(+j 2 pi / lambda (Rmin sqrt(1 - (lambda f / V)^2) - R_ref)) removes the curvature
    of the phase of the spectrum. Here f is the absolute Doppler frequency, Rmin the least range
    between the receiver and the point, V their relative speed, and R_ref the reference range of the
    radar, to which echo phases refer. Differentiable in the motion.

    Args:
        offset_hz: Doppler relative to the centre in Hz, float64 (bin,).
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        dtype: Complex dtype of the result.
        centre_hz: Doppler centre in Hz, shape (...,), by default that of the motion.

    Returns:
        The filter, shape (..., bin), complex, zero at |f| >= V / lambda, where a point of this
        speed has no spectrum.
    """
    centre_hz = doppler_centre_hz(radar, motion) if centre_hz is None else centre_hz
    sine = radar.wavelength_m * (centre_hz[..., None] + offset_hz) / motion.square_m2_s2.sqrt()[..., None]
    real = sine.detach().abs() < 1
    square = torch.where(real, sine, 0.0).square()
    closest = motion.closest_m[..., None]
    # written as a sum of differences, Rmin sqrt(1 - s^2) - R_ref keeps its precision
    path = (closest - radar.reference_range_m) - closest * square / (1 + torch.sqrt(1 - square))
    return unit_phasor(path / radar.wavelength_m, dtype) * real.to(real_dtype(dtype))


def focus_azimuth(
    spectrum: Tensor, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion, bandwidth_hz: float | None = None
) -> Tensor:
    """Focus reconstructed spectra to azimuth images over slow time.

    Differentiable in spectrum and motion.

    Args:
        spectrum: Reconstructed spectra about the Doppler centre of the motion, shape (..., bin),
            complex.
        offset_hz: Doppler relative to the centre in Hz, float64 (bin,).
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        bandwidth_hz: Processed Doppler bandwidth about the centre in Hz, None for the whole
            spectrum.

    Returns:
        Images over slow time, shape (..., bin), complex, with time zero at bin n // 2. A point
        appears at the slow time `motion.image_s` at which its Doppler is zero.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    spectrum = checked_samples(spectrum, "focus_azimuth", "doppler", finite=False)
    matched = azimuth_filter(offset_hz, radar, motion, spectrum.dtype)
    if bandwidth_hz is not None:
        matched = matched * (offset_hz.abs() <= bandwidth_hz / 2)
    return centred_ifft(spectrum * matched)


class FocusAzimuth(Stage):
    """Stage that focuses one target per trial in azimuth, with its velocities.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [30], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 360, None, Draws(seed=1))[0].signal
    >>> image = multichannel.FocusAzimuth(receiver)(multichannel.Reconstruct(receiver)(channels))
    >>> image.axis("azimuth").values()[image.data.abs().argmax()].round().item()
    30.0

    The input is a spectrum (doppler[, range]) of `Reconstruct`, the output an image (azimuth[,
    range]). Azimuth is x = V_R t in metres, with the speed V_R of the receiver and slow time t. A
    width w on this axis is a width w (V_R - u_a) / V_R along a target that moves at the along-track
    speed u_a. All range lines are focused for a single range, since a separate range for each line
    would curve the range side lobes of the target. Use `StationaryImage` for a whole stationary
    scene.

    Args:
        radar: Radar parameters.
        bandwidth_hz: Processed Doppler bandwidth about the centre in Hz, None for the whole
            spectrum.

    Raises:
        ValueError: If `bandwidth_hz` is not positive and finite.
    """

    works_on = ("doppler",)
    also_on = (("doppler", "range"),)

    def __init__(self, radar: BistaticRadar, bandwidth_hz: float | None = None) -> None:
        super().__init__()
        self.radar, self.bandwidth_hz = radar, bandwidth_hz
        if bandwidth_hz is not None and not 0 < bandwidth_hz < float("inf"):
            raise ValueError(f"bandwidth_hz must be positive, or None for the whole spectrum, got {bandwidth_hz}")

    def forward(
        self,
        signal: Signal,
        u_r_m_s: Number = 0.0,
        u_a_m_s: Number = 0.0,
        y0_m: Number = 0.0,
        range_m: Number | None = None,
    ) -> Signal:
        """Focus one target per trial in azimuth.

        Args:
            signal: Spectrum with the axes (doppler[, range]).
            u_r_m_s: Slant-range speed in m/s, closing positive, shape (...,) or a number.
            u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver,
                same shape.
            y0_m: Along-track position at t = 0 in metres, same shape.
            range_m: Closest range R0 in metres, same shape. By default that of the strongest range
                line, or the reference range of the radar where there is no range axis.

        Returns:
            Image with the axes (azimuth[, range]) in metres.
        """
        lines, doppler = "range" in signal.names, signal.axis("doppler")
        near = self.radar.reference_range_m if range_m is None else range_m
        if range_m is None and lines:
            across, energy = signal.axis("range"), signal.data.detach().abs().square().sum(-2)
            near = across.start + across.step * energy.argmax(-1).to(torch.float64)
        u_r, u_a, y0, near = (per_trial(value, int(lines), signal.data) for value in (u_r_m_s, u_a_m_s, y0_m, near))
        motion = PointMotion.of(self.radar, signal.data, u_r, u_a, y0, near)
        data = signal.data.mT if lines else signal.data
        image = focus_azimuth(data, doppler.values(data.device), self.radar, motion, self.bandwidth_hz)
        return Signal(image.mT if lines else image, (image_axis(self.radar, doppler), *signal.axes[1:]))


def image_axis(radar: BistaticRadar, doppler: Axis) -> Axis:
    """Return the azimuth axis x = V_R t in metres of the image that a Doppler spectrum gives.

    V_R is the speed of the receiver and t the slow time.

    Args:
        radar: Radar parameters.
        doppler: Doppler axis of the spectrum.

    Returns:
        Azimuth axis with as many samples as the Doppler axis.
    """
    time = doppler.dual()
    return Axis("azimuth", time.n, time.start * radar.speed_m_s, time.step * radar.speed_m_s, "m")


def known_motion_chain(
    radar: BistaticRadar,
    rebuild: Rebuild,
    bandwidth_hz: float | None = None,
    migration: Migration | None = None,
    order: int | None = None,
    full: bool = False,
    follow: bool = True,
) -> Chain:
    """Build the chain of stages from channels to the images of points of known motion.

    When it is run, the chain needs the motion of each point under the names `given.u_r_m_s`,
    `given.u_a_m_s`, `given.y0_m` and `given.range_m`, each of shape (trial,). These are slant-range
    and along-track speed in m/s, along-track position and closest range in metres.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction of the Doppler bands.
        bandwidth_hz: Width of the Doppler band that is focused in Hz; None for the whole
            reconstructed band.
        migration: Correction of range migration; None for azimuth-only data.
        order: Highest power of slow time in the transmit range that is removed from the phase; None
            for all.
        full: Whether the data are full chirps, which are then compressed in range first.
        follow: Whether the migration is corrected with the known motion, instead of that of a point
            at rest.

    Returns:
        The chain.
    """
    known = {name: f"given.{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}
    stages: dict[str, nn.Module] = {"compress": CompressChannels(radar, "flat")} if full else {}
    stages["remove"] = RemoveTransmitRange(radar, order)
    if migration is not None:
        stages["correct"] = use(CorrectMigration(radar, migration), **(known if follow else {}))
    stages["rebuild"] = use(Reconstruct(radar, rebuild), **known)
    stages["focus"] = use(FocusAzimuth(radar, bandwidth_hz), **known, range_m="given.range_m")
    return Chain(**stages)


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
