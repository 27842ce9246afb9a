"""Targets that stand out of the sea: places in an image at which the mean intensity of a
neighbourhood exceeds what is usual.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchsar.core import Signal


@dataclass(frozen=True)
class Detection:
    """One place: azimuth x = V_R t and range (m) of the middle of the neighbourhood, and how far it
    stands above the median of the image.
    """

    azimuth_m: float
    range_m: float
    contrast_db: float


def contrast(image: Signal, extent_m: tuple[float, float] = (60.0, 10.0)) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Mean intensity over neighbourhoods of extent_m, half overlapping, over the median of all:
    (..., row, column), and the azimuths (row,) and ranges (column,) of their middles (m).
    """
    azimuth, range_ = image.axes
    size = tuple(
        min(axis.n, max(2, 2 * round(extent / axis.step / 2)))
        for axis, extent in zip((azimuth, range_), extent_m, strict=True)
    )
    intensity = image.data.detach().abs().square().to(torch.float64)
    mean = avg_pool2d(
        intensity.flatten(0, -3)[:, None] if intensity.ndim > 2 else intensity[None, None],
        size,
        stride=(size[0] // 2, size[1] // 2),
    )
    mean = mean[:, 0].unflatten(0, image.trials) if image.trials else mean[0, 0]
    usual = mean.flatten(-2).median(-1).values.clamp_min(torch.finfo(torch.float64).tiny)
    places = [
        axis.start + axis.step * ((n - 1) / 2 + n // 2 * torch.arange(count, dtype=torch.float64))
        for axis, n, count in zip((azimuth, range_), size, mean.shape[-2:], strict=True)
    ]
    return mean / usual[..., None, None], (places[0], places[1])


def detect(
    image: Signal,
    threshold_db: float = 10.0,
    extent_m: tuple[float, float] = (60.0, 10.0),
    apart_m: tuple[float, float] = (200.0, 40.0),
    most: int = 16,
) -> list[Detection]:
    """Places of one image (azimuth, range), strongest first, at least apart_m from each other along
    one axis. The place is the centre of intensity of all that is bright there.
    """
    if image.trials:
        raise ValueError(f"detect works on one image at a time, got trials {tuple(image.trials)}")
    level, (rows, columns) = contrast(image, extent_m)
    left, found = level.clone(), []
    while len(found) < most and float(left.max()) >= 10 ** (threshold_db / 10):
        peak = float(left.max())
        row, column = divmod(int(left.argmax()), left.shape[1])
        near = ((rows - rows[row]).abs() < apart_m[0])[:, None] & ((columns - columns[column]).abs() < apart_m[1])
        bright = torch.where(near & (level > peak / 4), level, 0.0)
        azimuth, range_ = ((bright.sum(dim) * place).sum() / bright.sum() for dim, place in ((1, rows), (0, columns)))
        found.append(Detection(float(azimuth), float(range_), 10 * float(torch.log10(torch.tensor(peak)))))
        left = torch.where(near, 0.0, left)
    return found
