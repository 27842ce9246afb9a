"""One batch of trials: what was simulated or recorded, and the outcome of every method."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Estimate, Recording, Signal, Trace

OK = "ok"
IMAGE = ("azimuth", "range")
Metrics = Mapping[str, Tensor]


@dataclass(frozen=True)
class Trials:
    """What the trials of one batch hold.

    Args:
        recording: What methods get.
        clean: What methods of `input: clean` get: no impairments, and no errors of motion or phase.
        truth: True values by name, (trial, ...); methods that are oracles may use them.
        count: Number of trials.
        own: What only the judge of the system needs besides.
    """

    recording: Recording
    clean: Recording
    truth: Mapping[str, Tensor]
    count: int = 1
    own: Any = None


@dataclass(frozen=True)
class Judged:
    """What a system says of one method in one batch.

    Args:
        metrics: Figures by name, (trial,) each.
        targets: The same of each named target.
        outside: Named targets that lie outside the image or the record.
        view: What the pictures of the system need besides.
    """

    metrics: Metrics
    targets: Mapping[str, Metrics] = field(default_factory=dict)
    outside: Sequence[str] = ()
    view: Any = None


@dataclass(frozen=True)
class Outcome:
    """What one method gave in one batch.

    Args:
        judged: Its figures.
        estimates: What its estimators found, by stage.
        signal: Its last signal; None where it failed.
        seconds: Wall time of its stages.
        trace: Every intermediate, where something later needs it.
        reusable: Stages that estimated something and left the signal alone.
        failed: Why it failed; empty where it did not.
    """

    judged: Judged
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    signal: Signal | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    trace: Trace | None = None
    reusable: Collection[str] = ()
    failed: str = ""

    @property
    def metrics(self) -> Metrics:
        return self.judged.metrics


@dataclass(frozen=True)
class Batch:
    """The trials of one batch, and the outcome of every method."""

    trials: Trials
    outcomes: Mapping[str, Outcome]


@dataclass(frozen=True)
class Result:
    """All trials of one case, and the first batch of them for pictures and arrays.

    Args:
        bench: What the case was run on.
        first: The first batch.
        metrics: By method and name, (trial,).
        targets: By method, target and name, (trial,).
        estimates: By method and name: values, standard deviations and verdicts, (trial, ...).
        truth: True values by name, (trial, ...).
    """

    bench: Any
    first: Batch
    metrics: Mapping[str, Metrics]
    targets: Mapping[str, Mapping[str, Metrics]]
    estimates: Mapping[str, Mapping[str, Found]]
    truth: Mapping[str, Tensor]

    @property
    def images(self) -> dict[str, Signal]:
        """The image of every method in the first trial."""
        signals = {name: outcome.signal for name, outcome in self.first.outcomes.items()}
        return {name: image_of(signal) for name, signal in signals.items() if signal is not None}

    def first_of(self, name: str) -> Outcome:
        return self.first.outcomes[name]


@dataclass(frozen=True)
class Found:
    """An estimate by name: value and predicted standard deviation (trial, ...), `ok` (trial,)."""

    value: Tensor
    std: Tensor | None
    ok: Tensor | None


def joined_metrics(parts: Sequence[Metrics]) -> dict[str, Tensor]:
    """Figures of several batches one after the other; NaN where a batch lacks one."""
    counts = [max((len(value) for value in part.values()), default=0) for part in parts]
    names = dict.fromkeys(name for part in parts for name in part)

    def of(part: Metrics, name: str, count: int) -> Tensor:
        return part[name].double() if name in part else torch.full((count,), math.nan, dtype=torch.float64)

    return {name: torch.cat([of(part, name, n) for part, n in zip(parts, counts)]) for name in names}


def joined_found(parts: Sequence[Mapping[str, Found]]) -> dict[str, Found]:
    """Estimates of several batches one after the other; those that every batch has."""

    def whole(values: list[Tensor | None]) -> Tensor | None:
        there = [value for value in values if value is not None]
        return torch.cat(there) if len(there) == len(values) else None

    names = [name for name in parts[0] if all(name in part for part in parts)]
    fields = {name: [whole([getattr(p[name], f) for p in parts]) for f in ("value", "std", "ok")] for name in names}
    return {name: Found(value, std, ok) for name, (value, std, ok) in fields.items() if value is not None}


def summary(metrics: Metrics) -> dict[str, float]:
    """Mean over the trials that have a figure, with `<name>_sd` where there are several."""
    row: dict[str, float] = {}
    for name, value in metrics.items():
        x = value.to(torch.float64)
        there = x[torch.isfinite(x)]
        row[name] = float(there.mean()) if len(there) else math.nan
        if len(there) > 1 and name != OK:
            row[f"{name}_sd"] = float(there.std())
    return row


def verdict(estimates: Mapping[str, Estimate], count: int) -> dict[str, Tensor]:
    """`ok`, (trial,) bool: whether all estimates of a method are reliable; nothing without any."""
    found = [_rows(estimate.ok, count).flatten(1).all(1) for estimate in estimates.values()]
    return {OK: torch.stack(found).all(0)} if found else {}


def _rows(x: Tensor, count: int) -> Tensor:
    """A tensor with trials first, one that is the same in all trials repeated."""
    return (
        x.reshape(count, -1) if x.numel() and x.numel() % count == 0 and x.ndim else x.reshape(1, -1).expand(count, -1)
    )


def image_of(signal: Signal, trial: int = 0) -> Signal:
    """A signal of one trial."""
    if not signal.trials:
        return signal
    return signal.with_data(signal.data.reshape(-1, *signal.data.shape[len(signal.trials) :])[trial])


def fault_of_image(signal: Signal, images: Sequence[tuple[str, ...]], ending: str) -> str:
    """What is wrong with a last signal as an image; empty where nothing is."""
    if signal.names not in images:
        return (
            f"whose last stage gives the axes {signal.names}, not an image {IMAGE}; end its chain with {ending} (a "
            "sweep needs none)"
        )
    odd = [axis.name for axis in signal.axes if not math.isfinite(axis.step * axis.n)]
    said = "; check the carrier, the pulse rate and the rotation of the radar"
    return f"whose image has cells of infinite size along {odd[0]}{said}" if odd else ""
