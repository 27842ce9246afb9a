"""Plan of the images of one geometry by tiles."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchsar.core import block_bytes_of, checked_samples, is_traced, over_blocks, untraced
from torchsar.focus.backprojection import direct_sum, expanded_history
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.choice import choose, error_db
from torchsar.focus.tiles.expansion import slopes
from torchsar.focus.tiles.part import Band, Part, Tables
from torchsar.focus.tiles.scene import Lit, Scene, Weight, part_bounds, tile_centres, tile_heights
from torchsar.radar.antenna_path import AntennaPath, refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz
from torchsar.radar.stripmap import LIGHT_M_S

# tables of the pulses, and weights of the tiles, up to this size each (384 MB) are kept for the
# next image, by choice: what a small machine spares
_KEPT_BYTES = 3 << 27
# tiles and trials whose pixels are formed at once, by choice: enough for the products, and few
# enough that what is kept for gradients and by each thread is small
_GROUP = 16
# bytes of profiles that are formed at once, by choice: it limits the memory of the padded spectra
_PROFILE_BYTES = 1 << 25


class _Kept(dict):
    """What an image has computed and the next one of the same form needs.

    Args:
        count: Largest number of complex values that one image adds.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count, self.form = count, None

    def begin(self, dtype: torch.dtype, tiles: int) -> None:
        """Forget what images of another precision or number of tiles at once have left."""
        if self.form != (dtype, tiles):
            self.clear()
            self.form = dtype, tiles

    def keep(self, key: tuple, value: Any, dtype: torch.dtype) -> None:
        """Keep a value unless those of an image of the precision are too large together."""
        if self.fits(dtype):
            self[key] = value

    def fits(self, dtype: torch.dtype) -> bool:
        """True if the values of an image of the precision are kept."""
        return self.count * dtype.itemsize <= _KEPT_BYTES


