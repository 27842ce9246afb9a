"""Sentences about arguments of the wrong type, in place of errors from inside a constructor."""

from __future__ import annotations

import functools
import inspect
import numbers
import re
import traceback
from collections.abc import Callable, Iterable, Mapping, Sized
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from torchsar.core.host import is_out_of_memory

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
# annotations of several values, and what these are called
_SEVERAL = {"Sequence": "a sequence", "list": "a sequence", "tuple": "a sequence", "Mapping": "a mapping"}
# errors of Python and torch about values of other types than expected
_RAW = (TypeError, AttributeError, IndexError, RuntimeError, ValueError)


def names_arguments(cls: type[_Class]) -> type[_Class]:
    """Let the constructor of a class that fails name the argument whose type does not fit.

    Arguments are looked at only after an error that the code does not raise itself, so that
    whatever a constructor accepts stays accepted, and its own sentences stay. Annotations of
    numbers, words, tensors, sequences, mappings and classes are judged; tensors fit where numbers
    and sequences do.

    Args:
        cls: Class with an `__init__` of its own, such as a dataclass.

    Returns:
        The class. Its constructor raises TypeError with one sentence in place of an error of Python
        or torch if an argument does not fit its annotation.
    """
    init = cls.__init__

    @functools.wraps(init)
    def explained(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            init(self, *args, **kwargs)
        except _RAW as error:
            sentence = "" if _is_own(error) or is_out_of_memory(error) else _fault(init, self, *args, **kwargs)
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
    """What is wrong with the first argument that does not fit; empty if all may fit.

    Those that some constructors convert are named, all of them, only if there is no other one.
    """
    signature = inspect.signature(init)
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # one is missing or unknown, as the error of the call says
        return ""
    wrong, doubtful = [], []
    for name, value in given.items():
        parameter = signature.parameters[name]
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        # alternatives, without what stands in brackets
        kinds = [kind.strip() for kind in re.sub(r"\[.*?\]+", "", str(parameter.annotation)).split("|")]
        named = [kind for kind in kinds if kind not in _WORDS and kind not in _SEVERAL]
        classes = tuple(found for kind in named if (found := _class_of(kind, init.__globals__)))
        if len(classes) < len(named) or isinstance(value, classes) or _fits(value, kinds):
            continue
        words = {**{kind: _with_article(kind) for kind in named}, **_WORDS, **_SEVERAL}
        expected = " or ".join(dict.fromkeys(words[kind] for kind in kinds))
        sentence = f"{name} must be {expected}, got {' '.join(repr(value).split())[:60]}"
        (doubtful if _converts(value, kinds) else wrong).append(sentence)
    return wrong[0] if wrong else "; ".join(doubtful)


def _class_of(kind: str, known: Mapping[str, Any]) -> type | None:
    """The class that an annotation names, if `isinstance` can judge by it."""
    first, *rest = kind.split(".")
    found = functools.reduce(lambda x, name: getattr(x, name, None), rest, known.get(first))
    if found is Any or getattr(found, "_is_protocol", False):
        return None
    return found if inspect.isclass(found) else None


def _with_article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIO' or name.startswith('nn.') else 'a'} {name}"


def _fits(value: Any, kinds: list[str]) -> bool:
    """Whether a value may be of one of the kinds that have words."""
    if value is None or isinstance(value, str):
        return ("None" if value is None else "str") in kinds
    if isinstance(value, Mapping):
        return "Mapping" in kinds
    several, number = {"Sequence", "list", "tuple"}, {"int", "float", "bool"}
    if isinstance(value, (np.generic, np.ndarray, Tensor)):
        return bool({"Tensor", *several, *number} & set(kinds))
    if isinstance(value, (Sized, Iterable)):
        return bool(several & set(kinds))
    return isinstance(value, numbers.Real) and bool({"torch.device", *number} & set(kinds))


def _converts(value: Any, kinds: list[str]) -> bool:
    """Whether some code takes a value that is not of these kinds for one that is."""
    if isinstance(value, (numbers.Number, list, tuple)):
        return "Tensor" in kinds
    return callable(value) and "nn.Module" in kinds
