"""Stages in order, with named values between them, and re-runnable parts."""

from __future__ import annotations

import inspect
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from torchsar.core.estimate import Estimate
from torchsar.core.signal import Recording, Signal


class Use(nn.Module):
    """A stage and where its values come from: {parameter of forward: "stage.value" or "aux.name"}.

    Made by `use`.
    """

    def __init__(self, stage: nn.Module, names: Mapping[str, str]) -> None:
        super().__init__()
        self.stage = stage
        self.names = dict(names)


def use(stage: nn.Module, **names: str) -> Use:
    """Connect values of earlier stages: `use(OmegaK(radar), doppler_hz="doppler",
    velocity_m_s="velocity")`.

    "doppler" alone is short for "doppler.doppler_hz", the value called like the parameter;
    "aux.NAME" is recorded side data.
    """
    for parameter, source in names.items():
        if not isinstance(source, str):
            raise TypeError(
                f"{parameter}={source!r}: `use` connects values by name, such as "
                f"{parameter}='doppler'; a constant belongs to the constructor of the stage"
            )
    return Use(
        stage, {parameter: source if "." in source else f"{source}.{parameter}" for parameter, source in names.items()}
    )


@dataclass(frozen=True)
class Trace:
    """Every intermediate of one run: what went into each stage, what came out, the values, and what
    it cost.
    """

    inputs: Mapping[str, Signal]
    outputs: Mapping[str, Signal]
    estimates: Mapping[str, Estimate]
    values: Mapping[str, Tensor]
    seconds: Mapping[str, float]
    bytes: Mapping[str, int]

    @property
    def signal(self) -> Signal:
        """Output of the last stage."""
        return list(self.outputs.values())[-1]


@dataclass
class _Log:
    inputs: dict[str, Signal] = field(default_factory=dict)
    outputs: dict[str, Signal] = field(default_factory=dict)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    bytes: dict[str, int] = field(default_factory=dict)


