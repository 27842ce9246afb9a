"""Stationary clutter as a covariance of the channels in each Doppler bin, estimated from data, and
its whitening.

A stationary scene obeys the channel response at rest: in a Doppler bin its bands span few
directions among the channels. After the known ramp over Doppler the covariance changes slowly from
bin to bin, so that neighbouring bins, and range lines where there are several, are its samples.
Source: brief 001, Velocity (stationary clutter); Reed, Mallett and Brennan 1974 (sample
covariance).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import shared_response
from torchsar.radar import BistaticRadar

_SAMPLES = 60
_LOADING = 1e-6
_EVIDENCE = 2.0


@dataclass(frozen=True)
class Whitening:
    """factor: complex128 (..., bin, channel, channel), W with W R W^H = 1 for the covariance R of
    the FFT over pulses (unitary scale).

    log_det: (...,), of all R together; coloured: (...,) bool, R is not that of white noise.
    """

    factor: Tensor
    log_det: Tensor
    coloured: Tensor

    def expanded(self, count: int) -> Whitening:
        """The same covariance for `count` trials."""
        return Whitening(
            self.factor.expand(count, *self.factor.shape), self.log_det.expand(count), self.coloured.expand(count)
        )

    def applied(self, data: Tensor) -> Tensor:
        """Whitened spectra of data (..., channel, pulse), or (..., any, channel, pulse) with one
        more dim than the trials: same shape, bins for pulses.
        """
        spectrum = torch.fft.fft(data, norm="ortho")
        return _mixed(self.factor if data.ndim == self.factor.ndim - 1 else self.factor[..., None, :, :, :], spectrum)

    def backed(self, data: Tensor) -> Tensor:
        """R^-1 applied to data (..., channel, pulse), back over pulses: what correlations with a
        model take in clutter.
        """
        return torch.fft.ifft(_mixed(self.factor.mH, self.applied(data)), norm="ortho")


def _mixed(factor: Tensor, spectrum: Tensor) -> Tensor:
    """factor (..., bin, channel, channel) times spectra (..., channel, bin): as sums of products,
    many times as fast as so many small matrix products.
    """
    rows = factor.movedim(-3, -1)
    return sum(
        (rows[..., :, i, :] * spectrum[..., i, None, :] for i in range(1, spectrum.shape[-2])),
        rows[..., :, 0, :] * spectrum[..., 0, None, :],
    )


def sample_whitening(data: Tensor, radar: BistaticRadar, samples: int = _SAMPLES) -> Whitening:
    """From the data themselves (..., channel, pulse), or lines of them (..., line, channel, pulse)
    by `line_whitening`: mean over groups of `samples` neighbouring bins.
    """
    return line_whitening(data[..., None, :, :], radar, samples)


def line_whitening(lines: Tensor, radar: BistaticRadar, samples: int = _SAMPLES) -> Whitening:
    """Covariance from several independent lines (..., line, channel, pulse), without the point to
    be found: mean over lines and neighbouring bins, `samples` together.

    Where data show no more structure than white noise of one power would by chance, white noise it
    is, per trial. A trial of zeros keeps unit noise.
    """
    n, channels, count = lines.shape[-1], lines.shape[-2], lines.shape[-3]
    groups = max(1, n * count // max(samples, 4 * channels))
    group = torch.arange(n, device=lines.device) * min(groups, n) // n
    rest = PointMotion.of(radar, lines)
    ramp = torch.roll(
        shared_response(radar, rest, n, 2, torch.complex128), -n, -1
    )  # bin i of an FFT is i - n of two bands
    flat = torch.fft.fft(lines.to(torch.complex128), norm="ortho") * ramp.conj()
    products = flat[..., :, None, :] * flat.conj()[..., None, :, :]
    total = products.new_zeros(*products.shape[:-1], int(group[-1]) + 1).index_add(-1, group, products).sum(-4)
    size = torch.bincount(group).to(torch.float64) * count
    covariance = (total / size).movedim(-1, -3)
    covariance, log_det, coloured = _or_white(covariance, size)
    inverse = torch.linalg.inv(torch.linalg.cholesky(covariance))
    return Whitening(inverse[..., group, :, :] * ramp.conj().mT[..., None, :], log_det, coloured)


def _or_white(covariance: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Loaded covariance (..., group, channel, channel), white where its structure is no more than
    chance, the log determinant over all bins, and where it is not white.
    """
    channels = covariance.shape[-1]
    eye = torch.eye(channels, dtype=covariance.dtype, device=covariance.device)
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    power = (level * size).sum(-1) / size.sum()
    power = torch.where(power > 0, power, 1.0)
    loaded = covariance + _LOADING * power[..., None, None, None] * eye
    log_det = (torch.linalg.slogdet(loaded)[1] * size).sum(-1)
    white = channels * torch.log(power) * size.sum()
    chance = _EVIDENCE * channels**2 * len(size) / 2
    plain = (white - log_det < chance) | ~(level.amax(-1) > 0)
    return (
        torch.where(plain[..., None, None, None], power[..., None, None, None] * eye, loaded),
        torch.where(plain, white, log_det),
        ~plain,
    )
