"""Checks of samples and values, numbers of tensors that the host reads to decide on them, and
whether a device can compute.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TypeVar

import torch
from torch import Tensor
from torch._guards import active_fake_mode
from torch._subclasses.fake_tensor import is_fake
from torch.utils._python_dispatch import _disable_current_modes

Number = TypeVar("Number", bool, int, float)
# function that raises an error if the numbers passed to it are not acceptable
Check = Callable[..., None]


class _Gathered(threading.local):
    """State of a thread: number of open blocks of `gathered_checks`, and the checks not
    made yet.
    """

    def __init__(self) -> None:
        self.blocks = 0
        self.waiting: list[tuple[Tensor, Check]] = []


_gathered = _Gathered()


def host_value(x: Tensor, otherwise: Number) -> Number:
    """Read a number from a tensor, which waits for its device.

    >>> import torch
    >>> from torchsar.core import host_value
    >>> host_value(torch.tensor([3]), otherwise=0)
    3
    >>> torch.func.vmap(lambda x: x + host_value(x, otherwise=10.0))(torch.tensor([3.0, 4.0]))
    tensor([13., 14.])

    Checks that wait for values of this device (see `gathered_checks`) are made in the same wait.
    Inside `torch.func.vmap` a tensor stands for many trials, and while a program is traced, as by
    `torch.export`, for any data: its value cannot be read.

    Args:
        x: Tensor of one element, which may require a gradient.
        otherwise: What to return where the value cannot be read; its type is that of the result.

    Returns:
        The number.

    Raises:
        RuntimeError: If the tensor has more than one element, or the device fails.
    """
    if x.numel() != 1:
        raise RuntimeError(f"host_value reads a tensor of one element, got {x.numel()} elements")
    return host_values(x, otherwise)[0]


def host_values(x: Tensor, otherwise: Number) -> list[Number]:
    """Read the numbers of a small tensor in one wait for its device, see `host_value`.

    Args:
        x: Tensor of any shape, which may require a gradient.
        otherwise: What to return for each where the values cannot be read; its type is that of the
            numbers.

    Returns:
        The numbers in the order of the elements.
    """
    read: list[float] | None = []
    beside = any(waiting.device == x.device for waiting, _ in _gathered.waiting)
    if beside and not _is_mapped(x) and not is_traced(x):
        _make([*_taken(), (x.detach(), lambda *numbers: read.extend(numbers))])
    else:
        read = _read(x)
    return [otherwise] * x.numel() if read is None else [type(otherwise)(number) for number in read]


def host_largest(x: Tensor, otherwise: Number) -> Number:
    """Read the largest value of a tensor, which waits for its device.

    Args:
        x: Tensor of real numbers, any shape.
        otherwise: What to return if the tensor is empty, and where values cannot be read.

    Returns:
        The largest value.
    """
    return host_value(x.max(), otherwise) if x.numel() else otherwise


def device_fault(device: torch.device | str) -> str:
    """Find out whether a device can compute; on some devices allocation alone succeeds.

    >>> from torchsar.core import device_fault
    >>> device_fault("cpu") == "", device_fault("xla") == ""  # a device of another package
    (True, False)

    Args:
        device: The device, such as "cpu" or "cuda:1".

    Returns:
        Why it cannot compute, in one line; empty if it can.
    """
    try:
        torch.zeros(1, dtype=torch.complex128, device=torch.device(device)).abs().item()
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        return str(error).splitlines()[0].rstrip(".")
    return ""


def is_out_of_memory(error: BaseException) -> bool:
    """Decide whether an error says that memory is short.

    Args:
        error: An error. CUDA raises a class of its own, the CPU allocator of torch only a text.

    Returns:
        Whether a smaller batch may succeed.
    """
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or (
        isinstance(error, RuntimeError) and "allocate memory" in str(error)
    )


def is_traced(x: Tensor) -> bool:
    """Find out whether a tensor stands for any data while a program is traced.

    Args:
        x: Tensor.

    Returns:
        True for a tensor without values, which `torch.export` and the like use.
    """
    return is_fake(x)


@contextmanager
def untraced(*given: Tensor | float | None) -> Iterator[None]:
    """Within the block, compute with the values of tensors even while a program is traced.

    A plan of a geometry depends on numbers that are the same in all runs of a program. While
    `torch.export` traces it, they are computed once, and their tensors become constants of the
    program. What is computed in the block from a tensor that stands for any data (`is_traced`) must
    not leave it. Elsewhere the block has no effect.

    Args:
        given: What results that leave the block depend on. The block has no effect if one of them
            is a tensor that stands for any data.

    Returns:
        The context manager, which also serves as a decorator.
    """
    known = not any(isinstance(x, Tensor) and is_traced(x) for x in given)
    with _disable_current_modes() if known and active_fake_mode() is not None else nullcontext():
        yield


def is_hidden(x: Tensor) -> bool:
    """Find out whether `torch.func.vmap` hides the values of a tensor.

    Args:
        x: Tensor, not empty.

    Returns:
        True inside vmap, where the tensor stands for many trials.
    """
    return _is_mapped(x) and _read(x.detach().flatten()[:1]) is None


def check_value(x: Tensor, check: Check) -> None:
    """Check the numbers in a small tensor: at once, or in `gathered_checks` perhaps later.

    >>> import torch
    >>> from torchsar.core import check_value
    >>> def refuse(largest):
    ...     if largest > 1:
    ...         raise ValueError(f"the largest value must be at most 1, got {largest:g}")
    >>> check_value(torch.tensor([0.5, 2.0]).max(), refuse)
    Traceback (most recent call last):
        ...
    ValueError: the largest value must be at most 1, got 2

    Where values cannot be read, see `host_value`, nothing is checked.

    Args:
        x: Tensor of real numbers, float, int or bool; it may require a gradient.
        check: Function of the numbers, in the order of the elements, that raises an error if they
            are not acceptable. It is kept for as long as the check waits.

    Raises:
        Exception: What `check` raises.
    """
    if _gathered.blocks and x.device.type != "cpu" and not _is_mapped(x) and not is_traced(x):
        _gathered.waiting.append((x.detach(), check))
        return
    numbers = _read(x)
    if numbers is not None:
        check(*numbers)


@contextmanager
def gathered_checks() -> Iterator[None]:
    """Within the block, let the checks of `check_value` wait until a value is read from the device.

    >>> import torch
    >>> from torchsar.core import gathered_checks, refuse_non_finite
    >>> with gathered_checks():
    ...     refuse_non_finite(torch.tensor([1.0, 2.0]), "phase")
    ...     refuse_non_finite(torch.tensor([1.0, torch.inf]), "gain", "repeat the calibration")
    Traceback (most recent call last):
        ...
    ValueError: gain: 1 of 2 samples are NaN or Inf, the first at index (1,); repeat the calibration

    On an accelerator every value that the host reads makes it wait for the device. Waiting checks
    are made, in their order, with the next number that `host_value` reads, and at the end of the
    block with one reading; also if the block ends with an error, of which a value that is not
    acceptable may be the reason. On the CPU every check is made at once. Blocks may be nested; at
    the end of each no check waits any longer. While torch.compile traces a program, a block has no
    effect: no value is checked there.

    Returns:
        The context manager, which also serves as a decorator.

    Raises:
        Exception: What a check raises.
    """
    if torch.compiler.is_dynamo_compiling():
        yield
        return
    _gathered.blocks += 1
    try:
        yield
    except Exception as error:
        waiting = _taken()
        if not is_out_of_memory(error):
            _make(waiting)
        raise
    else:
        _make(_taken())
    finally:
        _gathered.blocks -= 1
        _gathered.waiting = []


def _read(x: Tensor) -> list[float] | None:
    """Numbers in a tensor as a list; None where they cannot be read."""
    if is_traced(x):
        return None
    try:
        # a tensor inside a torch.func transform has no storage that `tolist` could read
        return [one.item() for one in x.flatten()] if _is_mapped(x) else x.flatten().tolist()
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return None


def _is_mapped(x: Tensor) -> bool:
    """True for a tensor inside a torch.func transform, which must not be used outside the
    transform.
    """
    return torch._C._functorch.is_functorch_wrapped_tensor(x)  # pyright: ignore[reportAttributeAccessIssue]


def _taken() -> list[tuple[Tensor, Check]]:
    """Remove all postponed checks from the queue and return them."""
    waiting, _gathered.waiting = _gathered.waiting, []
    return waiting


@untraced()
def _make(checks: list[tuple[Tensor, Check]]) -> None:
    """Make all checks; the numbers are read once for each device."""
    values: dict[torch.device, list[float]] = {}
    for device in dict.fromkeys(x.device for x, _ in checks):
        here = [x.flatten().to(torch.float64) for x, _ in checks if x.device == device]
        values[device] = torch.cat(here).tolist()
    for x, check in checks:
        numbers = values[x.device]
        check(*numbers[: x.numel()])
        del numbers[: x.numel()]


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
    # a lazily conjugated tensor has no real view, and the sign of the imaginary part does not
    # matter
    x = x.detach().resolve_conj()

    def refuse(finite: bool) -> None:
        if finite:
            return
        bad = ~torch.isfinite(x)
        count = int(bad.sum())
        # a sum that is not finite may also come from finite samples, which overflow
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
    # the reciprocal of a smaller number would be infinite
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
