"""Sentences about arguments of the wrong type, in place of errors from inside a constructor."""

from __future__ import annotations

import functools
import inspect
import numbers
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

    Arguments are looked at only after an error, so that whatever a constructor accepts stays
    accepted. Annotations of other types than numbers, words and tensors are not judged.

    Args:
        cls: Class with an `__init__` of its own, such as a dataclass.

    Returns:
        The class. Its constructor raises TypeError with one sentence if an argument does not fit
        its annotation, else the error itself.
    """
    init, signature = cls.__init__, inspect.signature(cls.__init__)

    @functools.wraps(init)
    def explained(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            init(self, *args, **kwargs)
        except _RAW as error:
            sentence = _fault(signature, self, *args, **kwargs)
            if sentence:
                raise TypeError(f"{type(self).__name__}: {sentence}") from error
            raise

    cls.__init__ = explained
    return cls


def _fault(signature: inspect.Signature, *args: Any, **kwargs: Any) -> str:
    """What is wrong with the first argument that does not fit; empty if all do."""
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # one is missing or unknown, as the error of the call says
        return ""
    for name, value in given.items():
        kinds = [kind.strip() for kind in str(signature.parameters[name].annotation).split("|")]
        if set(kinds) <= _WORDS.keys() and not _fits(value, kinds):
            expected = " or ".join(_WORDS[kind] for kind in kinds)
            return f"{name} must be {expected}, got {repr(value)[:60]}"
    return ""


def _fits(value: Any, kinds: list[str]) -> bool:
    """Whether a value may be of one of the kinds."""
    if value is None or isinstance(value, str):
        return ("None" if value is None else "str") in kinds
    if isinstance(value, numbers.Number):
        return bool({"int", "float", "bool", "Tensor"} & set(kinds))
    if isinstance(value, (Tensor, np.ndarray, list, tuple)):
        return "Tensor" in kinds or (isinstance(value, (Tensor, np.ndarray)) and "float" in kinds)
    return False
