"""Line integrity: verification of line numbers, and a regular azimuth grid from them.

Every line number is compared with those of the neighbouring lines. Since lines are lost but never
added, the number of a correct line exceeds that of the k-th line before it by k or more. The
difference between the number of a line and its row in the recording therefore never falls. A number
that contradicts most of its neighbours on one of its two sides is taken for corrupted.

Reference:
    Tsvetkov 2017 (verification of line numbers).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, Signal, Stage, checked_samples, host_largest, host_value

# line number of padding at the end of a trial, by convention: no line has a negative number
PADDING = -1
# Numbers of neighbours on each side that are compared with a line, by choice: first many, against
# clusters of corrupted numbers, then few, against small errors.
_REACHES = (16, 4, 2)


def _shifted(x: Tensor, by: int, fill: int | bool) -> Tensor:
    """Elements x[..., i + by], and `fill` outside of x; |by| <= n."""
    edge = torch.full_like(x[..., : abs(by)], fill)
    return torch.cat([x[..., by:], edge], -1) if by > 0 else torch.cat([edge, x[..., :by]], -1)


def _contradictions(offset: Tensor, trusted: Tensor, reach: int, longest_gap: int, sign: int) -> tuple[Tensor, Tensor]:
    """Number of accepted neighbours on one side whose offset contradicts that of each line, and
    number of all accepted neighbours there.

    An offset contradicts if it falls, or rises by more than longest_gap.
    """
    contradicting, count = torch.zeros_like(offset), torch.zeros_like(offset)
    for distance in range(1, min(reach, offset.shape[-1] - 1) + 1):
        accepted = _shifted(trusted, sign * distance, False)
        rise = sign * (_shifted(offset, sign * distance, 0) - offset)
        contradicting = contradicting + (accepted & ((rise < 0) | (rise > longest_gap)))
        count = count + accepted
    return contradicting, count


def _unconfirmed_ends(offset: Tensor, trusted: Tensor) -> Tensor:
    """First and last accepted line, if the jump to the next one exceeds all jumps between inner
    lines.

    These lines have no neighbour on the outer side to confirm them.
    """
    before, after = _nearest(offset, trusted)
    first = trusted & (trusted.cumsum(-1) == 1)
    last = trusted & (trusted.flip(-1).cumsum(-1).flip(-1) == 1)
    inner = trusted & ~first & ~last
    known = torch.where(inner & (inner.cumsum(-1) > 1), offset - before, 1).amax(-1, keepdim=True).clamp_min(1)
    return (first & (after - offset > known)) | (last & (offset - before > known))


def _nearest(offset: Tensor, trusted: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets of the nearest accepted lines before and after each line; at the ends both are of one
    line.
    """
    n = offset.shape[-1]
    row = torch.arange(n, device=offset.device).expand(offset.shape)
    before = _shifted(torch.where(trusted, row, -1).cummax(-1).values, -1, -1)
    after = _shifted(torch.where(trusted, row, n).flip(-1).cummin(-1).values.flip(-1), 1, n)
    left, right = offset.gather(-1, before.clamp_min(0)), offset.gather(-1, after.clamp_max(n - 1))
    return torch.where(before < 0, right, left), torch.where(after >= n, left, right)


def _enclosed(trusted: Tensor) -> Tensor:
    """True for accepted (or lit) lines, and for lines with such lines on both sides."""
    return (trusted.cumsum(-1) > 0) & (trusted.flip(-1).cumsum(-1).flip(-1) > 0)


def _extremes(offset: Tensor, trusted: Tensor) -> tuple[Tensor, Tensor]:
    """Highest offset of the accepted lines up to each line, and lowest one from each line on."""
    limit = torch.iinfo(offset.dtype)
    highest = torch.where(trusted, offset, limit.min).cummax(-1).values
    return highest, torch.where(trusted, offset, limit.max).flip(-1).cummin(-1).values.flip(-1)


def trusted_numbers(offset: Tensor, candidate: Tensor, longest_gap: int) -> Tensor:
    """Return the lines whose number agrees with those of the neighbouring lines.

    Args:
        offset: Line number minus the row in the recording, counted without repeated lines, shape
            (..., line), int64.
        candidate: Lines that are tested, which are all except padding and repeated lines, shape
            (..., line), bool.
        longest_gap: Largest number of successive lost lines that is accepted; a larger step of the
            numbers is taken for an error.

    Returns:
        True for accepted lines, shape (..., line), bool.
    """
    trusted = candidate
    for reach in _REACHES:
        contradicting = [_contradictions(offset, trusted, reach, longest_gap, sign) for sign in (-1, 1)]
        trusted = trusted & ~torch.stack([2 * no > count for no, count in contradicting]).any(0)
    # the remaining offsets must not fall anywhere, so that all inconsistent numbers are dropped
    highest, lowest = _extremes(offset, trusted)
    trusted = trusted & (highest <= offset) & (lowest >= offset)
    return trusted & ~_unconfirmed_ends(offset, trusted)


