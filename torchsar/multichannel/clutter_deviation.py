"""Standard deviations of the channel weights that are fitted to stationary clutter.

The model of the clutter errs: its power over Doppler and over range is not the expected one, or a
few points make it up. The deviations therefore follow from the data. The gradient of the likelihood
is a sum over range cells, whose clutter and noise are independent of each other: their scatter
gives its covariance, and with the Hessian that of the unknowns. What leaks coherently into all
channels leaves the gradient of each cell at zero and does not count as noise.

Reference:
    White 1982 (covariance of a maximum-likelihood estimate whose model errs); MacKinnon and White
    1985 (correction for the share of an observation in the fit).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.core import matrix_inverse
from torchsar.multichannel.clutter_fit import HANN_LOOKS, Fit

# Blocks of range cells and of Doppler bins, by choice: 32 give a standard deviation to 13 %.
_CELL_BLOCKS, _BIN_BLOCKS = 32, 16
# Blocks that the covariance predicted by the model counts as, beside the measured one, by choice.
_EXPECTED = 2.0
# Curvature below which a combination of unknowns is not determined, per look.
_LEAST_CURVED = 1e-10
# Standard deviation in rad or neper of what is not determined.
_UNKNOWN = 1e3
_TINY = torch.finfo(torch.float64).tiny
# Standard deviation of the logarithm of the noise power where it is not determined: 9 dB.
_NOISE_STD = 2.0


class Deviations(NamedTuple):
    """Standard deviations of a fit, float64 (..., channel).

    Args:
        log_gain: Of the logarithms of the weights.
        phase: Of their phases in radians.
        turn: Of their turns in radians.
        misfit: Ratio of the deviations that follow from the scatter of the Doppler bins to those
            above, (...,): about 1, and larger where the prior does not describe the clutter.
        parts: Number of blocks of range cells, of at most 32, that hold the power above the noise,
            (...,).
    """

    log_gain: Tensor
    phase: Tensor
    turn: Tensor
    misfit: Tensor
    parts: Tensor


def deviations(
    lines: Tensor, model: Tensor, noise: Tensor, fit: Fit, position: Tensor | None, reference: int
) -> Deviations:
    """Return standard deviations of a fit relative to the reference channel.

    Where few cells hold the power, the covariance that the model predicts counts more. The gradient
    by the turns is taken as a sum over range frequencies.

    Args:
        lines: Spectra with the weights of the fit, complex128 (..., channel, bin, range frequency).
        model: Covariance of the model, (..., bin, channel, channel).
        noise: Noise power of the model, (...,).
        fit: Minimum, without turns in the lines.
        position: Places of the range frequencies in the band, -1 to 1; None without turns.
        reference: Index of the reference channel.

    Returns:
        The standard deviations.
    """
    channels, bins, count = lines.shape[-3:]
    inverse = matrix_inverse(model)
    inner = _through(inverse, lines)
    twice = _through(inverse, inner)
    trace = noise[..., None] * inverse.diagonal(dim1=-2, dim2=-1).real.sum(-1) / 2
    cells, within = torch.fft.ifft(lines, norm="ortho"), torch.fft.ifft(inner, norm="ortho")
    by_cell, by_bin = _scores(cells, within, trace.mean(-1, True), noise, -2), _scores(lines, inner, trace, noise, -1)
    # second derivatives by the noise
    mixed = -noise[..., None, None] * (lines.conj() * twice).mean(-2)
    cross = [mixed.real.mean(-1), mixed.imag.mean(-1)]
    if position is not None:
        cross.append((position * mixed.imag).mean(-1))
    bend = (inner.conj() * twice).real.sum(-3).mean((-2, -1)) - inverse.abs().square().sum((-2, -1)).mean(-1) / 2
    side, corner = torch.cat(cross, -1), noise.square() * bend + by_bin[..., 0, :].mean(-1)

    looks, still = count * bins * HANN_LOOKS, 1 + 2 * channels
    inverse, determined = _inverse(fit.hessian, reference, channels)
    # the noise changes the other unknowns by -follow
    follow = (inverse @ side[..., None])[..., 0]
    shared = (side * follow).sum(-1)
    own = (corner - shared).clamp_min(1 / (2 * looks * _NOISE_STD**2))
    expected = _bordered(fit.hessian, side, own + shared) / (2 * looks)
    by_noise = torch.cat([torch.ones_like(own)[..., None], -follow], -1) / own[..., None]
    inverse = torch.nn.functional.pad(inverse, (1, 0)) - follow[..., :, None] * by_noise[..., None, :]

    def std(scatter: Tensor) -> Tensor:
        relative = inverse[..., :channels, :] - inverse[..., reference, None, :]
        relative = torch.cat([relative, inverse[..., channels:, :]], -2)
        variance = ((relative @ scatter) * relative).sum(-1)
        found = torch.where(determined[..., None], variance.clamp_min(0).sqrt(), _UNKNOWN).clamp_max(_UNKNOWN)
        return found.unflatten(-1, (-1, channels))

    share = _share((cells.abs().square().mean((-3, -2)) - noise[..., None]).clamp_min(0))
    scatter, between = torch.zeros_like(expected), torch.zeros_like(expected)
    scatter[..., :still, :still] = _scatter(by_cell, share, expected[..., :still, :still])
    between[..., :still, :still] = _between(by_bin)
    if position is not None:
        turning = position * (lines.conj() * inner).mean(-2).imag
        equal = _share(torch.ones_like(turning[..., 0, :]))
        scatter[..., still:, still:] = _scatter(turning, equal, expected[..., still:, still:])
    found = std(scatter)
    ratio = std(between)[..., :2, :].square().sum(-1) / found[..., :2, :].square().sum(-1).clamp_min(_TINY)
    turn = found[..., 2, :] if position is not None else torch.zeros_like(found[..., 0, :])
    return Deviations(found[..., 0, :], found[..., 1, :], turn, ratio.amax(-1).sqrt(), _parts(share))


def _scores(lines: Tensor, inner: Tensor, trace: Tensor, noise: Tensor, dim: int) -> Tensor:
    """Return the gradient by the noise, the logarithms and the phases, (..., 1 + 2 channel, n).

    Args:
        lines: Balanced lines, (..., channel, bin, cell).
        inner: Lines times the inverse of the model.
        trace: Half the noise times the trace of the inverse, (..., n or 1).
        noise: Noise power of the model, (...,).
        dim: Dimension over which the gradients are averaged, bins or cells.
    """
    product = (lines.conj() * inner).mean(dim)
    spent = noise[..., None] * inner.abs().square().sum(-3).mean(dim) / 2
    return torch.cat([(trace - spent)[..., None, :], product.real - 1, product.imag], -2)


def _through(matrix: Tensor, lines: Tensor) -> Tensor:
    """Multiply the channels of lines (..., channel, bin, frequency) by a matrix of each bin."""
    return (matrix @ lines.movedim(-3, -2)).movedim(-2, -3)


def _bordered(matrix: Tensor, side: Tensor, corner: Tensor) -> Tensor:
    """Put a row, its column and their common element before a matrix."""
    top = torch.cat([corner[..., None], side], -1)[..., None, :]
    return torch.cat([top, torch.cat([side[..., None], matrix], -1)], -2)


def _blocks(values: Tensor, blocks: int) -> Tensor:
    """Add neighbouring values along the last dimension to at most this number of blocks."""
    count = values.shape[-1]
    at = torch.arange(count, device=values.device) * min(blocks, count) // count
    total = torch.zeros(*values.shape[:-1], min(blocks, count), dtype=values.dtype, device=values.device)
    return total.index_add(-1, at, values)


def _share(power: Tensor) -> Tensor:
    """Return the share of each block in the power of cells, (..., cell) -> (..., block)."""
    total = _blocks(power, _CELL_BLOCKS)
    return total / total.sum(-1, keepdim=True).clamp_min(_TINY)


def _parts(share: Tensor) -> Tensor:
    """Return the number of blocks that hold the power, from 1 to their number."""
    return 1 / share.square().sum(-1).clamp(1 / share.shape[-1], 1)


def _between(score: Tensor) -> Tensor:
    """Return the covariance (..., n, n) of the mean of scores (..., n, bin) from blocks of bins."""
    total = _blocks(score, _BIN_BLOCKS) / score.shape[-1]
    return total @ total.mT * (total.shape[-1] / max(1, total.shape[-1] - 1))


def _scatter(score: Tensor, share: Tensor, expected: Tensor) -> Tensor:
    """Return the covariance (..., n, n) of the mean of independent scores (..., n, cell).

    Args:
        score: Gradients of the cells at the minimum.
        share: Share of the power above the noise in each block of cells, (..., block).
        expected: Covariance that the model predicts.
    """
    # the fit adapts to a block by its share of the power
    left = _blocks(score, _CELL_BLOCKS) / score.shape[-1] * (1 - share).clamp_min(0.1).rsqrt()[..., None, :]
    free = (_parts(share) - 1)[..., None, None]
    return (free * (left @ left.mT) + _EXPECTED * expected) / (free + _EXPECTED)


def _inverse(hessian: Tensor, reference: int, channels: int) -> tuple[Tensor, Tensor]:
    """Return the inverse of a Hessian, and whether it is that of a minimum, (...,).

    Phase and turn of all channels together are not determined: those of the reference are zero.
    """
    kept = [i for i in range(hessian.shape[-1]) if i < channels or (i - reference) % channels]
    free = torch.tensor(kept, device=hessian.device)
    values, vectors = torch.linalg.eigh(hessian[..., free[:, None], free])
    inverse = torch.zeros_like(hessian)
    inverse[..., free[:, None], free] = (vectors / values.clamp_min(_LEAST_CURVED)[..., None, :]) @ vectors.mT
    return inverse, values[..., 0] > _LEAST_CURVED
