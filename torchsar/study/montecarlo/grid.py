"""The grid of a sweep: named parameters with their values, and the points, which are the
combinations of these values.

Each point has an address, a hash of its parameters, from which its random numbers follow.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchsar.io.seal import address, canonical
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.text import fault_of_name

# names that dimensions and parts of results already have
RESERVED = ("algorithm", "trial", "method", "ok", "outcome", "done", "saved")
# Largest length of a name in bytes; file systems allow 255. The margin is needed because names of
# bounds and figures are longer than those of metrics.
_LONGEST = 200


@dataclass(frozen=True)
class Parameter:
    """One parameter of a sweep with its values, which are one dimension of the grid.

    Args:
        name: Name of the parameter.
        labels: Numbers or words that name the values in results.
        values: The values that are passed to the trial function.
        batched: True if the trial function gets the values as a tensor with one entry per trial of
            a batch, so that a batch may hold several values. Otherwise all trials of a batch have
            the same value.
    """

    name: str
    labels: tuple[float | str, ...]
    values: tuple[Any, ...]
    batched: bool = False


@dataclass(frozen=True)
class Point:
    """One point of the grid: its index along every parameter, and the hash of its parameters, from
    which its random numbers follow.
    """

    index: tuple[int, ...]
    address: str


@dataclass(frozen=True)
class Case:
    """Points of the grid whose trials may be in one batch, because only their batched parameters
    differ.
    """

    fixed: Mapping[str, Any]
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Grid:
    """All combinations of the values of the parameters; the last parameter runs fastest."""

    parameters: tuple[Parameter, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(p.labels) for p in self.parameters)

    @property
    def labels(self) -> dict[str, tuple[float | str, ...]]:
        return {p.name: p.labels for p in self.parameters}

    def points(self) -> list[Point]:
        """Return every point. Its address depends only on names and values of its parameters."""
        return [
            Point(index, address({p.name: p.values[i] for p, i in zip(self.parameters, index)}))
            for index in itertools.product(*map(range, self.shape))
        ]

    def cases(self) -> list[Case]:
        """Return the points in groups with equal values of all parameters that are not batched."""
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


def make_grid(
    values: Mapping[str, Sequence[Any] | Mapping[str, Any]], batched: Sequence[str] = (), where: str = "grid"
) -> Grid:
    """Return the grid of all combinations of the values of some parameters.

    Args:
        values: {name: values}, or {name: {label: value}} for values that are neither numbers nor
            words.
        batched: Names of the parameters whose values the trial function gets as tensors with one
            entry per trial of a batch.
        where: Beginning of error messages.

    Raises:
        ConfigError: If a parameter has no values, a value is given twice, a name is reserved, or a
            value of a batched parameter is not a number.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must be a mapping of names to lists of values, got {values!r}")
    if isinstance(batched, str) or not isinstance(batched, Iterable):
        right = [batched] if isinstance(batched, str) else []
        raise ConfigError(f"{where}: batched must be a list of names, got {batched!r}; write {right}")
    unknown = next((name for name in batched if name not in [*values]), None)
    if unknown is not None:
        known = ", ".join(values) or "none"
        raise ConfigError(
            f"{where}: batched lists {unknown!r}, which is not a parameter of the grid (parameters: {known})"
        )
    return Grid(tuple(_parameter(name, given, name in batched, f"{where}: {name}") for name, given in values.items()))


def check_name(name: Any, taken: Sequence[str], where: str, kind: str) -> None:
    """Check that an array of this name can be kept in the store, where each array is a folder.

    Args:
        name: The name.
        taken: Names that are in use.
        where: Beginning of the error message.
        kind: What is named: a parameter, a metric or a bound.

    Raises:
        ConfigError: If the name is taken, not a word, or too long.
    """
    why = fault_of_name(name, _LONGEST)
    if name in taken:
        why = "which names a dimension or a part of the results; choose another name"
    if why:
        raise ConfigError(
            f"{where}: a {kind} cannot be called {name if not isinstance(name, str) else name[:40]!r}, {why}"
        )


def _bare(value: Any) -> Any:
    """Convert a number of numpy or torch to one of Python."""
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
            f"holds {nameless!r}, whose repr() differs between processes, so that random numbers would differ as well; "
            "give numbers, words, lists, mappings or dataclasses",
        ),
        (twice is not None, f"holds {twice} twice; give each value once"),
        (
            len({isinstance(label, str) for label in labels}) > 1,
            "mixes numbers and words; give every value a label of one kind: {label: value, ...}",
        ),
        (
            batched and not all(map(_is_number, values)),
            f"is passed as a tensor with one entry per trial, so its values must be finite numbers, got {list(values)}",
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
    raise ConfigError(
        f"{where} holds the value {value!r}, which cannot be a label of results; write {{label: value, ...}}"
    )
