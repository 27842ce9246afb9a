"""Impulse response of point targets: width, side lobes and position with sub-cell interpolation."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Signal, checked_samples, cis, power_of

# side of the neighbourhood in which the maximum is interpolated, in samples, by choice
_PATCH = 64
# length of a slice in samples, by choice: on each side it contains 10 null spacings of up to 25
# samples
_SLICE = 512
# _FINE: grid points per sample in the search for the maximum, by choice
# _STEPS: number of Newton steps from the best grid point, by choice
_FINE, _STEPS = 8, 2
# points per sample in an interpolated cut
_FACTOR = 16
# Numbers of samples on both sides of the peak within which a cut is interpolated, by choice.
# The larger number is used for responses that extend beyond the smaller one. If they extend beyond
# both, the whole cut is interpolated.
_NEAR = (32, 128)
# number of responses that are measured at once, by choice: the slices of each take one megabyte
_AT_ONCE = 64


def impulse_response(
    signal: Signal,
    at_m: tuple[Tensor | float, Tensor | float],
    sidelobe_nulls: int = 10,
    search_m: float | None = None,
    centre_turns: tuple[float | None, float | None] = (None, None),
) -> dict[str, Tensor]:
    """Measure width, side lobes and position of the point responses nearest to given positions.

    >>> import torch
    >>> from torchsar import core, metrics
    >>> line = torch.sinc(torch.arange(-32.0, 32.0) / 2)
    >>> axes = core.Axis("azimuth", 64, -16.0, 0.5, "m"), core.Axis("range", 64, -32.0, 1.0, "m")
    >>> image = core.Signal(torch.outer(line, line) + 0j, axes)
    >>> found = metrics.impulse_response(image, at_m=(0.0, 0.0))
    >>> [round(float(found[name]), 2) for name in ("irw_azimuth_m", "irw_range_m", "pslr_range_db")]
    [0.89, 1.77, -13.26]

    Each response is cut along both axes. Every cut is padded with zeros to twice its length and
    then interpolated within the sampled band about the centre of its own spectrum. Images that fill
    the sampled band and images with a squinted spectrum are therefore measured correctly.

    Args:
        signal: Image with two axes, (..., first, second).
        at_m: Coordinates on the two axes in metres, each of shape (...,) for one target per trial,
            or (..., target). The response measured is that of the strongest sample within
            `search_m`.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a sinc of the same -3 dB width. With 10, a sinc has an ISLR of -10.17 dB.
        search_m: Half width of the search in metres; None for 8 samples.
        centre_turns: Centre of the spectrum along each axis in turns per sample. With None it is
            estimated from the neighbourhood, where other scatterers may bias it. The value must be
            given for images whose spectrum fills the whole sampled band.

    Returns:
        For each axis A of the image `irw_A_m` (-3 dB width), `pslr_A_db` (strongest side lobe
        within `sidelobe_nulls`), `islr_A_db` (energy of the side lobes divided by that of the main
        lobe, null to null) and `position_A_m`; and `peak`, the interpolated peak, which is complex:
        `float` takes its `abs()`. The shapes are those of `at_m` broadcast with the trials. Where a
        side lobe exceeds the peak, there is no point response, and widths and side lobes are NaN; a
        warning says so. A weak target in the same row or column as a stronger one is measured with
        so few `sidelobe_nulls` that these do not reach the stronger one.

    Raises:
        ValueError: If the signal does not have two axes, is not finite, or a position lies outside
            it, or if `sidelobe_nulls` is below 1 or `search_m` not positive.
    """
    if len(signal.axes) != 2:
        raise ValueError(f"impulse_response needs a Signal with two axes, got {signal.names}")
    if sidelobe_nulls < 1 or (search_m is not None and not search_m > 0):
        raise ValueError(
            "impulse_response needs sidelobe_nulls of 1 or more and search_m above 0, got "
            f"{sidelobe_nulls} nulls and search_m={search_m}"
        )
    signal = signal.with_data(checked_samples(signal.data, "impulse_response", ", ".join(signal.names)))
    per_target = any(torch.as_tensor(a).ndim > len(signal.trials) for a in at_m)
    positions = torch.broadcast_tensors(
        *(torch.as_tensor(a, dtype=torch.float64, device=signal.data.device) for a in at_m)
    )
    positions = [p if per_target else p[..., None] for p in positions]
    shape = np.broadcast_shapes(positions[0].shape, (*signal.trials, 1))
    centre = [
        _nearest(axis.index_of(p.cpu()).to(p.device), axis.n, axis.name).expand(shape)
        for axis, p in zip(signal.axes, positions, strict=True)
    ]
    reach = [min(_reach(search_m, axis.step), axis.n - 1) for axis in signal.axes]
    image = torch.arange(math.prod(signal.trials), device=signal.data.device).reshape(*signal.trials, 1).expand(shape)
    images = _Images.of(signal.data.reshape(-1, *signal.data.shape[-2:]), reach)
    number = [x.flatten().split(_AT_ONCE) for x in (image, *centre)]
    parts = [
        _measured(images, some, rows, cols, reach, sidelobe_nulls, centre_turns)
        for some, rows, cols in zip(*number, strict=True)
    ]
    out: dict[str, Tensor] = {}
    for k, axis in enumerate(signal.axes):
        figures = {key: torch.cat([part[k][key] for part in parts]).reshape(shape) for key in parts[0][k]}
        out[f"irw_{axis.name}_m"] = figures["irw"] * axis.step
        out[f"pslr_{axis.name}_db"], out[f"islr_{axis.name}_db"] = figures["pslr"], figures["islr"]
        out[f"position_{axis.name}_m"] = axis.start + axis.step * figures["index"]
        out["peak"] = figures["peak"]
    lost = torch.stack([out[f"pslr_{axis.name}_db"] > 0 for axis in signal.axes]).any(0)
    if bool(lost.any()):
        warnings.warn(
            f"{int(lost.sum())} of {lost.numel()} places have no point response: what lies beside is stronger, and "
            "their widths and side lobes are NaN; check the coordinates, widen the search (search_m), or for a weak "
            "target beside a stronger one choose fewer sidelobe_nulls",
            stacklevel=2,
        )
        kept = ("peak", *(f"position_{axis.name}_m" for axis in signal.axes))
        out = {name: value if name in kept else value.masked_fill(lost, torch.nan) for name, value in out.items()}
    return out if per_target else {name: value[..., 0] for name, value in out.items()}


def _measured(
    images: _Images,
    image: Tensor,
    rows: Tensor,
    cols: Tensor,
    reach: list[int],
    nulls: int,
    centre_turns: tuple[float | None, float | None],
) -> list[dict[str, Tensor]]:
    """Measure, along both axes, the response nearest to each given sample.

    rows, cols: indices of the samples, (n,). image: indices of their images, (n,).
    """
    rows, cols = _brightest(images, image, rows, cols, reach)
    rows, cols, tone_a, tone_r, da, dr = _climb(images, image, rows, cols, centre_turns)
    height, width = (min(_SLICE, n) for n in images.shape)
    cuts = [
        _slice_through(images.patch(image, rows, cols, height, _PATCH), tone_r, dr, -1),
        _slice_through(images.patch(image, rows, cols, _PATCH, width), tone_a, da, -2),
    ]
    tones, offsets = [tone_a, tone_r], [da, dr]
    if height == width:
        figures, peak = cut_figures(torch.stack(cuts), torch.stack(tones), torch.stack(offsets), nulls)
        found = [{name: value[k] for name, value in {**figures, "peak": peak}.items()} for k in (0, 1)]
    else:
        each = [cut_figures(*cut, nulls) for cut in zip(cuts, tones, offsets, strict=True)]
        found = [{**figures, "peak": peak} for figures, peak in each]
    return [
        {**figures, "index": index + offset}
        for figures, index, offset in zip(found, (rows, cols), offsets, strict=True)
    ]


def _nearest(index: Tensor, n: int, name: str) -> Tensor:
    """Index of the sample nearest to each position; raises ValueError outside the axis."""
    if not bool(((index >= -0.5) & (index <= n - 0.5)).all()):
        raise ValueError(
            f"at_m of impulse_response lies outside the {name} axis of {n} samples: the positions are the "
            f"samples {float(index.min()):.1f} to {float(index.max()):.1f}"
        )
    return index.round().long().clamp(0, n - 1)


def _reach(search_m: float | None, step: float) -> int:
    """Half width of the search region in samples."""
    return 8 if search_m is None else max(1, math.ceil(search_m / step))


@dataclass(frozen=True)
class _Images:
    """Images (image, row, column) with margins of zeros on all sides.

    Args:
        padded: The images with their margins.
        margin: Width of the margins along both dimensions.
    """

    padded: Tensor
    margin: tuple[int, int]

    @staticmethod
    def of(data: Tensor, reach: list[int]) -> _Images:
        """Add margins to images, wide enough for slices and for a search within `reach` samples."""
        # the maximum may be a few samples away from the strongest sample of the search region
        down, right = (max(_PATCH, min(_SLICE, n)) // 2 + r + 8 for n, r in zip(data.shape[-2:], reach, strict=True))
        return _Images(torch.nn.functional.pad(data, (right, right, down, down)), (down, right))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns without the margins."""
        return self.padded.shape[-2] - 2 * self.margin[0], self.padded.shape[-1] - 2 * self.margin[1]

    def patch(self, image: Tensor, rows: Tensor, cols: Tensor, height: int, width: int) -> Tensor:
        """Neighbourhoods of the samples (rows, cols) of the given images, (n, height, width),
        complex128.

        Each sample is at the index (height // 2, width // 2) of its neighbourhood. rows, cols and
        image have the shape (n,).
        """
        starts = rows + self.margin[0] - height // 2, cols + self.margin[1] - width // 2
        down, right = (x[:, None] + torch.arange(n, device=x.device) for x, n in zip(starts, (height, width)))
        lines = (image * self.padded.shape[-2])[:, None] + down
        places = lines[:, :, None] * self.padded.shape[-1] + right[:, None, :]
        return self.padded.take(places).to(torch.complex128)


