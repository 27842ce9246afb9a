"""External narrowband interference: three repairs with one interface.

Each function takes raw lines (..., pulse, range) and returns a Repaired; each stage returns the
signal and an Estimate that says how many lines and cells were touched and which lines are missing
now (for the stage that fills lines). Lines without interference pass bit by bit. Recommended:
`subtract_interference`. Source: brief 004, item 3; Tsvetkov 2017.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage
from torchsar.repair.interference_band import find_band, subtract_band
from torchsar.repair.interference_detect import THRESHOLD, Level, clean_level, line_spectra, stands_out
from torchsar.repair.interference_tone import Tone, anything, find_tones, subtract_tones

_BAND_ROUNDS = 3


@dataclass(frozen=True)
class Repaired:
    """data (..., pulse, range); touched, missing: lines that were changed and lines given up, bool
    (..., pulse).

    cells: number of range-frequency cells of each line that stood above the threshold, int64 (...,
    pulse). tone_cycles: frequency of the strongest tone of each line in cycles per sample, 0 where
    there is none, float64 (..., pulse).
    """

    data: Tensor
    touched: Tensor
    missing: Tensor
    cells: Tensor
    tone_cycles: Tensor


@dataclass(frozen=True)
class Contamination:
    """Suspected lines and cells: excess (..., pulse, range) of the range spectra over the robust
    level, FFT order, and what exceeds.
    """

    level: Level
    excess: Tensor
    cells: Tensor
    lines: Tensor


def find_contamination(raw: Tensor, threshold: float = THRESHOLD) -> Contamination:
    """Cells whose tapered range spectrum exceeds `threshold` times the robust level, and lines
    where that is in few places. raw: (..., pulse, range).

    A first look: the repairs also test that what they see lasts the whole line, since regularly
    spaced targets make spectral lines too.
    """
    with torch.no_grad():
        power = line_spectra(raw)
        level = clean_level(power)
        excess = level.excess(power)
        cells = excess > threshold
    return Contamination(level, excess, cells, stands_out(excess, threshold))


def notch_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """The baseline: in contaminated lines, zero every cell of the range spectrum above the
    threshold. Differentiable in raw.

    Takes the clutter of those cells with it and leaves the skirts of the tone that lie below the
    threshold.
    """
    found = find_contamination(raw, threshold)
    touched = _interfered(raw.detach(), found, threshold)
    spectrum = torch.fft.fft(raw)
    with torch.no_grad():
        hit = (
            found.level.excess((spectrum.real.square() + spectrum.imag.square()) / raw.shape[-1]) > threshold
        ) & touched[..., None]
    data = torch.where(touched[..., None], torch.fft.ifft(spectrum.masked_fill(hit, 0)), raw)
    return Repaired(data, touched, torch.zeros_like(touched), hit.sum(-1), _no_tone(touched))


def drop_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Give contaminated lines up: they are set to zero and marked missing, for the stage that fills
    lines. Differentiable in raw.
    """
    found = find_contamination(raw, threshold)
    touched = _interfered(raw.detach(), found, threshold)
    data = raw.masked_fill(touched[..., None], 0)
    return Repaired(data, touched, touched, torch.where(touched, raw.shape[-1], 0), _no_tone(touched))


def subtract_interference(raw: Tensor, threshold: float = THRESHOLD, most_tones: int = 4) -> Repaired:
    """Subtract tones by maximum likelihood and what is wider as a narrowband process; give up lines
    that neither can save.

    raw: (..., pulse, range) complex. Up to `most_tones` tones a line, each with its own frequency
    and drift, amplitude and phase; up to three bands, each narrower than about 1/40 of the sampling
    rate. A tone costs a line of n samples 1 / n to 2 / n of the clutter's power at that frequency;
    a band of width B about B n / fs cells. A line is missing where interference stronger than its
    clutter is left. Differentiable in raw, with frequencies and spectra of the interferers held.
    Works on the contaminated lines only; the others pass bit by bit.
    """
    found = find_contamination(raw, threshold)
    if not anything(found.lines):
        nothing = torch.zeros_like(found.lines)
        return Repaired(raw, nothing, nothing, found.cells.sum(-1), _no_tone(nothing))
    index = _selection(found.lines)
    lines, level = _take_lines(raw, index), found.level.lines(index)
    with torch.no_grad():
        tones = find_tones(lines, level, index, most_tones, threshold)
    cleaned = subtract_tones(lines, tones)
    touched = torch.stack([torch.zeros_like(index, dtype=torch.bool), *(tone.present for tone in tones)]).any(0)
    for _ in range(_BAND_ROUNDS):
        banded, _ = find_band(cleaned, level, threshold)
        if not anything(banded):
            break
        cleaned, touched = subtract_band(cleaned, banded, level), touched | banded
    lost = touched & _ruined(cleaned.detach(), level, threshold)
    cleaned = torch.where(touched[..., None], cleaned, lines).masked_fill(lost[..., None], 0)
    everywhere = torch.zeros_like(found.lines)
    touched_all = everywhere.scatter(-1, index, touched)
    data = raw.scatter(-2, index[..., None].expand_as(cleaned), cleaned)
    cycles = _no_tone(everywhere).scatter(-1, index, _strongest(tones, index))
    return Repaired(data, touched_all, everywhere.scatter(-1, index, lost), found.cells.sum(-1) * touched_all, cycles)