def _repeats(lines: Tensor, number: Tensor, present: Tensor) -> Tensor:
    """True for lines with the same samples as the line before, (..., line); lines of zeros do not
    count.
    """
    same = (lines[..., 1:, :] == lines[..., :-1, :]).all(-1) & (lines[..., 1:, :] != 0).any(-1)
    return torch.nn.functional.pad(same, (1, 0)) & present


def _empty_lines(lines: Tensor, present: Tensor) -> Tensor:
    """True for lines of zeros, except those before the first and after the last echo."""
    lit = (lines != 0).any(-1)
    return present & ~lit & _enclosed(lit)


def line_integrity(
    lines: Tensor,
    line_number: Tensor,
    *,
    first_number: int | None = None,
    n_lines: int | None = None,
    longest_gap: int = 1000,
    assess: bool = True,
) -> Estimate:
    """Verify line numbers and plan the regular azimuth grid.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.arange(1, 9).to(torch.complex64)[:, None]
    >>> number = torch.tensor([10, 11, 12, 14, 15, 16, 17, 18])  # line 13 is lost
    >>> repair.line_integrity(lines, number)["missing"].nonzero().tolist()
    [[3]]

    Repeated lines (samples equal to those of the line before) are dropped. A number that
    contradicts its neighbours is corrected if the lines beside it leave only one position for it; a
    line that fits several positions of a gap is left out and marked as unplaced, and so is a line
    with a wrong number before the first or after the last accepted one, if lines were lost in this
    recording: some may be lost there as well. Lines of zeros
    between other lines count as missing. Rows after the last received line do not, since trials of
    different lengths are padded there. A trial with fewer than half of its numbers accepted keeps
    its lines in the order received.

    Args:
        lines: Received lines, shape (..., line, range), complex.
        line_number: Line numbers, shape (..., line), integer, -1 for padding at the end.
        first_number: Line number that belongs to row 0 of the grid; None: that of the first
            received line of each trial.
        n_lines: Number of rows of the grid; None: as many as there are received lines, or more if
            the line numbers span more.
        longest_gap: Largest number of successive lost lines that is accepted; a larger step of the
            numbers is taken for an error.
        assess: Whether to add the outcome.

    Returns:
        Estimate with `missing` of shape (..., n), bool: rows of the grid without a line. `quality`
        is the share of numbers that were accepted as received; the outcome is SINGULAR where it is
        below one half. `info` holds

        - `source`, the row of the recording for each of the n rows of the grid, -1 where there is
          none, shape (..., n);
        - `number`, the verified number of each received line, shape (..., received); -1 for padding
          at the end of a trial, repeated lines and lines without a unique position;
        - `corrected`, `repeated` and `unplaced`, shape (..., received), bool: lines with a
          corrected number, lines that repeat the line before, lines without a unique position;
        - `first_number`, the line number that belongs to row 0 of the grid, shape (...,);
        - the counts `received`, `placed`, `repeated_count`, `corrected_count`, `unplaced_count` and
          `missing_count` per trial, with received = placed + repeated + unplaced.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the numbers do not fit
            the lines or are not integers, the longest gap is less than one, fewer than half of the
            numbers are accepted in every trial, or the grid holds none of the lines.
    """
    lines = checked_samples(lines, "line_integrity", "line, range")
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
    fits = trusted | (single & (before == after))
    verified = torch.where(fits, number - offset + torch.where(trusted, offset, before), PADDING)
    share = trusted.sum(-1) / single.sum(-1).clamp_min(1)
    ok = share >= 0.5
    _check_consistency(ok, trusted, single)
    verified = torch.where(ok[..., None], verified, torch.where(present, row, PADDING))
    # row 0 is the first received line, whether its own number is correct or not
    origin = _first(verified) if first_number is None else ok * first_number
    highest, lowest = _extremes(offset, trusted)
    lossy = highest[..., -1:] > lowest[..., :1]  # True where lines are lost between accepted lines
    outside = ok[..., None] & ~_enclosed(trusted) & lossy
    verified = torch.where(outside, PADDING, verified)
    slot = verified - origin[..., None]
    rows = max(n, 1 + host_largest(torch.where(verified != PADDING, slot, 0), 0)) if n_lines is None else n_lines
    inside = (verified != PADDING) & (slot >= 0) & (slot < rows)
    _check_grid(inside, verified, rows)
    source = _sources(slot, inside, rows)
    empty = _empty_lines(lines, present).gather(-1, source.clamp_min(0)) & (source >= 0)
    before_last = (source >= 0).flip(-1).cumsum(-1).flip(-1) > 0
    found = ok[..., None]
    missing = found & (((source < 0) & before_last) | empty)
    info = {
        "source": source,
        "number": torch.where(inside, verified, PADDING),
        "corrected": found & inside & ~trusted,
        "repeated": found & repeated,
        "unplaced": (single | (present & ~found)) & ~inside,
        "first_number": origin,
    }
    counts = {f"{name}_count": info[name].sum(-1) for name in ("repeated", "corrected", "unplaced")}
    counts |= {"received": present.sum(-1), "placed": inside.sum(-1), "missing_count": missing.sum(-1)}
    outcome = Outcome.of(ok, Outcome.SINGULAR) if assess else Outcome.NOT_ASSESSED.like(ok)
    return Estimate({"missing": missing}, quality=share, outcome=outcome, info=info | counts)


