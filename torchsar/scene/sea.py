"""The surface a moving target lies on: stationary, rough, and the same for every channel."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, real_dtype
from torchsar.scene.vibration import refuse_unless_finite

_SHAPES = (0.1, 1000.0)
# deviations and entries of the table that turns normal into gamma numbers
_REACH, _NODES = 9.0, 4097


@dataclass(frozen=True, kw_only=True)
class Sea(ABC):
    """A surface of independent circular Gaussian scatterers (speckle), the local mean intensity of
    which (texture) is what a kind of sea describes.

    power_db: mean power of one sample of azimuth-only or range-compressed data, a number or one per
    trial (...,): against noise of -20 dB per sample, 0 dB is a clutter-to-noise ratio of 20 dB, and
    a target of amplitude 1 stands at -power_db above it. It is the mean over draws: a record that
    covers few cells of texture may hold more or less. margin_s: how much further than the record
    the surface reaches at both ends. None: as far as the gate sees, through an antenna pattern with
    half the power. What is seen from further away stands in from the other end. With 0 the surface
    closes to a ring as long as the record: two to three times cheaper, but its Doppler bins are
    then free of leakage, as no record's are. lobes: nulls to either side up to which an antenna
    pattern lights the surface. Beyond the first lie 10 % of the power of a sinc, beyond the second
    5 %; the second one costs about twice the Doppler band, and longer lines. Raises ValueError for
    a power, margin or number of lobes that is none.
    """

    power_db: Tensor | float = 0.0
    margin_s: float | None = None
    lobes: int = 1

    def __post_init__(self) -> None:
        refuse_unless_finite("power_db of a sea", self.power_db)
        if self.margin_s is not None and not (math.isfinite(self.margin_s) and self.margin_s >= 0):
            raise ValueError(
                f"margin_s of a sea must be 0 s or more, or None for as far as the gate sees, got {self.margin_s}"
            )
        if not (isinstance(self.lobes, int) and self.lobes >= 1):
            raise ValueError(f"lobes of a sea must be a whole number of 1 or more, got {self.lobes}")

    @abstractmethod
    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        """Mean intensity, unity on average, as a table (..., row, column) of float64 with the row
        of each azimuth (a,) and the column of each range (r,), int64.
        """

    def reflectivity(
        self, azimuth_m: Tensor, range_m: Tensor, draws: Draws, dtype: torch.dtype = torch.complex64
    ) -> Tensor:
        """Complex amplitudes of the cells of a grid, (..., a, r), of unit mean square and
        independent but for their texture.

        azimuth_m: place along track (a,), zero under the receiver at slow time zero; range_m:
        closest slant range less that of the middle of the scene (r,); float64, in any order. The
        numbers drawn belong to the grid: another grid has another surface.
        """
        table, row, column = self.texture(azimuth_m, range_m, draws)
        root = torch.sqrt(table).to(real_dtype(dtype))
        speckle = draws.normal("sea.speckle", (len(azimuth_m), len(range_m)), dtype, azimuth_m.device)
        return speckle * root.index_select(-2, row).index_select(-1, column)


@dataclass(frozen=True)
class KSea(Sea):
    """K-distributed clutter: gamma texture of the given shape times speckle, so that <I^2> / <I>^2
    = 2 (1 + 1 / shape).

    shape: 0.1..1000, small for spiky seas, or inf for a surface of pure speckle. cell_m: sides
    along track and in closest range of the rectangles that share one texture, none smaller than a
    cell of the grid; an image shows the K distribution where it resolves them. Source: Ward, Tough
    and Watts, Sea Clutter, IET 2013, compound model; shape 1.5 is that of brief 001.
    """

    shape: float = 1.5
    cell_m: tuple[float, float] = (20.0, 20.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (_SHAPES[0] <= self.shape <= _SHAPES[1] or self.shape == math.inf):
            raise ValueError(
                f"shape of a K sea must lie in {_SHAPES[0]:g}..{_SHAPES[1]:g}, or be inf for pure "
                f"speckle, got {self.shape}"
            )
        if len(self.cell_m) != 2 or not all(math.isfinite(side) and side > 0 for side in self.cell_m):
            raise ValueError(
                f"cell_m of a K sea must be two positive sides (m), along track and in range, got {self.cell_m}"
            )

    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        row, column = (_cells(places, side) for places, side in zip((azimuth_m, range_m), self.cell_m, strict=True))
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        if self.shape == math.inf:
            return torch.ones(shape, dtype=torch.float64, device=row.device), row, column
        return gamma_from_normal(draws.normal("sea.texture", shape, device=row.device), self.shape), row, column


@dataclass(frozen=True, eq=False)
class ImageReflectivity(Sea):
    """A surface whose mean intensity is an image: a recorded scene of any origin under speckle of
    its own.

    intensity: array or tensor (..., azimuth, range), real and not negative (complex images count by
    their squared magnitude); its level is normalised away. azimuth_extent_m, range_extent_m: what
    it covers, its middle at azimuth 0 and at the reference range; beyond its edges it is mirrored.
    A cell takes the value of the pixel it lies in. Differentiable in the intensity. Raises
    ValueError for an image with NaN or negative pixels or with nothing in it.
    """

    intensity: Any
    azimuth_extent_m: float
    range_extent_m: float

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("azimuth_extent_m", "range_extent_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} of an image must be a positive number of metres, got {getattr(self, name)}")
        image = torch.as_tensor(self.intensity)
        image = (image.abs().square() if image.is_complex() else image).to(torch.float64)
        if image.ndim < 2 or not image.numel():
            raise ValueError(
                f"an image of a surface needs the dims (azimuth, range), got an array of shape {tuple(image.shape)}"
            )
        if not bool((torch.isfinite(image) & (image >= 0)).all() and (image.mean((-2, -1)) > 0).all()):
            raise ValueError(
                "an image of a surface holds intensities: finite, not negative, and some above zero; "
                "square an image of amplitudes first"
            )
        object.__setattr__(self, "intensity", image)

    @staticmethod
    def from_file(
        path: str | Path, azimuth_extent_m: float, range_extent_m: float, key: str | None = None, **changes: Any
    ) -> ImageReflectivity:
        """The image in a .npy file, or in the array `key` of an .npz file (not needed if it holds
        just one). Raises FileNotFoundError, or ValueError naming the file.
        """
        return ImageReflectivity(_image(Path(path), key), azimuth_extent_m, range_extent_m, **changes)

    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        image = self.intensity.to(azimuth_m.device)
        row, column = (
            _mirrored(azimuth_m / self.azimuth_extent_m, image.shape[-2]),
            _mirrored(range_m / self.range_extent_m, image.shape[-1]),
        )
        return image / image.mean((-2, -1), keepdim=True), row, column


def gamma_from_normal(x: Tensor, shape: float) -> Tensor:
    """Standard normal numbers turned into gamma numbers of unit mean and the given shape, rank for
    rank; float64, any shape, relative error below 1e-4.

    Correlated normal fields become correlated gamma fields (the memoryless transform of Tough and
    Ward 1999). Raises ValueError for a shape outside 0.1..1000.
    """
    table = _gamma_table(shape).to(x.device)
    place = (x.clamp(-_REACH, _REACH) + _REACH) * ((_NODES - 1) / (2 * _REACH))
    node = place.detach().floor().clamp(0, _NODES - 2).to(torch.int64)
    return torch.exp(torch.lerp(table[node], table[node + 1], place - node))


@functools.lru_cache
def _gamma_table(shape: float) -> Tensor:
    """Logarithm of the unit-mean gamma number at as many normal deviations from -9 to 9, by
    bisection of whichever tail is the smaller.
    """
    if not _SHAPES[0] <= shape <= _SHAPES[1]:
        raise ValueError(f"gamma numbers are made for shapes of {_SHAPES[0]:g} to {_SHAPES[1]:g}, got {shape}")
    x = torch.linspace(-_REACH, _REACH, _NODES, dtype=torch.float64)
    tail, order = torch.special.ndtr(-x.abs()), torch.full_like(x, shape)
    low, high = (
        torch.full_like(x, -60 / min(shape, 1.0)),
        torch.full_like(x, math.log(shape + 60 * math.sqrt(shape) + 100)),
    )
    for _ in range(60):
        middle = (low + high) / 2
        value = torch.exp(middle)
        below = torch.where(
            x < 0, torch.special.gammainc(order, value) < tail, torch.special.gammaincc(order, value) > tail
        )
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return low - math.log(shape)


def _cells(places_m: Tensor, side_m: float) -> Tensor:
    """Number of the cell each place lies in, from 0 on; the middle of a cell lies at zero."""
    cell = torch.round(places_m / side_m).to(torch.int64)
    return cell - cell.min()


def _mirrored(share: Tensor, n: int) -> Tensor:
    """Pixel of n that a place falls on, in shares of the extent from its middle; the image and its
    mirror image take turns.
    """
    pixel = torch.remainder(torch.floor((share + 0.5) * n).to(torch.int64), 2 * n)
    return torch.minimum(pixel, 2 * n - 1 - pixel)


def _image(path: Path, key: str | None) -> Tensor:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; give the path of a .npy or .npz file with the image of a surface"
        )
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return torch.as_tensor(loaded)
        with loaded:
            names = list(loaded.files)
            key = names[0] if key is None and len(names) == 1 else key
            if key in names:
                return torch.as_tensor(loaded[key])
    except (ValueError, OSError, TypeError) as error:
        raise ValueError(f"{path} is no numpy file of plain numbers ({error})") from None
    raise ValueError(f"{path} holds the arrays {names}; name the one to use, got key={key!r}")
