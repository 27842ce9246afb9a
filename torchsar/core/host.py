"""Values of tensors on the host, on which a program decides, and whether a device can compute."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, TypeVar, get_args

import torch
from torch import Tensor
from torch._guards import active_fake_mode
from torch._subclasses.fake_tensor import is_fake
from torch.utils._python_dispatch import _disable_current_modes

Number = TypeVar("Number", bool, int, float)
# raises an error if the values are not acceptable
Check = Callable[..., None]
Validation = Literal["eager", "deferred", "off"]


@dataclass(frozen=True)
class _Waiting:
    """A check that waits for its values.

    Args:
        x: The values, any shape.
        check: The check of their numbers.
        stage: Name of the stage for the message; empty to leave the message as it is.
    """

    x: Tensor
    check: Check
    stage: str = ""

    def make(self, numbers: list[float]) -> None:
        try:
            self.check(*numbers)
        except Exception as error:
            if self.stage and error.args:
                error.args = (f"{self.stage}: {error.args[0]}", *error.args[1:])
            raise


class _Gathered(threading.local):
    """When values are checked, the names of the open blocks and the checks that wait, of this
    thread.
    """

    def __init__(self) -> None:
        self.validation: Validation = "eager"
        self.blocks: list[str] = []
        self.waiting: list[_Waiting] = []


_gathered = _Gathered()


class validate:
    """Set when values of tensors are checked: for a block, or from now on.

        with torchsar.validate("deferred"):
            image = chain(recording)

    Called without `with`, as `torchsar.validate("off")`, it holds until the next call. It holds for
    the thread that calls it. Types, shapes and dtypes are checked in any case, and an estimator
    that fails in a trial still says so by its outcome.

    - "eager", the default: a stage raises an error if one of its own values is not acceptable, such
      as a sample that is NaN. On an accelerator the checks of a stage wait for the next value that
      the stage reads, at the latest for its end.
    - "deferred": no stage waits for its checks. They are made at the end of the chain, of a stage
      that is called alone, or of the block, with one reading, or earlier with a value that a stage
      reads anyway. The error names the stage, and for samples that are not finite the index of the
      first, which begins with the trial. Until then stages may compute with such values.
    - "off": values are not checked. Results of values that are not acceptable are undefined.

    Args:
        mode: "eager", "deferred" or "off".

    Raises:
        ValueError: If `mode` is none of these.
        Exception: At the end of the block, what a check raises.
    """

    def __init__(self, mode: Validation) -> None:
        if mode not in get_args(Validation):
            raise ValueError(f"values are checked 'eager', 'deferred' or 'off', got {mode!r}")
        self._before: Validation = _gathered.validation
        _gathered.validation = mode
        self._block = gathered_checks()

    def __enter__(self) -> None:
        self._block.__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # the surrounding block decides whether its checks may wait any longer
        _gathered.validation = self._before
        self._block.__exit__(kind, error, traceback)


def validation() -> Validation:
    """Return when values are checked, see `validate`.

    Returns:
        "eager", "deferred" or "off".
    """
    return _gathered.validation


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
    beside = any(each.x.device == x.device for each in _gathered.waiting)
    if beside and not _is_mapped(x) and not is_traced(x):
        _make([*_taken(), _Waiting(x.detach(), lambda *numbers: read.extend(numbers))])
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

    Where values cannot be read, see `host_value`, and after `validate("off")` nothing is checked.

    Args:
        x: Tensor of real numbers, float, int or bool; it may require a gradient.
        check: Function of the numbers, in the order of the elements, that raises an error if they
            are not acceptable. It is kept for as long as the check waits.

    Raises:
        Exception: What `check` raises.
    """
    state = _gathered
    if state.validation == "off":
        return
    deferred = state.validation == "deferred"
    if state.blocks and (deferred or x.device.type != "cpu") and not _is_mapped(x) and not is_traced(x):
        stage = next(filter(None, state.blocks), "") if deferred else ""
        state.waiting.append(_Waiting(x.detach(), check, stage))
        return
    numbers = _read(x)
    if numbers is not None:
        check(*numbers)


def flat_index(at: float, shape: torch.Size) -> tuple[int, ...]:
    """Return the index of an element of a tensor from its position in the flattened tensor.

    Args:
        at: The position, a whole number.
        shape: Shape of the tensor.

    Returns:
        The index, one number per dimension.
    """
    return tuple(int(i) for i in torch.unravel_index(torch.tensor(int(at)), shape))


@contextmanager
def gathered_checks(stage: str = "") -> Iterator[None]:
    """Within the block, let the checks of `check_value` wait until a value is read from the device.

    On an accelerator every value that the host reads makes it wait for the device. Waiting checks
    are made, in their order, with the next number that `host_value` reads, and at the end of the
    block with one reading; also if the block ends with an error, of which a value that is not
    acceptable may be the reason. On the CPU every check is made at once. Blocks may be nested; at
    the end of each no check waits any longer. After `validate("deferred")` checks wait on the CPU
    too, and beyond the end of a nested block. While torch.compile traces a program, a block has no
    effect: no value is checked there.

    Args:
        stage: Name of the stage that the block runs, for errors of deferred checks. In nested
            blocks the outermost name counts.

    Returns:
        The context manager, which also serves as a decorator.

    Raises:
        Exception: What a check raises.
    """
    if torch.compiler.is_dynamo_compiling():
        yield
        return
    _gathered.blocks.append(stage)
    try:
        yield
    except Exception as error:
        waiting = _taken()
        if not is_out_of_memory(error):
            _make(waiting)
        raise
    else:
        if _gathered.validation != "deferred" or len(_gathered.blocks) == 1:
            _make(_taken())
    finally:
        _gathered.blocks.pop()
        if not _gathered.blocks:
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


def _taken() -> list[_Waiting]:
    """The checks that wait, which then no longer do."""
    waiting, _gathered.waiting = _gathered.waiting, []
    return waiting


@untraced()
def _make(checks: list[_Waiting]) -> None:
    """Make checks, with one reading for each device."""
    values: dict[torch.device, list[float]] = {}
    for device in dict.fromkeys(each.x.device for each in checks):
        here = [each.x.flatten().to(torch.float64) for each in checks if each.x.device == device]
        values[device] = torch.cat(here).tolist()
    for each in checks:
        numbers, count = values[each.x.device], each.x.numel()
        each.make(numbers[:count])
        del numbers[:count]