class TilePlan:
    """Images of one geometry, as exact as wanted, at several times the speed of the direct sum.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.5 * y, 100.0] for y in range(-20, 20)]).double()
    >>> given = (9.6e9 + 1e7 * torch.arange(16).double(), place_m, None, 2 * place_m.norm(dim=-1))
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> divmod(int(focus.TilePlan(*given, grid).image(torch.ones(40, 16) + 0j).abs().argmax()), 17)
    (8, 8)

    The image is the sum over pulses p and frequencies k

        I(x) = sum_p sum_k s[p, k] exp(+2j pi f_k (l_p(x) - l_ref,p) / c),

    where l_p(x) is the path from the transmitter over x to the receiver. The image is divided into
    tiles and the pulses into sub-apertures. Within a tile the path of each pulse is that of a plane
    wave, so that the polar-format algorithm applies, plus small terms that are expanded
    (`expansion`). Any path and spacing of the pulses is admitted. The sizes are chosen so that the
    predicted error is at most `error_db`; `choice` has them. The geometry is computed once, for any
    number of histories of complex64 or complex128.

    Leading dimensions of the positions are trials with paths of their own. Their mean is the
    nominal path, from which they may differ as motion errors do. The image is differentiable in
    the history, the positions, the reference and the heights of the pixels; memory for gradients is
    limited to that of the kept tables, or of some tiles at a time.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres, float64 (..., pulse, 3); None if both share
            an antenna, so that the path is twice its range.
        reference_m: Path to which the phases refer in metres (twice the reference range of a
            monostatic radar), float64 (..., pulse).
        grid: Pixels. The plan is fastest if one of its axes is that of the range.
        error_db: Largest rms error relative to the image of a history of white noise, in dB.
        lit: For a beam that lights a part of the image at a time: function of positions in metres,
            float64 (point, 3), that returns the first pulse that lights each point and the pulse
            after the last, int64 (point, 2), alike if there are none. Each pixel is the sum over
            the pulses that light it. None for all pulses.
        weight: Function of positions that returns the weights of all pulses in the sum of a pixel,
            finite, float64 (point, pulse), such as those of a beam with smooth edges. Within a tile
            they are interpolated, as exactly as wanted; the faster they change, the longer an image
            takes, longest with the hard edges of `lit` alone. None for equal ones.

    Raises:
        TypeError: If frequencies or positions are not float64.
        ValueError: If shapes do not match, values are not finite, the frequencies do not rise in
            equal steps, `lit` or `weight` returns other shapes, no pulse lights any of 64 x 64
            pixels that are spread over the image, tiles do not reach the error in this geometry, or
            the geometry is not constant in a program that is traced, as by `torch.export`.
    """

    def __init__(
        self,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        receiver_m: Tensor | None,
        reference_m: Tensor,
        grid: ImageGrid,
        error_db: float = -70.0,
        lit: Lit | None = None,
        weight: Weight | None = None,
    ) -> None:
        self.frequency_hz, self.grid, self.error_db = frequency_hz, grid, float(error_db)
        self.lit, self.weight = lit, weight
        _refuse_traced(frequency_hz, transmitter_m, receiver_m, reference_m, grid.origin_m, grid.axes, grid.height_m)
        with untraced():
            refuse_unusable(frequency_hz=frequency_hz)
            frequency_step_hz(frequency_hz)
            self._set_path(transmitter_m, receiver_m, reference_m)
            with torch.no_grad():
                self._plan([place.detach() for place in self._places])

    def _set_path(self, transmitter_m: Tensor, receiver_m: Tensor | None, reference_m: Tensor) -> None:
        """Bring the positions to the shape (path, pulse, 3)."""
        self.antennas = antennas = AntennaPath(transmitter_m, receiver_m, reference_m)
        size = *antennas.trials, antennas.pulses
        self._places = [place.expand(*size, 3).reshape(-1, *size[-1:], 3) for place in antennas.places]
        self._reference_m = reference_m.expand(size).reshape(-1, *size[-1:])

    def _plan(self, every: Sequence[Tensor]) -> None:
        """Choose the sizes and compute what does not depend on the history."""
        nominal = [place.mean(0) for place in every]
        grid = self.grid
        scene = Scene(self.frequency_hz, LIGHT_M_S, nominal, every, grid, self.lit, self.weight)
        # the second axis of a tile is that of the range, as the pulses see it that light the middle
        middle = scene.spread[1, 1][None]
        first, last = scene.lit_pulses(middle)[0].tolist()
        _, a, b = slopes([v[first : max(last, first + 1)] for v in nominal], middle, grid.axes)
        self._swapped = float(a.abs().mean()) > float(b.abs().mean())
        if self._swapped:
            grid = grid.transposed()
            scene = replace(scene, grid=grid)
        self._scene = scene
        with torch.device("cpu"):  # tables of the choice lie there whatever the default device
            self.choice = choice = choose(scene, self.error_db)
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
        self._tables = _Kept(len(every[0]) * self._table_count)
        self._weights = _Kept(sum(part.weight_count for part in parts))

    def moved(self, transmitter_m: Tensor, receiver_m: Tensor | None, reference_m: Tensor) -> TilePlan:
        """Return the plan of a path that differs little, such as by a change of its motion errors.

        It shares what this plan has computed, if the path does not leave its margins and the
        predicted error is at most 2 dB above `error_db`; otherwise a new plan is made.

        Args:
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.
            reference_m: Path to which the phases refer in metres, float64 (..., pulse).

        Returns:
            Plan of the path.

        Raises:
            TypeError: If the positions are not float64.
            ValueError: If shapes do not match, values are not finite, or tiles do not reach the
                error for this path.
        """
        _refuse_traced(transmitter_m, receiver_m, reference_m)
        plan = copy.copy(self)
        with untraced():
            plan._set_path(transmitter_m, receiver_m, reference_m)
            places = [place.detach() for place in plan._places]
            plan._tables = _Kept(len(places[0]) * plan._table_count)
            with torch.no_grad():
                predicted = self._error_db(places)
                # predictions of changed paths are within 1 dB, and 3 dB in all are promised
                if predicted <= self.error_db + 2:
                    plan.choice = replace(self.choice, error_db=predicted)
                else:
                    plan._plan(places)
        return plan

    def _error_db(self, places: Sequence[Tensor]) -> float:
        """Predicted error for other positions, each float64 (path, pulse, 3), that share what is
        computed; infinite where they cannot.
        """
        if [v.shape[1:] for v in places] != [v.shape[1:] for v in self._places]:
            return math.inf
        covered = all(part.covers(places) for zone in self._zones for part in zone)
        return error_db(self._scene.judging(places), self.choice) if covered else math.inf

    def image(self, history: Tensor) -> Tensor:
        """Form the images of phase histories.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex; its leading dimensions
                broadcast with those of the positions.

        Returns:
            Image, shape (..., i, j), complex, of the precision of the history. A point of unit
            amplitude has the number of samples as peak.

        Raises:
            TypeError: If the history is not complex64 or complex128.
            ValueError: If its size is not that of the plan.
        """
        history = checked_samples(history, "TilePlan.image", "pulse, frequency", finite=False)
        history = expanded_history(history, self.antennas, self.frequency_hz, "TilePlan.image")
        lead, size = history.shape[:-2], history.shape[-2:]
        # trials with paths of their own come first, those that share a path after them
        own = (*(1,) * (len(lead) - len(self.antennas.trials)), *self.antennas.trials)
        order = sorted(range(len(lead)), key=lambda d: own[d] != lead[d])
        paths = len(self._reference_m)
        data = history.permute(*order, -2, -1).reshape(paths, -1, *size)
        tiles = self._formed(data.transpose(1, 2)).unflatten(0, self._tiles)  # (tile, tile, path * trial, x, y)
        image = tiles.permute(2, 0, 3, 1, 4).flatten(1, 2).flatten(-2)
        if self._swapped:
            image = image.mT
        image = image[:, : self.grid.counts[0], : self.grid.counts[1]]
        image = image.reshape(*(lead[d] for d in order), *self.grid.counts)
        return image.permute(*(order.index(d) for d in range(len(lead))), -2, -1)

    def exact(self, history: Tensor, pixels_m: Tensor, eps: float = 1e-10) -> Tensor:
        """Compute pixels by the direct sum over the pulses that `image` sums for each of them.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            pixels_m: Positions of pixels of the grid in metres, float64 (pixel, 3).
            eps: Relative error of the interpolation in range.

        Returns:
            Image, shape (..., pixel), complex.

        Raises:
            TypeError: If the history is not complex64 or complex128, or the pixels are not float64.
            ValueError: If its size is not that of the plan, or a position is not that of a pixel.
        """
        history = checked_samples(history, "TilePlan.exact", "pulse, frequency", finite=False)
        history = expanded_history(history, self.antennas, self.frequency_hz, "TilePlan.exact")
        grid = self.grid.transposed() if self._swapped else self.grid
        refuse_unusable(pixels_m=pixels_m)
        if pixels_m.ndim != 2 or pixels_m.shape[-1] != 3 or not len(pixels_m):
            raise ValueError(f"pixels_m must be positions of pixels (pixel, 3), got the shape {tuple(pixels_m.shape)}")
        at = ((pixels_m - grid.origin_m) @ grid.axes.mT / grid.step_m).round().long()
        if bool(((at < 0) | (at >= at.new_tensor(grid.counts))).any()):
            raise ValueError("pixels_m must be positions of pixels of the grid of the plan, got some outside of it")
        weights = self._scene.weights(pixels_m).mT if self._scene.weighted else None

        def path(pulses: slice, some: slice) -> tuple[Tensor, Tensor | None]:
            weight = None if weights is None else weights[pulses, some]
            return self.antennas.path_m(pixels_m[some], pulses), weight

        return direct_sum(history, self.frequency_hz, path, len(pixels_m), eps=eps)

    def _formed(self, data: Tensor) -> Tensor:
        """All tiles, (tile, path * trial, x, y), of data (path, pulse, trial, frequency)."""
        profiles = self._profiles(data)
        paths, _, trials, _ = data.shape
        step = max(1, _GROUP // (paths * trials))
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
        # linear in the history alone, the graph holds what is kept anyway and the places of windows
        linear = trials <= _GROUP and not any(v.requires_grad for v in given[1:])
        linear = linear and self._tables.fits(data.dtype) and self._weights.fits(data.dtype)
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
        """Range profiles of data (path, pulse, trial, frequency), their first samples repeated."""
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
        """Pixels of some tiles, summed over the sub-apertures, (tile, path * trial, x, y)."""
        paths, _, trials, _ = profiles.shape
        dtype = profiles.dtype
        with untraced():
            height_m = None if height_m is None else height_m[rows]
        total = profiles.new_zeros(rows.stop - rows.start, paths * trials, *self._size) if not zone else None
        for part, matrices in zip(zone, across, strict=True):
            x = profiles[:, part.pulses]
            step = max(1, block_bytes_of(x.device) // (part.samples * x[..., 0].numel() * x.element_size()))
            height = paths * part.rows
            nodes = x.real.new_zeros(
                part.choice.points[1], (rows.stop - rows.start) * height, trials * part.length * 2
            )
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
        """What depends on the plan and the precision alone, from the last image if it is kept."""
        key = *key, dtype
        if key in self._weights:
            return self._weights[key]
        with torch.no_grad():
            found = make(*given)
        self._weights.keep(key, found, dtype)
        return found

    def _tables_of(self, part: Part, rows: slice, dtype: torch.dtype) -> Tables:
        """Tables of some tiles, from the last image if they are kept."""
        key = part, rows.start, rows.stop, dtype
        places = *self._places, self._reference_m
        fixed = not (torch.is_grad_enabled() and any(v.requires_grad for v in places))
        if fixed and key in self._tables:
            return self._tables[key]
        tables = part.tables(rows, self._places, self._reference_m, dtype)
        if fixed:
            self._tables.keep(key, tables, dtype)
        return tables


def _refuse_traced(*known: Tensor | None) -> None:
    """Raise ValueError for tensors on which a plan depends and whose values cannot be read."""
    if any(v is not None and is_traced(v) for v in known):
        raise ValueError(
            "the sizes of tiles depend on the values of positions and frequencies, which must be constants of a traced "
            "program; let it depend on the history alone, or use backproject"
        )


def image_tiles(
    history: Tensor,
    frequency_hz: Tensor,
    transmitter_m: Tensor,
    receiver_m: Tensor | None,
    reference_m: Tensor,
    grid: ImageGrid,
    error_db: float = -70.0,
    lit: Lit | None = None,
    weight: Weight | None = None,
) -> Tensor:
    """Form the image of a phase history by tiles; see `TilePlan`, which serves several histories.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.5 * y, 100.0] for y in range(-20, 20)]).double()
    >>> given = (9.6e9 + 1e7 * torch.arange(16).double(), place_m, None, 2 * place_m.norm(dim=-1))
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> divmod(int(focus.image_tiles(torch.ones(40, 16) + 0j, *given, grid).abs().argmax()), 17)
    (8, 8)

    Args:
        history: Phase history, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres; None if both share an antenna.
        reference_m: Path to which the phases refer in metres, float64 (..., pulse).
        grid: Pixels.
        error_db: Largest rms error relative to the image of a history of white noise, in dB.
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.

    Returns:
        Image, shape (..., i, j), complex.

    Raises:
        TypeError: If the history is not complex, or frequencies or positions are not float64.
        ValueError: If shapes do not match, values are not finite, the frequencies do not rise in
            equal steps, `lit` or `weight` returns other shapes, no pulse lights any of 64 x 64
            pixels that are spread over the image, or tiles do not reach the error in this geometry.
    """
    return TilePlan(frequency_hz, transmitter_m, receiver_m, reference_m, grid, error_db, lit, weight).image(history)
