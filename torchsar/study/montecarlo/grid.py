"""The grid of a sweep: named parameters and their values, the points they span, and the address of
each.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchsar.study.settings.errors import ConfigError

RESERVED = ("algorithm", "trial", "method", "ok", "done", "saved")
_LONGEST = 200  # bytes: file systems end at 255, and bounds and figures add words


@dataclass(frozen=True)
class Parameter:
    """One dimension of a sweep.

    labels: numbers or words that name the values in results; values: what the trial is given.

    batched: the values reach the trial as one tensor with an entry per row, so that one batch may
    hold several of them; others are given as they are, and each of their values is a case of its
    own.
    """

    name: str
    labels: tuple[float | str, ...]
    values: tuple[Any, ...]
    batched: bool = False


@dataclass(frozen=True)
class Point:
    """One place of the grid: index along every parameter, and the address of its random numbers."""

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
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def labels(self) -> dict[str, tuple[float | str, ...]]:
        return {p.name: p.labels for p in self.parameters}

    def points(self) -> list[Point]:
        """Every point, each with an address made of names and values alone: it stays when the grid
        grows.
        """
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
        """What a point is called, by parameter."""
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
    if isinstance(x, bool) or x is None or isinstance(x, str):
        return x
    if isinstance(x, int) and abs(x) > 2**53:  # beyond this, a float would make neighbours alike
        return x
    if isinstance(x, (int, float)):
        return float(x) + 0.0  # the sum makes -0.0 and 0.0, which are equal, alike
    return _plain(x.tolist()) if hasattr(x, "tolist") else repr(x)


def make_grid(
    values: Mapping[str, Sequence[Any] | Mapping[str, Any]], batched: Sequence[str] = (), where: str = "grid"
) -> Grid:
    """A grid from {name: values}; a mapping {label: value} names values that are no numbers or
    words themselves.

    batched: names whose values reach the trial as per-row tensors. Raises ConfigError for a
    parameter without values, a value given twice, a reserved name, or a batched parameter that is
    no number.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must be a mapping of names to lists of values, got {values!r}")
    if isinstance(batched, str):
        raise ConfigError(f"{where}: batched must be a list of names, got {batched!r}; write [{batched!r}]")
    unknown = [name for name in batched if name not in values]
    if unknown:
        raise ConfigError(
            f"{where}: batched names {unknown[0]!r}, which is no parameter of the grid "
            f"({', '.join(values) or 'it has none'})"
        )
    return Grid(tuple(_parameter(name, given, name in batched, f"{where}: {name}") for name, given in values.items()))


def check_name(name: Any, taken: Sequence[str], where: str, kind: str) -> None:
    """Raise ConfigError for a name under which the store could not keep an array: each is a folder
    of its own.
    """
    if name in taken:
        raise ConfigError(
            f"{where}: a {kind} cannot be called {name!r}, which names a dimension or a part of "
            "the results; choose another name"
        )
    if (
        not isinstance(name, str)
        or not name
        or "/" in name
        or "\0" in name
        or name in (".", "..", "zarr.json")
        or name.startswith("__")
    ):
        raise ConfigError(
            f"{where}: a {kind} cannot be called {name!r}; its name is a word without '/' that does not begin with '__'"
        )
    if len(name.encode()) > _LONGEST:
        raise ConfigError(
            f"{where}: the name of the {kind} {name[:40]!r}... has {len(name.encode())} bytes; use {_LONGEST} at most"
        )


def _pairs(given: Any, where: str) -> list[tuple[float | str, Any]]:
    """Labels and values, numpy's and torch's numbers as Python's own."""
    if not isinstance(given, Mapping) and hasattr(given, "tolist"):
        given = given.tolist()
    if isinstance(given, (str, bytes)) or not isinstance(given, (Mapping, Sequence)):
        raise ConfigError(f"{where} must be a list of values or a mapping of labels to values, got {given!r}")
    if isinstance(given, Mapping):
        return [(_label(label, where), _bare(value)) for label, value in given.items()]
    return [(_label(_bare(value), where), _bare(value)) for value in given]


def _bare(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") and getattr(value, "ndim", 1) == 0 else value


def _parameter(name: str, given: Any, batched: bool, where: str) -> Parameter:
    check_name(name, RESERVED, where, "parameter")
    pairs = _pairs(given, where)
    if not pairs:
        raise ConfigError(f"{where} has no values; give at least one")
    labels, values = tuple(label for label, _ in pairs), tuple(value for _, value in pairs)
    nameless = next((value for value in values if " at 0x" in canonical(value)), None)
    if nameless is not None:
        raise ConfigError(
            f"{where} holds {nameless!r}, whose text is another in every process, and random "
            "numbers follow it; give numbers, words, lists, mappings or dataclasses"
        )
    for known in (labels, tuple(map(canonical, values))):
        twice = next((label for i, label in enumerate(known) if label in known[:i]), None)
        if twice is not None:
            raise ConfigError(f"{where} holds {twice} twice; give each value once")
    if len({isinstance(label, str) for label in labels}) > 1:
        raise ConfigError(f"{where} mixes numbers and words; name all of its values: {{label: value, ...}}")
    if batched and not all(_is_number(v) for v in values):
        raise ConfigError(
            f"{where} becomes a tensor with an entry per trial, so its values must be finite "
            f"numbers, got {list(values)}"
        )
    return Parameter(name, labels, values, batched)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _label(value: Any, where: str) -> float | str:
    if isinstance(value, str):
        return value
    if _is_number(value):
        return float(value) + 0.0
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, (list, tuple)):
        return canonical(value)
    raise ConfigError(f"{where} holds the value {value!r}, which names nothing; write {{label: value, ...}}")
