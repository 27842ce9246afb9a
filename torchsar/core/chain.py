"""Processing chains: stages run in order, pass on named values, and can be rerun from any stage."""

from __future__ import annotations

import inspect
import time
from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core.connect import Use, run_module
from torchsar.core.draws import Draws
from torchsar.core.estimate import Estimate
from torchsar.core.host import gathered_checks
from torchsar.core.show import Shown, Summary, argument
from torchsar.core.signal import Recording, Signal
from torchsar.core.spread import Spread, spread_of
from torchsar.core.trace import Given, Known, Log, Trace


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

    Modules that are no stages of torchsar work too, such as a torch.nn.Sequential: they get the
    samples as a tensor and return samples of the same shape. If they have the attribute `provides`,
    as an estimator has, or the first parameter of `forward` is annotated with `Signal`, they get
    the signal as stages do.

    A chain may begin with the world and end with numbers: `echo.Simulate` makes the recording, so
    that the chain is called with random draws in its place (`chain(draws=Draws(1))`);
    `echo.Impair` impairs it; and `metrics.Measure` adds metrics to the trace. True values are
    connected as "truth.NAME": to metrics, or to a stage that shows the best possible result.

    An estimate is used except in the trials in which it failed. There later stages get the neutral
    value of the estimator (see `Stage`), and a stage that both estimates and corrects leaves the
    signal unchanged; see `use` for doubtful estimates. The Trace holds the estimates themselves,
    and shows in `neutral` where they were not used, and in `doubtful` where doubtful ones were.

    Args:
        *unnamed: Refused, since a stage needs a name.
        **stages: Stages by name, in the order in which they run; `use` connects their parameters.

    Raises:
        ValueError: If there is no stage, if torch.nn.ModuleDict reserves a name, if a connection
            names an unknown parameter or a value that no earlier stage provides, or if a required
            parameter is not connected.
        TypeError: If a stage has no name, or is not a torch.nn.Module.
    """

    def __init__(self, *unnamed: object, **stages: nn.Module) -> None:
        super().__init__()
        if unnamed:
            raise TypeError(
                f"a chain needs a name for each stage, such as Chain(focus=OmegaK(radar)), got {argument(unnamed[0])}; "
                "Chain(**stages) takes a mapping of names"
            )
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
            gives, of = " and ".join(_provided(stage)), stage.extra_repr()
            kind = f"{type(stage).__name__}{of and f' of {of}'}"
            stages.append((name, kind, uses and f"uses {uses}{doubt}", gives and f"estimates {gives}"))
        return Summary(f"{len(stages)} stage{'s' * (len(stages) > 1)}", {"stages in their order": stages})

    def _check(self) -> None:
        """Raise an error for connections that do not fit, and for required values without a
        connection.
        """
        available: set[str] = set()
        for name, stage in self.stages.items():
            parameters = _connectable(stage)
            accepted = [p.name for p in parameters]
            open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters)
            for parameter, source in self.uses[name].items():
                if parameter not in accepted and not open_ended:
                    raise ValueError(
                        f"stage {name!r} ({type(stage).__name__}) has no value {parameter!r} to connect; its "
                        f"`forward` accepts {accepted or 'none'}"
                    )
                if not source.startswith(("aux.", "given.", "truth.")) and source not in available:
                    maker, _, value = source.partition(".")
                    silent = maker in self.stages and not _provided(self.stages[maker])
                    lacks = f" (stage {maker!r} lacks the attribute `provides`, such as ({value!r},))" if silent else ""
                    raise ValueError(
                        f"stage {name!r} uses {source!r}, which no earlier stage provides{lacks}; available are "
                        f"{sorted(available) or 'nothing yet'}, 'aux.NAME' for recorded side data, 'truth.NAME' for "
                        "true values, and 'given.NAME' for values given to the chain"
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
                        f"{getattr(stage, 'connects_hint', '')}"
                    )
            available |= {f"{name}.{key}" for key in _provided(stage)}

    def forward(
        self, x: Recording | Signal | None = None, given: Given | None = None, *, draws: Draws | None = None
    ) -> Signal:
        """Run all stages of the chain on a recording or a signal, or on what it simulates itself.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal; None for a chain
                that begins with a simulation.
            given: Values by name. "STAGE.VALUE" and "aux.NAME" replace estimated and recorded
                values; "given.NAME" sets a value that a stage takes from the caller. A stage for
                which `given` holds every value that it provides does not run at all, even if it
                would change the signal. "STAGE" with an Estimate, such as that of an earlier trace,
                has the same effect. Where this estimate failed, its neutral values are used, or
                those of the stage if it has none.
            draws: Random draws of the stages that simulate or impair a recording. A simulation uses
                them as they are, an impairment the part with the name of its stage.

        Returns:
            Signal after the last stage.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, `given` is not a mapping, or a
                stage returns anything else than a Signal, an Estimate, a pair of both, or metrics.
            ValueError: If a value of a given Estimate does not begin with the trial dimensions, or
                a stage needs random draws and there are none.
        """
        return self._run(list(self.stages), *self._start(x, given, draws))

    def trace(
        self, x: Recording | Signal | None = None, given: Given | None = None, *, draws: Draws | None = None
    ) -> Trace:
        """Run all stages of the chain and return every intermediate result, with times and sizes.

        Args:
            x: Recording, whose side data are available as "aux.NAME", or a Signal; None for a chain
                that begins with a simulation.
            given: Values and estimates by name that replace those estimated or recorded, as in
                `forward`.
            draws: Random draws of the stages that simulate or impair a recording.

        Returns:
            Trace with the signals, estimates, values, wall times and sizes of all stages.

        Raises:
            KeyError: If a given value has an unknown name, or a value that a stage is connected to
                is missing.
            TypeError: If x is neither a Recording nor a Signal, `given` is not a mapping, or a
                stage returns anything else than a Signal, an Estimate, a pair of both, or metrics.
            ValueError: If a value of a given Estimate does not begin with the trial dimensions, or
                a stage needs random draws and there are none.
        """
        signal, known = self._start(x, given, draws)
        log = Log()
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
            ValueError: If `stop` runs before `start`, or a repeated stage simulates or impairs.
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
            the signals, values, estimates, arguments, metrics and neutral trials of `trace`, but
            neither times nor sizes.

        Raises:
            KeyError: If a stage or a given value has an unknown name.
            ValueError: If a repeated stage simulates or impairs a recording.
        """
        part, known = self._part(trace, start, None, given)
        before = [name for name in trace.outputs if name not in part]
        inputs = {name: signal for name, signal in trace.inputs.items() if name in before}
        log = Log(inputs, {name: trace.outputs[name] for name in before})
        known.metrics = {key: x for key, x in trace.metrics.items() if key.partition(".")[0] in before}
        log.arguments |= {name: trace.arguments[name] for name in before}
        for here, there in ((log.neutral, trace.neutral), (log.doubtful, trace.doubtful)):
            here |= {key: mask for key, mask in there.items() if key.partition(".")[0] in before}
        self._run(part, trace.inputs[start], known, log)
        return log.trace(known)

    def spread(self, trace: Trace, of: Collection[str] | None = None, pairs: int = 32) -> Spread:
        """Carry the errors of estimates through the stages that use them, to pixels and metrics.

        The estimates are moved by their standard deviations, or by their factors (see `Estimate`),
        in one direction and in the opposite one, and the stages after them are repeated. The result
        is the root mean square of the changes. A value has the signs + and - in these pairs, and n
        values take n pairs, rounded up to a power of two, with which the result is exact for small
        errors. If these are more than `pairs`, as for a phase per pulse, so many are chosen at
        random, always the same ones, and the result has a standard error, which is no bound: a
        share of at most `1 / (2 * pairs) ** 0.5`.

        A metric which the estimate itself makes best, such as the entropy after autofocus, has no
        first derivative there; the result is then the size of its change by the curvature.

        Errors of different estimates, and within an estimate without factors those of different
        values, count as independent, and all as free of bias. Values without a standard deviation
        count as exact, and so do the samples: the noise that reaches the image directly is not part
        of the result. The standard deviation of pixels is often mostly that of a common shift of
        the image. Changes below the rounding of the samples, about 1e-7 of the image in complex64,
        are not resolved.

        A standard deviation describes the error of a reliable estimate. The result is infinite in
        trials in which a stage uses a doubtful estimate, such as an `INEXACT` one, a failed one
        without a neutral value, or one of infinite standard deviation. It is zero where the neutral
        value is used, because the estimate failed or by `in_doubt="neutral"`. The values of these
        trials are not moved, and the results of the other trials do not depend on them.

        >>> import torch
        >>> from torchsar import Axis, Chain, Estimate, Signal, compensate, metrics, use
        >>> axes = Axis("pulse", 4, 0.0, 0.1, "s"), Axis("range", 1, 0.0, 1.0, "m")
        >>> chain = Chain(
        ...     phase=compensate.Sca(),
        ...     correct=use(compensate.CorrectPulsePhase(), phase_rad="phase"),
        ...     sum=metrics.Measure(lambda signal: signal.data.sum((-2, -1)).abs()),
        ... )
        >>> value, std = torch.tensor([0.0, 0.3, 0.0, 0.3]), torch.full((4,), 0.1)
        >>> phase = Estimate({"phase_rad": value}, {"phase_rad": std}, torch.ones(()))
        >>> trace = chain.trace(Signal(torch.ones(4, 1) + 0j, axes), given={"phase": phase})
        >>> round(float(chain.spread(trace).metrics["sum"]), 3)
        0.034

        Args:
            trace: Result of an earlier call of the method `trace`.
            of: Names of the estimates whose errors count; None for all that a later stage uses.
            pairs: Largest number of pairs; the stages are repeated twice for each.

        Returns:
            Standard deviations of the moduli of the pixels of `trace.signal` and of the metrics of
            the trace.

        Raises:
            ValueError: If no later stage uses a value with a standard deviation, or a stage that
                both estimates and corrects has one, since it cannot be repeated with another value;
                or if `of` is a text, or `pairs` is less than 1.
        """
        return spread_of(trace, self.retrace, self.uses, self.in_doubt, of, pairs)

    def _start(
        self, x: Recording | Signal | None, given: Given | None, draws: Draws | None
    ) -> tuple[Signal | None, Known]:
        """Signal with which a run starts, and the values that are known before its first stage."""
        random = [name for name, stage in self.stages.items() if _on_recording(stage)]
        begins = random[:1] == list(self.stages)[:1]
        if not isinstance(x, Recording | Signal) and not (x is None and begins):
            raise TypeError(
                f"a chain runs on a Recording or a Signal, got {type(x).__name__}; only one that begins with a "
                "simulation (echo.Simulate) makes its own recording"
            )
        if random and not isinstance(draws, Draws):
            raise ValueError(
                f"stage {random[0]!r} needs random draws, got {type(draws).__name__}; call the chain with "
                "draws=Draws(1), or draws=Draws(1, trials=range(8)) for eight trials"
            )
        aux = {f"aux.{name}": value for name, value in x.aux.items()} if isinstance(x, Recording) else {}
        radar = x.radar if isinstance(x, Recording) else None
        known = Known({**aux}, {}, radar=radar, draws=draws)
        known = known.with_given({} if given is None else given, dict(self.stages.named_children()))
        available = {f"{name}.{key}" for name, stage in self.stages.items() for key in _provided(stage)} | set(aux)
        available |= {source for names in self.uses.values() for source in names.values()}
        unknown = (known.held - available) | (known.stages - set(self.stages))
        if unknown:
            raise KeyError(f"`given` has unknown names {sorted(unknown)}; the chain has the values {sorted(available)}")
        return x.signal if isinstance(x, Recording) else x, known

    def _part(self, trace: Trace, start: str, stop: str | None, given: Given | None) -> tuple[list[str], Known]:
        """Names of the stages that a rerun repeats, and the values that are known before the first
        of them.
        """
        names = list(self.stages)
        for name in (start, stop or start):
            if name not in names:
                raise KeyError(f"the chain has no stage {name!r}; its stages are {names}")
        part = names[names.index(start) : names.index(stop) + 1 if stop else None]
        if not part:
            raise ValueError(f"the chain runs its stages in the order {names}: {stop!r} does not follow {start!r}")
        random = [name for name in part if _on_recording(self.stages[name])]
        if random:
            raise ValueError(f"stage {random[0]!r} makes the recording; a chain is rerun from a stage after it")
        before = {name: estimate for name, estimate in trace.estimates.items() if name not in part}
        clean = None if trace.truth is None else trace.truth.clean
        known = Known(dict(trace.values), before, clean=clean).with_given(
            {} if given is None else given, dict(self.stages.named_children())
        )
        unknown = (known.held - set(trace.values)) | (known.stages - set(names))
        if unknown:
            raise KeyError(
                f"`given` has unknown names {sorted(unknown)}; the trace has the values {sorted(trace.values)}"
            )
        return part, known

    def _run(self, names: list[str], signal: Any, known: Known, log: Log | None = None) -> Signal:
        """Run the named stages in order; the signal before a simulation is None."""
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
                log.inputs |= {} if entered is None else {name: entered}
                log.outputs[name] = signal
                log.bytes[name] = signal.data.numel() * signal.data.element_size()
                log.arguments[name] = arguments
                for key, estimate in origins.items() if not held or name in known.stages else ():
                    log.neutral[key] = estimate.unused(self.in_doubt[name])
                    log.doubtful[key] = estimate.doubtful & ~log.neutral[key]
        return signal

    def _arguments(self, name: str, known: Known, required: bool) -> tuple[dict[str, Tensor], dict[str, Estimate]]:
        """Values connected to the parameters of a stage, and the estimates that they come from.

        The estimates have the keys "STAGE.PARAMETER"; an estimate without a neutral value is left
        out.
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
        signal: Signal | None,
        arguments: dict[str, Tensor],
        known: Known,
        origins: dict[str, Estimate],
    ) -> Signal:
        """Run a stage and return the signal after it.

        Its estimate is added to `known`, and also to `origins` if the stage corrects the signal
        with it.
        """
        if _on_recording(stage):
            assert known.draws is not None
            before, draws = (None, known.draws) if signal is None else (known.recording(signal), known.draws.part(name))
            recording, truth = stage(before, draws, **arguments)
            known.take_over(recording, truth, "" if signal is None else f"{name}.")
            return recording.signal
        assert signal is not None
        result = run_module(name, stage, signal, arguments)
        if isinstance(result, Mapping) and all(isinstance(value, Tensor) for value in result.values()):
            known.metrics |= {f"{name}.{key}" if key else name: value for key, value in result.items()}
            return signal
        out, estimate = result if isinstance(result, tuple) and len(result) == 2 else (result, None)
        if isinstance(out, Estimate):
            out, estimate = signal, out
        if not isinstance(out, Signal) or not isinstance(estimate, Estimate | None):
            raise TypeError(
                f"stage {name!r} ({type(stage).__name__}) returned {_kinds(result)}; a stage "
                "returns a Signal, an Estimate, (Signal, Estimate), or metrics, tensors by name"
            )
        if estimate is not None:
            known.add(name, estimate)
            if _corrected(signal, out, estimate):
                origins[name] = estimate
                unchanged = estimate.unused(self.in_doubt[name])[(...,) + (None,) * len(out.axes)]
                out = out.with_data(torch.where(unchanged, signal.data, out.data))
        return out


def _kinds(result: Any) -> str:
    """Name of the type of a result, or of those of the members of a tuple or mapping."""
    if isinstance(result, Mapping):
        return f"{{{', '.join(f'{key}: {_kinds(value)}' for key, value in result.items())}}}"
    return f"({', '.join(map(_kinds, result))})" if isinstance(result, tuple) else type(result).__name__


def _corrected(signal: Signal, out: Signal, estimate: Estimate) -> bool:
    """True if an estimating stage has also changed the samples, on the same axes."""
    same = out.axes == signal.axes and out.data.shape == signal.data.shape and estimate.outcome.shape == signal.trials
    return same and out is not signal


def _connectable(stage: nn.Module) -> list[inspect.Parameter]:
    """Parameters of a stage that `use` can connect.

    These are the parameters of `forward` after the signal, or `connects` of a stage that calls a
    function; its `connects_hint` ends the message that one of them lacks a connection.
    """
    found = getattr(stage, "connects", None)
    return list(inspect.signature(stage.forward).parameters.values())[1:] if found is None else list(found)


def _on_recording(stage: nn.Module) -> bool:
    """True for a stage that makes or changes a recording with random draws."""
    return getattr(stage, "on_recording", False)


def _provided(stage: nn.Module) -> Collection[str]:
    """Names of the values that a stage estimates."""
    return getattr(stage, "provides", ())


def _check_member(name: str, stage: object) -> None:
    """Raise an error unless a member is a module with `forward` whose name nn.ModuleDict does not
    reserve.
    """
    if not isinstance(stage, nn.Module) or not callable(getattr(type(stage), "forward", None)):
        got = f"the class {stage.__name__}, not an instance of it" if isinstance(stage, type) else type(stage).__name__
        raise TypeError(f"stage {name!r} must be a torch.nn.Module with a method `forward`, such as a Stage, got {got}")
    if hasattr(nn.ModuleDict(), name) or "." in name:
        raise ValueError(f"a stage cannot be called {name!r}, which torch.nn.ModuleDict reserves; choose another name")


def _synchronise(x: Tensor) -> None:
    if x.is_cuda:
        torch.cuda.synchronize(x.device)
