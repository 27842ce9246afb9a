"""The door for methods of users: classes, modules, functions of torch and of numpy."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, Stage
from torchsar.study.bench.frame import samples
from torchsar.study.settings.errors import ConfigError


class MethodError(TypeError):
    """An error of a method of a user: what it returned, and what was expected."""


def loaded(place: str) -> Any:
    """Import `package.module:Name`, also from the working folder."""
    module, _, name = place.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"the method {place!r} cannot be imported: {error}; give package.module:Name") from error


def entrant(method: Any, name: str, per_pulse: bool = False) -> Callable[..., Estimate]:
    """Make a method one that takes the data of a world and returns an Estimate.

    A class is called without arguments. A stage is given the signal, and any other method the
    samples: a tensor, or an array if that is what it needs. It returns an Estimate, the value, or a
    tuple (value, std, ok), of which the last two may be left out or None.

    Args:
        method: Class, stage, module or function.
        name: Name of the value.
        per_pulse: Whether there is one value per pulse.

    Returns:
        The method.

    Raises:
        MethodError: If the method cannot be called; in a call, if it returns something else.
    """
    made = method() if isinstance(method, type) else method
    if not callable(made):
        raise MethodError(f"a method must be a class, module or function, got {type(made).__name__}")
    if isinstance(made, Stage):
        return made
    kinds: list[Callable[[Tensor], Any]] = [torch.Tensor.clone, lambda x: x.detach().cpu().numpy().copy()]

    def run(data: Any, **values: Any) -> Estimate:
        x = samples(data)
        try:
            out = made(kinds[0](x), **values)
        except Exception as first:
            if len(kinds) == 1:
                raise
            try:
                out = made(kinds[1](x), **values)
            except Exception:
                raise first from None
            del kinds[0]
        else:
            if len(kinds) > 1 and _holds_arrays(out):
                del kinds[0]
                out = made(kinds[0](x), **values)
        del kinds[1:]
        return _estimate(out, name, x, per_pulse)

    return run


def _holds_arrays(out: Any) -> bool:
    return any(isinstance(part, np.ndarray) for part in (out if isinstance(out, tuple) else (out,)))


def _estimate(out: Any, name: str, x: Tensor, per_pulse: bool) -> Estimate:
    parts = out if isinstance(out, tuple) else (out,)
    for part in parts:
        if isinstance(part, Estimate):
            return part
    three = (*parts, None, None)[:3]
    value, std, ok = (None if part is None else torch.as_tensor(part).detach().cpu() for part in three)
    shape = tuple(x.shape[:2] if per_pulse else x.shape[:1])
    if value is None or value.shape[: len(shape)] != shape or (per_pulse and value.ndim > 2) or value.is_complex():
        got = type(out).__name__ if value is None else f"{value.dtype} of shape {tuple(value.shape)}"
        expected = f"real values {name} of shape {shape} for data {tuple(x.shape)}"
        raise MethodError(f"a method must return {expected}, got {got}")
    value = value.double()
    finite = torch.isfinite(value).reshape(len(value), -1).all(-1)
    good = finite if ok is None else finite & ok.bool()
    code = Outcome.of(good, Outcome.UNSPECIFIED)
    code = torch.where(good, int(Outcome.NOT_ASSESSED), code) if ok is None else code
    table = {} if std is None else {name: std.double().expand(value.shape)}
    return Estimate({name: torch.nan_to_num(value, 0.0, 0.0, 0.0)}, table, outcome=code, quality=good.double())
