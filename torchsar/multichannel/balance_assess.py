"""Assessment of channel weights that are fitted to stationary clutter: deviations and outcome.

The model of the clutter has errors: its power over Doppler and over range is not the expected one,
or a few points dominate. The deviations therefore follow from the data. The gradient of the
likelihood is a sum over range cells, whose clutter and noise are independent of each other. Its
scatter over blocks of cells gives its covariance, and with the Hessian that of the unknowns. What
leaks coherently into all channels leaves the gradient of each cell at zero and does not count as
noise.

Reference:
    White 1982 (covariance of a maximum-likelihood estimate whose model has errors).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Outcome, matrix_inverse, worst
from torchsar.multichannel.clutter_fit import ClutterModel, Fit


def assessed_balance(
    lines: Tensor,
    weight: Tensor,
    model: ClutterModel,
    fit: Fit,
    snr_db: Tensor,
    position: Tensor | None,
    reference: int,
    no_power: Tensor,
    lead: Tensor | None,
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor, Tensor]:
    """Return standard deviations of phases, logarithms of gains and turns, quality and outcome.

    Args:
        lines: Balanced spectra, complex128 (..., channel, bin, range frequency).
        weight: Weights of the range cells, of mean 1, zero where a cell is left out, (..., cell).
        model: Model of the clutter.
        fit: Fit of the weights of the channels.
        snr_db: SNR of the model, (...,).
        position: Places of the range frequencies in the band, -1 to 1; None without turns.
        reference: Index of the reference channel.
        no_power: Where a channel has no power, bool (...,).
        lead: Lead of the first fit per look, see `ClutterModel.lead`; None where the clutter cannot
            lie in other Doppler bands.

    Returns:
        Deviations, float64 (..., channel) each; quality of 0 to 1 and codes of the outcome, (...,).
        Those of gains contain the difference that remains between the powers of the balanced
        channels, as with a wrong prior.
    """
    inverse, channels = matrix_inverse(model.noisy(snr_db)), lines.shape[-3]
    inner = (inverse @ lines.movedim(-3, -2)).movedim(-2, -3)
    cells, within = (torch.fft.ifft(x, norm="ortho") for x in (lines, inner))
    along, over_bins = _covariance(_score(cells, within, -2, weight)), _covariance(_score(lines, inner, -1), 16)
    hessian, determined = _inverse(fit.hessian, reference, channels)

    def std(covariance: Tensor, rows: Tensor, unknown: float = 1e3) -> Tensor:
        """Standard deviations in rad or neper; 1e3 for what is not determined."""
        variance = ((rows @ covariance) * rows).sum(-1).clamp_min(0)
        return torch.where(determined[..., None], variance.sqrt(), unknown).clamp_max(unknown)

    rows = hessian[..., : 2 * channels, : 2 * channels].clone()
    rows[..., :channels, :] -= rows[..., reference, None, :].clone()
    log_std, phase_std = std(along, rows).unflatten(-1, (2, -1)).unbind(-2)
    turn_std, tiny = torch.zeros_like(phase_std), torch.finfo(torch.float64).tiny
    if position is not None:
        turning = torch.cat([_score(lines, inner, -2), position * (lines.conj() * inner).mean(-2).imag], -2)
        turn_std = std(_covariance(turning), hessian[..., 2 * channels :, :])
    misfit = std(over_bins, rows).square().sum(-1) / std(along, rows).square().sum(-1).clamp_min(tiny)
    noise = weight * 10 ** (-snr_db[..., None] / 10)
    share = _blocks((cells.abs().square().mean((-3, -2)) - noise).clamp_min(0))
    share = share / share.sum(-1, keepdim=True).clamp_min(tiny)
    # Balanced channels have equal power, but with a wrong prior other gains are more likely. By
    # choice, the prior counts as wrong where the powers differ by four times as much as by chance.
    # Hann weights leave 18 / 35 independent looks per pulse: (mean square)^2 / mean fourth power.
    looks = (weight > 0).sum(-1, keepdim=True) * (lines.shape[-2] * 18 / 35)
    level = lines.abs().square().mean((-2, -1))
    uneven = torch.log((level / level[..., reference, None].clamp_min(1e-300)).clamp_min(1e-3)).abs() / 2
    chance = model.chance(snr_db, reference, looks) / 2
    log_std = torch.where(uneven > 4.0 * chance, torch.hypot(log_std, uneven), log_std)
    # A linear phase error of 0.1 rad, three times the first limit, already causes false targets of
    # about -20 dB when three bands are reconstructed at a PRF of 180 Hz. So do errors of amplitude.
    # Phases due to delays, here their rms over the range band, weigh less, because their mean is
    # zero.
    largest, across = torch.maximum(phase_std, log_std).amax(-1), turn_std.amax(-1) / math.sqrt(3)
    relative = torch.maximum(largest / 0.033, across / 0.1)
    # Limits by choice.
    # MISFIT: the ratio of the deviations by the scatter of Doppler bins and of range cells is at
    # most 1.8 where the prior suits.
    # AMBIGUOUS: the log likelihood ratio to clutter displaced by whole bands must exceed 100.
    # TOO_FEW: a point that holds 58 % of the power leaves 3 effective parts of the 32 of the swath.
    # NOISE: the standard deviation of a phase is at most 0.25 rad.
    outcome = worst(
        (Outcome.INEXACT, ~(relative < 1)),
        (Outcome.MISFIT, misfit.sqrt() >= 2.5),
        (Outcome.AMBIGUOUS, no_power if lead is None else lead * looks[..., 0] <= 100.0),
        (Outcome.TOO_FEW, share.square().sum(-1) * 3.0 >= 1),
        (Outcome.NOISE, phase_std.amax(-1) > 0.25),
        (Outcome.EMPTY, no_power),
        (Outcome.SINGULAR, ~determined & ~no_power),
    )
    return (phase_std, log_std, turn_std), (1 - relative).clamp(0, 1), outcome


def _score(lines: Tensor, inner: Tensor, dim: int, weight: Tensor | float = 1.0) -> Tensor:
    """Return the mean gradient over `dim` with respect to logarithms and phases, (..., 2 channel,
    n).

    Args:
        lines: Balanced lines, (..., channel, bin, cell).
        inner: Lines times the inverse of the model.
        dim: Dimension of bins or of cells.
        weight: Expected power of the lines relative to that of the model, (..., n).
    """
    product = (lines.conj() * inner).mean(dim)
    expected = weight[..., None, :] if isinstance(weight, Tensor) else weight
    return torch.cat([product.real - expected, product.imag], -2)


def _blocks(values: Tensor, blocks: int = 32) -> Tensor:
    """Add neighbouring values along the last dimension to at most this number of blocks.

    By choice there are 32 blocks of range cells or frequencies, which give a standard deviation to
    13 %.
    """
    count, blocks = values.shape[-1], min(blocks, values.shape[-1])
    at = torch.arange(count, device=values.device) * blocks // count
    total = torch.zeros(*values.shape[:-1], blocks, dtype=values.dtype, device=values.device)
    return total.index_add(-1, at, values)


def _covariance(score: Tensor, blocks: int = 32) -> Tensor:
    """Return the covariance (..., n, n) of the mean of scores (..., n, cell) from their blocks."""
    total = _blocks(score, blocks) / score.shape[-1]
    count = total.shape[-1]
    return total @ total.mT * (count / max(1, count - 1))


def _inverse(hessian: Tensor, reference: int, channels: int, least: float = 1e-10) -> tuple[Tensor, Tensor]:
    """Inverse of a Hessian, and whether it is that of a minimum, (...,).

    The phase and the phase slope over the band that all channels have in common are not determined,
    so those of the reference are zero. A combination of unknowns with a curvature below `least`,
    per look, is not determined either.
    """
    kept = [i for i in range(hessian.shape[-1]) if i < channels or (i - reference) % channels]
    free = torch.tensor(kept, device=hessian.device)
    values, vectors = torch.linalg.eigh(hessian[..., free[:, None], free])
    inverse = torch.zeros_like(hessian)
    inverse[..., free[:, None], free] = (vectors / values.clamp_min(least)[..., None, :]) @ vectors.mT
    return inverse, values[..., 0] > least
