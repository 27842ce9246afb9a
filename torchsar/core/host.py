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

from torchsar.core.memory import is_out_of_memory

Number = TypeVar("Number", bool, int, float)
# raises an error if a value is not acceptable
Check = Callable[[float], None]


class _Gathered(threading.local):
    """The checks that wait for their values, of this thread."""

    def __init__(self) -> None:
        self.blocks = 0
        self.waiting: list[tuple[Tensor, Check]] = []


_gathered = _Gathered()


def host_value(x: Tensor, otherwise: Number) -> Number:
    """Read a number from a tensor, which waits for its device.

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
    if _gathered.waiting and x.numel() == 1 and not _is_mapped(x):
        read: list[float] = []
        _make([*_taken(), (x.detach(), read.append)])
        return type(otherwise)(read[0])
    value = _read(x)
    return otherwise if value is None else type(otherwise)(value)


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
    """Check a number in a tensor: at once, or in a block of `gathered_checks` perhaps later.

    Where values cannot be read, see `host_value`, nothing is checked.

    Args:
        x: Tensor of one real number, float, int or bool; it may require a gradient.
        check: Function of the number that raises an error if it is not acceptable. It is kept for
            as long as the check waits.

    Raises:
        Exception: What `check` raises.
    """
    if _gathered.blocks and x.device.type != "cpu" and not _is_mapped(x):
        _gathered.waiting.append((x.detach(), check))
        return
    value = _read(x)
    if value is not None:
        check(value)


@contextmanager
def gathered_checks() -> Iterator[None]:
    """Within the block, let the checks of `check_value` wait until a value is read from the device.

    On an accelerator every value that the host reads makes it wait for the device. Waiting checks
    are made, in their order, with the next number that `host_value` reads, and at the end of the
    block with one reading; also if the block ends with an error, of which a value that is not
    acceptable may be the reason. On the CPU every check is made at once. Blocks may be nested; at
    the end of each no check waits any longer.

    Returns:
        The context manager, which also serves as a decorator.

    Raises:
        Exception: What a check raises.
    """
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
        if not _gathered.blocks:
            _gathered.waiting = []


def _read(x: Tensor) -> float | None:
    """The number in a tensor; None where it cannot be read."""
    if is_traced(x):
        return None
    try:
        return x.item()
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


def _make(checks: list[tuple[Tensor, Check]]) -> None:
    """Make checks, with one reading for each device."""
    values: dict[int, float] = {}
    for device in dict.fromkeys(x.device for x, _ in checks):
        here = {i: x for i, (x, _) in enumerate(checks) if x.device == device}
        read = torch.stack([x.reshape(()).to(torch.float64) for x in here.values()]).tolist()
        values |= dict(zip(here, read, strict=True))
    for i, (_, check) in enumerate(checks):
        check(values[i])
