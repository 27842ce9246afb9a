"""What receivers do to multichannel recordings: channels that differ, and clocks that drift against
the transmitter's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, real_dtype, unit_phasor
from torchsar.radar import BistaticRadar
from torchsar.scene.vibration import refuse_unless_finite

PerChannel = Sequence[float] | Tensor


def delayed(signal: Signal, delay_s: Tensor, radar: BistaticRadar) -> Signal:
    """Range lines later by delay_s, float64 (..., channel, pulse) or what broadcasts to it,
    carriers unchanged. The ends of a line join: what leaves one enters the other.
    """
    frequency = radar.range_frequency_hz(signal.data.shape[-1], signal.data.device)
    shift = unit_phasor(-delay_s[..., None] * frequency, signal.data.dtype)
    return signal.with_data(torch.fft.ifft(torch.fft.fft(signal.data) * shift))


def _refuse_delay(recording: Recording, what: str) -> None:
    if "range" not in recording.signal.names:
        raise ValueError(
            f"{what} has delays, but azimuth-only data have no range axis to shift along; "
            "simulate with n_range, or leave the delays out"
        )


@dataclass(frozen=True)
class ChannelErrors:
    """Phase (rad), gain (dB) and delay (s, later positive) of each channel, target and noise alike.

    One entry a channel, lists or tensors (..., channel) that may differ between trials; None for
    none. Delays shift lines without turning carriers. Truth: `phase_rad`, `gain_db`, `delay_s`,
    float64 (..., channel) each. Raises ValueError for numbers that do not fit the channels, or
    delays on azimuth-only data.
    """

    phase_rad: PerChannel | None = None
    gain_db: PerChannel | None = None
    delay_s: PerChannel | None = None

    def __post_init__(self) -> None:
        for name in ("phase_rad", "gain_db", "delay_s"):
            if getattr(self, name) is not None:
                refuse_unless_finite(f"{name} of channels", torch.as_tensor(getattr(self, name)))

    def _values(self, name: str, channels: int, device: torch.device) -> Tensor:
        given = getattr(self, name)
        value = (
            torch.zeros(channels, dtype=torch.float64) if given is None else torch.as_tensor(given, dtype=torch.float64)
        )
        if not value.ndim or value.shape[-1] != channels:
            raise ValueError(
                f"{name} of channels needs one entry for each of the {channels} channels, got shape "
                f"{tuple(value.shape)}"
            )
        return value.to(device)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
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
    """How an error of a clock goes with slow time: float64 (pulse,), zero at the middle pulse ->
    (..., pulse).
    """

    def values(self, time_s: Tensor, draws: Draws) -> Tensor: ...


@dataclass(frozen=True)
class PolynomialDrift:
    """coefficients[0] + coefficients[1] t + ..., the coefficients per power of a second."""

    coefficients: Sequence[float]

    def __post_init__(self) -> None:
        refuse_unless_finite("coefficients of a drift", torch.tensor(list(self.coefficients), dtype=torch.float64))

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        total = torch.zeros_like(time_s)
        for c in reversed(self.coefficients):
            total = total * time_s + c
        return total


@dataclass(frozen=True)
class SinusoidDrift:
    """amplitude sin(2 pi frequency_hz t + start_rad); start_rad: None for one at random in each
    trial.
    """

    amplitude: float
    frequency_hz: float
    start_rad: float | None = None

    def __post_init__(self) -> None:
        for name in ("amplitude", "frequency_hz"):
            refuse_unless_finite(f"{name} of a drift", getattr(self, name))

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        start = (
            2 * math.pi * draws.uniform("echo.drift.sinusoid")
            if self.start_rad is None
            else torch.tensor(self.start_rad, dtype=torch.float64)
        )
        return self.amplitude * torch.sin(2 * math.pi * self.frequency_hz * time_s + start.to(time_s.device)[..., None])


@dataclass(frozen=True)
class WalkDrift:
    """A random walk with normal steps of deviation `step` from pulse to pulse, zero at the middle
    one.
    """

    step: float

    def __post_init__(self) -> None:
        refuse_unless_finite("step of a drift", self.step, 0.0)

    def values(self, time_s: Tensor, draws: Draws) -> Tensor:
        walk = (self.step * draws.normal("echo.drift.walk", (time_s.numel(),))).cumsum(-1)
        return (walk - walk[..., time_s.numel() // 2, None]).to(time_s.device)


@dataclass(frozen=True)
class SynchronisationError:
    """Phase (rad) and delay (s, later positive) of every pulse, common to all channels, and a
    direct path from the transmitter that shows both.

    phase_rad, delay_s: lists of drifts that are added up: `PolynomialDrift`, `SinusoidDrift`,
    `WalkDrift`. Data become exp(j phase) times data delayed by delay, without turning carriers.
    aux: `direct_path` (..., pulse, direct_samples), the direct signal of each pulse after range
    compression at the sampling rate of the echoes, its known range taken out: a rectangular band,
    peak exp(j phase) at sample direct_samples // 2 + delay_s sampling_hz. direct_snr_db: of its
    peak over noise variance per sample, None for no noise. Truth: `phase_rad`, `delay_s`, float64
    (..., pulse). Raises ValueError for delays on azimuth-only data, or beyond a quarter of the
    direct path's samples.
    """

    phase_rad: Sequence[Drift] = ()
    delay_s: Sequence[Drift] = ()
    direct_snr_db: float | None = 40.0
    direct_samples: int = 64

    def __post_init__(self) -> None:
        if hasattr(self.phase_rad, "values") or hasattr(self.delay_s, "values"):
            raise TypeError("phase_rad and delay_s must be lists of drifts; put a single one in brackets")
        if self.direct_snr_db is not None:
            refuse_unless_finite("direct_snr_db", self.direct_snr_db)
        if not self.direct_samples >= 8:
            raise ValueError(
                f"a direct path needs at least 8 samples a pulse, got direct_samples={self.direct_samples}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        signal, radar = recording.signal, recording.radar
        trials, axis = signal.trials, signal.axis("pulse")
        phase, delay = (
            _total(drifts, axis.values(signal.data.device), draws.part(name)).expand(*trials, axis.n)
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
        n = self.direct_samples
        worst = float(delay_s.abs().max()) * radar.sampling_hz
        if not worst <= n / 4:
            raise ValueError(
                f"a delay of {worst:.4g} samples passes a quarter of the {n} samples of the direct "
                "path; give it more (direct_samples) or smaller drifts"
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
        return line + 10 ** (-self.direct_snr_db / 20) * noise


def _total(drifts: Sequence[Drift], time_s: Tensor, draws: Draws) -> Tensor:
    values = [drift.values(time_s, draws.part(str(i))) for i, drift in enumerate(drifts)]
    return sum(values, torch.zeros_like(time_s))
