"""Impulse responses on finer grids, for drawing."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, cis
from torchsar.metrics.impulse import impulse_response

# least number of samples of a cut to either side, and further ones that its interpolation needs
_LEAST, _MORE = 24, 8
# number of points of a cut per sample
_FACTOR = 16
# -3 dB width of a response, divided by the spacing of its nulls
_WIDTH = 0.886


def impulse_cuts(image: Signal, at_m: tuple[float, float]) -> dict[str, tuple[Tensor, Tensor]]:
    """Cut through the point response nearest to a position, along both axes of an image.

    The cuts have 16 points per sample of the image. They are interpolated by sinc kernels modulated
    to the centre of the local spectrum. To either side of the peak they extend over ten side lobes
    of a sinc, at least 24 samples, unless the image ends before.

    Args:
        image: Image of one trial, (first, second).
        at_m: Coordinates on the two axes in metres.

    Returns:
        A dict with the name of each axis as the key. Its values are pairs of the offsets from the
        peak in metres and the complex cut, shape (n,) each.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a cut through a place without a point response shows it
        measured = impulse_response(image, at_m)
    positions, windows, reaches = [], [], []
    for axis in image.axes:
        nulls = float(measured[f"irw_{axis.name}_m"]) / _WIDTH / axis.step
        # number of null spacings of a cut to either side: ten side lobes and half of the main lobe
        reach = min(max(_LEAST, math.ceil(11 * nulls)), axis.n // 2) if math.isfinite(nulls) else _LEAST
        at = float(axis.index_of(measured[f"position_{axis.name}_m"]))
        first = max(0, min(round(at) - reach - _MORE, axis.n - 2 * (reach + _MORE)))
        windows.append(slice(first, first + 2 * (reach + _MORE)))
        positions.append(at - first)
        reaches.append(reach)
    patch = image.data[windows[0], windows[1]].to(torch.complex128)
    tones = [_centre_turns(patch, dim) for dim in (0, 1)]
    cuts: dict[str, tuple[Tensor, Tensor]] = {}
    for dim, axis in enumerate(image.axes):
        other, steps = 1 - dim, reaches[dim] * _FACTOR
        through = _kernel(torch.tensor([positions[other]], dtype=torch.float64), patch.shape[other], tones[other])[0]
        line = (patch * (through[None, :] if dim == 0 else through[:, None])).sum(other)
        offsets = torch.arange(-steps, steps + 1, dtype=torch.float64) / _FACTOR
        offsets = offsets[(positions[dim] + offsets >= 0) & (positions[dim] + offsets <= len(line) - 1)]
        cuts[axis.name] = (offsets * axis.step, _kernel(positions[dim] + offsets, len(line), tones[dim]) @ line)
    return cuts


def finer(line: Tensor, factor: int) -> Tensor:
    """Interpolate cuts by zero padding of their spectra, which must be centred on zero frequency.

    Args:
        line: Samples of the cuts, shape (..., n), continued periodically.
        factor: Samples of the result per sample of `line`.

    Returns:
        The finer cuts, shape (..., factor n), complex128, with the amplitude divided by `factor`.
    """
    n = line.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(line.to(torch.complex128)), dim=-1)
    before = (factor * n) // 2 - n // 2
    wide = torch.nn.functional.pad(spectrum, (before, (factor - 1) * n - before))
    return torch.fft.ifft(torch.fft.ifftshift(wide, dim=-1))


def about_peak(image: Signal, reach: tuple[float, float], samples: int) -> Signal:
    """Interpolate the part of an image about its strongest sample.

    Args:
        image: Image of one trial, (first, second).
        reach: Half extents of the part along the two axes, in the units of the axes.
        samples: Samples of the result along either axis.

    Returns:
        The part about the strongest sample, complex128; its axes hold the offsets from that sample.
    """
    peak = divmod(int(image.data.abs().argmax()), image.axes[1].n)
    kernels, axes = [], []
    for axis, at, half in zip(image.axes, peak, reach, strict=True):
        offset = torch.linspace(-half, half, samples, dtype=torch.float64)
        kernels.append(_kernel(at + offset / axis.step, axis.n, 0.0))
        axes.append(Axis(axis.name, samples, -half, 2 * half / (samples - 1), axis.unit))
    return Signal(kernels[0] @ image.data.to(torch.complex128) @ kernels[1].mT, tuple(axes))


def _centre_turns(patch: Tensor, dim: int) -> float:
    """Centre of the spectrum along dim in cycles per sample."""
    n = patch.shape[dim]
    return float(torch.angle((patch.narrow(dim, 1, n - 1) * patch.narrow(dim, 0, n - 1).conj()).sum())) / (2 * math.pi)


def _kernel(places: Tensor, n: int, tone: float) -> Tensor:
    """Weights (place, n) that interpolate a band around `tone` at fractional positions."""
    distance = places[:, None] - torch.arange(n, dtype=torch.float64)
    return torch.sinc(distance) * cis(2 * math.pi * tone * distance)
