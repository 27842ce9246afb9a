"""Methods run on batches of trials, their traces, and what is said of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchsar.core import Chain, Estimate, Recording, Signal, Trace
from torchsar.study.build import foreign
from torchsar.study.montecarlo.record import OK
from torchsar.study.settings.errors import ConfigError

IMAGE = ("azimuth", "range")


def traced(chain: Chain, recording: Recording, name: str, given: Mapping[str, Tensor] | None = None) -> Trace:
    """The trace of a method, whose name goes before whatever its stages refuse.

    given: values to hold, see `Chain.trace`.
    """
    try:
        return chain.trace(recording, given)
    except AttributeError as error:
        raise ConfigError(f"processor.{name}: {foreign(error)}") from error
    except (ValueError, TypeError, KeyError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        raise ConfigError(f"processor.{name}: {text}") from error


def not_an_image(signal: Signal, ending: str) -> str:
    """What is wrong with a last signal that is no image; ending: the stages that make one."""
    return f"whose last stage gives the axes {signal.names}, not an image {IMAGE}; end its chain with {ending}"


def refuse_no_image(name: str, signal: Signal, ending: str) -> None:
    """Raise ConfigError for a method that makes no image, or one of cells without a size."""
    if signal.names != IMAGE:
        raise ConfigError(f"processor.{name}, {not_an_image(signal, ending)} (a sweep needs none)")
    for axis in signal.axes:
        if not math.isfinite(axis.step * axis.n):
            raise ConfigError(
                f"processor.{name}: the image has cells of {axis.step:g} {axis.unit} along "
                f"{axis.name}; check the carrier, the pulse rate and the rotation of the radar"
            )


def image_of(signal: Signal, trial: int = 0) -> Signal:
    """An image or other matrix of one trial."""
    return signal if not signal.trials else signal.with_data(signal.data.reshape(-1, *signal.data.shape[-2:])[trial])


def saved_of(traces: Mapping[str, Trace], taps: Sequence[str]) -> dict[str, dict[str, Tensor]]:
    """The last signal of every method, and the outputs of the stages that `taps` names."""
    return {
        name: {
            "last": trace.signal.data,
            **{stage: trace.outputs[stage].data for stage in taps if stage in trace.outputs},
        }
        for name, trace in traces.items()
    }


def verdict(estimates: Mapping[str, Estimate], trials: Sequence[int]) -> dict[str, Tensor]:
    """Whether all estimators of a method trust their results, (...,) bool under `ok`; nothing where
    there are none.
    """
    found = [estimate.ok.expand(tuple(trials)) for estimate in estimates.values()]
    return {OK: torch.stack(found).all(0)} if found else {}


def summary(values: Mapping[str, Mapping[str, Tensor]]) -> dict[str, dict[str, float]]:
    """Mean over trials of every metric by method, with `<metric>_sd` where there are several;
    `<metric>` of ok is a share.
    """
    out: dict[str, dict[str, float]] = {}
    for method, metrics in values.items():
        row: dict[str, float] = {}
        for name, value in metrics.items():
            x = value.to(torch.float64).reshape(-1)
            row[name] = float(x.mean())
            if x.numel() > 1 and name != OK:
                row[f"{name}_sd"] = float(x.std())
        out[method] = row
    return out
