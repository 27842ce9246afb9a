"""Results of one run of a chain, and what the run knows while it goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor, nn

from torchsar.core.draws import Draws
from torchsar.core.estimate import Estimate
from torchsar.core.show import Shown, Summary, content, kind_of, one_number
from torchsar.core.signal import Recording, Signal, Truth

Given = Mapping[str, Tensor | Estimate]


@dataclass(frozen=True, repr=False)
class Trace(Shown):
    """All intermediate results of one run of a chain, by the names of the stages.

    >>> import torch
    >>> from torchsar import Axis, Chain, Signal, compensate
    >>> axes = Axis("pulse", 3, 0.0, 0.1, "s"), Axis("range", 2, 0.0, 1.0, "m")
    >>> chain = Chain(phase=compensate.Sca(assess=False))
    >>> trace = chain.trace(Signal(torch.tensor([[1, 0], [1j, 0], [-1, 0]]), axes))
    >>> trace.values["phase.phase_rad"]
    tensor([0.0000, 1.5708, 3.1416])

    Args:
        inputs: Signal before each stage.
        outputs: Signal after each stage.
        estimates: Estimates of the stages that returned an Estimate.
        values: Estimated and given values under "STAGE.VALUE", side data under "aux.NAME", true
            values of a simulation under "truth.NAME".
        seconds: Wall time of each stage, in seconds; empty inside a program of `torch.compile`.
        bytes: Size of the samples after each stage, in bytes.
        neutral: Trials in which a stage did not use an estimate, because it failed or, with
            `in_doubt="neutral"`, because it is doubtful; bool with the shape of `outcome`: under
            "STAGE.PARAMETER" those in which this parameter of the stage got a neutral value, and
            under "STAGE" those in which a stage that both estimates and corrects left the signal
            unchanged.
        doubtful: Trials in which a stage used a doubtful estimate, by the same names.
        arguments: Values that each stage received from its connections, by its name and parameter;
            neutral where the estimate was not used.
        metrics: Numbers of the stages that measure, under "STAGE", or "STAGE.NAME" if there are
            several.
        truth: True values, if a stage of the chain simulates or impairs the recording.
    """

    inputs: Mapping[str, Signal]
    outputs: Mapping[str, Signal]
    estimates: Mapping[str, Estimate]
    values: Mapping[str, Tensor]
    seconds: Mapping[str, float]
    bytes: Mapping[str, int]
    neutral: Mapping[str, Tensor] = field(default_factory=dict)
    doubtful: Mapping[str, Tensor] = field(default_factory=dict)
    arguments: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)
    metrics: Mapping[str, Tensor] = field(default_factory=dict)
    truth: Truth | None = None

    @property
    def signal(self) -> Signal:
        """Signal after the last stage."""
        return list(self.outputs.values())[-1]

    def _summary(self) -> Summary:
        stages = []
        for name, signal in self.outputs.items():
            estimate, seconds = self.estimates.get(name), self.seconds.get(name)
            found = "" if estimate is None else f"{' and '.join(estimate.value)} {estimate._verdict}"
            took = "" if seconds is None else f"{seconds:.3g} s"
            stages.append(
                (name, f"{kind_of(signal.data)} of {' and '.join(signal.names)}", found, self._used(name), took)
            )
        tables = {"signals, estimates and times after stages": stages}
        if self.metrics:
            tables["metrics"] = [(name, content(value)) for name, value in self.metrics.items()]
        return Summary(f"{sum(self.seconds.values()):.3g} s", tables)

    def _used(self, name: str) -> str:
        """Describe in words in how many trials a stage used neutral or doubtful values."""
        words = []
        for kind, masks in (("neutral", self.neutral), ("doubtful", self.doubtful)):
            for key, mask in masks.items():
                stage, _, parameter = key.partition(".")
                count = one_number(mask.sum()) if stage == name else None
                words += [f"{parameter or 'correction'} {kind} in {count} of {mask.numel()}"] if count else []
        return " and ".join(words)


@dataclass
class Known:
    """Named values of a run, with the estimates that they come from.

    Args:
        values: Values by name, as in `Trace`.
        estimates: Estimates by the names of the stages.
        held: Names of values that the caller gave.
        stages: Names of stages whose estimates the caller gave.
        radar: Description of the instrument.
        metrics: Metrics by name.
        clean: Recording without noise and errors, if the data were simulated.
        draws: Random draws of the stages that simulate or impair.
    """

    values: dict[str, Tensor]
    estimates: dict[str, Estimate]
    held: frozenset[str] = frozenset()
    stages: frozenset[str] = frozenset()
    radar: Any = None
    metrics: dict[str, Tensor] = field(default_factory=dict)
    clean: Recording | None = None
    draws: Draws | None = None

    def with_given(self, given: Given, stages: Mapping[str, nn.Module]) -> Known:
        """Replace values by those that the caller gives for the stages of a chain."""
        if not isinstance(given, Mapping):
            raise TypeError(f"`given` must map names to values or estimates, got {type(given).__name__}")
        values = {name: value for name, value in given.items() if not isinstance(value, Estimate)}
        estimates = {name: value for name, value in given.items() if isinstance(value, Estimate)}
        held = {"held": frozenset(values), "stages": frozenset(estimates)}
        known = replace(self, values={**self.values, **values}, estimates=dict(self.estimates), **held)
        for name, estimate in estimates.items():
            _check_trials(name, estimate)
            known.add(name, _with_neutral(estimate, stages.get(name)))
        return known

    def add(self, name: str, estimate: Estimate) -> None:
        """Add the estimate of a stage; values that the caller gave are not replaced."""
        self.estimates[name] = estimate
        self.values |= {f"{name}.{key}": v for key, v in estimate.value.items() if f"{name}.{key}" not in self.held}

    def recording(self, signal: Signal) -> Recording:
        """Combine a signal with the radar and the side data into a recording."""
        return Recording(signal, self.radar, self._under("aux."))

    @property
    def truth(self) -> Truth | None:
        """True values of the simulation; None if the data were not simulated."""
        values = self._under("truth.")
        return Truth(values, self.clean) if values else None

    def _under(self, prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): value for name, value in self.values.items() if name.startswith(prefix)}

    def take_over(self, recording: Recording, truth: Truth, prefix: str) -> None:
        """Take the radar, the side data and the true values of a stage that makes a recording."""
        new = {f"aux.{key}": value for key, value in recording.aux.items()}
        new |= {f"truth.{prefix}{key}": value for key, value in truth.values.items()}
        self.values |= {name: value for name, value in new.items() if name not in self.held}
        self.radar, self.clean = recording.radar, self.clean if truth.clean is None else truth.clean

    def origin(self, source: str) -> tuple[Estimate, str] | None:
        """Estimate that a value comes from, and its name there.

        The result is None if the value is not estimated, was replaced, or has no neutral value.
        """
        name, _, key = source.partition(".")
        estimate = self.estimates.get(name)
        if estimate is None or key not in estimate.neutral or self.values[source] is not estimate.value[key]:
            return None
        return estimate, key


@dataclass
class Log:
    """Times, sizes and outputs of the stages of a run, from which its Trace is made.

    Args:
        inputs: Signal before each stage.
        outputs: Signal after each stage.
        seconds: Wall time of each stage in seconds.
        bytes: Size of the samples after each stage.
        neutral: Trials in which an estimate was not used, as in `Trace`.
        doubtful: Trials in which a doubtful estimate was used, as in `Trace`.
        arguments: Values that each stage received, as in `Trace`.
    """

    inputs: dict[str, Signal] = field(default_factory=dict)
    outputs: dict[str, Signal] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    bytes: dict[str, int] = field(default_factory=dict)
    neutral: dict[str, Tensor] = field(default_factory=dict)
    doubtful: dict[str, Tensor] = field(default_factory=dict)
    arguments: dict[str, Mapping[str, Tensor]] = field(default_factory=dict)

    def trace(self, known: Known) -> Trace:
        """Make the trace of the run from the log and these values and estimates."""
        parts = {name: getattr(self, name) for name in ("seconds", "bytes", "neutral", "doubtful", "arguments")}
        parts |= {"metrics": known.metrics, "truth": known.truth}
        return Trace(self.inputs, self.outputs, known.estimates, known.values, **parts)


def _with_neutral(estimate: Estimate, stage: nn.Module | None) -> Estimate:
    """Add the neutral values of a stage to an estimate that has none for them."""
    known = {key: number for key, number in getattr(stage, "neutral", {}).items() if not isinstance(number, str)}
    missing = {key: known[key] for key in estimate.value if key in known and key not in estimate.neutral}
    return replace(estimate, neutral={**estimate.neutral, **missing}) if missing else estimate


def _check_trials(name: str, estimate: Estimate) -> None:
    """Raise ValueError unless the values of a given estimate begin with its trial dimensions."""
    for key, value in estimate.value.items():
        if value.shape[: estimate.outcome.ndim] != estimate.outcome.shape:
            raise ValueError(
                f"`given`: the value {key!r} of the estimate {name!r} must begin with the trial dimensions "
                f"{tuple(estimate.outcome.shape)} of `outcome`, got the shape {tuple(value.shape)}"
            )
