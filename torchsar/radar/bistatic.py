"""What an airborne receiver with several channels along track knows about itself and about the
satellite that lights its scene, and ranges of moving points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis
from torchsar.radar.stripmap import LIGHT_M_S
from torchsar.radar.waveform import LinearFM


@dataclass(frozen=True)
class BistaticRadar:
    """A far transmitter with a low pulse rate and an airborne receiver with channels in a row along
    track.

    speed_m_s: of the receiver, along its straight level track; reference_range_m: closest slant
    range R0 of the middle of the scene; height_m: of the receiver. channel_m: along-track places
    dx_m of the channels against the reference of the track, in any order and spacing; element_m:
    along-track length of each. transmit_range: coefficients k1, k2, ... (m/s, m/s^2, ...) of R_T(t)
    - R_T(0) = k1 t + k2 t^2 + ..., from the ephemeris (`radar.orbit.range_coefficients`). The phase
    of an echo is -2 pi / lambda (R_T + R_m), once each way. A range axis holds the RECEIVE path R_m
    = c tau - R_T (m), step c / sampling_hz; on the axis c tau / 2, on which resolutions are quoted,
    everything is half as long. Slow time zero is pulse n // 2. Raises ValueError for parameters
    that make no instrument.
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
        for name in (
            "carrier_hz",
            "sampling_hz",
            "prf_hz",
            "speed_m_s",
            "reference_range_m",
            "element_m",
            "wave_speed_m_s",
        ):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"radar.{name} must be a positive number, got {getattr(self, name)}")
        if not 0 <= self.height_m < self.reference_range_m:
            raise ValueError(
                f"radar.height_m must lie in 0..reference_range_m ({self.reference_range_m:g} m), got {self.height_m}"
            )
        if self.pulse.bandwidth_hz > self.sampling_hz:
            raise ValueError(
                f"pulse bandwidth {self.pulse.bandwidth_hz:g} Hz exceeds the complex sampling rate "
                f"{self.sampling_hz:g} Hz; sample at least as fast as the bandwidth"
            )
        object.__setattr__(self, "channel_m", tuple(self.channel_m))
        object.__setattr__(self, "transmit_range", tuple(self.transmit_range))
        if not self.channel_m or not all(math.isfinite(x) for x in self.channel_m):
            raise ValueError(
                f"radar.channel_m needs the along-track place of at least one channel (m), got {self.channel_m}"
            )
        if len(set(self.channel_m)) != len(self.channel_m):
            raise ValueError(f"radar.channel_m names a place twice, which gives no new samples: {self.channel_m}")
        if not all(math.isfinite(k) for k in self.transmit_range):
            raise ValueError(f"radar.transmit_range must be finite coefficients k1, k2, ..., got {self.transmit_range}")

    @property
    def wavelength_m(self) -> float:
        return self.wave_speed_m_s / self.carrier_hz

    @property
    def channels(self) -> int:
        return len(self.channel_m)

    @property
    def range_step_m(self) -> float:
        """Of the receive path, c / sampling_hz."""
        return self.wave_speed_m_s / self.sampling_hz

    @property
    def ambiguous_velocity_m_s(self) -> float:
        """Slant-range velocity that turns Doppler by one pulse rate, lambda PRF: what the channels
        cannot tell apart (brief 001, Velocity).
        """
        return self.wavelength_m * self.prf_hz

    def channels_at(self, device: torch.device | str | None = None) -> Tensor:
        """channel_m as float64 (channel,)."""
        return torch.tensor(self.channel_m, dtype=torch.float64, device=device)

    def pulse_axis(self, n_pulse: int) -> Axis:
        """Slow time (s), zero at pulse n_pulse // 2."""
        return Axis("pulse", n_pulse, -(n_pulse // 2) / self.prf_hz, 1 / self.prf_hz, "s")

    def axes(self, n_pulse: int, n_range: int | None = None) -> tuple[Axis, ...]:
        """Axes (channel, pulse, range) of range-compressed data, the middle of the range axis,
        sample n_range // 2, at reference_range_m; (channel, pulse) without n_range.
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
        """Baseband range frequencies of an n-point FFT, FFT order, float64 (n,)."""
        return torch.fft.fftfreq(n, 1 / self.sampling_hz, dtype=torch.float64, device=device)

    def band_weights(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Spectrum of the range response, a rectangular band of the pulse's width with a peak of 1,
        float64 (n,) in FFT order; the bins at its edges have the share that lies inside.
        """
        bins = self.range_frequency_hz(n, device).abs() * n / self.sampling_hz
        inside = (self.pulse.bandwidth_hz * n / self.sampling_hz / 2 - bins + 0.5).clamp(0, 1)
        return inside * (n / inside.sum())

    def transmit_range_m(self, time_s: Tensor) -> Tensor:
        """R_T(t) - R_T(0) (m) by the ephemeris, float64, shape of time_s."""
        return polynomial_range(self.transmit_range, time_s)


def polynomial_range(coefficients: Sequence[float | Tensor], time_s: Tensor) -> Tensor:
    """k1 t + k2 t^2 + ..., float64; coefficients: numbers or tensors that broadcast with time_s."""
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
    """R_m(t) - R0 of a uniformly moving point, exact, float64 (m): sqrt((R0 - u_r t)^2 + (v t - y0
    - dx_m)^2) - R0 with v = V_R - u_a, formed as a difference.

    u_r_m_s: slant-range speed, closing positive; u_a_m_s: along-track speed, positive with the
    receiver; y0_m: along-track place at t = 0; range_m: R0. All arguments broadcast. Remote Sens.
    2020, 12, 1703, Eqs. (1), (4) (brief 001, with y0).
    """
    along = (speed_m_s - u_a_m_s) * time_s - y0_m - channel_m
    closing = u_r_m_s * time_s
    excess = closing * (closing - 2 * range_m) + along.square()
    return excess / (torch.sqrt((range_m - closing).square() + along.square()) + range_m)
