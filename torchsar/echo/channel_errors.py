"""Errors of multichannel recordings: unequal channels, and clocks that drift apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, real_dtype, unit_phasor
from torchsar.echo.recorded import noise, with_samples
from torchsar.radar import BistaticRadar
from torchsar.scene.trials import finite_numbers, refuse_other_trials, stacked, with_dims


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
@finite_numbers("channels")
class ChannelErrors:
    """Impairment: phase, gain and delay of each channel, for signal and noise.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 1e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [0], [0]), scene.BandLimited(1.0))
    >>> errors = {"channels": echo.ChannelErrors(gain_db=[0, 6, 0])}
    >>> recording, _ = echo.simulate_bistatic(sar, world, 4, None, Draws(1), impairments=errors)
    >>> recording.signal.data.abs().mean(-1).round(decimals=2)  # of three channels
    tensor([1., 2., 1.])

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

    phase_rad: Sequence[Tensor | float] | Tensor | None = None
    gain_db: Sequence[Tensor | float] | Tensor | None = None
    delay_s: Sequence[Tensor | float] | Tensor | None = None

    def _values(self, name: str, channels: int, device: torch.device) -> Tensor:
        """Values of a parameter for all channels, (..., channel). They are zero if the parameter is
        not given.
        """
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
        impaired = with_samples(recording, signal.data * factor[(..., *tail)])
        return impaired, {"phase_rad": phase, "gain_db": gain, "delay_s": delay}


@dataclass(frozen=True)
@finite_numbers("clock errors", phase_walk_rad=0.0)
class SynchronisationError:
    """Impairment: phase and delay of every pulse due to clocks that drift apart.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 1e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [0], [0]), scene.BandLimited(1.0))
    >>> errors = {"clocks": echo.SynchronisationError(phase_rad=[0.5], direct_snr_db=None)}
    >>> recording, _ = echo.simulate_bistatic(sar, world, 4, None, Draws(1), impairments=errors)
    >>> recording.aux["direct_path"][:, 32].angle().round(decimals=2)  # at the peak
    tensor([0.5000, 0.5000, 0.5000, 0.5000])

    Both are polynomials and sinusoids of slow time, which is zero at the middle pulse; the phase
    also walks at random from pulse to pulse. The errors are common to all channels. The data are
    delayed without a change of their carrier phases and then multiplied by exp(j phase).

    From the direct path, from the transmitter straight to the receiver, these errors can be
    measured. The recording gets aux `direct_path`, shape (..., pulse, direct_samples): the
    range-compressed samples of the direct path in each pulse. Its band is rectangular and its known
    range is removed, so that its peak exp(j phase) lies at sample direct_samples // 2 + delay_s *
    sampling_hz. The truth holds `phase_rad` and `delay_s`, shape (..., pulse) each, float64.

    Args:
        phase_rad: Polynomial of the phase in rad, rad/s, ...; each a number or one value per trial.
        phase_sinusoid_rad: Amplitude of a sinusoidal phase in radians, with a random start.
        phase_walk_rad: Standard deviation of the steps of a random walk, zero at the middle pulse,
            in radians.
        delay_s: Polynomial of the delay in s, s/s, ..., later positive.
        delay_sinusoid_s: Amplitude of a sinusoidal delay in seconds, with a random start.
        sinusoid_hz: Frequency of the sinusoids in hertz.
        direct_snr_db: Peak power of the direct path over the noise variance per sample in decibels,
            None for no noise.
        direct_samples: Number of samples of the direct path, at least 8.

    Raises:
        ValueError: If a number is not finite, a polynomial is no list or direct_samples is below 8;
            when applied, if delays are given for azimuth-only data or exceed a quarter of the
            samples of the direct path.
    """

    phase_rad: Sequence[Tensor | float] | None = None
    phase_sinusoid_rad: Tensor | float = 0.0
    phase_walk_rad: Tensor | float = 0.0
    delay_s: Sequence[Tensor | float] | None = None
    delay_sinusoid_s: Tensor | float = 0.0
    sinusoid_hz: Tensor | float = 0.5
    direct_snr_db: Tensor | float | None = 40.0
    direct_samples: int = 64

    def __post_init__(self) -> None:
        for name in ("phase_rad", "delay_s"):
            value = getattr(self, name)
            if not (value is None or isinstance(value, list | tuple)):
                raise ValueError(
                    f"{name} of clock errors must be a list of coefficients, got {value!r:.80}; put a single "
                    "coefficient in brackets"
                )
        if not self.direct_samples >= 8:
            raise ValueError(
                f"a direct path needs at least 8 samples per pulse, got direct_samples={self.direct_samples}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        signal, radar = recording.signal, recording.radar
        axis = signal.axis("pulse")
        time_s = axis.values(signal.data.device)
        phase, delay = (
            x.expand(*signal.trials, axis.n)
            for x in (
                self._phase_rad(time_s, draws.part("phase")),
                self._drift(self.delay_s, self.delay_sinusoid_s, time_s, draws.part("delay")),
            )
        )
        tail = (None,) * (-signal.dim("pulse") - 1)
        # azimuth-only data have no range cells, so that there can be no delay
        if self.delay_s or isinstance(self.delay_sinusoid_s, Tensor) or self.delay_sinusoid_s:
            _refuse_delay(recording, "a synchronisation error")
            signal = delayed(signal, delay[..., None, :], radar)
        turn = unit_phasor(phase / (2 * math.pi), signal.data.dtype)
        direct = self._direct_path(turn, delay, radar, draws)
        impaired = with_samples(recording, signal.data * turn[(..., None, slice(None), *tail)], direct_path=direct)
        return impaired, {"phase_rad": phase, "delay_s": delay}

    def _phase_rad(self, time_s: Tensor, draws: Draws) -> Tensor:
        """Phase at each pulse, (..., pulse)."""
        unit = draws.part("2").normal("echo.drift.walk", (time_s.numel(),))
        walk = (with_dims(self.phase_walk_rad, 1, unit) * unit).cumsum(-1)
        walk = (walk - walk[..., time_s.numel() // 2, None]).to(time_s.device)
        return self._drift(self.phase_rad, self.phase_sinusoid_rad, time_s, draws) + walk

    def _drift(
        self,
        coefficients: Sequence[Tensor | float] | None,
        amplitude: Tensor | float,
        time_s: Tensor,
        draws: Draws,
    ) -> Tensor:
        """Polynomial and sinusoid of slow time at each pulse, (..., pulse)."""
        total = torch.zeros_like(time_s)
        for c in reversed(coefficients or [0.0]):
            total = total * time_s + with_dims(c, 1, time_s)
        start = (2 * math.pi * draws.part("1").uniform("echo.drift.sinusoid")).to(time_s.device)[..., None]
        amplitude, frequency = (with_dims(v, 1, time_s) for v in (amplitude, self.sinusoid_hz))
        return total + amplitude * torch.sin(2 * math.pi * frequency * time_s + start)

    def _direct_path(self, turn: Tensor, delay_s: Tensor, radar: BistaticRadar, draws: Draws) -> Tensor:
        """Simulate the direct signal of each pulse, (..., pulse, direct_samples)."""
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
        std = torch.as_tensor(
            10 ** (-with_dims(self.direct_snr_db, 0, line) / 20), dtype=torch.float64, device=line.device
        )
        return line + noise(draws, "echo.direct_path.noise", line.shape[-2:], std, line.dtype, line.device)
