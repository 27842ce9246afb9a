"""Assessment of the estimators of receiver damage: standard deviations and outcomes.

Every function here takes what an estimator has found, and returns the fields `std`, `quality` and
`outcome` of its `Estimate`. The questions are the same for all of them: Is there anything beyond
noise? Do the data determine the values? Is the predicted deviation small enough for use? Where the
deviation does not follow from a model of the noise, the data are divided into parts that are left
out in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Outcome, worst
from torchsar.repair.jitter import uncrossed

# Largest standard deviations of good estimates.
# _MOST_IMBALANCE: of a phase in rad and of a relative gain. The remaining imbalance is 20 dB below
# the signal.
# _MOST_OFFSET: of an offset of sampling instants in samples. The remaining error is at -24 dB.
# _MOST_RESPONSE: of a phase response in rad. The remaining error is at -18 dB.
_MOST_IMBALANCE, _MOST_OFFSET, _MOST_RESPONSE = 0.1, 0.01, 0.125
# Largest Cramer-Rao bound in rad with which the search for a phase response finds the right
# minimum, by measurement: results were wrong from 0.09 on.
_MOST_BOUND = 0.08


def root(square: Tensor) -> Tensor:
    """Return the square root, with a gradient of zero at zero.

    Args:
        square: Any shape, 0 or more.

    Returns:
        Square roots, same shape.
    """
    return torch.where(square > 0, square.clamp_min(torch.finfo(square.dtype).tiny).sqrt(), 0)


def left_out_deviation(values: Tensor) -> Tensor:
    """Return the standard deviation of an estimate from those without one part of the data.

    Of two parts, it is half the difference of their estimates.

    Args:
        values: Estimates without each part in turn, shape (..., part, n).

    Returns:
        Standard deviation, shape (..., n).
    """
    parts = values.shape[-2]
    return root((values - values.mean(-2, keepdim=True)).square().sum(-2) * ((parts - 1) / parts))


def assess_imbalance(
    gain: Tensor,
    lag: Tensor,
    power: Tensor,
    noise: Tensor,
    left_out: tuple[Tensor, Tensor],
    looks: tuple[float, float],
    still: Tensor,
) -> dict[str, Any]:
    """Assess gains and phases of channels.

    Args:
        gain: Gains, shape (..., channel).
        lag: Mean product of each line with the line before over the mean power of the lines, shape
            (..., channel), complex.
        power: Mean power of the lines, shape (...,).
        noise: Noise power of each channel, 0 where it is not known, shape (..., channel).
        left_out: Gains and phases without one block of lines, shape (..., block, channel) each.
        looks: Samples of a channel, and samples over which its noise is averaged.
        still: Share of the power that constants of the channels hold, shape (...,).

    Returns:
        Fields of an Estimate: NOISE where the coherence of neighbouring lines may be due to chance,
        or a phase is that of noise. SINGULAR where a channel has no power. EMPTY for zeros. AT_REST
        where constants change the values. TOO_FEW with fewer than 8 blocks of lines. INEXACT where
        a deviation exceeds 0.1.
    """
    product = gain * torch.roll(gain, 1, -1) / gain.square().mean(-1, keepdim=True)
    coherence = (lag.abs() / product.clamp_min(1e-300)).mean(-1).clamp(0, 1)
    gain_std, phase_std = (left_out_deviation(values) for values in left_out)
    share = (noise / power[..., None].clamp_min(1e-300)).clamp_max(0.99)
    # An error of the noise level changes the ratios of the powers of the channels. It is assumed to
    # be three standard deviations of that level, or 3 % of the power if the level is not known.
    bias = torch.where(share > 0, 3 / math.sqrt(looks[1]) * share / (1 - share), 0.03)
    gain_std = root(gain_std.square() + (gain * torch.log(gain) * bias).square())
    # Limits by choice: a phase with a standard deviation above 0.25 rad may be that of noise. If
    # the noise is not known, the coherence must exceed 0.2.
    chance = (coherence < 5 / math.sqrt(looks[0])) | (phase_std > 0.25).any(-1)
    known = (share > 0).all(-1) | (coherence > 0.2)
    inexact = (phase_std > _MOST_IMBALANCE) | (gain_std > _MOST_IMBALANCE * gain)
    outcome = worst(
        (Outcome.INEXACT, inexact.any(-1)),
        (Outcome.TOO_FEW, torch.full_like(known, left_out[0].shape[-2] < 8)),
        # half of the deviation that is inexact
        (Outcome.AT_REST, still > _MOST_IMBALANCE / 2),
        (Outcome.NOISE, ~known | chance),
        (Outcome.SINGULAR, ((gain < 1e-3) | (gain > 1e3)).any(-1)),
        (Outcome.EMPTY, power == 0),
    )
    # constants were seen to change both by up to half of their share
    own = still[..., None] / 2
    std = {"gain": torch.hypot(gain_std, gain * own), "phase_rad": torch.hypot(phase_std, own)}
    return {"std": std, "quality": coherence, "outcome": outcome}


def of_trials(fields: dict[str, Any], trials: torch.Size) -> dict[str, Any]:
    """Return fields of an Estimate of trials in a row with the trial dimensions of the data.

    Args:
        fields: Fields `std`, `quality` and `outcome`, whose tensors begin with one dimension.
        trials: Trial dimensions; may be empty.

    Returns:
        The same fields with other shapes.
    """
    std = {name: value.reshape(*trials, *value.shape[1:]) for name, value in fields["std"].items()}
    return {"std": std, **{name: fields[name].reshape(trials) for name in ("quality", "outcome")}}


def assess_offsets(
    offsets: Tensor,
    std: Tensor,
    tested: Tensor,
    found: Tensor,
    lit: Tensor,
    quality: Tensor,
    most_rms: float = math.inf,
) -> dict[str, Any]:
    """Assess timing offsets.

    Args:
        offsets: Timing offsets in samples, shape (..., M).
        std: Their standard deviations, same shape.
        tested: Deviation of the offsets of the longest period tested, shape (...,).
        found: Whether there is a signal beyond noise, shape (...,), bool.
        lit: Whether there are samples that are finite and not zero, shape (...,), bool.
        quality: Quality 0..1, shape (...,).
        most_rms: Largest rms offset to which the method leads, in samples.

    Returns:
        Fields of an Estimate: EMPTY without samples, SINGULAR where sample instants would coincide
        or cross, NOISE without a signal, MISFIT where the offsets are too large for the method,
        INEXACT where a deviation is 0.01 samples or more.
    """
    outcome = worst(
        (Outcome.INEXACT, ~((std < _MOST_OFFSET).all(-1) & (tested < _MOST_OFFSET))),
        (Outcome.MISFIT, offsets.square().mean(-1).sqrt() >= most_rms),
        (Outcome.NOISE, ~found),
        (Outcome.EMPTY, ~lit),
        (Outcome.SINGULAR, lit & found & (uncrossed(offsets) != offsets).any(-1)),
    )
    std = torch.where((outcome >= Outcome.NOISE)[..., None], 0, std)
    return {"std": {"offset_samples": std}, "quality": quality, "outcome": outcome}


def assess_lines(lines: Tensor, lost: Tensor, reach: int = 8) -> dict[str, Any]:
    """Assess lines that are corrected for interference.

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        lost: Lines that were given up, shape (..., pulse), bool.
        reach: Number of lines on either side with which the power of a line is compared.

    Returns:
        Fields of an Estimate: EMPTY for zeros, MISFIT where lines that stand out among their
        neighbours hold more power than the rest, TOO_FEW where less than half of the lines remain.
    """
    power = lines.abs().to(torch.float64).square().mean(-1)
    row = torch.arange(power.shape[-1], device=power.device)
    near = (row[:, None] + torch.arange(-reach, reach + 1, device=power.device)).clamp(0, power.shape[-1] - 1)
    usual = torch.where(power > 0, power, torch.nan)[..., near].nanmedian(-1).values.nan_to_num(0)
    excess = torch.where(power > 4 * usual, power - usual, 0)
    quality = 1 - lost.to(torch.float64).mean(-1)
    outcome = worst(
        (Outcome.MISFIT, excess.sum(-1) > (power - excess).sum(-1)),
        (Outcome.TOO_FEW, quality < 0.5),
        (Outcome.EMPTY, (power == 0).all(-1) & ~lost.any(-1)),
    )
    return {"quality": quality, "outcome": outcome}


def assess_response(
    found: Tensor, degrees: int, slope: Callable[[Tensor], Tensor], bound: Tensor, sided: Tensor, phase_rad: Tensor
) -> dict[str, Any]:
    """Assess a phase response.

    The deviation has two parts. One is half the difference of the phases from two halves of the
    points. The other is the phase that finer degrees would add in both halves: one step of descent,
    whose length is the slope over the curvature.

    Args:
        found: Coefficients in rad of the first halves, then of the second ones, shape (2 trial, p).
        degrees: Number of all degrees, those of the fit and finer ones.
        slope: Function of coefficients, shape (2 trial, degrees), that gives the slope of the
            entropy along the finer degrees, shape (2 trial, degrees - p).
        bound: Cramer-Rao bound in rad, shape (trial,).
        sided: Whether both halves have a point, shape (trial,), bool.
        phase_rad: Phase response, shape (trial, n).

    Returns:
        Fields of an Estimate: NOISE where the bound is so large that the search may end in a wrong
        minimum. TOO_FEW where a half has no point. MISFIT where finer degrees are left. INEXACT
        where the deviation is 0.125 rad or more.
    """
    here = torch.nn.functional.pad(found, (0, degrees - found.shape[-1]))
    first, second = slope(here).chunk(2)
    both = first + second
    step = 0.05 * both / torch.linalg.vector_norm(both, dim=-1, keepdim=True).clamp_min(1e-300)
    moved = torch.cat([found, step.repeat(2, 1)], -1)
    change = sum(slope(moved).chunk(2)) - both
    curvature = (change / 2 * step).sum(-1) / step.square().sum(-1).clamp_min(1e-300)
    # least curvature in nats per rad^2, by measurement; it was 5 to 20 in sharp windows
    finer = (first * second).sum(-1).clamp_min(0).sqrt() / curvature.clamp_min(4)
    apart = left_out_deviation(torch.stack(found.chunk(2), -2))
    std = torch.hypot(torch.linalg.vector_norm(apart, dim=-1), finer).maximum(bound)
    outcome = worst(
        (Outcome.INEXACT, ~(std < _MOST_RESPONSE)),
        (Outcome.MISFIT, finer >= _MOST_RESPONSE),
        (Outcome.TOO_FEW, ~sided),
        (Outcome.NOISE, ~(bound < _MOST_BOUND)),
    )
    std = torch.where(torch.isfinite(std) & sided & (bound < _MOST_BOUND), std, math.pi)[:, None].expand_as(phase_rad)
    return {"std": {"phase_rad": std}, "quality": 1 / (1 + std[:, 0].square()), "outcome": outcome}


def assess_trigger(
    order: Tensor, fringe: Tensor, symmetry: Tensor, share: Tensor, outside: Tensor, quality: Tensor
) -> dict[str, Any]:
    """Assess the start of triangular sweeps.

    Args:
        order: Certainty of the order of up and down sweeps in standard deviations, shape (...,).
        fringe: Certainty of the fringe in standard deviations, shape (...,).
        symmetry: Symmetry 0..1 of the record about the turning points, shape (...,).
        share: Share of the scene in the power of the record, shape (...,).
        outside: Whether no whole period fits its block, shape (...,), bool.
        quality: Quality 0..1, shape (...,).

    Returns:
        Fields of an Estimate: NOISE where no scene rises above the noise, OUTSIDE_SEARCH where no
        period fits, AMBIGUOUS for an uncertain order or fringe, MISFIT where the record is not
        symmetric.
    """
    outcome = worst(
        # measured on scenes of 1 to 40 scatterers: above 0.7 in 97 % of the correct results, below
        # 0.66 in wrong ones
        (Outcome.MISFIT, ~(symmetry > 0.7 * share)),
        # a normal distribution exceeds 5 with probability 3e-7, and 3 with 1e-3
        (Outcome.AMBIGUOUS, ~((order > 5) & (fringe > 3))),
        (Outcome.OUTSIDE_SEARCH, outside),
        # white noise has a share of 0.02 by chance
        (Outcome.NOISE, ~(share > 0.05)),
    )
    return {"quality": quality.clamp(0, 1), "outcome": outcome}
