"""Smoothing of a mean periodogram that keeps the edges of its band."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def smoothed_spectrum(power: Tensor, looks: Tensor) -> Tensor:
    """Smooth a mean periodogram by a Haar wavelet transform of its logarithm.

    The transform is shift-invariant (without decimation). Details, the differences of neighbouring
    means, are set to zero where they are within 3.3 standard deviations of what the scatter of
    independent exponential powers gives. Constant parts become smooth, and the edges of a band stay
    sharp.

    Args:
        power: Mean power over `looks` periodograms of n samples padded with zeros to 2 n, shape
            (..., 2 n), positive; the first and the last bin are neighbours.
        looks: Number of periodograms, 1 or more, shape (...,).

    Returns:
        The smoothed power, same shape.

    Reference:
        Coifman and Donoho, Translation-invariant de-noising, 1995.
    """
    mean, scatter, details = torch.log(power), looks.rsqrt()[..., None], []
    for level in range(int(math.log2(power.shape[-1])) - 1):
        shifted = mean.roll(2**level, -1)
        detail = (mean - shifted) / 2
        # neighbouring bins of the padded transform are not independent: two count as one
        std = scatter / math.sqrt(2 * max(1.0, 2 ** (level - 1)))
        # among thousands of details about one exceeds 3.3 by chance
        details.append(torch.where(detail.abs() > 3.3 * std, detail, 0))
        mean = (mean + shifted) / 2
    for level, detail in reversed(list(enumerate(details))):
        mean = (mean + detail + (mean - detail).roll(-(2**level), -1)) / 2
    return torch.exp(mean)


def windowed_spectrum(power: Tensor, looks: Tensor) -> Tensor:
    """Smooth a mean periodogram by a Hann window of 9 bins, for phases that are still far off.

    Args:
        power: Mean power, shape (trial, bin); the first and the last bin are neighbours.
        looks: Not used, see `smoothed_spectrum`.

    Returns:
        The smoothed power, same shape.
    """
    window = torch.hann_window(11, periodic=False, dtype=power.dtype, device=power.device)[1:-1]
    padded = torch.nn.functional.pad(power[:, None], (4, 4), mode="circular")
    return torch.nn.functional.conv1d(padded, (window / window.sum())[None, None])[:, 0]
