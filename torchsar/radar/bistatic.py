"""Bistatic radar with a far transmitter and a multichannel airborne receiver; range histories."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, numbers_on
from torchsar.radar.instrument import LIGHT_M_S, Instrument
from torchsar.radar.waveform import LinearFM


@dataclass(frozen=True)
class BistaticRadar(Instrument):
    """Bistatic radar: a far transmitter with a low pulse rate, and an airborne receiver.

    >>> from torchsar import radar
    >>> receiver = radar.BistaticRadar(
    ...     carrier_hz=3e9,
    ...     pulse=radar.LinearFM(bandwidth_hz=40e6, duration_s=10e-6),
    ...     sampling_hz=50e6,
    ...     prf_hz=180.0,
    ...     speed_m_s=120.0,
    ...     reference_range_m=5000.0,
    ... )
    >>> receiver.channels, round(receiver.ambiguous_velocity_m_s, 2)
    (3, 17.99)

    The receiver has several channels along its track. The phase of an echo is -2 pi (R_T + R_m) /
    lambda, with the one-way ranges R_T from the transmitter to the target and R_m from the target
    to the channel m. The range axis holds R_m = c tau - R_T, where tau is the delay of the echo, in
    steps of c / sampling_hz. Lengths on it are twice those on the axis c tau / 2, on which
    resolutions are usually quoted. Slow time is zero at pulse n // 2.

    Args:
        carrier_hz: Carrier frequency in Hz.
        pulse: Transmitted pulse.
        sampling_hz: Complex sampling rate in Hz, at least the bandwidth of the pulse.
        prf_hz: Pulse repetition frequency of the transmitter in Hz.
        speed_m_s: Speed of the receiver along its straight, level track in m/s.
        reference_range_m: Closest slant range R0 of the scene centre in metres.
        channel_m: Along-track positions dx_m of the channels in metres, in any order and spacing:
            channel m is where the reference point of the track was dx_m / v earlier, v being the
            speed, so that a channel behind the reference point is positive, as in Remote Sens.
            2020, 12, 1703, Eq. (4).
        element_m: Along-track length of each channel's aperture in metres.
        height_m: Height of the receiver in metres.
        transmit_range: Coefficients k1, k2, ... (m/s, m/s^2, ...) of R_T(t) - R_T(0) = k1 t + k2
            t^2 + ... from the ephemeris, see `range_coefficients`.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If a parameter is not finite or out of range, two channels share a position, or
            the bandwidth of the pulse exceeds the sampling rate.
    """

    carrier_hz: float
    pulse: LinearFM
    sampling_hz: float
    prf_hz: float
    speed_m_s: float
    reference_range_m: float
    channel_m: tuple[float, ...] = (-0.8, 0.0, 0.8)
    element_m: float = 0.8
    height_m: float = 3000.0
    transmit_range: tuple[float, ...] = ()
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        self.refuse_not_positive("sampling_hz", "prf_hz", "speed_m_s", "reference_range_m", "element_m")
        if not 0 <= self.height_m < self.reference_range_m:
            raise ValueError(
                f"radar.height_m must lie in 0..reference_range_m ({self.reference_range_m:g} m), got {self.height_m}"
            )
        self.pulse.refuse_aliased(self.sampling_hz)
        object.__setattr__(self, "channel_m", tuple(self.channel_m))
        object.__setattr__(self, "transmit_range", tuple(self.transmit_range))
        finite = all(math.isfinite(x) for x in self.channel_m)
        if not (self.channel_m and finite and len(set(self.channel_m)) == len(self.channel_m)):
            raise ValueError(
                "radar.channel_m must hold the finite along-track position (m) of at least one channel, and must be "
                f"distinct, since a repeated position adds no samples, got {self.channel_m}"
            )
        if not all(math.isfinite(k) for k in self.transmit_range):
            raise ValueError(f"radar.transmit_range must be finite coefficients k1, k2, ..., got {self.transmit_range}")

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.channel_m)

    @property
    def range_step_m(self) -> float:
        """Sample spacing of the receive path, c / sampling_hz, in metres."""
        return self.wave_speed_m_s / self.sampling_hz

    @property
    def ambiguous_velocity_m_s(self) -> float:
        """Slant-range velocity lambda PRF in m/s that shifts the Doppler frequency by one PRF.

        Any number of channels measures the slant-range velocity only modulo this interval.
        """
        return self.wavelength_m * self.prf_hz

    def channels_at(self, device: torch.device | str | None = None) -> Tensor:
        """Return `channel_m` as a float64 tensor (channel,) on a device."""
        return numbers_on(device, *self.channel_m)

    def pulse_axis(self, n_pulse: int) -> Axis:
        """Return the slow-time axis in seconds, zero at pulse n_pulse // 2."""
        return Axis("pulse", n_pulse, -(n_pulse // 2) / self.prf_hz, 1 / self.prf_hz, "s")

    def axes(self, n_pulse: int, n_range: int | None = None) -> tuple[Axis, ...]:
        """Return the axes (channel, pulse, range) of range-compressed data.

        Args:
            n_pulse: Number of pulses.
            n_range: Number of range samples; None for data (channel, pulse) without a range axis.

        Returns:
            The axes. Sample n_range // 2 of the range axis lies at `reference_range_m`.
        """
        channel = Axis("channel", self.channels, 0.0, 1.0, "")
        if n_range is None:
            return channel, self.pulse_axis(n_pulse)
        step = self.range_step_m
        return (
            channel,
            self.pulse_axis(n_pulse),
            Axis("range", n_range, self.reference_range_m - (n_range // 2) * step, step, "m"),
        )

    def range_frequency_hz(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the baseband range frequencies (Hz) of an n-point FFT, FFT order, float64 (n,)."""
        return torch.fft.fftfreq(n, 1 / self.sampling_hz, dtype=torch.float64, device=device)

    def band_weights(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the spectrum of a range response with a rectangular band and a peak of 1.

        Args:
            n: Number of range samples.
            device: Device of the result.

        Returns:
            Weights in FFT order, float64 (n,): equal inside the band and zero outside. The weight
            of a bin at the edge is reduced to the fraction of the bin that lies inside.
        """
        bins = self.range_frequency_hz(n, device).abs() * n / self.sampling_hz
        inside = (self.pulse.bandwidth_hz * n / self.sampling_hz / 2 - bins + 0.5).clamp(0, 1)
        return inside * (n / inside.sum())

    def transmit_range_m(self, time_s: Tensor) -> Tensor:
        """Return the change of the transmit range since slow time zero, from `transmit_range`.

        Args:
            time_s: Slow times t in seconds, any shape.

        Returns:
            Range of the scene from the transmitter at t minus that at zero, k1 t + k2 t^2 + ..., in
            metres, float64, same shape.
        """
        return polynomial_range(self.transmit_range, time_s)


def polynomial_range(coefficients: Sequence[float | Tensor], time_s: Tensor) -> Tensor:
    """Evaluate the range polynomial k1 t + k2 t^2 + ...

    Args:
        coefficients: k1, k2, ... in m/s, m/s^2, ...: numbers, or tensors that broadcast with
            `time_s`.
        time_s: Times in seconds.

    Returns:
        Range k1 t + k2 t^2 + ... in metres, float64.
    """
    total = torch.zeros_like(time_s, dtype=torch.float64)
    for k in reversed(coefficients):
        total = (total + k) * time_s
    return total


def receive_range(
    time_s: Tensor,
    u_r_m_s: Tensor | float,
    u_a_m_s: Tensor | float,
    y0_m: Tensor | float,
    range_m: Tensor | float,
    speed_m_s: float,
    channel_m: Tensor | float,
) -> Tensor:
    """Return the exact range history R_m(t) - R0 from a receive channel to a moving point.

    The point moves uniformly, and the receiver along a straight track: R_m(t) = sqrt((R0 - u_r t)^2
    + (v t - y0 - dx_m)^2) with v = V_R - u_a. The difference R_m(t) - R0 is computed without
    subtracting large numbers, so that it keeps its precision. All arguments broadcast.

    Args:
        time_s: Slow time t in seconds.
        u_r_m_s: Slant-range speed u_r in m/s, closing positive.
        u_a_m_s: Along-track speed u_a in m/s, positive in the flight direction of the receiver.
        y0_m: Along-track position y0 of the point at t = 0 in metres.
        range_m: Range R0 in metres from the track to the position of the point at t = 0, across the
            track.
        speed_m_s: Speed V_R of the receiver in m/s.
        channel_m: Along-track position dx_m of the channel in metres.

    Returns:
        R_m(t) - R0 in metres.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (1), (4), extended by y0.
    """
    along = (speed_m_s - u_a_m_s) * time_s - y0_m - channel_m
    closing = u_r_m_s * time_s
    excess = closing * (closing - 2 * range_m) + along.square()
    return excess / (torch.sqrt((range_m - closing).square() + along.square()) + range_m)