def _brightest(images: _Images, image: Tensor, rows: Tensor, cols: Tensor, reach: list[int]) -> tuple[Tensor, Tensor]:
    """Row and column of the strongest sample in the search region about each position."""
    height, width = 2 * reach[0] + 1, 2 * reach[1] + 1
    best = images.patch(image, rows, cols, height, width).abs().flatten(-2).argmax(-1)
    return rows + best // width - reach[0], cols + best % width - reach[1]


def _climb(
    images: _Images,
    image: Tensor,
    rows: Tensor,
    cols: Tensor,
    centre_turns: tuple[float | None, float | None],
    rounds: int = 3,
) -> tuple[Tensor, ...]:
    """Find the interpolated maximum near the strongest sample.

    Returns its row and column, the spectral centres in cycles per sample along both axes, and the
    offsets from the row and column in samples, (n,) each. The search is repeated from the new
    sample, because the maximum of a skewed response may be more than one sample away from the
    strongest sample. This occurs if one axis is sampled finely and the other coarsely.
    """
    found = _refined(images.patch(image, rows, cols, _PATCH, _PATCH), centre_turns)
    for _ in range(rounds):
        down, right = (offset.round().long() for offset in found[2:])
        moved = (down != 0) | (right != 0)
        if not bool(moved.any()):
            break
        rows, cols = rows + down, cols + right
        again = _refined(images.patch(image[moved], rows[moved], cols[moved], _PATCH, _PATCH), centre_turns)
        found = [old.masked_scatter(moved, new) for old, new in zip(found, again, strict=True)]
    return rows, cols, *found


