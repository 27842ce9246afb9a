"""Gaussian model of stationary clutter seen by several channels, fitted by maximum likelihood.

The unknowns are the logarithm and the phase of a weight of each channel, a delay of each channel,
and the power of the noise. With weights w = exp(a + j p) that balance the channels, half the
negative log-likelihood per look is 1/2 w^H Q w - sum(a), up to terms of the noise. Here Q is the
product, element by element, of the inverse model covariance and the conjugate measured covariance,
averaged over the Doppler bins.

Reference:
    Weiss and Friedlander 1990 (self-calibration of gains and phases in subspace form).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import linear_solve, matrix_inverse
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import Prior, band_matrix, doppler_offsets, first_bin, shared_response
from torchsar.optim.scalar import grid_minimum, parabola_minimum
from torchsar.radar import BistaticRadar


def hann(radar: BistaticRadar, n_pulse: int, device: torch.device) -> Tensor:
    """Return Hann weights of the pulses of each channel.

    Channel m sees the clutter dx_m / v later, and its weights lie as much later. Each channel is
    then the same weighted signal, delayed: its spectrum has the response of its own frequency. With
    equal weights, responses of neighbouring frequencies would mix at -43 dB at 256 pulses.

    Args:
        radar: Radar parameters.
        n_pulse: Number of pulses; up to two are not weighted.
        device: Device of the result.

    Returns:
        Weights, float64 (channel, pulse).
    """
    if n_pulse <= 2:
        return torch.ones(radar.channels, n_pulse, dtype=torch.float64, device=device)
    later = radar.channels_at(device) * (radar.prf_hz / radar.speed_m_s)
    later = (later - (later.amax() + later.amin()) / 2)[:, None]
    half = (n_pulse + 1) / 2 - later.abs().amax().clamp_max(n_pulse / 4)
    at = (torch.arange(n_pulse, dtype=torch.float64, device=device) - (n_pulse - 1) / 2 - later) / half
    return torch.cos(math.pi / 2 * at.clamp(-1, 1)).square()


@dataclass(frozen=True)
class ClutterModel:
    """Gaussian model of stationary clutter in balanced channels.

    Args:
        response: Response of the channels to each Doppler band, complex128 (bin, channel, band),
            with bins in FFT order. The outermost bands hold what the taper spreads over the edges.
        power: Power of the bands, float64 (..., bin, band).
    """

    response: Tensor
    power: Tensor

    @staticmethod
    def of(
        radar: BistaticRadar, prior: Prior, n_pulse: int, bands: int, device: torch.device, points: int = 8
    ) -> ClutterModel:
        """Return the model of clutter in Hann-weighted pulses, on the scale of a prior.

        The taper spreads the power over neighbouring bins, also beyond the edges of the bands. It
        is followed over eight bins to either side, beyond which its side lobes lie below -70 dB.

        Args:
            radar: Radar parameters.
            prior: Expected power over Doppler.
            n_pulse: Number of pulses.
            bands: Number of Doppler bands that hold the clutter.
            device: Device of the result.
            points: Points per Doppler bin at which the prior is smoothed by the taper.

        Returns:
            The model.
        """
        motion = PointMotion.of(radar, torch.zeros((), dtype=torch.float64, device=device))
        wide, reach = bands + 2, 8 * points
        fine = (torch.arange(points, dtype=torch.float64, device=device) + 0.5) / points - 0.5
        offset = doppler_offsets(n_pulse, wide, radar.prf_hz, device)[:, None] + fine * (radar.prf_hz / n_pulse)
        power = prior.power(offset, radar, motion) * (offset.abs() <= bands * radar.prf_hz / 2)
        x = (torch.arange(-reach, reach, dtype=torch.float64, device=device) + 0.5) / points
        kernel = (torch.sinc(x) / (1 - x.square())).square()
        padded = torch.nn.functional.pad(power.reshape(1, 1, -1), (reach - points // 2,) * 2)
        smooth = torch.nn.functional.conv1d(padded, (kernel / kernel.sum())[None, None], stride=points)
        response = shared_response(radar, motion, n_pulse, wide, torch.complex128).T[..., None]
        response, first = response * band_matrix(radar, motion, wide), first_bin(n_pulse, wide)
        return ClutterModel(torch.roll(response, first, 0), torch.roll(smooth.view(wide, n_pulse).T, first, 0))

    def adapted(self, products: Tensor, weights: Tensor, snr_db: Tensor, rounds: int = 30) -> ClutterModel:
        """Return the model with the power over Doppler of the data, per trial.

        It is the likeliest power of each band but the outermost two, averaged over neighbouring
        bins. Its peak is 1.

        Args:
            products: Measured covariances, complex128 (..., bin, channel, channel).
            weights: Weights that balance the channels, (..., channel).
            snr_db: SNR of the model that fits the weights, (...,).
            rounds: Rounds in which the power is found.
        """
        weights = weights[..., None, :]
        balanced = self._smoothed(weights[..., :, None] * products * weights[..., None, :].conj())
        response, model, power = self.response[..., 1:-1], self, self.power
        for _ in range(rounds):
            seen = matrix_inverse(model.noisy(snr_db)) @ response
            found, expected = ((seen.conj() * x).sum(-2).real for x in (balanced @ seen, response))
            ratio = found / expected.clamp_min(torch.finfo(torch.float64).tiny)
            power = model.power.expand(*ratio.shape[:-1], -1).clone()
            power[..., 1:-1] *= ratio
            model = ClutterModel(self.response, power)
        return ClutterModel(self.response, power / power.amax((-2, -1), True).clamp_min(1e-300))

    def _smoothed(self, products: Tensor, near: int = 4) -> Tensor:
        """Average covariances (..., bin, channel, channel) over neighbouring Doppler bins.

        The delays between the channels are removed meanwhile. Nine bins of 80 range cells determine
        the power to 5 %.
        """
        bins, first = products.shape[-3], first_bin(products.shape[-3], self.response.shape[-1])
        steering = self.response[..., :1] @ self.response[..., :1].mH
        rising = torch.view_as_real(torch.roll(products * steering.conj(), -first, -3)).flatten(-3).mT
        padded = torch.nn.functional.pad(rising.reshape(-1, 1, bins), (near, near), mode="replicate")
        found = torch.nn.functional.avg_pool1d(padded, 2 * near + 1, stride=1).view(rising.shape).mT
        found = torch.view_as_complex(found.unflatten(-1, (*products.shape[-2:], 2)).contiguous())
        return torch.roll(found, first, -3) * steering

    def noisy(self, snr_db: Tensor | float) -> Tensor:
        """Return the covariances plus white noise, (..., bin, channel, channel).

        Args:
            snr_db: Ratio in dB of the strongest expected power of a band to the noise, (...,).
        """
        noise = 10 ** (-torch.as_tensor(snr_db, dtype=torch.float64, device=self.response.device) / 10)
        eye = torch.eye(self.response.shape[-2], dtype=self.response.dtype, device=self.response.device)
        clutter = (self.response * self.power[..., None, :]) @ self.response.mH
        return clutter + noise[..., None, None, None] * eye

    def weights(self, products: Tensor, snr_db: Tensor | float) -> tuple[Tensor, Tensor]:
        """Fit the channel weights for a given SNR.

        The fit starts from the weights of channels of equal power for which w^H Q w is least.

        Args:
            products: Measured covariances, complex128 (..., bin, channel, channel).
            snr_db: SNR in dB, (...,).

        Returns:
            Complex weights that balance the channels (..., channel), and the negative
            log-likelihood per look (...,).
        """
        model = self.noisy(snr_db)
        matrix = (matrix_inverse(model) * products.mT).mean(-3)
        power = products.diagonal(dim1=-2, dim2=-1).real.mean(-2)
        level = power.clamp_min(torch.finfo(torch.float64).tiny).rsqrt().to(matrix.dtype)
        least = torch.linalg.eigh(level[..., :, None] * matrix * level[..., None, :])[1][..., 0]
        # every channel starts with at least a tenth of the weight, by choice
        found = solve(matrix[..., None, :, :], level * torch.polar(least.abs().clamp_min(0.1), least.angle()))
        return found.weights, 2 * found.cost + torch.linalg.slogdet(model)[1].mean(-1)

    def homogeneous(self, cells: Tensor, no_power: Tensor, bins: int = 256, rounds: int = 8) -> Tensor:
        """Return weights of range cells, zero for those that the model does not describe.

        In such cells something moves, or there is another source. The model is fitted to the cells
        that are kept, and the power outside the clutter is summed over Doppler. Cells are left out
        where this power is at least twice the median and exceeds it by six standard deviations; one
        is 1.48 times the median deviation of a normal distribution. This repeats until nothing
        changes. If the clutter has fewer bands than there are channels, strong clutter does not
        count as power outside the clutter. With as many bands, the whole whitened power counts.

        Args:
            cells: Doppler spectra of range cells, complex128 (..., channel, bin, cell).
            no_power: Where a channel has no power (...,); all cells are then kept.
            bins: About this many Doppler bins are compared.
            rounds: Largest number of rounds.

        Returns:
            Weights of mean 1, zero where a cell is left out, float64 (..., cell).
        """
        step = max(1, cells.shape[-2] // bins)
        thin, x = ClutterModel(self.response[::step], self.power[::step]), cells[..., ::step, :].movedim(-3, -2)
        kept = torch.ones_like(x[..., 0, 0, :].real)
        eye = torch.eye(x.shape[-2], dtype=x.dtype, device=x.device)
        for _ in range(rounds):
            products = (x * kept[..., None, None, :]) @ x.mH / kept.sum(-1)[..., None, None, None]
            products = torch.where(no_power[..., None, None, None], eye, products)
            snr_db = thin.snr_db(products)
            weighted = x * thin.weights(products, snr_db)[0][..., None, :, None]
            # an SNR far above the actual one, so that clutter of any strength has little whitened
            # power
            inner = matrix_inverse(thin.noisy(snr_db + 30.0)) @ weighted
            power = (weighted.conj() * inner).real.sum((-3, -2))
            known = power.masked_fill(kept == 0, torch.nan)
            middle = known.nanmedian(-1, keepdim=True).values
            spread = 1.4826 * (known - middle).abs().nanmedian(-1, keepdim=True).values
            new = ((power <= middle + torch.maximum(6.0 * spread, middle)) | no_power[..., None]).to(kept.dtype)
            if torch.equal(new, kept):
                break
            kept = new
        return kept / kept.mean(-1, keepdim=True)

    def fit(self, products: Tensor, snr_db: Tensor | float, position: Tensor | None) -> Fit:
        """Fit weights, and turns if there is a position, for a given SNR.

        Args:
            products: Measured covariances, complex128 (..., bin, block, channel, channel).
            snr_db: SNR in dB, (...,).
            position: Places of the blocks in the range band, see `solve`.

        Returns:
            The fit.
        """
        start = self.weights(products.mean(-3), snr_db)[0]
        inverse = matrix_inverse(self.noisy(snr_db))
        return solve((inverse[..., None, :, :] * products.mT).mean(-4), start, position)

    def lead(self, products: Tensor, weights: Tensor, snr_db: Tensor) -> Tensor:
        """Return by how much weights are likelier than those for clutter displaced by whole bands.

        Clutter that lies in one band alone can as well lie in another one, with another phase along
        the array.

        Args:
            products: Measured covariances, complex128 (..., bin, channel, channel).
            weights: Weights, (..., channel).
            snr_db: SNR in dB, (...,).

        Returns:
            Difference of the log-likelihoods per look, (...,).
        """
        matrix = (matrix_inverse(self.noisy(snr_db)) * products.mT).mean(-3)
        apart = (self.response[0, :, 2:-1] / self.response[0, :, 1:2]).mT
        others = torch.cat([apart, apart.conj()])
        moved = weights[..., None, :] * torch.cat([torch.ones_like(others[:1]), others])
        form = (moved.conj() * (moved @ matrix.mT)).sum(-1).real
        lead = form[..., 1:] - form[..., :1]
        # phases that are nearly equal in all channels displace nothing (limit of 0.995 by choice)
        return torch.where(others.mean(-1).abs() < 0.995, lead, torch.inf).amin(-1)

    def snr_db(self, products: Tensor) -> Tensor:
        """Estimate the SNR in dB (...,) by maximum likelihood, with the weights."""

        def cost(snr_db: Tensor) -> Tensor:
            return self.weights(products, snr_db)[1]

        centre = torch.full(products.shape[:-3], 39.0, dtype=torch.float64, device=products.device)
        levels, _ = grid_minimum(cost, centre, 57.0, 20)
        return parabola_minimum(cost, levels, 2.0, 0.1, rounds=4)[0]

    def chance(self, snr_db: Tensor, reference: int, looks: Tensor) -> Tensor:
        """Return by how much the powers of balanced channels differ from the reference by chance.

        Args:
            snr_db: SNR, shape (...,).
            reference: Index of the reference channel.
            looks: Number of independent samples in all bins, (..., 1).

        Returns:
            Standard deviations relative to the power, shape (..., channel).
        """
        model = self.noisy(snr_db)
        power = model.diagonal(dim1=-2, dim2=-1).real
        shared = model[..., reference].abs().square()
        variance = (power.square() + power[..., reference, None].square() - 2 * shared).clamp_min(0).mean(-2)
        return (variance / looks).sqrt() / power.mean(-2)


@dataclass(frozen=True)
class Fit:
    """Weights that minimise the negative log-likelihood.

    Args:
        weights: Complex weights, (..., channel).
        turn: Phase by which each weight turns from the middle of the range band to its end,
            (..., channel); zero where no turns are fitted.
        hessian: Second derivatives of half the negative log-likelihood per look, (..., n, n), by
            the logarithms and the phases of the weights and the turns.
        cost: Half the negative log-likelihood per look, (...,).
    """

    weights: Tensor
    turn: Tensor
    hessian: Tensor
    cost: Tensor


def solve(matrix: Tensor, start: Tensor, position: Tensor | None = None, rounds: int = 25) -> Fit:
    """Minimise the mean over blocks of w^H Q w / 2 - sum(a) by damped Newton steps.

    In block b the weights are w = exp(a + j (p + position[b] d)), with log amplitudes a, phases p,
    and turns d, the change of phase from the middle of the range band to its end. The phase and the
    turn that all channels have in common keep their first values.

    Args:
        matrix: Hermitian matrices Q, complex128 (..., block, channel, channel).
        start: First weights, complex128 (..., channel).
        position: Places of the blocks in the range band, -1 to 1, shape (block,); None to leave out
            the turns d, which start at zero.
        rounds: Number of steps. After 25 they have converged; after 12, phases still err by 3e-5
            rad with a flat band and by 8e-3 rad with the element pattern.

    Returns:
        The minimum.
    """
    form = (start.conj()[..., None, :] * (matrix @ start[..., None, :, None])[..., 0]).sum(-1).real.mean(-1)
    start = start * (matrix.shape[-1] / form.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()[..., None]
    logs = torch.cat([start.abs().log(), start.angle()] + [torch.zeros_like(start.real)] * (position is not None), -1)
    damping, here = torch.full_like(form, 1e-6), _expanded(matrix, logs, position)
    identity = torch.eye(logs.shape[-1], dtype=logs.dtype, device=logs.device)
    for _ in range(rounds):
        _, gradient, hessian = here
        level = (damping * hessian.diagonal(dim1=-2, dim2=-1).abs().amax(-1)).clamp_min(1e-12)[..., None, None]
        new = logs - linear_solve(hessian + level * identity, gradient).clamp(-1, 1)
        there = _expanded(matrix, new, position)
        better = there[0] < here[0]
        logs = torch.where(better[..., None], new, logs)
        here = tuple(torch.where(better.view(better.shape + (1,) * i), there[i], here[i]) for i in range(3))
        damping = torch.where(better, damping / 10, damping * 30).clamp(1e-9, 1e6)
    a, p, *d = logs.unflatten(-1, (-1, start.shape[-1])).unbind(-2)
    return Fit(torch.polar(a.exp(), p), d[0] if d else torch.zeros_like(p), here[2], here[0])


def _expanded(matrix: Tensor, logs: Tensor, position: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the value that `solve` minimises, with its gradient and Hessian over (a, p[, d]).

    In each block the derivatives are first taken by the logarithms and phases of its own weights.
    These are linear in the unknowns: the phases are p + position[b] d.
    """
    a, p, *d = logs.unflatten(-1, (-1, matrix.shape[-1])).unbind(-2)
    phase = p[..., None, :] if position is None else p[..., None, :] + position[:, None] * d[0][..., None, :]
    weights = torch.polar(a.exp()[..., None, :].expand_as(phase), phase)
    t = weights.conj()[..., :, None] * matrix * weights[..., None, :]
    rows = t.sum(-1)
    gradient = torch.cat([rows.real, rows.imag], -1)
    turns = torch.diag_embed(rows.imag) - t.imag
    above = torch.cat([t.real + torch.diag_embed(rows.real), turns], -1)
    hessian = torch.cat([above, torch.cat([turns.mT, t.real - torch.diag_embed(rows.real)], -1)], -2)
    if position is not None:
        channels, at = p.shape[-1], position[:, None]
        gradient = torch.cat([gradient, at * gradient[..., channels:]], -1)
        hessian = torch.cat([hessian, at[..., None] * hessian[..., channels:, :]], -2)
        hessian = torch.cat([hessian, at[..., None] * hessian[..., channels : 2 * channels]], -1)
    gradient = gradient.mean(-2) - torch.cat([torch.ones_like(a), torch.zeros_like(logs[..., a.shape[-1] :])], -1)
    return t.real.sum((-2, -1)).mean(-1) / 2 - a.sum(-1), gradient, hessian.mean(-3)
