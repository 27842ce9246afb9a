"""Interference in the receiver: tones, wider emitters, and the converter that has to digitise them
with the echo.

Levels are the interferer's power over the mean power per sample, averaged over the contaminated
lines, of the recording as it comes: of the echo and its noise for the first interferer, of these
and the earlier interferers for a second. The world side of brief 004, item 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, cis, per_trial, real_dtype, reduced_turns


@dataclass(frozen=True)
class Tone:
    """A tone on a share of the lines.

    over_signal_db: tone power over mean power per sample of the contaminated lines. frequency_hz:
    baseband frequency at the first line; drift_hz: frequency change from the first line to the
    last, linear; wander_hz: amplitude of one slow sine on top of it; rate_hz_s: drift inside a
    line. share: of the lines, chosen at random. coherent: one oscillator through the whole
    recording (the phase follows from slow and fast time); otherwise each line has its own random
    phase. Numbers, or per-trial tensors (...,).
    """

    over_signal_db: Tensor | float
    frequency_hz: Tensor | float
    drift_hz: Tensor | float = 0.0
    wander_hz: Tensor | float = 0.0
    rate_hz_s: Tensor | float = 0.0
    share: float = 1.0
    coherent: bool = False

    def __post_init__(self) -> None:
        _check_share(self.share)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
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
        """Phase at the middle of each line, turns (..., pulse)."""
        n_pulse = frequency.shape[-1]
        if self.coherent:
            per_line = frequency / recording.radar.prf_hz
            return draws.uniform("tone.phase", (1,), device=frequency.device) + (
                per_line - torch.round(per_line)
            ).cumsum(-1)
        return draws.uniform("tone.phase", (n_pulse,), device=frequency.device)


@dataclass(frozen=True)
class WideInterferer:
    """Band-limited noise of bandwidth_hz about frequency_hz on a share of the lines, independent
    from line to line.

    over_signal_db: its power over mean power per sample of the contaminated lines. The noise is
    stationary: a line is a cut from a longer process, not a period of a circular one.
    """

    over_signal_db: Tensor | float
    frequency_hz: Tensor | float
    bandwidth_hz: float
    share: float = 1.0

    def __post_init__(self) -> None:
        _check_share(self.share)
        if not self.bandwidth_hz > 0:
            raise ValueError(
                f"an interferer's bandwidth_hz must be positive, got {self.bandwidth_hz}; for a single tone use Tone"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        data, fs = recording.signal.data, recording.radar.sampling_hz
        lines = _chosen_lines(draws, self.share, data)
        n_pulse, n = data.shape[-2:]
        # at least 8 random coefficients, however narrow the band
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
class Quantiser:
    """An I/Q converter of `bits` bits behind an automatic gain: odd levels -(2^bits - 1) ..

    2^bits - 1, clipped.

    The gain of a trial brings the rms of one component to rms_levels (RADARSAT-1 records 4 bits at
    6.6 to 7.4) and is undone after the conversion. No dither.
    """

    bits: int
    rms_levels: float = 7.0

    def __post_init__(self) -> None:
        if not (1 <= self.bits <= 16 and self.rms_levels > 0):
            raise ValueError(
                f"a converter needs 1 to 16 bits and rms_levels above 0, got bits={self.bits}, "
                f"rms_levels={self.rms_levels}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        parts = torch.view_as_real(recording.signal.data)
        rms = parts.square().mean((-3, -2, -1)).sqrt()
        gain = self.rms_levels / torch.where(rms > 0, rms, 1)
        top = 2**self.bits - 1
        levels = (2 * torch.floor(parts * gain[..., None, None, None] / 2) + 1).clamp(-top, top)
        clipped = (levels.abs() == top).to(torch.float64).mean((-3, -2, -1))
        data = torch.view_as_complex((levels / gain[..., None, None, None]).contiguous())
        return replace(recording, signal=recording.signal.with_data(data)), {
            "gain": gain.to(torch.float64),
            "extreme_share": clipped,
        }


def _check_share(share: float) -> None:
    if not 0 < share <= 1:
        raise ValueError(f"share of contaminated lines must be in 0..1 and above 0, got {share}")


def _chosen_lines(draws: Draws, share: float, data: Tensor) -> Tensor:
    """round(share * lines) lines at random, at least one, bool (..., pulse)."""
    n_pulse = data.shape[-2]
    index = draws.subset("interference.lines", n_pulse, max(1, round(share * n_pulse)), data.device)
    lines = torch.zeros((*index.shape[:-1], n_pulse), dtype=torch.bool, device=data.device).scatter(-1, index, True)
    return lines.expand(data.shape[:-1])


def _add(recording: Recording, wave: Tensor, lines: Tensor, over_signal_db: Tensor | float) -> Recording:
    """The recording with the wave (unit mean power) on some lines, at a level over the mean power
    of those lines.
    """
    data = recording.signal.data
    power = (data.abs().square().mean(-1) * lines).sum(-1) / lines.sum(-1)
    ratio = 10 ** (per_trial(over_signal_db, 0, data) / 10)
    amplitude = torch.sqrt(power.to(torch.float64) * ratio).to(power.dtype)
    return replace(
        recording, signal=recording.signal.with_data(data + wave * (amplitude[..., None] * lines)[..., None])
    )
