"""Phases: reduction to one turn in float64, and fast unit phasors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# the distance of float64 numbers of this size is 6e-5 turn
MAX_TURNS = 4e11
# real dtype of each complex dtype
_REAL = {torch.complex64: torch.float32, torch.complex128: torch.float64}


def real_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the real dtype that belongs to a complex one.

    Args:
        dtype: complex64 or complex128.

    Returns:
        float32 or float64.

    Raises:
        TypeError: For any other dtype.
    """
    if dtype not in _REAL:
        raise TypeError(f"expected complex64 or complex128, got {dtype}; convert the samples first")
    return _REAL[dtype]


def cis(angle_rad: Tensor) -> Tensor:
    """Compute exp(1j * angle) in the precision of the angle.

    Takes a third of the time of torch.polar. Use `unit_phasor` for phases of more than a few turns.
    Differentiable.

    Args:
        angle_rad: Angle in radians, any shape, float32 or float64.

    Returns:
        Unit phasors of the same shape, complex64 or complex128.
    """
    if angle_rad.requires_grad:
        return torch.complex(torch.cos(angle_rad), torch.sin(angle_rad))
    try:
        parts = angle_rad.new_empty((*angle_rad.shape, 2))
        torch.cos(angle_rad, out=parts[..., 0])
        torch.sin(angle_rad, out=parts[..., 1])
    except RuntimeError:  # inside torch.func transforms `out=` is not available
        return torch.complex(torch.cos(angle_rad), torch.sin(angle_rad))
    return torch.view_as_complex(parts)


def reduced_turns(turns: Tensor) -> Tensor:
    """Remove whole turns from a phase.

    Differentiable: the removed part counts as a constant.

    Args:
        turns: Phase in turns, any shape, float64.

    Returns:
        Phase in -0.5..0.5 turns, same shape, float64.

    Raises:
        TypeError: If the phase is not float64.
        ValueError: If the phase exceeds 4e11 turns, where float64 resolves only 1e-4 turn.
    """
    if turns.dtype != torch.float64:
        raise TypeError(
            f"phase needs float64 turns, got {turns.dtype}: a range of 700 km is 1e7 turns at S "
            "band and 1e12 in the near infrared; form the phase in float64"
        )
    _check_resolution(turns)
    return turns - torch.round(turns.detach())


def unit_phasor(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """Compute exp(2j * pi * turns); whole turns are removed while the phase is still float64.

    The phase convention is exp(-2j pi f tau): the echo of delay tau at carrier frequency f is
    `unit_phasor(-f * tau, dtype)`. Differentiable.

    Args:
        turns: Phase in turns, any shape, float64.
        dtype: complex64 or complex128.

    Returns:
        Unit phasors of the same shape.

    Raises:
        TypeError: If the phase is not float64 or `dtype` is not complex.
        ValueError: If the phase exceeds 4e11 turns.
    """
    return cis((2 * math.pi * reduced_turns(turns)).to(real_dtype(dtype)))


def _check_resolution(turns: Tensor) -> None:
    """Raise ValueError for phases beyond the precision of float64."""
    if turns.numel() == 0:
        return
    try:
        worst = float(turns.detach().abs().max())
    except RuntimeError:  # inside vmap values cannot be read
        return
    if not worst <= MAX_TURNS:
        raise ValueError(
            f"phase of {worst:.3g} turns exceeds {MAX_TURNS:.0e}, where float64 holds only 1e-4 "
            "turn; form range - reference range as a difference first"
        )


def linear_phasor(turns_per_step: Tensor, start: float, n: int, dtype: torch.dtype) -> Tensor:
    """Compute exp(2j pi s (start + i)) for i = 0..n - 1, with s in turns.

    Multiplies two short tables: as exact as `unit_phasor` of every element, at a tenth of its cost.
    Differentiable.

    Args:
        turns_per_step: Phase step s in turns, shape (...,), float64.
        start: Offset of the first element in steps.
        n: Number of elements.
        dtype: complex64 or complex128.

    Returns:
        Unit phasors, shape (..., n).
    """
    fine, coarse = phasor_tables(turns_per_step, start, n, dtype)
    return outer_phasor(fine, coarse, n)


def outer_phasor(fine: Tensor, coarse: Tensor, n: int) -> Tensor:
    """Multiply the tables of `phasor_tables`.

    Args:
        fine: Shape (..., m), complex.
        coarse: Shape (..., ceil(n / m)), complex.
        n: Number of elements.

    Returns:
        The first n products, shape (..., n); element i is fine[i % m] * coarse[i // m].
    """
    return (coarse[..., :, None] * fine[..., None, :]).flatten(-2)[..., :n]


def phasor_tables(turns_per_step: Tensor, start: float, n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the two factors of `linear_phasor`, for use where the full product is not needed.

    Args:
        turns_per_step: As in `linear_phasor`.
        start: As in `linear_phasor`.
        n: As in `linear_phasor`.
        dtype: As in `linear_phasor`.

    Returns:
        `fine` of shape (..., m) and `coarse` of shape (..., ceil(n / m)), complex; element i of the
        phasor is fine[i % m] * coarse[i // m], with m a power of two near sqrt(n).
    """
    m = max(1, 2 ** round(math.log2(max(n, 1)) / 2))
    steps = torch.arange(m, dtype=torch.float64, device=turns_per_step.device)
    starts = start + m * torch.arange(-(-n // m), dtype=torch.float64, device=turns_per_step.device)
    return unit_phasor(turns_per_step[..., None] * steps, dtype), unit_phasor(turns_per_step[..., None] * starts, dtype)
