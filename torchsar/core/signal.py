"""Signals with named, uniformly sampled axes, recordings of an instrument, and the truth of a
simulation.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core.host import refuse_non_finite
from torchsar.core.show import Rows, Shown, Summary, content, in_bytes, kind_of

# conventional names of frequency axes; other axes get the suffix "_frequency"
_DUAL_NAME = {"pulse": "doppler", "range": "range_frequency"}


@dataclass(frozen=True)
class Axis:
    """Uniform sampling grid of one dimension: sample i lies at `start + i * step`.

    >>> from torchsar import Axis
    >>> pulses = Axis("pulse", 8, start=0.0, step=0.25, unit="s")
    >>> pulses.stop, float(pulses.index_of(0.5))
    (1.75, 2.0)
    >>> pulses.dual()
    Axis(name='doppler', n=8, start=-2.0, step=0.5, unit='Hz', dual_start=0.0)

    Raw data have the axes `pulse` (slow time in s) and `range` (slant range in m), images the axes
    `azimuth` and `range` (both in m). A frequency axis made by `dual` keeps the `start` of the axis
    from which it was made, so that the inverse transform restores that axis.

    Args:
        name: Name of the axis.
        n: Number of samples, at least one.
        start: Coordinate of the first sample, in `unit`.
        step: Distance between samples, in `unit`, positive.
        unit: Unit of the coordinates, such as "s", "m" or "Hz".
        dual_start: For a frequency axis made by `dual`, the `start` of the axis from which it was
            made; None for all other axes.

    Raises:
        ValueError: If there is no sample, or the step is not positive.
    """

    name: str
    n: int
    start: float
    step: float
    unit: str
    dual_start: float | None = None

    def __post_init__(self) -> None:
        if self.n < 1 or not self.step > 0:
            raise ValueError(
                f"axis {self.name!r} needs at least one sample and a positive step, got n={self.n}, step={self.step}"
            )

    @property
    def stop(self) -> float:
        """Coordinate of the last sample, in `unit`."""
        return self.start + (self.n - 1) * self.step

    def values(self, device: torch.device | str | None = None) -> Tensor:
        """Return the coordinates of all samples.

        Args:
            device: Device of the result.

        Returns:
            Coordinates in `unit`, shape (n,), float64.
        """
        return self.start + self.step * torch.arange(self.n, dtype=torch.float64, device=device)

    def offsets(self, device: torch.device | str | None = None) -> Tensor:
        """Return the coordinates of all samples relative to the first one.

        Compute phases from these differences rather than from `values`, which lose precision where
        `start` is large.

        Args:
            device: Device of the result.

        Returns:
            Coordinates minus `start`, in `unit`, shape (n,), float64.
        """
        return self.step * torch.arange(self.n, dtype=torch.float64, device=device)

    def index_of(self, value: Tensor | float) -> Tensor:
        """Return the fractional sample index of a coordinate.

        Args:
            value: Coordinates in `unit`, any shape.

        Returns:
            Indices of the same shape, float64; below 0 or above n - 1 outside the axis.
        """
        return (torch.as_tensor(value, dtype=torch.float64) - self.start) / self.step

    def part(self, first: int, last: int) -> Axis:
        """Return the axis of the samples with the indices `first` to `last - 1`.

        An index below 0 or above the number of samples extends the axis on that side.

        Args:
            first: Index of the first sample of the result.
            last: Index after the last sample of the result.
        """
        return replace(self, n=last - first, start=self.start + first * self.step)

    def resampled(self, factor: int) -> Axis:
        """Return the axis of the samples after band-limited interpolation by a whole factor.

        Args:
            factor: Number of new samples for each old one, at least 1.
        """
        return replace(self, n=self.n * factor, step=self.step / factor)

    def dual(self) -> Axis:
        """Return the axis after a centred Fourier transform along this axis.

        Returns:
            Frequency axis in cycles per unit (Hz for s, 1/m for m), rising, with zero at sample
            n // 2; `pulse` becomes `doppler` and `range` becomes `range_frequency`. For a frequency
            axis made by `dual`, the original axis.
        """
        step = 1.0 / (self.n * self.step)
        if self.dual_start is not None:
            back = {dual: name for name, dual in _DUAL_NAME.items()}
            unit = {"Hz": "s", "1/m": "m"}.get(self.unit, self.unit)
            return Axis(back.get(self.name, self.name.removesuffix("_frequency")), self.n, self.dual_start, step, unit)
        unit = {"s": "Hz", "m": "1/m"}.get(self.unit, f"1/{self.unit}")
        name = _DUAL_NAME.get(self.name, f"{self.name}_frequency")
        return Axis(name, self.n, -(self.n // 2) * step, step, unit, dual_start=self.start)


# limit of plausibility that detects errors in files: 200 dB is a factor of 1e10 in amplitude
AGC_LIMIT_DB = 200.0
# tolerance for the rounding of coordinates, in samples
_ROUNDING = 1e-6
_ADVICE = "the numbers are too large for this type: scale the samples, or choose complex128"


@dataclass(frozen=True, repr=False)
class Signal(Shown):
    """Samples with named trailing axes; every dimension before them is a Monte Carlo trial.

    >>> import torch
    >>> from torchsar import Axis, Signal
    >>> axes = Axis("pulse", 4, 0.0, 0.01, "s"), Axis("range", 8, 9000.0, 3.0, "m")
    >>> signal = Signal(torch.ones(4, 8, dtype=torch.complex64), axes)
    >>> signal.sel(range=slice(9003, 9010))
    Signal(complex64 (4, 3), cpu, 96 bytes; pulse: 4, 0 to 0.03 s; range: 3, 9003 to 9009 m)

    Slow time comes before fast time, and range is last and contiguous. Samples are complex, except
    those of a one-channel detector, which are real.

    Args:
        data: Samples, shape (*trials, axes[0].n, axes[1].n, ...).
        axes: One axis for each trailing dimension.

    Raises:
        ValueError: If the trailing dimensions do not have the lengths of the axes.
        TypeError: If `data` is not a tensor.
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
                f"the data of a Signal must end in dimensions of the lengths of its axes ({named}), got "
                f"shape {tuple(self.data.shape)}; transpose or crop the data, with range last"
            )

    @property
    def shape(self) -> torch.Size:
        """Shape of the samples, trials first."""
        return self.data.shape

    def __abs__(self) -> Tensor:
        """Amplitudes of the samples, a tensor."""
        return self.data.abs()

    def __mul__(self, factor: Any) -> Signal:
        """Samples times a number, or times a tensor that broadcasts with them, on the same axes."""
        if isinstance(factor, Signal):
            raise TypeError(
                "a Signal is multiplied by a number or a tensor; for two, multiply their samples: a.data * b.data"
            )
        return self.with_data(self.data * factor)

    __rmul__ = __mul__

    def __getitem__(self, index: Any) -> Signal:
        """Choose trials, as `signal[0]` or `signal[:, 2:5]`; `isel` and `sel` choose samples.

        Raises:
            IndexError: If the signal has fewer trial dimensions, or fewer trials.
        """
        count = sum(i is not None for i in index) if isinstance(index, tuple) else 1
        if count > len(self.trials) or (isinstance(index, tuple) and Ellipsis in index):
            raise IndexError(
                f"signal[...] chooses trials, and this signal has the trial dimensions {tuple(self.trials)}; choose "
                f"samples with signal.isel({self.names[0]}=0) or signal.sel({self.names[0]}=...)"
            )
        return self.with_data(self.data[index])

    def __iter__(self) -> Iterator[Signal]:
        """Signals of the trials of the first dimension."""
        return map(self.__getitem__, range(self.trials[0] if self.trials else 1))

    def numpy(self) -> np.ndarray:
        """Return the samples as an array on the CPU, without gradient."""
        return self.data.numpy(force=True)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.numpy(), dtype=dtype, copy=copy)

    @property
    def trials(self) -> torch.Size:
        """Shape of the leading trial dimensions."""
        return self.data.shape[: self.data.ndim - len(self.axes)]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes, in order."""
        return tuple(axis.name for axis in self.axes)

    def axis(self, name: str) -> Axis:
        """Return the axis that has a given name.

        Raises:
            KeyError: If the signal has no axis of that name.
        """
        return self.axes[self.dim(name)]

    def dim(self, name: str) -> int:
        """Return the dimension of a named axis, counted from the end.

        Returns:
            A negative number: -1 for the last axis.

        Raises:
            KeyError: If the signal has no axis of that name.
        """
        if name not in self.names:
            raise KeyError(f"signal has the axes {self.names}, not {name!r}")
        return self.names.index(name) - len(self.axes)

    def with_data(self, data: Tensor) -> Signal:
        """Return a signal with other samples on the same axes.

        Args:
            data: Samples whose trailing dimensions fit the axes.

        Raises:
            ValueError: If the trailing dimensions do not have the lengths of the axes.
        """
        return replace(self, data=data)

    def with_axis(self, data: Tensor, **axes: Axis) -> Signal:
        """Return a signal with other samples and with some axes replaced.

        Args:
            data: Samples whose trailing dimensions fit the new axes.
            **axes: New axes, by the names of those that they replace.

        Raises:
            KeyError: If the signal has no axis of one of these names.
            ValueError: If the trailing dimensions do not have the lengths of the new axes.
        """
        for name in axes:
            self.dim(name)
        return Signal(data, tuple(axes.get(axis.name, axis) for axis in self.axes))

    def isel(self, **index: int | slice) -> Signal:
        """Select samples by indices along some axes, such as `signal.isel(range=slice(0, 9))`.

        Args:
            **index: By the name of the axis, an index, or a slice of indices. They count as in
                Python: from the end if negative, and a slice may reach beyond the samples. An index
                removes its axis.

        Returns:
            Signal with a view of the samples.

        Raises:
            KeyError: If the signal has no axis of one of these names.
            IndexError: If there is no sample of such an index.
            ValueError: If a slice has no samples, or runs backwards.
        """
        signal = self
        for name, chosen in index.items():
            axis, dim = signal.axis(name), signal.dim(name)
            if not isinstance(chosen, slice):
                rest = tuple(other for other in signal.axes if other is not axis)
                signal = Signal(signal.data.select(dim, chosen), rest)
                continue
            kept = range(*chosen.indices(axis.n))
            if kept.step < 1 or not kept:
                raise ValueError(
                    f"axis {name!r} with {axis.n} samples: the slice {chosen.start}:{chosen.stop}"
                    f"{'' if kept.step == 1 else f':{kept.step}'} has no samples in rising order"
                )
            data = signal.data[(..., chosen, *(slice(None),) * (-dim - 1))]
            part = replace(axis.part(kept.start, kept.start + len(kept)), step=axis.step * kept.step)
            signal = signal.with_axis(data, **{name: part})
        return signal

    def sel(self, **position: float | slice) -> Signal:
        """Select samples by coordinates of some axes, such as `signal.sel(range=slice(100, 200))`.

        Args:
            **position: By the name of the axis and in its unit, a coordinate, of which the nearest
                sample is taken and the axis removed, or a slice(first, last) of coordinates, of
                which both ends are included. An end that is None is that of the axis.

        Returns:
            Signal with a view of the samples.

        Raises:
            KeyError: If the signal has no axis of one of these names.
            ValueError: If there are no samples there, or a slice has a step.
        """
        return self.isel(**{name: _indices(self.axis(name), chosen) for name, chosen in position.items()})

    def to_xarray(self) -> Any:
        """Return the signal as an xarray.DataArray on the CPU, without gradient.

        Its dims are those of the trials (`trial`, or `trial_0`, `trial_1`, ... if there are
        several) and the axes with their coordinates and attribute `units`. It shares the memory of
        samples on the CPU.

        Raises:
            ModuleNotFoundError: If the extra `xarray` is not installed.
        """
        try:
            xarray = importlib.import_module("xarray")
        except ModuleNotFoundError as error:
            package = (error.name or "xarray").partition(".")[0]
            raise ModuleNotFoundError(
                f'Signal.to_xarray needs the package {package}: pip install "torchsar-lab[xarray]"'
            ) from error
        count = len(self.trials)
        trials = ("trial",) if count == 1 else tuple(f"trial_{i}" for i in range(count))
        coordinates = {a.name: (a.name, a.values().numpy(), {"units": a.unit}) for a in self.axes}
        return xarray.DataArray(self.numpy(), coordinates, (*trials, *self.names))

    def to(self, *args: Any, **kwargs: Any) -> Signal:
        """Return the signal on another device or in another dtype; arguments as for Tensor.to."""
        return self.with_data(self.data.to(*args, **kwargs))

    def _summary(self) -> Summary:
        size = in_bytes(self.data.numel() * self.data.element_size())
        return Summary(f"{kind_of(self.data)}, {self.data.device}, {size}", {"axes": self._spans()})

    def _spans(self) -> Rows:
        """Rows of a table with the name, the number of samples and the coordinates of each axis."""
        return [(a.name, f"{a.n}", f"{a.start:.6g} to {a.stop:.6g} {a.unit}".rstrip()) for a in self.axes]


@dataclass(frozen=True, repr=False)
class Recording(Shown):
    """Samples of an instrument, with its description and the side data recorded beside them.

    >>> import torch
    >>> from torchsar import Recording, radar
    >>> turntable = radar.InverseRadar(carrier_hz=10e9, bandwidth_hz=500e6, prf_hz=100.0)
    >>> Recording.from_arrays(torch.ones(4, 8, dtype=torch.complex64), turntable)
    Recording(InverseRadar; complex64 (4, 8), cpu, 256 bytes
      pulse: 4, 0 to 0.03 s
      range: 8, -1.19917 to 0.899377 m)

    `recording[0]` is the recording of the first trial, with its side data.

    Args:
        signal: Raw samples with their axes.
        radar: Description of the instrument (carrier, waveform, nominal path), such as a
            StripmapRadar.
        aux: Side data by name, such as `line_number` or `agc_db`, both of shape (..., pulse).
    """

    signal: Signal
    radar: Any
    aux: Mapping[str, Tensor] = field(default_factory=dict)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            hint = f"; its signal has it: recording.signal.{name}" if name in Signal.__match_args__ else ""
            raise AttributeError(f"a Recording has no {name!r}{hint}")

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
        """Make a recording from a user's own raw data matrix and side data.

        Range lines that hold only zeros cause a UserWarning.

        Args:
            data: Complex samples (..., line, sample), range last, as an array or a tensor.
            radar: Description of the instrument with a method `raw_axes`, such as StripmapRadar.
            dtype: complex64 or complex128; the samples are converted to it.
            start_s: Slow time of the first line, in seconds.
            what: Name of the data for messages.
            **aux: Side data by name. `agc_db` (..., line) is the attenuation of the receiver in dB,
                which is compensated here: each line is multiplied by 10**(agc_db / 20).
                `line_number` (..., line) has one whole number per line.

        Returns:
            Recording with the axes that `radar.raw_axes` gives, and the side data in `aux`.

        Raises:
            ValueError: If `dtype` or the samples are not complex, there are no samples, or a sample
                is not finite or becomes infinite by the conversion. For side data: if they are not
                numbers, `agc_db` or `line_number` does not have one entry per line, a line number
                is not whole, or `agc_db` exceeds +-200 dB.
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
        _warn_of_empty_lines(x, what)
        side = {name: _as_tensor(value, f"{what}: {name}") for name, value in aux.items()}
        for name in ("agc_db", "line_number"):
            if name in side:
                _check_side_data(side[name], x, f"{what}: {name}")
        if "line_number" in side:
            side["line_number"] = _whole(side["line_number"], f"{what}: line_number")
        x = x.to(dtype)
        if "agc_db" in side:
            level = side["agc_db"].to(torch.float64)
            if not bool((level.abs() <= AGC_LIMIT_DB).all()):
                raise ValueError(
                    f"{what}: agc_db must be finite and within +-{AGC_LIMIT_DB:g} dB, got values from "
                    f"{float(level.min()):g} to {float(level.max()):g}"
                )
            x = x * (10 ** (level / 20)).to(x.real.dtype)[..., None]
        refuse_non_finite(x, f"{what}, converted to {dtype}", _ADVICE)
        return cls(Signal(x, radar.raw_axes(x.shape[-2], x.shape[-1], start_s)), radar, side)

    def __getitem__(self, index: Any) -> Recording:
        """Choose trials of the samples and of the side data that have trials, as `recording[0]`.

        Raises:
            IndexError: If the signal has fewer trial dimensions, or fewer trials.
            ValueError: If the shape of side data does not tell whether they have trials.
        """
        signal, trials = self.signal[index], self.signal.trials
        aux = dict(self.aux)
        for name, value in self.aux.items():
            if value.shape[: len(trials)] == trials:
                if value.ndim <= 2 and tuple(trials) in {(axis.n,) for axis in self.signal.axes}:
                    raise ValueError(
                        f"aux.{name} of shape {tuple(value.shape)} may have an entry for each of the {trials[0]} "
                        "trials, or for each sample of an axis of this length; choose from both yourself"
                    )
                aux[name] = value[index]
        return replace(self, signal=signal, aux=aux)

    def to(self, *args: Any, **kwargs: Any) -> Recording:
        """Return the recording on another device or in another dtype; arguments as for Tensor.to.

        Side data move to the device too, but keep their dtype.
        """
        signal = self.signal.to(*args, **kwargs)
        return replace(
            self, signal=signal, aux={name: value.to(signal.data.device) for name, value in self.aux.items()}
        )

    def _summary(self) -> Summary:
        samples = self.signal._summary()
        side_data = [(f"aux.{name}", content(value)) for name, value in self.aux.items()]
        return Summary(f"{type(self.radar).__name__}; {samples.about}", {**samples.tables, "side data": side_data})


