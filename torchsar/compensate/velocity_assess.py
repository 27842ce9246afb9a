"""Whether a velocity of least entropy can be trusted: standard deviation, quality and outcome.

Is the minimum deeper than noise makes one? Does it lie inside the search? Is the record long enough
for whole apertures? How far do parts of the image disagree about it?
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchsar.compensate.group import RangeGroup, block_entropy, quotient
from torchsar.core import Estimate, Outcome, fft_lines, host_value, worst

if TYPE_CHECKING:
    from torchsar.compensate.velocity import Minimum, Parts

# Variance of the entropy of n independent pixels of pure noise, times n: with the exponential
# distribution of their intensity, 0.290.
_NOISE_ENTROPY = 0.29
# Depth of a significant minimum in standard deviations of noise. On noise and on clutter that fills
# the Doppler band evenly the depth is below 5; 20 dB above the noise it is above 100.
_LEAST_DEPTH = 8.0
# Distances from the minimum at which its depth is measured, in steps of the grid. The second
# counts where the minimum reaches to the first, because the targets are seen for a short time.
_NEAR, _FAR = 2.0, 8.0
# Error that remains without noise: the spectrum of a short chirp is not that of the stationary
# phase. It is a share of width^2 / velocity, or of the same with the step of the grid as the width.
# Measured at time-bandwidth products of 19 to 374.
_REST, _REST_STEP = 0.45, 0.11
# Largest standard deviation of an estimate that is ok, over the width of the minimum: an eighth
# of a cycle of phase at the ends of the aperture.
_MOST_WIDTHS = 0.27
_COMBS = 4  # interleaved sets of Doppler rows, of independent noise


def assessed(found: Estimate, at: Minimum, group: RangeGroup) -> Estimate:
    """Assess a velocity of least entropy.

    The standard deviation has three parts. The first follows from the parts of the image, blocks of
    range cells times eight parts along azimuth: the slopes of their entropies at the minimum,
    divided by the curvature of the whole entropy. The second follows in the same way from four
    interleaved sets of Doppler rows, whose noise is independent also where one target dominates;
    the larger of both counts. The third is what remains without noise.
    """
    radar = group.radar
    depth, width = _depth(at, min(at.step_m_s, radar.velocity_m_s / 18))
    by_parts = quotient(at.slope.flatten(-2).square().sum(-1).sqrt(), at.curvature)
    rest = (_REST * width.square()).clamp_min(_REST_STEP * at.step_m_s**2) / radar.velocity_m_s
    std = torch.hypot(torch.maximum(by_parts, _comb_std(at)), rest).clamp_max(1e6)
    known = radar.integration_s
    most = _MOST_WIDTHS * width if known is None else torch.full_like(width, at.step_m_s / 8)
    short = known is not None and group.data.shape[-2] < known * radar.prf_hz
    outcome = worst(
        (Outcome.INEXACT, std >= most),
        (Outcome.MISFIT, torch.full_like(at.inside, short)),
        (Outcome.OUTSIDE_SEARCH, ~at.inside),
        (Outcome.NOISE, ~((at.curvature > 0) & (depth > _LEAST_DEPTH * _noise_std(at.nominal, at.weight)))),
        (Outcome.EMPTY, (group.data == 0).all((-2, -1))),
    )
    quality = torch.exp(-std / most.clamp_min(1e-12))
    return replace(found, std={"velocity_m_s": std}, quality=quality, outcome=outcome)


def _depth(at: Minimum, step: float) -> tuple[Tensor, Tensor]:
    """Depth of the minimum in nats, and its width in m/s, that of a parabola of this depth and of
    the curvature at the minimum, (...,) each.
    """
    least = (block_entropy(fft_lines(at.beside[1].rows, inverse=True)) * at.weight).sum(-1)

    def measured(distance: float) -> tuple[Tensor, Tensor]:
        sides = [at.objective(at.velocity_m_s + side * distance * step) for side in (-1, 1)]
        beside = 0.5 * (sides[0] + sides[1]) - least
        return beside, quotient(2 * beside.clamp_min(0), at.curvature).sqrt()

    depth, width = measured(_NEAR)
    wide = width > _NEAR * step / 2
    if not host_value(wide.any(), True):
        return depth, width
    far_depth, far_width = measured(_FAR)
    return torch.where(wide, far_depth, depth), torch.where(wide, far_width, width)


def _noise_std(image: Tensor, weight: Tensor) -> Tensor:
    """Standard deviation (...,) in nats of the weighted entropy of an image (..., azimuth, range)
    of noise that has the powers and the correlations of the image's range cells.

    Cells of equal power without correlation have the variance 0.29 / number of pixels. In general,
    the squared elements of the covariance between cells take the place of 1 / number of cells.
    """
    n, parts = image.shape[-2], image.tensor_split(weight.shape[-1], -1)
    norms = [torch.linalg.vector_norm(part, dim=(-2, -1)).clamp_min(1e-30) for part in parts]
    scale = weight.sqrt() / torch.stack(norms, -1)
    scaled = [part * share[..., None, None] for part, share in zip(parts, scale.to(norms[0]).unbind(-1), strict=True)]
    lines = torch.cat(scaled, -1)
    squares = torch.linalg.vector_norm(lines.mH @ lines, dim=(-2, -1)).square().to(torch.float64)
    # less what independent cells contribute because the number of pixels is finite
    return (_NOISE_ENTROPY / n * (squares - 1 / n).clamp_min(1 / image.shape[-1])).sqrt()


def _comb_std(at: Minimum) -> Tensor:
    """Standard deviation (...,) in m/s from the slopes of interleaved sets of Doppler rows."""

    def entropies(parts: Parts) -> Tensor:
        sets = [fft_lines(parts.rows[..., first::_COMBS, :], inverse=True) for first in range(_COMBS)]
        return torch.stack([(block_entropy(one) * at.weight).sum(-1) for one in sets], -1)

    low, middle, high = map(entropies, at.beside)
    curvature = (low - 2 * middle + high).mean(-1) / at.half_m_s**2
    return quotient(((high - low) / (2 * at.half_m_s)).std(-1) / math.sqrt(_COMBS), curvature)
