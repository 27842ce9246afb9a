"""One chunk of a sweep, computed: rows in, plain arrays out. Runs in this process or in a
worker.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.study.montecarlo.grid import Case
from torchsar.study.montecarlo.record import OK
from torchsar.study.settings.errors import ConfigError

Trial = Callable[[Mapping[str, Any], Draws], Mapping[str, Any]]
BOUNDS, SAVED = "bounds", "saved"


class TrialError(ConfigError):
    """A trial function failed; the text says where, the cause what."""


@dataclass(frozen=True)
class Chunk:
    """Rows that run as one batch: a case, and for every row the place of its point in the case and
    its trial number.
    """

    case: int
    points: tuple[int, ...]
    trials: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.trials)

    def pieces(self, rows: int) -> Iterator[Chunk]:
        """The same rows in as few and as equal pieces of at most `rows` as there can be."""
        count = -(-len(self) // rows)
        edges = [round(i * len(self) / count) for i in range(count + 1)]
        for first, last in pairwise(edges):
            yield Chunk(self.case, self.points[first:last], self.trials[first:last])


@dataclass
class Outcome:
    """What a chunk gave.

    values: algorithm -> metric -> (rows,); bounds: metric -> name -> (rows,); saved: row ->
    "algorithm.name" -> array.

    fits: the largest batch that the memory was found to hold, None where nothing was too large.
    """

    values: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    bounds: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    saved: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)
    seconds: float = 0.0
    fits: int | None = None


@dataclass(frozen=True)
class Work:
    """All that a process needs in order to compute chunks."""

    trial: Trial
    cases: tuple[Case, ...]
    batched: Mapping[str, tuple[float, ...]]
    names: tuple[str, ...]
    seed: int
    device: str = "cpu"
    save: frozenset[int] = frozenset()

    def compute(self, chunk: Chunk, fits: int | None = None) -> Outcome:
        """Run a chunk, in batches of at most `fits` rows; one that runs out of memory is halved,
        and so are those after it.
        """
        began, first_fits = time.perf_counter(), fits
        waiting, parts = [chunk], []
        while waiting:
            piece = waiting.pop(0)
            if fits is not None and len(piece) > fits:
                waiting = [*piece.pieces(fits), *waiting]
                continue
            outcome = self._attempt(piece)
            if outcome is None:
                fits, waiting = -(-len(piece) // 2), [piece, *waiting]
            else:
                parts.append((piece, outcome))
        whole = _joined(parts)
        whole.seconds, whole.fits = time.perf_counter() - began, fits if fits != first_fits else None
        return whole

    def _attempt(self, chunk: Chunk) -> Outcome | None:
        """The outcome of a batch, None where it does not fit into memory."""
        try:
            return self._once(chunk)
        except Exception as error:
            if not _out_of_memory(error):
                raise TrialError(
                    f"{self._where(chunk)}: {type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"
                ) from error
        if len(chunk) == 1:
            raise TrialError(
                f"{self._where(chunk)}: a single trial does not fit into the memory of {self.device}; "
                "make the scene smaller"
            )
        if self.device != "cpu":
            torch.cuda.empty_cache()
        return None

    def _where(self, chunk: Chunk) -> str:
        points = ", ".join(f"{k}={v}" for k, v in self.cases[chunk.case].fixed.items())
        return (
            f"the trial function failed in trials {min(chunk.trials)} to "
            f"{max(chunk.trials)}{' of ' + points if points else ''}"
        )

    def parameters(self, chunk: Chunk) -> dict[str, Any]:
        """What the trial function is given: fixed values as they are, batched ones as float64
        tensors (rows,).
        """
        case = self.cases[chunk.case]
        given: dict[str, Any] = dict(case.fixed)
        for name, values in self.batched.items():
            dim = self.names.index(name)
            given[name] = torch.tensor(
                [values[case.points[p].index[dim]] for p in chunk.points], dtype=torch.float64, device=self.device
            )
        return {name: given[name] for name in self.names}

    def draws(self, chunk: Chunk) -> Draws:
        """Random numbers of every row at its own address."""
        points = self.cases[chunk.case].points
        return Draws(self.seed, tuple(points[p].address for p in chunk.points), list(chunk.trials))

    def _once(self, chunk: Chunk) -> Outcome:
        given = self.trial(self.parameters(chunk), self.draws(chunk))
        if not isinstance(given, Mapping):
            raise ValueError(
                f"a trial function returns {{metric: tensor}} or {{algorithm: {{metric: tensor}}}}, "
                f"got {type(given).__name__}"
            )
        found = dict(given)
        bounds, saved = found.pop(BOUNDS, {}), found.pop(SAVED, {})
        nested = {name: value for name, value in found.items() if isinstance(value, Mapping)}
        if nested and len(nested) != len(found):
            raise ValueError(
                "a trial function returns tensors by metric, or a mapping of metrics by algorithm, "
                f"not both; got {list(found)}"
            )
        if not (any(nested.values()) if nested else found):
            raise ValueError("a trial function gives at least one metric, and this one gave none")
        for name, tree in ((BOUNDS, bounds), (SAVED, saved)):
            if not isinstance(tree, Mapping) or not all(isinstance(named, Mapping) for named in tree.values()):
                raise ValueError(
                    f"{name!r} must be a mapping of mappings, "
                    f"{'{metric: {name: tensor}}' if name == BOUNDS else '{algorithm: {name: tensor}}'}"
                )
        outcome = Outcome()
        for algorithm, metrics in (nested or {_name(self.trial): found}).items():
            outcome.values[algorithm] = {
                metric: _rows(value, len(chunk), f"{algorithm}.{metric}") for metric, value in metrics.items()
            }
        outcome.bounds = {
            metric: {name: _rows(v, len(chunk), f"bounds.{metric}.{name}") for name, v in named.items()}
            for metric, named in bounds.items()
        }
        for row in (i for i, trial in enumerate(chunk.trials) if trial in self.save):
            outcome.saved[row] = {
                f"{algorithm}.{name}": _array(value, row, len(chunk), f"{SAVED}.{algorithm}.{name}")
                for algorithm, named in saved.items()
                for name, value in named.items()
            }
        return outcome


def _name(trial: Trial) -> str:
    name = getattr(trial, "__name__", type(trial).__name__)
    return name if name.isidentifier() else "trial"


def _array(value: Any, row: int, rows: int, what: str) -> np.ndarray:
    """One trial's part of what is to be kept."""
    if not hasattr(value, "__len__") or len(value) != rows:
        raise ValueError(
            f"{what} must hold one array for each of the {rows} trials, got "
            f"{tuple(getattr(value, 'shape', ())) or type(value).__name__}"
        )
    one = value[row]
    return (
        one.to(torch.float32 if one.dtype == torch.bfloat16 else one.dtype).numpy(force=True)
        if isinstance(one, Tensor)
        else np.asarray(one)
    )


