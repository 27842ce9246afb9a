"""Constructors name the argument whose type does not fit."""

from __future__ import annotations

import inspect
import pickle
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsar import compensate, core, echo, focus, metrics, multichannel, optim, radar, repair, scene
from torchsar.core.arguments import names_arguments

FACES = (compensate, core, echo, focus, metrics, multichannel, optim, radar, repair, scene)
NUMBERS = {"int", "float", "float | None", "int | None", "Tensor | float", "Tensor | float | None"}


def constructors() -> Iterator[tuple[type, dict[str, object], str]]:
    """Public classes that can be made of ones, these arguments, and the name of one more number."""
    for face in FACES:
        for name in face.__all__:
            cls = getattr(face, name)
            if not inspect.isclass(cls):
                continue
            parameters = inspect.signature(cls).parameters.values()
            needed = {p.name: 1.0 for p in parameters if p.default is p.empty and p.kind is not p.VAR_POSITIONAL}
            try:
                cls(**needed)
            except Exception:
                continue
            for p in parameters:
                if str(p.annotation) in NUMBERS:
                    yield cls, needed, p.name


RAW = re.compile(
    r"not supported between|unsupported operand|must be real number|bad operand|has no attribute|not iterable"
    r"|not subscriptable|has no len|not callable|could not convert|cannot unpack"
)
# an alias of numbers and sequences, and a protocol
NOT_JUDGED = {"GroundMovers", "MovingPoints", "EffectiveVelocity"}


@pytest.mark.parametrize("value", ["abc", 3, object(), None, []], ids=["word", "number", "object", "None", "sequence"])
def test_no_constructor_fails_with_an_error_of_python(value: object) -> None:
    """Every required argument is of the wrong type."""
    wrong, refused = [], 0
    for cls in (getattr(face, name) for face in FACES for name in face.__all__):
        if not inspect.isclass(cls) or cls.__name__ in NOT_JUDGED:
            continue
        parameters = inspect.signature(cls).parameters.values()
        needed = [p.name for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
        try:
            cls(**dict.fromkeys(needed, value))
        except Exception as error:
            refused += 1
            if RAW.search(str(error)):
                wrong.append(f"{cls.__name__}: {error}")
    assert not wrong and refused > 40, wrong


@pytest.mark.parametrize("value", ["abc", {}, object()], ids=["word", "mapping", "object"])
def test_no_constructor_fails_with_an_error_of_python_about_a_number(value: object) -> None:
    wrong, tried = [], 0
    for cls, needed, name in constructors():
        tried += 1
        try:
            cls(**{**needed, name: value})
        except Exception as error:
            if RAW.search(str(error)):
                wrong.append(f"{cls.__name__}({name}): {error}")
    assert not wrong and tried > 200, wrong


@names_arguments
@dataclass(frozen=True)
class Limits:
    """Two limits in order."""

    low: float
    high: float | None = None
    words: tuple[str, ...] = ()
    scale: Limits | None = None

    def __post_init__(self) -> None:
        if self.high is not None and not self.low < self.high:
            raise ValueError("low must be below high")
        "".join(self.words)
        if self.scale is not None and self.scale.low > self.low:
            raise ValueError("scale must be below low")


def test_the_argument_is_named_only_if_it_is_the_cause() -> None:
    with pytest.raises(TypeError, match=r"^Limits: low must be a number, got 'a'$"):
        Limits("a", 2.0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"^Limits: high must be a number or None, got \[\]$"):
        Limits(1.0, high=[])  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"^Limits: words must be a sequence, got 3$"):
        Limits(1.0, words=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"^Limits: scale must be a Limits or None, got \[2\]$"):
        Limits(1.0, scale=[2])  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"expected str instance"):
        Limits(1.0, words=range(3))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="low must be below high"):
        Limits(2.0, 1.0)
    with pytest.raises(TypeError, match="missing 1 required"):
        Limits()  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match="expected str instance"):
        Limits(1.0, 2.0, (3,))  # pyright: ignore[reportArgumentType]
    assert Limits(None).low is None  # pyright: ignore[reportArgumentType]


@names_arguments
@dataclass
class Tables:
    """Tables, the first of which may be a list."""

    first: Tensor
    second: Tensor
    limits: Limits | None = None
    content: Any = None

    def __post_init__(self) -> None:
        self.first = torch.as_tensor(self.first)
        assert self.second.ndim and (self.limits is None or self.limits.low)


def test_arguments_that_may_be_converted_are_named_only_without_others() -> None:
    said = r"^Tables: first must be a tensor, got \[1\]; second must be a tensor, got 3$"
    with pytest.raises(TypeError, match=said):
        Tables([1], 3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"^Tables: limits must be a Limits or None, got 'x'$"):
        Tables([1], torch.ones(1), "x", content=3)  # pyright: ignore[reportArgumentType]
    assert Tables([1], torch.ones(1)).first.tolist() == [1]  # pyright: ignore[reportArgumentType]


def test_own_sentences_and_what_numbers_may_be_stay() -> None:
    @names_arguments
    @dataclass
    class Own:
        gain: float = 1.0
        count: int = 1
        rest: tuple[int, ...] = ()

        def __post_init__(self) -> None:
            if self.count > 3:
                raise TypeError("count must be at most 3")
            sum(self.rest)

    with pytest.raises(TypeError, match="^count must be at most 3$"):
        Own(None, 5)  # pyright: ignore[reportArgumentType]
    for number in (np.float32(2), np.bool_(True), torch.tensor(2), True):
        with pytest.raises(TypeError, match=r"unsupported operand type\(s\) for \+"):
            Own(number, number, ("a",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"^Own: gain must be a number, got 1j$"):
        Own(1j, 1, 3)  # pyright: ignore[reportArgumentType]


def test_a_compiled_function_may_make_one() -> None:
    compiled = torch.compile(lambda x: Limits(x.numel(), 9.0).low * x, fullgraph=True, backend="eager")
    assert compiled(torch.ones(2)).tolist() == [2, 2]


def test_signature_equality_and_copies_stay() -> None:
    assert list(inspect.signature(Limits).parameters) == ["low", "high", "words", "scale"]
    assert pickle.loads(pickle.dumps(Limits(1.0, 2.0))) == Limits(1.0, 2.0)
    assert str(inspect.signature(repair.DropInterference)).startswith("(threshold: ")
