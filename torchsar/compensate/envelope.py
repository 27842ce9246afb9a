"""Alignment of the envelopes of pulses in range, ahead of any estimate of their phases (brief 002,
section 9).

A shift is the place of a pulse against what the pulses have in common, in cells, towards greater
range and circular in the window. It is to be removed: `shift_range(data, -shift_cells)`. Envelopes
are powers |s|^2 on a grid of half cells, where they are band-limited and shifts by any fraction
exact, each over its own mean: neither the phase nor the gain of a pulse can change its shift.

A range cell of many scatterers is speckle: its power in a pulse is exponential about the mean T of
all pulses, noise included. The log-likelihood of a shift is then the correlation of |s|^2 with -1 /
T, not with T or with |s|. On the aircraft of brief 002 this halves the jitter of single pulses and
lets a polynomial be found at -10 dB.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.envelope_fit import (
    Course,
    Envelopes,
    Match,
    about_circular_mean,
    running_shifts,
    single_shifts,
    smooth_shifts,
    unit_time,
    with_tones,
)
from torchsar.compensate.pulse_phase.data import checked
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.stages import correct_pulse_phase
from torchsar.core import Estimate, Signal, Stage, block_bytes_of, fft_lines, legendre, linear_phasor, refuse_non_finite
from torchsar.metrics.image import entropy
from torchsar.optim.descent import lbfgs

GOOD_CELLS = 0.5  # deviation of a shift beyond which an alignment is not ok


def shift_range(data: Tensor, shift_cells: Tensor | float) -> Tensor:
    """Every pulse moved by its shift towards greater range, circularly.

    data: (..., pulse, range) complex; shift_cells: (..., pulse), (pulse,) or a number.

    A linear phase about the centre of fast time, the middle of the band: the phase of an echo does
    not turn with its place. Unitary, and shift_range(., -s) undoes shift_range(., s).
    Differentiable in both. Raises ValueError for shifts of another shape or not finite.
    """
    n = data.shape[-1]
    shift = torch.as_tensor(shift_cells, dtype=torch.float64, device=data.device)
    if shift.ndim and shift.shape[-1] != data.shape[-2]:
        raise ValueError(f"one shift per pulse is needed, (..., {data.shape[-2]}), got {tuple(shift.shape)}")
    refuse_non_finite(shift, "shift_range: shift_cells")
    phasor = torch.fft.ifftshift(linear_phasor(-shift / n, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)


def align_running(data: Tensor, *, memory_pulses: float = 10.0) -> Estimate:
    """Shift of each pulse against an exponentially running mean of the aligned ones before it, with
    value["shift_cells"] (..., pulse).

    data: (..., pulse, range) complex, range-compressed. Correlates |s|, peak by a parabola through
    samples a quarter of a cell apart. memory_pulses: how far the mean reaches back. Follows any
    motion of less than half a window from pulse to pulse, but the mean drifts: for a start. See
    `align_envelopes`, also for std, ok and errors.
    """
    if not memory_pulses >= 1:
        raise ValueError(f"align_running: memory_pulses is {memory_pulses}; choose 1 or more")
    return _estimated(data, "align_running", lambda pulses: (running_shifts(pulses, 1 / memory_pulses), None))


def align_mean(
    data: Tensor, *, first: Literal["running", "none"] = "running", match: Match = "likelihood", iterations: int = 4
) -> Estimate:
    """Shift of each pulse by itself against the mean envelope of all, iterated, with
    value["shift_cells"] (..., pulse).

    data: (..., pulse, range) complex. first: where to begin, the running mean or the data as they
    are. match: "likelihood" correlates |s|^2 with -1 / T, "amplitude" |s| with its mean. On a
    perfect recording of the aircraft the shifts have 0.03 cell (likelihood) or 0.07 cell rms of
    speckle jitter. For motion that has no smooth course; otherwise `align_envelopes`, also for std,
    ok and errors.
    """
    if first not in ("running", "none") or match not in ("likelihood", "amplitude") or iterations < 1:
        raise ValueError(
            f"align_mean: first is {first!r} ('running' or 'none'), match {match!r} ('likelihood' "
            f"or 'amplitude'), iterations {iterations} (1 or more)"
        )

    def find(pulses: Envelopes) -> Course:
        start = (
            running_shifts(pulses, 0.1) if first == "running" else torch.zeros_like(pulses.present, dtype=torch.float64)
        )
        return single_shifts(pulses, start, match, iterations), None

    return _estimated(data, "align_mean", find)


def align_envelopes(
    data: Tensor, *, degree: int | None = 2, tones: int = 0, passes: int = 6, blocks: int = 16
) -> Estimate:
    """The recommended alignment, with value["shift_cells"] (..., pulse) to be removed: a smooth
    course of shifts of mean zero.

    data: (..., pulse, range) complex, range-compressed, of any phases. The line along which the
    coarse envelopes add up best, then `passes` rounds: the mean envelope, the likelihood of the
    shift of each of `blocks` runs of pulses against that of the others, and a polynomial of
    `degree` through these, robust against runs that went wrong. tones: number of sinusoids
    (vibration) that are then looked for in the shifts of single pulses, and kept where they stand
    out; they need periods of two pulses or more, and shifts of single pulses, that is about -5 dB.
    degree None: shifts of single pulses, not smoothed, begun at a parabola.

    On the aircraft of brief 002 (400 pulses) the course is found to 0.02 cell down to -8 dB and to
    0.05 cell at -12.5 dB, and costs perfect data less than 0.002 nats. Shifts may pass the ends of
    the window any number of times, but not curve away from a line by half a window. A pulse of
    zeros takes the place that the course gives it. std: half of the rms difference between what the
    lower and the upper half of the band say, each found from nothing, or the deviation of the
    course by the scatter of its runs where that is more; ok: it is below half a cell. quality: 1 /
    (1 + (2 std)^2). Not differentiable. Raises TypeError or ValueError for samples that are not
    finite and complex, or settings that make no sense.
    """
    whole = all(isinstance(value, int) for value in (degree or 0, tones, passes, blocks))
    if not (whole and (degree is None or degree >= 0) and tones >= 0 and passes >= 1 and blocks >= 1) or (
        degree is None and tones
    ):
        raise ValueError(
            f"align_envelopes: degree is {degree!r} (0 or more; None without tones), tones "
            f"{tones!r} (0 or more), passes {passes!r} and blocks {blocks!r} (1 or more); whole "
            "numbers"
        )

    def find(pulses: Envelopes) -> Course:
        smooth, deviation = smooth_shifts(pulses, 2 if degree is None else degree, passes, blocks)
        if degree is None:
            return single_shifts(pulses, smooth, "likelihood", 3), None
        return with_tones(pulses, smooth, tones, degree), deviation

    return _estimated(data, "align_envelopes", find)


def refine_alignment(
    data: Tensor, shift_cells: Tensor, *, degree: int = 2, rounds: int = 2, steps: int = 15
) -> Estimate:
    """Image-based refinement: the polynomial that, added to shifts (..., pulse), gives the image of
    least entropy, with value["shift_cells"].

    data: (..., pulse, range) complex. In each round `autofocus` finds the phases at the present
    shifts; then the coefficients of degrees 1..degree are varied with these phases held
    (torchsar.optim.lbfgs, each trial by itself, at most `steps` steps). A round that does not lower
    the entropy is not taken. Needs phases that can be found, that is shifts within about a cell. On
    shifts of `align_envelopes` it changes the entropy by less than 0.005. ok and quality: those of
    the last autofocus. Errors as `align_envelopes`.
    """
    flat, _ = checked(data, "refine_alignment")
    if degree < 1 or rounds < 1:
        raise ValueError(f"refine_alignment: degree is {degree} and rounds {rounds}; choose 1 or more of both")
    flat, shift = flat.detach(), shift_cells.detach().to(torch.float64).expand(data.shape[:-1]).reshape(flat.shape[:-1])
    basis = legendre(unit_time(flat.shape[-2], flat.device), degree)[:, 1:]
    phase = autofocus(shift_range(flat, -shift))
    least = entropy(_focused(flat, shift, phase["phase_rad"]))
    for _ in range(rounds):
        held = phase["phase_rad"]

        def cost(c: Tensor, shift: Tensor = shift, held: Tensor = held) -> Tensor:
            return entropy(_focused(flat, shift + (basis @ c[..., None])[..., 0], held)).double()

        found = lbfgs(cost, shift.new_zeros(len(flat), degree), steps=steps, first_step=0.05)
        moved = shift + (basis @ found.x[..., None])[..., 0]
        phase = autofocus(shift_range(flat, -moved), start=held)
        reached = entropy(_focused(flat, moved, phase["phase_rad"]))
        shift, least = torch.where((reached < least)[:, None], moved, shift), torch.minimum(reached, least)
    shape = data.shape[:-2]
    return Estimate(
        {"shift_cells": shift.reshape(data.shape[:-1])},
        phase.quality.reshape(shape),
        phase.ok.reshape(shape),
        info={"entropy_nats": least.reshape(shape)},
    )


def _focused(data: Tensor, shift: Tensor, phase_rad: Tensor) -> Tensor:
    return fft_lines(correct_pulse_phase(shift_range(data, -shift), phase_rad))


def drift_cells(shift_cells: Tensor) -> Tensor:
    """Mean drift of shifts (..., pulse), cells a pulse (...,): the slope of the line through them
    by least squares; 0 for a single pulse.
    """
    n = shift_cells.shape[-1]
    k = torch.arange(n, dtype=shift_cells.dtype, device=shift_cells.device) - (n - 1) / 2
    return (shift_cells * k).sum(-1) / k.square().sum().clamp_min(1)


def _estimated(data: Tensor, name: str, find: Callable[[Envelopes], Course]) -> Estimate:
    """Shifts of the whole band and, to judge them, of its lower and upper half, whose speckle and
    noise are independent.
    """
    flat, present = checked(data, name)
    height = (
        max(1, 8 * block_bytes_of(flat.device) // max(1, flat[0].numel() * flat.element_size())) if len(flat) else 1
    )
    with torch.no_grad():
        parts = [_judged(flat[first : first + height].detach(), find) for first in range(0, len(flat), height)]
    parts = parts or [
        (torch.zeros_like(present, dtype=torch.float64), torch.zeros(0, dtype=torch.float64, device=flat.device))
    ]  # no trials
    shift, std = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
    learnable = present.sum(-1) >= 2
    shift, std = torch.where(learnable[:, None], shift, 0), torch.where(learnable, std, data.shape[-1] / math.sqrt(12))
    quality = 1 / (1 + (std / GOOD_CELLS).square())
    shape = data.shape[:-2]
    wide = std[:, None].expand_as(shift).reshape(data.shape[:-1])
    return Estimate(
        value={"shift_cells": shift.reshape(data.shape[:-1])},
        std={"shift_cells": wide},
        quality=quality.reshape(shape),
        ok=(learnable & (std < GOOD_CELLS)).reshape(shape),
        info={"present": present.reshape(data.shape[:-1])},
    )


def _judged(lines: Tensor, find: Callable[[Envelopes], Course]) -> tuple[Tensor, Tensor]:
    """Shifts (trial, pulse) and their deviation (trial,) in cells: what the halves disagree by, or
    what the method says itself where that is more.
    """
    envelopes, n = Envelopes.of(lines), lines.shape[-1]
    shift, deviation = find(envelopes)
    if n < 4:
        return shift, shift.new_full(shift.shape[:1], n / math.sqrt(12))
    lower, upper = (find(Envelopes.of(half))[0] * (n / half.shape[-1]) for half in _band_halves(lines))
    off = about_circular_mean(lower - upper, envelopes.present, n)
    disagreement = (off.square().sum(-1) / envelopes.present.sum(-1).clamp_min(1)).sqrt() / 2
    return shift, disagreement if deviation is None else torch.maximum(disagreement, deviation)


def _band_halves(lines: Tensor) -> list[Tensor]:
    """Pulses compressed from the two halves of the band alone, each about its own middle, (trial,
    pulse, n // 2), cells twice as wide.
    """
    half = lines.shape[-1] // 2
    spectrum = torch.fft.fftshift(torch.fft.fft(lines), dim=-1)
    return [torch.fft.ifft(torch.fft.ifftshift(part, dim=-1)) for part in (spectrum[..., :half], spectrum[..., -half:])]


class AlignEnvelopes(Stage):
    """`align_envelopes`, with shift_m (..., pulse) towards greater range, to be removed by
    `ShiftRange`, and the range rate velocity_m_s (...,).

    velocity_m_s: that of the residual drift (receding positive), added to the one that the pulses
    were compressed with where such a value is connected: what `focus.CompressDechirped` should be
    given. Drift is known modulo a window per pulse, and an acceleration a adds a f0 / gamma to it
    where dechirped pulses couple range to Doppler (0.13 s in brief 002).
    """

    provides = ("shift_m", "velocity_m_s")

    def __init__(self, degree: int | None = 2, tones: int = 0, passes: int = 6, blocks: int = 16) -> None:
        super().__init__()
        self.degree, self.tones, self.passes, self.blocks = degree, tones, passes, blocks

    def forward(self, signal: Signal, velocity_m_s: Tensor | None = None) -> Estimate:
        found = align_envelopes(
            signal.data, degree=self.degree, tones=self.tones, passes=self.passes, blocks=self.blocks
        )
        cell_m, per_s = signal.axis("range").step, 1 / signal.axis("pulse").step
        velocity = drift_cells(found["shift_cells"]) * (cell_m * per_s)
        value = {
            "shift_m": found["shift_cells"] * cell_m,
            "velocity_m_s": velocity if velocity_m_s is None else velocity + velocity_m_s,
        }
        return Estimate(value, found.quality, found.ok, {"shift_m": found.std["shift_cells"] * cell_m}, found.info)


class ShiftRange(Stage):
    """Moves every pulse back by shift_m (..., pulse), a value of `AlignEnvelopes`: see
    `shift_range`. Differentiable in both.
    """

    def forward(self, signal: Signal, shift_m: Tensor) -> Signal:
        return signal.with_data(shift_range(signal.data, -shift_m / signal.axis("range").step))
