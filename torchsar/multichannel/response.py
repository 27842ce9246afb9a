"""Responses of several channels to the Doppler bands that their pulse rate aliases.

Up to a constant phase, channel m at the along-track position dx_m is the reference channel delayed
by dx_m / v_e, with the relative sensor velocity v_e of Eq. (25). Its response to band b has the
factor exp(-j 2 pi b PRF dx_m / v_e), which differs between channels.

Common parts of all stages on channels: their axes, and the checks of channels and of
slow time.

Reference:
    Remote Sens. 2020, 12, 1703, Eqs. (25)-(27) and (34). The constant phase is that of Eq. (34);
    the printed Eq. (27) has wrong signs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, Stage, checked_samples, linear_phasor, unit_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar


class ChannelStage(Stage):
    """Base class of stages on channels (channel, pulse[, range]) of a radar.

    Args:
        radar: Radar parameters.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar


def checked_channels(
    data: Tensor, radar: BistaticRadar, what: str, dims: str = "channel, pulse", *, finite: bool = True
) -> Tensor:
    """Check the samples of several channels, and resolve lazy conjugation and negation.

    Args:
        data: Samples, shape (..., *dims), complex64 or complex128.
        radar: Radar parameters.
        what: Name of the function for the message.
        dims: Names of the trailing dimensions, of which one is "channel".
        finite: Whether NaN and Inf are refused.

    Returns:
        The samples.

    Raises:
        TypeError: If the data are not a tensor of these dtypes.
        ValueError: If the data have no samples or too few dimensions, do not have one channel for
            each position of the radar, or a sample is not finite.
    """
    data, names = checked_samples(data, what, dims, finite=finite), dims.split(", ")
    if data.shape[names.index("channel") - len(names)] != radar.channels:
        raise ValueError(
            f"{what} works on samples (..., {dims}) with one channel for each of the {radar.channels} positions in "
            f"the radar's channel_m, got the shape {tuple(data.shape)}; select the same channels in radar and data"
        )
    return data


def refuse_other_count(what: str, count: int, noun: str, **values: Tensor | None) -> None:
    """Raise ValueError unless values hold one number per channel, or per pulse.

    Args:
        what: Name of the function for the message.
        count: Number of channels or pulses.
        noun: "channel" or "pulse".
        **values: Values by name, shape (..., count), or None.
    """
    for name, value in values.items():
        if value is not None and value.shape[-1:] != (count,):
            raise ValueError(
                f"{what} needs {name} of shape (..., {count}), one value per {noun}, got shape {tuple(value.shape)}"
            )


def refuse_shifted(radar: BistaticRadar, pulse: Axis) -> None:
    """Raise ValueError unless slow time is zero at pulse n // 2 and pulses come at the radar's PRF.

    Reconstruction and focusing count phases from slow time zero.

    Args:
        radar: Radar parameters.
        pulse: Slow-time axis of the data.
    """
    expected = radar.pulse_axis(pulse.n)
    start, step = abs(pulse.start - expected.start), abs(pulse.step - expected.step)
    if start > 1e-6 * expected.step or step > 1e-9 * expected.step:
        raise ValueError(
            f"slow time must be zero at pulse {pulse.n // 2} of {pulse.n}, in steps of 1 / "
            f"{radar.prf_hz:g} s, got a first pulse at {pulse.start:g} s in steps of "
            f"{pulse.step:g} s; "
            "if pulses were cropped, crop as many from the other end; otherwise check prf_hz of the radar"
        )


