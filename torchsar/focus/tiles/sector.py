"""Images by tiles for pulses that see the scene from about the same side."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchsar.core import block_bytes_of, is_plain, over_blocks, untraced
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.choice import GROUP, Costly, Unsuitable, choose, error_db
from torchsar.focus.tiles.direct import Direct
from torchsar.focus.tiles.expansion import slopes
from torchsar.focus.tiles.part import Band, Part, Tables
from torchsar.focus.tiles.scene import Lit, Scene, Weight, part_bounds, tile_centres, tile_heights
from torchsar.radar.stripmap import LIGHT_M_S

# Largest size of the tables of the pulses, and of the weights of the tiles (384 MB each), that are
# kept for the next image, by choice. A small machine has that much memory to spare.
_KEPT_BYTES = 3 << 27
# bytes of profiles that are formed at once, by choice, which limits the memory of the padded
# spectra
_PROFILE_BYTES = 1 << 25


class _Kept(dict):
    """Results of an image that the next image of the same form needs.

    Args:
        count: Largest number of complex values that one image adds.
        share: Share of the memory that they may take, 0 to 1.
    """

    def __init__(self, count: int, share: float) -> None:
        super().__init__()
        self.count, self.share, self.form = count, share, None

    def begin(self, dtype: torch.dtype, tiles: int) -> None:
        """Discard what images of another precision, or with another number of tiles at once, have
        left.
        """
        if self.form != (dtype, tiles):
            self.clear()
            self.form = dtype, tiles

    def keep(self, key: tuple, value: Any, dtype: torch.dtype) -> None:
        """Keep a value, unless the values of an image of this precision would be too large
        together.
        """
        if self.fits(dtype):
            self[key] = value

    def fits(self, dtype: torch.dtype) -> bool:
        """True if the values of an image of this precision are kept."""
        return self.count * dtype.itemsize <= self.share * _KEPT_BYTES


class Sector:
    """Sums of the pulses of a path by tiles.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        places: Positions of one or two antennas, each float64 (path, pulse, 3).
        reference_m: Path to which the phases refer in metres, float64 (path, pulse).
        grid: Pixels.
        error_db: Largest error relative to the image of white noise, in dB.
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.
        kept: Share of the memory that tables and weights may take, 0 to 1.
        images: Number of images that share the plan, see `TilePlan`.

    Raises:
        Costly: If tiles take longer than the direct sum.
        Unsuitable: If tiles do not reach the error in this geometry.
    """

    def __init__(
        self,
        frequency_hz: Tensor,
        places: Sequence[Tensor],
        reference_m: Tensor,
        grid: ImageGrid,
        error_db: float,
        lit: Lit | None = None,
        weight: Weight | None = None,
        kept: float = 1.0,
        images: float | None = None,
    ) -> None:
        self.frequency_hz, self.grid, self.error_db, self._images = frequency_hz, grid, error_db, images
        self.lit, self.weight, self._share = lit, weight, kept
        self._places, self._reference_m = places, reference_m
        with torch.no_grad():
            self._plan([place.detach() for place in places])

    def _plan(self, every: Sequence[Tensor]) -> None:
        """Choose the sizes, and compute everything that does not depend on the history."""
        nominal = [place.mean(0) for place in every]
        grid = self.grid
        scene = Scene(self.frequency_hz, LIGHT_M_S, nominal, every, grid, self.lit, self.weight)
        # the second axis of a tile is that of the range, as seen by the pulses that light the
        # middle
        middle = scene.spread[1, 1][None]
        first, last = scene.lit_pulses(middle)[0].tolist()
        if scene.weighted:
            scene.weights(middle)  # raises ValueError for weights of another shape or type
        _, a, b = slopes([v[first : max(last, first + 1)] for v in nominal], middle, grid.axes)
        self._swapped = float(a.abs().mean()) > float(b.abs().mean())
        if self._swapped:
            grid = grid.transposed()
            scene = replace(scene, grid=grid)
        self._scene = scene
        # the tables of the choice are on the host, independently of the default device
        with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
            self.choice = choice = choose(scene, self.error_db, self._images)
        self._size = size = choice.width, choice.depth
        self._band = Band.of(self.frequency_hz, LIGHT_M_S, choice.oversampling)
        self._tiles = tuple(-(-n // m) for n, m in zip(grid.counts, size, strict=True))
        self._numbers: list[Tensor] = []
        self._zones: list[list[Part]] = []
        self._height_m, relief = scene.relief(*size)
        for block, pulses in scene.zones(*size):
            i, j = (torch.arange(s.start, s.stop, device=grid.origin_m.device) for s in block)
            self._numbers.append((i[:, None] * self._tiles[1] + j).reshape(-1))
            centre = tile_centres(grid, *size, i, j, self._height_m)
            bounds = part_bounds(*pulses, choice.parts)
            given = nominal, every, centre, grid, relief, scene.weights if scene.weighted else None
            self._zones.append([Part(self._band, choice, ends, *given) for ends in bounds])
        parts = [part for zone in self._zones for part in zone]
        self._table_count = sum(part.table_count for part in parts)
        self._tables = _Kept(len(every[0]) * self._table_count, self._share)
        self._weights = _Kept(sum(part.weight_count for part in parts), self._share)

    def moved(self, places: Sequence[Tensor], reference_m: Tensor) -> Sector | Direct:
        """Return the sums of a path that differs little; a new plan where it differs too much.

        Args:
            places: Positions of one or two antennas, each float64 (path, pulse, 3).
            reference_m: Path to which the phases refer in metres, float64 (path, pulse).
        """
        moved = copy.copy(self)
        moved._places, moved._reference_m = places, reference_m
        every = [place.detach() for place in places]
        moved._tables = _Kept(len(every[0]) * moved._table_count, self._share)
        with torch.no_grad():
            predicted = self._error_db(every)
            # predictions for changed paths are correct within 1 dB, and 3 dB in all are promised
            if predicted <= self.error_db + 2:
                moved.choice = replace(self.choice, error_db=predicted)
            else:
                given = self.frequency_hz, places, reference_m, self.grid, self.error_db, self.lit, self.weight
                return planned(*given, self._share, self._images)
        return moved

    def _error_db(self, places: Sequence[Tensor]) -> float:
        """Predicted error in dB of the present plan for other positions, each float64 (path, pulse,
        3).

        It is infinite if they differ in number or leave the range of the nodes and windows of the
        plan.
        """
        if [v.shape[1:] for v in places] != [v.shape[1:] for v in self._places]:
            return math.inf
        covered = all(part.covers(places) for zone in self._zones for part in zone)
        return error_db(self._scene.judging(places), self.choice) if covered else math.inf

    def image(self, data: Tensor) -> Tensor:
        """Form the images of histories (path, trial, pulse, frequency), (path * trial, i, j)."""
        # shape (tile, tile, path * trial, x, y)
        tiles = self._formed(data.transpose(1, 2)).unflatten(0, self._tiles)
        image = tiles.permute(2, 0, 3, 1, 4).flatten(1, 2).flatten(-2)
        if self._swapped:
            image = image.mT
        return image[:, : self.grid.counts[0], : self.grid.counts[1]]

    def _formed(self, data: Tensor) -> Tensor:
        """Form all tiles, (tile, path * trial, x, y), of data (path, pulse, trial, frequency)."""
        profiles = self._profiles(data)
        paths, _, trials, _ = data.shape
        step = max(1, GROUP // (paths * trials))
        for kept in (self._tables, self._weights):
            kept.begin(data.dtype, step)
        with untraced():
            heights = tile_heights(self.grid.transposed() if self._swapped else self.grid, *self._size)
            if heights is not None:
                assert self._height_m is not None
                heights = (heights - self._height_m[..., None, None]).flatten(0, 1)
        found: list[Tensor] = []
        given = [data, *self._places, self._reference_m, *([] if heights is None else [heights])]
        grad = torch.is_grad_enabled() and any(v.requires_grad for v in given)
        # If only the history requires gradients, the autograd graph holds only the tables and
        # weights, which are kept in any case, and the window indices. Otherwise the pixels are
        # computed again in the backward pass.
        linear = trials <= GROUP and not any(v.requires_grad for v in given[1:])
        linear = linear and self._tables.fits(data.dtype) and self._weights.fits(data.dtype)
        linear = linear or not all(map(is_plain, given))  # torch.func takes no checkpoints
        pixels = self._pixels if linear else partial(checkpoint, self._pixels, use_reentrant=False)
        count = 0 if grad else math.prod(self._tiles)
        tiles = data.new_empty(count, paths * trials, *self._size)
        for zone, numbers in zip(self._zones, self._numbers, strict=True):
            across = [self._weights_of((part,), data.dtype, part.across, data.dtype) for part in zone]
            with untraced():
                above = None if heights is None else heights[numbers]
            rows = [slice(i, min(i + step, len(numbers))) for i in range(0, len(numbers), step)]
            if grad:
                fixed = across, profiles, above
                found += [pixels(zone, some, *fixed) for some in rows]
                continue

            def work(some: slice) -> None:
                tiles[numbers[some]] = self._pixels(zone, some, across, profiles, above)  # noqa: B023

            over_blocks(work, rows, data)
        return torch.cat(found)[torch.argsort(torch.cat(self._numbers))] if grad else tiles

    def _profiles(self, data: Tensor) -> Tensor:
        """Range profiles of data (path, pulse, trial, frequency), with their first samples repeated
        at the end.
        """
        longest = max((part.samples for zone in self._zones for part in zone), default=0)
        length = self._band.length
        whole = data.new_empty(*data.shape[:-1], length + longest)
        step = max(1, _PROFILE_BYTES // (whole[:, :1].numel() * whole.element_size()))
        for i in range(0, data.shape[1], step):
            whole[:, i : i + step, :, :length] = self._band.profiles(data[:, i : i + step])
        whole[..., length:] = whole[..., torch.arange(longest, device=data.device) % length]
        return whole

    def _pixels(
        self,
        zone: Sequence[Part],
        rows: slice,
        across: Sequence[list[Tensor]],
        profiles: Tensor,
        height_m: Tensor | None,
    ) -> Tensor:
        """Form the pixels of some tiles, summed over the sub-apertures, (tile, path *
        trial, x, y).
        """
        paths, _, trials, _ = profiles.shape
        dtype = profiles.dtype
        with untraced():
            height_m = None if height_m is None else height_m[rows]
        total = profiles.new_zeros(rows.stop - rows.start, paths * trials, *self._size) if not zone else None
        for part, matrices in zip(zone, across, strict=True):
            x = profiles[:, part.pulses]
            step = max(1, block_bytes_of(x.device) // (part.samples * x[..., 0].numel() * x.element_size()))
            height = paths * part.rows
            nodes = x.real.new_zeros(part.choice.points[1], (rows.stop - rows.start) * height, trials * part.length * 2)
            for i in range(rows.start, rows.stop, step):
                some = slice(i, min(i + step, rows.stop))
                where = slice((some.start - rows.start) * height, (some.stop - rows.start) * height)
                part.add_nodes(nodes[:, where], x, self._tables_of(part, some, dtype))
            if height_m is not None and height_m.requires_grad:
                weights = part.weights(rows, dtype, height_m)
            else:
                weights = self._weights_of((part, rows.start, rows.stop), dtype, part.weights, rows, dtype, height_m)
            for one, along in zip(nodes, part.of_y.mT.to(x.real.dtype), strict=True):
                image = part.pixels_of(one, matrices, weights)
                image = image if len(nodes) == 1 else image * along
                total = image if total is None else total + image
        assert total is not None
        return total

    def _weights_of(self, key: tuple, dtype: torch.dtype, make: Callable, *given: Any) -> Any:
        """Result of `make`, which depends only on the plan and the precision, taken from the last
        image if it was kept.
        """
        key = *key, dtype
        if key in self._weights:
            return self._weights[key]
        with torch.no_grad():
            found = make(*given)
        self._weights.keep(key, found, dtype)
        return found

    def _tables_of(self, part: Part, rows: slice, dtype: torch.dtype) -> Tables:
        """Tables of some tiles, taken from the last image if they were kept."""
        key = part, rows.start, rows.stop, dtype
        places = *self._places, self._reference_m
        fixed = not (torch.is_grad_enabled() and any(v.requires_grad for v in places))
        if fixed and key in self._tables:
            return self._tables[key]
        tables = part.tables(rows, self._places, self._reference_m, dtype)
        if fixed:
            self._tables.keep(key, tables, dtype)
        return tables


def planned(
    frequency_hz: Tensor,
    places: Sequence[Tensor],
    reference_m: Tensor,
    grid: ImageGrid,
    error_db: float,
    lit: Lit | None,
    weight: Weight | None,
    kept: float,
    images: float | None,
) -> Sector | Direct:
    """Return the sums of the pulses of a path by tiles, or without them where these do not suit.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        places: Positions of one or two antennas, each float64 (path, pulse, 3).
        reference_m: Path to which the phases refer in metres, float64 (path, pulse).
        grid: Pixels.
        error_db: Largest error relative to the image of white noise, in dB.
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.
        kept: Share of the memory that tables and weights may take, 0 to 1.
        images: Number of images that share the plan; None for tiles in any case.

    Returns:
        The sums.

    Raises:
        Unsuitable: If `images` is None and tiles do not reach the error in this geometry.
    """
    given = frequency_hz, places, reference_m, grid, error_db, lit, weight
    try:
        return Sector(*given, kept, images)
    except Unsuitable as why:
        if images is None:
            raise
        if not isinstance(why, Costly):
            warnings.warn(f"{places[0].shape[1]} pulses are summed directly: {why}", stacklevel=4)
        return Direct(*given, str(why))
