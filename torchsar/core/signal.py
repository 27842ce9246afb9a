"""What flows between stages: a tensor and the names of its trailing axes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core.axis import Axis
from torchsar.core.check import refuse_non_finite

AGC_LIMIT_DB = 200.0


@dataclass(frozen=True)
class Signal:
    """Complex samples with named trailing axes; every dim before them is a Monte Carlo trial.

    data: (*trials, axes[0].n, axes[1].n, ...), slow time before fast time, range last and
    contiguous. Raises ValueError where the trailing shape and the axes disagree, TypeError for data
    that are no tensor.
    """

    data: Tensor
    axes: tuple[Axis, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.data, Tensor):
            raise TypeError(
                f"a Signal holds a torch.Tensor, got {type(self.data).__name__}; "
                "Recording.from_arrays takes arrays of other kinds"
            )
        expected = tuple(axis.n for axis in self.axes)
        trailing = tuple(self.data.shape[self.data.ndim - len(expected) :])
        if trailing != expected:
            named = ", ".join(f"{axis.name}={axis.n}" for axis in self.axes)
            raise ValueError(
                f"data of shape {tuple(self.data.shape)} does not end in the axes ({named}); "
                "transpose or crop it so that range is last"
            )

    @property
    def trials(self) -> torch.Size:
        """Shape of the leading trial dims."""
        return self.data.shape[: self.data.ndim - len(self.axes)]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(axis.name for axis in self.axes)

    def axis(self, name: str) -> Axis:
        """The axis of that name. Raises KeyError naming the axes there are."""
        return self.axes[self.dim(name)]

    def dim(self, name: str) -> int:
        """Position of the named axis counted from the end (negative), so that it holds for any
        number of trial dims.
        """
        if name not in self.names:
            raise KeyError(f"signal has the axes {self.names}, not {name!r}")
        return self.names.index(name) - len(self.axes)

    def with_data(self, data: Tensor) -> Signal:
        """Other samples on the same axes."""
        return replace(self, data=data)

    def with_axis(self, data: Tensor, **axes: Axis) -> Signal:
        """Other samples with some axes replaced, each named by what it replaces."""
        for name in axes:
            self.dim(name)
        return Signal(data, tuple(axes.get(axis.name, axis) for axis in self.axes))

    def crop(self, **bounds: tuple[int, int]) -> Signal:
        """Samples first..last-1 of the named axes: `signal.crop(range=(0, 1480))`."""
        signal = self
        for name, (first, last) in bounds.items():
            axis = signal.axis(name)
            if not 0 <= first < last <= axis.n:
                raise ValueError(f"crop of axis {name!r} to {first}:{last} does not fit its {axis.n} samples")
            data = signal.data.narrow(signal.dim(name), first, last - first)
            signal = signal.with_axis(data, **{name: axis.part(first, last)})
        return signal

    def to(self, *args: Any, **kwargs: Any) -> Signal:
        """As Tensor.to, for the samples."""
        return self.with_data(self.data.to(*args, **kwargs))


@dataclass(frozen=True)
class Recording:
    """What an instrument hands over: samples, what it knows about itself, and recorded side data.

    signal: raw samples with true axes. radar: a frozen description (carrier, waveform, nominal
    path). aux: named tensors that were recorded beside the samples, such as `line_number` (...,
    pulse) or `agc_db` (..., pulse).
    """

    signal: Signal
    radar: Any
    aux: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def from_arrays(
        cls,
        data: Any,
        radar: Any,
        *,
        dtype: torch.dtype = torch.complex64,
        start_s: float = 0.0,
        what: str = "data",
        **aux: Any,
    ) -> Recording:
        """A recording from a user's own complex raw matrix (..., line, sample), range last, and
        side data by name.

        radar: an instrument description with `raw_axes`, such as StripmapRadar. `agc_db` (...,
        line), receiver attenuation, is undone here: each line is multiplied by 10**(agc_db/20).
        `line_number` (..., line) has one number a line. Raises ValueError where shapes disagree or
        samples are not complex and finite; warns of lines that hold only zeros.
        """
        if not dtype.is_complex:
            raise ValueError(f"{what}: dtype must be complex64 or complex128, got {dtype}")
        x = _as_tensor(data, what)
        if not x.is_complex() or x.ndim < 2 or not x.numel():
            raise ValueError(
                f"{what}: expected complex samples (..., line, sample), at least one, got {x.dtype} "
                f"of shape {tuple(x.shape)}"
            )
        refuse_non_finite(x, what)
        _warn_of_silence(x, what)
        side = {name: _as_tensor(value, f"{what}: {name}") for name, value in aux.items()}
        for name in ("agc_db", "line_number"):
            if name in side:
                _refuse_other_lines(side[name], x, f"{what}: {name}")
        x = x.to(dtype)
        if "agc_db" in side:
            level = side["agc_db"].to(torch.float64)
            if not bool((level.abs() <= AGC_LIMIT_DB).all()):
                raise ValueError(
                    f"{what}: agc_db must be finite and within +-{AGC_LIMIT_DB:g} dB, got "
                    f"{float(level.min()):g} to {float(level.max()):g}"
                )
            x = x * (10 ** (level / 20)).to(x.real.dtype)[..., None]
        return cls(Signal(x, radar.raw_axes(x.shape[-2], x.shape[-1], start_s)), radar, side)

    def to(self, *args: Any, **kwargs: Any) -> Recording:
        """Samples and side data moved; only the samples change dtype."""
        signal = self.signal.to(*args, **kwargs)
        return replace(
            self, signal=signal, aux={name: value.to(signal.data.device) for name, value in self.aux.items()}
        )


def _as_tensor(value: Any, what: str) -> Tensor:
    """torch.as_tensor with the offender named."""
    try:
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        kind = getattr(value, "dtype", type(value).__name__)
        raise ValueError(f"{what}: expected numbers in an array or a tensor, got {kind}") from None


def _warn_of_silence(samples: Tensor, what: str) -> None:
    silent = ~samples.detach().bool().any(-1)
    count = int(silent.sum())
    if count:
        first = int(silent.nonzero()[0, -1])
        warnings.warn(
            f"{what}: {count} of {silent.numel()} lines hold only zeros, the first is line "
            f"{first}; line integrity marks such lines as missing",
            stacklevel=3,
        )


def _refuse_other_lines(side: Tensor, samples: Tensor, what: str) -> None:
    """Side data have one real number per line, for all trials or per trial."""
    lines, trials = samples.shape[-2], samples.shape[:-2]
    if side.ndim == 0 or side.shape[-1] != lines:
        raise ValueError(
            f"{what} has {side.shape[-1] if side.ndim else 1} entries for {lines} lines; give one per line"
        )
    if side.is_complex() or (side.ndim > 1 and side.shape[:-1] != trials):
        raise ValueError(
            f"{what} is {side.dtype} of shape {tuple(side.shape)}; give real numbers (line,) or "
            f"(*trials, line), trials being {tuple(trials)}"
        )


@dataclass(frozen=True)
class Truth:
    """What the world knows and no processor may see: named per-trial tensors, and the unimpaired
    recording where there is one.
    """

    values: Mapping[str, Tensor]
    clean: Recording | None = None
