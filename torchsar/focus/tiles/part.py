"""One zone of tiles and one sub-aperture: its plan, the tables of its pulses, and its image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import outer_phasor, phasor_tables, real_dtype, unit_phasor
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.choice import CHUNK, Choice, even_length, profile_length
from torchsar.focus.tiles.expansion import MOMENTS, Expansion, curvatures, slopes
from torchsar.focus.tiles.kernels import CROSS_OVERSAMPLING, node_values, spread_kernel, window_slope

# pulses to which the polynomials of a part are fitted
_FIT_PULSES = 64
# share of the extent of s that is added at either end for changes of the path, and least margin
_MARGIN, _LEAST_MARGIN = 0.02, 1e-6
_TURN = 2 * math.pi


@dataclass(frozen=True, eq=False)
class Band:
    """Frequencies, and the range profiles formed of them.

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
        """Range profiles (..., length) of a history (..., frequency), from difference zero on."""
        padded = pad(history, (0, self.length - self.n))
        return torch.fft.ifft(torch.roll(padded, -(self.n // 2), -1), dim=-1, norm="forward")


@dataclass(frozen=True, eq=False)
class Tables:
    """What the pulses and tiles of a group need; differentiable in the positions of the antennas.

    Args:
        first: First sample of each window, shape (tile, path, pulse), int64.
        before: Weights of the samples of a window, complex (tile, path, pulse, sample).
        after: Weights of their spectrum, complex (tile, path, pulse, wave number).
        spread: Weights of pulses at nodes, real (tile, path, chunk, node of the chunk, pulse).
        node: Node of each row of `spread`, (tile, path, chunk, node of the chunk), int64.
    """

    first: Tensor
    before: Tensor
    after: Tensor
    spread: Tensor
    node: Tensor


class Part:
    """Plan of a block of tiles and of a range of pulses.

    Args:
        band: Frequencies and profiles.
        choice: Sizes.
        places: Nominal positions of one or two antennas over the pulses of the part, float64
            (pulse, 3).
        every: Positions of all paths, float64 (path, pulse, 3), for the extents.
        centre: Centres of the tiles, float64 (tile, 3).
        grid: Pixels, with the second axis nearer to the range direction.
    """

    def __init__(
        self,
        band: Band,
        choice: Choice,
        places: Sequence[Tensor],
        every: Sequence[Tensor],
        centre: Tensor,
        grid: ImageGrid,
    ) -> None:
        axes = grid.axes
        self.band, self.choice, self.centre, self.axes = band, choice, centre, axes
        self.pulses = pulses = len(places[0])
        fitted = torch.linspace(0, pulses - 1, min(pulses, _FIT_PULSES)).round().long()
        self.reference = [v[pulses // 2, None] for v in places]
        self.expansion = Expansion.of([v[fitted] for v in places], self.reference, centre, axes, band.carrier)
        self.x, self.y = (
            (torch.arange(n, dtype=torch.float64, device=centre.device) - (n - 1) / 2) * grid.step_m
            for n in (choice.width, choice.depth)
        )
        low, high = self._extent(every)
        margin = _MARGIN * (high - low) + _LEAST_MARGIN
        extent = low - margin, high + margin
        taps = choice.taps
        self.node_step = _TURN / (band.highest * choice.width * grid.step_m * CROSS_OVERSAMPLING)
        self.low = extent[0] - taps / 2 * self.node_step
        self.nodes = math.ceil((extent[1] - extent[0]) / self.node_step) + taps + 1
        self.extent = extent
        flat = 2 * self._reach(every) + 1
        self.length = even_length(flat + choice.rise)
        self.slope = window_slope(choice.rise, choice.guard).to(centre.device)
        self.samples = self.length + choice.rise
        self._across(extent)

    def _extent(self, places: Sequence[Tensor]) -> tuple[float, float]:
        """Least and largest s of the pulses in the tiles."""
        _, a, b = slopes(places, self.centre, self.axes)
        s = a / (b / self.expansion.b[..., None]) - self.expansion.a[..., None]
        return float(s.min()), float(s.max())

    def _reach(self, places: Sequence[Tensor]) -> float:
        """Largest path difference of a pixel from the centre of its tile, in samples."""
        _, a, b = slopes(places, self.centre, self.axes)
        half = float(self.x[-1]), float(self.y[-1])
        bend = float(curvatures([v[..., ::16, :] for v in places], self.centre, self.axes).abs().max())
        reach = float((a.abs() * half[0] + b.abs() * half[1]).max()) + bend * (half[0] + half[1]) ** 2 / 2
        return reach / self.band.step_m

    def covers(self, places: Sequence[Tensor]) -> bool:
        """Whether other positions, each float64 (path, pulse, 3), stay within nodes and windows."""
        low, high = self._extent(places)
        inside = self.extent[0] <= low and high <= self.extent[1]
        return inside and 2 * self._reach(places) + 1 <= self.length - self.choice.rise

    def _across(self, extent: tuple[float, float]) -> None:
        """Matrices from nodes to pixels across the range, and the weights of the tiles."""
        m = torch.arange(self.length, dtype=torch.float64, device=self.centre.device) - self.length // 2
        q = m * (_TURN / (self.length * self.band.step_m))
        s = torch.linspace(*extent, 3 * self.nodes, dtype=torch.float64, device=self.centre.device)
        values = node_values((s - self.low) / self.node_step, self.nodes, self.choice.taps) / self.length
        phase = self.expansion.common_phase(s, q[:, None, None], self.x[:, None]) / _TURN
        phasor = unit_phasor(phase, torch.complex128)
        moments = torch.cat([phasor * s**power for power in range(MOMENTS)], 1)  # (wave number, moment x, sample)
        across = torch.complex(moments.real @ values.mT, moments.imag @ values.mT)
        cut = q[:, None, None]
        tile = unit_phasor(self.expansion.tile_phase(cut, self.x) / _TURN, torch.complex128)
        weights = [
            [weight * tile for weight in weights]
            for weights in self.expansion.remainders(cut, self.x, self.choice.order)
        ]
        along = unit_phasor(self.expansion.range_phase(q, self.y) / _TURN, torch.complex128)
        self._matrices = {
            torch.complex128: Matrices(
                across.mT.contiguous(),
                [[w.expand(-1, len(self.centre), -1) for w in row] for row in weights],
                [along * self.y**power for power in range(self.choice.order + 1)],
                self._pixel_phasors(),
            )
        }

    def _pixel_phasors(self) -> Tensor:
        """Carrier phase of the pixels at the reference place, complex128 (tile, x, y)."""
        along = self.x[:, None, None] * self.axes[0] + self.y[:, None] * self.axes[1]
        pixels = self.centre[:, None, None] + along
        path = slopes(self.reference, pixels.reshape(-1, 3), self.axes)[0].reshape(pixels.shape[:-1])
        return unit_phasor((path - self.expansion.path_m[..., None]) * (self.band.carrier / _TURN), torch.complex128)

    def matrices(self, dtype: torch.dtype) -> Matrices:
        """Matrices in the precision of a history."""
        if dtype not in self._matrices:
            self._matrices[dtype] = self._matrices[torch.complex128].to(dtype)
        return self._matrices[dtype]

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
        path, a, b = slopes(places, self.centre[rows], self.axes)
        path, stretch = path - reference_m, b / of.b[rows, :, None]
        s = a / stretch - of.a[rows, :, None]
        at = path / band.step_m
        nearest = torch.round(at.detach())
        fraction = at - nearest
        first = torch.remainder(nearest.long() - self.samples // 2, band.length)
        # the carrier becomes k_c / (1 + eps); half a turn per sample centres the spectrum
        per_sample = band.carrier * band.step_m / _TURN * (1 - 1 / stretch)
        start = band.carrier / _TURN * path - per_sample * (fraction + self.samples // 2)
        before = _ramp(start + self.samples // 2 * 0.5, per_sample + 0.5, self.samples, dtype)
        parts, rise = torch.view_as_real(before), self.choice.rise
        parts[..., :rise, :] *= self.slope.to(real)[:, None]
        parts[..., -rise:, :] *= self.slope.to(real).flip(0)[:, None]
        after = _ramp(-fraction / 2, fraction / self.length + 0.5, self.length, dtype)
        position = (s - self.low) / self.node_step
        below = torch.ceil(position.detach() - taps / 2)
        away = (below - position)[..., None] + torch.arange(taps, device=device)
        weights = spread_kernel(away.to(real), taps)
        return Tables(first, before, after, *_spreading(below.long(), weights, self.nodes))

    def nodes_of(self, profiles: Tensor, tables: Tables) -> Tensor:
        """Sum the windows of the pulses at the nodes of some tiles.

        Args:
            profiles: Range profiles, extended circularly, complex (path, pulse, trial, sample).
            tables: Tables of the tiles.

        Returns:
            Real and imaginary parts, real (tile * path, node, trial * wave number * 2).
        """
        tiles, paths, pulses = tables.first.shape
        trials, stride = profiles.shape[-2:]
        base = torch.arange(paths * pulses * trials, device=profiles.device).reshape(paths, pulses, trials) * stride
        index = (tables.first[..., None] + base).reshape(-1)
        x = _Cut.apply(profiles.reshape(-1), index, self.samples)
        x = _times(x.view(tiles, paths, pulses, trials, self.samples), tables.before[..., None, :])
        rise = self.samples - self.length
        half = rise // 2
        # the slopes overlap outside the part that is used
        y = x[..., half : half + self.length].clone()
        y[..., :half] += x[..., half + self.length :]
        y[..., self.length - half :] += x[..., :half]
        y = _times(torch.fft.fft(y), tables.after[..., None, :])
        y = torch.view_as_real(y).reshape(tiles * paths, pulses, -1)
        chunks, joined, height = tables.spread.shape[-3:]
        if chunks * height != pulses:
            y = pad(y, (0, 0, 0, chunks * height - pulses))
        width = y.shape[-1]
        z = torch.bmm(tables.spread.reshape(-1, joined, height), y.view(tiles * paths * chunks, height, width))
        block = torch.arange(tiles * paths, device=y.device) * self.nodes
        target = tables.node.reshape(tiles * paths, -1) + block[:, None]
        out = z.new_zeros(tiles * paths * self.nodes, width).index_add(0, target.reshape(-1), z.reshape(-1, width))
        return out.view(tiles * paths, self.nodes, width)

    def pixels_of(self, nodes: Tensor, rows: slice, trials: int) -> Tensor:
        """Form the pixels of some tiles.

        Args:
            nodes: Sums at the nodes, real (tile * path, node, trial * wave number * 2).
            rows: Tiles of the part.
            trials: Trials of a path.

        Returns:
            Pixels, complex (tile, path * trial, x, y).
        """
        tiles = len(self.centre[rows])
        z = torch.view_as_complex(nodes.view(-1, self.nodes, trials, self.length, 2))
        z = z.permute(3, 0, 2, 1).reshape(self.length, -1, self.nodes)
        matrices = self.matrices(z.dtype)
        moments = torch.bmm(z, matrices.across).view(self.length, tiles, -1, MOMENTS, len(self.x)).unbind(-2)
        image: Tensor | None = None
        for weights, along in zip(matrices.weights, matrices.along, strict=True):
            part = moments[0] * weights[0][:, rows, None]
            for moment, weight in zip(moments[1:], weights[1:], strict=True):
                part = torch.addcmul(part, moment, weight[:, rows, None])
            part = part.permute(1, 2, 3, 0).reshape(tiles, -1, self.length)
            image = torch.bmm(part, along[rows]) if image is None else torch.baddbmm(image, part, along[rows])
        assert image is not None
        return _times(image.view(tiles, -1, len(self.x), len(self.y)), matrices.pixels[rows, None])


@dataclass(frozen=True, eq=False)
class Matrices:
    """Constant matrices of a part.

    Args:
        across: Nodes to pixels across the range, (wave number, node, moment * x).
        weights: Weights of the moments, by power of y and moment, (wave number, tile, x).
        along: Wave numbers to pixels along the range, by power of y, (tile, wave number, y).
        pixels: Carrier phase of the pixels, (tile, x, y).
    """

    across: Tensor
    weights: list[list[Tensor]]
    along: list[Tensor]
    pixels: Tensor

    def to(self, dtype: torch.dtype) -> Matrices:
        """Return the matrices in another precision."""
        return Matrices(
            self.across.to(dtype),
            [[w.to(dtype) for w in row] for row in self.weights],
            [v.to(dtype) for v in self.along],
            self.pixels.to(dtype),
        )


def _times(x: Tensor, factor: Tensor) -> Tensor:
    """Product, in the memory of x where no gradient is asked for."""
    return x * factor if x.requires_grad or factor.requires_grad else x.mul_(factor)


def _ramp(start: Tensor, step: Tensor, n: int, dtype: torch.dtype) -> Tensor:
    """Phasors exp(2j pi (start + i step)), i < n, in a new last dimension."""
    fine, coarse = phasor_tables(step, 0.0, n, dtype)
    return outer_phasor(fine, coarse * unit_phasor(start, dtype)[..., None], n)


def _spreading(below: Tensor, weights: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Matrices of the chunks of pulses, from the first node of each pulse, (..., pulse), and the
    weights of its nodes, (..., pulse, tap).
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


class _Cut(torch.autograd.Function):
    """Windows of adjacent samples; the adjoint of `_Lay`."""

    @staticmethod
    def forward(ctx, x: Tensor, index: Tensor, n: int) -> Tensor:
        ctx.save_for_backward(index)
        ctx.size, ctx.n = len(x), n
        return x.as_strided((len(x) - n + 1, n), (1, 1)).index_select(0, index)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        return _Lay.apply(gradient, ctx.saved_tensors[0], ctx.size), None, None


class _Lay(torch.autograd.Function):
    """Sum of windows at their places; the adjoint of `_Cut`."""

    @staticmethod
    def forward(ctx, windows: Tensor, index: Tensor, size: int) -> Tensor:
        ctx.save_for_backward(index)
        ctx.n = windows.shape[-1]
        at = index[:, None] + torch.arange(ctx.n, device=index.device)
        return windows.new_zeros(size).index_add_(0, at.reshape(-1), windows.reshape(-1))

    @staticmethod
    def backward(ctx, gradient: Tensor):
        return _Cut.apply(gradient.contiguous(), ctx.saved_tensors[0], ctx.n), None, None
