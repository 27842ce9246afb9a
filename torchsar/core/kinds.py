"""Refusal of arguments that are not of the kind that the annotation of their parameter names."""

from __future__ import annotations

import functools
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core.show import argument

_UNFIT = object()
_UNIONS = (typing.Union, types.UnionType)


def check_kinds(members: Iterable[Any]) -> dict[str, Any]:
    """Let dataclasses and functions refuse arguments of another kind than their annotations name.

    A parameter is examined if its annotation names a class or a protocol of this package, `bool`,
    or a tuple of a fixed length. Where a sequence of such objects is expected, a single one is
    accepted.

    Args:
        members: Members of a package. Classes are changed in place.

    Returns:
        The functions that examine their arguments, by name, to replace those of the package. They
        have replaced those of the modules in which they are defined.
    """
    replaced = {}
    for one in members:
        if is_dataclass(one) and isinstance(one, type) and "__init__" in vars(one):
            one.__init__ = _examining(one.__init__)
        elif isinstance(one, types.FunctionType) and _examined(one):
            replaced[one.__name__] = _examining(one)
            setattr(sys.modules[one.__module__], one.__name__, replaced[one.__name__])
    return replaced


def fitted(function: Callable[..., Any], owner: str, args: tuple, given: dict[str, Any]) -> tuple[tuple, dict]:
    """Return the arguments of a call after a check of their kinds.

    Args:
        function: Function or constructor that is called.
        owner: Its name for messages.
        args: Positional arguments.
        given: Arguments by name.

    Returns:
        Positional arguments and those by name; a single object is a tuple where a sequence of such
        objects is expected.

    Raises:
        TypeError: If an argument is of another kind than its annotation names.
    """
    kinds = _examined(function)
    if not kinds or torch.compiler.is_dynamo_compiling():
        return args, given

    def fit(name: str, value: Any) -> Any:
        form = _fitted(value, kinds[name]) if name in kinds else value
        if form is _UNFIT:
            got = f"the class {value.__name__}, not an object of it" if isinstance(value, type) else argument(value)
            others = " or ".join(_others(function, name, value))
            hint = "; pass its signal: recording.signal" if hasattr(value, "signal") else others and f"; use {others}"
            raise TypeError(f"{owner}: {name} must be {_words(kinds[name])}, got {got}{hint}")
        return form

    names = list(inspect.signature(function).parameters)
    return tuple(map(fit, names, args)) + args[len(names) :], {name: fit(name, value) for name, value in given.items()}


def _others(function: Callable[..., Any], name: str, value: Any) -> Iterator[str]:
    """Names of the functions of the same package that begin with the same word and accept a value
    as this parameter.
    """
    package = _package(function)
    for other in getattr(package, "__all__", ()):
        if other.partition("_")[0] == function.__name__.partition("_")[0]:
            kind = _examined(getattr(package, other)).get(name)
            if kind is not None and _fitted(value, kind) is not _UNFIT:
                yield other


def _package(of: Any) -> types.ModuleType:
    """Package of the room in which a class or a function is defined."""
    return sys.modules[".".join(of.__module__.split(".")[:2])]


