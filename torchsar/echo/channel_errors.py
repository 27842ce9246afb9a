"""Errors of multichannel recordings: unequal channels, and clocks that drift apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, real_dtype, unit_phasor
from torchsar.radar import BistaticRadar
from torchsar.scene.trials import refuse_other_trials, refuse_unless_finite, stacked, with_dims

PerChannel = Sequence[Tensor | float] | Tensor


def delayed(signal: Signal, delay_s: Tensor, radar: BistaticRadar) -> Signal:
    """Delay range lines without a change of their carrier phases.

    The lines are periodic: what leaves one end enters at the other.

    Args:
        signal: Data of shape (..., channel, pulse, range), complex.
        delay_s: Delay in seconds, later positive, broadcastable to (..., channel, pulse), float64.
        radar: Radar parameters.

    Returns:
        Delayed data.
    """
    frequency = radar.range_frequency_hz(signal.data.shape[-1], signal.data.device)
    shift = unit_phasor(-delay_s[..., None] * frequency, signal.data.dtype)
    return signal.with_data(torch.fft.ifft(torch.fft.fft(signal.data) * shift))


def _refuse_delay(recording: Recording, what: str) -> None:
    """Raise ValueError for data without a range axis."""
    if "range" not in recording.signal.names:
        raise ValueError(
            f"{what} has delays, but azimuth-only data have no range axis to shift along; "
            "simulate with n_range, or leave the delays out"
        )


@dataclass(frozen=True)
class ChannelErrors:
    """Impairment: phase, gain and delay of each channel, for signal and noise.

    Delays shift lines without a change of their carrier phases. Each parameter is a list with one
    entry per channel (numbers, or one value per trial), a tensor of shape (..., channel), or None
    for no error. The truth holds `phase_rad`, `gain_db` and `delay_s`, shape (..., channel) each,
    float64.

    Args:
        phase_rad: Phases in radians.
        gain_db: Gains in decibels.
        delay_s: Delays in seconds, later positive.

    Raises:
        ValueError: If a number is not finite; when applied, if a parameter has not one entry per
            channel, or delays are given for azimuth-only data.
    """

    phase_rad: PerChannel | None = None
    gain_db: PerChannel | None = None
    delay_s: PerChannel | None = None

    def __post_init__(self) -> None:
        for name in ("phase_rad", "gain_db", "delay_s"):
            refuse_unless_finite(f"{name} of channels", getattr(self, name))

    def _values(self, name: str, channels: int, device: torch.device) -> Tensor:
        """Values of a parameter for all channels, zero where it is not given, (..., channel)."""
        given = getattr(self, name)
        value = torch.zeros(channels, dtype=torch.float64) if given is None else stacked(given)
        if not value.ndim or value.shape[-1] != channels:
            raise ValueError(
                f"{name} of channels needs one entry for each of the {channels} channels, got shape "
                f"{tuple(value.shape)}"
            )
        return value.to(device)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        signal = recording.signal
        tail = (None,) * (-signal.dim("channel") - 1)
        phase, gain, delay = (
            self._values(name, signal.axis("channel").n, signal.data.device)
            for name in ("phase_rad", "gain_db", "delay_s")
        )
        if self.delay_s is not None:
            _refuse_delay(recording, "a channel error")
            signal = delayed(signal, delay[..., None], recording.radar)
        factor = unit_phasor(phase / (2 * math.pi), signal.data.dtype) * (10 ** (gain / 20)).to(
            real_dtype(signal.data.dtype)
        )
        impaired = signal.with_data(signal.data * factor[(..., *tail)])
        return replace(recording, signal=impaired), {"phase_rad": phase, "gain_db": gain, "delay_s": delay}


class Drift(Protocol):
    """Error of a clock as a function of slow time."""

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        """Return the clock error at each pulse.

        Args:
            time_s: Slow time in seconds, zero at the middle pulse, shape (pulse,), float64.
            draws: Random draws.

        Returns:
            Clock error, in radians for a phase and in seconds for a delay, shape (..., pulse),
            float64.
        """
        ...


@dataclass(frozen=True)
class PolynomialDrift:
    """Polynomial drift of a clock, c0 + c1 t + c2 t^2 + ..., with the slow time t in seconds.

    Args:
        coefficients: c0, c1, ... in rad, rad/s, ... for a phase and in s, s/s, ... for a delay;
            each a number or one value per trial.

    Raises:
        ValueError: If a coefficient is not finite.
    """

    coefficients: Sequence[Tensor | float]

    def __post_init__(self) -> None:
        refuse_unless_finite("coefficients of a drift", self.coefficients)

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        """Return the polynomial drift at each pulse.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.
            draws: Random draws, which are not used.

        Returns:
            Drift in radians or seconds, as the coefficients, shape (..., pulse), float64.
        """
        total = torch.zeros_like(time_s)
        for c in reversed(self.coefficients):
            total = total * time_s + with_dims(c, time_s.ndim, time_s)
        return total


@dataclass(frozen=True)
class SinusoidDrift:
    """Sinusoidal drift of a clock, amplitude sin(2 pi frequency_hz t + start_rad) at slow time t.

    Args:
        amplitude: Amplitude, in radians for a phase and in seconds for a delay.
        frequency_hz: Frequency in hertz.
        start_rad: Phase at slow time zero in radians, None for a random phase in each trial.

    Raises:
        ValueError: If a number is not finite.
    """

    amplitude: Tensor | float
    frequency_hz: Tensor | float
    start_rad: Tensor | float | None = None

    def __post_init__(self) -> None:
        for name in ("amplitude", "frequency_hz", "start_rad"):
            refuse_unless_finite(f"{name} of a drift", getattr(self, name))

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        """Return the sinusoidal drift at each pulse.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.
            draws: Random draws of the start phase.

        Returns:
            Drift in radians or seconds, as the amplitude, shape (..., pulse), float64.
        """
        start = (
            2 * math.pi * draws.uniform("echo.drift.sinusoid")
            if self.start_rad is None
            else torch.as_tensor(self.start_rad, dtype=torch.float64)
        ).to(time_s.device)[..., None]
        amplitude, frequency = (with_dims(v, 1, time_s) for v in (self.amplitude, self.frequency_hz))
        return amplitude * torch.sin(2 * math.pi * frequency * time_s + start)


@dataclass(frozen=True)
class WalkDrift:
    """Random walk of a clock with normal steps from pulse to pulse, zero at the middle pulse.

    Args:
        step: Standard deviation of a step, in radians for a phase and in seconds for a delay.

    Raises:
        ValueError: If the standard deviation is negative or not finite.
    """

    step: Tensor | float

    def __post_init__(self) -> None:
        refuse_unless_finite("step of a drift", self.step, 0.0)

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        """Draw the random walk of the clock.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.
            draws: Random draws.

        Returns:
            Drift in radians or seconds, as the step, shape (..., pulse), float64.
        """
        unit = draws.normal("echo.drift.walk", (time_s.numel(),))
        walk = (with_dims(self.step, 1, unit) * unit).cumsum(-1)
        return (walk - walk[..., time_s.numel() // 2, None]).to(time_s.device)


@dataclass(frozen=True)
class SynchronisationError:
    """Impairment: phase and delay of every pulse due to clocks that drift apart.

    The errors are common to all channels. The data are delayed without a change of their carrier
    phases and then multiplied by exp(j phase).

    From the direct path, from the transmitter straight to the receiver, these errors can be
    measured. The recording gets aux `direct_path`, shape (..., pulse, direct_samples): the
    range-compressed samples of the direct path in each pulse. Its band is rectangular and its known
    range is removed, so that its peak exp(j phase) lies at sample direct_samples // 2 + delay_s *
    sampling_hz. The truth holds `phase_rad` and `delay_s`, shape (..., pulse) each, float64.

    Args:
        phase_rad: Drifts whose sum is the phase in radians.
        delay_s: Drifts whose sum is the delay in seconds, later positive.
        direct_snr_db: Peak power of the direct path over the noise variance per sample in decibels,
            None for no noise.
        direct_samples: Number of samples of the direct path, at least 8.

    Raises:
        TypeError: If a single drift is given instead of a list.
        ValueError: If direct_snr_db is not finite or direct_samples is below 8; when applied, if
            delays are given for azimuth-only data or exceed a quarter of the samples of the direct
            path.
    """

    phase_rad: Sequence[Drift] = ()
    delay_s: Sequence[Drift] = ()
    direct_snr_db: Tensor | float | None = 40.0
    direct_samples: int = 64

    def __post_init__(self) -> None:
        if hasattr(self.phase_rad, "values") or hasattr(self.delay_s, "values"):
            raise TypeError(
                f"phase_rad and delay_s must be lists of drifts, got {self.phase_rad!r} and {self.delay_s!r}; "
                "put a single drift in brackets"
            )
        refuse_unless_finite("direct_snr_db", self.direct_snr_db)
        if not self.direct_samples >= 8:
            raise ValueError(
                f"a direct path needs at least 8 samples per pulse, got direct_samples={self.direct_samples}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        signal, radar = recording.signal, recording.radar
        axis = signal.axis("pulse")
        phase, delay = (
            _total(drifts, axis.values(signal.data.device), draws.part(name)).expand(*signal.trials, axis.n)
            for name, drifts in (("phase", self.phase_rad), ("delay", self.delay_s))
        )
        tail = (None,) * (-signal.dim("pulse") - 1)
        if self.delay_s:
            _refuse_delay(recording, "a synchronisation error")
            signal = delayed(signal, delay[..., None, :], radar)
        turn = unit_phasor(phase / (2 * math.pi), signal.data.dtype)
        impaired = signal.with_data(signal.data * turn[(..., None, slice(None), *tail)])
        aux = {**recording.aux, "direct_path": self._direct_path(turn, delay, radar, draws)}
        return replace(recording, signal=impaired, aux=aux), {"phase_rad": phase, "delay_s": delay}

    def _direct_path(self, turn: Tensor, delay_s: Tensor, radar: BistaticRadar, draws: Draws) -> Tensor:
        """Direct signal of each pulse, (..., pulse, direct_samples)."""
        n = self.direct_samples
        worst = float(delay_s.abs().max()) * radar.sampling_hz
        if not worst <= n / 4:
            raise ValueError(
                f"a delay of {worst:.4g} samples exceeds a quarter of the {n} samples of the direct "
                "path; give more samples (direct_samples) or smaller drifts"
            )
        frequency = radar.range_frequency_hz(n, delay_s.device)
        band = radar.band_weights(n, delay_s.device).to(turn.dtype)
        line = torch.fft.ifft(
            band * unit_phasor(-(delay_s[..., None] + n // 2 / radar.sampling_hz) * frequency, turn.dtype)
        )
        line = turn[..., None] * line
        if self.direct_snr_db is None:
            return line
        noise = draws.normal("echo.direct_path.noise", line.shape[-2:], line.dtype, line.device)
        std = 10 ** (-with_dims(self.direct_snr_db, 2, line) / 20)
        return line + (std.to(real_dtype(line.dtype)) if isinstance(std, Tensor) else std) * noise


def _total(drifts: Sequence[Drift], time_s: Tensor, draws: Draws) -> Tensor:
    """Sum of drifts, each of which draws from an address of its own, (..., pulse)."""
    values = [drift.values(time_s, draws.part(str(i))) for i, drift in enumerate(drifts)]
    return sum(values, torch.zeros_like(time_s))
