"""Run the methods of a config on one case."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from torchsar.core import Chain, Estimate, Signal, Trace
from torchsar.radar import StripmapRadar
from torchsar.study.build import Case, build_chain, check_given, foreign
from torchsar.study.config import Loaded, Method, check_methods
from torchsar.study.settings.errors import ConfigError

log = logging.getLogger("torchsar")


@dataclass(frozen=True)
class Result:
    """What one method gave.

    trace is kept where figures or reruns need it; used: what the focusing stage worked with.
    """

    name: str
    title: str
    chain: Chain
    image: Signal
    estimates: Mapping[str, Estimate]
    seconds: Mapping[str, float]
    bytes: int
    used: Mapping[str, float]
    trace: Trace | None


def build_chains(loaded: Loaded, **given: Any) -> dict[str, Chain]:
    """All chains, before anything is computed, so that a mistake in the last method costs no
    waiting. given: what stages take from the recording, such as radar.
    """
    check_methods(loaded.config, loaded.file)
    chains: dict[str, Chain] = {}
    for name, method in loaded.config.processor.items():
        if method.stages is not None:
            chains[name] = build_chain(method, f"processor.{name}", loaded.file, **given)
        elif method.rerun is not None:
            chains[name] = chains[method.rerun.method]
            check_given(chains[name], method, f"processor.{name}", loaded.file)
    return chains


def run_methods(loaded: Loaded, case: Case, chains: Mapping[str, Chain]) -> dict[str, Result]:
    """Every method in the order of the config; the traces that reruns and the report need are kept,
    the others dropped.
    """
    methods = loaded.config.processor
    keep = {"recommended"} | {m.rerun.method for m in methods.values() if m.rerun is not None}
    steps = sum(len(m.stages) if m.stages else 1 for m in methods.values())
    results: dict[str, Result] = {}
    with tqdm(total=steps, unit="stage", disable=None, leave=False) as bar:
        for name, method in methods.items():
            try:
                with torch.no_grad(), _announced(chains[name], name, bar):
                    results[name] = _run_one(name, method, chains[name], case, results)
            except AttributeError as error:
                raise ConfigError(f"{loaded.file}: processor.{name}: {foreign(error)}") from None
            except (
                ValueError,
                TypeError,
                KeyError,
                RuntimeError,
            ) as error:  # RuntimeError: what torch itself refuses, too little memory among it
                if os.environ.get("TORCHSAR_DEBUG"):
                    raise
                text = error.args[0] if isinstance(error, KeyError) and error.args else error
                raise ConfigError(f"{loaded.file}: processor.{name}: {' '.join(str(text).split())}") from None
            log.info("%s: %.1f s", name, sum(results[name].seconds.values()))
            _warn_of_doubt(results[name])
            for other, result in results.items():
                if other not in keep and result.trace is not None:
                    results[other] = replace(result, trace=None)
    return results


def _warn_of_doubt(result: Result) -> None:
    """Name the estimators that do not stand for their values, such as those of an empty pilot
    record.
    """
    for stage, estimate in result.estimates.items():
        if not bool(estimate.ok.all()):
            log.warning(
                "warning: %s: stage %r found nothing to trust in the data; its values %s are a fallback",
                result.name,
                stage,
                ", ".join(estimate.value),
            )


def run_recommended(loaded: Loaded, case: Case) -> Result:
    """The recommended method alone."""
    chains = build_chains(loaded, radar=case.recording.radar)
    config = loaded.config.model_copy(update={"processor": {"recommended": loaded.config.processor["recommended"]}})
    return run_methods(replace(loaded, config=config), case, chains)["recommended"]


def _run_one(name: str, method: Method, chain: Chain, case: Case, earlier: Mapping[str, Result]) -> Result:
    began = time.perf_counter()
    if method.rerun is not None:
        source = earlier[method.rerun.method].trace
        assert source is not None
        given = {key: torch.tensor(value, dtype=torch.float64) for key, value in method.rerun.given.items()}
        image = chain.rerun(source, method.rerun.start, given=given)
        used = _used(chain, {**source.values, **given}, case.recording.radar)
        return Result(
            name, method.title, chain, image, {}, {"rerun": time.perf_counter() - began}, _bytes(image), used, None
        )
    trace = chain.trace(case.clean if method.input == "clean" else case.recording)
    image = trace.signal
    if image.names != ("azimuth", "range") or image.trials:
        raise ValueError(
            f"the last stage gives the axes {image.names}, not an image ('azimuth', 'range'); end "
            "the chain with a focusing stage (a sweep needs none)"
        )
    used = _used(chain, trace.values, case.recording.radar)
    return Result(
        name, method.title, chain, image, trace.estimates, dict(trace.seconds), max(trace.bytes.values()), used, trace
    )


def _bytes(signal: Signal) -> int:
    return signal.data.numel() * signal.data.element_size()


def focus_name(chain: Chain) -> str:
    """The stage that makes the image: the last one with a Doppler of its own, else the last."""
    focusing = [name for name, stage in chain.stages.items() if hasattr(focuser_of(stage), "frame_hz")]
    return focusing[-1] if focusing else list(chain.stages)[-1]


def focuser_of(stage: nn.Module) -> nn.Module:
    """The stage itself, or the focuser that it wraps."""
    return getattr(stage, "focuser", stage)


def _used(chain: Chain, values: Mapping[str, Tensor], radar: StripmapRadar) -> dict[str, float]:
    """Doppler, velocity and frame that the focusing stage worked with, connected or its own."""
    name = focus_name(chain)
    stage, connected = focuser_of(chain.stages[name]), chain.uses[name]
    used: dict[str, float] = {}
    for key in ("doppler_hz", "velocity_m_s"):
        value = values[connected[key]] if key in connected else getattr(stage, key, None)
        if value is not None and torch.as_tensor(value).numel() == 1:
            used[key] = float(value)
    frame = getattr(stage, "frame_hz", None)
    frame = radar.pointing_doppler_hz if frame is None else frame
    used["frame_hz"] = float(used.get("doppler_hz", 0.0) if frame is None else frame)
    return used


class _announced:
    """Moves the progress bar, and the log where there is no terminal, as stages begin and end."""

    def __init__(self, chain: Chain, method: str, bar: tqdm) -> None:
        self.chain, self.method, self.bar, self.handles = chain, method, bar, []

    def __enter__(self) -> None:
        for name, stage in self.chain.stages.items():
            self.handles.append(stage.register_forward_pre_hook(lambda *_, name=name: self._begin(name)))
            self.handles.append(stage.register_forward_hook(lambda *_: self._end()))

    def _begin(self, name: str) -> None:
        self.bar.set_description(f"{self.method}: {name}")
        log.debug("%s: %s", self.method, name)

    def _end(self) -> None:
        self.bar.update()

    def __exit__(self, *_: object) -> None:
        for handle in self.handles:
            handle.remove()
