"""Checks of samples and values that every public function shares, and their scale per trial."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core.host import check_value

_COMPLEX = (torch.complex64, torch.complex128)
_REAL = (torch.float32, torch.float64)


def refuse_non_finite(
    x: Tensor,
    what: str,
    advice: str = "set missing samples to zero, or correct the code that reads the data",
    noun: str = "samples",
) -> None:
    """Raise ValueError if samples are NaN or infinite.

    >>> import torch
    >>> from torchsar.core import refuse_non_finite
    >>> refuse_non_finite(torch.tensor([1.0, torch.inf]), "gain", "repeat the calibration")
    Traceback (most recent call last):
        ...
    ValueError: gain: 1 of 2 samples are NaN or Inf, the first at index (1,); repeat the calibration

    For valid data the check takes the time of one sum over the samples. It has no effect inside
    torch.vmap, where values cannot be read.

    Args:
        x: Samples of any shape, real or complex.
        what: Name of the samples for the message.
        advice: What to do about such samples, for the message.
        noun: What the elements of x are, for the message.

    Raises:
        ValueError: If a sample is NaN or infinite; the message has the number of such samples and
            the index of the first.
    """
    # a lazily conjugated tensor has no real view; signs do not matter here
    x = x.detach().resolve_conj()

    def refuse(finite: bool) -> None:
        if finite:
            return
        bad = ~torch.isfinite(x)
        count = int(bad.sum())
        # the sum of finite samples may overflow
        if count:
            first = tuple(map(int, torch.unravel_index(bad.view(torch.uint8).argmax(), x.shape)))
            raise ValueError(
                f"{what}: {count} of {x.numel()} {noun} are NaN or Inf, the first at index {first}; {advice}"
            )

    total = torch.view_as_real(x).sum() if x.is_complex() else x.sum()
    check_value(torch.isfinite(total), refuse)


def refuse_non_finite_values(what: str, **values: Tensor | float | None) -> None:
    """Raise ValueError if parameters of a correction are NaN or infinite.

    It has no effect inside torch.vmap, where values cannot be read.

    Args:
        what: Name of the function or the stage for the message.
        **values: Parameters by name, of any shape. Only real floating-point numbers are checked;
            complex ones are samples, such as those of a pilot, in which a bad trial is not ok.

    Raises:
        ValueError: If one of them is NaN or infinite; the message has its name.
    """
    for name, value in values.items():
        x = torch.as_tensor(value) if isinstance(value, float) else value
        if isinstance(x, Tensor) and x.is_floating_point():
            refuse_non_finite(x, f"{what}: {name}", "in trials without an estimate, give the neutral value", "values")


def checked_samples(
    x: Tensor, what: str, dims: str, *, real: bool = False, finite: bool = True, empty: bool = False
) -> Tensor:
    """Check the samples that a function works on, and resolve lazy conjugation and negation.

    >>> import torch
    >>> from torchsar.core import checked_samples
    >>> raw = torch.ones(4, 8, dtype=torch.complex64).conj()
    >>> raw.is_conj(), checked_samples(raw, "range compression", "pulse, range").is_conj()
    (True, False)

    Args:
        x: Samples, shape (..., *dims), complex64 or complex128.
        what: Name of the function for the message.
        dims: Names of the trailing dimensions, such as "pulse, range".
        real: Whether float32 and float64 are accepted, too.
        finite: Whether NaN and Inf are refused. Linear operations need not refuse them, since their
            results are NaN in these trials, too.
        empty: Whether a batch without trials is accepted.

    Returns:
        The samples, as a tensor without lazy conjugation or negation; the same tensor if it has
        neither.

    Raises:
        TypeError: If x is not a dense tensor of these dtypes.
        ValueError: If x has no samples or, unless `empty`, no trials, or too few dimensions, or a
            sample is not finite.
    """
    accepted = (*_COMPLEX, *_REAL) if real else _COMPLEX
    if not isinstance(x, Tensor) or x.dtype not in accepted:
        names = "complex64, complex128, float32 or float64" if real else "complex64 or complex128"
        got = x.dtype if isinstance(x, Tensor) else type(x).__name__
        advice = "form the analytic signal" if got in _REAL else "convert the samples"
        raise TypeError(
            f"{what} works on {'' if real else 'complex '}samples (..., {dims}) in a tensor of {names}, got {got}; "
            f"{advice} first"
        )
    if x.layout != torch.strided:
        raise TypeError(f"{what} works on dense samples (..., {dims}), got {x.layout}; call to_dense() first")
    least = dims.count(",") + 1
    if x.ndim < least or not (x.shape[-least:] if empty else x.shape).numel():
        raise ValueError(
            f"{what} works on samples (..., {dims}), at least one, got the shape {tuple(x.shape)}; "
            "leave out what has no trials or no samples"
        )
    x = x.resolve_conj().resolve_neg()
    if finite:
        refuse_non_finite(x, what)
    return x


def power_of(x: Tensor) -> Tensor:
    """Compute |x|^2 from real and imaginary part, without a root. Differentiable.

    >>> import torch
    >>> from torchsar.core import power_of
    >>> power_of(torch.tensor([3 + 4j, 1j]))
    tensor([25.,  1.])

    Args:
        x: Samples, any shape, real or complex.

    Returns:
        Powers, same shape, real.
    """
    return x.real.square().add_(x.imag.square()) if x.is_complex() else x.square()


def level_of(x: Tensor, trailing: int = 2) -> Tensor:
    """Return a power of two next to the largest magnitude of each trial.

    >>> import torch
    >>> from torchsar.core import level_of
    >>> level_of(torch.tensor([3.0, -5.0]), trailing=1)
    tensor([4.])

    Samples divided by it have squares and fourth powers that neither underflow nor overflow in
    single precision. The division is exact, so that results do not depend on the scale of the
    samples, not even in their rounding errors.

    Args:
        x: Samples, shape (..., and `trailing` dimensions), real or complex.
        trailing: Number of dimensions after the trial dimensions.

    Returns:
        Level, real, with `trailing` dimensions of length one at the end: the largest real or
        imaginary part, rounded down to a power of two, and at least the smallest normal number; 1
        for a trial of zeros and for one with samples that are not finite.
    """
    x = x.detach()
    part = torch.maximum(x.real.abs(), x.imag.abs()) if x.is_complex() else x.abs()
    largest = part.amax(tuple(range(-trailing, 0)), keepdim=True)
    usual = (largest > 0) & torch.isfinite(largest)
    level = torch.exp2(torch.floor(torch.log2(torch.where(usual, largest, 1))))
    # the reciprocal of a smaller number is infinite
    return torch.where(usual, level.clamp_min(torch.finfo(level.dtype).tiny), 1)


def unit_level(x: Tensor, trailing: int = 2) -> Tensor:
    """Divide each trial by its level, see `level_of`.

    >>> import torch
    >>> from torchsar.core import unit_level
    >>> unit_level(torch.tensor([3.0, -5.0]), trailing=1)
    tensor([ 0.7500, -1.2500])

    Args:
        x: Samples, shape (..., and `trailing` dimensions), real or complex.
        trailing: Number of dimensions after the trial dimensions.

    Returns:
        Samples of the same shape; the largest real or imaginary part of a trial is 1 to 2.
    """
    return x / level_of(x, trailing)