class Chain(nn.Module):
    """`Chain(name=stage, ...)` runs stages in order; an estimator leaves the signal alone and
    offers its values by name.

    chain(x): the signal after the last stage; x is a Recording or a Signal. chain.trace(x): every
    intermediate. chain.rerun(trace, start, given={"velocity.velocity_m_s": v}): the part from
    `start` on, from the signal that entered it, with values held fixed; this is the objective of
    minimum-entropy searches, always on the original data, and differentiable. Connections are
    checked at construction; a misuse names the stage, what it needs and what there is.
    """

    def __init__(self, **stages: nn.Module) -> None:
        super().__init__()
        if not stages:
            raise ValueError(
                "a chain needs at least one stage: Chain(compress=RangeCompress(radar), focus=OmegaK(radar))"
            )
        members = {name: item.stage if isinstance(item, Use) else item for name, item in stages.items()}
        for name, stage in members.items():
            _refuse_foreign(name, stage)
        self.stages = nn.ModuleDict(members)
        self.uses = {name: item.names if isinstance(item, Use) else {} for name, item in stages.items()}
        self._check()

    def _check(self) -> None:
        offered: set[str] = set()
        for name, stage in self.stages.items():
            parameters = list(inspect.signature(stage.forward).parameters.values())[1:]
            accepted = [p.name for p in parameters]
            for parameter, source in self.uses[name].items():
                if parameter not in accepted:
                    raise ValueError(
                        f"stage {name!r} ({type(stage).__name__}) has no value {parameter!r} to connect; it "
                        f"accepts {accepted or 'none'}"
                    )
                if not source.startswith("aux.") and source not in offered:
                    raise ValueError(
                        f"stage {name!r} uses {source!r}, which no earlier stage provides; there is "
                        f"{sorted(offered) or 'nothing yet'}, and 'aux.NAME' for recorded side data"
                    )
            for p in parameters:
                if (
                    p.default is p.empty
                    and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
                    and p.name not in self.uses[name]
                ):
                    there = f"one of {sorted(offered)}" if offered else "a value of an earlier stage"
                    raise ValueError(
                        f"stage {name!r} ({type(stage).__name__}) needs the value {p.name!r}; connect it "
                        f"(`use`) with {there}, or with 'aux.NAME' for recorded side data"
                    )
            offered |= {f"{name}.{key}" for key in getattr(stage, "provides", ())}

    def forward(self, x: Recording | Signal, given: Mapping[str, Tensor] | None = None) -> Signal:
        """The signal after the last stage. given: values that replace what an estimator
        would find.
        """
        signal, aux = _split(x)
        self._refuse_unknown(given, aux)
        return self._run(list(self.stages), signal, {**aux, **(given or {})}, set(given or {}), None)

    def trace(self, x: Recording | Signal, given: Mapping[str, Tensor] | None = None) -> Trace:
        """Run and keep every intermediate by stage name, with wall seconds and bytes of each
        output.
        """
        signal, aux = _split(x)
        self._refuse_unknown(given, aux)
        values, log = {**aux, **(given or {})}, _Log()
        self._run(list(self.stages), signal, values, set(given or {}), log)
        return Trace(log.inputs, log.outputs, log.estimates, values, log.seconds, log.bytes)

    def rerun(
        self, trace: Trace, start: str, stop: str | None = None, given: Mapping[str, Tensor] | None = None
    ) -> Signal:
        """Run again from stage `start` to `stop` (inclusive; the last by default) on what entered
        `start` in the trace.
        """
        names = list(self.stages)
        for name in (start, stop or start):
            if name not in names:
                raise KeyError(f"the chain has the stages {names}, not {name!r}")
        part = names[names.index(start) : names.index(stop) + 1 if stop else None]
        unknown = set(given or {}) - set(trace.values)
        if unknown:
            raise KeyError(f"given {sorted(unknown)}, but the trace holds the values {sorted(trace.values)}")
        return self._run(part, trace.inputs[start], {**trace.values, **(given or {})}, set(given or {}), None)

    def _refuse_unknown(self, given: Mapping[str, Tensor] | None, aux: Mapping[str, Tensor]) -> None:
        """A value that no stage offers or uses and nothing recorded would be held for nothing."""
        offered = {
            f"{name}.{key}" for name, stage in self.stages.items() for key in getattr(stage, "provides", ())
        } | set(aux)
        offered |= {source for names in self.uses.values() for source in names.values()}
        unknown = set(given or {}) - offered
        if unknown:
            raise KeyError(f"given {sorted(unknown)}, but the chain offers the values {sorted(offered)}")

    def _run(
        self, names: list[str], signal: Signal, values: dict[str, Tensor], held: set[str], log: _Log | None
    ) -> Signal:
        for name in names:
            stage = self.stages[name]
            provided = {f"{name}.{key}" for key in getattr(stage, "provides", ())}
            entered, began = signal, time.perf_counter()
            if not (provided and provided <= held):
                signal = self._step(name, stage, signal, values, held, log)
            if log is not None:
                _synchronise(signal.data)
                log.inputs[name], log.outputs[name] = entered, signal
                log.seconds[name] = time.perf_counter() - began
                log.bytes[name] = signal.data.numel() * signal.data.element_size()
        return signal

    def _step(
        self, name: str, stage: nn.Module, signal: Signal, values: dict[str, Tensor], held: set[str], log: _Log | None
    ) -> Signal:
        arguments = {}
        for parameter, source in self.uses[name].items():
            if source not in values:
                raise KeyError(f"stage {name!r} needs {source!r} for {parameter!r}, but there is {sorted(values)}")
            arguments[parameter] = values[source]
        result = stage(signal, **arguments)
        out, estimate = result if isinstance(result, tuple) else (result, None)
        if isinstance(out, Estimate):
            out, estimate = signal, out
        if not isinstance(out, Signal):
            raise TypeError(
                f"stage {name!r} ({type(stage).__name__}) returned {type(out).__name__}; a stage "
                "returns a Signal, an Estimate, or (Signal, Estimate)"
            )
        if estimate is not None:
            values.update(
                {f"{name}.{key}": value for key, value in estimate.value.items() if f"{name}.{key}" not in held}
            )
            if log is not None:
                log.estimates[name] = estimate
        return out


def _refuse_foreign(name: str, stage: object) -> None:
    """A member of a chain is a module, under a name that nn.ModuleDict does not need for itself."""
    if not isinstance(stage, nn.Module):
        got = f"the class {stage.__name__}, not an instance of it" if isinstance(stage, type) else type(stage).__name__
        raise TypeError(f"stage {name!r} must be a torch.nn.Module, such as a Stage, got {got}")
    if hasattr(nn.ModuleDict(), name) or "." in name:
        raise ValueError(
            f"a stage cannot be called {name!r}, which torch.nn.ModuleDict has for itself; choose another name"
        )


def _split(x: Recording | Signal) -> tuple[Signal, dict[str, Tensor]]:
    if isinstance(x, Recording):
        return x.signal, {f"aux.{name}": value for name, value in x.aux.items()}
    if isinstance(x, Signal):
        return x, {}
    raise TypeError(f"a chain runs on a Recording or a Signal, got {type(x).__name__}")


def _synchronise(x: Tensor) -> None:
    if x.is_cuda:
        torch.cuda.synchronize(x.device)
