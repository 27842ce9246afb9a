"""Correction of narrowband interference from external sources, by one of three methods.

The interference is subtracted (`subtract_interference`, recommended), its frequencies are set to
zero (`notch_interference`), or whole lines are set to zero (`drop_interference`). Each of these
functions takes raw lines (..., pulse, range) and returns a `Repaired`. The corresponding stages of
a processing chain (`SubtractInterference`, `NotchInterference`, `DropInterference`) return the
corrected signal and a mask of the lines that are missing afterwards; a later stage can fill these
lines. Lines without interference are unchanged bit for bit.

Reference:
    Tsvetkov 2017, Figs. 2 and 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    host_largest,
    level_of,
    power_of,
    unit_level,
)
from torchsar.repair.interference_band import find_band, subtract_band
from torchsar.repair.interference_detect import THRESHOLD, Level, clean_level, line_spectra, stands_out
from torchsar.repair.interference_tone import Tone, anything, find_tones, subtract_tones

# Largest number of bands that are subtracted, by choice: every round costs a search of all lines.
_BAND_ROUNDS = 3
# Power of a line after a notch filter over that of clutter from which on it is lost, by choice.
_MOST_LEFT = 1.5


@dataclass(frozen=True)
class Repaired:
    """Lines after the correction of interference.

    Args:
        data: Lines, shape (..., pulse, range), complex.
        touched: Lines that were changed, shape (..., pulse), bool.
        missing: Lines that could not be corrected and are zero, shape (..., pulse), bool.
        cells: Number of contaminated range-frequency cells of each line: those above the threshold,
            or all cells of a line that is dropped, shape (..., pulse), int64.
        tone_cycles: Frequency of the strongest tone of each line in cycles per sample, 0 where
            there is none, shape (..., pulse), float64.
    """

    data: Tensor
    touched: Tensor
    missing: Tensor
    cells: Tensor
    tone_cycles: Tensor


@dataclass(frozen=True)
class Contamination:
    """Lines and range-frequency cells that may hold interference.

    Args:
        level: Robust estimate of the power spectral density without interference, one value for
            each cell of each line, for lines divided by the level of their trial
            (`torchsar.core.level_of`).
        excess: Power spectra divided by the level, in FFT order, shape (..., pulse, range).
        cells: Cells whose excess is above the threshold, shape (..., pulse, range), bool.
        lines: Lines whose spectrum has a narrow peak above the threshold (see `stands_out`), shape
            (..., pulse), bool.
    """

    level: Level
    excess: Tensor
    cells: Tensor
    lines: Tensor


def find_contamination(raw: Tensor, threshold: float = THRESHOLD) -> Contamination:
    """Find range-frequency cells with more power than clutter has, and the lines that hold them.

    Power is compared with a robust estimate of the clutter's spectrum. The lines found are only
    candidates: regularly spaced targets also make narrow spectral peaks, so the corrections test in
    addition that the energy of a peak lasts the whole line.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Contamination`, which marks cells (..., pulse, range) and lines (..., pulse).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw = checked_samples(raw, "find_contamination", "pulse, range")
    with torch.no_grad():
        power = line_spectra(unit_level(raw))
        level = clean_level(power)
        excess = level.excess(power)
        cells = excess > threshold
    return Contamination(level, excess, cells, stands_out(excess, threshold))


def notch_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated cells of the range spectrum to zero: a notch filter, the simplest method.

    The clutter of those cells is removed as well. Side lobes of a tone that are below the threshold
    remain; a line in which they make the power more than 1.5 times that of clutter is set to zero
    and marked as missing. Differentiable in the lines.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw, level, found, touched = _searched(raw, "notch_interference", threshold)
    spectrum = torch.fft.fft(raw)
    with torch.no_grad():
        power = power_of(spectrum) / raw.shape[-1]
        hit = (found.level.excess(power) > threshold) & touched[..., None]
        left = power.masked_fill(hit, 0).sum(-1)
        lost = touched & (left > _MOST_LEFT * found.level.density.sum(-1))
    data = torch.where(touched[..., None], torch.fft.ifft(spectrum.masked_fill(hit, 0)), raw)
    data = data.masked_fill(lost[..., None], 0)
    return Repaired(data * level, touched, lost, hit.sum(-1), _no_tone(touched))


def drop_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated lines to zero and mark them as missing, so that a later stage can fill them.

    Differentiable in the lines.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw, level, _, touched = _searched(raw, "drop_interference", threshold)
    data = raw.masked_fill(touched[..., None], 0)
    return Repaired(data * level, touched, touched, torch.where(touched, raw.shape[-1], 0), _no_tone(touched))


def subtract_interference(raw: Tensor, threshold: float = THRESHOLD, most_tones: int = 4) -> Repaired:
    """Subtract tones by maximum likelihood, and wider interference as a narrowband random process.

    A tone has its own frequency, linear drift, amplitude and phase in each line. Wider interference
    is subtracted in up to three bands, each narrower than about 1/40 of the sampling rate fs. The
    subtraction also removes some clutter. In a line of n samples, which has n frequency cells, a
    tone costs the clutter of 1 to 2 cells, and a band of width B that of about B n / fs cells. A
    line in which the remaining interference is stronger than the clutter is set to zero and marked
    as missing. Lines without interference are unchanged. Differentiable in the lines, with the
    frequencies and spectra of the interference held fixed.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.
        most_tones: Largest number of tones that are subtracted from a line.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw = checked_samples(raw, "subtract_interference", "pulse, range")
    scale = level_of(raw)
    raw = raw / scale
    found = find_contamination(raw, threshold)
    if not anything(found.lines):
        nothing = torch.zeros_like(found.lines)
        return Repaired(raw * scale, nothing, nothing, found.cells.sum(-1), _no_tone(nothing))
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
    lost = touched & _uncorrected(cleaned.detach(), level, threshold)
    cleaned = torch.where(touched[..., None], cleaned, lines).masked_fill(lost[..., None], 0)
    everywhere = torch.zeros_like(found.lines)
    touched_all = everywhere.scatter(-1, index, touched)
    data = raw.scatter(-2, index[..., None].expand_as(cleaned), cleaned)
    cycles = _no_tone(everywhere).scatter(-1, index, _strongest(tones, index))
    return Repaired(
        data * scale, touched_all, everywhere.scatter(-1, index, lost), found.cells.sum(-1) * touched_all, cycles
    )


def _searched(raw: Tensor, name: str, threshold: float) -> tuple[Tensor, Tensor, Contamination, Tensor]:
    """Lines of unit level, their level, where they are contaminated, and the lines to treat."""
    raw = checked_samples(raw, name, "pulse, range")
    level = level_of(raw)
    raw = raw / level
    found = find_contamination(raw, threshold)
    return raw, level, found, _contaminated(raw.detach(), found, threshold)


def _contaminated(raw: Tensor, found: Contamination, threshold: float) -> Tensor:
    """Lines with a tone or wider interference that lasts the whole line, (..., pulse) bool."""
    touched = find_band(raw, found.level, threshold)[0] if anything(found.lines) else found.lines
    for tone in find_tones(raw, found.level, most=1, threshold=threshold) if anything(found.lines & ~touched) else []:
        touched = touched | tone.present
    return touched


def _selection(lines: Tensor) -> Tensor:
    """Indices of the marked lines of each trial, rising; unmarked ones follow."""
    count = host_largest(lines.sum(-1), lines.shape[-1])
    return torch.argsort((~lines).to(torch.int8), dim=-1, stable=True)[..., :count]


def _take_lines(raw: Tensor, index: Tensor) -> Tensor:
    """Lines of these indices."""
    return raw.gather(-2, index[..., None].expand(*index.shape, raw.shape[-1]))


def _uncorrected(lines: Tensor, level: Level, threshold: float) -> Tensor:
    """Lines whose cells above the threshold hold more power than the clutter of the whole line."""
    power = line_spectra(lines)
    left = (power * (level.excess(power) > threshold)).sum(-1)
    return left > level.density.sum(-1)


def _disturbed(lines: Tensor, reach: int = 8) -> Tensor:
    """Trials in which lines that stand out among their neighbours hold more power than the rest."""
    power = lines.abs().to(torch.float64).square().mean(-1)
    row = torch.arange(power.shape[-1], device=power.device)
    near = (row[:, None] + torch.arange(-reach, reach + 1, device=power.device)).clamp(0, power.shape[-1] - 1)
    usual = torch.where(power > 0, power, torch.nan)[..., near].nanmedian(-1).values.nan_to_num(0)
    excess = torch.where(power > 4 * usual, power - usual, 0)
    return excess.sum(-1) > (power - excess).sum(-1)


def _no_tone(touched: Tensor) -> Tensor:
    """Zero frequency of every line."""
    return torch.zeros(touched.shape, dtype=torch.float64, device=touched.device)


def _strongest(tones: list[Tone], index: Tensor) -> Tensor:
    """Frequency of the strongest tone in each line, 0 where there is none."""
    cycles = _no_tone(index)
    for tone in reversed(tones):
        cycles = torch.where(tone.present, tone.frequency, cycles)
    return cycles


class _InterferenceCorrection(Stage):
    """Common part of the three stages.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    provides = ("missing",)
    neutral = {"missing": False}
    repair: Callable[..., Repaired]

    def __init__(self, threshold: float = THRESHOLD) -> None:
        super().__init__()
        if not threshold > 1:
            raise ValueError(
                "threshold must be above 1 (the mean power of clutter), got "
                f"{threshold}; 20 to 50 is useful, {THRESHOLD:g} the default"
            )
        self.threshold = float(threshold)

    def forward(self, signal: Signal, missing: Tensor | None = None) -> tuple[Signal, Estimate]:
        """Correct raw lines that contain narrowband interference.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            missing: Lines that earlier stages marked as missing, shape (..., pulse), bool.

        Returns:
            The corrected signal, and an Estimate with `missing` of shape (..., pulse), bool: lines
            that were missing before, or that this stage could not correct and set to zero.
            `quality` is the share of lines that this stage did not set to zero; `ok` is False where
            it is below one half, for data that are all zero, and where lines with more than four
            times the median power of their neighbours hold more power than the rest: interference
            that is not narrowband, or too short to be found. `info` holds, for each trial, the
            numbers of corrected lines, `lines_touched`, and of contaminated frequency cells,
            `cells_touched`; and for each line whether it was corrected, `touched`, and the
            frequency of its strongest tone, `tone_cycles_per_sample`.
        """
        result = type(self).repair(signal.data, self.threshold)
        quality = 1 - result.missing.to(torch.float64).mean(-1)
        ok = (quality >= 0.5) & (signal.data != 0).any(-1).any(-1) & ~_disturbed(result.data)
        given_up = result.missing if missing is None else result.missing | missing.bool()
        info = {
            "lines_touched": result.touched.sum(-1),
            "cells_touched": result.cells.sum(-1),
            "touched": result.touched,
            "tone_cycles_per_sample": result.tone_cycles,
        }
        return signal.with_data(result.data), Estimate(
            {"missing": given_up}, quality=quality, outcome=Outcome.of(ok, Outcome.NOISE), info=info
        )


class SubtractInterference(_InterferenceCorrection):
    """Stage that subtracts narrowband interference (recommended); see `subtract_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(subtract_interference)


class NotchInterference(_InterferenceCorrection):
    """Stage that removes narrowband interference by a notch filter; see `notch_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(notch_interference)


class DropInterference(_InterferenceCorrection):
    """Stage that sets lines with interference to zero, so that a later stage can fill them.

    The stage returns the mask of these lines as `missing`; see `drop_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(drop_interference)
