"""Errors of the receiver, and echoes that do not share the motion of the scene.

Leakage, spurs and ground at rest keep their phase while the motion turns that of the scene. A level
is the ratio of the power of an effect, where it is present, to the mean power per sample that the
recording has without it, noise included. All axes of a recording other than pulses and samples,
such as channels and sweeps, get the same effect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, cis, linear_phasor, per_trial, reduced_turns
from torchsar.echo.recorded import with_samples
from torchsar.scene.trials import finite_numbers, refuse_other_trials, refuse_unless


def _lines(recording: Recording) -> Tensor:
    """Samples (..., pulse, sample), with one sample per pulse where there is no range axis."""
    data = recording.signal.data
    return data[..., None] if recording.signal.names[-1] == "pulse" else data


def _with_lines(recording: Recording, lines: Tensor) -> Recording:
    return with_samples(recording, lines[..., 0] if recording.signal.names[-1] == "pulse" else lines)


def _behind(recording: Recording, x: Tensor, dims: int) -> Tensor:
    """Insert dimensions of length one for the further axes into numbers (..., *dims) of
    each trial.
    """
    further = max(2, len(recording.signal.axes)) - 2
    return x.reshape(*x.shape[: x.ndim - dims], *[1] * further, *x.shape[x.ndim - dims :])


def _added(recording: Recording, wave: Tensor, over_signal_db: Tensor | float) -> tuple[Recording, Tensor]:
    """Add a wave (..., pulse, sample) of unit power to a recording, at a level relative to its
    power.

    Also returns the power of the wave, (...,).
    """
    lines = _lines(recording)
    dims = tuple(range(-max(2, len(recording.signal.axes)), 0))
    power = lines.abs().square().mean(dims, keepdim=True).to(torch.float64)
    power = power * 10 ** (per_trial(over_signal_db, -dims[0], lines) / 10)
    wave = _behind(recording, wave, 2)
    # a detector with one channel records the real part, at the same level
    norm, of_real = (torch.linalg.vector_norm(x, dim=(-2, -1), keepdim=True) for x in (wave, wave.real))
    wave = wave if lines.is_complex() else wave.real * (norm / of_real.clamp_min(1e-300))
    wave = wave.to(lines.dtype) * power.sqrt().to(lines.real.dtype)
    return _with_lines(recording, lines + wave), power.flatten(dims[0])[..., 0]


@dataclass(frozen=True)
@finite_numbers("leakage", position=None)
class Leakage:
    """Impairment: a constant of the receiver, its drift, or a spur.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"leakage": echo.Leakage(over_signal_db=0.0, position=0.75)}
    >>> recording, _ = echo.simulate_turntable(isar, world, 64, 8, Draws(1), errors)
    >>> recording.signal.data.abs().mean(-2).round(decimals=2)  # of 8 range cells
    tensor([0.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.3500, 0.0000, 0.0000])

    With all frequencies zero it is a constant offset, such as that of an analogue-to-digital
    converter or of the local oscillator. With frequencies it is a spur, such as the leakage of a
    clock. With a `position` it stands at one range cell, such as the leakage of a transmitter after
    range compression. Its phase at the first pulse is random in each trial. The truth holds the
    complex `leakage` of each pulse, shape (..., pulse), in units of its amplitude, and `power`, its
    power, shape (...,).

    Args:
        over_signal_db: Ratio in decibels of the power of the leakage, in the samples that have it,
            to the mean power per sample without it.
        sample_cycles: Frequency along samples in cycles per sample.
        pulse_cycles: Frequency along pulses in cycles per pulse.
        walk_rad: Standard deviation in radians of the change of its phase from pulse to pulse.
        position: Range cell as a fraction of the axis, 0..1; None for all samples.

    Raises:
        ValueError: If a number is not finite or the position is out of range.
    """

    over_signal_db: Tensor | float
    sample_cycles: Tensor | float = 0.0
    pulse_cycles: Tensor | float = 0.0
    walk_rad: Tensor | float = 0.0
    position: Tensor | float | None = None

    def __post_init__(self) -> None:
        if self.position is not None:
            refuse_unless("position of leakage must lie within 0..1", self.position, lambda x: (x >= 0) & (x <= 1))

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        lines = _lines(recording)
        (n_pulse, n), device = lines.shape[-2:], lines.device
        pulse, sample = (torch.arange(k, dtype=torch.float64, device=device) for k in (n_pulse, n))
        walk = draws.normal("leakage.walk", (n_pulse,), device=device)
        walk = per_trial(self.walk_rad, 1, lines) / (2 * math.pi) * (walk.cumsum(-1) - walk[..., :1])
        turns = draws.uniform("leakage.phase", (1,), device=device)
        turns = turns + per_trial(self.pulse_cycles, 1, lines) * pulse + walk
        along = per_trial(self.sample_cycles, 2, lines) * sample
        wave = cis(2 * math.pi * reduced_turns(turns[..., None] + along))
        if self.position is not None:
            wave = wave * (torch.round(per_trial(self.position, 2, lines) * (n - 1)) == sample)
        impaired, power = _added(recording, wave, self.over_signal_db)
        return impaired, {"leakage": cis(2 * math.pi * reduced_turns(turns)), "power": power}


@dataclass(frozen=True)
@finite_numbers("ground at rest")
class GroundAtRest:
    """Impairment: homogeneous ground at rest, whose echo does not share the motion of the target.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"ground": echo.GroundAtRest(over_signal_db=0.0)}
    >>> _, truth = echo.simulate_turntable(isar, world, 64, 8, Draws(1), errors)
    >>> truth.values["ground.band_cycles"]
    tensor(0.0200, dtype=torch.float64)

    Name it after the impairments and errors that the target alone has. The echo of each range cell
    is complex noise within a band about Doppler zero. The truth holds `band_cycles` and `power`,
    the mean power of the ground, shape (...,) each.

    Args:
        over_signal_db: Ratio in decibels of the mean power of the ground to the mean power per
            sample without it.
        band_cycles: Width of the Doppler band in cycles per pulse, 0..1.

    Raises:
        ValueError: If a number is not finite or the width is out of range.
    """

    over_signal_db: Tensor | float
    band_cycles: Tensor | float = 0.02

    def __post_init__(self) -> None:
        refuse_unless("band_cycles of ground must lie within 0..1", self.band_cycles, lambda x: (x >= 0) & (x <= 1))

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        lines = _lines(recording)
        n_pulse, n = lines.shape[-2:]
        # the noise is cut out of a longer periodic process, so that the ends of the record do not
        # join
        noise = draws.normal("ground.spectrum", (2 * n_pulse, n), torch.complex128, lines.device)
        band = per_trial(self.band_cycles, 2, lines)
        frequency = torch.fft.fftfreq(2 * n_pulse, dtype=torch.float64, device=lines.device)[:, None].abs()
        inside = frequency <= band / 2
        wave = torch.fft.ifft(noise * inside, dim=-2, norm="ortho") / inside.to(torch.float64).mean(-2, True).sqrt()
        impaired, power = _added(recording, wave[..., :n_pulse, :], self.over_signal_db)
        return impaired, {"band_cycles": band[..., 0, 0], "power": power}


@dataclass(frozen=True)
@finite_numbers("interfering pulses", prf_hz="positive", duration_s="positive", bandwidth_hz=0.0)
class PulsedInterference:
    """Impairment: pulses of another radar, at a pulse repetition frequency of its own.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"other": echo.PulsedInterference(30.0, prf_hz=98765.0, duration_s=1e-6)}
    >>> _, truth = echo.simulate(strip, world, 256, 64, Draws(1), errors)
    >>> truth.values["other.share"].mean().round(decimals=1)  # of all samples: 1e5 Hz * 1e-6 s
    tensor(0.1000, dtype=torch.float64)

    The first pulse begins at a random time. Pulses are linear chirps of a running oscillator, tones
    if `bandwidth_hz` is 0, or bursts of noise. A line is hit where a pulse overlaps its sampling
    window. The truth holds `share`, the fraction of the samples of each line that are hit, shape
    (..., pulse), and `power`, the power within a pulse, shape (...,).

    Args:
        over_signal_db: Ratio in decibels of the power within a pulse to the mean power per sample
            without it.
        prf_hz: Pulse repetition frequency of the other radar in hertz.
        duration_s: Length of its pulses in seconds.
        bandwidth_hz: Bandwidth of its chirps in hertz, 0 or more.
        frequency_hz: Baseband frequency of the middle of its pulses in hertz.
        bursts: Whether its pulses are white noise, independent from sample to sample.

    Raises:
        ValueError: If a number is not finite, or a frequency or duration is out of range.
    """

    over_signal_db: Tensor | float
    prf_hz: Tensor | float
    duration_s: Tensor | float
    bandwidth_hz: Tensor | float = 0.0
    frequency_hz: Tensor | float = 0.0
    bursts: bool = False

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        lines, fs = _lines(recording), recording.radar.sampling_hz
        n_pulse, n = lines.shape[-2:]
        pulse, sample = (torch.arange(k, dtype=torch.float64, device=lines.device) for k in (n_pulse, n))
        time = pulse[:, None] * recording.signal.axis("pulse").step + sample / fs
        rate, length, band, tone = (
            per_trial(value, 2, lines) for value in (self.prf_hz, self.duration_s, self.bandwidth_hz, self.frequency_hz)
        )
        cycles = time * rate + draws.uniform("pulsed.start", (1, 1), device=lines.device)
        since = (cycles - torch.floor(cycles)) / rate
        hit = since < length
        if self.bursts:
            wave = draws.normal("pulsed.noise", (n_pulse, n), torch.complex128, lines.device)
        else:
            wave = cis(2 * math.pi * reduced_turns(tone * time + band / (2 * length) * (since - length / 2).square()))
        impaired, power = _added(recording, wave * hit, self.over_signal_db)
        return impaired, {"share": hit.to(torch.float64).mean(-1), "power": power}


@dataclass(frozen=True)
@finite_numbers("quadrature errors")
class QuadratureError:
    """Impairment: gain and phase of the Q component that differ from those of the I component.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"iq": echo.QuadratureError(gain_db=1.0, phase_deg=5.0)}
    >>> _, truth = echo.simulate_turntable(isar, world, 64, 8, Draws(1), errors)
    >>> truth.values["iq.image_db"].round(decimals=1)
    tensor(-22.8000, dtype=torch.float64)

    Samples I + jQ become I + j g (Q cos e + I sin e) for a gain g and a phase e, and so a conjugate
    image is added to them. The truth holds `image_db`, the power of this image over that of the
    echo in decibels, shape (...,).

    Args:
        gain_db: Gain of Q over I in decibels.
        phase_deg: Deviation from quadrature in degrees.

    Raises:
        ValueError: If a number is not finite; when applied, if the samples are real.
    """

    gain_db: Tensor | float = 0.0
    phase_deg: Tensor | float = 0.0

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data = recording.signal.data
        if not data.is_complex():
            raise ValueError("quadrature errors need complex samples, got real ones; leave this impairment out")
        dims = len(recording.signal.axes)
        gain, phase = 10 ** (per_trial(self.gain_db, dims, data) / 20), per_trial(self.phase_deg, dims, data).deg2rad()
        real = data.real.dtype
        q = data.imag * (gain * torch.cos(phase)).to(real) + data.real * (gain * torch.sin(phase)).to(real)
        turned = torch.polar(gain, phase).flatten(-dims)[..., 0] if dims else torch.polar(gain, phase)
        image = (1 - turned).abs() / (1 + turned.conj()).abs()
        return with_samples(recording, torch.complex(data.real, q)), {"image_db": 20 * torch.log10(image)}


@dataclass(frozen=True)
@finite_numbers("steps of the gain")
class GainSteps:
    """Impairment: a gain of the receiver that changes in steps between pulses.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"gain": echo.GainSteps(count=1, step_db=6.0)}
    >>> _, truth = echo.simulate_turntable(isar, world, 8, 8, Draws(1), errors)
    >>> len(truth.values["gain.gain_db"].unique())
    2

    The gain of each section between two steps is drawn independently. The truth holds `gain_db`,
    shape (..., pulse).

    Args:
        count: Number of steps at random pulses, fixed for all trials.
        step_db: Standard deviation of the gain of a section in decibels.

    Raises:
        ValueError: If a number is not finite or the count is negative.
    """

    count: int = 4
    step_db: Tensor | float = 3.0

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"steps of the gain need a count >= 0, got {self.count}")

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        lines = _lines(recording)
        n_pulse = lines.shape[-2]
        at = draws.uniform("gain.steps", (self.count,), 0.0, float(n_pulse), device=lines.device)
        level = draws.normal("gain.level", (self.count + 1,), device=lines.device)
        section = (torch.arange(n_pulse, device=lines.device)[:, None] >= at[..., None, :]).sum(-1)
        gain_db = per_trial(self.step_db, 1, lines) * level.gather(-1, section.expand(*level.shape[:-1], n_pulse))
        gain = _behind(recording, 10 ** (gain_db / 20), 1)[..., None]
        return _with_lines(recording, lines * gain.to(lines.real.dtype)), {"gain_db": gain_db}


@dataclass(frozen=True)
@finite_numbers("jumps of the range gate", share=None)
class GateJumps:
    """Impairment: a range gate that jumps by whole cells.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"gate": echo.GateJumps(cells=2)}
    >>> recording, truth = echo.simulate_turntable(isar, world, 4, 16, Draws(1), errors)
    >>> recording.signal.data.abs().argmax(-1) - 8 == truth.values["gate.shift_cells"]
    tensor([True, True, True, True])

    Range cells are moved circularly, and their phases are kept. In dechirped pulses a shift is a
    change of the beat frequency. The truth holds `shift_cells`, shape (..., pulse), positive
    towards greater range.

    Args:
        cells: Largest jump in range cells; positions are uniform between minus and plus this value
            and are rounded to whole cells.
        share: Probability that the gate jumps at a pulse, above 0 and at most 1.
        lasting: Whether the gate stays where it jumped to until the next jump; otherwise it is back
            at the next pulse.

    Raises:
        ValueError: If a number is not finite or the share is out of range.
    """

    cells: Tensor | float
    share: Tensor | float = 1.0
    lasting: bool = False

    def __post_init__(self) -> None:
        refuse_unless("share of jumps must be above 0 and at most 1", self.share, lambda x: (x > 0) & (x <= 1))

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        lines = _lines(recording)
        n_pulse, n = lines.shape[-2:]
        jumps = draws.uniform("gate.jumps", (n_pulse,), device=lines.device) < per_trial(self.share, 1, lines)
        where = draws.uniform("gate.position", (n_pulse,), -1.0, 1.0, device=lines.device)
        shift = torch.where(jumps, torch.round(per_trial(self.cells, 1, lines) * where), 0)
        if self.lasting:
            pulse = torch.arange(n_pulse, device=lines.device)
            last = torch.where(jumps, pulse, -1).cummax(-1).values
            shift = torch.where(last >= 0, shift.gather(-1, last.clamp_min(0)), 0)
        moved = _behind(recording, shift, 1)
        if recording.signal.names[-1] == "range":
            index = (torch.arange(n, device=lines.device) - moved[..., None].long()) % n
            shape = torch.broadcast_shapes(lines.shape, index.shape)
            return _with_lines(recording, lines.expand(shape).gather(-1, index.expand(shape))), {"shift_cells": shift}
        beat = linear_phasor(-moved / n, -(n // 2), n, lines.dtype)
        return _with_lines(recording, lines * beat), {"shift_cells": shift}
