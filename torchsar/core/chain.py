"""Processing chains: stages run in order, pass on named values, and can be rerun from any stage."""

from __future__ import annotations

import inspect
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from torchsar.core.estimate import Estimate
from torchsar.core.host import gathered_checks
from torchsar.core.show import Shown, Summary, kind_of, one_number
from torchsar.core.signal import Recording, Signal

Given = Mapping[str, Tensor | Estimate]


class Use(nn.Module):
    """Stage together with the sources of its keyword values; made by the function `use`.

    >>> from torchsar import compensate, use
    >>> use(compensate.CorrectPulsePhase(), phase_rad="phase").names
    {'phase_rad': 'phase.phase_rad'}

    Args:
        stage: Stage whose `forward` takes the values.
        names: Source of each parameter of `forward`: "STAGE.VALUE" for the value VALUE that the
            stage named STAGE of the chain estimates, "aux.NAME" for side data of the recording, or
            "given.NAME" for a value that the caller of the chain gives.
        in_doubt: What the stage does in trials whose estimates are doubtful, see `use`.
    """

    def __init__(self, stage: nn.Module, names: Mapping[str, str], in_doubt: str = "apply") -> None:
        super().__init__()
        self.stage = stage
        self.names = dict(names)
        self.in_doubt = in_doubt


def use(stage: nn.Module, *, in_doubt: str = "apply", **names: str) -> Use:
    """Connect parameters of a stage to values of earlier stages or to recorded side data.

    >>> from torchsar import Chain, compensate, use
    >>> correct = use(compensate.CorrectPulsePhase(), phase_rad="phase")
    >>> Chain(phase=compensate.Sca(), correct=correct)
    Chain(2 stages
      phase: Sca, estimates phase_rad
      correct: CorrectPulsePhase, uses phase_rad from phase.phase_rad)

    Where an estimate failed (`Estimate.failed`), the stage gets the neutral value of the estimator
    in place of the estimated one, for example no phase error or the nominal velocity. A stage that
    both estimates and corrects an error leaves the signal unchanged there. Doubtful estimates are
    used, unless `in_doubt="neutral"` treats them as failed ones.

    Args:
        stage: Stage whose `forward` takes the values.
        in_doubt: What the stage does in trials whose estimates are doubtful: "apply" takes the
            estimated values, "neutral" the neutral ones.
        **names: Source of each parameter: "STAGE.VALUE", or "STAGE" alone if the value has the name
            of the parameter, or "aux.NAME" for side data of the recording, or "given.NAME" for a
            value that the caller of the chain gives.

    Returns:
        The stage with its sources, to be given to a `Chain`.

    Raises:
        TypeError: If a source is not a name, since a constant belongs in the constructor of the
            stage, or if the stage already is the result of `use`.
        ValueError: If `in_doubt` is neither "neutral" nor "apply".
    """
    if isinstance(stage, Use):
        raise TypeError("the stage has its connections from `use` already; connect all its parameters in one call")
    if in_doubt not in ("neutral", "apply"):
        raise ValueError(
            f"in_doubt must be 'apply' (estimated values where an estimate is doubtful) or 'neutral' (neutral ones), "
            f"got {in_doubt!r}"
        )
    for parameter, source in names.items():
        if not isinstance(source, str):
            raise TypeError(
                f"{parameter}={source!r}: `use` connects values by name, such as "
                f"{parameter}='doppler'; pass a constant to the constructor of the stage instead"
            )
    sources = {key: source if "." in source else f"{source}.{key}" for key, source in names.items()}
    return Use(stage, sources, in_doubt)


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
        values: Estimated and given values under "STAGE.VALUE", side data under "aux.NAME".
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
        return Summary(f"{sum(self.seconds.values()):.3g} s", {"signals, estimates and times after stages": stages})

    def _used(self, name: str) -> str:
        """Numbers of trials in which a stage used neutral or doubtful values, as words."""
        words = []
        for kind, masks in (("neutral", self.neutral), ("doubtful", self.doubtful)):
            for key, mask in masks.items():
                stage, _, parameter = key.partition(".")
                count = one_number(mask.sum()) if stage == name else None
                words += [f"{parameter or 'correction'} {kind} in {count} of {mask.numel()}"] if count else []
        return " and ".join(words)