def _indices(axis: Axis, chosen: float | slice) -> int | slice:
    """Index of the sample nearest to a coordinate, or slice of the samples between two
    coordinates.
    """
    part = isinstance(chosen, slice)
    if part and chosen.step is not None:
        raise ValueError(f"axis {axis.name!r}: a slice of coordinates has no step, got {chosen}; see `isel`")
    first, last = (chosen.start, chosen.stop) if part else (chosen, chosen)
    low = float(axis.index_of(axis.start if first is None else first))
    high = float(axis.index_of(axis.stop if last is None else last))
    if not part and -0.5 <= low < axis.n - 0.5:
        return round(low)
    low, high = max(low, 0.0), min(high, axis.n - 1.0)
    if part and low <= high and math.ceil(low - _ROUNDING) <= high + _ROUNDING:
        return slice(math.ceil(low - _ROUNDING), math.floor(high + _ROUNDING) + 1)
    raise ValueError(
        f"axis {axis.name!r} has no samples at {chosen}; it has {axis.n} from {axis.start:g} to {axis.stop:g} "
        f"{axis.unit}"
    )


def _as_tensor(value: Any, what: str) -> Tensor:
    """Convert to a tensor like torch.as_tensor, with an error message that names the data."""
    try:
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        kind = getattr(value, "dtype", type(value).__name__)
        raise ValueError(f"{what}: expected numbers in an array or a tensor, got {kind}") from None


