"""From complex images to pictures: detection, looks, decibels, quick-looks."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchsar.core import Axis, Signal, Stage


def power(image: Tensor) -> Tensor:
    """|I|^2 of a complex image, or the image itself where it is real (detected) already."""
    return image.real.square() + image.imag.square() if image.is_complex() else image


def multilook(image: Tensor, looks: tuple[int, int]) -> Tensor:
    """Mean power over blocks of (azimuth, range) samples.

    (..., azimuth, range) -> real (..., azimuth // a, range // r).

    Rows and columns that fill no whole block are dropped. Differentiable. Raises ValueError where a
    block exceeds the image.
    """
    azimuth, range_ = looks
    if not (1 <= azimuth <= image.shape[-2] and 1 <= range_ <= image.shape[-1]):
        raise ValueError(
            f"looks of {looks} (azimuth, range) do not fit an image of {tuple(image.shape[-2:])}; "
            "choose 1 up to its size"
        )
    x = power(image)
    return avg_pool2d(x.reshape(-1, 1, *x.shape[-2:]), looks).reshape(
        *x.shape[:-2], x.shape[-2] // azimuth, x.shape[-1] // range_
    )


def amplitude(image: Tensor, looks: tuple[int, int] = (1, 1)) -> Tensor:
    """Square root of the mean power over looks, real.

    Scaled by each trial's peak on the way, so that no level over- or underflows.
    """
    peak = image.detach().abs().amax((-2, -1), keepdim=True)
    mean = multilook(image / torch.where(peak > 0, peak, 1), looks) if image.is_complex() else multilook(image, looks)
    root = torch.where(mean > 0, torch.sqrt(mean.clamp_min(torch.finfo(mean.dtype).tiny)), 0)
    return root * peak if image.is_complex() else root


def to_db(power_: Tensor, floor_db: float = -120.0, reference: Tensor | None = None) -> Tensor:
    """10 lg of power over a reference, (..., azimuth, range): by default each trial's own maximum.

    Clamped at floor_db; an all-zero image is the floor.
    """
    top = power_.detach().amax((-2, -1)) if reference is None else reference
    top = top[..., None, None]
    ratio = power_ / torch.where(top > 0, top, 1)
    return 10 * torch.log10(ratio.clamp_min(10 ** (floor_db / 10)))


def quicklook_looks(shape: tuple[int, ...], step_m: tuple[float, float], size: int) -> tuple[int, int]:
    """Looks that bring an image of (azimuth, range) shape to at most `size` samples a side with
    cells as square as whole numbers allow.
    """
    azimuth, range_ = shape[-2:]
    side = max(azimuth * step_m[0], range_ * step_m[1]) / size
    looks = [max(1, min(n, round(side / step))) for n, step in zip((azimuth, range_), step_m, strict=True)]
    return max(looks[0], -(-azimuth // size)), max(looks[1], -(-range_ // size))


def _looked(axis: Axis, looks: int) -> Axis:
    """The axis of block means: samples at the middles of the blocks."""
    return Axis(axis.name, axis.n // looks, axis.start + (looks - 1) / 2 * axis.step, axis.step * looks, axis.unit)


class Detect(Stage):
    """Amplitude of a focused image, sqrt of the mean power over `looks` (azimuth, range); the axes
    follow.
    """

    works_on = ("azimuth", "range")

    def __init__(self, looks: tuple[int, int] = (1, 1)) -> None:
        super().__init__()
        self.looks = looks

    def forward(self, signal: Signal) -> Signal:
        data = amplitude(signal.data, self.looks)
        azimuth, range_ = signal.axes
        return Signal(data, (_looked(azimuth, self.looks[0]), _looked(range_, self.looks[1])))


class QuickLook(Stage):
    """Amplitude picture of at most `size` samples a side, cells as square in metres as whole looks
    allow.
    """

    works_on = ("azimuth", "range")

    def __init__(self, size: int = 1024) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"a quick-look needs a size of at least one sample, got {size}")
        self.size = size

    def forward(self, signal: Signal) -> Signal:
        azimuth, range_ = signal.axes
        return Detect(quicklook_looks(signal.data.shape, (azimuth.step, range_.step), self.size))(signal)
