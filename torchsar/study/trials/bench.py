"""The bench of a case: its radar, world and chains, which are built from the config, and the
processing of batches of trials.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import (
    Chain,
    Draws,
    Estimate,
    Outcome,
    Recording,
    Trace,
    Truth,
    gathered_checks,
    is_out_of_memory,
    use,
)
from torchsar.core.stored import machine_memory_bytes
from torchsar.echo import Simulate, apply_impairments
from torchsar.study.settings.errors import ConfigError, did_you_mean, one_line, own_line
from torchsar.study.settings.sections import LONGEST_NAME, OF_CHAIN, Loaded, Method
from torchsar.study.trials.batch import Batch, Judged, Processed, Trials, fault_of_image, rows, verdict
from torchsar.study.trials.choice import resolved

log = logging.getLogger("torchsar")
Announce = Callable[[str, str], Any]
# errors of stages that cannot process their data; torch itself raises RuntimeError
_FAILURES = (ValueError, TypeError, KeyError, RuntimeError)


class Bench:
    """Radar, world and chains of one case, on one device.

    Args:
        loaded: The config of the case. Every `auto` in it is replaced.
        device: Device on which trials are computed.
        announce: Function that is called with the method and the stage when a stage begins.

    Attributes:
        chosen: A sentence about each `auto` that was replaced.

    Raises:
        ConfigError: If a part of the config cannot be built.
    """

    def __init__(self, loaded: Loaded, device: str = "cpu", announce: Announce = lambda *_: None) -> None:
        self.system, self.device, self.announce = loaded.system, device, announce
        self.loaded, self.chosen = resolved(loaded, lambda plain: Bench(plain, device))
        config, self.file = self.loaded.config, self.loaded.file
        self.config, self.dtype = config, getattr(torch, config.precision)
        self.judging = self._made("metrics")
        self.recording = self._read() if config.data.file is not None else None
        if self.recording is None:
            self.radar, self._still = self._made("radar"), self._made("world")
            self._refuse_oversize()
        else:
            self.radar, self._still = self.recording.radar, None
        context = {} if self.recording is None else self.system.context(self.recording)
        chains = build_chains(self.loaded, radar=self.radar, **context)
        self.chains: dict[str, Chain] = {name: chain.to(device) for name, chain in chains.items()}
        made = self.system.impairments.make
        entries = config.data.impairments.items()
        self.impairments = {name: made(entry, f"data.impairments.{name}", self.file) for name, entry in entries}
        self._memo: dict[str, Any] = {}
        self._refuse_reference()
        self.system.check(self)

    def chain(self, name: str, vary: Sequence[str] = ()) -> Chain:
        """Return the chain of a method that begins with the simulation of the world.

        Args:
            name: Name of the method.
            vary: Dotted keys below `world` of numbers that are given per trial, as
                "given.world.KEY".

        Raises:
            ConfigError: If the config has a recording in place of a world, or the method repeats a
                part of another one.
        """
        method = self.config.processor[name]
        if self.recording is not None or method.rerun is not None:
            raise ConfigError(f"{self.file}: the method {name!r} does not begin with the world; choose another one")

        def simulated(radar: Any, world: Any, n_pulse: int, draws: Draws, **_: Any) -> tuple[Recording, Truth]:
            trials = self.system.simulate(self, world, draws)
            return trials.clean if method.input == "clean" else trials.recording, Truth(trials.truth, trials.clean)

        def world(**given: Tensor) -> Any:
            return self.world(given)

        given = {key: f"given.world.{key}" for key in vary}
        chain, first = self.chains[name], use(Simulate(self.radar, world, 0, by=simulated), **given)
        stages = {n: use(s, in_doubt=chain.in_doubt[n], **chain.uses[n]) for n, s in chain.stages.items()}
        return Chain(world=first, **stages)

    def memo(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the object that is kept under a name; `make` makes it when it is first needed."""
        if name not in self._memo:
            self._memo[name] = make()
        return self._memo[name]

    def _made(self, section: str, given: Mapping[str, Tensor] | None = None) -> Any:
        values = getattr(self.config, section)
        return self.system.sections[section].make(values, section, self.file, given or {})

    def _read(self) -> Recording:
        try:
            channel = self.config.data.channel
            if channel is None:
                return self.system.read(self.config.data.file, self.dtype)
            if self.system.name != "path":
                raise ValueError(f"only recordings of the system path have channels, got data.channel={channel!r}")
            return self.system.read(self.config.data.file, self.dtype, channel)  # pyright: ignore[reportCallIssue]
        except (ValueError, OSError, ModuleNotFoundError) as error:
            text = one_line(error).removeprefix("data.file: ")
            raise ConfigError(f"{self.file}: data.file: {text}") from None

    def _refuse_oversize(self) -> None:
        """Raise ConfigError if the raw data of a trial exceed the memory of the machine."""
        size, memory = 8 * self.system.samples(self._still, self.radar), machine_memory_bytes()
        if memory is not None and size > memory:
            raise ConfigError(
                f"{self.file}: world: the raw data of a trial take {size / 1e9:.3g} GB, and this machine has "
                f"{memory / 1e9:.3g} GB; reduce the number of pulses or samples of the world"
            )

    def _refuse_reference(self) -> None:
        reference = getattr(self.judging, "reference", None)
        if reference is not None and self.config.processor[reference].input != "clean":
            raise ConfigError(
                f"{self.file}: metrics.reference names {reference!r}, which processes impaired data; name a method "
                "with 'input: clean'"
            )

    def world(self, given: Mapping[str, Tensor] | None = None) -> Any:
        """Return the world of the config.

        Args:
            given: Tensors (trial,) that replace numbers, by dotted key below `world`.
        """
        return self._made("world", given) if given else self._still

    @property
    def bytes_per_trial(self) -> int:
        """Bytes of the largest tensor that a trial needs."""
        if self.recording is not None:
            return self.recording.signal.data.numel() * self.recording.signal.data.element_size()
        return self.system.bytes_per_trial(self)

    def draws(self, case: str | int = 0, trials: Sequence[int] | None = None) -> Draws:
        """Return random numbers with the seed and the source of the config; see `Draws`."""
        return Draws(self.config.seed, case, trials, self.config.random)

    def trials(self, draws: Draws, given: Mapping[str, Tensor] | None = None) -> Trials:
        """Return simulated trials, or the recording with the impairments of the config.

        Args:
            draws: Random numbers of the trials.
            given: Tensors (trial,) that replace numbers of the world, by dotted key below `world`.

        Raises:
            ConfigError: If the simulation fails.
        """
        with self._named("world"), gathered_checks():
            if self.recording is None:
                return self.system.simulate(self, self.world(given), draws)
            impaired, truth = apply_impairments(self.recording, self.impairments, replace(draws, trials=None))
            return Trials(impaired, self.recording, truth)

    @torch.no_grad()
    def batch(
        self,
        draws: Draws,
        given: Mapping[str, Tensor] | None = None,
        keep: Collection[str] = (),
        detail: bool = False,
        methods: Collection[str] = (),
    ) -> Batch:
        """Simulate a batch of trials, run every method on it, and compute its metrics.

        Args:
            draws: Random numbers of the trials of the batch.
            given: Tensors (trial,) that replace numbers of the world, by dotted key below `world`.
            keep: Methods whose traces are kept.
            detail: True, as for `torchsar run`, to compute metrics of single targets too, and to
                report a method whose chain does not end with an image as failed.
            methods: Methods that are run; all if empty.

        Returns:
            The trials and the outcomes.

        Raises:
            ConfigError: If the simulation fails, or the method with the name `recommended`. The
                failure of another method is part of its outcome.
        """
        self.announce("", "recording" if self.recording is not None else "simulation")
        trials = self.trials(draws, given)
        outcomes: dict[str, Processed] = {}
        later = [method.rerun.method for method in self.config.processor.values() if method.rerun is not None]
        for name, method in self.config.processor.items():
            if methods and name not in methods:
                continue
            outcomes[name] = self._outcome(name, method, trials, outcomes, detail)
            for other in outcomes:
                if other not in (name, *keep, *later):
                    outcomes[other] = replace(outcomes[other], trace=None)
        return Batch(trials, self._compared(outcomes))

    def _outcome(
        self, name: str, method: Method, trials: Trials, earlier: Mapping[str, Processed], detail: bool
    ) -> Processed:
        codes = {name: torch.full((trials.count,), int(Outcome.ERROR))}
        try:
            trace, estimates, seconds = self._run(name, method, trials, earlier)
            system = self.system
            fault = fault_of_image(trace.signal, system.images, system.ending) if detail and system.ending else ""
            if fault:  # a chain that ends without an image is a mistake in the config
                raise (ValueError if trace.signal.names in system.images else ConfigError)(f"processor.{name}, {fault}")
            with gathered_checks():
                judged = self.system.judge(self, name, replace(trace, estimates=estimates), trials, detail)
        except (SystemExit, GeneratorExit) as error:
            raise ConfigError(f"{self.file}: processor.{name}: a stage ends the program") from error
        except ConfigError as error:
            raise ConfigError(str(error) if str(error).startswith(self.file) else f"{self.file}: {error}") from error
        except Exception as error:  # a stage of the user may raise any error
            if is_out_of_memory(error):  # a smaller batch may succeed
                raise
            text = reason_of(error)
            if name == "recommended" or os.environ.get("TORCHSAR_DEBUG"):
                raise ConfigError(f"{self.file}: processor.{name}: {text}") from error
            log.warning("warning: %s failed: %s", name, text)
            return Processed(Judged(verdict(codes)), failed=text, marks={"outcomes": codes})
        # the code 0, which is OK, is added for estimates without targets
        codes = {
            stage: pad(rows(e.outcome.where(e.outcome != Outcome.ABSENT, 0), trials.count), (1, 0)).amax(1)
            for stage, e in estimates.items()
        }
        spent = torch.full((trials.count,), sum(seconds.values()) / trials.count, dtype=torch.float64)
        measured = {
            key: rows(x.abs() if x.is_complex() else x, trials.count).detach().double().mean(1)
            for key, x in trace.metrics.items()
        }
        own, *targets = (
            {key: x.expand(trials.count) for key, x in of.items()} for of in (judged.metrics, *judged.targets.values())
        )
        metrics = {"seconds": spent, **verdict(codes), **own, **measured}
        judged = replace(judged, metrics=metrics, targets=dict(zip(judged.targets, targets)))
        left = [stage for stage in trace.inputs if trace.outputs[stage] is trace.inputs[stage]]
        used = {"neutral": trace.neutral, "doubtful": trace.doubtful}
        used = {kind: {key: rows(x, trials.count).any(1) for key, x in of.items()} for kind, of in used.items()}
        return Processed(judged, estimates, trace.signal, seconds, trace, left, marks={"outcomes": codes, **used})

    def _run(
        self, name: str, method: Method, trials: Trials, earlier: Mapping[str, Processed]
    ) -> tuple[Trace, Mapping[str, Estimate], Mapping[str, float]]:
        """Run a method, and return its trace, its estimates and its computing times.

        Estimates of earlier methods by the same stages from the same data are reused.
        """
        chain, recording = self.chains[name], trials.clean if method.input == "clean" else trials.recording
        if method.rerun is not None:
            source = earlier[method.rerun.method].trace
            if source is None:
                raise ValueError(f"the method {method.rerun.method!r} failed, and this method repeats a part of it")
            given = {k: torch.tensor(v, dtype=torch.float64, device=self.device) for k, v in method.rerun.given.items()}
            began = time.perf_counter()
            again = chain.retrace(source, method.rerun.start, given)
            return again, {}, {"rerun": time.perf_counter() - began}
        shared = self._shared(method, earlier)
        if unknown := sorted(true_names(chain) - trials.truth.keys()):
            raise ValueError(f"it uses truth.{unknown[0]}, which is known of simulated data only")
        true = {f"{TRUTH}{key}": trials.truth[key] for key in true_names(chain)}
        with self._announced(chain, name):
            trace = chain.trace(recording, {**shared.estimates, **true})
        spent = {stage: shared.seconds[stage] for stage in shared.estimates}
        return trace, trace.estimates, {**trace.seconds, **spent}

    def _shared(self, method: Method, earlier: Mapping[str, Processed]) -> Processed:
        """Reusable estimates of the earlier method that has the most initial stages in common."""
        best, found = [], Processed(Judged({}))
        for name, outcome in earlier.items():
            other = self.config.processor[name]
            if other.input == method.input and other.stages and not outcome.failed:
                same = takewhile(
                    lambda pair: pair[0] == pair[1], zip((method.stages or {}).items(), other.stages.items())
                )
                common = [stage for (stage, _), _ in same]
                best, found = (common, outcome) if len(common) > len(best) else (best, found)
        kept = {stage: e for stage, e in found.estimates.items() if stage in best and stage in found.reusable}
        return replace(found, estimates=kept)

    def _compared(self, outcomes: Mapping[str, Processed]) -> dict[str, Processed]:
        """Add the metrics relative to the reference method to the outcomes."""
        reference = getattr(self.judging, "reference", None)
        ideal = outcomes.get(reference or "")
        ideal = None if ideal is None or ideal.failed else ideal
        return {
            name: outcome if outcome.failed else replace(outcome, judged=self.system.compare(self, outcome, ideal))
            for name, outcome in outcomes.items()
        }

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Turn an error of the simulation into a ConfigError, unless memory was short."""
        try:
            yield
        except ConfigError:
            raise
        except _FAILURES as error:
            if is_out_of_memory(error):  # a smaller batch may succeed
                raise
            raise ConfigError(f"{self.file}: {what}: {one_line(error).removeprefix(f'{what}: ')}") from error

    @contextmanager
    def _announced(self, chain: Chain, method: str) -> Iterator[None]:
        """Announce each stage when it begins."""
        hooks = [
            stage.register_forward_pre_hook(lambda *_, name=name: self.announce(method, name))
            for name, stage in chain.stages.items()
        ]
        try:
            yield
        finally:
            for hook in hooks:
                hook.remove()


# errors whose text describes the problem; torch itself raises RuntimeError
_PLAIN = (ValueError, TypeError, KeyError, RuntimeError)
# prefix of true values
TRUTH = "truth."


def build_chains(loaded: Loaded, **context: Any) -> dict[str, Chain]:
    """Build the chain of every method.

    Args:
        loaded: The config.
        context: Parameters of constructors that are not keys of the config, such as `radar`.

    Returns:
        Chains by method; a rerun has the chain of the method that it repeats.

    Raises:
        ConfigError: If a key, a connection of stages or a value given to a rerun is not accepted.
    """
    chains: dict[str, Chain] = {}
    for name, method in loaded.config.processor.items():
        where = f"{loaded.file}: processor.{name}"
        if method.rerun is None:
            chains[name] = _chain(loaded, method, f"processor.{name}", context)
        else:
            chains[name] = chains[method.rerun.method]
            offered = {
                f"{n}.{key}" for n, stage in chains[name].stages.items() for key in getattr(stage, "provides", ())
            }
            unknown = next((value for value in method.rerun.given if value not in offered), None)
            if unknown is not None:
                raise ConfigError(
                    f"{where}.rerun.given.{unknown} does not name an estimate (STAGE.NAME) that the method "
                    f"{method.rerun.method!r} makes"
                    f"{did_you_mean(unknown, offered)}"
                )
    return chains


def true_names(chain: Chain) -> set[str]:
    """Return the names of the true values that a chain uses."""
    sources = {source for uses in chain.uses.values() for source in uses.values()}
    return {source.removeprefix(TRUTH) for source in sources if source.startswith(TRUTH)}


def _chain(loaded: Loaded, method: Method, where: str, context: Mapping[str, Any]) -> Chain:
    built = {}
    for name, entry in (method.stages or {}).items():
        path = f"{where}.stages.{name}"
        if not name.isidentifier() or len(name) > LONGEST_NAME:
            raise ConfigError(
                f"{loaded.file}: {path}: a stage name has only letters, digits and '_', does not begin with a digit, "
                f"and has {LONGEST_NAME} characters at most"
            )
        rest = {key: value for key, value in entry.items() if key not in OF_CHAIN}
        try:
            stage = loaded.system.stages.make(rest, path, loaded.file, **context)
        except ConfigError:
            raise
        except Exception as error:  # a stage of the user may raise any error
            raise ConfigError(f"{loaded.file}: {path}: {reason_of(error)}") from error
        built[name] = use(
            stage,
            in_doubt=entry.get("in_doubt", "apply"),
            **_checked_sources(entry, method, loaded, path),
        )
    try:
        return Chain(**built)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{loaded.file}: {where}: {one_line(error)}") from None


def _checked_sources(entry: Mapping[str, Any], method: Method, loaded: Loaded, where: str) -> dict[str, str]:
    """Sources of the values of a stage. Only an oracle and metrics may use true values."""
    uses = entry.get("uses", {})
    for key, source in {} if entry["stage"] == "measure" else uses.items():
        true, name = source.startswith(TRUTH), source.removeprefix(TRUTH)
        if true and not method.oracle:
            raise ConfigError(
                f"{loaded.file}: {where}.uses.{key}: {source} is a true value; set 'oracle: true' for the method if it "
                "shall show the best possible result"
            )
        if true and name not in loaded.system.truths:
            raise ConfigError(
                f"{loaded.file}: {where}.uses.{key}: {source} does not exist{did_you_mean(name, loaded.system.truths)}"
            )
    return uses


def reason_of(error: Exception) -> str:
    """Return the reason why a stage failed.

    Args:
        error: The error of the stage.

    Returns:
        The text of the error in one line, with its kind where the text alone may say too little.
    """
    if isinstance(error, _PLAIN) and " " in one_line(error):  # a single word says too little
        return one_line(error)
    return f"{type(error).__name__}: {one_line(error) or 'no message'}{own_line(error)}"
