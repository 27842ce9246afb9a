"""Connections of parameters of stages to values of earlier stages, and the call of a module."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from torchsar.core.signal import Signal


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


def run_module(name: str, stage: nn.Module, signal: Signal, arguments: Mapping[str, Tensor]) -> Any:
    """Run a stage on a signal, or a module that is no stage on its samples.

    Args:
        name: Name of the stage in the chain.
        stage: The module. Unless it belongs to torchsar, has names of values in `provides`, or the
            first parameter of its `forward` is annotated with `Signal`, it gets samples and returns
            samples.
        signal: Signal before the stage.
        arguments: Further values by the names of parameters.

    Returns:
        What the module returns; samples become a signal on the axes of `signal`.

    Raises:
        ValueError: If samples have another shape than those of the signal.
        Exception: What the module raises; a note says what a module that is no stage was given.
    """
    if not _is_foreign(type(stage)):
        return stage(signal, **arguments)
    given = signal if getattr(stage, "provides", ()) or _takes_signal(type(stage)) else signal.data
    try:
        result = stage(given, **arguments)
    except Exception as error:
        error.add_note(
            f"stage {name!r} ({type(stage).__name__}), which is no Stage, was given a {type(given).__name__}"
        )
        raise
    if not isinstance(result, Tensor):
        return result
    if result.shape != signal.shape:
        raise ValueError(
            f"stage {name!r} ({type(stage).__name__}) made {tuple(result.shape)} of samples {tuple(signal.shape)}; a "
            "module that is no Stage returns samples of the same shape, or else a Signal with axes of its own"
        )
    return signal.with_data(result)


@functools.cache
def _is_foreign(kind: type[nn.Module]) -> bool:
    """True for a class that does not derive from one of torchsar."""
    return not any(base.__module__.startswith("torchsar.") for base in kind.__mro__)


@functools.cache
def _takes_signal(kind: type[nn.Module]) -> bool:
    """True if the first parameter of `forward` is annotated with `Signal`."""
    first = list(inspect.signature(kind.forward).parameters.values())[1:2]
    return any("Signal" in str(parameter.annotation) for parameter in first)
