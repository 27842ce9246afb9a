"""Geometry of an image by tiles, and the errors of tiles from a sample of zones and pulses.

The numbers of samples are chosen so that more of them change the predicted error by 1 dB at most:
24 pulses of a sub-aperture, and 33 values of eps and of the frequency. Errors change slowly from
zone to zone, but those of one sub-aperture of a rough path were 13 dB above those of 15 others. The
tiles of a zone sum about a quarter more pulses than illuminate a pixel. The illuminated part of an
image is found if it is wider than a 64th of the image.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import host_value
from torchsar.core.fft import smooth_length
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.expansion import Expansion, curvatures, slopes
from torchsar.focus.tiles.kernels import CROSS_OVERSAMPLING, interpolation

# Lit: function of positions (point, 3) that returns the first pulse that lights each one and the
# pulse after the last, (point, 2).
# Weight: function of positions that returns the weight of each pulse, (point, pulse).
Lit = Callable[[Tensor], Tensor]
Weight = Callable[[Tensor], Tensor]

# Number of tiles that share one expansion, by choice. It is large enough that its matrices, which
# do not depend on the tile, take a small part of the time, and small enough that the zone is small.
TILES_OF_ZONE = 256


def profile_length(n: int, oversampling: float) -> int:
    """Return the length of a range profile.

    Args:
        n: Number of frequencies.
        oversampling: Least number of samples per frequency.

    Returns:
        Number of samples.
    """
    return smooth_length(math.ceil(n * oversampling))


def part_bounds(first: int, last: int, parts: int) -> list[tuple[int, int]]:
    """Divide pulses into sub-apertures.

    Args:
        first: First pulse.
        last: Pulse after the last.
        parts: Number of sub-apertures.

    Returns:
        First pulse of each sub-aperture and the pulse after its last; none without pulses.
    """
    pulses = last - first
    parts = min(parts, pulses)
    return [(first + k * pulses // parts, first + (k + 1) * pulses // parts) for k in range(parts)]


def tile_heights(grid: ImageGrid, width: int, depth: int) -> Tensor | None:
    """Arrange the heights of an image by tiles.

    Args:
        grid: Pixels of the image.
        width: Pixels of a tile along the first axis.
        depth: Pixels of a tile along the second axis.

    Returns:
        Heights of the pixels in metres, float64 (tile, tile, x, y); None if the image is flat.
    """
    if grid.height_m is None:
        return None
    down, right = (-n % size for n, size in zip(grid.counts, (width, depth), strict=True))
    # tiles that extend beyond the image repeat its last row and column
    whole = pad(grid.height_m[None, None], (0, right, 0, down), mode="replicate")[0, 0]
    return whole.unflatten(1, (-1, depth)).unflatten(0, (-1, width)).transpose(1, 2)


def tile_centres(
    grid: ImageGrid, width: int, depth: int, rows: Tensor, columns: Tensor, height_m: Tensor | None = None
) -> Tensor:
    """Compute the centres of tiles.

    Args:
        grid: Pixels of the image.
        width: Pixels of a tile along the first axis.
        depth: Pixels of a tile along the second axis.
        rows: Numbers of the tiles along the first axis, (i,).
        columns: Numbers of the tiles along the second axis, (j,).
        height_m: Height of the centres of all tiles in metres, float64 (tile, tile); None for 0.

    Returns:
        Positions in metres, float64 (i * j, 3).
    """
    x = (rows.to(torch.float64) * width + (width - 1) / 2) * grid.step_m
    y = (columns.to(torch.float64) * depth + (depth - 1) / 2) * grid.step_m
    centre = grid.origin_m + (x[:, None] * grid.axes[0])[:, None] + y[:, None] * grid.axes[1]
    if height_m is not None:
        centre = centre + height_m[rows][:, columns, None] * grid.normal
    return centre.reshape(-1, 3)


def lit_pulses(points: Tensor, pulses: int, lit: Lit | None) -> Tensor:
    """Find the pulses that light points.

    Args:
        points: Positions in metres, float64 (..., 3).
        pulses: Number of pulses.
        lit: Function of positions, see `Scene`; None for all pulses.

    Returns:
        First pulse that lights each point and the pulse after the last, int64 (..., 2).
    """
    if lit is None:
        return torch.tensor([0, pulses]).expand(*points.shape[:-1], 2)
    flat = points.reshape(-1, 3)
    found = lit(flat)
    _refuse_other("lit", found, torch.int64, (len(flat), 2))
    return found.cpu().clamp(0, pulses).view(*points.shape[:-1], 2)


def pulse_weights(points: Tensor, pulses: int, lit: Lit | None, weight: Weight | None) -> Tensor:
    """Compute the weights of pulses in the sums at points.

    Args:
        points: Positions in metres, float64 (..., 3).
        pulses: Number of pulses.
        lit: Function of positions, see `Scene`; None for all pulses.
        weight: Function of positions, see `Scene`; None for equal weights.

    Returns:
        Weights, zero where a pulse does not light a point, float64 (..., pulse).

    Raises:
        ValueError: If a function returns another shape or type, or a weight is not finite.
    """
    flat, number = points.reshape(-1, 3), torch.arange(pulses, device=points.device)
    first, last = lit_pulses(flat, pulses, lit).to(points.device)[..., None].unbind(-2)
    found = ((first <= number) & (number < last)).to(torch.float64)
    if weight is not None:
        own = weight(flat)
        _refuse_other("weight", own, torch.float64, (len(flat), pulses))
        if not host_value(torch.isfinite(own).all(), True):
            raise ValueError("weight must return finite weights of pulses, got NaN or Inf; give 0 where none counts")
        found = found * own
    return found.view(*points.shape[:-1], -1)


@dataclass(frozen=True, eq=False)
class Sampled:
    """Quantities that determine the errors of a choice of tile sizes, from a sample of tiles and
    pulses.

    Args:
        error: Rms error of the expansion relative to 1.
        stretch: Values of eps, from the least to the greatest, float64 (value,).
        span_m: Mean path differences between the middle and the edge of a tile along either axis.
        reach_m: Largest path difference between the middle of a tile and a pixel.
    """

    error: float
    stretch: Tensor
    span_m: tuple[float, float]
    reach_m: float

    @property
    def away_m(self) -> Tensor:
        """Path differences of pixels from the middle of their tiles in metres, float64 (pixel,)."""
        at = (torch.arange(8, dtype=torch.float64) + 0.5) * (2 / 8) - 1
        return (self.span_m[0] * at[:, None] + self.span_m[1] * at).flatten()


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry for which sizes are chosen.

    Args:
        frequency_hz: Frequencies, float64 (frequency,).
        speed_m_s: Propagation speed in m/s.
        places: Nominal positions of one or two antennas, each float64 (pulse, 3).
        judged: Positions of all trials, each float64 (trial, pulse, 3).
        grid: Pixels, with the second axis nearer to the range direction.
        lit: Function of positions, float64 (point, 3), that returns the first pulse of each and the
            pulse after the last, int64 (point, 2); None if all pulses light the whole image.
        weight: Function of positions that returns the weights of all pulses, float64 (point,
            pulse); None for equal ones.
    """

    frequency_hz: Tensor
    speed_m_s: float
    places: Sequence[Tensor]
    judged: Sequence[Tensor]
    grid: ImageGrid
    lit: Lit | None = None
    weight: Weight | None = None
    _known: dict[tuple[int, int, float], tuple[int, float]] = field(default_factory=dict, init=False)

    @functools.cached_property
    def farthest(self) -> list[Tensor]:
        """Positions of the trial that is farthest from the nominal path, (pulse, 3) each."""
        pairs = zip(self.judged, self.places, strict=True)
        apart = [torch.linalg.vector_norm(v - nominal, dim=-1).amax(-1) for v, nominal in pairs]
        trial = int(torch.stack(torch.broadcast_tensors(*apart)).sum(0).argmax())
        return [v[min(trial, len(v) - 1)] for v in self.judged]

    def judging(self, judged: Sequence[Tensor]) -> Scene:
        """Return the scene for trials with other positions, (trial, pulse, 3) each. The nominal
        path of the tiles remains that of this scene.
        """
        other = copy.copy(self)  # contains the pulses that light the image, if they are known
        object.__setattr__(other, "judged", judged)
        other.__dict__.pop("farthest", None)
        return other

    @functools.cached_property
    def probed(self) -> tuple[Tensor, Tensor, Tensor]:
        """Pulses that light a lattice of pixels over the whole image.

        Returns the rows (i,) and columns (j,) of the pixels, and the first pulse of each and the
        pulse after the last, int64 (i, j, 2).
        """
        most = 2 if self.lit is None else 64
        rows, columns = (some_of(0, n, most) for n in self.grid.counts)
        return rows, columns, self.lit_pulses(self._points(rows, columns))

    @functools.cached_property
    def spread(self) -> Tensor:
        """Nine points from edge to edge of the part of the image that is lit, float64 (3, 3, 3).

        Raises:
            ValueError: If no pulse lights a pixel of the lattice.
        """
        *at, pulses = self.probed
        seen = pulses[..., 1] > pulses[..., 0]  # shape (i, j)
        if not bool(seen.any()):
            raise ValueError(
                f"no pulse lights any of {len(at[0])} x {len(at[1])} pixels across the image; image the part "
                "that is lit, and check width and squint of the beam, the centre of the image, and that `lit` returns "
                "the first pulse before the one after the last"
            )
        rows, columns = (v[seen.any(dim)] for dim, v in zip((1, 0), at, strict=True))
        return self._points(*(torch.linspace(int(v[0]), int(v[-1]), 3, dtype=torch.float64) for v in (rows, columns)))

    @property
    def longest(self) -> tuple[Tensor, tuple[int, int]]:
        """Pixel of the lattice that most pulses light, or without `lit` nine pixels from edge to
        edge, (point, 3); the first of these pulses and the one after the last.
        """
        if self.lit is None:
            return self.spread.reshape(-1, 3), (0, len(self.places[0]))
        rows, columns, lit = self.probed
        i, j = divmod(int((lit[..., 1] - lit[..., 0]).argmax()), len(columns))
        first, last = lit[i, j].tolist()
        return self._points(rows[i, None], columns[j, None]).reshape(1, 3), (first, max(last, first + 1))

    def _points(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Points at rows (..., i) and columns (..., j) of pixels, float64 (..., i, j, 3)."""
        axes, (i, j) = self.grid.axes * self.grid.step_m, (v.to(self.grid.origin_m) for v in (rows, columns))
        points = self.grid.origin_m + i[..., :, None, None] * axes[0] + j[..., None, :, None] * axes[1]
        if self.grid.height_m is None:
            return points
        i, j = (v.round().long().clamp(0, n - 1) for v, n in zip((i, j), self.grid.counts, strict=True))
        return points + self.grid.height_m[i[..., :, None], j[..., None, :]][..., None] * self.grid.normal

    def lit_pulses(self, points: Tensor) -> Tensor:
        """First pulse that lights each point (..., 3), and the pulse after the last, (..., 2)."""
        return lit_pulses(points, len(self.places[0]), self.lit)

    @property
    def weighted(self) -> bool:
        """True if the sums of pixels have weights."""
        return self.lit is not None or self.weight is not None

    def weights(self, points: Tensor) -> Tensor:
        """Weights of all pulses in the sums at points, see `pulse_weights`."""
        return pulse_weights(points, len(self.places[0]), self.lit, self.weight)

    def _some_tiles(self, *sizes: int) -> Tensor:
        """Middles of some tiles of a size that contain lit pixels, float64 (tile, 3)."""
        if self.lit is None:
            at = torch.cartesian_prod(*(torch.linspace(0, n - 1, 3, dtype=torch.float64) for n in self.grid.counts))
        else:
            rows, columns, lit = self.probed
            some = (lit[..., 1] > lit[..., 0]).nonzero()
            some = some[_between(0, len(some), 8)]
            at = torch.stack([rows[some[:, 0]], columns[some[:, 1]]], -1).to(torch.float64)
        # the pixels lie at different positions in their tiles, which do not extend beyond the image
        place = torch.remainder(torch.arange(1, len(at) + 1)[:, None] * torch.tensor([0.7548776662, 0.5698402910]), 1)
        half = (torch.tensor(sizes, dtype=torch.float64) - 1) / 2
        most = torch.maximum(half, torch.tensor(self.grid.counts) - 1 - half)
        at = torch.minimum((at + (2 * place - 1) * half).maximum(half), most)
        return self._points(*(v[:, None] for v in at.to(self.grid.origin_m.device).unbind(-1)))[:, 0, 0]

    def points(self, axis: int, size: int, error: float) -> tuple[int, float]:
        """Find the number of points of a tile between which weights are interpolated.

        Args:
            axis: Axis of the tile along which the points lie.
            size: Pixels of the tile along this axis.
            error: Largest rms error relative to the rms of the weights.

        Returns:
            Number of points, and the error that they have, from a sample of tiles.
        """
        if not self.weighted:
            return 1, 0.0
        key = axis, size, error
        return self._known.get(key) or self._known.setdefault(key, self._points_found(*key))

    def _points_found(self, axis: int, size: int, error: float) -> tuple[int, float]:
        """Compute the result of `points`."""
        device, step, n = self.grid.origin_m.device, self.grid.step_m, self.grid.counts[axis]
        along, number = self.grid.axes[axis], torch.arange(size, dtype=torch.float64, device=device)
        centre = self._some_tiles(*((size, 1) if axis == 0 else (1, size)))
        # the last tiles may extend beyond the image, where weights may change faster
        inside = (number < n % size).to(number)
        last = (n // size * size + (size - 1) / 2) * step - (centre - self.grid.origin_m) @ along
        centre = torch.stack([centre, centre + last[:, None] * along])
        share = torch.stack([torch.full_like(inside, n // size), inside])[:, None, :, None]
        at = (number - (size - 1) / 2) * step
        true = self.weights(centre[:, :, None] + at[:, None] * along)
        power = (share * true.square()).sum().clamp_min(torch.finfo(true.dtype).tiny)
        for known in (k for k in (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24) if k < size):
            known_at, matrix = interpolation(at, known)
            left = true - matrix @ self.weights(centre[:, :, None] + known_at[:, None] * along)
            found = math.sqrt(float((share * left.square()).sum() / power))
            if found <= error:
                return known, found
        return size, 0.0

    def raised_error(self, width: int, depth: int) -> float:
        """Rms error of weights, relative to their rms, due to heights of pixels above the middle
        of their tile.
        """
        relief = self.relief(width, depth)[1]
        if not (relief and self.weighted):
            return 0.0
        centre = self._some_tiles(width, depth)
        level = self.weights(centre)
        raised = self.weights(centre + (relief * _GAUSS.to(centre))[:, None, None] * self.grid.normal)
        squares = (raised - level).square().flatten(1).sum(-1) @ _GAUSS_WEIGHT.to(centre)
        return math.sqrt(float(squares / level.square().sum().clamp_min(torch.finfo(level.dtype).tiny)))

    @functools.cached_property
    def most(self) -> tuple[float, float]:
        """Largest extent of a zone in pixels, so that few more pulses light it than a pixel."""
        rows, columns, lit = self.probed
        first, last = lit.to(torch.float64).unbind(-1)
        seen, middle, pulses = last > first, (first + last) / 2, float((last - first).max())

        def extent(at: Tensor, seen: Tensor, middle: Tensor) -> float:
            # pulses per pixel by which the middle of the pulses that light a pixel moves
            span, moved = (
                torch.where(seen, v, -math.inf).amax(0) - torch.where(seen, v, math.inf).amin(0)
                for v in (at[:, None].to(middle).expand_as(middle), middle)
            )
            some = span > 0
            speed = float((moved[some] / span[some]).max()) if bool(some.any()) else 0.0
            return 0.25 * pulses / speed if speed else math.inf

        return extent(rows, seen, middle), extent(columns, seen.mT, middle.mT)

    def relief(self, width: int, depth: int) -> tuple[Tensor | None, float]:
        """Height of the centre of each tile in metres, (tile, tile), and the largest difference of
        a pixel from it.

        Centres have about the mean height of their pixels, in steps. A small change of the heights
        does not move them, so that the error of the tiles does not jump.
        """
        heights = tile_heights(self.grid, width, depth)
        if heights is None:
            return None, 0.0
        step = self.grid.step_m / 16
        centre = (heights.mean((-2, -1)) / step).round() * step
        return centre, float((heights - centre[..., None, None]).abs().max())

    def zones(self, width: int, depth: int) -> list[tuple[tuple[slice, slice], tuple[int, int]]]:
        """Zones of about the same extent along both axes, as slices of the tile numbers along
        either axis.

        Each zone has the first pulse that lights it and the pulse after the last; they are equal if
        none does.
        """
        tiles = (-(-self.grid.counts[0] // width), -(-self.grid.counts[1] // depth))
        total = math.sqrt(TILES_OF_ZONE * width * depth)
        steps = [
            max(1, min(n, round(min(total, limit) / size)))
            for n, size, limit in zip(tiles, (width, depth), self.most, strict=True)
        ]
        found = [
            (slice(i, min(i + steps[0], tiles[0])), slice(j, min(j + steps[1], tiles[1])))
            for i in range(0, tiles[0], steps[0])
            for j in range(0, tiles[1], steps[1])
        ]
        if self.lit is None:
            return [(zone, (0, len(self.places[0]))) for zone in found]
        # nine points of each zone, and those of the lattice that lie in it or next to it
        ends = [
            torch.tensor([(zone[axis].start * size, min(zone[axis].stop * size, n) - 1) for zone in found])
            for axis, (size, n) in enumerate(zip((width, depth), self.grid.counts, strict=True))
        ]
        share = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
        own = self.lit_pulses(self._points(*(v[:, :1] + (v[:, 1:] - v[:, :1]) * share for v in ends))).flatten(1, 2)
        *at, probed = self.probed
        inner = (
            torch.stack([(v < end[:, :1]).sum(-1), (v <= end[:, 1:]).sum(-1)], -1).tolist()
            for v, end in zip(at, ends, strict=True)
        )
        pulses = []
        for (top, bottom), (left, right), nine in zip(*inner, own, strict=True):
            near = probed[max(0, top - 1) : bottom + 1, max(0, left - 1) : right + 1]
            every = torch.cat([nine, near.reshape(-1, 2)])
            every = every[every[:, 1] > every[:, 0]]
            pulses.append((int(every[:, 0].min()), int(every[:, 1].max())) if len(every) else (0, 0))
        return list(zip(found, pulses, strict=True))

    @functools.cached_property
    def waves(self) -> tuple[float, float, float]:
        """Wave numbers in rad/m: lowest, of the carrier (sample n // 2), highest."""
        f = self.frequency_hz * (2 * math.pi / self.speed_m_s)
        low, carrier, high = torch.stack([f[0], f[len(f) // 2], f[-1]]).tolist()
        return low, carrier, high

    def node_turns(self, width: int) -> tuple[Tensor, Tensor]:
        """Cycles per node over cross range of the pixels of a tile at three wave numbers, with
        weights, both (pixel, 3).
        """
        low, _, high = self.waves
        at, weight = _in_tile(self.grid.counts[0], width)
        turns = at[:, None] / (width * CROSS_OVERSAMPLING) * (((low + high) / 2 + (high - low) / 2 * _GAUSS) / high)
        return turns, weight[:, None] * _GAUSS_WEIGHT

    def samples_per_metre(self, oversampling: float) -> float:
        """Number of samples of the range profiles in a path difference of 1 m."""
        low, _, high = self.waves
        n = len(self.frequency_hz)
        return profile_length(n, oversampling) * (high - low) / max(1, n - 1) / (2 * math.pi)

    def sample_turns(self, oversampling: float, stretch: Tensor) -> Tensor:
        """Cycles per sample over range of the frequencies of pulses with given values of eps."""
        n = len(self.frequency_hz)
        low, carrier, high = self.waves
        some = min(n, 33)
        number = ((torch.arange(some, dtype=torch.float64) + 0.5) * (n / some)).floor()
        wave = low + (high - low) / max(1, n - 1) * number
        return (wave[:, None] - carrier / (1 + stretch)) / (2 * math.pi * self.samples_per_metre(oversampling))

    @functools.cached_property
    def bend(self) -> float:
        """Largest second derivative of the path along the axes of the image in 1/m."""
        points = self.spread.reshape(-1, 3)
        return float(curvatures([v[:1] for v in self.places], points, self.grid.axes).abs().max())

    def sampled(self, width: int, depth: int, parts: int, order: int, *, dense: bool = False) -> Sampled:
        """Error of the expansion, and the properties that the window must have, from a sample of
        zones and pulses.

        In a dense sample each sub-aperture occurs in one zone: those of a rough path differ.
        """
        device, step = self.grid.origin_m.device, self.grid.step_m
        (x, of_x), (y, of_y) = (
            (nodes.to(device) * step, weight.to(device))
            for nodes, weight in map(_pixel_rule, self.grid.counts, (width, depth))
        )
        low, _, high = self.waves
        wave = ((low + high) / 2 + (high - low) / 2 * _GAUSS).to(device)
        within = (_GAUSS_WEIGHT.to(device)[:, None, None] * of_x[:, None] * of_y).flatten()
        relief = self.relief(width, depth)[1]
        heights = list(zip((relief * _GAUSS).tolist(), _GAUSS_WEIGHT.tolist(), strict=True)) if relief else [(0.0, 1.0)]
        half = torch.tensor([width - 1, depth - 1], dtype=torch.float64, device=device) * (step / 2)
        total, whole, stretches, spans = 0.0, 0.0, [], []
        for centre, of_tile, pulses, weight in self._blocks(width, depth, parts, dense):
            expansion, places = self._fitted(centre, *pulses)
            whole += weight
            for height, of_height in heights:
                squares = expansion.error(places, wave, x, y, order, height).abs().square()
                total += weight * of_height * float((squares.mean(1).flatten(1) @ within) @ of_tile)
            _, a, b = slopes(places, centre, self.grid.axes)
            stretches.append((b / expansion.b - 1).flatten())
            spans.append((torch.stack([a, b], -1).abs() * half).flatten(0, -2))
        stretch, span = torch.cat(stretches).sort().values.cpu(), torch.cat(spans)
        across, along = span.mean(0).tolist()
        return Sampled(
            math.sqrt(total / whole),
            stretch[some_of(0, len(stretch), 33)],
            (across, along + 2 * relief),
            float(span.sum(-1).max()) + self.bend * float(half.sum()) ** 2 / 2 + 2 * relief,
        )

    def _blocks(
        self, width: int, depth: int, parts: int, dense: bool
    ) -> Iterator[tuple[Tensor, Tensor, tuple[int, int], float]]:
        """Sample of blocks of tiles and pulses.

        Generates the centres of tiles (tile, 3) with weights (tile,), the first pulse and the pulse
        after the last, and the weight of the block.
        """
        device, (heights, _) = self.grid.origin_m.device, self.relief(width, depth)
        lit = [(zone, pulses) for zone, pulses in self.zones(width, depth) if pulses[1] > pulses[0]]
        some = _between(0, len(lit), 3).unique().tolist()
        for turn, number in enumerate(some):
            zone, (first, last) = lit[int(number)]
            (rows, of_row), (columns, of_column) = (_gauss_numbers(s.start, s.stop) for s in zone)
            centre = tile_centres(self.grid, width, depth, rows.to(device), columns.to(device), heights)
            of_tile = (of_row[:, None] * of_column).flatten().to(device)
            bounds = part_bounds(first, last, parts)
            if dense:
                chosen = torch.arange(turn, len(bounds), len(some))
                of_part = torch.ones(len(chosen))
            else:
                chosen, of_part = _gauss_numbers(0, len(bounds))
            for part, weight in zip(chosen.tolist(), of_part.tolist(), strict=True):
                first, last = bounds[part]
                yield centre, of_tile, (first, last), weight * (last - first)

    def _fitted(self, centre: Tensor, first: int, last: int) -> tuple[Expansion, list[Tensor]]:
        """Expansion of tiles for some pulses, and the positions at which its error is computed."""
        middle, fitted = (first + last) // 2, some_of(first, last, 24)
        places, reference = [v[fitted] for v in self.places], [v[middle, None] for v in self.places]
        judged = _between(first, last, 16)
        others = [v[judged] for v in self.farthest]
        return Expansion.of(places, reference, centre, self.grid.axes, self.waves[1]), others


# Gauss-Legendre rule of three points for the mean from -1 to 1
_GAUSS = torch.tensor([-math.sqrt(0.6), 0.0, math.sqrt(0.6)], dtype=torch.float64, device="cpu")
_GAUSS_WEIGHT = torch.tensor([5 / 18, 8 / 18, 5 / 18], dtype=torch.float64, device="cpu")


def _in_tile(n: int, size: int) -> tuple[Tensor, Tensor]:
    """Positions in a tile of `size` pixels relative to its middle, in pixels, and the share of the
    n pixels that lie there.

    The last tile may be filled only in part.
    """
    number = torch.arange(size, dtype=torch.float64)
    return number - (size - 1) / 2, (n // size + (number < n % size).to(number)) / n


@functools.cache
def _pixel_rule(n: int, size: int) -> tuple[Tensor, Tensor]:
    """Gauss quadrature for the mean over the pixels of `_in_tile`: nodes in pixels from the middle,
    and weights, (4,) or fewer.

    It follows from the eigenvalues of the Jacobi matrix of the pixels, see Golub and Welsch 1969.

    Reference:
        Golub and Welsch 1969.
    """
    at, weight = _in_tile(n, size)
    at, root = at[weight > 0], weight[weight > 0].sqrt()
    powers = (at / size)[:, None] ** torch.arange(min(4, len(at)))
    q = torch.linalg.qr(root[:, None] * powers).Q
    nodes, vectors = torch.linalg.eigh(q.mT @ (at[:, None] * q))
    return nodes, (root @ q @ vectors).square()


def some_of(first: int, last: int, n: int) -> Tensor:
    """Select whole numbers at even distances.

    Args:
        first: First number.
        last: The number after the last one.
        n: Most numbers to select.

    Returns:
        At most n numbers of first..last - 1, with both ends.
    """
    return torch.linspace(first, last - 1, min(n, last - first), dtype=torch.float64).round().long()


def _gauss_numbers(first: int, last: int) -> tuple[Tensor, Tensor]:
    """Up to three whole numbers of first..last - 1, with weights for the mean over all of them."""
    n = last - first
    if n <= 3:
        return torch.arange(first, last), torch.full((n,), 1 / n, dtype=torch.float64)
    return ((first + last - 1) / 2 + _GAUSS * (n / 2)).round().long().clamp(first, last - 1), _GAUSS_WEIGHT


def _between(first: int, last: int, n: int) -> Tensor:
    """At most n whole numbers of first..last - 1, at irregular distances."""
    at = torch.remainder(torch.arange(min(n, last - first), dtype=torch.float64) * 0.6180339887 + 0.31, 1)
    return (first + at * (last - first)).long()


def _refuse_other(name: str, found: object, dtype: torch.dtype, size: tuple[int, int]) -> None:
    """Raise ValueError unless the result of `lit` or `weight` has the required type and size."""
    if isinstance(found, Tensor) and found.dtype == dtype and found.shape == size:
        return
    what = f"a tensor of {found.dtype} of shape {tuple(found.shape)}" if isinstance(found, Tensor) else type(found)
    raise ValueError(f"{name} must return a tensor of {dtype} of shape {size} for {size[0]} points, got {what}")
