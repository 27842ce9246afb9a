"""Sentences about arguments of the wrong type, in place of errors from inside a constructor."""

from __future__ import annotations

import functools
import inspect
import numbers
import traceback
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

_Class = TypeVar("_Class")
# types that annotations name, and what they are called
_WORDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "True or False",
    "str": "a word",
    "Tensor": "a tensor",
    "None": "None",
}
# errors of Python and torch about values of other types than expected
_RAW = (TypeError, AttributeError, IndexError, RuntimeError)


def names_arguments(cls: type[_Class]) -> type[_Class]:
    """Let the constructor of a class that fails name the argument whose type does not fit.

    Arguments are looked at only after an error that the code does not raise itself, so that
    whatever a constructor accepts stays accepted, and its own sentences stay. Only annotations of
    numbers, words and tensors are judged, as texts; tensors fit where numbers do.

    Args:
        cls: Class with an `__init__` of its own, such as a dataclass.

    Returns:
        The class. Its constructor raises TypeError with one sentence in place of a TypeError,
        AttributeError, IndexError or RuntimeError if an argument does not fit its annotation.
    """
    init = cls.__init__

    @functools.wraps(init)
    def explained(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            init(self, *args, **kwargs)
        except _RAW as error:
            sentence = "" if _is_own(error) else _fault(init, self, *args, **kwargs)
            if sentence:
                raise TypeError(f"{type(self).__name__}: {sentence}") from error
            raise

    cls.__init__ = explained
    return cls


def _is_own(error: Exception) -> bool:
    """Whether an error comes from a statement `raise`."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return (last.line or "").startswith("raise ")


def _fault(init: Callable[..., None], *args: Any, **kwargs: Any) -> str:
    """What is wrong with the first argument that does not fit; empty if all do."""
    signature = inspect.signature(init)
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # one is missing or unknown, as the error of the call says
        return ""
    for name, value in given.items():
        parameter = signature.parameters[name]
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        kinds = [kind.strip() for kind in str(parameter.annotation).split("|")]
        if set(kinds) <= _WORDS.keys() and not _fits(value, kinds):
            expected = " or ".join(_WORDS[kind] for kind in kinds)
            return f"{name} must be {expected}, got {' '.join(repr(value).split())[:60]}"
    return ""


def _fits(value: Any, kinds: list[str]) -> bool:
    """Whether a value may be of one of the kinds."""
    if value is None or isinstance(value, str):
        return ("None" if value is None else "str") in kinds
    if isinstance(value, (list, tuple, complex)):
        return "Tensor" in kinds
    number = isinstance(value, (numbers.Number, np.generic, np.ndarray, Tensor))
    return number and bool({"int", "float", "bool", "Tensor"} & set(kinds))
