"""Detection of complex images: amplitude, multilooking, decibels and quick-look pictures."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchsar.core import Axis, Signal, Stage, checked_samples, host_value, level_of, power_of, unit_level
from torchsar.core.derivatives import is_differentiated


def power(image: Tensor) -> Tensor:
    """Compute |I|^2 of a complex image; a real image is returned as it is (already detected).

    Args:
        image: Image, shape (..., azimuth, range).

    Returns:
        Power, same shape, real.
    """
    return power_of(image) if image.is_complex() else image


def multilook(image: Tensor, looks: tuple[int, int]) -> Tensor:
    """Average the power over blocks of (azimuth, range) samples.

    >>> import torch
    >>> from torchsar.focus import multilook
    >>> multilook(torch.tensor([[1.0, 3.0, 5.0, 7.0], [1.0, 3.0, 9.0, 7.0]]), looks=(2, 2))
    tensor([[2., 7.]])

    Rows and columns that fill no whole block are dropped. Differentiable.

    Args:
        image: Image, shape (..., azimuth, range), complex, or real power.
        looks: Samples (a, r) of a block in azimuth and range.

    Returns:
        Mean power, shape (..., azimuth // a, range // r), real.

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples, a block exceeds the image, or the power overflows or
            underflows.
    """
    image = checked_samples(image, "multilook", "azimuth, range", real=True, finite=False)
    azimuth, range_ = looks
    if not (1 <= azimuth <= image.shape[-2] and 1 <= range_ <= image.shape[-1]):
        raise ValueError(
            f"looks (azimuth, range) must be at least 1 and at most the {tuple(image.shape[-2:])} samples of the "
            f"image, got {looks}"
        )
    _refuse_unsquarable(image)
    x = power(image)
    return avg_pool2d(x.reshape(-1, 1, *x.shape[-2:]), looks).reshape(
        *x.shape[:-2], x.shape[-2] // azimuth, x.shape[-1] // range_
    )


def _refuse_unsquarable(image: Tensor) -> None:
    """Raise ValueError if the power of complex samples overflows or underflows as a whole."""
    if not image.is_complex():
        return
    level = level_of(image)
    peak, limits = level.double().square() * 2, torch.finfo(level.dtype)
    if host_value(((peak > limits.max / 4) | (peak < limits.tiny)).any(), False):
        raise ValueError(
            f"multilook: the power of samples of about {float(level.max()):.3g} does not fit {level.dtype}; divide the "
            "image by its peak, convert it to complex128, or use `amplitude`"
        )


def amplitude(image: Tensor, looks: tuple[int, int] = (1, 1)) -> Tensor:
    """Compute the amplitude of an image: the square root of the mean power of blocks of samples.

    >>> import torch
    >>> from torchsar.focus import amplitude
    >>> amplitude(torch.full((4, 6), 3 + 4j), looks=(2, 3))
    tensor([[5., 5.],
            [5., 5.]])

    Complex images are divided by their level before squaring and multiplied by it afterwards, so
    that very large or small values neither overflow nor underflow.

    Args:
        image: Image, shape (..., azimuth, range), complex, or real power.
        looks: Samples (a, r) of a block in azimuth and range.

    Returns:
        Amplitude, shape (..., azimuth // a, range // r), real.

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples, or if a block exceeds the image.
    """
    image = checked_samples(image, "amplitude", "azimuth, range", real=True, finite=False)
    if image.is_complex() and tuple(looks) == (1, 1):
        # torch.abs makes a complex copy in between, but has a derivative at zero
        return image.abs() if is_differentiated(image) else torch.hypot(image.real, image.imag)
    level = level_of(image)
    mean = multilook(image / level, looks) if image.is_complex() else multilook(image, looks)
    root = torch.where(mean <= 0, 0, torch.sqrt(mean.clamp_min(torch.finfo(mean.dtype).tiny)))
    return root * level if image.is_complex() else root


def to_db(power_: Tensor, floor_db: float = -120.0, reference: Tensor | None = None) -> Tensor:
    """Convert power to decibels relative to a reference, 10 log10(power / reference).

    >>> import torch
    >>> from torchsar.focus import to_db
    >>> to_db(torch.tensor([[1.0, 0.1], [0.01, 0.0]]))
    tensor([[   0.,  -10.],
            [ -20., -120.]])

    Args:
        power_: Power, shape (..., azimuth, range).
        floor_db: Least value in dB; an all-zero image has this value.
        reference: Reference power, shape (...,); None for the maximum of each trial.

    Returns:
        Power in dB, same shape.

    Raises:
        ValueError: If the power is no tensor of real floating-point numbers, or empty.
    """
    if not isinstance(power_, Tensor) or not power_.is_floating_point() or power_.ndim < 2 or not power_.numel():
        got = f"{power_.dtype} of shape {tuple(power_.shape)}" if isinstance(power_, Tensor) else type(power_).__name__
        raise ValueError(f"to_db converts real power (..., azimuth, range) with at least one sample, got {got}")
    power_ = unit_level(power_) if reference is None else power_  # derivatives do not overflow
    top = power_.amax((-2, -1)) if reference is None else reference
    top = top[..., None, None]
    ratio = power_ / torch.where(top > 0, top, 1)
    return 10 * torch.log10(ratio.clamp_min(10 ** (floor_db / 10)))


def quicklook_looks(shape: tuple[int, ...], step_m: tuple[float, float], size: int) -> tuple[int, int]:
    """Choose how many samples to average for a picture of limited size with nearly square cells.

    Args:
        shape: Shape of the image, ending in (azimuth, range).
        step_m: Sample spacing of the image in azimuth and range in metres.
        size: Largest number of samples per side of the picture.

    Returns:
        Samples to average in azimuth and in range, the looks of `multilook`.
    """
    azimuth, range_ = shape[-2:]
    side = max(azimuth * step_m[0], range_ * step_m[1]) / size
    looks = [max(1, min(n, round(side / step))) for n, step in zip((azimuth, range_), step_m, strict=True)]
    return max(looks[0], -(-azimuth // size)), max(looks[1], -(-range_ // size))


def _looked(axis: Axis, looks: int) -> Axis:
    """Axis of block means, with each sample in the middle of its block."""
    return Axis(axis.name, axis.n // looks, axis.start + (looks - 1) / 2 * axis.step, axis.step * looks, axis.unit)


class Detect(Stage):
    """Stage that computes the amplitude of a focused image, see `amplitude`.

    >>> import torch
    >>> from torchsar import Axis, Signal, focus
    >>> axes = (Axis("azimuth", 4, 0.0, 1.0, "m"), Axis("range", 6, 0.0, 1.0, "m"))
    >>> image = focus.Detect(looks=(2, 3))(Signal(torch.full((4, 6), 3 + 4j), axes))
    >>> image.data.tolist(), [axis.step for axis in image.axes]
    ([[5.0, 5.0], [5.0, 5.0]], [2.0, 3.0])

    The samples of a real image are amplitudes, such as those of an earlier `Detect`.

    Args:
        looks: Samples of a block in azimuth and range, over which the power is averaged.

    Raises:
        ValueError: If `looks` are not two numbers of at least 1.
    """

    works_on = ("azimuth", "range")
    takes_real = True

    def __init__(self, looks: Sequence[int] = (1, 1)) -> None:
        super().__init__()
        if len(looks) != 2 or min(looks) < 1:
            raise ValueError(f"looks must be two numbers of at least 1, in azimuth and range, got {list(looks)}")
        self.looks = (looks[0], looks[1])

    def axes(self, image: Sequence[Axis]) -> tuple[Axis, Axis]:
        """Return the axes of the amplitude; they have one sample in the middle of each block.

        Args:
            image: Axes (azimuth, range) of the image.
        """
        azimuth, range_ = image
        return _looked(azimuth, self.looks[0]), _looked(range_, self.looks[1])

    def forward(self, signal: Signal) -> Signal:
        """Compute the amplitude of an image with axes (azimuth, range).

        Args:
            signal: Focused image.

        Returns:
            Amplitude, real; the axes have one sample in the middle of each block.

        Raises:
            ValueError: If a block exceeds the image.
        """
        data = signal.data
        if data.is_complex():
            return Signal(amplitude(data, self.looks), self.axes(signal.axes))
        level = level_of(data)
        return Signal(amplitude((data / level).square(), self.looks) * level, self.axes(signal.axes))


class QuickLook(Stage):
    """Stage that makes an amplitude picture of limited size with cells nearly square in metres.

    >>> import torch
    >>> from torchsar import Axis, Signal, focus
    >>> axes = (Axis("azimuth", 400, 0.0, 1.0, "m"), Axis("range", 60, 0.0, 2.0, "m"))
    >>> picture = focus.QuickLook(size=100)(Signal(torch.ones(400, 60) + 0j, axes))
    >>> picture.data.shape, [axis.step for axis in picture.axes]
    (torch.Size([100, 30]), [4.0, 4.0])

    The samples of a real image are amplitudes, such as those of `Detect`.

    Args:
        size: Largest number of samples per side of the picture.

    Raises:
        ValueError: If `size` is below 1.
    """

    works_on = ("azimuth", "range")
    takes_real = True

    def __init__(self, size: int = 1024) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"size of a QuickLook must be at least 1 sample per side, got {size}")
        self.size = size

    def detect(self, image: Sequence[Axis]) -> Detect:
        """Return the stage that averages an image with given axes.

        Args:
            image: Axes (azimuth, range) of the image.
        """
        azimuth, range_ = image
        return Detect(quicklook_looks((azimuth.n, range_.n), (azimuth.step, range_.step), self.size))

    def forward(self, signal: Signal) -> Signal:
        """Reduce an image with axes (azimuth, range) to an amplitude picture of limited size.

        Args:
            signal: Focused image.

        Returns:
            Amplitude, real, with the mean power of each block of samples.
        """
        return self.detect(signal.axes)(signal)