def _refined(patch: Tensor, centre_turns: tuple[float | None, float | None]) -> list[Tensor]:
    """Spectral centres and offsets of the interpolated maximum of neighbourhoods (..., row,
    column).

    The centres along both axes are in cycles per sample; the offsets from the central sample are in
    samples, (...,) each.
    """
    tones = [
        _centre_turns(patch, dim)
        if centre is None
        else torch.full(patch.shape[:-2], centre, dtype=torch.float64, device=patch.device)
        for dim, centre in zip((-2, -1), centre_turns, strict=True)
    ]
    return [*tones, *_fine_peak(patch, *tones)]


def cut_offset(cut: Tensor, tone: Tensor) -> Tensor:
    """Find the position of the interpolated maximum of cuts through point responses.

    Args:
        cut: Cuts whose strongest sample is n // 2, shape (..., n), complex.
        tone: Centre of the spectrum in turns per sample, shape (...,).

    Returns:
        Offset of the maximum from sample n // 2 in samples, shape (...,).
    """
    return _fine_peak(cut[..., None], tone, torch.zeros_like(tone))[0]


def _centre_turns(patch: Tensor, dim: int) -> Tensor:
    """Centre of the spectrum along an axis in cycles per sample, (..., target).

    It is computed from the phase of the products of adjacent samples.
    """
    n = patch.shape[dim]
    lag = (patch.narrow(dim, 1, n - 1) * patch.narrow(dim, 0, n - 1).conj()).sum((-2, -1))
    return torch.angle(lag) / (2 * math.pi)


