"""Detection of moving targets in an image, by the mean intensity of small rectangles of pixels.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchsar.core import Signal, checked_samples, differentiable, unit_level


@dataclass(frozen=True)
class Detection:
    """Position of one detection in an image.

    Args:
        azimuth_m: Azimuth x = V_R t of the intensity centre in metres, with the speed V_R of the
            receiver.
        range_m: Range of the intensity centre in metres.
        contrast_db: Mean intensity of the brightest neighbourhood, a small rectangle of pixels,
            relative to the median over all neighbourhoods of the image in dB.
    """

    azimuth_m: float
    range_m: float
    contrast_db: float


def contrast(image: Signal, extent_m: tuple[float, float] = (60.0, 10.0)) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Compute the mean intensity of small rectangles of pixels relative to the median of all.

    The rectangles (neighbourhoods) overlap by half along both axes.

    Args:
        image: Image (azimuth, range), complex.
        extent_m: Extent of a neighbourhood in azimuth and range in metres.

    Returns:
        The contrast (intensity ratio), float64 (..., row, column), and the azimuths (row,) and
        ranges (column,) of the middles of the neighbourhoods in metres.
    """
    azimuth, range_ = image.axes
    size = tuple(
        min(axis.n, max(2, 2 * round(extent / axis.step / 2)))
        for axis, extent in zip((azimuth, range_), extent_m, strict=True)
    )
    intensity = unit_level(image.data.detach()).abs().square().to(torch.float64)
    mean = avg_pool2d(
        intensity.flatten(0, -3)[:, None] if intensity.ndim > 2 else intensity[None, None],
        size,
        stride=(max(1, size[0] // 2), max(1, size[1] // 2)),
    )
    mean = mean[:, 0].unflatten(0, image.trials) if image.trials else mean[0, 0]
    typical = mean.flatten(-2).median(-1).values.clamp_min(torch.finfo(torch.float64).tiny)
    middles = [
        axis.start
        + axis.step * ((n - 1) / 2 + max(1, n // 2) * torch.arange(count, dtype=torch.float64, device=mean.device))
        for axis, n, count in zip((azimuth, range_), size, mean.shape[-2:], strict=True)
    ]
    return mean / typical[..., None, None], (middles[0], middles[1])


@differentiable("no")
def detect(
    image: Signal,
    threshold_db: float = 10.0,
    extent_m: tuple[float, float] = (60.0, 10.0),
    apart_m: tuple[float, float] = (200.0, 40.0),
    most: int = 16,
) -> list[Detection]:
    """Detect bright targets in one image, strongest first.

    >>> import torch
    >>> from torchsar import Axis, Signal, multichannel
    >>> axes = Axis("azimuth", 256, -256.0, 2.0, "m"), Axis("range", 64, 4840.0, 5.0, "m")
    >>> image = torch.ones(256, 64, dtype=torch.complex64)
    >>> image[168:188, 31:34] = 10  # a ship at 99 m
    >>> [(round(x.azimuth_m), round(x.range_m)) for x in multichannel.detect(Signal(image, axes))]
    [(98, 5000)]

    The image is divided into rectangles of pixels (neighbourhoods) that overlap by half. Their
    contrast is the mean intensity relative to the median over all of them. Any two detections are
    at least `apart_m` apart along one of the axes. The position of a detection is the
    contrast-weighted mean position of all neighbourhoods that lie within `apart_m` of the brightest
    one and have more than a quarter of its contrast.

    Args:
        image: Image (azimuth, range) without trials, complex.
        threshold_db: Least contrast of a detection in dB.
        extent_m: Extent of a neighbourhood in azimuth and range in metres.
        apart_m: Least separation in azimuth and range in metres.
        most: Largest number of detections.

    Returns:
        The detections, strongest first.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If the image has trials or no samples, or a sample is not finite.
    """
    if image.trials:
        raise ValueError(
            "detect works on one image at a time, got images with the trial dimensions "
            f"{tuple(image.trials)}; call it for each image separately"
        )
    image = image.with_data(checked_samples(image.data, "detect", ", ".join(image.names)))
    level, (rows, columns) = contrast(image, extent_m)
    left, found = level.clone(), []
    while len(found) < most and float(left.max()) >= 10 ** (threshold_db / 10):
        peak = float(left.max())
        row, column = divmod(int(left.argmax()), left.shape[1])
        near = ((rows - rows[row]).abs() < apart_m[0])[:, None] & ((columns - columns[column]).abs() < apart_m[1])
        bright = torch.where(near & (level > peak / 4), level, 0.0)
        azimuth, range_ = ((bright.sum(dim) * middle).sum() / bright.sum() for dim, middle in ((1, rows), (0, columns)))
        found.append(Detection(float(azimuth), float(range_), 10 * float(torch.log10(torch.tensor(peak)))))
        left = torch.where(near, 0.0, left)
    return found
