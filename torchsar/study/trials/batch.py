"""Batches of trials: recordings with their true values, and the results of every method."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Estimate, Outcome, Recording, Signal, Trace
from torchsar.metrics import Measure

OK, OUTCOME = "ok", "outcome"
IMAGE = ("azimuth", "range")
Metrics = Mapping[str, Tensor]


@dataclass(frozen=True)
class Trials:
    """Recordings and true values of the trials of one batch.

    Args:
        recording: Input of the methods.
        clean: Input of methods with `input: clean`, without impairments and errors of motion and
            phase.
        truth: True values by name, (trial, ...); only oracles may use them.
        count: Number of trials.
        own: Further data from which the system computes metrics.
    """

    recording: Recording
    clean: Recording
    truth: Mapping[str, Tensor]
    count: int = 1
    own: Any = None

    def first(self, *names: str) -> list[Tensor]:
        """Return true values of the first trial by name, one per scatterer or pulse."""
        return [self.truth[name].reshape(-1, self.truth[name].shape[-1])[0].cpu() for name in names]


@dataclass(frozen=True)
class Judged:
    """Metrics of one method in one batch.

    Args:
        metrics: Metrics by name, (trial,) each.
        targets: Metrics of each named target.
        outside: Names of the targets that lie outside the image or the record.
        view: Further data for the pictures of the system.
    """

    metrics: Metrics
    targets: Mapping[str, Metrics] = field(default_factory=dict)
    outside: Sequence[str] = ()
    view: Any = None


@dataclass(frozen=True)
class Processed:
    """Result of one method in one batch.

    Args:
        judged: Its metrics.
        estimates: Its estimates by stage.
        signal: Its last signal; None if it failed.
        seconds: Wall time of its stages in s.
        trace: All intermediate signals; None if nothing needs them.
        reusable: Stages that return an estimate and leave the signal unchanged.
        failed: The reason of its failure; empty if it did not fail.
        marks: What is known of its stages in every trial, (trial,) each: "outcomes", the worst code
            of each stage that estimates, and whether stages used "neutral" or "doubtful" values,
            see `Trace`.
    """

    judged: Judged
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    signal: Signal | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    trace: Trace | None = None
    reusable: Collection[str] = ()
    failed: str = ""
    marks: Mapping[str, Metrics] = field(default_factory=dict)

    @property
    def metrics(self) -> Metrics:
        return self.judged.metrics


@dataclass(frozen=True)
class Batch:
    """The trials of one batch, and the result of every method."""

    trials: Trials
    outcomes: Mapping[str, Processed]


@dataclass(frozen=True)
class Result:
    """All trials of one case, and the first batch of them for pictures and arrays.

    Args:
        bench: The bench of the case.
        first: The first batch.
        metrics: Metrics by method and name, (trial,).
        targets: Metrics by method, target and name, (trial,).
        estimates: Estimates by method and name.
        truth: True values by name, (trial, ...).
        marks: What is known of the stages in every trial, by method; see `Processed`.
    """

    bench: Any
    first: Batch
    metrics: Mapping[str, Metrics]
    targets: Mapping[str, Mapping[str, Metrics]]
    estimates: Mapping[str, Mapping[str, Found]]
    truth: Mapping[str, Tensor]
    marks: Mapping[str, Mapping[str, Metrics]]

    @property
    def images(self) -> dict[str, Signal]:
        """Images of the first trial, by method."""
        signals = {name: outcome.signal for name, outcome in self.first.outcomes.items()}
        return {name: image_of(signal) for name, signal in signals.items() if signal is not None}

    def first_of(self, name: str) -> Processed:
        return self.first.outcomes[name]


@dataclass(frozen=True)
class Found:
    """Estimates of a quantity: value and standard deviation (trial, ...), and codes (trial,)."""

    value: Tensor
    std: Tensor | None
    outcome: Tensor | None


def error_name(name: str, what: str = "error") -> str:
    """Return the name of the error of a value: 'doppler_hz' gives 'doppler_error_hz'.

    Args:
        name: Name of the value, with its unit.
        what: Word for the error, such as "std".

    Returns:
        Name with the word before the unit.
    """
    return re.sub(r"(_(hz|m_s|m|s|rad|deg|db))?$", rf"_{what}\1", name, count=1)


def joined_metrics(parts: Sequence[Metrics]) -> dict[str, Tensor]:
    """Concatenate the metrics of several batches, with NaN for a metric that a batch lacks."""
    counts = [max((len(value) for value in part.values()), default=0) for part in parts]
    names = dict.fromkeys(name for part in parts for name in part)

    def of(part: Metrics, name: str, count: int) -> Tensor:
        return part[name].double() if name in part else torch.full((count,), math.nan, dtype=torch.float64)

    return {name: torch.cat([of(part, name, n) for part, n in zip(parts, counts)]) for name in names}


def joined_found(parts: Sequence[Mapping[str, Found]]) -> dict[str, Found]:
    """Concatenate those estimates of several batches that every batch has."""

    def whole(values: list[Tensor | None]) -> Tensor | None:
        there = [value for value in values if value is not None]
        return torch.cat(there) if len(there) == len(values) else None

    names = [name for name in parts[0] if all(name in part for part in parts)]
    fields = {
        name: [whole([getattr(p[name], f) for p in parts]) for f in ("value", "std", "outcome")] for name in names
    }
    return {name: Found(value, std, codes) for name, (value, std, codes) in fields.items() if value is not None}


def summary(metrics: Metrics) -> dict[str, float]:
    """Return the mean of each metric over the trials in which it is finite.

    If there are several such trials, `<name>_sd` is the standard deviation. The mean of `ok` is
    that over the trials that were assessed.
    """
    row: dict[str, float] = {}
    for name, value in metrics.items():
        if name == OUTCOME:
            continue
        x = value.to(torch.float64)
        if name == OK and OUTCOME in metrics:
            x = torch.where(metrics[OUTCOME] == int(Outcome.NOT_ASSESSED), math.nan, x)
        there = x[torch.isfinite(x)]
        row[name] = float(there.mean()) if len(there) else math.nan
        if len(there) > 1 and name != OK:
            row[f"{name}_sd"] = float(there.std())
    return row


def verdict(codes: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return {"ok": whether all assessed estimates of a trial are reliable, bool (trial,),
    "outcome": the worst code of them}, or {} without estimates.

    A trial has the outcome NOT_ASSESSED only if none of its estimates was assessed.
    """
    if not codes:
        return {}
    every = torch.stack(list(codes.values()))
    silent = every == Outcome.NOT_ASSESSED
    worst = every.masked_fill(silent & ~silent.all(0), int(Outcome.OK)).amax(0)
    return {OK: worst < Outcome.INEXACT, OUTCOME: worst}


