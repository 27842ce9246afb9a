"""Named physical axes of the trailing dims of a signal."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

_DUAL_NAME = {"pulse": "doppler", "range": "range_frequency"}


@dataclass(frozen=True)
class Axis:
    """A uniform sampling grid: sample i lies at `start + i * step`, in `unit`.

    Names in use: `pulse` (slow time, s), `range` (slant range, m), and the axes of an image,
    `azimuth` (m) and `range` (m). The Fourier partner of an axis remembers where it came from, so
    that going back restores the origin.
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
        """Coordinate of the last sample."""
        return self.start + (self.n - 1) * self.step

    def values(self, device: torch.device | str | None = None) -> Tensor:
        """Coordinates of all samples, float64, shape (n,)."""
        return self.start + self.step * torch.arange(self.n, dtype=torch.float64, device=device)

    def offsets(self, device: torch.device | str | None = None) -> Tensor:
        """Coordinates relative to the first sample, float64, shape (n,): the form to build phases
        from.
        """
        return self.step * torch.arange(self.n, dtype=torch.float64, device=device)

    def index_of(self, value: Tensor | float) -> Tensor:
        """Fractional sample index of a coordinate."""
        return (torch.as_tensor(value, dtype=torch.float64) - self.start) / self.step

    def part(self, first: int, last: int) -> Axis:
        """The axis of samples first..last-1; bounds outside the axis extend it."""
        return replace(self, n=last - first, start=self.start + first * self.step)

    def resampled(self, factor: int) -> Axis:
        """The axis after band-limited interpolation by an integer factor."""
        return replace(self, n=self.n * factor, step=self.step / factor)

    def dual(self) -> Axis:
        """The centred frequency axis of this axis (cycles per unit); of a frequency axis, the axis
        it came from.
        """
        step = 1.0 / (self.n * self.step)
        if self.dual_start is not None:
            back = {dual: name for name, dual in _DUAL_NAME.items()}
            unit = {"Hz": "s", "1/m": "m"}.get(self.unit, self.unit)
            return Axis(back.get(self.name, self.name.removesuffix("_frequency")), self.n, self.dual_start, step, unit)
        unit = {"s": "Hz", "m": "1/m"}.get(self.unit, f"1/{self.unit}")
        name = _DUAL_NAME.get(self.name, f"{self.name}_frequency")
        return Axis(name, self.n, -(self.n // 2) * step, step, unit, dual_start=self.start)