def _check(lines: Tensor, line_number: Tensor, longest_gap: int) -> None:
    """Raise ValueError for invalid line numbers or gaps."""
    if line_number.shape[-1:] != lines.shape[-2:-1]:
        raise ValueError(
            f"line_number must have one number for each of the {lines.shape[-2]} lines, {PADDING} for padding "
            f"at the end, got the shape {tuple(line_number.shape)}"
        )
    if line_number.is_floating_point() or line_number.is_complex() or line_number.dtype == torch.bool:
        raise ValueError(f"line_number must hold integers, got {line_number.dtype}; round them before the call")
    if longest_gap < 1:
        raise ValueError(f"longest_gap must be one line or more, got {longest_gap}")


def _check_consistency(ok: Tensor, trusted: Tensor, single: Tensor) -> None:
    """Raise ValueError if no trial has a consistent set of numbers."""
    if ok.numel() == 0 or host_value(ok.any(), True):
        return
    accepted, total = int(trusted.sum()), int(single.sum())
    raise ValueError(
        f"line numbers cannot be reconciled: only {accepted} of {total} agree with those of neighbouring "
        "lines, and at least half must; check that the numbers rise from line to line, or raise longest_gap"
    )


def _check_grid(inside: Tensor, verified: Tensor, rows: int) -> None:
    """Raise ValueError if the grid holds none of the lines."""
    if host_value(inside.any(), True) or not bool((verified != PADDING).any()):
        return
    low, high = int(verified[verified != PADDING].min()), int(verified.max())
    raise ValueError(
        f"none of the line numbers, {low} to {high}, lies on the grid of {rows} rows from first_number on; choose "
        "first_number and n_lines so that the grid holds the recording"
    )


def _first(verified: Tensor) -> Tensor:
    """Smallest verified number, (...,); 0 where there is none."""
    least = torch.where(verified != PADDING, verified, torch.iinfo(verified.dtype).max).amin(-1)
    return torch.where(least == torch.iinfo(verified.dtype).max, 0, least)


def _sources(slot: Tensor, inside: Tensor, rows: int) -> Tensor:
    """Received row for each row of the grid, -1 where there is none."""
    row = torch.arange(slot.shape[-1], device=slot.device).expand(slot.shape)
    empty = slot.new_full((*slot.shape[:-1], rows + 1), -1)
    return empty.scatter(-1, torch.where(inside, slot, rows), row)[..., :rows]


def place_lines(x: Tensor, source: Tensor, fill: float = 0.0) -> Tensor:
    """Put received lines on their rows of a regular azimuth grid.

    Differentiable.

    Args:
        x: Received lines, shape (..., received, range).
        source: Row of the recording for each of the n rows of the grid, -1 where there is none,
            shape (..., n).
        fill: Value of the rows without a line.

    Returns:
        Lines on the grid, shape (..., n, range).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "place_lines", "line, range", real=True, finite=False)
    index = source.clamp_min(0)[..., None].expand(*source.shape, x.shape[-1])
    return torch.where(source[..., None] >= 0, x.expand(*source.shape[:-1], *x.shape[-2:]).gather(-2, index), fill)


class LineIntegrity(Stage):
    """Stage that verifies line numbers and puts lines on a regular grid; see `line_integrity`.

    Args:
        first_number: Line number that belongs to row 0 of the grid; None: that of the first
            received line of each trial.
        n_lines: Number of rows of the grid; None: as many as there are received lines, or more if
            the line numbers span more.
        longest_gap: Largest number of successive lost lines that is accepted; a larger step of the
            numbers is taken for an error.
        assess: Whether to add the outcome.
    """

    provides = ("missing",)
    neutral = {"missing": False}

    def __init__(
        self,
        first_number: int | None = None,
        n_lines: int | None = None,
        longest_gap: int = 1000,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__()
        numbers = {"first_number": first_number, "n_lines": n_lines, "longest_gap": longest_gap}
        self.options: dict[str, Any] = {**numbers, "assess": assess}

    def forward(self, signal: Signal, line_number: Tensor) -> tuple[Signal, Estimate]:
        """Put every line on the row of the azimuth grid that its verified number gives.

        Args:
            signal: Received lines, shape (..., pulse, range).
            line_number: Line numbers, shape (..., pulse), integer, -1 for padding at the end.

        Returns:
            The signal on the grid, with missing lines zero (regular input is unchanged bit for
            bit), and the Estimate of `line_integrity`.

        Raises:
            ValueError: If the numbers do not fit the lines or are not integers, or `longest_gap` is
                less than one. Also if fewer than half of the numbers are accepted in every trial,
                or the grid holds none of the lines.
        """
        plan = line_integrity(signal.data, line_number, **self.options)
        source = plan.info["source"]
        axis = signal.axis("pulse").part(0, source.shape[-1])
        return signal.with_axis(place_lines(signal.data, source), pulse=axis), plan
