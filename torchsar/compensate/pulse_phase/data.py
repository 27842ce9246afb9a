"""Pulses in the layout of the autofocus functions, and the phases between adjacent ones.

The phase between two pulses is that of the product of one with the conjugate of the other, summed
over range.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import block_bytes_of, checked_samples, cis, is_hidden, over_blocks, unit_level


@dataclass(frozen=True)
class Pulses:
    """Range-compressed pulses in the layout that the autofocus estimators use.

    Args:
        rows: Samples, shape (trial, range, pulse), complex. Each trial is divided by its own level,
            so that squares neither underflow nor overflow.
        present: False where a pulse holds only zeros, shape (trial, pulse), bool.
        trials: The leading dimensions of the data that were folded into the dimension trial.
    """

    rows: Tensor
    present: Tensor
    trials: torch.Size

    @property
    def n(self) -> int:
        """Number of pulses."""
        return self.rows.shape[-1]


def checked(data: Tensor, name: str, empty: bool = True) -> tuple[Tensor, Tensor]:
    """Check range-compressed data and fold their leading dimensions into one.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        name: Name of the calling function for the error message.
        empty: Whether a batch without trials is accepted.

    Returns:
        The data, shape (trial, pulse, range), and whether each pulse has a sample other than zero,
        shape (trial, pulse), bool: a missing pulse is all zeros.

    Raises:
        TypeError: If the data are not a tensor of complex64 or complex128.
        ValueError: If the data are empty, have fewer than two dimensions, or are not finite.
    """
    if not isinstance(data, Tensor) or not data.is_complex():
        raise TypeError(
            f"{name} works on complex range-compressed samples (..., pulse, range), got "
            f"{data.dtype if isinstance(data, Tensor) else type(data).__name__}"
        )
    data = checked_samples(data, name, "pulse, range", empty=empty)
    flat = data.reshape(-1, *data.shape[-2:])
    return flat, (flat.detach() != 0).any(-1)


def prepare(data: Tensor, name: str, empty: bool = True) -> Pulses:
    """Check range-compressed data and bring them to the layout of the autofocus estimators.

    Warns if the data hold fewer than three pulses or only one range cell, from which no phase error
    can be estimated.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        name: Name of the calling function for error messages and warnings.
        empty: Whether a batch without trials is accepted.

    Returns:
        The pulses, scaled to a peak of one to two and transposed to shape (trial, range, pulse).

    Raises:
        TypeError: If the data are not a tensor of complex64 or complex128.
        ValueError: If the data are empty, have fewer than two dimensions, or are not finite.
    """
    flat, present = checked(data, name, empty)
    n_pulse, n_range = data.shape[-2:]
    if n_pulse < 3:
        warnings.warn(
            f"{name}: a phase error of {n_pulse} pulse(s) cannot be distinguished from a shift of the "
            "image; the estimate is zero and not ok; use three pulses or more",
            stacklevel=3,
        )
    elif n_range == 1:
        warnings.warn(
            f"{name}: with one range cell, phase errors cannot be distinguished from the scene; the "
            "estimate flattens the phase and is not ok; use several range cells",
            stacklevel=3,
        )
    return Pulses(unit_level(flat).mT.contiguous(), present, data.shape[:-2])


def starting_phase(start: Tensor | None, pulses: Pulses, name: str) -> Tensor | None:
    """Convert phases to start from to the precision of the data, one row per trial.

    If phases are too large for that precision, whole turns are subtracted first.

    Args:
        start: Phases in rad, shape (..., pulse) or (pulse,), or None.
        pulses: The pulses to which the phases belong.
        name: Name of the calling function for error messages.

    Returns:
        The phases in rad, shape (trial, pulse), or None.

    Raises:
        TypeError: If the start is not a tensor.
        ValueError: If the start is not real and finite, or does not have one phase per pulse.
    """
    if start is None:
        return None
    if not isinstance(start, Tensor):
        raise TypeError(
            f"{name}: start must be a tensor of phases (rad), got {type(start).__name__}; torch.as_tensor makes one"
        )
    want = (*pulses.trials, pulses.n)
    if start.is_complex() or not start.is_floating_point() or not torch.isfinite(start).all():
        raise ValueError(
            f"{name}: start must hold finite real phases (rad), got "
            f"{start.dtype}{'' if start.is_complex() or not start.is_floating_point() else ' with NaN or Inf'}"
        )
    try:
        wide = start.expand(want)
    except RuntimeError:
        raise ValueError(
            f"{name}: start must hold one phase per pulse, shape {want} or (pulse,), got {tuple(start.shape)}"
        ) from None
    phase, working = wide.reshape(-1, pulses.n), pulses.rows.real.dtype
    # rounding errors of 1e-3 rad are far below the accuracy of any estimate
    large = phase.detach().abs().amax(-1, keepdim=True) > 1e-3 / torch.finfo(working).eps
    return torch.where(large, on_the_circle(phase.to(torch.float64)), phase).to(
        dtype=working, device=pulses.rows.device
    )


def by_blocks(
    pulses: Pulses,
    work: Callable[[slice], tuple[Tensor, ...]],
    whole: bool = False,
    gradients: bool = False,
    size: int | None = None,
) -> tuple[Tensor, ...]:
    """Process blocks of trials, and join their results.

    Args:
        pulses: The pulses.
        work: Function of a slice of the trials that returns tensors (trial, ...).
        whole: Whether to process all trials at once.
        gradients: Whether gradients are required; blocks are then processed one after another.
        size: Trials in a block, by default as many as fit into the cache.

    Returns:
        The tensors of all trials.
    """
    rows, done = pulses.rows, {}
    if rows.numel() and is_hidden(rows):
        raise RuntimeError(
            "torch.func.vmap cannot map estimators of phases, whose iterations end by trial; give all trials as "
            "leading dimensions, (..., pulse, range), in one call"
        )
    if size is None:
        size = max(1, block_bytes_of(rows.device) // max(1, rows[:1].numel() * rows.element_size()))
    size = max(1, len(rows)) if whole else size
    parts = [slice(first, first + size) for first in range(0, max(1, len(rows)), size)]

    def into(part: slice) -> None:
        done[part.start] = work(part)

    if len(parts) == 1 and not gradients:
        with torch.no_grad():
            return work(slice(None))
    if gradients:
        for part in parts:
            into(part)
    else:
        with torch.no_grad():
            over_blocks(into, parts, rows)
    return tuple(torch.cat(pieces) for pieces in zip(*(done[part.start] for part in parts), strict=True))


def find_phases(
    pulses: Pulses,
    find: Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]],
    start: Tensor | None = None,
    tuned: Sequence[Tensor | float] = (),
    whole: bool = False,
) -> tuple[Tensor, Tensor]:
    """Run an autofocus method on all trials, in blocks of trials that fit into the cache.

    Args:
        pulses: The pulses.
        find: The method: a function of (rows, present, start) that returns the phase (trial, pulse)
            and the number of iterations (trial,).
        start: Phase to start from in rad, one row per trial, or None.
        tuned: Settings of the method; where one of them, the start or the rows require a gradient,
            all trials are processed at once.
        whole: Whether to process all trials at once.

    Returns:
        The phases in rad, shape (trial, pulse), and the numbers of iterations, shape (trial,); zero
        with fewer than three pulses.
    """
    rows = pulses.rows
    if not len(rows) or pulses.n < 3:
        return rows.real.sum(-2) * 0, torch.zeros(len(rows), dtype=torch.int64, device=rows.device)

    def work(part: slice) -> tuple[Tensor, Tensor]:
        return find(rows[part], pulses.present[part], None if start is None else start[part])

    of_gradients = any(isinstance(x, Tensor) and x.requires_grad for x in (rows, start, *tuned))
    gradients = of_gradients and torch.is_grad_enabled()
    phase, taken = by_blocks(pulses, work, whole or gradients, gradients)
    return phase, taken


def refuse_odd_counts(name: str, least: int, **counts: int) -> None:
    """Check that numbers of iterations are integers of at least `least`.

    Args:
        name: Name of the calling function for the error message.
        least: Smallest allowed number.
        counts: The numbers, by the name of their parameter.

    Raises:
        ValueError: If a number is not an integer or is too small.
    """
    for what, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < least:
            raise ValueError(f"{name}: {what} must be a whole number of {least} or more, got {count!r}")


def rotate(rows: Tensor, phase_rad: Tensor) -> Tensor:
    """Remove a phase from every pulse: the samples are multiplied by exp(-j phase).

    Args:
        rows: Samples, shape (trial, range, pulse), complex.
        phase_rad: Phases in rad, shape (trial, pulse).

    Returns:
        The corrected samples, shape (trial, range, pulse), complex.
    """
    return rows * cis(-phase_rad)[..., None, :]


def safe_angle(z: Tensor) -> Tensor:
    """Compute the phase angle of complex values; where z is zero, angle and gradient are zero.

    Args:
        z: Complex values, any shape.

    Returns:
        The angle in rad, same shape.
    """
    nothing = z == 0
    return torch.where(nothing, 0, torch.angle(torch.where(nothing, 1, z)))


def without_line(phase_rad: Tensor, present: Tensor) -> Tensor:
    """Subtract from the phases of pulses the straight line that fits them best (least squares).

    Only pulses with samples enter the fit; the line is subtracted from all.

    Args:
        phase_rad: Phases in rad, shape (..., pulse).
        present: False for pulses without samples, shape (..., pulse), bool.

    Returns:
        The phases in rad, shape (..., pulse).
    """
    weight = present.to(phase_rad.dtype)
    k = torch.arange(phase_rad.shape[-1], dtype=phase_rad.dtype, device=phase_rad.device)
    total = weight.sum(-1, keepdim=True).clamp_min(1)
    centred = (k - (weight * k).sum(-1, keepdim=True) / total) * weight
    spread = (centred * centred).sum(-1, keepdim=True).clamp_min(torch.finfo(phase_rad.dtype).tiny)
    mean = (weight * phase_rad).sum(-1, keepdim=True) / total
    slope = (centred * phase_rad).sum(-1, keepdim=True) / spread
    return phase_rad - mean - slope * (k - (weight * k).sum(-1, keepdim=True) / total)


def on_the_circle(phase_rad: Tensor) -> Tensor:
    """Reduce phases modulo 2 pi to -pi..pi.

    Args:
        phase_rad: Phases in rad, any shape.

    Returns:
        The phases in rad, same shape.
    """
    return phase_rad - 2 * math.pi * torch.round(phase_rad.detach() / (2 * math.pi))


def or_one(x: Tensor) -> Tensor:
    """Replace values that are not positive by 1, so that they can divide.

    Args:
        x: Real values, any shape.

    Returns:
        x where it is positive, else 1, same shape.
    """
    return torch.where(x > 0, x, 1)


def pair_phase(rows: Tensor, present: Tensor) -> Tensor:
    """Estimate the phase of each pulse by adding up the phases between successive pulses.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The phases in rad, shape (trial, pulse); that of the first pulse is 0.
    """
    return running_sum(pair_products(rows, present))


def pair_products(rows: Tensor, present: Tensor) -> Tensor:
    """Sum over range the product of each pulse and the conjugate of the pulse before it.

    Pulses without samples are skipped: the next pulse that holds samples is paired with the last
    one that does.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The products, shape (trial, pulse - 1), complex; zero for a pulse without samples.
    """
    if present.device.type == "cpu" and bool(present.all()):
        return (rows[..., 1:] * rows[..., :-1].conj()).sum(-2)
    # index of the last earlier pulse that has samples; 0 if there is none
    index = torch.arange(present.shape[-1], device=present.device)
    before = torch.where(present, index, 0).cummax(-1).values[:, :-1]
    return torch.where(
        present[:, 1:],
        (rows[..., 1:] * rows.gather(-1, before[:, None, :].expand(-1, rows.shape[-2], -1)).conj()).sum(-2),
        0,
    )


def running_sum(products: Tensor) -> Tensor:
    """Add up the phases of products of successive pulses, in float64.

    Args:
        products: Product of each pulse but the first with the conjugate of the pulse before it,
            shape (trial, pulse - 1), complex.

    Returns:
        The phase of every pulse in rad, shape (trial, pulse); that of the first pulse is 0.
    """
    steps = safe_angle(products)
    total = steps.to(torch.float64).cumsum(-1).to(steps.dtype)
    return torch.cat([torch.zeros_like(total[..., :1]), total], -1)
