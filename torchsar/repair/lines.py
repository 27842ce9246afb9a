"""Line integrity: every line on its place of a regular azimuth grid, by numbers that are verified
before they are trusted.

A number is judged against its neighbours: of two lines in order the later has the larger number, by
at least their distance (lines are lost, never invented). In terms of offset = number - row this
says: offsets never fall. A number that contradicts most of its neighbours on either side is
corrupted. Source: brief 004, item 1; Tsvetkov 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage

PADDING = -1
# neighbours on each side that vote on a number: wide first, against clusters of corrupted numbers,
# then close ones, against small errors
_REACHES = (16, 4, 2)


@dataclass(frozen=True)
class LinePlan:
    """Where the received lines belong. n: rows of the regular grid; all per trial.

    source (..., n): received row for each row of the grid, -1 where there is none. number (...,
    received): verified number of each received row, -1 for padding, repeats and lines that could
    not be placed. missing: bool (..., n). corrected, repeated, unplaced: bool (..., received).
    first_number (...,): number of row 0 of the grid. trusted (...,): share of numbers that stood.
    ok: bool (...,).
    """

    source: Tensor
    number: Tensor
    missing: Tensor
    corrected: Tensor
    repeated: Tensor
    unplaced: Tensor
    first_number: Tensor
    trusted: Tensor
    ok: Tensor


def _shifted(x: Tensor, by: int, fill: int | bool) -> Tensor:
    """x[..., i + by], `fill` outside. |by| <= n."""
    edge = torch.full_like(x[..., : abs(by)], fill)
    return torch.cat([x[..., by:], edge], -1) if by > 0 else torch.cat([edge, x[..., :by]], -1)


def _votes(offset: Tensor, trusted: Tensor, reach: int, longest_gap: int, sign: int) -> tuple[Tensor, Tensor]:
    """How many trusted neighbours on one side (sign +1: later) contradict each line, and how many
    there are.
    """
    against, asked = torch.zeros_like(offset), torch.zeros_like(offset)
    for distance in range(1, min(reach, offset.shape[-1] - 1) + 1):
        there = _shifted(trusted, sign * distance, False)
        rise = sign * (_shifted(offset, sign * distance, 0) - offset)
        against = against + (there & ((rise < 0) | (rise > longest_gap)))
        asked = asked + there
    return against, asked


def _lonely_ends(offset: Tensor, trusted: Tensor) -> Tensor:
    """The first and the last trusted line where a jump parts them from the rest that is larger than
    any inside: nothing on their far side speaks for them.
    """
    before, after = _nearest(offset, trusted)
    first = trusted & (trusted.cumsum(-1) == 1)
    last = trusted & (trusted.flip(-1).cumsum(-1).flip(-1) == 1)
    inner = trusted & ~first & ~last
    known = torch.where(inner & _inner_before(inner), offset - before, 1).amax(-1, keepdim=True).clamp_min(1)
    return (first & (after - offset > known)) | (last & (offset - before > known))


def _inner_before(inner: Tensor) -> Tensor:
    """Lines that have an inner line somewhere before them."""
    return inner.cumsum(-1) > 1


def _nearest(offset: Tensor, trusted: Tensor) -> tuple[Tensor, Tensor]:
    """Offset of the nearest trusted line before and behind each row; where there is none on one
    side, that of the other side.
    """
    n = offset.shape[-1]
    row = torch.arange(n, device=offset.device).expand(offset.shape)
    before = _shifted(torch.where(trusted, row, -1).cummax(-1).values, -1, -1)
    after = _shifted(torch.where(trusted, row, n).flip(-1).cummin(-1).values.flip(-1), 1, n)
    left, right = offset.gather(-1, before.clamp_min(0)), offset.gather(-1, after.clamp_max(n - 1))
    return torch.where(before < 0, right, left), torch.where(after >= n, left, right)


def _disputed(offset: Tensor, trusted: Tensor) -> Tensor:
    """Trusted lines that lie above a later or below an earlier one."""
    limit = torch.iinfo(offset.dtype)
    highest = torch.where(trusted, offset, limit.min).cummax(-1).values
    lowest = torch.where(trusted, offset, limit.max).flip(-1).cummin(-1).values.flip(-1)
    return trusted & ((highest > offset) | (lowest < offset))


def trusted_numbers(offset: Tensor, candidate: Tensor, longest_gap: int) -> Tensor:
    """Lines whose number stands.

    offset: number - row, int64 (..., line); candidate: lines that take part, bool (..., line).
    """
    trusted = candidate
    for reach in _REACHES:
        against = [_votes(offset, trusted, reach, longest_gap, sign) for sign in (-1, 1)]
        trusted = trusted & ~torch.stack([2 * no > asked for no, asked in against]).any(0)
    # what is left must not fall anywhere: numbers still in dispute are dropped, all of them
    trusted = trusted & ~_disputed(offset, trusted)
    return trusted & ~_lonely_ends(offset, trusted)


def _repeats(lines: Tensor, number: Tensor, present: Tensor) -> Tensor:
    """Lines that are the line before them once more, sample by sample, bool (..., line).

    Lines of zeros are none.
    """
    same = (lines[..., 1:, :] == lines[..., :-1, :]).all(-1) & (lines[..., 1:, :] != 0).any(-1)
    first = torch.zeros_like(same[..., :1])
    return torch.cat([first, same], -1) & present


def _dead(lines: Tensor, present: Tensor) -> Tensor:
    """Lines of zeros between lines that are none: a dead receiver.

    Silence before the first and behind the last echo is left alone.
    """
    lit = (lines != 0).any(-1)
    return present & ~lit & (lit.cumsum(-1) > 0) & (lit.flip(-1).cumsum(-1).flip(-1) > 0)


def line_integrity(
    lines: Tensor,
    line_number: Tensor,
    *,
    first_number: int | None = None,
    n_lines: int | None = None,
    longest_gap: int = 1000,
) -> LinePlan:
    """Verify line numbers and plan the regular grid.

    lines: (..., line, range); line_number: integer (..., line), -1 for padding at the end.

    Repeated lines (equal samples) are dropped, numbers that contradict their neighbours are
    corrected where the lines beside them leave one place only, and a line that could stand in
    several places of a gap is left out and counted, rather than put where it may do harm. Lines of
    zeros amid others hold nothing and count as missing; rows behind the last received line do not
    (trials of different lengths are padded there). first_number: number of row 0 of the grid; None:
    that of the first received line, per trial. n_lines: rows of the grid; None: as many as there
    are lines, more where the numbers need more. longest_gap: a larger step between neighbours is
    taken for a corrupted number. A trial with fewer than half of its numbers standing has ok =
    False and stays as it came. Raises ValueError where shapes disagree, a number is no integer, or
    no trial at all can be reconciled.
    """
    _check(lines, line_number, longest_gap)
    n = lines.shape[-2]
    number = line_number.to(torch.int64).expand(lines.shape[:-1])
    row = torch.arange(n, device=lines.device)
    present = (number != PADDING).flip(-1).cumsum(-1).flip(-1) > 0
    repeated = _repeats(lines, number, present)
    single = present & ~repeated
    offset = number - (row - repeated.cumsum(-1))
    trusted = trusted_numbers(offset, single, longest_gap)
    before, after = _nearest(offset, trusted)
    placeable = trusted | (single & (before == after))
    verified = torch.where(placeable, number - offset + torch.where(trusted, offset, before), PADDING)
    share = trusted.sum(-1) / single.sum(-1).clamp_min(1)
    ok = share >= 0.5
    _refuse_hopeless(ok, trusted, single)
    verified = torch.where(ok[..., None], verified, torch.where(present, row, PADDING))
    # only the first received line can be row 0, be its own number right or wrong
    origin = _first(verified) if first_number is None else torch.full_like(verified[..., 0], first_number)
    slot = verified - origin[..., None]
    rows = n_lines if n_lines is not None else _rows(slot, verified, n)
    inside = (verified != PADDING) & (slot >= 0) & (slot < rows)
    source = _sources(slot, inside, rows)
    dead = _dead(lines, present).gather(-1, source.clamp_min(0)) & (source >= 0)
    before_last = (source >= 0).flip(-1).cumsum(-1).flip(-1) > 0
    return LinePlan(
        source=source,
        number=torch.where(inside, verified, PADDING),
        missing=ok[..., None] & (((source < 0) & before_last) | dead),
        corrected=ok[..., None] & inside & ~trusted,
        repeated=ok[..., None] & repeated,
        unplaced=(single | (present & ~ok[..., None])) & ~inside,
        first_number=origin,
        trusted=share,
        ok=ok,
    )


def _check(lines: Tensor, line_number: Tensor, longest_gap: int) -> None:
    if line_number.shape[-1:] != lines.shape[-2:-1]:
        raise ValueError(
            f"line numbers of shape {tuple(line_number.shape)} do not fit {lines.shape[-2]} "
            f"lines; give one number per line, {PADDING} for padding at the end"
        )
    if line_number.is_floating_point() or line_number.is_complex() or line_number.dtype == torch.bool:
        raise ValueError(f"line numbers must be integers, got {line_number.dtype}; round them before the call")
    if longest_gap < 1:
        raise ValueError(f"the longest gap must be at least one line, got {longest_gap}")


def _refuse_hopeless(ok: Tensor, trusted: Tensor, single: Tensor) -> None:
    """Raise where not one trial can be reconciled; inside vmap a value cannot be looked at."""
    try:
        if bool(ok.any()) or ok.numel() == 0:
            return
        stand, of = int(trusted.sum()), int(single.sum())
    except RuntimeError:
        return
    raise ValueError(
        f"the line numbers cannot be reconciled: only {stand} of {of} agree with their "
        "neighbours; check that they rise with the lines, and longest_gap"
    )


def _first(verified: Tensor) -> Tensor:
    """Smallest number that is none of padding, (...,); 0 where there is none."""
    least = torch.where(verified != PADDING, verified, torch.iinfo(verified.dtype).max).amin(-1)
    return torch.where(least == torch.iinfo(verified.dtype).max, 0, least)


def _rows(slot: Tensor, verified: Tensor, n: int) -> int:
    """Rows that hold every placed line of every trial, at least n."""
    try:
        return max(n, 1 + int(torch.where(verified != PADDING, slot, 0).max()))
    except RuntimeError:  # inside vmap a value cannot be looked at
        return n


def _sources(slot: Tensor, inside: Tensor, rows: int) -> Tensor:
    """Received row for each row of the grid, -1 where none.

    Lines outside go into a row that is cut off again.
    """
    row = torch.arange(slot.shape[-1], device=slot.device).expand(slot.shape)
    plan = slot.new_full((*slot.shape[:-1], rows + 1), -1)
    return plan.scatter(-1, torch.where(inside, slot, rows), row)[..., :rows]


def place_lines(x: Tensor, source: Tensor, fill: float = 0.0) -> Tensor:
    """Received lines (..., received, range) on the grid of LinePlan.source (..., n); `fill` where
    there is none. Differentiable.
    """
    index = source.clamp_min(0)[..., None].expand(*source.shape, x.shape[-1])
    return torch.where(source[..., None] >= 0, x.expand(*source.shape[:-1], *x.shape[-2:]).gather(-2, index), fill)


def place_per_line(x: Tensor, source: Tensor, fill: float = 0.0) -> Tensor:
    """Side data with one entry a received line, (..., received), on the same grid."""
    return place_lines(x[..., None], source, fill)[..., 0]


class LineIntegrity(Stage):
    """Put every line on its place of a regular azimuth grid; see line_integrity.

    forward(signal, line_number).

    Returns the signal on the grid, missing lines zero, and an Estimate: `missing` (..., pulse)
    bool; quality: share of numbers that stood; info: `source`, `number`, masks `corrected`,
    `repeated`, `unplaced` of the received lines, and per-trial counts `received`, `placed`,
    `repeated_count`, `corrected_count`, `unplaced_count`, `missing_count`: received = placed +
    repeated + unplaced, always. Regular input passes bit for bit.
    """

    provides = ("missing",)

    def __init__(self, first_number: int | None = None, n_lines: int | None = None, longest_gap: int = 1000) -> None:
        super().__init__()
        self.first_number, self.n_lines, self.longest_gap = first_number, n_lines, longest_gap

    def forward(self, signal: Signal, line_number: Tensor) -> tuple[Signal, Estimate]:
        plan = line_integrity(
            signal.data, line_number, first_number=self.first_number, n_lines=self.n_lines, longest_gap=self.longest_gap
        )
        axis = signal.axis("pulse").part(0, plan.source.shape[-1])
        counts = {
            "received": (line_number.expand(signal.data.shape[:-1]) != PADDING).flip(-1).cumsum(-1).gt(0).sum(-1),
            "placed": (plan.number != PADDING).sum(-1),
            "repeated_count": plan.repeated.sum(-1),
            "corrected_count": plan.corrected.sum(-1),
            "unplaced_count": plan.unplaced.sum(-1),
            "missing_count": plan.missing.sum(-1),
        }
        masks = {
            name: getattr(plan, name)
            for name in ("source", "number", "corrected", "repeated", "unplaced", "first_number")
        }
        estimate = Estimate({"missing": plan.missing}, quality=plan.trusted, ok=plan.ok, info={**masks, **counts})
        return signal.with_axis(place_lines(signal.data, plan.source), pulse=axis), estimate