def _examining(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def examining(*args: Any, **given: Any) -> Any:
        constructs = function.__name__ == "__init__"
        args, given = fitted(function, type(args[0]).__name__ if constructs else function.__name__, args, given)
        return function(*args, **given)

    return examining


@functools.cache
def _examined(function: Callable[..., Any]) -> dict[str, Any]:
    """Annotations, by parameter, of those that are examined."""
    try:
        hints = typing.get_type_hints(function)
    except NameError:  # of a class of a user, whose annotations name what is defined later
        return {}
    return {name: hint for name, hint in hints.items() if name != "return" and not _accepts_all(hint)}


def _accepts_all(hint: Any) -> bool:
    """True for a hint that is not examined."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in _UNIONS:
        return any(_accepts_all(one) for one in inner if one is not types.NoneType)
    if origin is Mapping:
        return _accepts_all(inner[1])
    if origin in (Sequence, tuple, list):
        numbers = {*(typing.get_args(inner[0]) or inner[:1])} <= {float, int, Tensor}
        return not numbers and (len(inner) == 1 or Ellipsis in inner) and _accepts_all(inner[0])
    return hint is not bool and not (isinstance(hint, type) and hint.__module__.startswith("torchsar."))


def _fitted(value: Any, hint: Any) -> Any:
    """An argument converted to the type of its annotation `hint`, or `_UNFIT` if it has no such
    form.
    """
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in _UNIONS:
        return next((form for one in inner if (form := _fitted(value, one)) is not _UNFIT), _UNFIT)
    if hint is types.NoneType:
        return value if value is None else _UNFIT
    if _accepts_all(hint):
        return value
    if origin is Mapping:
        fits = isinstance(value, Mapping) and all(_fitted(part, inner[1]) is not _UNFIT for part in value.values())
    elif origin is None:
        fits = isinstance(value, bool | np.bool_) if hint is bool else _is_one(value, hint)
    elif not hasattr(value, "__len__") or not getattr(value, "ndim", 1) or isinstance(value, str | Mapping):
        form = _UNFIT if _accepts_all(inner[0]) else _fitted(value, inner[0])
        return _UNFIT if form is _UNFIT else (form,)
    elif origin is tuple and Ellipsis not in inner:
        fits = len(value) == len(inner)
    else:
        fits = _accepts_all(inner[0]) or all(_fitted(part, inner[0]) is not _UNFIT for part in value)
    return value if fits else _UNFIT


def _declared(kind: type) -> dict[str, Any]:
    """Public methods of a protocol; none of another class."""
    protocols = [base for base in kind.__mro__ if getattr(base, "_is_protocol", False)]
    parts = [item for base in protocols for item in vars(base).items()] if kind in protocols else []
    return {
        name: part
        for name, part in parts
        if isinstance(part, types.FunctionType) and name not in ("__init__", "__subclasshook__")
    }


def _is_one(value: Any, kind: type) -> bool:
    """True for an object of a class, or with all methods of a protocol."""
    declared = _declared(kind)
    has = (
        callable(getattr(value, name, None)) and getattr(type(value), name, None) is not method
        for name, method in declared.items()
    )
    return not isinstance(value, type) and (all(has) if declared else isinstance(value, kind))


def _words(hint: Any) -> str:
    """What a hint accepts, in words."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in _UNIONS:
        return " or ".join(map(_words, inner))
    if hint in (types.NoneType, bool):
        return "None" if hint is types.NoneType else "True or False"
    if origin is Mapping:
        return f"a mapping, such as {{'first': x}}, with x {_words(inner[1])}"
    if origin is tuple and Ellipsis not in inner:
        return "a pair" if len(inner) == 2 else f"{len(inner)} values"
    if origin is not None:
        return f"a list of {'numbers' if _accepts_all(inner[0]) else _words(inner[0])}"
    made = " or ".join([f"{one.__name__}({', '.join(_parameters(one))})" for one in _concrete(hint)][:3])
    methods = " and ".join(f"{name}({', '.join(_parameters(part)[1:])})" for name, part in _declared(hint).items())
    return f"an object with {methods}{made and f', such as {made}'}" if methods else made


def _concrete(kind: type) -> Iterator[type]:
    """A public class, or the public ones that follow a protocol or another base."""
    if kind.__name__ in getattr(_package(kind), "__all__", ()) and not _declared(kind):
        yield kind
    else:
        for one in kind.__subclasses__():
            yield from _concrete(one)


def _parameters(function: Callable[..., Any]) -> list[str]:
    """Names of the parameters without a default."""
    return [p.name for p in inspect.signature(function).parameters.values() if p.default is p.empty]
