"""Narrowband interference in raw lines: correction by one of three methods.

The interference is subtracted (`subtract_interference`, recommended), its frequencies are set to
zero (`notch_interference`), or whole lines are set to zero (`drop_interference`). Each of these
functions takes raw lines (..., pulse, range) and returns a `Repaired`. The corresponding stages of
a processing chain (`SubtractInterference`, `NotchInterference`, `DropInterference`) return the
corrected signal and a mask of the lines that are missing afterwards; a later stage can fill these
lines. Lines without interference are unchanged bit for bit.

Pulses of another radar in raw lines: parts of lines are marked by their energy, and filled.

Reference:
    Tsvetkov 2017, Figs. 2 and 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    differentiable,
    host_largest,
    level_of,
    power_of,
)
from torchsar.repair.assess import assess_lines
from torchsar.repair.contamination import (
    THRESHOLD,
    anything,
    excess_of,
    find_band,
    find_contamination,
    find_tones,
    line_spectra,
    subtract_band,
    waveforms,
)
from torchsar.repair.fill import band_limited_fill


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


def notch_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated cells of the range spectrum to zero: a notch filter, the simplest method.

    >>> import torch
    >>> from torchsar import repair
    >>> raw = torch.randn(8, 256, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    >>> raw[3] += 10 * torch.exp(0.5j * torch.pi * torch.arange(256))
    >>> found = repair.notch_interference(raw)
    >>> [round(lines[3].abs().square().mean().item()) for lines in (raw, found.data)]
    [101, 1]

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
    raw, level, density, touched = _searched(raw, "notch_interference", threshold)
    spectrum = torch.fft.fft(raw)
    power = power_of(spectrum.detach()) / raw.shape[-1]
    hit = (excess_of(power, density) > threshold) & touched[..., None]
    # a line that still has more than 1.5 times the power of clutter counts as missing, by choice
    lost = touched & (power.masked_fill(hit, 0).sum(-1) > 1.5 * density.sum(-1))
    data = torch.where(touched[..., None], torch.fft.ifft(spectrum.masked_fill(hit, 0)), raw)
    return Repaired(
        data.masked_fill(lost[..., None], 0) * level,
        touched,
        lost,
        hit.sum(-1),
        torch.zeros_like(touched, dtype=torch.float64),
    )


def drop_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated lines to zero and mark them as missing, so that a later stage can fill them.

    >>> import torch
    >>> from torchsar import repair
    >>> raw = torch.randn(8, 256, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    >>> raw[3] += 10 * torch.exp(0.5j * torch.pi * torch.arange(256))
    >>> found = repair.drop_interference(raw)
    >>> found.missing.nonzero().tolist(), found.data[3].abs().max().item()
    ([[3]], 0.0)

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
    return Repaired(
        raw.masked_fill(touched[..., None], 0) * level,
        touched,
        touched,
        torch.where(touched, raw.shape[-1], 0),
        torch.zeros_like(touched, dtype=torch.float64),
    )


def subtract_interference(raw: Tensor, threshold: float = THRESHOLD, most_tones: int = 4) -> Repaired:
    """Subtract tones by maximum likelihood, and wider interference as a narrowband random process.

    >>> import torch
    >>> from torchsar import repair
    >>> raw = torch.randn(8, 256, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    >>> raw[3] += 10 * torch.exp(0.5j * torch.pi * torch.arange(256))
    >>> found = repair.subtract_interference(raw)
    >>> found.touched.nonzero().tolist(), round(found.tone_cycles[3].item(), 3)
    ([[3]], 0.25)

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
    nothing = torch.zeros_like(found.lines)
    if not anything(found.lines):
        return Repaired(
            raw * scale, nothing, nothing, found.cells.sum(-1), torch.zeros_like(nothing, dtype=torch.float64)
        )
    # indices of the marked lines of each trial; unmarked lines follow
    count = host_largest(found.lines.sum(-1), found.lines.shape[-1])
    index = torch.argsort((~found.lines).to(torch.int8), dim=-1, stable=True)[..., :count]
    wide = index[..., None].expand(*index.shape, raw.shape[-1])
    lines, density = raw.gather(-2, wide), found.density.gather(-2, wide)
    tones = find_tones(lines, density, index.to(torch.float64), most_tones, threshold)
    touched, cycles = torch.zeros_like(index, dtype=torch.bool), torch.zeros_like(index, dtype=torch.float64)
    cleaned = lines - sum(waveforms(lines, tones))
    for tone in reversed(tones):
        touched, cycles = touched | tone.present, torch.where(tone.present, tone.frequency, cycles)
    # at most three bands, by choice, because every round requires a search in all lines
    for _ in range(3):
        banded = find_band(cleaned, density, threshold)
        if not anything(banded):
            break
        cleaned, touched = subtract_band(cleaned, banded, density), touched | banded
    # a line counts as missing if its cells above the threshold contain more power than the clutter
    # of the whole line
    power = line_spectra(cleaned.detach())
    left = (power * (excess_of(power, density) > threshold)).sum(-1)
    lost = touched & (left > density.sum(-1))
    cleaned = torch.where(touched[..., None], cleaned, lines).masked_fill(lost[..., None], 0)
    touched, lost = (nothing.scatter(-1, index, mask) for mask in (touched, lost))
    return Repaired(
        raw.scatter(-2, wide, cleaned) * scale,
        touched,
        lost,
        found.cells.sum(-1) * touched,
        torch.zeros_like(nothing, dtype=torch.float64).scatter(-1, index, cycles),
    )


def _searched(raw: Tensor, name: str, threshold: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines of unit level, their level, their density, and the lines with a tone or wider
    interference that lasts the whole line.
    """
    raw = checked_samples(raw, name, "pulse, range")
    level = level_of(raw)
    raw = raw / level
    found = find_contamination(raw, threshold)
    touched = find_band(raw, found.density, threshold) if anything(found.lines) else found.lines
    if anything(found.lines & ~touched):
        row = torch.arange(raw.shape[-2], dtype=torch.float64, device=raw.device).expand(touched.shape)
        for tone in find_tones(raw, found.density, row, 1, threshold):
            touched = touched | tone.present
    return raw, level, found.density, touched


class _InterferenceCorrection(Stage):
    """Common part of the three stages that correct interference.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    provides = ("missing",)
    neutral = {"missing": False}
    repair: Callable[..., Repaired]

    def __init__(self, threshold: float = THRESHOLD, *, assess: bool = True) -> None:
        super().__init__()
        if not threshold > 1:
            raise ValueError(
                "threshold must be above 1 (the mean power of clutter), got "
                f"{threshold}; 20 to 50 is useful, {THRESHOLD:g} the default"
            )
        self.threshold, self.assess = float(threshold), assess

    def forward(self, signal: Signal, missing: Tensor | None = None) -> tuple[Signal, Estimate]:
        """Correct raw lines that contain narrowband interference.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            missing: Lines that earlier stages marked as missing, shape (..., pulse), bool.

        Returns:
            The corrected signal, and an Estimate with `missing` of shape (..., pulse), bool: lines
            that were missing before, or that this stage could not correct and set to zero.
            `quality` is the share of lines that this stage did not set to zero. The outcome is
            EMPTY for data that are all zero, and TOO_FEW where less than half of the lines remain.
            It is MISFIT where lines with more than four times the median power of their neighbours
            hold more power than the rest. Their interference is not narrowband, or too short to be
            found. It is OK where there is no interference. `info` holds, for each trial, the
            numbers of corrected lines, `lines_touched`, and of contaminated frequency cells,
            `cells_touched`; and for each line whether it was corrected, `touched`, and the
            frequency of its strongest tone, `tone_cycles_per_sample`.
        """
        result = type(self).repair(signal.data, self.threshold)
        given_up = result.missing if missing is None else result.missing | missing.bool()
        info = {
            "lines_touched": result.touched.sum(-1),
            "cells_touched": result.cells.sum(-1),
            "touched": result.touched,
            "tone_cycles_per_sample": result.tone_cycles,
        }
        not_assessed: dict[str, Any] = {"outcome": Outcome.NOT_ASSESSED.like(info["lines_touched"])}
        judged = assess_lines(result.data, result.missing) if self.assess else not_assessed
        return signal.with_data(result.data), Estimate({"missing": given_up}, **judged, info=info)


class SubtractInterference(_InterferenceCorrection):
    """Stage that subtracts narrowband interference (recommended); see `subtract_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(subtract_interference)


class NotchInterference(_InterferenceCorrection):
    """Stage that removes narrowband interference by a notch filter; see `notch_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

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
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(drop_interference)


@torch.no_grad()
def hit_parts(raw: Tensor, parts: int = 32, threshold: float = 3.0) -> Tensor:
    """Mark parts of lines with more energy than the same part of the lines nearby has.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        parts: Number of parts of a line.
        threshold: Least power of a part over the median of 65 lines.

    Returns:
        True for the parts that are hit, shape (..., pulse, part), bool.
    """
    length = -(-raw.shape[-1] // parts)
    power = pad(power_of(raw / level_of(raw)), (0, -raw.shape[-1] % length)).unflatten(-1, (-1, length)).mean(-1)
    half = min(32, power.shape[-2] - 1)
    # lines at the ends are compared with as many lines inside
    around = torch.cat([power[..., 1 : half + 1, :].flip(-2), power, power[..., -half - 1 : -1, :].flip(-2)], -2)
    usual = around.unfold(-2, 2 * half + 1, 1).median(-1).values
    return power > threshold * usual


@differentiable("yes")
def remove_pulses(raw: Tensor, parts: int = 32, threshold: float = 3.0) -> Tensor:
    """Remove pulses of another radar: parts of lines that they hit are filled from other lines.

    >>> import torch
    >>> from torchsar import repair
    >>> raw = torch.randn(1, 256, dtype=torch.complex64).expand(64, -1).clone()  # Doppler zero
    >>> hit = raw.clone()
    >>> hit[10, 40:80] += 30
    >>> bool((repair.remove_pulses(hit) - raw).abs().square().mean() < 1e-3)
    True

    A part of a line is hit if it has clearly more energy than the median of the same part of the
    lines nearby, as a pulse that lasts less than a line makes it in less than half of the lines. A
    target of this power that is seen in fewer than 33 lines is taken for a pulse and removed too.
    Parts are filled as by `band_limited_fill`, which needs a Doppler band below the PRF.
    Interference that lasts whole lines is one for `subtract_interference`. Differentiable in the
    samples that are kept.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        parts: Number of parts of a line.
        threshold: Least power of a part over the median of 65 lines. Clutter reaches 2.5 in parts
            of 12 samples; in parts of 2 samples it exceeds 3 in one of 25 parts.

    Returns:
        Lines of the same shape; parts that are not hit are unchanged.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, a sample is not finite, or an option is not positive.
    """
    raw = checked_samples(raw, "remove_pulses", "pulse, range")
    if not (parts >= 1 and threshold > 1):
        raise ValueError(
            f"remove_pulses: parts must be 1 or more and threshold above 1, got parts {parts} and threshold {threshold}"
        )
    hit, n = hit_parts(raw, parts, threshold), raw.shape[-1]
    length = -(-n // parts)
    blocks = pad(raw, (0, -n % length)).unflatten(-1, (-1, length)).movedim(-2, -3)
    filled = band_limited_fill(blocks, hit.mT).movedim(-3, -2).flatten(-2)[..., :n]
    return torch.where(hit.repeat_interleave(length, -1)[..., :n], filled, raw)


RemovePulses = Stage.of(remove_pulses)
