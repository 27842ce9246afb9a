"""The only place where range becomes phase, and fast unit phasors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_TURNS = 4e11
_REAL = {torch.complex64: torch.float32, torch.complex128: torch.float64}


def real_dtype(dtype: torch.dtype) -> torch.dtype:
    """The real dtype of the parts of a complex one. Raises TypeError for any other dtype."""
    if dtype not in _REAL:
        raise TypeError(
            f"expected complex64 or complex128, got {dtype}; convert the samples first, nothing is cast silently"
        )
    return _REAL[dtype]


def cis(angle_rad: Tensor) -> Tensor:
    """exp(1j * angle), in the precision of the angle, which must already be small (a few turns).

    Writes cosine and sine straight into the real view of the result, a third of the time of
    torch.polar; differentiable.
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
    """Turns with the whole ones dropped, in -0.5..0.5, float64.

    Differentiable: the dropped part is a constant.

    Raises TypeError unless float64, ValueError beyond 4e11 turns, where float64 itself holds only
    1e-4 turn.
    """
    if turns.dtype != torch.float64:
        raise TypeError(
            f"phase needs float64 turns, got {turns.dtype}: a range of 700 km is 1e7 turns at S "
            "band and 1e12 in the near infrared"
        )
    _refuse_huge(turns)
    return turns - torch.round(turns.detach())


def unit_phasor(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(2j*pi*turns) in `dtype`.

    turns: float64, any shape; whole turns are dropped before leaving float64.

    An echo of delay tau at carrier f is `unit_phasor(-f * tau, dtype)` (design: phase exp(-j 2 pi f
    tau)).
    """
    return cis((2 * math.pi * reduced_turns(turns)).to(real_dtype(dtype)))


def _refuse_huge(turns: Tensor) -> None:
    if turns.numel() == 0:
        return
    try:
        worst = float(turns.detach().abs().max())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not worst <= MAX_TURNS:
        raise ValueError(
            f"phase of {worst:.3g} turns exceeds {MAX_TURNS:.0e}, where float64 holds only 1e-4 "
            "turn; form range - reference range as a difference first"
        )


def linear_phasor(turns_per_step: Tensor, start: float, n: int, dtype: torch.dtype) -> Tensor:
    """exp(2j pi s (start + i)) for i = 0..n-1, from two short float64 tables and one complex
    product per element.

    turns_per_step: float64 (...,). Returns (..., n). As exact as unit_phasor on every element, at a
    tenth of its cost; differentiable.
    """
    fine, coarse = phasor_tables(turns_per_step, start, n, dtype)
    return outer_phasor(fine, coarse, n)


def outer_phasor(fine: Tensor, coarse: Tensor, n: int) -> Tensor:
    """The first n products of phasor_tables' factors, (..., n)."""
    return (coarse[..., :, None] * fine[..., None, :]).flatten(-2)[..., :n]


def phasor_tables(turns_per_step: Tensor, start: float, n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Factors of linear_phasor: fine (..., m) and coarse (..., ceil(n / m)), element i being fine[i
    % m] * coarse[i // m].
    """
    m = max(1, 2 ** round(math.log2(max(n, 1)) / 2))
    steps = torch.arange(m, dtype=torch.float64, device=turns_per_step.device)
    starts = start + m * torch.arange(-(-n // m), dtype=torch.float64, device=turns_per_step.device)
    return unit_phasor(turns_per_step[..., None] * steps, dtype), unit_phasor(turns_per_step[..., None] * starts, dtype)
