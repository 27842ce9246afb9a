"""Processing chains: stages run in order, pass on named values, and can be rerun from any stage."""

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
    """Stage together with the sources of its keyword values; made by the function `use`.

    Args:
        stage: Stage whose `forward` takes the values.
        names: Source of each parameter of `forward`: "STAGE.VALUE" for the value VALUE that the
            stage named STAGE of the chain estimates, "aux.NAME" for side data of the recording, or
            "given.NAME" for a value that the caller of the chain gives.
    """

    def __init__(self, stage: nn.Module, names: Mapping[str, str]) -> None:
        super().__init__()
        self.stage = stage
        self.names = dict(names)


def use(stage: nn.Module, **names: str) -> Use:
    """Connect parameters of a stage to values of earlier stages or to recorded side data.

    In the following example the values come from the stages named "doppler" and "velocity".

        use(OmegaK(radar), doppler_hz="doppler", velocity_m_s="velocity")

    Args:
        stage: Stage whose `forward` takes the values.
        **names: Source of each parameter: "STAGE.VALUE", or "STAGE" alone if the value has the name
            of the parameter, or "aux.NAME" for side data of the recording, or "given.NAME" for a
            value that the caller of the chain gives.

    Returns:
        The stage with its sources, to be given to a `Chain`.

    Raises:
        TypeError: If a source is not a name; a constant belongs in the constructor of the stage.
    """
    for parameter, source in names.items():
        if not isinstance(source, str):
            raise TypeError(
                f"{parameter}={source!r}: `use` connects values by name, such as "
                f"{parameter}='doppler'; pass a constant to the constructor of the stage instead"
            )
    return Use(
        stage, {parameter: source if "." in source else f"{source}.{parameter}" for parameter, source in names.items()}
    )


@dataclass(frozen=True)
class Trace:
    """All intermediate results of one run of a chain, by the names of the stages.

    Args:
        inputs: Signal before each stage.
        outputs: Signal after each stage.
        estimates: Estimates of the stages that returned an Estimate.
        values: Estimated and given values under "STAGE.VALUE", side data under "aux.NAME".
        seconds: Wall time of each stage, in seconds.
        bytes: Size of the samples after each stage, in bytes.
    """

    inputs: Mapping[str, Signal]
    outputs: Mapping[str, Signal]
    estimates: Mapping[str, Estimate]
    values: Mapping[str, Tensor]
    seconds: Mapping[str, float]
    bytes: Mapping[str, int]

    @property
    def signal(self) -> Signal:
        """Signal after the last stage."""
        return list(self.outputs.values())[-1]


@dataclass
class _Log:
    """Record of a run that becomes its Trace."""

    inputs: dict[str, Signal] = field(default_factory=dict)
    outputs: dict[str, Signal] = field(default_factory=dict)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    bytes: dict[str, int] = field(default_factory=dict)


