"""One zone of tiles and one sub-aperture: its plan, the tables of its pulses, and its image."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import outer_phasor, phasor_tables, real_dtype, unit_phasor, untraced
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.choice import CHUNK, Choice
from torchsar.focus.tiles.expansion import MOMENTS, Expansion, curvatures, slopes
from torchsar.focus.tiles.kernels import (
    CROSS_OVERSAMPLING,
    interpolation,
    node_values,
    spread_kernel,
    window_length,
    window_slope,
)
from torchsar.focus.tiles.scene import profile_length

# _FIT_PULSES: pulses to which the polynomials of a part are fitted, by choice. Fits to 24 and 64
# pulses differed by 0.2 dB at most in 11 geometries.
# _FIT_DENSITY: samples of s per node to which the values of the nodes are fitted, by choice.
# Functions of s are then sampled three times as densely as their band needs.
_FIT_PULSES, _FIT_DENSITY = 64, 2
# degrees of the remainders in the wave number and in x; they are exact, being squares of linear and
# of quadratic terms
_WAVE_DEGREE, _PIXEL_DEGREE = 2, 4
# _MARGIN: share of the extent of s that is added at either end, by choice, so that small changes of
# the path need no new plan.
# _LEAST_MARGIN: least margin, by choice, so that an extent is never empty.
_MARGIN, _LEAST_MARGIN = 0.02, 1e-6
_TURN = 2 * math.pi


@dataclass(frozen=True, eq=False)
class Band:
    """Frequencies, and the range profiles that are formed of them.

    Args:
        n: Number of frequencies.
        carrier: Wave number of frequency n // 2 in rad/m.
        highest: Highest wave number in rad/m.
        length: Samples of a profile.
        step_m: Path difference of adjacent samples in metres.
    """

    n: int
    carrier: float
    highest: float
    length: int
    step_m: float

    @classmethod
    def of(cls, frequency_hz: Tensor, speed_m_s: float, oversampling: float) -> Band:
        """Return the band of uniform frequencies, float64 (frequency,)."""
        n = len(frequency_hz)
        step_hz = float(frequency_hz[-1] - frequency_hz[0]) / (n - 1)
        length = profile_length(n, oversampling)
        waves = frequency_hz * (_TURN / speed_m_s)
        return cls(n, float(waves[n // 2]), float(waves[-1]), length, speed_m_s / (length * step_hz))

    def profiles(self, history: Tensor) -> Tensor:
        """Range profiles (..., length) of a phase history (..., frequency).

        Sample k is at the path difference k step_m. Negative differences are at the end, since the
        profile is periodic.
        """
        low, high = history[..., : self.n // 2], history[..., self.n // 2 :]
        padded = torch.cat([high, history.new_zeros(*history.shape[:-1], self.length - self.n), low], -1)
        return torch.fft.ifft(padded, dim=-1, norm="forward")


@dataclass(frozen=True, eq=False)
class Tables:
    """Tables of the pulses and tiles of a group, differentiable in the positions of the antennas.

    Args:
        first: First sample of each window, shape (tile, path, pulse), int64.
        before: Weights of the samples of a window, complex (tile, path, pulse, sample).
        after: Weights of their spectrum, complex (tile, path, pulse, wave number).
        spread: Kernel of pulses at nodes, real (tile, path, chunk, node of the chunk, pulse).
        node: Node of each row of `spread`, (tile, path, chunk, node of the chunk), int64.
        shares: Weights of the pulses at the points of a tile, real (y, x, tile, chunk, pulse); None
            if all are one.
    """

    first: Tensor
    before: Tensor
    after: Tensor
    spread: Tensor
    node: Tensor
    shares: Tensor | None


class Part:
    """Plan of a block of tiles and of a range of pulses.

    Args:
        band: Frequencies and profiles.
        choice: Sizes.
        pulses: First pulse of the part and the pulse after the last.
        places: Nominal positions of one or two antennas, float64 (pulse, 3).
        every: Positions of all paths, float64 (path, pulse, 3), for the extents.
        centre: Centres of the tiles, float64 (tile, 3).
        grid: Pixels, with the second axis nearer to the range direction.
        relief_m: Largest height of a pixel above the plane of its tile in metres.
        shares: Function of positions (..., 3) that returns the weights of all pulses in the sums
            there, (..., pulse); None if all are one.
    """

    def __init__(
        self,
        band: Band,
        choice: Choice,
        pulses: tuple[int, int],
        places: Sequence[Tensor],
        every: Sequence[Tensor],
        centre: Tensor,
        grid: ImageGrid,
        relief_m: float = 0.0,
        shares: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        axes, self.relief_m, self.shares = grid.axes, relief_m, shares
        self.band, self.choice, self.centre, self.axes = band, choice, centre, axes
        first, last = pulses
        self.pulses, self.count = slice(first, last), last - first
        fitted = torch.linspace(first, last - 1, min(last - first, _FIT_PULSES)).round().long()
        self.reference = [v[(first + last) // 2, None] for v in places]
        self.expansion = Expansion.of([v[fitted] for v in places], self.reference, centre, axes, band.carrier)
        self.x, self.y = (
            (torch.arange(n, dtype=torch.float64, device=centre.device) - (n - 1) / 2) * grid.step_m
            for n in (choice.width, choice.depth)
        )
        # points of a tile at which weights are known, and the polynomials that interpolate between
        # them
        (x, self.of_x), (y, self.of_y) = map(interpolation, (self.x, self.y), choice.points)
        self.offset_m = (y[:, None] * axes[1])[:, None] + x[:, None] * axes[0]
        every = [v[:, self.pulses] for v in every]
        low, high = self._extent(every)
        margin = _MARGIN * (high - low) + _LEAST_MARGIN
        extent = low - margin, high + margin
        taps = choice.taps
        self.node_step = _TURN / (band.highest * choice.width * grid.step_m * CROSS_OVERSAMPLING)
        self.low = extent[0] - taps / 2 * self.node_step
        self.nodes = math.ceil((extent[1] - extent[0]) / self.node_step) + taps + 1
        self.extent = extent
        self.length = window_length(self._reach(every), choice.rise)
        self.slope = window_slope(choice.rise, choice.guard).to(centre.device)
        self.samples = self.length + choice.rise

    def _extent(self, places: Sequence[Tensor]) -> tuple[float, float]:
        """Least and largest s of the pulses in any of the tiles."""
        _, a, b = slopes(places, self.centre, self.axes)
        s = a / (b / self.expansion.b[..., None]) - self.expansion.a[..., None]
        return float(s.min()), float(s.max())

    def _reach(self, places: Sequence[Tensor]) -> float:
        """Largest path difference of a pixel from the centre of its tile, in samples."""
        _, a, b = slopes(places, self.centre, self.axes)
        half = float(self.x[-1]), float(self.y[-1])
        bend = float(curvatures([v[..., ::16, :] for v in places], self.centre, self.axes).abs().max())
        reach = float((a.abs() * half[0] + b.abs() * half[1]).max()) + bend * (half[0] + half[1]) ** 2 / 2
        return (reach + 2 * self.relief_m) / self.band.step_m

    def covers(self, places: Sequence[Tensor]) -> bool:
        """True if other positions, each float64 (path, pulse, 3), stay within the range of the
        nodes and windows.
        """
        places = [v[:, self.pulses] for v in places]
        low, high = self._extent(places)
        inside = self.extent[0] <= low and high <= self.extent[1]
        return inside and 2 * self._reach(places) + 1 <= self.length - self.choice.rise

    @property
    def table_count(self) -> int:
        """Largest number of complex values in the tables of all tiles for one path."""
        # weights at nodes and at points of the tile are real, so that two of them count as one
        # complex number; the position of a window, an int64, counts as one
        real = self.nodes + (0 if self.shares is None else math.prod(self.choice.points))
        return len(self.centre) * self.count * (self.samples + self.length + real // 2 + 1)

    @property
    def weight_count(self) -> int:
        """Number of complex values in `across` and in the weights of all tiles."""
        wide, deep, powers = len(self.x), len(self.y), self.choice.order + 1
        of_tile = self.length * powers * (MOMENTS * wide + deep) + wide * deep
        if self.relief_m:
            of_tile += wide * deep * 3 * math.isqrt(self.length)
        return MOMENTS * self.length * self.rows * wide + len(self.centre) * of_tile

    @property
    def rows(self) -> int:
        """Number of rows of nodes of a tile for each interpolation point along y: the number of
        points along x times the number of nodes.
        """
        return self.choice.points[0] * self.nodes

    @untraced()
    def across(self, dtype: torch.dtype) -> list[Tensor]:
        """Matrices from nodes to pixels across the range, one for each moment of s.

        Args:
            dtype: Precision of the history.

        Returns:
            Matrices (wave number, point along x * node, x) that all tiles of the part share.
        """
        s = torch.linspace(*self.extent, _FIT_DENSITY * self.nodes, dtype=torch.float64, device=self.centre.device)
        values = node_values((s - self.low) / self.node_step, self.nodes, self.choice.taps) / self.length
        constant, path = self.expansion.common_phase(s[:, None], self.x)  # (sample, x)
        per_wave = path / (self.length * self.band.step_m)
        # The phase is linear in the wave number. The phasors are computed at as many Chebyshev
        # points as their largest phase from the middle needs for -140 dB, and interpolated.
        waves = torch.arange(self.length, dtype=torch.float64, device=self.centre.device) - self.length // 2
        half = math.pi * self.length * float(per_wave.abs().max())
        known, to_waves = interpolation(waves, math.ceil(half + 5 * half ** (1 / 3) + 8))
        # double precision is needed, because the matrix has large values of both signs
        phasor = unit_phasor((constant / _TURN)[..., None] + per_wave[..., None] * known, torch.complex128)
        moments = torch.cat([values * s**power for power in range(MOMENTS)])
        found = moments @ torch.view_as_real(phasor).reshape(len(s), -1)
        few = found.view(-1, len(self.x), len(known), 2).permute(2, 0, 1, 3).flatten(1).to(real_dtype(dtype))
        every = torch.view_as_complex((to_waves.to(few.dtype) @ few).view(-1, MOMENTS, self.nodes, len(self.x), 2))
        if len(self.of_x.mT) > 1:
            # (wave number, moment, point along x * node, x)
            every = (every[:, :, None] * self.of_x.mT[:, None].to(few.dtype)).flatten(2, 3)
        return [one.contiguous() for one in every.unbind(1)]

    @untraced()
    def weights(self, rows: slice, dtype: torch.dtype, height_m: Tensor | None = None) -> Weights:
        """Compute the factors that form the pixels of some tiles, for any history.

        Args:
            rows: Tiles of the part.
            dtype: Precision of the history.
            height_m: Heights of the pixels above the centres of their tiles in metres, float64
                (tile, x, y); None for 0. Differentiable.
        """
        of, step = self.expansion.rows(rows), 1 / (self.length * self.band.step_m)
        # the phases of tiles are linear in the wave number
        tile = _ramp(-(self.length // 2) * step * of.tile_path(self.x), step * of.tile_path(self.x), self.length, dtype)
        tile = tile.movedim(-1, 0).contiguous()
        # the remainders are polynomials of the wave number and of x
        waves = torch.arange(self.length, dtype=torch.float64, device=self.centre.device) - self.length // 2
        q, to_waves = interpolation(waves * (_TURN * step), _WAVE_DEGREE + 1)
        x, to_pixels = interpolation(self.x, _PIXEL_DEGREE + 1)
        order, raised = self.choice.order, height_m is not None
        some = of.remainders(q[:, None, None], x, order, heights=raised)
        few = torch.stack([w.expand(-1, len(tile[0]), -1) for row in some for w in row])
        every = to_waves.to(dtype) @ (few.to(dtype) @ to_pixels.mT.to(dtype)).flatten(-2)
        moments = every.view(len(some), -1, *tile.shape).mul_(tile)
        path, along = self._pixel_path(rows, height_m), of.range_path(self.y)
        if height_m is not None:
            along = along[:, None] + path - self._pixel_path(rows)
        ramps = phasor_tables(step * along, -(self.length // 2), self.length, dtype)
        pixels = unit_phasor((path - of.path_m[..., None]) * (self.band.carrier / _TURN), dtype)
        factors = [factor.to(pixels.real.dtype) for factor in of.factors(self.y, order, height_m)]
        if raised:
            return RaisedWeights(moments, ramps, [factor.expand_as(pixels.real)[:, None] for factor in factors], pixels)
        shared = outer_phasor(*ramps, self.length).mT.contiguous()
        return FlatWeights(moments, [shared * factor for factor in factors], pixels)

    def _pixel_path(self, rows: slice, height_m: Tensor | None = None) -> Tensor:
        """Path of the pixels of some tiles at the reference position in m, float64 (tile, x, y)."""
        frame = torch.cat([self.axes, torch.linalg.cross(*self.axes)[None]])
        total = torch.zeros((), dtype=torch.float64, device=self.centre.device)
        for place in self.reference:
            u, v, w = ((self.centre[rows] - place) @ frame.mT)[..., None, None].unbind(1)
            w = w if height_m is None else w + height_m
            total = total + ((u + self.x[:, None]).square() + ((v + self.y).square() + w.square())).sqrt()
        return (3 - len(self.reference)) * total

    @untraced()
    def tables(self, rows: slice, places: Sequence[Tensor], reference_m: Tensor, dtype: torch.dtype) -> Tables:
        """Compute the tables of some tiles.

        Args:
            rows: Tiles of the part.
            places: Positions of one or two antennas, each float64 (path, pulse, 3).
            reference_m: Path to which the phases refer in metres, float64 (path, pulse).
            dtype: Precision of the history.
        """
        band, taps, of = self.band, self.choice.taps, self.expansion
        device, real = self.centre.device, real_dtype(dtype)
        path, a, b = slopes([v[:, self.pulses] for v in places], self.centre[rows], self.axes)
        path, stretch = path - reference_m[:, self.pulses], b / of.b[rows, :, None]
        s = a / stretch - of.a[rows, :, None]
        at = path / band.step_m
        nearest = torch.round(at.detach())
        fraction = at - nearest
        first = torch.remainder(nearest.long() - self.samples // 2, band.length)
        # the carrier becomes k_c / (1 + eps); half a cycle per sample centres the spectrum
        per_sample = band.carrier * band.step_m / _TURN * (1 - 1 / stretch)
        start = band.carrier / _TURN * path - per_sample * (fraction + self.samples // 2)
        before = _ramp(start + self.samples // 2 * 0.5, per_sample + 0.5, self.samples, dtype)
        rise, slope = self.choice.rise, self.slope.to(dtype)
        before[..., :rise] *= slope
        before[..., -rise:] *= slope.flip(0)
        after = _ramp(-fraction / 2, fraction / self.length + 0.5, self.length, dtype)
        position = (s - self.low) / self.node_step
        below = torch.ceil(position.detach() - taps / 2)
        away = (below - position)[..., None] + torch.arange(taps, device=device)
        spread, node = _spreading(below.long(), spread_kernel(away.to(real), taps), self.nodes)
        shares = None
        if self.shares is not None:
            points = self.offset_m[:, :, None] + self.centre[rows]
            shares = self.shares(points)[..., self.pulses].to(real)
            shares = pad(shares, (0, spread.shape[2] * spread.shape[4] - self.count)).unflatten(-1, spread.shape[2::2])
        return Tables(first, before, after, spread, node, shares)

    def add_nodes(self, nodes: Tensor, profiles: Tensor, tables: Tables) -> None:
        """Add the windows of the pulses to the nodes of some tiles.

        Args:
            nodes: Sums at the nodes, real (point along y, tile * path * point along x * node,
                trial * wave number * 2); changed in place.
            profiles: Range profiles, extended circularly, complex (path, pulse, trial, sample).
            tables: Tables of the tiles.
        """
        tiles, paths, pulses = tables.first.shape
        trials, stride = profiles.shape[-2:]
        base = torch.arange(paths * pulses * trials, device=profiles.device).reshape(paths, pulses, trials) * stride
        index = (tables.first[..., None] + base).reshape(-1)
        x = _Windows.apply(profiles.reshape(-1), index, self.samples, 0)
        x = x.view(tiles, paths, pulses, trials, self.samples)
        x = _times(x, tables.before[..., None, :])
        half = (self.samples - self.length) // 2
        # the slopes of the window overlap outside the part that is used
        y = x[..., half : half + self.length].clone()
        y[..., :half] += x[..., half + self.length :]
        y[..., self.length - half :] += x[..., :half]
        y = _times(torch.fft.fft(y), tables.after[..., None, :])
        y = torch.view_as_real(y).reshape(tiles * paths, pulses, -1)
        chunks, joined, height = tables.spread.shape[-3:]
        if chunks * height != pulses:
            y = pad(y, (0, 0, 0, chunks * height - pulses))
        width = y.shape[-1]
        y = y.view(tiles * paths * chunks, height, width)
        block = torch.arange(tiles * paths, device=y.device) * self.rows
        target = (tables.node.reshape(tiles * paths, -1) + block[:, None]).reshape(-1)
        for j, i in itertools.product(range(len(nodes)), range(self.choice.points[0])):
            spread = tables.spread
            if tables.shares is not None:
                spread = spread * tables.shares[j, i, :, None, :, None]
            z = torch.bmm(spread.reshape(-1, joined, height), y)
            nodes[j].index_add_(0, target + i * self.nodes, z.reshape(-1, width))

    def pixels_of(self, nodes: Tensor, across: Sequence[Tensor], weights: Weights) -> Tensor:
        """Form the pixels of some tiles.

        Args:
            nodes: Sums at the nodes for one point along y, as in `add_nodes`.
            across: Matrices of `across`.
            weights: Weights of the tiles.

        Returns:
            Pixels, complex (tile, path * trial, x, y).
        """
        tiles, width = len(weights.pixels), len(self.x)
        z = torch.view_as_complex(nodes.view(-1, self.rows, nodes.shape[-1] // (2 * self.length), self.length, 2))
        z = z.permute(3, 0, 2, 1).reshape(self.length, -1, self.rows)
        moments = [torch.bmm(z, matrix).view(self.length, tiles, -1, width) for matrix in across]
        parts = []
        for row in weights.moments:
            part = moments[0] * row[0][:, :, None]
            for moment, weight in zip(moments[1:], row[1:], strict=True):
                part.addcmul_(moment, weight[:, :, None])
            parts.append(part)
        return _times(weights.sums(parts), weights.pixels[:, None])


@dataclass(frozen=True, eq=False)
class FlatWeights:
    """Factors that form the pixels of some tiles in the plane of the image.

    Args:
        moments: Weights of the moments of s, (factor, moment, wave number, tile, x).
        along: Wave numbers to pixels along the range, by factor, (tile, wave number, y).
        pixels: Carrier phase of the pixels, (tile, x, y).
    """

    moments: Tensor
    along: list[Tensor]
    pixels: Tensor

    def sums(self, parts: Sequence[Tensor]) -> Tensor:
        """Sum the parts (wave number, tile, trial, x) over wave numbers and factors, (tile, trial,
        x, y).
        """
        image: Tensor | None = None
        for part, along in zip(parts, self.along, strict=True):
            rows = part.flatten(2).permute(1, 2, 0)
            image = torch.bmm(rows, along) if image is None else image.baddbmm_(rows, along)
        assert image is not None
        return image.unflatten(1, parts[0].shape[2:])


@dataclass(frozen=True, eq=False)
class RaisedWeights:
    """Factors that form the pixels of some tiles at heights above the plane of the image.

    Args:
        moments: Weights of the moments of s, (factor, moment, wave number, tile, x).
        ramps: The two tables (`phasor_tables`) of the phasors of each pixel over the wave numbers,
            (tile, x, y, entry).
        factors: Factors of the pixels, (tile, 1, x, y).
        pixels: Carrier phase of the pixels, (tile, x, y).
    """

    moments: Tensor
    ramps: tuple[Tensor, Tensor]
    factors: list[Tensor]
    pixels: Tensor

    def sums(self, parts: Sequence[Tensor]) -> Tensor:
        """Sum the parts (wave number, tile, trial, x) over wave numbers and factors, (tile, trial,
        x, y).
        """
        fine, coarse = self.ramps
        inner, outer = fine.shape[-1], coarse.shape[-1]
        image: Tensor | None = None
        for part, factor in zip(parts, self.factors, strict=True):
            rows = pad(part.movedim(0, -1), (0, inner * outer - len(part))).transpose(1, 2)
            blocks = rows.unflatten(-1, (outer, inner)).flatten(2, 3)  # (tile, x, trial * outer, inner)
            sums = (blocks @ fine.mT).unflatten(2, (-1, outer))  # (tile, x, trial, outer, y)
            pixels = factor * (sums * coarse.mT[:, :, None]).sum(-2).transpose(1, 2)
            image = pixels if image is None else image + pixels
        assert image is not None
        return image


Weights = FlatWeights | RaisedWeights


def _times(x: Tensor, factor: Tensor) -> Tensor:
    """Product, stored in the memory of x if no gradient is required."""
    return x * factor if x.requires_grad or factor.requires_grad else x.mul_(factor)


def _ramp(start: Tensor, step: Tensor, n: int, dtype: torch.dtype) -> Tensor:
    """Phasors exp(2j pi (start + i step)), i < n, in a new last dimension."""
    fine, coarse = phasor_tables(step, 0.0, n, dtype)
    return outer_phasor(fine, coarse * unit_phasor(start, dtype)[..., None], n)


def _spreading(below: Tensor, weights: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Matrices of the chunks of pulses that spread them onto nodes.

    below: first node of each pulse, (..., pulse). weights: weights of its nodes, (..., pulse, tap).
    """
    *lead, pulses, taps = weights.shape
    chunks = -(-pulses // CHUNK)
    height = -(-pulses // chunks)
    missing = chunks * height - pulses
    if missing:
        below = torch.cat([below, below[..., -1:].expand(*lead, missing)], -1)
        weights = pad(weights, (0, 0, 0, missing))
    below = below.reshape(*lead, chunks, height)
    least = below.amin(-1)
    joined = int((below.amax(-1) - least).max()) + taps
    device = below.device
    row = (below - least[..., None])[..., None] + torch.arange(taps, device=device)
    at = row * height + torch.arange(height, device=device)[:, None]
    flat = weights.reshape(*lead, chunks, height * taps)
    spread = flat.new_zeros(*lead, chunks, joined * height).scatter(-1, at.flatten(-2), flat)
    node = (least[..., None] + torch.arange(joined, device=device)).clamp_max(nodes - 1)
    return spread.unflatten(-1, (joined, height)), node


class _Windows(torch.autograd.Function):
    """Windows of n adjacent samples. For a size above 0 it is the adjoint: the sum of windows at
    their positions among `size` samples.
    """

    @staticmethod
    def forward(x: Tensor, index: Tensor, n: int, size: int) -> Tensor:
        if not size:
            return x.as_strided((len(x) - n + 1, n), (1, 1)).index_select(0, index)
        at = index[:, None] + torch.arange(n, device=index.device)
        return x.new_zeros(size).index_add_(0, at.reshape(-1), x.reshape(-1))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        x, index, ctx.n, ctx.size = inputs
        ctx.other = 0 if ctx.size else len(x)
        ctx.save_for_backward(index)
        ctx.save_for_forward(index)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Windows.apply(gradient.contiguous(), *ctx.saved_tensors, ctx.n, ctx.other), None, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Windows.apply(tangent.contiguous(), *ctx.saved_tensors, ctx.n, ctx.size)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor, index: Tensor, n: int, size: int) -> tuple[Tensor, int]:
        count, joined = info.batch_size, x.movedim(in_dims[0], 0)
        # the samples of all trials follow each other
        start = torch.arange(count, device=index.device)[:, None] * (size or joined.shape[1])
        every = _Windows.apply(joined.flatten(0, 1), (start + index).reshape(-1), n, count * size)
        return every.unflatten(0, (count, -1)), 0