def _rows(value: Any, rows: int, what: str) -> list[float]:
    """One number per row; a list, since that is the cheapest way out of torch."""
    try:
        x = value if isinstance(value, Tensor) else torch.as_tensor(value)
    except (TypeError, RuntimeError, ValueError):
        raise ValueError(
            f"{what} must hold one real number for each of the {rows} trials, got {type(value).__name__}"
        ) from None
    if x.is_complex() or x.shape not in ((rows,), ()):
        raise ValueError(
            f"{what} must hold one real number for each of the {rows} trials, got {x.dtype} of shape {tuple(x.shape)}"
        )
    if what.endswith(f".{OK}") and x.dtype != torch.bool:
        raise ValueError(f"{what} must be bool, got {x.dtype}")
    return x.tolist() if x.ndim else [x.item()] * rows


def _joined(parts: list[tuple[Chunk, Outcome]]) -> Outcome:
    """The outcomes of pieces as one, in order."""
    if len(parts) == 1:
        return parts[0][1]
    if any(set(o.values) != set(parts[0][1].values) for _, o in parts):
        raise TrialError(
            "trials gave results of "
            f"{' and then of '.join(dict.fromkeys(', '.join(o.values) for _, o in parts))}; "
            "return the same algorithms in every trial"
        )
    whole = Outcome(_columns([(o.values, len(c)) for c, o in parts]), _columns([(o.bounds, len(c)) for c, o in parts]))
    start = 0
    for chunk, outcome in parts:
        whole.saved.update({start + row: arrays for row, arrays in outcome.saved.items()})
        start += len(chunk)
    return whole


def _columns(parts: list[tuple[dict[str, dict[str, list[float]]], int]]) -> dict[str, dict[str, list[float]]]:
    """The numbers of pieces and how many rows each has, one after the other; a name that only some
    of them give is NaN in the others.
    """
    names = {
        outer: dict.fromkeys(inner for tree, _ in parts for inner in tree.get(outer, {}))
        for outer in dict.fromkeys(o for tree, _ in parts for o in tree)
    }

    def column(outer: str, inner: str) -> list[float]:
        missing = True if inner == OK else math.nan
        return [x for tree, rows in parts for x in tree.get(outer, {}).get(inner, [missing] * rows)]

    return {outer: {inner: column(outer, inner) for inner in inners} for outer, inners in names.items()}


def _out_of_memory(error: Exception) -> bool:
    """CUDA has a class for it, the CPU allocator of torch only a text."""
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or (
        isinstance(error, RuntimeError) and "allocate memory" in str(error)
    )
