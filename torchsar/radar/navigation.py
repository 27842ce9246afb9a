"""Positions at pulse times from the record of a navigation system."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Spline
from torchsar.radar.antenna_path import broadcast, refuse_unusable


def resample_path(
    time_s: Tensor,
    position_m: Tensor,
    pulse_time_s: Tensor,
    *,
    longest_gap_s: float | None = None,
    jump_m: float = 0.2,
) -> Tensor:
    """Interpolate recorded positions of an antenna at the times of the pulses by cubic splines.

    >>> import torch
    >>> from torchsar import radar
    >>> time_s = torch.arange(6).double()
    >>> position_m = torch.stack([50 * time_s, time_s.square(), 100 + 0 * time_s], dim=-1)
    >>> radar.resample_path(time_s, position_m, torch.tensor([2.5]).double()).round(decimals=3)
    tensor([[125.0000,   6.2500, 100.0000]], dtype=torch.float64)

    Times may be uneven. All clocks must agree; to correct a latency, subtract it from `time_s`. The
    spline passes through the records, so that their noise enters the positions. Differentiable in
    all tensors.

    A jump shows in the fourth divided differences of the record, in which smooth motion cancels. It
    is refused if it exceeds ten times their median in the record (more where intervals are long),
    what an acceleration of 10 m/s^2 that sets in between two records makes, and what a jump of
    `jump_m` makes. At the ends of a record a jump must be up to three times larger to be found.

    Args:
        time_s: Times of the records in seconds, rising, float64 (..., record), at least five.
        position_m: Recorded positions in metres, float64 (..., record, 3).
        pulse_time_s: Times of the pulses in seconds, within the record, float64 (..., pulse).
        longest_gap_s: Longest interval between records in seconds from which pulses are
            interpolated; None for ten times the median interval, or five times the interval that
            95 % do not exceed if that is longer.
        jump_m: Smallest jump in metres that is refused in a smooth record, at least four times the
            step to which its positions are rounded; infinity if jumps are accepted.

    Returns:
        Positions in metres, float64 (..., pulse, 3); leading dims are those of all three tensors,
        broadcast.

    Raises:
        TypeError: If a tensor is not float64.
        ValueError: If shapes do not match, there are fewer than five records, a value is not
            finite, times are out of order or doubled, pulses lie beyond the record, or the record
            has a gap or a jump among the pulses.
    """
    refuse_unusable(time_s=time_s, position_m=position_m, pulse_time_s=pulse_time_s)
    shapes = time_s.shape, position_m.shape, pulse_time_s.shape
    fits = time_s.ndim and pulse_time_s.numel() and position_m.shape[-2:] == (*time_s.shape[-1:], 3)
    if not fits or time_s.shape[-1] < 5 or broadcast([shapes[0][:-1], shapes[1][:-2], shapes[2][:-1]]) is None:
        raise ValueError(
            "resample_path needs time_s (..., record) of at least five records, position_m (..., record, 3) and "
            "pulse_time_s (..., pulse) of at least one pulse, with leading dims that broadcast, got "
            f"{', '.join(str(tuple(shape)) for shape in shapes)}"
        )
    if not jump_m > 0 or not (longest_gap_s is None or longest_gap_s > 0):
        raise ValueError(f"longest_gap_s and jump_m must be positive, got {longest_gap_s} and {jump_m}")
    time, first, last = (x.detach() for x in (time_s, pulse_time_s.amin(-1), pulse_time_s.amax(-1)))
    _refuse_times(time, first, last)
    _refuse_gaps(time, first, last, longest_gap_s)
    _refuse_jumps(time, position_m.detach(), first, last, jump_m)
    return Spline(position_m.mT, time_s[..., None, :]).at(pulse_time_s[..., None, :]).mT


def _refuse_times(time: Tensor, first: Tensor, last: Tensor) -> None:
    """Raise ValueError unless times rise and the pulses are within the record.

    A pulse may be outside the record by a millionth of the median interval, because of rounding
    errors.
    """
    bad = time.diff() <= 0
    if bool(bad.any()):
        at, where = _first(bad)
        before, after = float(time[(*at[:-1], at[-1])]), float(time[(*at[:-1], at[-1] + 1)])
        fault, remedy = (
            (f"{after:.9g} s stands twice,", "remove doubled records")
            if before == after
            else (f"{after:.9g} s follows {before:.9g} s", "sort the records")
        )
        raise ValueError(f"times of a navigation record must rise, but {fault} at record {at[-1] + 1}{where}; {remedy}")
    slack = 1e-6 * time.diff().median(-1).values
    for beyond, end, edge in (
        (time[..., 0] - first, "before the first", 0),
        (last - time[..., -1], "after the last", -1),
    ):
        bad = beyond > slack
        if bool(bad.any()):
            at, where = _first(bad[..., None])
            raise ValueError(
                f"pulses must lie within the navigation record, but one is {float(beyond[at[:-1]]):.3g} s {end} record "
                f"at {float(time[..., edge].expand(bad.shape)[at[:-1]]):.9g} s{where}; use a longer record or fewer "
                "pulses"
            )


def _refuse_gaps(time: Tensor, first: Tensor, last: Tensor, longest_gap_s: float | None) -> None:
    """Raise ValueError if an interval of the record is too long during the pulses.

    By choice, an interval is too long if it exceeds both ten median intervals and five times the
    95 % quantile. The longest of 1000 random intervals is about ten times the median.
    """
    step = time.diff()
    if longest_gap_s is None:
        usual = step.kthvalue(math.ceil(0.95 * step.shape[-1]), -1, keepdim=True).values
        longest = torch.maximum(10 * step.median(-1, keepdim=True).values, 5 * usual)
    else:
        longest = torch.as_tensor(longest_gap_s, dtype=torch.float64)
    bad = (step > longest) & (time[..., 1:] > first[..., None]) & (time[..., :-1] < last[..., None])
    if bool(bad.any()):
        at, where = _first(bad)
        gap, limit, start = (float(x.expand(bad.shape)[at]) for x in (step, longest, time[..., :-1]))
        raise ValueError(
            f"the navigation record has a gap of {gap:.3g} s after {start:.9g} s{where}, longer than {limit:.3g} s; "
            "image the pulses before or after it, or give longest_gap_s"
        )


def _refuse_jumps(time: Tensor, position: Tensor, first: Tensor, last: Tensor, jump_m: float) -> None:
    """Raise ValueError if recorded positions jump during the pulses."""
    t = time.unfold(-1, 5, 1)  # windows of five times, (..., window, 5)
    mean_step = (t[..., -1] - t[..., 0]) / 4
    away = (t[..., :, None] - t[..., None, :]) / mean_step[..., None, None]
    weight = 1 / (away + torch.eye(5, dtype=torch.float64, device=time.device)).prod(-1)
    weight = weight / torch.linalg.vector_norm(weight, dim=-1, keepdim=True)
    # the weights have a sum of zero; the common offset is subtracted to avoid rounding errors
    offset = position.unfold(-2, 5, 1) - position[..., 2:-2, :, None]  # (..., window, 3, 5)
    residual = torch.linalg.vector_norm((offset * weight[..., None, :]).sum(-1), dim=-1)
    # Effects on a normalised fourth difference at equal steps h: a jump of 1 in the middle gives
    # 3 / sqrt(70). An acceleration that begins between two records gives its value times h^2 / 12;
    # by choice, about that of gravity is accepted.
    of_jump = 0.36
    limit = torch.maximum(10.0 / 12 * mean_step.square(), mean_step.new_tensor(of_jump * jump_m))
    # The residual of smooth motion grows with the fourth power of the interval. By choice, a jump
    # is ten times the median of the residuals; normal noise has up to 4.
    longer = (mean_step / mean_step.median(-1, keepdim=True).values).clamp_min(1) ** 4
    limit = torch.maximum(limit, 10 * longer * residual.median(-1, keepdim=True).values)
    bad = (residual > limit) & (t[..., -1] > first[..., None]) & (t[..., 0] < last[..., None])
    if bool(bad.any()):
        # time in the middle of the window with the largest residual
        at, where = _first(bad & (residual == torch.where(bad, residual, 0).amax(-1, keepdim=True)))
        size, most, when = (float(x.expand(bad.shape)[at]) for x in (residual, limit, t[..., 2]))
        raise ValueError(
            f"the navigation record has a jump of about {size / of_jump:.3g} m near {when:.9g} s{where}, where up to "
            f"{most / of_jump:.3g} m are accepted; correct the record, or give jump_m"
        )


def _first(bad: Tensor) -> tuple[tuple[int, ...], str]:
    """Index of the first entry that is True, and a text that names its trial."""
    at = tuple(int(i) for i in bad.nonzero()[0])
    trial = at[0] if len(at) == 2 else at[:-1]
    return at, f" in trial {trial}" if len(at) > 1 else ""
