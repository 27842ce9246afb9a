"""Choice of the cheapest tile, sub-apertures, kernel and window that meet a wanted error."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.nufft import smooth_length
from torchsar.focus.tiles.expansion import MOMENTS, Expansion, curvatures, slopes
from torchsar.focus.tiles.kernels import CROSS_OVERSAMPLING, kernel_error, rise_for, taps_for, window_error

# first pulse that lights each point (point, 3), and the pulse after the last, (point, 2)
Lit = Callable[[Tensor], Tensor]

# sizes that are tried
_WIDTHS = (8, 16, 32, 64, 128)
_DEPTHS = (4, 8, 16, 32, 64, 128)
_RANGE_OVERSAMPLING = (1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
# windows are tabulated at multiples of this share of the band
_GUARD_STEP = 1 / 64
# tiles that share one expansion
TILES_OF_ZONE = 256
# pulses that one product of the spreading joins
CHUNK = 64
# most error of the kernel, as a share of what the expansion leaves; those of kernel and window that
# the cost assumes, as shares of the whole
_KERNEL_SHARE, _USUAL_SHARE = 0.8, 0.5
# errors that are offered: the kernels reach the least
_LEAST_DB, _MOST_DB = -130.0, -20.0
# most that an expansion gains from halving a size or doubling the sub-apertures, found by trial
_MOST_GAIN_DB = 24.0
# pulses of a sub-aperture to which an expansion is fitted, and others on which it is judged
_FIT_PULSES, _JUDGED_PULSES = 24, 16
# time of the operations in ns, fitted to 13 plans on one core within 7 %: per sample of a window or
# of its spectrum, per flop of a product, per element of the expansion, and per tile
_NS_SAMPLE, _NS_FLOP, _NS_ELEMENT, _NS_TILE = 4.4, 0.0142, 2.1, 3000.0
# |eps| of all pulses over the largest that is sampled
_MARGIN = 1.1
# pulses of which the extent of s is found, and least pulses of a sub-aperture
_SPAN_PULSES, _LEAST_PULSES = 512, 8
# extent of a zone relative to that which a pulse lights
_ZONE_SHARE = 0.25
# longest window that is tried, in samples
_LONGEST = 4096
# what the cost assumes: oversampling of the profiles with the guard that is left, and depth of a
# tile in resolution cells
_USUAL_OVERSAMPLING, _USUAL_GUARD, _CELLS = 1.5, 20 / 64, 24


@dataclass(frozen=True)
class Choice:
    """Sizes of a tile plan.

    Args:
        width: Pixels of a tile across the range.
        depth: Pixels of a tile along the range.
        parts: Number of sub-apertures.
        order: Highest power of the range coordinate in the expansion, 1 or 2.
        taps: Width of the kernel over cross range in nodes.
        rise: Samples of either slope of the window over range.
        guard: Share of the band that the slopes of the window may fill.
        oversampling: Fineness of the range profiles relative to the resolution.
        error_db: Predicted error relative to the image of white noise in dB.
    """

    width: int
    depth: int
    parts: int
    order: int
    taps: int
    rise: int
    guard: float
    oversampling: float
    error_db: float


def even_length(n: float) -> int:
    """Return the least even FFT length of at least n without prime factors above 5.

    Args:
        n: Least length, at least 1.

    Returns:
        Length.
    """
    return 2 * smooth_length(math.ceil(n / 2))


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


def zones(
    counts: tuple[int, int], width: int, depth: int, most: tuple[float, float] = (math.inf, math.inf)
) -> list[tuple[slice, slice]]:
    """Divide the tiles of an image into zones of about the same extent along both axes.

    Args:
        counts: Pixels of the image along either axis.
        width: Pixels of a tile along the first axis.
        depth: Pixels of a tile along the second axis.
        most: Largest extent of a zone along either axis in pixels, if that is more than a tile.

    Returns:
        Slices of the tile numbers along either axis.
    """
    tiles = (-(-counts[0] // width), -(-counts[1] // depth))
    total = math.sqrt(TILES_OF_ZONE * width * depth)
    steps = [
        max(1, min(n, round(min(total, limit) / size)))
        for n, size, limit in zip(tiles, (width, depth), most, strict=True)
    ]
    return [
        (slice(i, min(i + steps[0], tiles[0])), slice(j, min(j + steps[1], tiles[1])))
        for i in range(0, tiles[0], steps[0])
        for j in range(0, tiles[1], steps[1])
    ]


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
    # tiles that leave the image repeat its last row and column
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
    """

    frequency_hz: Tensor
    speed_m_s: float
    places: Sequence[Tensor]
    judged: Sequence[Tensor]
    grid: ImageGrid
    lit: Lit | None = None

    @property
    def spread(self) -> Tensor:
        """Nine points from edge to edge of the image, float64 (3, 3, 3)."""
        return self._points(*((0, n - 1) for n in self.grid.counts))

    def _points(self, rows: tuple[int, int], columns: tuple[int, int]) -> Tensor:
        """Nine points between two rows and two columns of pixels, float64 (3, 3, 3)."""
        i, j = (torch.linspace(*ends, 3, dtype=torch.float64).to(self.grid.origin_m) for ends in (rows, columns))
        axes = self.grid.axes * self.grid.step_m
        return self.grid.origin_m + i[:, None, None] * axes[0] + j[:, None] * axes[1]

    def lit_pulses(self, points: Tensor) -> Tensor:
        """First pulse that lights each point (..., 3), and the pulse after the last, (..., 2)."""
        pulses = len(self.places[0])
        if self.lit is None:
            return torch.tensor([0, pulses]).expand(*points.shape[:-1], 2)
        flat = points.reshape(-1, 3)
        found = self.lit(flat)
        if found.shape != (len(flat), 2) or found.dtype != torch.int64:
            raise ValueError(
                f"lit must return int64 pulses of shape {(len(flat), 2)} for {len(flat)} points, got {found.dtype} of "
                f"shape {tuple(found.shape)}"
            )
        return found.clamp(0, pulses).view(*points.shape[:-1], 2)

    @functools.cached_property
    def most(self) -> tuple[float, float]:
        """Largest extent of a zone in pixels, so that it is lit by few more pulses than a pixel."""
        first, last = self.lit_pulses(self.spread).to(torch.float64).unbind(-1)
        pulses, middle = float((last - first).max()), (first + last) / 2
        moves = (float((v[-1] - v[0]).abs().max()) for v in (middle, middle.mT))
        rows, columns = (
            _ZONE_SHARE * pulses * n / move if move else math.inf
            for n, move in zip(self.grid.counts, moves, strict=True)
        )
        return rows, columns

    def relief(self, width: int, depth: int) -> tuple[Tensor | None, float]:
        """Mean height of each tile in metres, (tile, tile), and the largest difference from it."""
        heights = tile_heights(self.grid, width, depth)
        if heights is None:
            return None, 0.0
        mean = heights.mean((-2, -1))
        return mean, float((heights - mean[..., None, None]).abs().max())

    def zones(self, width: int, depth: int) -> list[tuple[slice, slice]]:
        """Zones of the tiles, see `zones`."""
        return zones(self.grid.counts, width, depth, self.most)

    def pulses_of(self, zone: tuple[slice, slice], width: int, depth: int) -> tuple[int, int]:
        """First pulse that lights a zone, and the pulse after the last."""
        rows, columns = (
            (s.start * size, min(s.stop * size, n) - 1)
            for s, size, n in zip(zone, (width, depth), self.grid.counts, strict=True)
        )
        first, last = self.lit_pulses(self._points(rows, columns)).unbind(-1)
        seen = last > first
        return (int(first[seen].min()), int(last[seen].max())) if bool(seen.any()) else (0, 0)

    @property
    def waves(self) -> tuple[float, float, float]:
        """Wave numbers in rad/m: lowest, of the carrier (sample n // 2), highest."""
        f = self.frequency_hz * (2 * math.pi / self.speed_m_s)
        return float(f[0]), float(f[len(f) // 2]), float(f[-1])

    def expansion_error(self, width: int, depth: int, parts: int, order: int) -> tuple[float, float]:
        """Rms error of the expansion relative to 1, and the largest |eps|, over a sample of zones
        and sub-apertures.
        """
        lit = [(zone, self.pulses_of(zone, width, depth)) for zone in self.zones(width, depth)]
        lit = [(zone, pulses) for zone, pulses in lit if pulses[1] > pulses[0]]
        x, y = (_gauss(size, self.grid) for size in (width, depth))
        low, carrier, high = self.waves
        wave = (low + high) / 2 + (high - low) / 2 * _GAUSS.to(x)
        squares, stretches = [], []
        mean, relief = self.relief(width, depth)
        ends = [(zone, part) for zone, (first, last) in _ends(lit) for part in _ends(part_bounds(first, last, parts))]
        for zone, (first, last) in ends:
            rows, columns = (_gauss_numbers(s.start, s.stop).to(x.device) for s in zone)
            centre = tile_centres(self.grid, width, depth, rows, columns, mean)
            middle, fitted = (first + last) // 2, _sampled(first, last, _FIT_PULSES)
            expansion = Expansion.of(
                [v[fitted] for v in self.places],
                [v[middle, None] for v in self.places],
                centre,
                self.grid.axes,
                carrier,
            )
            judged = _between(first, last, _JUDGED_PULSES)
            places = [v[:: max(1, len(v) // 2)][:, judged].flatten(0, 1) for v in self.judged]
            for height in sorted(set((relief * _GAUSS).tolist())):
                error = expansion.error(places, wave, x, y, order, height)
                squares.append(float(error.abs().square().mean()))
            stretches.append(float((slopes(places, centre, self.grid.axes)[2] / expansion.b - 1).abs().max()))
        return math.sqrt(sum(squares) / len(squares)), max(stretches)


# nodes of the Gauss-Legendre rule of three points
_GAUSS = torch.tensor([-math.sqrt(0.6), 0.0, math.sqrt(0.6)], dtype=torch.float64)


def _gauss(size: int, grid: ImageGrid) -> Tensor:
    """Three positions in a tile, whose mean square is close to that of all."""
    return (_GAUSS * (size * grid.step_m / 2)).to(grid.origin_m.device)


def _ends(items: Sequence) -> list:
    """First, middle and last item, each once."""
    return [items[i] for i in sorted({0, len(items) // 2, len(items) - 1})]


def _sampled(first: int, last: int, n: int) -> Tensor:
    """At most n whole numbers of first..last - 1, with both ends."""
    return torch.linspace(first, last - 1, min(n, last - first), dtype=torch.float64).round().long()


def _gauss_numbers(first: int, last: int) -> Tensor:
    """Up to three whole numbers of first..last - 1, whose mean square is close to that of all."""
    at = (first + last - 1) / 2 + _GAUSS * ((last - first) / 2)
    return at.round().long().clamp(first, last - 1).unique()


def _between(first: int, last: int, n: int) -> Tensor:
    """At most n whole numbers of first..last - 1, at irregular places."""
    at = torch.remainder(torch.arange(min(n, last - first), dtype=torch.float64) * 0.6180339887 + 0.31, 1)
    return (first + at * (last - first)).long()


def choose(scene: Scene, error_db: float) -> Choice:
    """Choose the cheapest sizes whose predicted error is at most `error_db`.

    Args:
        scene: Geometry.
        error_db: Wanted error relative to the image of white noise in dB.

    Returns:
        The sizes.

    Raises:
        ValueError: If none meets the error, or it is not offered.
    """
    if not _LEAST_DB <= error_db <= _MOST_DB:
        raise ValueError(f"error_db of an image by tiles must be {_LEAST_DB:g} to {_MOST_DB:g} dB, got {error_db:g} dB")
    wanted = 10 ** (error_db / 20)
    best = math.inf
    failed: list[tuple[tuple[int, int, int, int], float]] = []
    for sizes, _ in sorted(_costs(scene, wanted), key=lambda pair: pair[1]):
        if any(_hopeless(sizes, *other, wanted) for other in failed):
            continue
        error, stretch = scene.expansion_error(*sizes)
        left = math.sqrt(max(0.0, wanted**2 - error**2))
        taps = taps_for(_KERNEL_SHARE * left)
        if taps is None:
            best = min(best, error)
        else:
            slope = _choose_slope(scene, stretch, math.sqrt(left**2 - kernel_error(taps) ** 2))
            if slope is not None:
                total = math.hypot(error, kernel_error(taps), window_error(*slope[:2]))
                return Choice(*sizes, taps, *slope, 20 * math.log10(total))
        failed.append((sizes, error))
    reach = f"{20 * math.log10(best):.0f} dB" if best < 1 else "no error below 0 dB"
    raise ValueError(
        f"tiles reach {reach} in this geometry, wanted were {error_db:g} dB; ask for a larger error_db, turn the "
        "axes of the grid to the direction of the range, or use the direct sum"
    )


def _choose_slope(scene: Scene, stretch: float, error: float) -> tuple[int, float, float] | None:
    """Slope of the window in samples, its share of the band, and oversampling of the profiles, for
    an error of the window.
    """
    found = []
    for oversampling in _RANGE_OVERSAMPLING:
        guard = _guard_of(scene, oversampling, stretch * _MARGIN)
        rise = rise_for(error, guard)
        if rise is not None:
            found.append((oversampling * _CELLS + rise, (rise, guard, oversampling)))
    return min(found)[1] if found else None


def _guard_of(scene: Scene, oversampling: float, stretch: float) -> float:
    """Share of the sampled band that no wave number of a stretched pulse enters, rounded down so
    that few windows are tabulated.
    """
    low, carrier, high = scene.waves
    n = len(scene.frequency_hz)
    band = profile_length(n, oversampling) * (high - low) / max(1, n - 1)
    share = 1 - 2 * (max(high - carrier, carrier - low) + carrier * stretch) / band
    return math.floor(share / _GUARD_STEP) * _GUARD_STEP


def _hopeless(sizes: tuple[int, int, int, int], other: tuple[int, int, int, int], error: float, wanted: float) -> bool:
    """Whether sizes cannot meet the error, since another failed by more than any gain."""
    if sizes[3] != other[3]:
        return False
    gain = sum(max(0.0, math.log2(b / a)) for a, b in zip(sizes[:2], other[:2], strict=True))
    gain += max(0.0, math.log2(sizes[2] / other[2]))
    return not error * 10 ** (-_MOST_GAIN_DB * gain / 20) <= wanted


def _costs(scene: Scene, wanted: float) -> Iterator[tuple[tuple[int, int, int, int], float]]:
    """Sizes (width, depth, parts, order) and about the time of an image in ns."""
    grid = scene.grid
    low, _, high = scene.waves
    points = scene.spread.reshape(-1, 3)
    ranges = sorted({(first, last) for first, last in scene.lit_pulses(points).tolist() if last > first})
    if not ranges:
        raise ValueError("no pulse lights the corners or the middle of the image; image the part that is lit")
    pulses = max(last - first for first, last in ranges)
    number = [2**k for k in range(int(math.log2(max(1, pulses // _LEAST_PULSES))) + 1)]
    spans = dict.fromkeys(number, 0.0)
    steepest: list[tuple[Tensor, Tensor]] = []
    for first, last in ranges:
        some = [v[_sampled(first, last, _SPAN_PULSES)] for v in scene.places]
        n = len(some[0])
        _, a, b = slopes(some, points, grid.axes)
        s = a / (b / b[:, n // 2, None]) - a[:, n // 2, None]
        for parts in number:
            blocks = [s[:, i:j] for i, j in part_bounds(0, n, parts)]
            spans[parts] = max(spans[parts], *(float((v.amax(-1) - v.amin(-1)).max()) for v in blocks))
        steepest.append((a.abs(), b.abs()))
    bend = float(curvatures([v[:1] for v in scene.places], points, grid.axes).abs().max())
    per_metre = _USUAL_OVERSAMPLING * (high - low) / (2 * math.pi)
    rise = rise_for(_USUAL_SHARE * wanted, _USUAL_GUARD) or _CELLS
    taps = taps_for(_USUAL_SHARE * wanted)
    assert taps is not None
    widths, depths = (
        [size for size in sizes if size < 2 * n or size == sizes[0]]
        for sizes, n in zip((_WIDTHS, _DEPTHS), grid.counts, strict=True)
    )
    relief = {size: scene.relief(*size)[1] for size in itertools.product(widths, depths)}
    for width, depth, parts, order in itertools.product(widths, depths, number, (1, 2)):
        half = width * grid.step_m / 2, depth * grid.step_m / 2
        reach = max(float((a * half[0] + b * half[1]).max()) for a, b in steepest) + bend * (half[0] + half[1]) ** 2 / 2
        reach += 2 * relief[width, depth]
        flat = 2 * reach * per_metre + 1
        if not flat <= _LONGEST:
            continue
        length, samples = even_length(flat + rise), flat + 2 * rise
        nodes = spans[parts] * high * width * grid.step_m * CROSS_OVERSAMPLING / (2 * math.pi) + taps + 1
        joined = taps + CHUNK * nodes / max(1, pulses / parts)
        tiles = -(-grid.counts[0] // width) * -(-grid.counts[1] // depth)
        pairs = parts * tiles
        flops = 4 * tiles * pulses * joined * length
        flops += 8 * pairs * length * width * (MOMENTS * nodes + (order + 1) * depth)
        time = tiles * pulses * (samples + length) * _NS_SAMPLE + flops * _NS_FLOP
        time += pairs * (length * width * MOMENTS * (order + 1) * _NS_ELEMENT + _NS_TILE)
        yield (width, depth, parts, order), time
