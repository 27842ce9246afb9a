"""Values of tensors on the host, on which a program decides, and whether a device can compute."""

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
# raises an error if the values are not acceptable
Check = Callable[..., None]


class _Gathered(threading.local):
    """The number of open blocks of `gathered_checks` in this thread, and the checks that wait."""

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


def is_out_of_memory(error: Exception) -> bool:
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
    """The numbers in a tensor; None where they cannot be read."""
    if is_traced(x):
        return None
    try:
        # a tensor of a transform has no storage, from which `tolist` reads
        return [one.item() for one in x.flatten()] if _is_mapped(x) else x.flatten().tolist()
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return None


def _is_mapped(x: Tensor) -> bool:
    """Whether a tensor belongs to a transform of torch.func, outside which it must not be kept."""
    return torch._C._functorch.is_functorch_wrapped_tensor(x)  # pyright: ignore[reportAttributeAccessIssue]


def _taken() -> list[tuple[Tensor, Check]]:
    """The checks that wait, which then no longer do."""
    waiting, _gathered.waiting = _gathered.waiting, []
    return waiting


@untraced()
def _make(checks: list[tuple[Tensor, Check]]) -> None:
    """Make checks, with one reading for each device."""
    values: dict[torch.device, list[float]] = {}
    for device in dict.fromkeys(x.device for x, _ in checks):
        here = [x.flatten().to(torch.float64) for x, _ in checks if x.device == device]
        values[device] = torch.cat(here).tolist()
    for x, check in checks:
        numbers = values[x.device]
        check(*numbers[: x.numel()])
        del numbers[: x.numel()]
