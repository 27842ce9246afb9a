"""Impairments of the sequence of lines: lost, repeated and misnumbered lines.

A lost line leaves no gap: later lines move up, and the end of the matrix is filled with zero lines
of number -1, as in recordings of different lengths. Recorded side data with one entry per line move
with their lines. Combine impairments in the order lost, repeated, misnumbered. The first line is
never lost, since its number is the origin of the processing grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchsar.core import Draws, Recording
from torchsar.echo.recorded import with_samples
from torchsar.scene.trials import refuse_other_trials, refuse_unless

# line number of padding at the end of a trial, by convention, because no line has a negative number
PADDING = -1


def _numbers(recording: Recording) -> Tensor:
    """Line numbers (*trials, pulse); 0, 1, ... if the recording has none."""
    data = recording.signal.data
    number = recording.aux.get("line_number", torch.arange(data.shape[-2], device=data.device))
    return number.to(torch.int64).expand(data.shape[:-1])


def _valid_count(number: Tensor, draws: Draws) -> Tensor:
    """Number of valid lines of each trial, (trial,).

    If the draws have other trials, it is the smallest number of all trials, ().
    """
    have = (number != PADDING).sum(-1)
    return have if draws.trials is not None and have.shape == (len(draws.trials),) else have.min()


def _order(draws: Draws, purpose: str, n: Tensor, number: Tensor) -> Tensor:
    """Numbers 0..n-1 in random order for each trial, (*trials, largest n)."""
    order = draws.permutation(purpose, n.tolist(), number.device)
    if order.shape[:-1] not in ((), number.shape[:-1]):
        raise ValueError(
            f"draws must have the trials of the recording, of shape {tuple(number.shape[:-1])}, got trials of shape "
            f"{tuple(order.shape[:-1])}; use draws without trials for a single recording"
        )
    return order.expand(*number.shape[:-1], -1)


def _at(index: Tensor, n: int) -> Tensor:
    """Boolean mask (..., n) that is True at row indices (..., k)."""
    return torch.zeros((*index.shape[:-1], n), dtype=torch.bool, device=index.device).scatter(-1, index, True)


def take_lines(recording: Recording, source: Tensor) -> Recording:
    """Return a recording whose line i is line source[i] of the given recording.

    Args:
        recording: Recording of lines, shape (*trials, pulse, range).
        source: Index of the line to take, or -1 for a line of zeros with the line number -1, shape
            (*trials, pulse), int64.

    Returns:
        Recording of the shape of the given one; side data with one entry per line are rearranged as
        well.
    """
    data, n = recording.signal.data, recording.signal.data.shape[-2]
    present, index = source >= 0, source.clamp_min(0)
    lines = torch.where(present[..., None], data.gather(-2, index[..., None].expand(data.shape)), 0)
    aux = {}
    for name, value in {**recording.aux, "line_number": _numbers(recording)}.items():
        if name != "pilot" and value.ndim and value.shape[-1] == n:
            moved = value.expand(source.shape).gather(-1, index)
            aux[name] = torch.where(present, moved, PADDING if name == "line_number" else 0).to(value.dtype)
    return with_samples(recording, lines, **aux)


def _drop(recording: Recording, lost: Tensor) -> tuple[Recording, dict[str, Tensor]]:
    """Remove the lines under a mask (*trials, pulse); later lines move up."""
    n, number = lost.shape[-1], _numbers(recording)
    order = lost.to(torch.int8).argsort(dim=-1, stable=True)
    row = torch.arange(n, device=lost.device)
    kept = n - lost.sum(-1, keepdim=True)
    # the grid begins at the first line number
    slot = (number - number[..., :1]).clamp(0, n - 1)
    first = (~lost).to(torch.int8).argsort(dim=-1, stable=True)[..., : int((n - kept).max())]
    return take_lines(recording, torch.where(row < kept, order, -1)), {
        "lost": torch.zeros_like(lost).scatter(-1, slot, lost),
        "lost_number": torch.where(lost.gather(-1, first), number.gather(-1, first), PADDING),
    }


@dataclass(frozen=True)
class _Lost:
    """Base of the impairments in which lines are lost, given by their number or by a fraction."""

    count: int | None = None
    fraction: Tensor | float | None = None
    _lost: ClassVar[str] = "lines"

    def __post_init__(self) -> None:
        if (self.count is None) == (self.fraction is None):
            raise ValueError(
                f"lost {self._lost} need a count or a fraction, and not both, got count={self.count}, "
                f"fraction={self.fraction}"
            )
        if self.count is not None and self.count < 0:
            raise ValueError(f"count of lost {self._lost} must be 0 or more, got {self.count}")
        if self.fraction is not None:
            sentence = f"fraction of lost {self._lost} must be at least 0 and below 1"
            refuse_unless(sentence, self.fraction, lambda x: (x >= 0) & (x < 1))

    def _number(self, have: Tensor, like: Tensor) -> Tensor:
        """Number of the lines (...,) that are lost, float64. Raises ValueError if none would be
        left.
        """
        lost = have.to(torch.float64)
        if self.count is not None:
            lost = torch.full_like(lost, self.count)
        else:
            lost = torch.round(torch.as_tensor(self.fraction, dtype=torch.float64, device=like.device) * lost)
        if bool((lost >= have).any()):
            worst, lines = (int(v.expand(lost.shape)[lost >= have][0]) for v in (lost, have))
            raise ValueError(
                f"{worst} lost {self._lost} leave nothing of a recording of {lines} {self._lost}; lose fewer"
            )
        return lost


@dataclass(frozen=True)
class LostLines(_Lost):
    """Impairment: single lines lost at random positions.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"lost": echo.LostLines(count=2)}
    >>> recording, truth = echo.simulate(strip, world, 8, 64, Draws(1), errors)
    >>> truth.values["lost.lost_number"], recording.aux["line_number"]
    (tensor([3, 5]), tensor([ 0,  1,  2,  4,  6,  7, -1, -1]))

    The truth holds `lost`, shape (..., pulse), bool, indexed by the line number minus the number of
    the first line, and the numbers of the lost lines `lost_number`, shape (..., count), padded with
    -1 where trials lose fewer lines.

    Args:
        count: Number of lost lines, fixed for all trials; None if a fraction is given.
        fraction: Fraction of all lines, at least 0 and below 1; None if a count is given.

    Raises:
        ValueError: If both count and fraction are given or neither is, or one is out of range; when
            applied, if no line would be left or the trials of draws and recording differ.
    """

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        number = _numbers(recording)
        have = _valid_count(number, draws)
        count = self._number(have, number)
        order = _order(draws, "echo.lines.lost", have - 1, number)
        chosen = torch.arange(order.shape[-1], device=number.device) < count[..., None]
        lost = torch.zeros(number.shape, dtype=torch.bool, device=number.device)
        return _drop(recording, lost.scatter(-1, 1 + order, chosen.expand(order.shape)))


@dataclass(frozen=True)
class LostPulses(_Lost):
    """Impairment: whole pulses at random positions that were not received; their samples are zero.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"lost": echo.LostPulses(fraction=0.25)}
    >>> recording, _ = echo.simulate_turntable(isar, world, 8, 8, Draws(1), errors)
    >>> recording.signal.data[:, 4].abs().round(decimals=2)  # the range cell of the point
    tensor([0., 1., 1., 1., 1., 1., 0., 1.])

    All other pulses keep their positions, as where a trigger counts the pulses. (`LostLines` is the
    impairment in which later lines move up instead.) The true value `present`, shape (..., pulse),
    bool, is true for the pulses that were received.

    Args:
        count: Number of lost pulses, fixed for all trials; None if a fraction is given.
        fraction: Fraction of all pulses, at least 0 and below 1; None if a count is given.

    Raises:
        ValueError: Unless exactly one of count and fraction is given, and within its range. When
            applied, if no pulse would be left or the trials of draws and recording differ.
    """

    _lost: ClassVar[str] = "pulses"

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data = recording.signal.data
        n = data.shape[-2]
        count = self._number(torch.as_tensor(n, device=data.device), data)
        order = _order(draws, "echo.pulses.lost", torch.as_tensor(n), data[..., 0])
        kept = (torch.arange(n, device=data.device) >= count[..., None]).expand(data.shape[:-1])
        present = torch.zeros_like(kept).scatter(-1, order.expand(kept.shape), kept)
        return with_samples(recording, data * present[..., None]), {"present": present}


@dataclass(frozen=True)
class LostGaps:
    """Impairment: gaps of consecutive lost lines, with at least one received line between gaps.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"gap": echo.LostGaps(count=1, length=3)}
    >>> recording, truth = echo.simulate(strip, world, 8, 64, Draws(1), errors)
    >>> truth.values["gap.lost_number"], recording.aux["line_number"]
    (tensor([3, 4, 5]), tensor([ 0,  1,  2,  6,  7, -1, -1, -1]))

    The truth holds `lost`, shape (..., pulse), bool, indexed by the line number minus the number of
    the first line, and the numbers of the lost lines `lost_number`, shape (..., count * length).

    Args:
        count: Number of gaps, fixed for all trials.
        length: Number of lines of each gap, fixed for all trials.

    Raises:
        ValueError: If a number is out of range; when applied, if the gaps do not fit or the trials
            of draws and recording differ.
    """

    count: int
    length: int

    def __post_init__(self) -> None:
        if self.count < 0 or self.length < 1:
            raise ValueError(
                f"lost gaps need a count >= 0 and a length >= 1, got count={self.count}, length={self.length}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        number = _numbers(recording)
        have = _valid_count(number, draws)
        free = have - self.count * self.length
        if bool((free <= self.count).any()):
            raise ValueError(
                f"{self.count} gaps of {self.length} lines do not fit a recording of {int(have.min())} lines; "
                "lose fewer or shorter ones"
            )
        # A gap begins after a received line. The received lines before gaps are chosen first, and
        # then the gaps are inserted.
        kept = _order(draws, "echo.lines.gaps", free - 1, number)[..., : self.count].sort(-1).values
        begin = 1 + kept + self.length * torch.arange(self.count, device=number.device)
        index = (begin[..., None] + torch.arange(self.length, device=number.device)).flatten(-2)
        return _drop(recording, _at(index, number.shape[-1]))


@dataclass(frozen=True)
class RepeatedLines:
    """Impairment: lines that appear twice in succession, with the same number and samples.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"repeated": echo.RepeatedLines(count=1)}
    >>> recording, _ = echo.simulate(strip, world, 8, 64, Draws(1), errors)
    >>> recording.aux["line_number"]
    tensor([0, 0, 1, 2, 3, 4, 5, 6])

    The recording keeps its number of lines: as many lines (or padding) at its end are dropped as
    lines are repeated. The truth holds `repeated`, shape (..., pulse), bool, true for the second
    copy of each repeated line in the impaired recording.

    Args:
        count: Number of repeated lines, fixed for all trials.

    Raises:
        ValueError: If the count is negative; when applied, if it exceeds half of the lines or the
            trials of draws and recording differ.
    """

    count: int

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"repeated lines need a count >= 0, got {self.count}")

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        number = _numbers(recording)
        n, have = number.shape[-1], _valid_count(number, draws)
        if bool((self.count > have // 2).any()):
            raise ValueError(
                f"{self.count} repeated lines are more than half of a recording of {int(have.min())} lines; "
                "repeat fewer"
            )
        repeat = _at(_order(draws, "echo.lines.repeated", have - self.count, number)[..., : self.count], n)
        # line i comes after all copies of the lines before it, and its own copy comes after it
        landing = torch.arange(n, device=number.device) + repeat.cumsum(-1) - repeat.long()
        starts = torch.zeros((*number.shape[:-1], 2 * n), dtype=torch.int64, device=number.device).scatter(
            -1, landing, 1
        )[..., :n]
        source = (starts.cumsum(-1) - 1).clamp_max(n - 1)
        return take_lines(recording, source), {"repeated": starts == 0}


@dataclass(frozen=True)
class CorruptedNumbers:
    """Impairment: line numbers that are overwritten, while the samples are unchanged.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"numbers": echo.CorruptedNumbers(count=2, bits=4)}
    >>> recording, truth = echo.simulate(strip, world, 16, 64, Draws(1), errors)
    >>> (recording.aux["line_number"] != truth.values["numbers.true_number"]).sum()
    tensor(2)

    The truth holds, for each line of the recording, `corrupted`, bool, and `true_number`, shape
    (..., pulse) each.

    Args:
        count: Number of corrupted line numbers, fixed for all trials.
        bits: None to overwrite with random numbers of 0 to 65535; otherwise one randomly chosen bit
            among this many lowest bits of the number is flipped.

    Raises:
        ValueError: If a number is out of range; when applied, if the count exceeds the lines or the
            trials of draws and recording differ.
    """

    count: int
    bits: int | None = None

    def __post_init__(self) -> None:
        if self.count < 0 or (self.bits is not None and not 1 <= self.bits <= 31):
            raise ValueError(
                f"corrupted numbers need a count >= 0 and 1 to 31 bits, got count={self.count}, bits={self.bits}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        number = _numbers(recording)
        have = _valid_count(number, draws)
        if bool((self.count > have).any()):
            raise ValueError(
                f"{self.count} corrupted numbers are more than the {int(have.min())} lines of the recording; "
                "corrupt fewer"
            )
        index = _order(draws, "echo.lines.corrupted", have, number)[..., : self.count].sort(-1).values
        drawn = draws.uniform("echo.lines.number", (self.count,), 0.0, 1.0).to(number.device).expand(index.shape)
        true = number.gather(-1, index)
        wrong = (65536 * drawn).long() if self.bits is None else true ^ (1 << (self.bits * drawn).long())
        wrong = torch.where(wrong == true, true + 1, wrong)
        impaired = replace(recording, aux={**recording.aux, "line_number": number.scatter(-1, index, wrong)})
        return impaired, {"corrupted": _at(index, number.shape[-1]), "true_number": number}
