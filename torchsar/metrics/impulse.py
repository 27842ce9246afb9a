"""Impulse response of point targets: width, side lobes and position with sub-cell interpolation."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Signal, checked_samples, cis

# chosen: samples per axis of the neighbourhood in which the maximum is interpolated
_PATCH = 64
# chosen: samples of a slice; 10 null spacings of up to 25 samples fit on either side
_SLICE = 512
# chosen: grid points per sample of the search for the maximum, before a parabola refines it
_FINE = 32


def impulse_response(
    signal: Signal,
    at_m: tuple[Tensor | float, Tensor | float],
    sidelobe_nulls: int = 10,
    search_m: float | None = None,
    centre_turns: tuple[float | None, float | None] = (None, None),
) -> dict[str, Tensor]:
    """Measure width, side lobes and position of the point responses nearest to given positions.

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
        lobe, null to null) and `position_A_m`; and `peak`, the complex interpolated peak. The
        shapes are those of `at_m` broadcast with the trials.

    Raises:
        ValueError: If the signal does not have two axes, is not finite, or a position lies outside
            it, or if `sidelobe_nulls` is below 1 or `search_m` not positive.
    """
    if not isinstance(signal, Signal) or len(signal.axes) != 2:
        raise ValueError(
            "impulse_response needs a Signal with two axes, got "
            f"{signal.names if isinstance(signal, Signal) else type(signal).__name__}"
        )
    if len(at_m) != 2:
        raise ValueError(f"at_m needs one coordinate for each of the axes {signal.names}, got {len(at_m)}")
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
    reach = [_reach(search_m, axis.step) for axis in signal.axes]
    data = signal.data.to(torch.complex128)
    rows, cols = _brightest(data, centre, reach)
    rows, cols, tone_a, tone_r, da, dr = _climb(data, rows, cols, centre_turns)
    azimuth = _slice_through(_patch(data, rows, cols, min(_SLICE, signal.axes[0].n), _PATCH), tone_r, dr, -1)
    range_ = _slice_through(_patch(data, rows, cols, _PATCH, min(_SLICE, signal.axes[1].n)), tone_a, da, -2)
    out: dict[str, Tensor] = {}
    for axis, cut, tone, index, offset in (
        (signal.axes[0], azimuth, tone_a, rows, da),
        (signal.axes[1], range_, tone_r, cols, dr),
    ):
        figures, peak = cut_figures(cut, tone, offset, sidelobe_nulls)
        out[f"irw_{axis.name}_m"] = figures["irw"] * axis.step
        out[f"pslr_{axis.name}_db"], out[f"islr_{axis.name}_db"] = figures["pslr"], figures["islr"]
        out[f"position_{axis.name}_m"] = axis.start + axis.step * (index + offset)
        out["peak"] = peak
    return out if per_target else {name: value[..., 0] for name, value in out.items()}


def _nearest(index: Tensor, n: int, name: str) -> Tensor:
    """Nearest sample of each position; raises ValueError outside the axis."""
    if not bool(((index >= -0.5) & (index <= n - 0.5)).all()):
        raise ValueError(
            f"at_m of impulse_response lies outside the {name} axis of {n} samples: the positions are the "
            f"samples {float(index.min()):.1f} to {float(index.max()):.1f}"
        )
    return index.round().long().clamp(0, n - 1)


def _reach(search_m: float | None, step: float) -> int:
    """Half width of the search in samples."""
    return 8 if search_m is None else max(1, math.ceil(search_m / step))


def _patch(data: Tensor, rows: Tensor, cols: Tensor, height: int, width: int, image: Tensor | None = None) -> Tensor:
    """Neighbourhoods (..., target, height, width) with (rows, cols) at sample (height//2,
    width//2); zero outside the image.

    image: Number of the image of each position (n,) among all of data; None where positions (...,
    target) have the leading dimensions of data.
    """
    n_a, n_r = data.shape[-2:]
    i = rows[..., None, None] + torch.arange(height, device=data.device)[:, None] - height // 2
    j = cols[..., None, None] + torch.arange(width, device=data.device) - width // 2
    down, right = (i >= 0) & (i < n_a), (j >= 0) & (j < n_r)
    at = i.clamp(0, n_a - 1) * n_r + j.clamp(0, n_r - 1)
    if image is None:
        flat = at.flatten(-3)
        trials = np.broadcast_shapes(data.shape[:-2], flat.shape[:-1])
        values = data.flatten(-2).expand(*trials, -1).gather(-1, flat.expand(*trials, -1))
        values = values.reshape(*trials, rows.shape[-1], height, width)
    else:
        values = data.take(at + image[:, None, None] * (n_a * n_r))
    return values if bool(down.all() & right.all()) else torch.where(down & right, values, 0)


def _brightest(data: Tensor, centre: list[Tensor], reach: list[int]) -> tuple[Tensor, Tensor]:
    """Row and column of the strongest sample within reach of each position."""
    height, width = 2 * reach[0] + 1, 2 * reach[1] + 1
    best = _patch(data, centre[0], centre[1], height, width).abs().flatten(-2).argmax(-1)
    return centre[0] + best // width - reach[0], centre[1] + best % width - reach[1]


def _climb(
    data: Tensor, rows: Tensor, cols: Tensor, centre_turns: tuple[float | None, float | None], rounds: int = 3
) -> tuple[Tensor, ...]:
    """From the strongest sample to the interpolated maximum: row, column, spectral centres in turns
    per sample, offsets in samples. A skewed response that is sampled finely in one axis and
    coarsely in the other has its maximum more than a sample away from its strongest sample.
    """
    found = _refined(_patch(data, rows, cols, _PATCH, _PATCH), centre_turns)
    lead = data.shape[:-2]
    image = torch.arange(math.prod(lead), device=data.device).reshape(*lead, 1).expand_as(found[0])
    for _ in range(rounds):
        down, right = (offset.round().long() for offset in found[2:])
        moved = (down != 0) | (right != 0)
        if not bool(moved.any()):
            break
        rows, cols = rows + down, cols + right
        patch = _patch(data, rows[moved], cols[moved], _PATCH, _PATCH, image[moved])
        again = _refined(patch, centre_turns)
        found = [old.masked_scatter(moved, new) for old, new in zip(found, again, strict=True)]
    return rows, cols, *found


def _refined(patch: Tensor, centre_turns: tuple[float | None, float | None]) -> list[Tensor]:
    """Spectral centres in turns per sample, and offsets of the interpolated maximum from the
    central sample of neighbourhoods (..., row, column) in samples, shape (...,) each.
    """
    tone_a, tone_r = (
        _centre_turns(patch, dim)
        if centre is None
        else torch.full(patch.shape[:-2], centre, dtype=torch.float64, device=patch.device)
        for dim, centre in zip((-2, -1), centre_turns, strict=True)
    )
    return [tone_a, tone_r, *_fine_peak(patch, tone_a, tone_r)]


def cut_offset(cut: Tensor, tone: Tensor) -> Tensor:
    """Find the position of the interpolated maximum of cuts through point responses.

    Args:
        cut: Cuts whose strongest sample is n // 2, shape (..., n), complex.
        tone: Centre of the spectrum in turns per sample, shape (...,).

    Returns:
        Offset of the maximum from sample n // 2 in samples, shape (...,).
    """
    grid = torch.linspace(-1, 1, 2 * _FINE + 1, dtype=torch.float64, device=cut.device).expand(*tone.shape, -1)
    fine = (_kernel(grid, cut.shape[-1], tone) @ cut[..., None])[..., 0].abs().square()
    best = fine.argmax(-1)
    return (best + _parabola(fine, best) - _FINE) / _FINE


def _centre_turns(patch: Tensor, dim: int) -> Tensor:
    """Centre of the spectrum along dim in turns per sample, from the phase of the lag-one product,
    (..., target).
    """
    n = patch.shape[dim]
    lag = (patch.narrow(dim, 1, n - 1) * patch.narrow(dim, 0, n - 1).conj()).sum((-2, -1))
    return torch.angle(lag) / (2 * math.pi)


def _kernel(offsets: Tensor, n: int, tone: Tensor) -> Tensor:
    """Weights (..., offset, n) that interpolate a band about `tone` at fractional offsets (...,
    offset) from sample n//2.
    """
    distance = offsets[..., None] - (torch.arange(n, dtype=torch.float64, device=offsets.device) - n // 2)
    return torch.sinc(distance) * cis(2 * math.pi * tone[..., None, None] * distance)


def _fine_peak(patch: Tensor, tone_a: Tensor, tone_r: Tensor) -> tuple[Tensor, Tensor]:
    """Offset of the interpolated maximum from the central sample along each dim in samples, (...,
    target).
    """
    grid = torch.linspace(-1, 1, 2 * _FINE + 1, dtype=torch.float64, device=patch.device)
    grid = grid.expand(*tone_a.shape, -1)
    fine = _kernel(grid, patch.shape[-2], tone_a) @ patch @ _kernel(grid, patch.shape[-1], tone_r).mT
    fine = fine.real.square() + fine.imag.square()
    best = fine.flatten(-2).argmax(-1)
    i, j = best // grid.shape[-1], best % grid.shape[-1]
    along_a = fine.gather(-1, j[..., None, None].expand(*j.shape, fine.shape[-2], 1))[..., 0]
    along_r = fine.gather(-2, i[..., None, None].expand(*i.shape, 1, fine.shape[-1]))[..., 0, :]
    return tuple((index + _parabola(curve, index) - _FINE) / _FINE for index, curve in ((i, along_a), (j, along_r)))  # type: ignore[return-value]


def _parabola(curve: Tensor, index: Tensor) -> Tensor:
    """Sub-sample offset of the maximum near `index` of curve (..., n)."""
    index = index.clamp(1, curve.shape[-1] - 2)
    low, mid, high = (curve.gather(-1, index[..., None] + k)[..., 0] for k in (-1, 0, 1))
    bend = low - 2 * mid + high
    return torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0).clamp(-1, 1)


def _slice_through(patch: Tensor, tone: Tensor, offset: Tensor, dim: int) -> Tensor:
    """Cut (..., target, n) along the other dim, at a fractional offset along `dim`."""
    weights = _kernel(offset[..., None], patch.shape[dim], tone)[..., 0, :]
    return (patch * (weights[..., None, :] if dim == -1 else weights[..., :, None])).sum(dim)


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
    n, factor = cut.shape[-1], 16
    base = torch.arange(n, dtype=torch.float64, device=cut.device) - n // 2
    base = cut * cis(-2 * math.pi * tone[..., None] * base)
    spectrum = torch.fft.fft(base, 2 * n)
    frequency = torch.fft.fftfreq(2 * n, dtype=torch.float64, device=cut.device)
    shift = offset + n // 2
    spectrum = spectrum * cis(2 * math.pi * frequency * shift[..., None])
    wide = torch.zeros((*spectrum.shape[:-1], 2 * n * factor), dtype=spectrum.dtype, device=cut.device)
    wide[..., :n], wide[..., -n:] = spectrum[..., :n], spectrum[..., n:]
    fine = torch.fft.ifft(wide) * factor
    power = torch.fft.fftshift(fine.real.square() + fine.imag.square(), dim=-1)
    middle = n * factor
    right, left = power[..., middle:], power[..., 1 : middle + 1].flip(-1)
    widths = [_crossing(side) for side in (right, left)]
    first_nulls = [_first_minimum(side) for side in (right, left)]
    irw = widths[0] + widths[1]
    extent = nulls * irw / 0.8859
    position = torch.arange(right.shape[-1], dtype=torch.float64, device=cut.device)
    main = torch.zeros_like(irw)
    side_energy, strongest = torch.zeros_like(irw), torch.zeros_like(irw)
    for side, null in zip((right, left), first_nulls, strict=True):
        inside_main = position < null[..., None]
        inside_side = ~inside_main & (position <= extent[..., None])
        main = main + (side * inside_main)[..., 1:].sum(-1) + 0.5 * side[..., 0]
        side_energy = side_energy + (side * inside_side).sum(-1)
        strongest = torch.maximum(strongest, (side * inside_side).amax(-1))
    floor = torch.finfo(power.dtype).tiny
    peak = right[..., 0].clamp_min(floor)
    figures = {
        "irw": irw / factor,
        "pslr": 10 * torch.log10((strongest / peak).clamp_min(1e-30)),
        "islr": 10 * torch.log10((side_energy / main.clamp_min(floor)).clamp_min(1e-30)),
    }
    return figures, fine[..., 0] * cis(2 * math.pi * tone * offset)


def _crossing(side: Tensor) -> Tensor:
    """Distance from the peak (index 0) to half its power in fine samples, by linear
    interpolation.
    """
    below = side < side[..., :1] / 2
    i = torch.where(below.any(-1), below.to(torch.int8).argmax(-1), side.shape[-1] - 1).clamp_min(1)
    high, low = (side.gather(-1, (i - k)[..., None])[..., 0] for k in (1, 0))
    step = (high - side[..., 0] / 2) / torch.where(high > low, high - low, 1)
    return i - 1 + step.clamp(0, 1)


def _first_minimum(side: Tensor) -> Tensor:
    """Index of the first local minimum after the peak, past the half-power point."""
    rising = (side[..., 1:] > side[..., :-1]) & (side[..., :-1] < side[..., :1] / 2)
    return torch.where(rising.any(-1), rising.to(torch.int8).argmax(-1), side.shape[-1] - 1)