def _distance(offset: Tensor, n: int) -> Tensor:
    """Distances (..., n) of all samples from positions (...,); these are given relative to sample n
    // 2.
    """
    return offset[..., None] - (torch.arange(n, dtype=torch.float64, device=offset.device) - n // 2)


def _at_baseband(patch: Tensor, tone: Tensor, dim: int) -> Tensor:
    """Shift the spectra of neighbourhoods along an axis from the centre `tone` (...,) to zero."""
    turns = tone[..., None] * _distance(torch.zeros_like(tone), patch.shape[dim])
    return patch * cis(2 * math.pi * turns)[..., None, :].transpose(dim, -1)


def _sinc_derivatives(x: Tensor) -> Tensor:
    """Function sinc(x) and its first two derivatives for x (..., n), (..., 3, n)."""
    near = x.abs() < 1e-3
    over, squared = 1 / torch.where(near, 1, x), (math.pi * x).square()
    value = torch.sinc(x)
    first = torch.where(near, -(math.pi**2) / 3 * x * (1 - squared / 10), (torch.cos(math.pi * x) - value) * over)
    second = torch.where(near, -(math.pi**2) / 3 * (1 - 0.3 * squared), -(math.pi**2) * value - 2 * first * over)
    return torch.stack([value, first, second], -2)


def _fine_peak(patch: Tensor, tone_a: Tensor, tone_r: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets of the interpolated maximum from the central sample along both axes in samples,
    (...,) each.

    The best point of a grid is refined by Newton steps on the squared magnitude.
    """
    patch = _at_baseband(_at_baseband(patch, tone_a, -2), tone_r, -1)
    parts = torch.stack([patch.real, patch.imag], -3)
    grid = torch.linspace(-1, 1, 2 * _FINE + 1, dtype=torch.float64, device=patch.device)
    rows, cols = (torch.sinc(_distance(grid, n)) for n in patch.shape[-2:])
    power = (rows @ parts @ cols.mT).square().sum(-3)
    best = power.flatten(-2).argmax(-1)
    at = torch.stack([grid[best // len(grid)], grid[best % len(grid)]])
    for _ in range(_STEPS):
        along_a, along_r = (_sinc_derivatives(_distance(x, n)) for x, n in zip(at, patch.shape[-2:], strict=True))
        at = (at + _newton_step(along_a[..., None, :, :] @ parts @ along_r[..., None, :, :].mT)).clamp(-1, 1)
    return at[0], at[1]


def _newton_step(jet: Tensor) -> Tensor:
    """Newton step (2, ...) towards a maximum of the squared magnitude.

    The step is at most half a grid step along each axis, and zero where the squared magnitude is
    not concave.

    jet: real and imaginary part of the function and its derivatives, (..., 2, order along the first
    axis, order along the second axis).
    """

    value, slope = jet[..., :1, :1], torch.stack([jet[..., 1, 0], jet[..., 0, 1]], -1)
    bends = (value * jet).sum(-3)
    squares = slope.mT @ slope
    slope_a, slope_r = bends[..., 1, 0], bends[..., 0, 1]
    bend_a, bend_r = bends[..., 2, 0] + squares[..., 0, 0], bends[..., 0, 2] + squares[..., 1, 1]
    twist = bends[..., 1, 1] + squares[..., 0, 1]
    area = bend_a * bend_r - twist.square()
    concave = (bend_a < 0) & (area > 0)
    step = torch.stack([twist * slope_r - bend_r * slope_a, twist * slope_a - bend_a * slope_r])
    return torch.where(concave, step / torch.where(concave, area, 1), 0).clamp(-0.5 / _FINE, 0.5 / _FINE)


def _slice_through(patch: Tensor, tone: Tensor, offset: Tensor, dim: int) -> Tensor:
    """Interpolate at a fractional offset along `dim`; the result is the cut along the other axis,
    (..., n).
    """
    distance = _distance(offset, patch.shape[dim])
    weights = torch.sinc(distance) * cis(2 * math.pi * tone[..., None] * distance)
    return (patch @ weights[..., None])[..., 0] if dim == -1 else (weights[..., None, :] @ patch)[..., 0, :]


def cut_figures(cut: Tensor, tone: Tensor, offset: Tensor, nulls: int) -> tuple[dict[str, Tensor], Tensor]:
    """Measure width and side lobes of cuts through point responses.

    Args:
        cut: Cuts, shape (..., n), complex.
        tone: Centre of the spectrum in turns per sample, shape (...,).
        offset: Position of the maximum relative to sample n // 2 in samples, shape (...,).
        nulls: Distance from the peak up to which side lobes are measured, in null spacings of a
            sinc of the same -3 dB width.

    Returns:
        A dict with `irw` (-3 dB width in samples), `pslr` and `islr` in dB, and the complex peak,
        each of shape (...,).
    """
    n = cut.shape[-1]
    base = torch.arange(n, dtype=torch.float64, device=cut.device) - n // 2
    spectrum = torch.fft.fft(cut * cis(-2 * math.pi * tone[..., None] * base), 2 * n)
    frequency = torch.fft.fftfreq(2 * n, dtype=torch.float64, device=cut.device)
    spectrum = spectrum * cis(2 * math.pi * frequency * (offset + n // 2)[..., None])
    first, *wider = *(reach for reach in _NEAR if reach < n), n
    figures, peak, contained = _lobes(_about_zero(spectrum, first), nulls)
    for reach in wider:
        rest = ~contained
        if not bool(rest.any()):
            break
        again, _, inside = _lobes(_about_zero(spectrum[rest], reach), nulls)
        figures = {name: value.masked_scatter(rest, again[name]) for name, value in figures.items()}
        contained = contained.masked_scatter(rest, inside)
    return figures, peak * cis(2 * math.pi * tone * offset)


def _about_zero(spectrum: Tensor, reach: int) -> Tensor:
    """Interpolate cuts about position 0 from their spectra (..., n).

    Returns `_FACTOR` points per sample at distances below `reach` samples on both sides, (..., 2
    _FACTOR reach - 1). If this is only a part of the cut, Bluestein's chirp transform is used. It
    replaces the sum over the frequencies k by a convolution, since k m = (k^2 + m^2 - (m -
    k)^2) / 2.
    """
    n, m = spectrum.shape[-1], _FACTOR * reach - 1
    bins = torch.fft.fftshift(spectrum, dim=-1)
    if 2 * reach >= n:
        half = (n * _FACTOR - n) // 2
        wide = torch.fft.ifftshift(torch.nn.functional.pad(bins, (half, half)), dim=-1)
        return torch.fft.fftshift(torch.fft.ifft(wide), dim=-1)[..., 1:] * _FACTOR
    size = n + 2 * m + 2
    k = torch.arange(-(n // 2), n // 2, device=spectrum.device)
    to = torch.arange(-m, m + 1, device=spectrum.device)
    apart = torch.arange(size, device=spectrum.device)
    apart = torch.where(apart <= 2 * m, apart, apart - size) + n // 2 - m
    over_k, over_m, between = (_chirp(x, n * _FACTOR) for x in (k, to, apart))
    product = torch.fft.fft(bins * over_k, size) * torch.fft.fft(between.conj())
    return torch.fft.ifft(product)[..., : 2 * m + 1] * over_m / n


def _chirp(index: Tensor, period: int) -> Tensor:
    """Chirp exp(j pi index^2 / period); whole periods are removed from the square before
    rounding.
    """
    return cis(math.pi * torch.remainder(index.square(), 2 * period).to(torch.float64) / period)


def _lobes(fine: Tensor, nulls: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Measure width and side lobes of interpolated cuts (..., 2 m - 1) whose peak is in the middle.

    Also returns the values at the peaks, and True where the cut contains the whole main lobe and
    all side lobes to be measured, (...,) each.
    """
    power = power_of(fine)
    middle = fine.shape[-1] // 2
    right, left = power[..., middle:], power[..., : middle + 1].flip(-1)
    irw = _crossing(right) + _crossing(left)
    extent = nulls * irw / 0.8859
    position = torch.arange(right.shape[-1], dtype=torch.float64, device=fine.device)
    main, side_energy, strongest = torch.zeros_like(irw), torch.zeros_like(irw), torch.zeros_like(irw)
    contained = extent < middle
    for side in (right, left):
        null = _first_minimum(side)
        contained = contained & (null < middle)
        inside_main = position < null[..., None]
        beside = side * (~inside_main & (position <= extent[..., None]))
        main = main + (side * inside_main)[..., 1:].sum(-1) + 0.5 * side[..., 0]
        side_energy = side_energy + beside.sum(-1)
        strongest = torch.maximum(strongest, beside.amax(-1))
    floor = torch.finfo(power.dtype).tiny
    peak = right[..., 0].clamp_min(floor)
    figures = {
        "irw": irw / _FACTOR,
        "pslr": 10 * torch.log10((strongest / peak).clamp_min(1e-30)),
        "islr": 10 * torch.log10((side_energy / main.clamp_min(floor)).clamp_min(1e-30)),
    }
    return figures, fine[..., middle], contained


def _crossing(side: Tensor) -> Tensor:
    """Distance from the peak (index 0) to half of its power, in samples of the interpolated cut.

    It is found by linear interpolation of the power.
    """
    below = side < side[..., :1] / 2
    i = torch.where(below.any(-1), below.to(torch.int8).argmax(-1), side.shape[-1] - 1).clamp_min(1)
    high, low = (side.gather(-1, (i - k)[..., None])[..., 0] for k in (1, 0))
    step = (high - side[..., 0] / 2) / torch.where(high > low, high - low, 1)
    return i - 1 + step.clamp(0, 1)


def _first_minimum(side: Tensor) -> Tensor:
    """Index of the first local minimum of the power beyond the half-power point."""
    rising = (side[..., 1:] > side[..., :-1]) & (side[..., :-1] < side[..., :1] / 2)
    return torch.where(rising.any(-1), rising.to(torch.int8).argmax(-1), side.shape[-1] - 1)
