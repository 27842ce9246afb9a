"""Calls of stages in a program of torch.compile.

The module is imported only while torch.compile traces a program: torch._dynamo takes seconds to
import.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from operator import index
from typing import Any

import torch
import torch._dynamo
from torch import Tensor
from torch._guards import active_fake_mode
from torch._subclasses.fake_tensor import is_fake
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode, _get_current_dispatch_mode_stack

from torchsar.core.host import untraced


def call_as_one(stage: Any, args: Sequence[Any], values: Mapping[str, Any]) -> Any:
    """Call a stage as one node of the graph of torch.compile.

    torch.compile does not read the code of the stage. The compiler behind it traces the stage as a
    non-strict `torch.export` does. All lengths are constants of the program; torch.compile makes a
    new program for other lengths. A stage that cannot be traced runs as it is, between two graphs.

    Args:
        stage: Stage. Its values in `fixed` become constants of the program.
        args: Arguments of the call.
        values: Values by name.

    Returns:
        Result of the stage.

    Raises:
        RuntimeError: When the program runs, if a fixed value is not that of the first call.
    """
    tensors = [x for x in pytree.tree_leaves((args, values)) if isinstance(x, Tensor)]
    for x in tensors:
        [index(n) for n in x.shape]  # lengths that are read as numbers become constants
    names = [name for name in stage.fixed if values.get(name) is not None]
    if names and torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
        return _call_apart(stage, args, values)
    # torch.compile takes a text as a constant only if it is part of a longer text
    return _call(stage, args, values, [f"{name} {_digits(values[name])}" for name in names])  # pyright: ignore[reportCallIssue]


@torch._dynamo.nonstrict_trace
@torch.compiler.disable
def _call(stage: Any, args: Sequence[Any], values: Mapping[str, Any], fixed: Sequence[str]) -> Any:
    """Call a stage with the constants in `fixed` instead of the values of the same names."""
    with ExitStack() as modes:
        if active_fake_mode() is not None:
            modes.enter_context(_Constants())
            modes.enter_context(_Operands())
        known = {}
        for name, digits in map(str.split, fixed):
            x = values[name]
            with untraced():
                known[name] = torch.frombuffer(bytearray.fromhex(digits), dtype=x.dtype).reshape(x.shape).to(x.device)
            torch.ops.aten._assert_async.msg(
                (x == known[name]).all(),
                f"{type(stage).__name__}: {name} is not that of the first call, which the compiled program holds as a "
                "constant; compile a new one",
            )
        return stage(*args, **{**values, **known})


class _Operands(TorchFunctionMode):
    """Context in which host values of a traced program become tensors before a derivative uses
    them.

    A tensor that a function writes into is left to `_Constants`, which raises an error for it.
    """

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        if not any(isinstance(mode, _Constants) for mode in _get_current_dispatch_mode_stack()):
            return func(*args, **kwargs)  # inside `untraced`
        inplace = name.endswith("_") and not name.endswith("__")
        written = int(inplace or name.startswith("__i") or name in ("__setitem__", "__set__"))
        lifted = pytree.tree_map(_lifted, (args[written:], {k: x for k, x in kwargs.items() if k != "out"}))
        return func(*args[:written], *lifted[0], **{**kwargs, **lifted[1]})


def _lifted(x: Any) -> Any:
    """Turn a host tensor into a value of the program, and return anything else unchanged."""
    return torch.ops.aten.lift_fresh_copy(x) if _of_host(x) else x


class _Constants(TorchDispatchMode):
    """Context in which host tensors, such as tables of a stage, become values of a traced program.

    The compiler "inductor" takes them in no other form. Writing into such a tensor raises a
    RuntimeError.
    """

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.ops.aten.lift_fresh_copy.default:
            return func(*args, **kwargs)
        for i, one in enumerate(func._schema.arguments if func._schema.is_mutable else ()):
            written = one.alias_info is not None and one.alias_info.is_write
            if written and any(map(_of_host, pytree.tree_leaves(args[i] if i < len(args) else kwargs.get(one.name)))):
                raise RuntimeError(
                    f"a compiled program cannot write into a tensor that it holds as a constant ({func})"
                )
        lifted = pytree.tree_map(_lifted, (args, kwargs))
        return func(*lifted[0], **lifted[1])


def _of_host(x: Any) -> bool:
    """True for a tensor that holds numbers and is not part of a traced program."""
    return type(x) is Tensor and not is_fake(x)


@torch.compiler.disable(reason="with constants of a program in its plan, a stage has no derivatives in one graph")
def _call_apart(stage: Any, args: Sequence[Any], values: Mapping[str, Any]) -> Any:
    return stage(*args, **values)


@torch.compiler.assume_constant_result
def _digits(x: Tensor) -> str:
    """Hexadecimal digits of the bytes of a tensor."""
    return x.detach().cpu().contiguous().numpy().tobytes().hex()
