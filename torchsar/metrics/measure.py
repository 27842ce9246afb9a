"""Stage that measures: any function of an image and of true values."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torch import Tensor, nn

from torchsar.core import Signal


class Measure(nn.Module):
    """Stage that adds the result of a function, such as a metric, to the trace of a chain.

    >>> import torch
    >>> from torchsar import Axis, Chain, Signal, compensate, metrics, use
    >>> axes = Axis("pulse", 3, 0.0, 0.1, "s"), Axis("range", 2, 0.0, 1.0, "m")
    >>> chain = Chain(
    ...     phase=compensate.Sca(assess=False),
    ...     contrast=metrics.Measure(metrics.contrast, of="amplitude"),
    ...     rmse=use(
    ...         metrics.Measure(metrics.phase_rmse),
    ...         estimate_rad="phase.phase_rad",
    ...         reference_rad="given.true",
    ...     ),
    ... )
    >>> signal = Signal(torch.tensor([[1, 0], [1j, 0], [-1, 0]]), axes)
    >>> trace = chain.trace(signal, given={"given.true": torch.tensor([0.0, 1.5, 3.0])})
    >>> {name: round(float(value), 3) for name, value in trace.metrics.items()}
    {'contrast': 1.0, 'rmse': 0.0}

    If the first parameter of the function is called `image` or `signal`, it is the signal at this
    place of the chain. All other parameters without a default are connected by `use`, to estimates,
    true values ("truth.NAME") or values of the caller. The signal goes on unchanged.

    Args:
        function: Function that returns a tensor, or tensors by name.
        **constants: Values of parameters that are not connected.
    """

    def __init__(self, function: Callable[..., Any], **constants: Any) -> None:
        super().__init__()
        self.function = partial(function, **constants)
        parameters = list(inspect.signature(function).parameters.values())
        self.of_signal = bool(parameters) and parameters[0].name in ("image", "signal")
        self.connects_hint = "" if self.of_signal else "; the signal itself is a first parameter called image or signal"
        self.connects = [p for p in parameters[self.of_signal :] if p.name not in constants]

    def extra_repr(self) -> str:
        name = getattr(self.function.func, "__name__", "")
        return "" if name == "<lambda>" else name

    def forward(self, signal: Signal, **values: Tensor) -> Mapping[str, Tensor]:
        """Measure.

        Args:
            signal: Signal at this place of the chain.
            **values: Parameters of the function.

        Returns:
            Numbers by name; one number has the empty name.
        """
        found = self.function(signal, **values) if self.of_signal else self.function(**values)
        return found if isinstance(found, Mapping) else {"": found}