@dataclass
class _Known:
    """Values of a run by name, with the estimates that they come from.

    Those in `held`, and the estimates of the stages in `stages`, were given by the caller.
    """

    values: dict[str, Tensor]
    estimates: dict[str, Estimate]
    held: frozenset[str] = frozenset()
    stages: frozenset[str] = frozenset()

    def with_given(self, given: Given, stages: Mapping[str, nn.Module]) -> _Known:
        """These values, replaced by those that the caller gives for the stages of a chain."""
        if not isinstance(given, Mapping):
            raise TypeError(f"`given` must map names to values or estimates, got {type(given).__name__}")
        values = {name: value for name, value in given.items() if not isinstance(value, Estimate)}
        estimates = {name: value for name, value in given.items() if isinstance(value, Estimate)}
        known = _Known({**self.values, **values}, dict(self.estimates), frozenset(values), frozenset(estimates))
        for name, estimate in estimates.items():
            _check_trials(name, estimate)
            known.add(name, _with_neutral(estimate, stages.get(name)))
        return known

    def add(self, name: str, estimate: Estimate) -> None:
        """Add the estimate of a stage, without values that the caller gives."""
        self.estimates[name] = estimate
        self.values |= {f"{name}.{key}": v for key, v in estimate.value.items() if f"{name}.{key}" not in self.held}

    def origin(self, source: str) -> tuple[Estimate, str] | None:
        """The estimate that a value comes from, and its name there; None if the value is not
        estimated or has no neutral one.
        """
        name, _, key = source.partition(".")
        estimate = self.estimates.get(name)
        if estimate is None or key not in estimate.neutral or self.values[source] is not estimate.value[key]:
            return None
        return estimate, key


@dataclass
class _Log:
    """Record of a run that becomes its Trace."""

    inputs: dict[str, Signal] = field(default_factory=dict)
    outputs: dict[str, Signal] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    bytes: dict[str, int] = field(default_factory=dict)
    neutral: dict[str, Tensor] = field(default_factory=dict)
    doubtful: dict[str, Tensor] = field(default_factory=dict)
    arguments: dict[str, Mapping[str, Tensor]] = field(default_factory=dict)

    def trace(self, known: _Known) -> Trace:
        """The trace of the run, with these values and estimates."""
        parts = {name: getattr(self, name) for name in ("seconds", "bytes", "neutral", "doubtful", "arguments")}
        return Trace(self.inputs, self.outputs, known.estimates, known.values, **parts)


