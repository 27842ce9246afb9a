"""What every estimator of a phase per pulse begins with: data that are checked, scaled, and laid
out for transforms along pulses.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import cis, real_dtype, refuse_non_finite

_PHASE_ERROR_RAD = 1e-3  # a start may lose this much by rounding


@dataclass(frozen=True)
class Pulses:
    """Range-compressed pulses, ready to work on.

    rows: (trial, range, pulse) complex, each trial over its own peak, so that squares neither
    under- nor overflow. present: (trial, pulse) bool, False where a pulse holds only zeros. trials:
    the leading dims that were folded into one.
    """

    rows: Tensor
    present: Tensor
    trials: torch.Size

    @property
    def n(self) -> int:
        return self.rows.shape[-1]


def checked(data: Tensor, name: str) -> tuple[Tensor, Tensor]:
    """Range-compressed data (..., pulse, range) as (trial, pulse, range), and which pulses hold
    samples, (trial, pulse).

    Raises TypeError or ValueError naming the function for what are no finite complex samples.
    """
    if not isinstance(data, Tensor) or not data.is_complex():
        raise TypeError(
            f"{name} works on complex range-compressed samples (..., pulse, range), got "
            f"{data.dtype if isinstance(data, Tensor) else type(data).__name__}"
        )
    real_dtype(data.dtype)
    if data.ndim < 2 or not data.shape[-2] * data.shape[-1]:
        raise ValueError(
            f"{name} works on samples (..., pulse, range) with at least one pulse and one range "
            f"cell, got the shape {tuple(data.shape)}"
        )
    refuse_non_finite(data, name)
    flat = data.reshape(-1, *data.shape[-2:])
    return flat, (flat.detach() != 0).any(-1)


def prepare(data: Tensor, name: str) -> Pulses:
    """Check and lay out data (..., pulse, range).

    Raises TypeError or ValueError naming the estimator; warns where nothing can be learnt.
    """
    flat, present = checked(data, name)
    n_pulse, n_range = data.shape[-2:]
    if n_pulse < 3:
        warnings.warn(
            f"{name}: {n_pulse} pulse(s) carry no phase error that can be told from a shift; the "
            "estimate is zero and not ok",
            stacklevel=3,
        )
    elif n_range == 1:
        warnings.warn(
            f"{name}: one range cell cannot tell phase errors from the scene; the estimate flattens it and is not ok",
            stacklevel=3,
        )
    largest = torch.maximum(flat.detach().real.abs(), flat.detach().imag.abs()).amax(
        (-2, -1), keepdim=True
    )  # |z| itself may overflow
    scale = torch.where(largest > 0, largest, 1)
    return Pulses((flat / scale).mT.contiguous(), present, data.shape[:-2])


def starting_phase(start: Tensor | None, pulses: Pulses, name: str) -> Tensor | None:
    """A start of the caller, (..., pulse) or (pulse,), as (trial, pulse) in the working precision;
    trials with phases too large for it lose their whole turns first.
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
        raise ValueError(f"{name}: start has the shape {tuple(start.shape)}; one phase per pulse is {want}") from None
    phase, working = wide.reshape(-1, pulses.n), pulses.rows.real.dtype
    large = phase.detach().abs().amax(-1, keepdim=True) > _PHASE_ERROR_RAD / torch.finfo(working).eps
    return torch.where(large, on_the_circle(phase.to(torch.float64)), phase).to(
        dtype=working, device=pulses.rows.device
    )


def refuse_odd_counts(name: str, least: int, **counts: int) -> None:
    """Numbers of iterations are whole and at least `least`.

    Raises ValueError naming the one that is not.
    """
    for what, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < least:
            raise ValueError(f"{name}: {what} must be a whole number of {least} or more, got {count!r}")


def rotate(rows: Tensor, phase_rad: Tensor) -> Tensor:
    """rows * exp(-j phase). rows: (trial, range, pulse); phase_rad: (trial, pulse)."""
    return rows * cis(-phase_rad)[..., None, :]


def safe_angle(z: Tensor) -> Tensor:
    """arg z, zero (with zero gradient) where z is zero."""
    nothing = z == 0
    return torch.where(nothing, 0, torch.angle(torch.where(nothing, 1, z)))


def without_line(phase_rad: Tensor, present: Tensor) -> Tensor:
    """The phase without its constant and its slope over the pulses that are there (least squares).

    (..., pulse).
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
    """Phases modulo a turn, in -pi..pi."""
    return phase_rad - 2 * math.pi * torch.round(phase_rad.detach() / (2 * math.pi))
