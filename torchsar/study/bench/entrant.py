"""The door for methods of users: classes, modules, functions of torch and of numpy."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Chain, Estimate, Outcome, Stage, is_out_of_memory
from torchsar.study.bench.frame import samples
from torchsar.study.settings.errors import ConfigError, one_line, own_line


class MethodError(TypeError):
    """An error of a method of a user: what it returned, and what was expected."""


def _called(what: str, function: Callable[..., Any], *parts: Any, **values: Any) -> Any:
    """Call what a user wrote; its errors become one sentence with the own line."""
    try:
        return function(*parts, **values)
    except Exception as error:
        if isinstance(error, MethodError) or is_out_of_memory(error):
            raise
        told = f"{type(error).__name__}: {one_line(error) or 'no message'}{own_line(error)}"
        raise MethodError(f"{what} failed with {told}") from error


def loaded(place: str) -> Any:
    """Import `package.module:Name`, also from the working folder."""
    module, _, name = place.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever a module of a user raises
        right = f"{Path(module).stem}:{name}" if module.endswith(".py") else "package.module:Name"
        told = f"{one_line(error)}{own_line(error)}; give {right}"
        raise ConfigError(f"the method {place!r} cannot be imported: {told}") from error


def entrant(method: Any, name: str, per_pulse: bool = False) -> Callable[..., Estimate]:
    """Make a method one that takes the data of a world and returns an Estimate.

    A class is called without arguments. A stage or a chain is given the signal, and any other
    method the samples: a tensor, or an array if that is what it needs, and those of the values of
    a world that its arguments name. It returns an Estimate, the value, or a tuple (value, std, ok),
    of which the last two may be left out or None. Of a chain counts the last estimate of the value.

    Args:
        method: Class, stage, module or function.
        name: Name of the value.
        per_pulse: Whether there is one value per pulse.

    Returns:
        The method.

    Raises:
        MethodError: If the method cannot be called; in a call, if it returns something else.
    """
    made = method
    if isinstance(method, type):
        made = _called(f"{method.__name__}() without arguments (an instance may be given in its place)", method)
    if not callable(made):
        raise MethodError(f"a method must be a class, module or function, got {type(made).__name__}")
    called = f"the method {getattr(made, '__name__', type(made).__name__)}"
    if isinstance(made, Stage):
        return partial(_called, called, made)
    if isinstance(made, Chain):
        return partial(_called, called, partial(_last, made, name))
    kinds: list[Callable[[Tensor], Any]] = [torch.Tensor.clone, lambda x: x.detach().cpu().numpy().copy()]

    def run(data: Any, **values: Any) -> Estimate:
        x, values = samples(data), _taken(made, values)
        try:
            out = _called(called, made, kinds[0](x), **values)
        except Exception as first:
            if len(kinds) == 1:
                raise
            try:
                out = made(kinds[1](x), **values)
            except Exception:
                raise first from first.__cause__
            del kinds[0]
        else:
            if len(kinds) > 1 and _holds_arrays(out):
                del kinds[0]
                out = _called(called, made, kinds[0](x), **values)
        del kinds[1:]
        return _estimate(out, name, x, per_pulse)

    return run


def _taken(method: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Those of the values that a method takes."""
    try:
        parameters = inspect.signature(getattr(method, "forward", method)).parameters
    except ValueError:  # a function in C without a signature
        return {}
    named = any(one.kind is one.VAR_KEYWORD for one in parameters.values())
    return {name: value for name, value in values.items() if named or name in parameters}


def _last(chain: Chain, name: str, data: Any, **_: Any) -> Estimate:
    estimates = [found for found in chain.trace(data).estimates.values() if name in found.value]
    if not estimates:
        raise MethodError(f"no stage of the chain {', '.join(chain.stages)} estimates {name}")
    return estimates[-1]


def _holds_arrays(out: Any) -> bool:
    return any(isinstance(part, np.ndarray) for part in (out if isinstance(out, tuple) else (out,)))


def _estimate(out: Any, name: str, x: Tensor, per_pulse: bool) -> Estimate:
    parts = out if isinstance(out, tuple) else (out,)
    for part in parts:
        if isinstance(part, Estimate):
            return part
    shape = tuple(x.shape[:2] if per_pulse else x.shape[:1])
    three = (*parts, None, None)[:3]
    try:
        value, std, ok = (None if part is None else torch.as_tensor(part).detach().cpu() for part in three)
    except (TypeError, ValueError, RuntimeError) as error:
        kinds = ", ".join(type(part).__name__ for part in three if part is not None)
        raise MethodError(f"a method must return {name} of shape {shape}, or (value, std, ok), got {kinds}") from error
    if value is None or value.shape[: len(shape)] != shape or (per_pulse and value.ndim > 2) or value.is_complex():
        got = type(out).__name__ if value is None else f"{value.dtype} of shape {tuple(value.shape)}"
        expected = f"real values {name} of shape {shape} for data {tuple(x.shape)}"
        raise MethodError(f"a method must return {expected}, got {got}")
    each = (*shape[:1], *(1,) * (value.ndim - 1))
    for what, part, shapes in (("std", std, (value.shape, each, ())), ("ok", ok, (shape[:1], ()))):
        if part is not None and (part.shape not in shapes or (part is std and part.dtype == torch.bool)):
            got = f"{part.dtype} of shape {tuple(part.shape)}"
            told = f"a method must return {what} of shape {tuple(shapes[0])}, got {got}"
            raise MethodError(f"{told}; the order is (value, std, ok), and std may be None")
    value = value.double()
    finite = torch.isfinite(value).reshape(len(value), -1).all(-1)
    good = torch.ones(len(value), dtype=torch.bool) if ok is None else ok.bool().expand(len(value))
    if not finite[good].all():
        told = f"{int((good & ~finite).sum())} of {len(value)} trials are sure of values that are NaN or Inf"
        raise MethodError(f"a method must return finite {name}, but {told}; return ok, False where it found nothing")
    if std is not None and (std < 0).any():
        raise MethodError(f"a method must return standard deviations of at least 0, got {float(std.min()):.3g}")
    code = Outcome.of(good, Outcome.UNSPECIFIED)
    code = torch.where(good, int(Outcome.NOT_ASSESSED), code) if ok is None else code
    table = {} if std is None else {name: std.double().expand(value.shape)}
    return Estimate({name: torch.nan_to_num(value, 0.0, 0.0, 0.0)}, table, outcome=code, quality=good.double())