class Chain(Shown, nn.Module):
    """Sequence of stages that run in order and pass estimates to later stages as named values.

    >>> import torch
    >>> from torchsar import Axis, Chain, Signal, compensate, use
    >>> axes = Axis("pulse", 3, 0.0, 0.1, "s"), Axis("range", 2, 0.0, 1.0, "m")
    >>> correct = use(compensate.CorrectPulsePhase(), phase_rad="phase")
    >>> chain = Chain(phase=compensate.Sca(assess=False), correct=correct)
    >>> chain(Signal(torch.tensor([[1, 0], [1j, 0], [-1, 0]]), axes)).data[:, 0].real.round()
    tensor([1., 1., 1.])

    `chain(x)` returns the signal after the last stage, and `chain.trace(x)` a Trace of all
    intermediate results. `chain.rerun(trace, start, given={"velocity.velocity_m_s": v})` repeats
    the stages from `start` on with some values replaced. A rerun always begins with the signal that
    the trace holds before `start`, and it is differentiable, so that it can serve as the objective
    of a minimum-entropy search. A stage that returns only an Estimate leaves the signal unchanged.
    Connections made by `use` are checked when the chain is built.

    An estimate is used except in the trials in which it failed. There later stages get the neutral
    value of the estimator (see `Stage`), and a stage that both estimates and corrects leaves the
    signal unchanged; see `use` for doubtful estimates. The Trace holds the estimates themselves,
    and shows in `neutral` where they were not used, and in `doubtful` where doubtful ones were.

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
        self.in_doubt = {name: item.in_doubt if isinstance(item, Use) else "apply" for name, item in stages.items()}
        self._check()

    def _summary(self) -> Summary:
        stages = []
        for name, stage in self.stages.items():
            uses = " and ".join(f"{parameter} from {source}" for parameter, source in self.uses[name].items())
            doubt = " (neutral if doubtful)" if self.in_doubt[name] == "neutral" else ""
            gives = " and ".join(_provided(stage))
            row = (type(stage).__name__, uses and f"uses {uses}{doubt}", gives and f"estimates {gives}")
            stages.append((name, *row))
        return Summary(f"{len(stages)} stage{'s' * (len(stages) > 1)}", {"stages in their order": stages})

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
            available |= {f"{name}.{key}" for key in _provided(stage)}

    def forward(self, x: Recording | Signal, given: Given | None = None) -> Signal:
        """Run all stages of the chain on a recording or a signal.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal.
            given: Values by name. "STAGE.VALUE" and "aux.NAME" replace estimated and recorded
                values; "given.NAME" sets a value that a stage takes from the caller. A stage for
                which `given` holds every value that it provides does not run at all, even if it
                would change the signal. "STAGE" with an Estimate, such as that of an earlier trace,
                has the same effect; its values count except where they failed, and there the
                neutral values of the estimate, or of the stage if it has none, are used.

        Returns:
            Signal after the last stage.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, `given` is not a mapping, or a
                stage returns anything else than a Signal, an Estimate or a pair of both.
            ValueError: If a value of a given Estimate does not begin with the trial dimensions.
        """
        return self._run(list(self.stages), *self._start(x, given))

    def trace(self, x: Recording | Signal, given: Given | None = None) -> Trace:
        """Run all stages of the chain and return every intermediate result, with times and sizes.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal.
            given: Values and estimates by name that replace those estimated or recorded, as in
                `forward`.

        Returns:
            Trace with the signals, estimates, values, wall times and sizes of all stages.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, `given` is not a mapping, or a
                stage returns anything else than a Signal, an Estimate or a pair of both.
            ValueError: If a value of a given Estimate does not begin with the trial dimensions.
        """
        signal, known = self._start(x, given)
        log = _Log()
        self._run(list(self.stages), signal, known, log)
        return log.trace(known)

    def rerun(self, trace: Trace, start: str, stop: str | None = None, given: Given | None = None) -> Signal:
        """Repeat consecutive stages on the signal that a trace holds before the first of them.

        Args:
            trace: Result of an earlier call of the method `trace`.
            start: Name of the first stage to repeat.
            stop: Name of the last stage to repeat; by default the last one of the chain.
            given: Values by name that replace those of the trace; they are used in all trials.

        Returns:
            Signal after the last repeated stage.

        Raises:
            KeyError: If a stage or a given value has an unknown name.
            ValueError: If `stop` runs before `start`.
        """
        part, known = self._part(trace, start, stop, given)
        return self._run(part, trace.inputs[start], known)

    def retrace(self, trace: Trace, start: str, given: Given | None = None) -> Trace:
        """Repeat the last stages of the chain and return a new trace with their results.

        Args:
            trace: Result of an earlier call of the method `trace`.
            start: Name of the first stage to repeat.
            given: Values by name that replace those of the trace; they are used in all trials.

        Returns:
            Trace with all results of the repeated stages. Of the stages before `start` it holds
            the signals, values, estimates, arguments and neutral trials of `trace`, but neither
            times nor sizes.

        Raises:
            KeyError: If a stage or a given value has an unknown name.
        """
        part, known = self._part(trace, start, None, given)
        before = [name for name in trace.inputs if name not in part]
        log = _Log({name: trace.inputs[name] for name in before}, {name: trace.outputs[name] for name in before})
        log.arguments |= {name: trace.arguments[name] for name in before}
        for here, there in ((log.neutral, trace.neutral), (log.doubtful, trace.doubtful)):
            here |= {key: mask for key, mask in there.items() if key.partition(".")[0] in before}
        self._run(part, trace.inputs[start], known, log)
        return log.trace(known)

    def _start(self, x: Recording | Signal, given: Given | None) -> tuple[Signal, _Known]:
        """The signal of a run, and the values that are known before it."""
        if not isinstance(x, Recording | Signal):
            raise TypeError(f"a chain runs on a Recording or a Signal, got {type(x).__name__}")
        aux = {f"aux.{name}": value for name, value in x.aux.items()} if isinstance(x, Recording) else {}
        known = _Known({**aux}, {}).with_given({} if given is None else given, dict(self.stages.named_children()))
        available = {f"{name}.{key}" for name, stage in self.stages.items() for key in _provided(stage)} | set(aux)
        available |= {source for names in self.uses.values() for source in names.values()}
        unknown = (known.held - available) | (known.stages - set(self.stages))
        if unknown:
            raise KeyError(f"`given` has unknown names {sorted(unknown)}; the chain has the values {sorted(available)}")
        return x.signal if isinstance(x, Recording) else x, known

    def _part(self, trace: Trace, start: str, stop: str | None, given: Given | None) -> tuple[list[str], _Known]:
        """The stages that a rerun repeats, and the values that it starts with."""
        names = list(self.stages)
        for name in (start, stop or start):
            if name not in names:
                raise KeyError(f"the chain has no stage {name!r}; its stages are {names}")
        part = names[names.index(start) : names.index(stop) + 1 if stop else None]
        if not part:
            raise ValueError(f"the chain runs its stages in the order {names}: {stop!r} does not follow {start!r}")
        before = {name: estimate for name, estimate in trace.estimates.items() if name not in part}
        known = _Known(dict(trace.values), before).with_given(
            {} if given is None else given, dict(self.stages.named_children())
        )
        unknown = (known.held - set(trace.values)) | (known.stages - set(names))
        if unknown:
            raise KeyError(
                f"`given` has unknown names {sorted(unknown)}; the trace has the values {sorted(trace.values)}"
            )
        return part, known

    def _run(self, names: list[str], signal: Signal, known: _Known, log: _Log | None = None) -> Signal:
        timed = log is not None and not torch.compiler.is_dynamo_compiling()
        for name in names:
            stage = self.stages[name]
            provided = {f"{name}.{key}" for key in _provided(stage)}
            held = name in known.stages or bool(provided and provided <= known.held)
            entered, began = signal, time.perf_counter() if timed else 0.0
            arguments, origins = self._arguments(name, known, required=not held)
            if not held:
                with gathered_checks():
                    signal = self._step(name, stage, signal, arguments, known, origins)
            if log is not None:
                if timed:
                    _synchronise(signal.data)
                    log.seconds[name] = time.perf_counter() - began
                log.inputs[name], log.outputs[name] = entered, signal
                log.bytes[name] = signal.data.numel() * signal.data.element_size()
                log.arguments[name] = arguments
                for key, estimate in origins.items() if not held or name in known.stages else ():
                    log.neutral[key] = estimate.unused(self.in_doubt[name])
                    log.doubtful[key] = estimate.doubtful & ~log.neutral[key]
        return signal

    def _arguments(self, name: str, known: _Known, required: bool) -> tuple[dict[str, Tensor], dict[str, Estimate]]:
        """The connected values of a stage, and by "STAGE.PARAMETER" the estimates they come from,
        as far as these have neutral values.
        """
        arguments, origins = {}, {}
        for parameter, source in self.uses[name].items():
            if source not in known.values and required:
                raise KeyError(
                    f"stage {name!r} needs the value {source!r} for its parameter {parameter!r}, but the only values "
                    f"of this run are {sorted(known.values)}"
                )
            origin = known.origin(source)
            if origin is not None:
                estimate, value = origin
                arguments[parameter] = estimate.trusted(value, self.in_doubt[name])
                origins[f"{name}.{parameter}"] = estimate
            elif source in known.values:
                arguments[parameter] = known.values[source]
        return arguments, origins

    def _step(
        self,
        name: str,
        stage: nn.Module,
        signal: Signal,
        arguments: dict[str, Tensor],
        known: _Known,
        origins: dict[str, Estimate],
    ) -> Signal:
        """The signal after a stage; its estimate joins `known`, and `origins` if the stage corrects
        by it.
        """
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
            known.add(name, estimate)
            if _corrected(signal, out, estimate):
                origins[name] = estimate
                unchanged = estimate.unused(self.in_doubt[name])[(...,) + (None,) * len(out.axes)]
                out = out.with_data(torch.where(unchanged, signal.data, out.data))
        return out


def _corrected(signal: Signal, out: Signal, estimate: Estimate) -> bool:
    """Whether a stage that estimates has also changed the samples, on the same axes."""
    same = out.axes == signal.axes and out.data.shape == signal.data.shape and estimate.outcome.shape == signal.trials
    return same and out is not signal


def _provided(stage: nn.Module) -> Collection[str]:
    """Names of the values that a stage estimates."""
    return getattr(stage, "provides", ())


def _with_neutral(estimate: Estimate, stage: nn.Module | None) -> Estimate:
    """An estimate with the neutral values of a stage where it has none, as that of a function."""
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


def _check_member(name: str, stage: object) -> None:
    """Raise an error unless a member is a module whose name nn.ModuleDict does not reserve."""
    if not isinstance(stage, nn.Module):
        got = f"the class {stage.__name__}, not an instance of it" if isinstance(stage, type) else type(stage).__name__
        raise TypeError(f"stage {name!r} must be a torch.nn.Module, such as a Stage, got {got}")
    if hasattr(nn.ModuleDict(), name) or "." in name:
        raise ValueError(f"a stage cannot be called {name!r}, which torch.nn.ModuleDict reserves; choose another name")


def _synchronise(x: Tensor) -> None:
    if x.is_cuda:
        torch.cuda.synchronize(x.device)
