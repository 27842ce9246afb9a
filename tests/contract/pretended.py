"""A pretended accelerator: tensors that claim another device and hold their values on the CPU.

Like CUDA, it refuses operands on several devices. It counts, by line of the library, what costs
time on an accelerator: synchronisations (the host waits for a value) and copies from the host. It
runs on every machine.

The claimed device is `meta`: torch has no lazy start, no device threads and no kernels of its own
for it, so that every operation comes here and gradients run in the thread of the caller. Other
devices need a build of torch for them, or a registration that holds for the whole process.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

import torchsar

DEVICE = torch.device("meta")
_CPU = torch.device("cpu")
_LIBRARY = f"{Path(torchsar.__file__).parent}/"
_aten: Any = torch.ops.aten

# on CUDA the host waits for the number of elements or for the status of a factorisation
_WAITS = {
    _aten._local_scalar_dense,
    _aten.nonzero,
    _aten.masked_select,
    _aten.equal,
    _aten.bincount,
    _aten._unique2,
    _aten.unique_dim,
    _aten.unique_consecutive,
    _aten._linalg_check_errors,
    _aten._linalg_eigh,
    _aten._linalg_svd,
    _aten.linalg_eig,
}
_COPIES = {_aten.copy_, _aten._to_copy}
_INDEXED = {_aten.index, _aten._unsafe_index, _aten.index_put, _aten.index_put_, _aten._index_put_impl_}
_PUTS = _INDEXED - {_aten.index, _aten._unsafe_index}
# these take a value in a CPU tensor of no dimensions, like elementwise operations
_TAKES_SCALAR = {_aten.fill_, _aten.masked_fill, _aten.masked_fill_, _aten.index_fill, _aten.index_fill_}
# elementwise operations that do not
_TAKES_NO_SCALAR = {_aten.complex, _aten.polar}


@dataclass
class Counts:
    """What was done on the pretended device, by line of the library ("focus/strip.py:12 in f").

    Args:
        waits: Synchronisations.
        uploads: Copies from the host.
        faults: Operations with an index out of range. CUDA reports them later, and then computes
            nothing more in this process.
    """

    waits: Counter[str] = field(default_factory=Counter)
    uploads: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)


class Pretended(Tensor):
    """A tensor that claims the device DEVICE.

    Args:
        kept: The values, a CPU tensor.
    """

    kept: Tensor
    # a number that torch has turned into a tensor, which CUDA would keep on the host
    number = False

    @staticmethod
    def __new__(cls, kept: Tensor) -> Pretended:
        strides = kept.stride() if kept.layout is torch.strided else None
        made = Tensor._make_wrapper_subclass(cls, kept.shape, strides, dtype=kept.dtype, device=DEVICE)  # pyright: ignore
        made.kept = kept
        return made

    # torch would make index tensors of lists on `meta`, without values
    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_index(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_index(index), value)

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def new_tensor(self, data: Any, **kwargs: Any) -> Tensor:
        return torch.tensor(data, **{"dtype": self.dtype, "device": DEVICE, **kwargs})

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _carried_out(func, args, kwargs or {})

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"Pretended({self.kept!r})"


def _index(index: Any) -> Any:
    if isinstance(index, tuple):
        return tuple(_index(each) for each in index)
    return torch.tensor(index, device=DEVICE) if isinstance(index, list) else index


class _Operations(TorchDispatchMode):
    """Catches functions that make tensors on the pretended device."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # wrapping the method against the compiler would cost as much as all the rest
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _carried_out(func, args, kwargs or {})