def _interfered(raw: Tensor, found: Contamination, threshold: float) -> Tensor:
    """Lines with a tone or with something wider that lasts the whole line, (..., pulse) bool."""
    touched = find_band(raw, found.level, threshold)[0] if anything(found.lines) else found.lines
    for tone in find_tones(raw, found.level, most=1, threshold=threshold) if anything(found.lines & ~touched) else []:
        touched = touched | tone.present
    return touched


def _selection(lines: Tensor) -> Tensor:
    """Indices of marked lines in rising order, (..., count) int64, count the largest of any trial;
    unmarked lines fill up behind.
    """
    try:
        count = int(lines.sum(-1).max())
    except RuntimeError:  # inside vmap a value cannot be looked at
        count = lines.shape[-1]
    return torch.argsort((~lines).to(torch.int8), dim=-1, stable=True)[..., :count]


def _take_lines(raw: Tensor, index: Tensor) -> Tensor:
    return raw.gather(-2, index[..., None].expand(*index.shape, raw.shape[-1]))


def _ruined(lines: Tensor, level: Level, threshold: float) -> Tensor:
    """Lines where the cells still above the threshold hold more power than the clutter of the whole
    line, (..., pulse) bool.
    """
    power = line_spectra(lines)
    left = (power * (level.excess(power) > threshold)).sum(-1)
    return left > level.density.sum(-1)


def _no_tone(touched: Tensor) -> Tensor:
    return torch.zeros(touched.shape, dtype=torch.float64, device=touched.device)


def _strongest(tones: list[Tone], index: Tensor) -> Tensor:
    """Frequency of the first tone present in each line, else 0."""
    cycles = _no_tone(index)
    for tone in reversed(tones):
        cycles = torch.where(tone.present, tone.frequency, cycles)
    return cycles


class _InterferenceRepair(Stage):
    """Common part of the three stages: a repaired signal, and how much of it was touched.

    Estimate: value `missing` (..., pulse) bool, lines given up, joined with those that were missing
    before where a chain connects them (`missing`), so that one fill serves both; info
    `lines_touched`, `cells_touched` (...,) counts, `touched` (..., pulse), `tone_cycles_per_sample`
    (..., pulse); quality is the share of lines kept, ok False where fewer than half are.
    """

    provides = ("missing",)
    repair: Callable[..., Repaired]

    def __init__(self, threshold: float = THRESHOLD) -> None:
        super().__init__()
        if not threshold > 1:
            raise ValueError(
                f"threshold {threshold} is not above the mean level of clutter (1); choose 20 to 50, "
                f"by default {THRESHOLD:g}"
            )
        self.threshold = float(threshold)

    def forward(self, signal: Signal, missing: Tensor | None = None) -> tuple[Signal, Estimate]:
        result = type(self).repair(signal.data, self.threshold)
        quality = 1 - result.missing.to(torch.float64).mean(-1)
        given_up = result.missing if missing is None else result.missing | missing.bool()
        info = {
            "lines_touched": result.touched.sum(-1),
            "cells_touched": result.cells.sum(-1),
            "touched": result.touched,
            "tone_cycles_per_sample": result.tone_cycles,
        }
        return signal.with_data(result.data), Estimate({"missing": given_up}, quality, quality >= 0.5, info=info)


class SubtractInterference(_InterferenceRepair):
    """Recommended: see subtract_interference."""

    repair = staticmethod(subtract_interference)


class NotchInterference(_InterferenceRepair):
    """Baseline: see notch_interference."""

    repair = staticmethod(notch_interference)


class DropInterference(_InterferenceRepair):
    """See drop_interference; connect its `missing` to the stage that fills lines."""

    repair = staticmethod(drop_interference)
