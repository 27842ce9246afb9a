"""Stationary rough surfaces, such as a sea: clutter beneath moving targets."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, real_dtype, refuse_non_finite
from torchsar.scene.trials import finite, finite_numbers, refuse_unless, with_dims

# _REACH: largest number of standard deviations in the table of gamma numbers
# _NODES: number of its entries, between which linear interpolation has an error below 1e-4
_REACH, _NODES = 9.0, 4097


def _is_shape(x: Any) -> Any:
    """True for shapes of a gamma distribution for which the table was checked, 0.1 to 1000."""
    return (x >= 0.1) & (x <= 1000)


@dataclass(frozen=True, kw_only=True)
@finite_numbers("a sea", margin_s=None)
class Sea(ABC):
    """Surface of independent circular Gaussian scatterers with a local mean intensity.

    The scatterers form speckle. Their local mean intensity is called texture; each subclass defines
    its own.

    Args:
        power_db: Mean power in decibels of one sample of the clutter, in range-compressed data or
            in data without a range axis. For example, 0 dB with a noise variance of -20 dB is a
            clutter-to-noise ratio of 20 dB. The mean is over random draws: a single record with few
            texture cells may have more or less power.
        margin_s: Time by which the surface extends beyond the record at both ends in seconds, fixed
            for all trials. With None the surface reaches to the edge of the illumination, which for
            an antenna pattern is taken at half power. The surface is periodic: beyond one end the
            antenna sees the other end. With 0 the period is the length of the record. The
            simulation is then two to three times faster, but the Doppler spectrum has no leakage,
            unlike that of a real record.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface, fixed for all trials. It has no effect on an
            illumination without an antenna pattern. A sinc pattern has 10 % of its power beyond the
            first null and 5 % beyond the second. A simulation with two nulls needs about twice the
            Doppler band of one with a single null, and longer range lines.

    Raises:
        ValueError: If the power is not finite, the margin is negative or the number of lobes is not
            positive.
    """

    power_db: Tensor | float = 0.0
    margin_s: float | None = None
    lobes: int = 1

    def __post_init__(self) -> None:
        if self.margin_s is not None:
            sentence = "margin_s of a sea must be 0 s or more, or None to reach to the edge of the illumination"
            refuse_unless(sentence, self.margin_s, lambda x: finite(x) & (x >= 0))
        if not (isinstance(self.lobes, int) and self.lobes >= 1):
            raise ValueError(
                f"lobes of a sea must be a whole number of 1 or more, got {self.lobes}; it counts the nulls of the "
                "antenna pattern up to which the sea is illuminated"
            )

    @abstractmethod
    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        """Return the local mean intensity of a grid.

        Args:
            azimuth_m: Along-track positions of a grid in metres, shape (a,), float64.
            range_m: Range positions of the grid in metres, shape (r,), float64.
            draws: Random draws.

        Returns:
            The tensors table, row and column. Grid cell (i, j) has the mean intensity
            table[..., row[..., i], column[..., j]]. The table has the shape (..., rows, columns),
            float64, and unit mean. The indices have the shapes (a,) or (..., a) for row, and (r,)
            or (..., r) for column, int64.
        """

    def reflectivity(
        self, azimuth_m: Tensor, range_m: Tensor, draws: Draws, dtype: torch.dtype = torch.complex64
    ) -> Tensor:
        """Draw the complex amplitudes of the cells of a grid.

        Amplitudes have unit mean square and are independent except for their texture. A different
        grid has a different surface, also at positions that both grids share.

        Args:
            azimuth_m: Along-track positions in metres, zero below the receiver at slow time zero,
                in any order, shape (a,), float64.
            range_m: Closest ranges relative to the middle of the scene in metres, in any order,
                shape (r,), float64.
            draws: Random draws.
            dtype: Complex dtype of the result.

        Returns:
            Amplitudes, shape (..., a, r).
        """
        table, row, column = self.texture(azimuth_m, range_m, draws)
        root = torch.sqrt(table).to(real_dtype(dtype))
        speckle = draws.normal("sea.speckle", (len(azimuth_m), len(range_m)), dtype, azimuth_m.device)
        return speckle * _entries(_entries(root, row, -2), column, -1)


def _entries(table: Tensor, index: Tensor, dim: int) -> Tensor:
    """Select entries of a table (..., row, column) along a dimension at indices (n,) or
    (..., n).
    """
    if index.ndim == 1:
        return table.index_select(dim, index)
    trials = np.broadcast_shapes(table.shape[:-2], index.shape[:-1])
    index = index[..., None] if dim == -2 else index[..., None, :]
    shape = (index.shape[-2], table.shape[-1]) if dim == -2 else (table.shape[-2], index.shape[-1])
    return table.expand(*trials, -1, -1).gather(dim, index.expand(*trials, *shape))


@dataclass(frozen=True)
class KSea(Sea):
    """K-distributed clutter: speckle with a gamma-distributed texture.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> grid_m, sea = torch.arange(-100.0, 100.0), scene.KSea(shape=2.0, cell_m=(1.0, 1.0))
    >>> intensity = sea.reflectivity(grid_m, grid_m, Draws(seed=1)).abs().square()
    >>> round(float(intensity.square().mean() / intensity.mean().square()))
    3

    The intensity I satisfies <I^2> / <I>^2 = 2 (1 + 1 / shape). An image shows the K distribution
    where it resolves the texture cells.

    Args:
        shape: Shape of the gamma distribution, 0.1 to 1000, small for spiky seas; inf for pure
            speckle.
        cell_m: Along-track side and range side in metres of the rectangular texture cells, fixed
            for all trials. Each cell has one value of the texture. Neither side should be smaller
            than a cell of the simulation grid.
        power_db: Mean power in decibels of one sample of the clutter, in range-compressed data or
            in data without a range axis. For example, 0 dB with a noise variance of -20 dB is a
            clutter-to-noise ratio of 20 dB. The mean is over random draws: a single record with few
            texture cells may have more or less power.
        margin_s: Time by which the surface extends beyond the record at both ends in seconds, fixed
            for all trials. With None the surface reaches to the edge of the illumination, which for
            an antenna pattern is taken at half power. The surface is periodic: beyond one end the
            antenna sees the other end. With 0 the period is the length of the record. The
            simulation is then two to three times faster, but the Doppler spectrum has no leakage,
            unlike that of a real record.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface, fixed for all trials. It has no effect on an
            illumination without an antenna pattern. A sinc pattern has 10 % of its power beyond the
            first null and 5 % beyond the second. A simulation with two nulls needs about twice the
            Doppler band of one with a single null, and longer range lines.

    Raises:
        ValueError: If the shape or a side is out of range, or as for `Sea`.

    Reference:
        Ward, Tough and Watts, Sea Clutter, IET 2013 (compound model).
    """

    shape: Tensor | float = 1.5
    cell_m: tuple[float, float] = (20.0, 20.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_other_shape("shape of a K sea", self.shape)
        if len(self.cell_m) != 2 or not all(math.isfinite(side) and side > 0 for side in self.cell_m):
            raise ValueError(
                f"cell_m of a K sea must be two positive sides (m), along track and in range, got {self.cell_m}"
            )

    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        row, column = (
            _cells(positions, side) for positions, side in zip((azimuth_m, range_m), self.cell_m, strict=True)
        )
        counts = (int(row.max()) + 1, int(column.max()) + 1)
        return gamma_texture(self.shape, counts, draws, "sea.texture", row.device), row, column


@dataclass(frozen=True, eq=False)
@finite_numbers("an image", azimuth_extent_m="positive", range_extent_m="positive")
class ImageReflectivity(Sea):
    """Surface whose mean intensity is a given image; each trial draws its own speckle.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> coast = scene.ImageReflectivity([[0.0, 1.0]], azimuth_extent_m=100.0, range_extent_m=100.0)
    >>> line_m = torch.tensor([-25.0, 25.0], dtype=torch.float64)
    >>> coast.texture(line_m[:1], line_m, Draws(seed=1))[0].tolist()
    [[0.0, 2.0]]

    A cell of the simulation grid takes the value of the pixel in which it lies. Beyond the edges of
    the image its mirror image follows. The echo is differentiable in the intensity.

    Args:
        intensity: Image of shape (..., azimuth, range), an array or a tensor, real and not negative
            (of a complex image the squared magnitude is taken). It is divided by its mean.
        azimuth_extent_m: Along-track extent of the image in metres; its middle lies at azimuth
            zero.
        range_extent_m: Range extent of the image in metres; its middle lies at the reference range.
        power_db: Mean power in decibels of one sample of the clutter, in range-compressed data or
            in data without a range axis. For example, 0 dB with a noise variance of -20 dB is a
            clutter-to-noise ratio of 20 dB. The mean is over random draws: a single record with few
            texture cells may have more or less power.
        margin_s: Time by which the surface extends beyond the record at both ends in seconds, fixed
            for all trials. With None the surface reaches to the edge of the illumination, which for
            an antenna pattern is taken at half power. The surface is periodic: beyond one end the
            antenna sees the other end. With 0 the period is the length of the record. The
            simulation is then two to three times faster, but the Doppler spectrum has no leakage,
            unlike that of a real record.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface, fixed for all trials. It has no effect on an
            illumination without an antenna pattern. A sinc pattern has 10 % of its power beyond the
            first null and 5 % beyond the second. A simulation with two nulls needs about twice the
            Doppler band of one with a single null, and longer range lines.

    Raises:
        ValueError: If the image has fewer than two dimensions, NaN or negative pixels or a mean of
            zero, an extent is not positive, or as for `Sea`.
    """

    intensity: Any
    azimuth_extent_m: Tensor | float
    range_extent_m: Tensor | float

    def __post_init__(self) -> None:
        super().__post_init__()
        image = torch.as_tensor(self.intensity)
        image = (image.abs().square() if image.is_complex() else image).to(torch.float64)
        if image.ndim < 2 or not image.numel():
            raise ValueError(
                "intensity of a surface must be an array of shape (..., azimuth, range), got shape "
                f"{tuple(image.shape)}"
            )
        if not bool((torch.isfinite(image) & (image >= 0)).all() and (image.mean((-2, -1)) > 0).all()):
            raise ValueError(
                "intensity of a surface must be finite and not negative, with some pixels above 0, got values from "
                f"{float(image.min()):g} to {float(image.max()):g}; square an image of amplitudes first"
            )
        object.__setattr__(self, "intensity", image)

    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        image = self.intensity.to(azimuth_m.device)
        extents = zip((azimuth_m, range_m), (self.azimuth_extent_m, self.range_extent_m), image.shape[-2:])
        row, column = (_mirrored(at / with_dims(extent, 1, at), n) for at, extent, n in extents)
        return image / image.mean((-2, -1), keepdim=True), row, column


def refuse_other_shape(name: str, shape: Tensor | float) -> None:
    """Refuse what is no shape of a texture.

    Args:
        name: Name of the shape.
        shape: Shape of the gamma distribution, inf for pure speckle.

    Raises:
        ValueError: If a shape is out of range.
    """
    sentence = f"{name} must lie in 0.1..1000, or be inf for pure speckle"
    refuse_unless(sentence, shape, lambda x: _is_shape(x) | (x == math.inf))


def gamma_texture(
    shape: Tensor | float, counts: Sequence[int], draws: Draws, purpose: str, device: torch.device | None = None
) -> Tensor:
    """Draw the mean intensities of the cells of a texture.

    Args:
        shape: Shape of the gamma distribution, a number or (...,); with the number inf nothing is
            drawn.
        counts: Numbers of cells along azimuth and range.
        draws: Random draws.
        purpose: Purpose of the draws.
        device: Device of the result.

    Returns:
        Intensities of unit mean, shape (..., azimuth, range), float64.
    """
    if not isinstance(shape, Tensor) and shape == math.inf:
        return torch.ones(tuple(counts), dtype=torch.float64, device=device)
    normal = draws.normal(purpose, tuple(counts), device=device)
    return gamma_from_normal(normal, with_dims(shape, 2, normal))


def gamma_from_normal(x: Tensor, shape: Tensor | float) -> Tensor:
    """Transform standard normal numbers into gamma-distributed numbers of unit mean.

    Every number is replaced by the gamma number of the same cumulative probability, so that
    correlated normal fields become correlated gamma fields. The relative error is below 1e-4;
    normal numbers beyond 9 standard deviations are clamped.

    Args:
        x: Normal numbers of any shape, float64.
        shape: Shape of the gamma distribution, 0.1 to 1000: a number, or a tensor that broadcasts
            with x, in which inf gives ones. The result is not differentiable in the shape.

    Returns:
        Gamma numbers of the shape of x, float64.

    Raises:
        ValueError: If a shape is out of range, or a number is not finite.

    Reference:
        Tough and Ward 1999 (memoryless non-linear transform).
    """
    refuse_non_finite(x, "gamma_from_normal", "draw normal numbers", "numbers")
    if isinstance(shape, Tensor):
        known, which = shape.detach().to(x.device, torch.float64).unique(return_inverse=True)
        table = torch.cat([_gamma_table(one) if one < math.inf else torch.zeros(_NODES) for one in known.tolist()])
        first = which * _NODES
    else:
        table, first = _gamma_table(shape), 0
    table = table.to(x.device, torch.float64)
    position = (x.clamp(-_REACH, _REACH) + _REACH) * ((_NODES - 1) / (2 * _REACH))
    below = position.detach().floor().clamp(0, _NODES - 2).to(torch.int64)
    node = first + below
    return torch.exp(torch.lerp(table[node], table[node + 1], position - below))


@functools.lru_cache
def _gamma_table(shape: float) -> Tensor:
    """Logarithm of the gamma number at equally spaced normal numbers, found by bisection."""
    refuse_unless("shape of a gamma distribution must lie in 0.1..1000", shape, _is_shape)
    x = torch.linspace(-_REACH, _REACH, _NODES, dtype=torch.float64)
    # the smaller of the two tail probabilities of each number is used, since it has a smaller
    # relative error
    tail, order = torch.special.ndtr(-x.abs()), torch.full_like(x, shape)
    low = torch.full_like(x, -60 / min(shape, 1.0))
    high = torch.full_like(x, math.log(shape + 60 * math.sqrt(shape) + 100))
    for _ in range(60):
        middle = (low + high) / 2
        value = torch.exp(middle)
        below = torch.where(
            x < 0, torch.special.gammainc(order, value) < tail, torch.special.gammaincc(order, value) > tail
        )
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return low - math.log(shape)


def _cells(position_m: Tensor, side_m: float) -> Tensor:
    """Index of the texture cell of each position; one cell is centred on position zero."""
    cell = torch.round(position_m / side_m).to(torch.int64)
    return cell - cell.min()


def _mirrored(share: Tensor, n: int) -> Tensor:
    """Index of the pixel at positions in units of the image extent.

    The surface beyond the image consists of its mirror images and copies in turn.
    """
    pixel = torch.remainder(torch.floor((share + 0.5) * n).to(torch.int64), 2 * n)
    return torch.minimum(pixel, 2 * n - 1 - pixel)
