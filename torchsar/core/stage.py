"""The base of every stage: a thin nn.Module that knows axis names and refuses what it cannot work
on.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core.check import refuse_non_finite
from torchsar.core.signal import Signal


class Stage(nn.Module):
    """`stage(signal, **values)` returns a Signal, an Estimate (the signal is left alone), or both
    as a pair.

    Subclasses say in `works_on` which trailing axes they need, in `also_on` what else they work on,
    and in `provides` which values their Estimate carries; keyword parameters of `forward` that are
    not the signal are values that a Chain can connect. Constants are buffers, tunables are
    nn.Parameters. Samples that are not finite or not complex are refused here, once, for every
    stage; one that separates the record of a one-channel detector says `takes_real`.
    """

    works_on: tuple[str, ...] = ("pulse", "range")
    also_on: tuple[tuple[str, ...], ...] = ()
    provides: tuple[str, ...] = ()
    takes_real: bool = False

    def __call__(self, signal: Signal, *args: Any, **values: Any) -> Any:
        name = type(self).__name__
        if not isinstance(signal, Signal):
            raise TypeError(
                f"{name} works on a Signal with the axes {self.works_on}, got "
                f"{type(signal).__name__}; wrap the tensor: Signal(data, radar.axes(lines, samples))"
            )
        if signal.names not in (self.works_on, *self.also_on):
            raise ValueError(
                f"{name} works on the axes {' or '.join(map(str, (self.works_on, *self.also_on)))}, got {signal.names}"
            )
        if not (signal.data.is_complex() or (self.takes_real and signal.data.is_floating_point())):
            raise TypeError(f"{name} works on complex samples, got {signal.data.dtype}; form the analytic signal first")
        refuse_non_finite(signal.data, name)
        return super().__call__(signal, *args, **values)

    def hold(self, name: str, value: Tensor | float) -> None:
        """Register a value of this stage: an nn.Parameter stays one (tunable), anything else
        becomes a float64 buffer (constant).
        """
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))