def rows(x: Tensor, count: int) -> Tensor:
    """Return a tensor as one row per trial; a value common to all trials is repeated."""
    return (
        x.reshape(count, -1) if x.numel() and x.numel() % count == 0 and x.ndim else x.reshape(1, -1).expand(count, -1)
    )


def used_values(chain: Chain, trace: Trace, name: str) -> list[Tensor]:
    """Return the values that the stages of a chain used under a name, in float64, as far as the
    chain ran.
    """
    users = [stage for stage, uses in chain.uses.items() if name in uses and stage in trace.arguments]
    return [trace.arguments[stage][name].to(torch.float64) for stage in users]


def last_values(trace: Trace, name: str) -> list[Tensor]:
    """Return the last estimate of a value by a chain, in float64; nothing if there is none."""
    return [e.value[name].to(torch.float64) for e in trace.estimates.values() if name in e.value][-1:]


def last_stage(chain: Chain) -> tuple[str, Any]:
    """Return the name of the last stage of a chain that is no metric, and the stage."""
    return [(name, stage) for name, stage in chain.stages.items() if not isinstance(stage, Measure)][-1]


def image_of(signal: Signal, trial: int = 0) -> Signal:
    """Return the signal of one trial."""
    if not signal.trials:
        return signal
    return signal.with_data(signal.data.reshape(-1, *signal.data.shape[len(signal.trials) :])[trial])


def fault_of_image(signal: Signal, images: Sequence[tuple[str, ...]], ending: str) -> str:
    """Return the reason why the last signal of a chain is no image, empty if it is one."""
    if signal.names not in images:
        return (
            f"whose last stage gives the axes {signal.names}, not an image {IMAGE}; end its chain with {ending} (a "
            "sweep does not need an image)"
        )
    odd = [axis.name for axis in signal.axes if not math.isfinite(axis.step * axis.n)]
    hint = "; check the carrier, the pulse rate and the rotation of the radar"
    return f"whose image has cells of infinite size along {odd[0]}{hint}" if odd else ""
