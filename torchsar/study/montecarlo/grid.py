"""The grid of a sweep: named parameters and their values, the points they span, and the address of
each.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchsar.study.settings.errors import ConfigError

# names of dims and parts of results
RESERVED = ("algorithm", "trial", "method", "ok", "done", "saved")
_LONGEST = 200  # bytes: file systems allow 255, and names of bounds and figures are longer


@dataclass(frozen=True)
class Parameter:
    """One dimension of a sweep.

    Args:
        name: Its name.
        labels: Numbers or words that name the values in results.
        values: The values that are passed to the trial.
        batched: Whether the trial gets the values as one tensor with an entry per row, so that one
            batch may hold several of them; otherwise each value is a case of its own.
    """

    name: str
    labels: tuple[float | str, ...]
    values: tuple[Any, ...]
    batched: bool = False


@dataclass(frozen=True)
class Point:
    """One point of the grid: index along every parameter, and the address of its random numbers."""

    index: tuple[int, ...]
    address: str


@dataclass(frozen=True)
class Case:
    """The points that may share a batch: they differ in batched parameters alone."""

    fixed: Mapping[str, Any]
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Grid:
    """The product of its parameters, the last one running fastest."""

    parameters: tuple[Parameter, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(p.labels) for p in self.parameters)

    @property
    def labels(self) -> dict[str, tuple[float | str, ...]]:
        return {p.name: p.labels for p in self.parameters}

    def points(self) -> list[Point]:
        """Every point; its address depends on its names and values alone."""
        return [
            Point(index, address({p.name: p.values[i] for p, i in zip(self.parameters, index)}))
            for index in itertools.product(*map(range, self.shape))
        ]

    def cases(self) -> list[Case]:
        """The points in groups of equal fixed parameters, in the order of the grid."""
        groups: dict[tuple[int, ...], list[Point]] = {}
        for point in self.points():
            groups.setdefault(tuple(i for p, i in zip(self.parameters, point.index) if not p.batched), []).append(point)
        fixed = [p for p in self.parameters if not p.batched]
        return [
            Case({p.name: p.values[i] for p, i in zip(fixed, key)}, tuple(points)) for key, points in groups.items()
        ]

    def labels_at(self, point: Point) -> dict[str, float | str]:
        """The labels of a point by parameter."""
        return {p.name: p.labels[i] for p, i in zip(self.parameters, point.index)}


def address(parameters: Mapping[str, Any]) -> str:
    """A hash of parameters by name: equal parameters give equal random numbers in every grid, in
    any order.
    """
    return hashlib.blake2b(canonical(parameters).encode(), digest_size=12).hexdigest()


def canonical(tree: Any) -> str:
    """One text for one content: keys sorted, 20 and 20.0 alike."""
    return json.dumps(_plain(tree), sort_keys=True, separators=(",", ":"))


def _plain(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    # beyond 2^53, a float would make neighbouring whole numbers alike
    if x is None or isinstance(x, (bool, str)) or (isinstance(x, int) and abs(x) > 2**53):
        return x
    if isinstance(x, (int, float)):
        return float(x) + 0.0  # the sum makes -0.0 and 0.0, which are equal, alike
    return _plain(x.tolist()) if hasattr(x, "tolist") else repr(x)


def make_grid(
    values: Mapping[str, Sequence[Any] | Mapping[str, Any]], batched: Sequence[str] = (), where: str = "grid"
) -> Grid:
    """A grid from the values of every parameter.

    Args:
        values: {name: values}, or {name: {label: value}} if they are neither numbers nor words.
        batched: Names whose values the trial gets as tensors with an entry per row.
        where: Beginning of error messages.

    Raises:
        ConfigError: If a parameter has no values, a value is given twice, a name is reserved, or a
            batched parameter is not a number.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must be a mapping of names to lists of values, got {values!r}")
    if isinstance(batched, str):
        raise ConfigError(f"{where}: batched must be a list of names, got {batched!r}; write [{batched!r}]")
    unknown = next((name for name in batched if name not in values), None)
    if unknown is not None:
        known = ", ".join(values) or "it has none"
        raise ConfigError(f"{where}: batched names {unknown!r}, which is not a parameter of the grid ({known})")
    return Grid(tuple(_parameter(name, given, name in batched, f"{where}: {name}") for name, given in values.items()))


def check_name(name: Any, taken: Sequence[str], where: str, kind: str) -> None:
    """Refuse a name under which the store could not keep an array: each is a folder of its own.

    Args:
        name: The name.
        taken: Names that are in use.
        where: Beginning of the error message.
        kind: What is named: a parameter, a metric or a bound.

    Raises:
        ConfigError: If the name is taken, not a word, or too long.
    """
    why = ""
    if name in taken:
        why = "which names a dimension or a part of the results; choose another name"
    elif not isinstance(name, str) or name in ("", ".", "..", "zarr.json") or re.search("^__|[/\0]", name):
        why = "since names are words without '/' that do not begin with '__'"
    elif len(name.encode()) > _LONGEST:
        why = f"since it has {len(name.encode())} bytes; use {_LONGEST} at most"
    if why:
        raise ConfigError(
            f"{where}: a {kind} cannot be called {name if not isinstance(name, str) else name[:40]!r}, {why}"
        )


def _bare(value: Any) -> Any:
    """A number of numpy or torch as Python's own."""
    return value.tolist() if hasattr(value, "tolist") and getattr(value, "ndim", 1) == 0 else value


def _parameter(name: str, given: Any, batched: bool, where: str) -> Parameter:
    check_name(name, RESERVED, where, "parameter")
    given = given.tolist() if not isinstance(given, Mapping) and hasattr(given, "tolist") else given
    if isinstance(given, (str, bytes)) or not isinstance(given, (Mapping, Sequence)):
        raise ConfigError(f"{where} must be a list of values or a mapping of labels to values, got {given!r}")
    values = tuple(map(_bare, given.values() if isinstance(given, Mapping) else given))
    labels = tuple(_label(label, where) for label in (given if isinstance(given, Mapping) else values))
    texts = tuple(map(canonical, values))
    nameless = next((value for value, text in zip(values, texts) if " at 0x" in text), None)
    twice = next((one for known in (labels, texts) for i, one in enumerate(known) if one in known[:i]), None)
    for wrong, text in (
        (not values, "has no values; give at least one"),
        (
            nameless is not None,
            f"holds {nameless!r}, whose text differs between processes, and random numbers depend on it; give numbers, "
            "words, lists, mappings or dataclasses",
        ),
        (twice is not None, f"holds {twice} twice; give each value once"),
        (
            len({isinstance(label, str) for label in labels}) > 1,
            "mixes numbers and words; name all of its values: {label: value, ...}",
        ),
        (
            batched and not all(map(_is_number, values)),
            f"becomes a tensor with an entry per trial, so its values must be finite numbers, got {list(values)}",
        ),
    ):
        if wrong:
            raise ConfigError(f"{where} {text}")
    return Parameter(name, labels, values, batched)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _label(value: Any, where: str) -> float | str:
    value = _bare(value)
    if _is_number(value):
        return float(value) + 0.0
    if isinstance(value, str):
        return value
    if value is None or isinstance(value, (bool, list, tuple)):
        return canonical(value)
    raise ConfigError(f"{where} holds the value {value!r}, which names nothing; write {{label: value, ...}}")