def first_bin(n_pulse: int, bands: int) -> int:
    """Return the index of the lowest Doppler bin relative to the centre.

    The bands * n_pulse bins rise from this index, PRF / n_pulse apart.

    Args:
        n_pulse: Number of pulses.
        bands: Number of Doppler bands.

    Returns:
        Index, not positive.
    """
    return -(bands * n_pulse // 2)


def doppler_offsets(n_pulse: int, bands: int, prf_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Return the Doppler of all bins of a reconstructed spectrum relative to its centre.

    >>> from torchsar import multichannel
    >>> multichannel.doppler_offsets(n_pulse=2, bands=3, prf_hz=180.0).tolist()
    [-270.0, -180.0, -90.0, 0.0, 90.0, 180.0]

    Args:
        n_pulse: Number of pulses.
        bands: Number of bands.
        prf_hz: Pulse repetition frequency in Hz.
        device: Device of the result.

    Returns:
        Doppler offsets in Hz, rising, float64 (bands * n_pulse,).
    """
    return (torch.arange(bands * n_pulse, dtype=torch.float64, device=device) + first_bin(n_pulse, bands)) * (
        prf_hz / n_pulse
    )


def band_matrix(radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """Return the part of the channel response that differs between Doppler bands.

    It is exp(-j 2 pi b PRF dx_m / v_e) in band b for the channel at the along-track position dx_m,
    with the relative sensor velocity v_e = V^2 / v. Here v is the along-track speed of the receiver
    relative to the point, and V^2 = v^2 + u_r^2 with the slant-range speed u_r of the point.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        bands: Number of bands; b is counted from the lowest one.

    Returns:
        The matrix, complex128 (..., channel, band).

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (25), (34).
    """
    band = torch.arange(bands, dtype=torch.float64, device=motion.u_r_m_s.device)
    delay = radar.channels_at(band.device)[:, None] / motion.effective_m_s[..., None, None]
    return unit_phasor(-radar.prf_hz * band * delay, torch.complex128)


def shared_response(
    radar: BistaticRadar, motion: PointMotion, n_pulse: int, bands: int, dtype: torch.dtype, left_k1_m_s: float = 0.0
) -> Tensor:
    """Return the part of the channel response that all Doppler bands share.

    For the channel at the along-track position dx it is exp(-j 2 pi (f dx / v_e + C / (2 R0
    lambda))) with C = dx^2 - (v dx^2 + 2 R0 u_r dx) / v_e + 2 y0 dx u_r^2 / V^2. Here f is u_r /
    lambda plus the Doppler of the bin in the lowest band relative to the Doppler centre, v is the
    along-track speed of the receiver relative to the point, u_r the slant-range speed of the point,
    V^2 = v^2 + u_r^2, v_e = V^2 / v, y0 the along-track position at t = 0 and R0 the closest range.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        n_pulse: Number of pulses.
        bands: Number of bands.
        dtype: Complex dtype of the result.
        left_k1_m_s: Rate k1 in m/s of the linear term k1 t of the transmit range, if this term is
            still in the phase; 0 if it was removed. The response does not depend on it.

    Returns:
        The response, shape (..., channel, n_pulse), complex.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (7), (34); C is extended by the along-track position y0.
    """
    dx = radar.channels_at(motion.u_r_m_s.device)
    m = motion.each(lambda value: value[..., None])
    constant = (
        dx.square()
        - (m.along_m_s * dx.square() + 2 * m.range_m * m.u_r_m_s * dx) / m.effective_m_s
        + 2 * m.y0_m * dx * m.u_r_m_s.square() / m.square_m2_s2
    )
    delay = dx / m.effective_m_s
    centre_hz = doppler_centre_hz(radar, m, left_k1_m_s)
    fixed = -centre_hz * delay - (constant / (2 * m.range_m) + left_k1_m_s * delay) / radar.wavelength_m
    return unit_phasor(fixed, dtype)[..., None] * linear_phasor(
        -delay * (radar.prf_hz / n_pulse), first_bin(n_pulse, bands), n_pulse, dtype
    )


def doppler_centre_hz(radar: BistaticRadar, motion: PointMotion, left_k1_m_s: float = 0.0) -> Tensor:
    """Return the Doppler centre (u_r - k1) / lambda of a point with the slant-range speed u_r.

    It is the Doppler frequency while the point is at broadside.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        left_k1_m_s: Rate k1 in m/s of the linear term k1 t of the transmit range, if this term is
            still in the phase; 0 if it was removed.

    Returns:
        Doppler in Hz, shape (...,).

    Reference:
        Remote Sens. 2020, 12, 1703, Eq. (39), for k1 = 0.
    """
    return (motion.u_r_m_s - left_k1_m_s) / radar.wavelength_m


@dataclass(frozen=True)
class ElementPattern:
    """Expected power over Doppler by the one-way antenna pattern of a channel.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> offset_hz = torch.tensor([0.0, 90.0, 180.0])
    >>> multichannel.ElementPattern().power(offset_hz, receiver, still).round(decimals=1).tolist()
    [1.0, 0.8, 0.4]

    The pattern is sinc^2(L sin(look) / lambda) with the length L = `radar.element_m` of the
    aperture of a channel. The look angle from broadside follows from sin(look) = -lambda offset /
    v, with the Doppler offset from the centre and the along-track speed v of the receiver relative
    to the point.
    """

    def power(self, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion) -> Tensor:
        """Return the expected power relative to its peak: the antenna pattern over Doppler.

        Args:
            offset_hz: Doppler relative to the Doppler centre in Hz, any shape.
            radar: Radar parameters.
            motion: Motion of the point, shape (...,).

        Returns:
            Power ratio, (...,) followed by the shape of `offset_hz`.
        """
        return torch.sinc(radar.element_m * offset_hz / motion.along_m_s[(...,) + (None,) * offset_hz.ndim]).square()


@dataclass(frozen=True)
class FlatBand:
    """Expected power that is equal within a band about the Doppler centre and zero outside.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> offset_hz = torch.tensor([0.0, 90.0, 180.0])
    >>> multichannel.FlatBand(250.0).power(offset_hz, receiver, still).tolist()
    [1.0, 1.0, 0.0]

    Args:
        bandwidth_hz: Width of the band in Hz.

    Raises:
        ValueError: If the bandwidth is not positive.
    """

    bandwidth_hz: float

    def __post_init__(self) -> None:
        if not self.bandwidth_hz > 0:
            raise ValueError(f"bandwidth_hz of a flat band must be positive, got {self.bandwidth_hz}")

    def power(self, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion) -> Tensor:
        """Return 1 inside the band and 0 outside, in the shape of `offset_hz`."""
        return (offset_hz.abs() <= self.bandwidth_hz / 2).to(torch.float64)


# expected power of the echoes over Doppler
Prior = ElementPattern | FlatBand
