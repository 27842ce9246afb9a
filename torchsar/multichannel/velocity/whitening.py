"""Whitening of stationary clutter by the covariance of the channels in each Doppler bin.

In each Doppler bin, only a few aliased Doppler bands overlap. In each of these bands the phases of
a stationary scene across the channels are known. The covariance of the clutter across the channels
is therefore of low rank. When the known phase ramp over Doppler has been removed, this covariance
changes slowly from bin to bin. It can then be averaged over neighbouring bins, and over range lines
where there are several.

The phase ramp delays one channel against another by a fraction of a pulse interval, circularly. At
the ends of a record, the clutter of the channels is therefore not related by it. A taper over a few
pulses at either end removes this part, which in clutter of 30 dB dominates the residual after
whitening.

Reference:
    Reed, Mallett and Brennan 1974 (sample covariance).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import cholesky_factor, matrix_inverse
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import checked_channels, shared_response
from torchsar.radar import BistaticRadar


@dataclass(frozen=True)
class Whitening:
    """Matrices that whiten the channels in each Doppler bin of the unitary FFT over pulses.

    The ends of the record are tapered before the FFT.

    Args:
        factor: Matrices W with W R W^H = I for the covariance R of the channels in each bin,
            complex128 (..., bin, channel, channel).
        log_det: Sum of the log determinants of R over all bins, shape (...,).
        coloured: True in trials where R differs from the covariance of white noise, bool (...,).
    """

    factor: Tensor
    log_det: Tensor
    coloured: Tensor

    def at(self, trials: Tensor) -> Whitening:
        """Return the whitening of some trials, which a bool tensor (...,) selects."""
        return Whitening(self.factor[trials], self.log_det[trials], self.coloured[trials])

    def applied(self, data: Tensor) -> Tensor:
        """Return the whitened Doppler spectra of the channels.

        Args:
            data: Channels, shape (..., channel, pulse), or (..., any, channel, pulse) with one more
                dimension than the trials, complex.

        Returns:
            Whitened spectra, same shape with Doppler bins in place of pulses.
        """
        return _mixed(self.factor, _spectrum(data))

    def backed(self, data: Tensor) -> Tensor:
        """Return channels weighted by their inverse covariance in each Doppler bin.

        The correlation of the result with the model of an echo is the matched filter in clutter.

        Args:
            data: As in `applied`.

        Returns:
            Data of the same shape.
        """
        weighted = _mixed(self.factor.mH, self.applied(data))
        return torch.fft.ifft(weighted, norm="ortho") * _taper(weighted)


def _taper(data: Tensor, length: int = 16) -> Tensor:
    """Return weights (pulse,) of pulses (..., pulse) that rise from 0 to 1 at either end.

    The taper takes at most an eighth of the record. With 900 pulses and clutter of 30 dB, errors of
    0.25 m/s become 0.17 m/s with 9 pulses, and 0.16 m/s with 27 to 108.
    """
    n = data.shape[-1]
    inside = torch.arange(n, dtype=torch.float64, device=data.device) + 0.5
    inside = torch.minimum(inside, inside.flip(0)) / max(1, min(length, n // 8))
    return torch.sin(torch.pi / 2 * inside.clamp_max(1.0)).square().to(data.real.dtype)


def _spectrum(data: Tensor) -> Tensor:
    """Return the unitary FFT over the pulses of tapered channels, same shape."""
    return torch.fft.fft(data * _taper(data), norm="ortho")


def _mixed(factor: Tensor, spectrum: Tensor) -> Tensor:
    """Multiply spectra (..., [any,] channel, bin) by matrices (..., bin, channel, channel).

    Sums of products are many times faster than as many small matrix products.
    """
    rows = (factor if spectrum.ndim == factor.ndim - 1 else factor[..., None, :, :, :]).movedim(-3, -1)
    return sum(
        (rows[..., :, i, :] * spectrum[..., i, None, :] for i in range(1, spectrum.shape[-2])),
        rows[..., :, 0, :] * spectrum[..., 0, None, :],
    )


def sample_whitening(data: Tensor, radar: BistaticRadar, samples: int = 60) -> Whitening:
    """Estimate the whitening of the channels in each Doppler bin from the data themselves.

    The covariance of the channels is averaged over neighbouring bins; see `line_whitening`.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        samples: Number of neighbouring bins averaged. With three channels 60 cost 0.15 dB of SNR on
            average; more would average over a wider Doppler interval.

    Returns:
        Whitening of each Doppler bin. Where the covariance shows no more structure than that of
        white noise by chance, the covariance of white noise is used.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite.
    """
    data = checked_channels(data, radar, "sample_whitening")
    return line_whitening(data[..., None, :, :], radar, samples)


def line_whitening(lines: Tensor, radar: BistaticRadar, samples: int = 60) -> Whitening:
    """Estimate the whitening of the channels in each Doppler bin from several range lines.

    The covariance of the channels is averaged over the lines, which should be independent and not
    contain the point to be found, and over neighbouring bins. In trials where the covariance shows
    no more structure than that of white noise by chance, the covariance of white noise is used. A
    trial of zeros gets a noise power of 1.

    Args:
        lines: Range lines, shape (..., line, channel, pulse), complex.
        radar: Radar parameters.
        samples: Number of samples averaged: range lines times neighbouring bins.

    Returns:
        Whitening of each Doppler bin.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite.
    """
    lines = checked_channels(lines, radar, "line_whitening", "line, channel, pulse")
    n, channels, count = lines.shape[-1], lines.shape[-2], lines.shape[-3]
    groups = max(1, n * count // max(samples, 4 * channels))
    groups = min(groups, n)
    group = torch.arange(n, device=lines.device) * groups // n
    rest = PointMotion.of(radar, lines)
    ramp = torch.roll(
        shared_response(radar, rest, n, 2, torch.complex128), -n, -1
    )  # the bins of two bands begin at -n; the roll arranges them like those of an FFT
    flat = _spectrum(lines.to(torch.complex128)) * ramp.conj()
    products = flat[..., :, None, :] * flat.conj()[..., None, :, :]
    total = products.new_zeros(*products.shape[:-1], (n - 1) * groups // n + 1).index_add(-1, group, products).sum(-4)
    size = total.real.new_zeros(total.shape[-1]).index_add(0, group, total.real.new_ones(n)) * count
    covariance = (total / size).movedim(-1, -3)
    eye = torch.eye(channels, dtype=covariance.dtype, device=covariance.device)
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    power = (level * size).sum(-1) / size.sum()
    power = torch.where(power > 0, power, 1.0)
    # the diagonal term keeps the covariance of noise-free data invertible
    loaded = covariance + 1e-6 * power[..., None, None, None] * eye
    log_det = (torch.linalg.slogdet(loaded)[1] * size).sum(-1)
    white = channels * torch.log(power) * size.sum()
    # Clutter is assumed from twice the log-likelihood expected by chance. Found by trial: white
    # noise of 384 pulses counted as clutter in 0 of 200 trials, and with 1.5 times in 2 %.
    chance = 2.0 * channels**2 * len(size) / 2
    plain = (white - log_det < chance) | ~(level.amax(-1) > 0)
    covariance = torch.where(plain[..., None, None, None], power[..., None, None, None] * eye, loaded)
    inverse = matrix_inverse(cholesky_factor(covariance))
    factor = inverse[..., group, :, :] * ramp.conj().mT[..., None, :]
    return Whitening(factor, torch.where(plain, white, log_det), ~plain)