class Chain(nn.Module):
    """Sequence of stages that run in order and pass estimates to later stages as named values.

    `chain(x)` returns the signal after the last stage, and `chain.trace(x)` a Trace of all
    intermediate results. `chain.rerun(trace, start, given={"velocity.velocity_m_s": v})` repeats
    the stages from `start` on with some values replaced. A rerun always begins with the signal that
    the trace holds before `start`, and it is differentiable, so that it can serve as the objective
    of a minimum-entropy search. A stage that returns only an Estimate leaves the signal unchanged.
    Connections made by `use` are checked when the chain is built.

    Args:
        **stages: Stages by name, in the order in which they run; `use` connects their parameters.

    Raises:
        ValueError: If there is no stage, if torch.nn.ModuleDict reserves a name, if a connection
            names an unknown parameter or a value that no earlier stage provides, or if a required
            parameter is not connected.
        TypeError: If a stage is not a torch.nn.Module.
    """

    def __init__(self, **stages: nn.Module) -> None:
        super().__init__()
        if not stages:
            raise ValueError(
                "a chain needs at least one stage: Chain(compress=RangeCompress(radar), focus=OmegaK(radar))"
            )
        members = {name: item.stage if isinstance(item, Use) else item for name, item in stages.items()}
        for name, stage in members.items():
            _check_member(name, stage)
        self.stages = nn.ModuleDict(members)
        self.uses = {name: item.names if isinstance(item, Use) else {} for name, item in stages.items()}
        self._check()

    def _check(self) -> None:
        """Reject connections that do not fit, and required values without a connection."""
        available: set[str] = set()
        for name, stage in self.stages.items():
            parameters = list(inspect.signature(stage.forward).parameters.values())[1:]
            accepted = [p.name for p in parameters]
            for parameter, source in self.uses[name].items():
                if parameter not in accepted:
                    raise ValueError(
                        f"stage {name!r} ({type(stage).__name__}) has no value {parameter!r} to connect; its "
                        f"`forward` accepts {accepted or 'none'}"
                    )
                if not source.startswith(("aux.", "given.")) and source not in available:
                    raise ValueError(
                        f"stage {name!r} uses {source!r}, which no earlier stage provides; available are "
                        f"{sorted(available) or 'nothing yet'}, 'aux.NAME' for recorded side data, and "
                        "'given.NAME' for values given to the chain"
                    )
            for p in parameters:
                if (
                    p.default is p.empty
                    and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
                    and p.name not in self.uses[name]
                ):
                    choices = f"one of {sorted(available)}" if available else "a value of an earlier stage"
                    raise ValueError(
                        f"stage {name!r} ({type(stage).__name__}) needs the value {p.name!r}; connect it "
                        f"(`use`) with {choices}, or with 'aux.NAME' for recorded side data"
                    )
            available |= {f"{name}.{key}" for key in getattr(stage, "provides", ())}

    def forward(self, x: Recording | Signal, given: Mapping[str, Tensor] | None = None) -> Signal:
        """Run all stages of the chain on a recording or a signal.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal.
            given: Values by name. "STAGE.VALUE" and "aux.NAME" replace estimated and recorded
                values; "given.NAME" sets a value that a stage takes from the caller. A stage for
                which `given` holds every value that it provides does not run at all, even if it
                would change the signal.

        Returns:
            Signal after the last stage.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, or a stage returns anything else
                than a Signal, an Estimate or a pair of both.
        """
        signal, aux = _split(x)
        self._refuse_unknown(given, aux)
        return self._run(list(self.stages), signal, {**aux, **(given or {})}, set(given or {}), None)

    def trace(self, x: Recording | Signal, given: Mapping[str, Tensor] | None = None) -> Trace:
        """Run all stages of the chain and return every intermediate result, with times and sizes.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal.
            given: Values by name that replace those estimated or recorded, as in `forward`.

        Returns:
            Trace with the signals, estimates, values, wall times and sizes of all stages.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, or a stage returns anything else
                than a Signal, an Estimate or a pair of both.
        """
        signal, aux = _split(x)
        self._refuse_unknown(given, aux)
        values, log = {**aux, **(given or {})}, _Log()
        self._run(list(self.stages), signal, values, set(given or {}), log)
        return Trace(log.inputs, log.outputs, log.estimates, values, log.seconds, log.bytes)

    def rerun(
        self, trace: Trace, start: str, stop: str | None = None, given: Mapping[str, Tensor] | None = None
    ) -> Signal:
        """Repeat consecutive stages on the signal that a trace holds before the first of them.

        Args:
            trace: Result of an earlier call of the method `trace`.
            start: Name of the first stage to repeat.
            stop: Name of the last stage to repeat; by default the last one of the chain.
            given: Values by name that replace those of the trace.

        Returns:
            Signal after the last repeated stage.

        Raises:
            KeyError: If a stage or a given value has an unknown name.
        """
        part, values = self._part(trace, start, stop, given)
        return self._run(part, trace.inputs[start], values, set(given or {}), None)

    def retrace(self, trace: Trace, start: str, given: Mapping[str, Tensor] | None = None) -> Trace:
        """Repeat the last stages of the chain and return a new trace with their results.

        Args:
            trace: Result of an earlier call of the method `trace`.
            start: Name of the first stage to repeat.
            given: Values by name that replace those of the trace.

        Returns:
            Trace with all results of the repeated stages. Of the stages before `start` it holds
            the signals and values of `trace`, but neither estimates nor times nor sizes.

        Raises:
            KeyError: If a stage or a given value has an unknown name.
        """
        part, values = self._part(trace, start, None, given)
        before = [name for name in trace.inputs if name not in part]
        log = _Log({name: trace.inputs[name] for name in before}, {name: trace.outputs[name] for name in before})
        self._run(part, trace.inputs[start], values, set(given or {}), log)
        return Trace(log.inputs, log.outputs, log.estimates, values, log.seconds, log.bytes)

    def _part(
        self, trace: Trace, start: str, stop: str | None, given: Mapping[str, Tensor] | None
    ) -> tuple[list[str], dict[str, Tensor]]:
        """The stages that a rerun repeats, and the values that it starts with."""
        names = list(self.stages)
        for name in (start, stop or start):
            if name not in names:
                raise KeyError(f"the chain has no stage {name!r}; its stages are {names}")
        unknown = set(given or {}) - set(trace.values)
        if unknown:
            raise KeyError(
                f"`given` has unknown names {sorted(unknown)}; the trace has the values {sorted(trace.values)}"
            )
        part = names[names.index(start) : names.index(stop) + 1 if stop else None]
        return part, {**trace.values, **(given or {})}

    def _refuse_unknown(self, given: Mapping[str, Tensor] | None, aux: Mapping[str, Tensor]) -> None:
        """Reject given values that no stage provides or uses and no recording holds."""
        available = {
            f"{name}.{key}" for name, stage in self.stages.items() for key in getattr(stage, "provides", ())
        } | set(aux)
        available |= {source for names in self.uses.values() for source in names.values()}
        unknown = set(given or {}) - available
        if unknown:
            raise KeyError(f"`given` has unknown names {sorted(unknown)}; the chain has the values {sorted(available)}")

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
                raise KeyError(
                    f"stage {name!r} needs the value {source!r} for its parameter {parameter!r}, but the only values "
                    f"of this run are {sorted(values)}"
                )
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


def _check_member(name: str, stage: object) -> None:
    """Raise an error unless a member is a module whose name nn.ModuleDict does not reserve."""
    if not isinstance(stage, nn.Module):
        got = f"the class {stage.__name__}, not an instance of it" if isinstance(stage, type) else type(stage).__name__
        raise TypeError(f"stage {name!r} must be a torch.nn.Module, such as a Stage, got {got}")
    if hasattr(nn.ModuleDict(), name) or "." in name:
        raise ValueError(f"a stage cannot be called {name!r}, which torch.nn.ModuleDict reserves; choose another name")


def _split(x: Recording | Signal) -> tuple[Signal, dict[str, Tensor]]:
    if isinstance(x, Recording):
        return x.signal, {f"aux.{name}": value for name, value in x.aux.items()}
    if isinstance(x, Signal):
        return x, {}
    raise TypeError(f"a chain runs on a Recording or a Signal, got {type(x).__name__}")


def _synchronise(x: Tensor) -> None:
    if x.is_cuda:
        torch.cuda.synchronize(x.device)