def _filled(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`torch.tensor` and the like by way of the CPU, since torch fills no tensor on `meta`."""

    def made(data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Tensor:
        wanted = torch.empty(0).device if device is None else torch.device(device)
        if isinstance(data, Tensor) or wanted != DEVICE:
            return make(data, *args, device=device, **kwargs)
        return make(data, *args, device=_CPU, **kwargs).to(DEVICE)

    return made


@contextmanager
def pretended_device() -> Iterator[Counts]:
    """Within the block torch has the pretended device; yields what is done on it."""
    counts = Counts()
    with ExitStack() as stack:
        for make in (torch.tensor, torch.as_tensor, torch.asarray):
            stack.enter_context(mock.patch.object(torch, make.__name__, _filled(make)))
        stack.enter_context(mock.patch.object(_Counting, "now", counts))
        stack.enter_context(_Operations())
        yield counts


def to_device(x: Any) -> Any:
    """Put the tensors of a value, which may be nested, on the pretended device, uncounted."""
    return tree_map(lambda leaf: Pretended(leaf.clone()) if isinstance(leaf, Tensor) else leaf, x)


def to_host(x: Any) -> Any:
    """Take the tensors of a value, which may be nested, from the pretended device, uncounted."""
    return tree_map(lambda leaf: leaf.kept if isinstance(leaf, Pretended) else leaf, x)


class _Counting:
    now: Counts | None = None


@dataclass(frozen=True)
class _Operation:
    """What is to be known of an operation of torch.

    Args:
        packet: Its name without overload.
        waits: Whether the host waits for it.
        counted: Whether the host may wait for it or copy to it, which its arguments decide.
        scalars: Whether it takes a value in a CPU tensor of no dimensions.
        writes: Whether it changes an argument.
    """

    packet: Any
    waits: bool
    counted: bool
    scalars: bool
    writes: bool


_OPERATIONS: dict[int, _Operation] = {}


def _known(func: Any) -> _Operation:
    """By identity: operations live as long as torch, and their hash costs more than the rest."""
    known = _OPERATIONS.get(id(func))
    if known is None:
        known = _OPERATIONS[id(func)] = _looked_up(func)
    return known


def _looked_up(func: Any) -> _Operation:
    packet = func.overloadpacket
    counted = packet in _WAITS | _COPIES | _INDEXED | {_aten.repeat_interleave}
    scalars = packet in _TAKES_SCALAR or (torch.Tag.pointwise in func.tags and packet not in _TAKES_NO_SCALAR)
    return _Operation(packet, packet in _WAITS, counted, scalars, func._schema.is_mutable)


def _carried_out(func: Any, args: Any, kwargs: Mapping[str, Any]) -> Any:
    """The result of an operation of torch, on the device on which CUDA would compute it."""
    operands: list[Tensor] = []
    plain = [_plain(x, operands) for x in args]
    named = {name: _plain(x, operands) for name, x in kwargs.items()} if kwargs else {}
    here = [x for x in operands if type(x) is Pretended]
    wanted = kwargs.get("device")
    on_device = bool(here) if wanted is None else torch.device(wanted) == DEVICE
    if not here and not on_device:
        return func(*args, **kwargs)
    known = _known(func)
    if known.packet is _aten.copy_:
        on_device = type(args[0]) is Pretended
    elif len(here) < len(operands) and known.packet is not _aten._to_copy:
        _refuse_mixed(func, known, operands, args)
    if known.counted and _Counting.now is not None:
        _count(_Counting.now, known, operands, on_device, args, kwargs)
    if wanted is not None:
        named["device"] = _CPU
    try:
        made = func(*plain, **named)
    except (IndexError, RuntimeError) as error:
        if _Counting.now is not None and re.search("out of (range|bounds)", str(error)):
            _Counting.now.faults[_line()] += 1
        raise
    if not on_device:
        return args[0] if known.packet is _aten.copy_ else made
    originals = {id(x.kept): x for x in here} if known.writes else {}
    if type(made) is Tensor:
        return _wrapped(made, originals, known.packet)
    return tree_map(lambda x: _wrapped(x, originals, known.packet) if isinstance(x, Tensor) else x, made)


def _plain(x: Any, operands: list[Tensor]) -> Any:
    """An argument with the values of pretended tensors; its tensors are added to the operands."""
    if type(x) is Pretended:
        operands.append(x)
        return x.kept
    if isinstance(x, Tensor):
        operands.append(x)
        return x
    return [_plain(each, operands) for each in x] if isinstance(x, (list, tuple)) else x


def _wrapped(x: Tensor, originals: Mapping[int, Pretended], packet: Any) -> Pretended:
    if originals and id(x) in originals:
        return originals[id(x)]
    if x.is_conj() or x.is_neg():
        # the wrapper has no bit for a lazy conjugate, which torch would resolve earlier
        x = x.resolve_conj().resolve_neg()
    made = Pretended(x)
    if packet is _aten.scalar_tensor:
        made.number = True
    return made


def _refuse_mixed(func: Any, known: _Operation, operands: list[Tensor], args: Any) -> None:
    """Raise RuntimeError for operands on two devices, where CUDA does."""
    strangers = [x for x in operands if not isinstance(x, Pretended)]
    if known.packet in _INDEXED and isinstance(args[0], Pretended):
        # indices may lie on the CPU, values not
        strangers = [x for x in args[2:3] if not isinstance(x, Pretended) and x.ndim]
    elif known.scalars:
        strangers = [x for x in strangers if x.ndim or (known.writes and x is args[0])]
    if strangers:
        shapes = ", ".join(f"{tuple(x.shape)} on {x.device}" for x in operands)
        raise RuntimeError(f"expected all tensors to be on the same device: {func} got {shapes}, at {_line()}")


def _count(
    counts: Counts, known: _Operation, operands: list[Tensor], on_device: bool, args: Any, kwargs: Mapping[str, Any]
) -> None:
    waits, uploads = known.waits, 0
    if known.packet in _COPIES:
        waits, uploads = not on_device, int(on_device and not isinstance(operands[-1], Pretended))
    elif known.packet in _INDEXED:
        indices = [x for x in args[1] if x is not None]
        masks = [x for x in indices if isinstance(x, Pretended) and x.dtype in (torch.bool, torch.uint8)]
        waits = bool(masks) and not (known.packet in _PUTS and _is_number(args[2]))
        uploads = sum(not isinstance(x, Pretended) for x in indices)
    elif known.packet is _aten.repeat_interleave:
        waits = kwargs.get("output_size") is None
    if waits or uploads:
        line = _line()
        counts.waits[line] += int(waits)
        counts.uploads[line] += uploads


def _is_number(x: Tensor) -> bool:
    return x.ndim == 0 and (x.number if isinstance(x, Pretended) else True)


def _line() -> str:
    """The innermost line of the library that is being executed."""
    frame = sys._getframe(1)
    while frame is not None:
        file = _inside(frame.f_code.co_filename)
        if file:
            return f"{file}:{frame.f_lineno} in {frame.f_code.co_name}"
        frame = frame.f_back
    return "elsewhere"


@cache
def _inside(file: str) -> str:
    """Path of a file in the library; empty for other files, and for the one that reads values for
    all others.
    """
    return file.removeprefix(_LIBRARY) if file.startswith(_LIBRARY) and not file.endswith("core/host.py") else ""
