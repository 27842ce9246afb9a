"""Assessment of a velocity of least entropy: its standard deviation, quality and outcome.

Is the minimum deeper than one that noise makes? Does it lie inside the search? Is the record long
enough for whole apertures? How much do the velocities differ that parts of the image give?
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.group import RangeGroup, block_entropy, quotient
from torchsar.core import Estimate, Outcome, fft_lines, host_value, worst


def assessed(
    found: Estimate,
    group: RangeGroup,
    nominal: Tensor,
    minimum: tuple[Callable[[Tensor], Tensor], Tensor, Tensor, float],
    rows: Sequence[Tensor],
    half_m_s: Tensor,
    slope: Tensor,
    curvature: Tensor,
) -> Estimate:
    """Assess a velocity of least entropy.

    The standard deviation has three parts. The first follows from the parts of the image, which are
    blocks of range cells times eight parts along azimuth. The slopes of their entropies at the
    minimum are divided by the curvature of the whole entropy. The second follows in the same way
    from four interleaved sets of Doppler rows, whose noise is independent also where one target
    dominates. The larger of both is used. The third is the error that remains without noise.

    Args:
        found: The estimate.
        group: Group of range cells.
        nominal: Its image of the nominal velocity.
        minimum: Entropy of the image as a function of the velocity (...,); weights of the blocks,
            (..., block); whether the best velocity of the first grid is not at an end, (...,); and
            the step of the grid, see `grid_step_m_s`.
        rows: Range-Doppler spectra of images a little below, at and above the velocity.
        half_m_s: Distance of the outer ones, (...,): a tenth of the step or, where the dwell of the
            beam is not known, a twentieth of a distance that exceeds the width of the minimum.
        slope: Slopes of the summands of the entropy over the velocity, (..., block, part).
        curvature: Curvature of the entropy, (...,).

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    radar, (objective, weight, inside, step) = group.radar, minimum

    def entropy(rows: Tensor) -> Tensor:
        return (block_entropy(fft_lines(rows, inverse=True)) * weight).sum(-1)

    def measured(distance: Tensor) -> tuple[Tensor, Tensor]:
        sides = [objective(found["velocity_m_s"] + side * distance) for side in (-1, 1)]
        beside = 0.5 * (sides[0] + sides[1]) - entropy(rows[1])
        return beside, quotient(2 * beside.clamp_min(0), curvature).sqrt()

    # Depth of the minimum in nats, and its width, that of a parabola of this depth and curvature.
    # The depth is measured two steps of the grid away, or eight if the minimum is that wide,
    # because the targets are illuminated for a short time.
    known = radar.integration_s
    near = 20 * half_m_s if known is None else torch.full_like(half_m_s, 2 * min(step, radar.velocity_m_s / 18))
    depth, width = measured(near)
    wide = width > near / 2
    if host_value(wide.any(), True):
        depth, width = (torch.where(wide, x, y) for x, y in zip(measured(4 * near), (depth, width), strict=True))
    by_parts = quotient(slope.flatten(-2).square().sum(-1).sqrt(), curvature)
    # Without noise, an error remains, because the spectrum of a short chirp is not that of the
    # stationary phase. It is a share of width^2 / velocity, or of the same with the step of the
    # grid as the width, measured at time-bandwidth products of 19 to 374.
    rest = (0.45 * width.square()).clamp_min(0.11 * step**2) / radar.velocity_m_s
    sets = [torch.stack([entropy(one[..., k::4, :]) for k in range(4)], -1) for one in rows]
    bend = (sets[0] - 2 * sets[1] + sets[2]).mean(-1) / half_m_s.square()
    by_combs = quotient(((sets[2] - sets[0]) / (2 * half_m_s[..., None])).std(-1) / 2, bend)
    std = torch.hypot(torch.maximum(by_parts, by_combs), rest)
    # velocity error of an eighth of a cycle of phase at the ends of the aperture
    most = 0.27 * width if known is None else torch.full_like(width, step / 8)
    short = known is not None and group.data.shape[-2] < known * radar.prf_hz
    outcome = worst(
        (Outcome.INEXACT, std >= most),
        (Outcome.MISFIT, torch.full_like(inside, short)),
        (Outcome.OUTSIDE_SEARCH, ~inside),
        # The depth of the minimum is given in standard deviations. It is below 5 in noise and in
        # clutter that fills the Doppler band evenly, and above 100 at 20 dB above the noise.
        (Outcome.NOISE, ~((curvature > 0) & (depth > 8.0 * _noise_std(nominal, weight)))),
        (Outcome.EMPTY, (group.data == 0).all((-2, -1))),
    )
    quality = torch.exp(-std / most.clamp_min(1e-12)).nan_to_num(0.0)
    return replace(found, std={"velocity_m_s": std}, quality=quality, outcome=outcome)


def _noise_std(image: Tensor, weight: Tensor) -> Tensor:
    """Standard deviation (...,) in nats of the weighted entropy of an image (..., azimuth, range)
    of noise.

    The noise has the powers and the correlations of the range cells of the given image. Cells of
    equal power without correlation have the variance 0.29 / number of pixels, by the exponential
    distribution of their intensity. In general, the squared elements of the covariance between
    cells take the place of 1 / number of cells.
    """
    n, parts = image.shape[-2], image.tensor_split(weight.shape[-1], -1)
    norms = [torch.linalg.vector_norm(part, dim=(-2, -1)).clamp_min(1e-30) for part in parts]
    scale = weight.sqrt() / torch.stack(norms, -1)
    scaled = [part * share[..., None, None] for part, share in zip(parts, scale.to(norms[0]).unbind(-1), strict=True)]
    lines = torch.cat(scaled, -1)
    squares = torch.linalg.vector_norm(lines.mH @ lines, dim=(-2, -1)).square().to(torch.float64)
    # the contribution of independent cells, due to the finite number of pixels, is subtracted
    return (0.29 / n * (squares - 1 / n).clamp_min(1 / image.shape[-1])).sqrt()
