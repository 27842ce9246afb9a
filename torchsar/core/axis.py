"""Named, uniformly sampled physical axes of the trailing dimensions of a signal."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

# names of frequency axes by convention; other names get the suffix "_frequency"
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
