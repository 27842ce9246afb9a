"""Interference in the receiver: tones, wideband interferers, and the converter that digitises them.

The level of an interferer is the ratio of its power to the mean power per sample of the lines that
it is added to. Those lines hold echo and noise for the first interferer; for a later one they also
hold the interferers that were added before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, cis, per_trial, real_dtype, reduced_turns
from torchsar.echo.recorded import with_samples
from torchsar.scene.trials import finite_numbers, refuse_other_trials, refuse_unless, with_dims


@dataclass(frozen=True)
@finite_numbers("a tone", share=None)
class Tone:
    """Impairment: a tone that is added to randomly chosen lines.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"tone": echo.Tone(over_signal_db=20.0, frequency_hz=5e6, share=0.25)}
    >>> _, truth = echo.simulate(strip, world, 16, 64, Draws(1), errors)
    >>> truth.values["tone.contaminated"].sum(), truth.values["tone.frequency_hz"][0]
    (tensor(4), tensor(5000000., dtype=torch.float64))

    The truth holds `contaminated`, shape (..., pulse), bool, true for the lines with the tone, and
    `frequency_hz` at the middle of each line, shape (..., pulse).

    Args:
        over_signal_db: Ratio in decibels of the power of the tone to the mean power per sample that
            the contaminated lines have without it.
        frequency_hz: Baseband frequency at the first line in hertz.
        drift_hz: Linear change of the frequency from the first to the last line in hertz.
        wander_hz: Amplitude in hertz of a sinusoidal change of the frequency with one period over
            the record.
        rate_hz_s: Linear change of the frequency within a line in hertz per second.
        share: Fraction of all lines that get the tone, above 0 and at most 1.
        coherent: Whether one oscillator runs through the whole recording, so that the phase
            continues from line to line; otherwise each line has a random phase.

    Raises:
        ValueError: If a number is not finite or the share is out of range.
    """

    over_signal_db: Tensor | float
    frequency_hz: Tensor | float
    drift_hz: Tensor | float = 0.0
    wander_hz: Tensor | float = 0.0
    rate_hz_s: Tensor | float = 0.0
    share: Tensor | float = 1.0
    coherent: bool = False

    def __post_init__(self) -> None:
        _check_share(self.share)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data, fs = recording.signal.data, recording.radar.sampling_hz
        lines = _chosen_lines(draws, self.share, data)
        frequency = self._frequency_hz(data.shape[-2], draws, data)
        fast = torch.arange(data.shape[-1], dtype=torch.float64, device=data.device) / fs
        since_middle = fast - fast.mean()
        turns = (
            frequency[..., None] * since_middle
            + 0.5 * per_trial(self.rate_hz_s, 2, data) * since_middle.square()
            + self._phase_turns(frequency, recording, draws)[..., None]
        )
        wave = cis((2 * math.pi * reduced_turns(turns)).to(real_dtype(data.dtype)))
        impaired = _add(recording, wave, lines, self.over_signal_db)
        return impaired, {"contaminated": lines, "frequency_hz": frequency.expand(lines.shape)}

    def _frequency_hz(self, n_pulse: int, draws: Draws, like: Tensor) -> Tensor:
        """Frequency at the middle of each line, (..., pulse)."""
        along = torch.arange(n_pulse, dtype=torch.float64, device=like.device) / max(1, n_pulse - 1)
        start = draws.uniform("tone.wander", (1,), device=like.device)
        wander = per_trial(self.wander_hz, 1, like) * torch.sin(2 * math.pi * (along + start))
        return per_trial(self.frequency_hz, 1, like) + per_trial(self.drift_hz, 1, like) * along + wander

    def _phase_turns(self, frequency: Tensor, recording: Recording, draws: Draws) -> Tensor:
        """Phase at the middle of each line in cycles, (..., pulse)."""
        n_pulse = frequency.shape[-1]
        if self.coherent:
            per_line = frequency / recording.radar.prf_hz
            return draws.uniform("tone.phase", (1,), device=frequency.device) + (
                per_line - torch.round(per_line)
            ).cumsum(-1)
        return draws.uniform("tone.phase", (n_pulse,), device=frequency.device)


@dataclass(frozen=True)
@finite_numbers("an interferer", share=None, bandwidth_hz="positive")
class WideInterferer:
    """Impairment: band-limited noise on randomly chosen lines, independent from line to line.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"wide": echo.WideInterferer(20.0, frequency_hz=5e6, bandwidth_hz=2e6, share=0.25)}
    >>> _, truth = echo.simulate(strip, world, 16, 64, Draws(1), errors)
    >>> truth.values["wide.contaminated"].sum()
    tensor(4)

    The noise of a line is cut out of a longer periodic process and is therefore not itself
    periodic. The truth holds `contaminated`, shape (..., pulse), bool, true for the lines with this
    noise, and `bandwidth_hz`, shape (...,).

    Args:
        over_signal_db: Ratio in decibels of the power of the noise to the mean power per sample
            that the contaminated lines have without it.
        frequency_hz: Centre frequency in hertz.
        bandwidth_hz: Bandwidth in hertz, fixed for all trials, since it decides how many random
            numbers are drawn.
        share: Fraction of all lines that get the noise, above 0 and at most 1.

    Raises:
        ValueError: If a number is not finite, the bandwidth is not positive or the share is out of
            range.
    """

    over_signal_db: Tensor | float
    frequency_hz: Tensor | float
    bandwidth_hz: float
    share: Tensor | float = 1.0

    def __post_init__(self) -> None:
        _check_share(self.share)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data, fs = recording.signal.data, recording.radar.sampling_hz
        lines = _chosen_lines(draws, self.share, data)
        n_pulse, n = data.shape[-2:]
        # length of the process, which has at least 8 random coefficients in any band
        n_long = max(2 * n, math.ceil(8 * fs / self.bandwidth_hz))
        half = int(self.bandwidth_hz / 2 / fs * n_long)
        coefficients = draws.normal("wide.coefficients", (n_pulse, 2 * half + 1), data.dtype, data.device)
        cell = torch.arange(-half, half + 1, dtype=torch.float64, device=data.device) / n_long
        turns = (cell[:, None] + per_trial(self.frequency_hz, 2, data) / fs) * torch.arange(
            n, dtype=torch.float64, device=data.device
        )
        wave = (coefficients / math.sqrt(2 * half + 1)) @ cis(
            (2 * math.pi * reduced_turns(turns)).to(real_dtype(data.dtype))
        )
        return _add(recording, wave, lines, self.over_signal_db), {
            "contaminated": lines,
            "bandwidth_hz": torch.full(lines.shape[:-1], self.bandwidth_hz, dtype=torch.float64),
        }


@dataclass(frozen=True)
@finite_numbers("a converter", bits=None, rms_levels="positive")
class Quantiser:
    """Impairment: an I/Q converter behind an automatic gain control, without dither.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), snr_db=10.0)
    >>> errors = {"converter": echo.Quantiser(bits=2)}
    >>> recording, _ = echo.simulate(strip, world, 16, 64, Draws(1), errors)
    >>> len(recording.signal.data.real.unique())
    4

    The output levels are the odd numbers from -(2^bits - 1) to 2^bits - 1; larger samples are
    clipped. In each trial the gain brings the rms value of one component, I or Q, to rms_levels,
    and is undone after the conversion. The truth holds `gain` and `extreme_share`, the fraction of
    samples at the two outermost levels, shape (...,) each.

    Args:
        bits: Number of bits, a whole number of 1 to 16.
        rms_levels: Rms value of one component, I or Q, at the converter, in units of half the
            distance of neighbouring levels; RADARSAT-1 records 4 bits at 6.6 to 7.4.

    Raises:
        ValueError: If the number of bits or the rms value is out of range.
    """

    bits: Tensor | float
    rms_levels: Tensor | float = 7.0

    def __post_init__(self) -> None:
        sentence = "a converter needs a whole number of 1 to 16 bits"
        refuse_unless(sentence, self.bits, lambda x: (x >= 1) & (x <= 16) & (x % 1 == 0))

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        parts = torch.view_as_real(recording.signal.data)
        rms = parts.square().mean((-3, -2, -1)).sqrt()
        levels = with_dims(self.rms_levels, 0, rms)
        # torch divides a number by a tensor in this way; rounding in another way would move samples
        # at the edge of a level
        gain = (levels.to(rms.dtype) if isinstance(levels, Tensor) else levels) * torch.where(
            rms > 0, rms, 1
        ).reciprocal()
        top = 2 ** per_trial(self.bits, 3, parts).to(parts.dtype) - 1
        levels = (2 * torch.floor(parts * gain[..., None, None, None] / 2) + 1).minimum(top).maximum(-top)
        clipped = (levels.abs() == top).to(torch.float64).mean((-3, -2, -1))
        data = torch.view_as_complex((levels / gain[..., None, None, None]).contiguous())
        return with_samples(recording, data), {"gain": gain.to(torch.float64), "extreme_share": clipped}


def _check_share(share: Tensor | float) -> None:
    """Raise ValueError for a share of lines that is out of range."""
    refuse_unless("share of contaminated lines must be above 0 and at most 1", share, lambda x: (x > 0) & (x <= 1))


def _chosen_lines(draws: Draws, share: Tensor | float, data: Tensor) -> Tensor:
    """Mask of round(share * lines) lines that are chosen at random, at least one, bool (...,
    pulse).
    """
    n_pulse = data.shape[-2]
    count = torch.round(per_trial(share, 1, data) * n_pulse).clamp_min(1)
    order = draws.permutation("interference.lines", n_pulse, data.device)
    chosen = (torch.arange(n_pulse, device=data.device) < count).expand(data.shape[:-1])
    return torch.zeros_like(chosen).scatter(-1, order.expand(chosen.shape), chosen)


def _add(recording: Recording, wave: Tensor, lines: Tensor, over_signal_db: Tensor | float) -> Recording:
    """Add a wave of unit mean power to the lines of a recording, at a level relative to the mean
    power of these lines.
    """
    data = recording.signal.data
    power = (data.abs().square().mean(-1) * lines).sum(-1) / lines.sum(-1)
    ratio = 10 ** (per_trial(over_signal_db, 0, data) / 10)
    amplitude = torch.sqrt(power.to(torch.float64) * ratio).to(power.dtype)
    return with_samples(recording, data + wave * (amplitude[..., None] * lines)[..., None])