def _whole(numbers: Tensor, what: str) -> Tensor:
    """Convert numbers to integers; raise ValueError if they are not whole."""
    if numbers.dtype == torch.bool:
        raise ValueError(f"{what} must hold whole numbers, got {numbers.dtype}")
    if not numbers.is_floating_point():
        return numbers
    wide = numbers.to(torch.float64)
    if not bool(((wide == wide.round()) & (wide.abs() < 2.0**53)).all()):
        raise ValueError(f"{what} must hold whole numbers, got fractions, NaN or numbers beyond 2**53")
    return wide.to(torch.int64)


def _warn_of_empty_lines(samples: Tensor, what: str) -> None:
    """Warn of range lines that hold only zeros."""
    empty = ~samples.detach().bool().any(-1)
    count = int(empty.sum())
    if count:
        first = int(empty.nonzero()[0, -1])
        warnings.warn(
            f"{what}: {count} of {empty.numel()} lines hold only zeros, the first is line "
            f"{first}; line integrity marks such lines as missing",
            stacklevel=3,
        )


def _check_side_data(side: Tensor, samples: Tensor, what: str) -> None:
    """Raise ValueError unless side data have one real number per line."""
    lines, trials = samples.shape[-2], samples.shape[:-2]
    if side.ndim == 0 or side.shape[-1] != lines:
        raise ValueError(
            f"{what} has {side.shape[-1] if side.ndim else 1} entries for {lines} lines; give one per line"
        )
    if side.is_complex() or (side.ndim > 1 and side.shape[:-1] != trials):
        raise ValueError(
            f"{what} must hold real numbers, one per line, of shape ({lines},)"
            f"{f' or {(*trials, lines)}' if trials else ''}, got {side.dtype} of shape {tuple(side.shape)}"
        )


@dataclass(frozen=True, repr=False)
class Truth(Shown):
    """True values of a simulation, for evaluation only; no processing stage may use them.

    >>> from torchsar import Draws, echo, radar, scene
    >>> flight = scene.Flight(scene.StraightPath([-5e3, 0.0, 3e3], [0.0, 100.0, 0.0]))
    >>> world = scene.PathWorld(scene.Points(azimuth_m=[0.0, 5.0], range_m=[0.0, 2.0]), flight)
    >>> _, truth = echo.simulate_path(radar.InverseRadar(10e9, 100e6, 100.0), world, 4, 8, Draws(1))
    >>> truth.values["range_m"]
    tensor([0., 2.], dtype=torch.float64)

    Args:
        values: True values by name; tensors begin with the trial dimensions.
        clean: Recording of the same scene without the simulated impairments, or None where the
            simulation made no such recording.
    """

    values: Mapping[str, Tensor]
    clean: Recording | None = None

    def _summary(self) -> Summary:
        values = [(name, content(value)) for name, value in self.values.items()]
        return Summary("without `clean`" if self.clean is None else "with `clean`", {"values": values})
