"""Phases and unit phasors: removal of whole turns in float64, and fast complex exponentials."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core.host import check_value, is_out_of_memory, is_traced

# largest phase in cycles; float64 numbers of this size are 6e-5 cycles apart
MAX_TURNS = 4e11
# measured count of phasors above which copying their parts takes longer than strided writing
_FEW = 1 << 15
# real dtype of each complex dtype
_REAL = {torch.complex64: torch.float32, torch.complex128: torch.float64}


def real_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the real dtype that belongs to a complex one.

    >>> import torch
    >>> from torchsar.core import real_dtype
    >>> real_dtype(torch.complex64)
    torch.float32

    Args:
        dtype: complex64 or complex128.

    Returns:
        float32 or float64.

    Raises:
        TypeError: For any other dtype.
    """
    if dtype not in _REAL:
        raise TypeError(f"the dtype must be complex64 or complex128, got {dtype}; convert the samples first")
    return _REAL[dtype]


def cis(angle_rad: Tensor) -> Tensor:
    """Compute exp(1j * angle) in the precision of the angle.

    >>> import torch
    >>> from torchsar.core import cis
    >>> cis(torch.tensor([0.0, torch.pi / 2])).imag
    tensor([0., 1.])

    It takes a third of the time of torch.polar. Use `unit_phasor` for phases of more than a few
    turns. Differentiable.

    Args:
        angle_rad: Angle in radians, any shape, float32 or float64.

    Returns:
        Unit phasors of the same shape, complex64 or complex128.
    """
    if angle_rad.requires_grad or angle_rad.numel() < _FEW or is_traced(angle_rad):
        return torch.complex(torch.cos(angle_rad), torch.sin(angle_rad))
    # the parts are written in place, because allocating copies takes as long as the functions
    try:
        parts = angle_rad.new_empty((*angle_rad.shape, 2))
        torch.cos(angle_rad, out=parts[..., 0])
        torch.sin(angle_rad, out=parts[..., 1])
    except RuntimeError as error:  # `out=` is not available inside torch.func transforms
        if is_out_of_memory(error):
            raise
        return torch.complex(torch.cos(angle_rad), torch.sin(angle_rad))
    return torch.view_as_complex(parts)


def reduced_turns(turns: Tensor) -> Tensor:
    """Remove whole turns from a phase.

    >>> import torch
    >>> from torchsar.core import reduced_turns
    >>> reduced_turns(torch.tensor([1000000.25, -2.75], dtype=torch.float64))
    tensor([0.2500, 0.2500], dtype=torch.float64)

    Differentiable: the number of removed turns counts as a constant.

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
            f"the phase must be in float64 turns, got {turns.dtype}; compute it in float64, since a range of "
            "700 km is 1e7 turns at S band and 1e12 turns in the near infrared"
        )
    check_resolution(turns)
    return turns - torch.round(turns.detach())


def wrapped(x: Tensor, period: float) -> Tensor:
    """Wrap values into the interval -period / 2..period / 2.

    >>> import torch
    >>> from torchsar.core import wrapped
    >>> wrapped(torch.tensor([10.0, 190.0, -350.0]), 360.0)
    tensor([  10., -170.,   10.])

    Args:
        x: Values, any shape.
        period: Length of the interval, in the unit of the values.

    Returns:
        The wrapped values, same shape.
    """
    return x - period * torch.round(x / period)


def unit_phasor(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """Compute exp(2j * pi * turns); whole turns are removed while the phase is still float64.

    >>> import torch
    >>> from torchsar.core import unit_phasor
    >>> unit_phasor(torch.tensor([1000000.0, 1000000.5], dtype=torch.float64), torch.complex64).real
    tensor([ 1., -1.])

    The phase of an echo in this package is -2 pi f tau, so that an echo of delay tau at the carrier
    frequency f is `unit_phasor(-f * tau, dtype)`. Differentiable.

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


def check_resolution(turns: Tensor) -> None:
    """Check that float64 resolves phases.

    Args:
        turns: Phases in turns, float64.

    Raises:
        ValueError: If the largest exceeds 4e11 turns, or one is not finite.
    """

    def check(worst: float) -> None:
        if not worst <= MAX_TURNS:
            raise ValueError(
                f"the phase must be at most {MAX_TURNS:.0e} turns, beyond which float64 resolves only 1e-4 turn, "
                f"got {worst:.3g} turns; subtract the reference range from the range before computing the phase"
            )

    if turns.numel():
        check_value(turns.detach().abs().max(), check)


def linear_phasor(turns_per_step: Tensor, start: float, n: int, dtype: torch.dtype) -> Tensor:
    """Compute the phasors exp(2j pi s (start + i)) for i = 0..n - 1 of a linear phase.

    >>> import torch
    >>> from torchsar.core import linear_phasor
    >>> quarter = torch.tensor(0.25, dtype=torch.float64)
    >>> torch.view_as_real(linear_phasor(quarter, 0, 4, torch.complex64)).round().int().tolist()
    [[1, 0], [0, 1], [-1, 0], [0, -1]]

    They are products of the elements of two short tables, which is as exact as `unit_phasor` of
    every element and takes a tenth of the time. Differentiable.

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
    """Multiply the two tables of `phasor_tables` into the phasors of a linear phase.

    Args:
        fine: Phasors of the first m elements, shape (..., m), complex.
        coarse: Phasors of every m-th element, shape (..., ceil(n / m)), complex.
        n: Number of elements.

    Returns:
        The first n products, shape (..., n); element i is fine[i % m] * coarse[i // m].
    """
    return (coarse[..., :, None] * fine[..., None, :]).flatten(-2)[..., :n]


def phasor_tables(turns_per_step: Tensor, start: Tensor | float, n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return two short tables whose products are the phasors exp(2j pi s (start + i)), i < n.

    `linear_phasor` multiplies them; the tables serve where the full product is not needed.

    Args:
        turns_per_step: Phase step s in turns, shape (...,), float64.
        start: Offset of the first element in steps, a number or a tensor without dimensions.
        n: Number of elements.
        dtype: complex64 or complex128.

    Returns:
        `fine` of shape (..., m) and `coarse` of shape (..., ceil(n / m)), complex. Element i of the
        phasor is fine[i % m] * coarse[i // m], with m a power of two near sqrt(n).
    """
    m = max(1, 2 ** round(math.log2(max(n, 1)) / 2))
    steps = torch.arange(m, dtype=torch.float64, device=turns_per_step.device)
    starts = start + m * torch.arange(-(-n // m), dtype=torch.float64, device=turns_per_step.device)
    return unit_phasor(turns_per_step[..., None] * steps, dtype), unit_phasor(turns_per_step[..., None] * starts, dtype)
