"""Impairment to the sequence of lines: lost, repeated and misnumbered ones (brief 004, item 1).

A lost line is really gone: the later lines move up and the end of the matrix is filled with zero
lines of number -1, as in recordings of different lengths. Recorded side data that has one entry a
line moves with its line. Each object does one thing; combine them in the order lost, repeated,
misnumbered. The first line is never lost: its number is where the processor's grid begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording

PADDING = -1
# side data that is never one entry per line, whatever its length
_NOT_PER_LINE = ("pilot",)


def _numbers(recording: Recording) -> Tensor:
    """Line numbers (*trials, pulse), 0.. where the recording has none."""
    data = recording.signal.data
    number = recording.aux.get("line_number", torch.arange(data.shape[-2], device=data.device))
    return number.to(torch.int64).expand(data.shape[:-1])


def _valid_count(number: Tensor) -> int:
    """Lines that every trial has."""
    return int((number != PADDING).sum(-1).min())


def _of_draws(index: Tensor, number: Tensor) -> Tensor:
    """Drawn row indices (trial, k), or (k,), as (*trials of the recording, k).

    Raises ValueError where the trials do not agree.
    """
    try:
        return index.to(number.device).expand(*number.shape[:-1], index.shape[-1])
    except RuntimeError:
        raise ValueError(
            f"draws for {tuple(index.shape[:-1])} trials do not fit a recording of "
            f"{tuple(number.shape[:-1])} trials; draw one unbatched trial for a single recording"
        ) from None


def _at(index: Tensor, n: int) -> Tensor:
    """Bool mask (..., n) of row indices (..., k)."""
    return torch.zeros((*index.shape[:-1], n), dtype=torch.bool, device=index.device).scatter(-1, index, True)


def take_lines(recording: Recording, source: Tensor) -> Recording:
    """The recording whose line i is line source[i] of the given one, a zero line of number -1 where
    source is -1. source: (*trials, pulse).
    """
    data, n = recording.signal.data, recording.signal.data.shape[-2]
    present, index = source >= 0, source.clamp_min(0)
    lines = torch.where(present[..., None], data.gather(-2, index[..., None].expand(data.shape)), 0)
    aux = dict(recording.aux)
    for name, value in {**recording.aux, "line_number": _numbers(recording)}.items():
        if name not in _NOT_PER_LINE and value.ndim and value.shape[-1] == n:
            moved = value.expand(source.shape).gather(-1, index)
            aux[name] = torch.where(present, moved, PADDING if name == "line_number" else 0).to(value.dtype)
    return replace(recording, signal=recording.signal.with_data(lines), aux=aux)


def _drop(recording: Recording, lost: Tensor) -> tuple[Recording, dict[str, Tensor]]:
    """Remove the lines under the mask (*trials, pulse), which close up."""
    n, number = lost.shape[-1], _numbers(recording)
    order = lost.to(torch.int8).argsort(dim=-1, stable=True)
    row = torch.arange(n, device=lost.device)
    kept = n - lost.sum(-1, keepdim=True)
    # the grid of line numbers starts where the unimpaired numbers do
    slot = (number - number[..., :1]).clamp(0, n - 1)
    return take_lines(recording, torch.where(row < kept, order, -1)), {
        "lost": torch.zeros_like(lost).scatter(-1, slot, lost),
        "lost_number": number[lost].reshape(*number.shape[:-1], -1),
    }


@dataclass(frozen=True)
class LostLines:
    """Single lines lost at random places: `count` of them, or a `fraction` of all lines.

    Give one of the two.

    Truth: `lost` (..., pulse), the lost lines on the grid line number - first number; `lost_number`
    (..., count).
    """

    count: int | None = None
    fraction: float | None = None

    def __post_init__(self) -> None:
        if (self.count is None) == (self.fraction is None):
            raise ValueError(f"lost lines need a count or a fraction, got count={self.count}, fraction={self.fraction}")
        if (self.count is not None and self.count < 0) or (self.fraction is not None and not 0 <= self.fraction < 1):
            raise ValueError(
                f"lost lines need a count >= 0 or a fraction in 0..1, got count={self.count}, fraction={self.fraction}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        number = _numbers(recording)
        have = _valid_count(number)
        count = self.count if self.count is not None else round((self.fraction or 0.0) * have)
        if count >= have:
            raise ValueError(f"{count} lost lines leave nothing of a recording of {have} lines; lose fewer")
        index = _of_draws(1 + draws.subset("echo.lines.lost", have - 1, count), number)
        return _drop(recording, _at(index, number.shape[-1]))


@dataclass(frozen=True)
class LostGaps:
    """`count` gaps of `length` consecutive lines each, apart from one another.

    Truth as for LostLines.
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
        have = _valid_count(number)
        free = have - self.count * self.length
        if free <= self.count:
            raise ValueError(
                f"{self.count} gaps of {self.length} lines do not fit a recording of {have} lines; "
                "lose fewer or shorter ones"
            )
        # a gap begins behind a kept line: choose kept lines, then open the gaps
        begin = 1 + draws.subset("echo.lines.gaps", free - 1, self.count) + self.length * torch.arange(self.count)
        index = (begin[..., None] + torch.arange(self.length)).flatten(-2)
        return _drop(recording, _at(_of_draws(index, number), number.shape[-1]))


@dataclass(frozen=True)
class RepeatedLines:
    """`count` lines that a buffer hands over twice, number and samples alike; the last lines of a
    full matrix fall off its end.

    Truth: `repeated` (..., pulse), the second copies in the impaired matrix.
    """

    count: int

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"repeated lines need a count >= 0, got {self.count}")

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        number = _numbers(recording)
        n, have = number.shape[-1], _valid_count(number)
        if self.count > have // 2:
            raise ValueError(
                f"{self.count} repeated lines are more than half of a recording of {have} lines; repeat fewer"
            )
        repeat = _at(_of_draws(draws.subset("echo.lines.repeated", have - self.count, self.count), number), n)
        # line i lands behind all copies of the lines before it, and its own copy behind it
        landing = torch.arange(n, device=number.device) + repeat.cumsum(-1) - repeat.long()
        starts = torch.zeros((*number.shape[:-1], 2 * n), dtype=torch.int64, device=number.device).scatter(
            -1, landing, 1
        )[..., :n]
        source = (starts.cumsum(-1) - 1).clamp_max(n - 1)
        return take_lines(recording, source), {"repeated": starts == 0}


@dataclass(frozen=True)
class CorruptedNumbers:
    """`count` line numbers overwritten: by any number 0..65535, or by the true one with one of its
    low `bits` bits flipped.

    The samples are untouched. Truth: `corrupted` (..., pulse) and `true_number` (..., pulse), both
    in the order of the matrix.
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
        have = _valid_count(number)
        if self.count > have:
            raise ValueError(
                f"{self.count} corrupted numbers are more than the {have} lines of the recording; corrupt fewer"
            )
        index = _of_draws(draws.subset("echo.lines.corrupted", have, self.count), number)
        drawn = draws.uniform("echo.lines.number", (self.count,), 0.0, 1.0).to(number.device).expand(index.shape)
        true = number.gather(-1, index)
        wrong = (65536 * drawn).long() if self.bits is None else true ^ (1 << (self.bits * drawn).long())
        wrong = torch.where(wrong == true, true + 1, wrong)
        impaired = replace(recording, aux={**recording.aux, "line_number": number.scatter(-1, index, wrong)})
        return impaired, {"corrupted": _at(index, number.shape[-1]), "true_number": number}
