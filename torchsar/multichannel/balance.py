"""Estimation and correction of phase, gain and delay differences between channels.

Stationary clutter is modelled as a Gaussian process. Its covariance over the channels without
differences is known at every Doppler frequency: each Doppler band contributes with the response of
the array to this band, and with the power that the antenna pattern gives the band. The differences
are fitted to the data with this model by maximum likelihood. If the clutter fills fewer bands than
there are channels, this amounts to fitting the balanced data into the subspace that the responses
to these bands span (a noise-subspace method). Otherwise the estimate relies on the expected power
over Doppler.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3, which requires the correction without a method; Weiss
    and Friedlander 1990 (self-calibration in subspace form).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    fft_lines,
    linear_phasor,
    refuse_non_finite_values,
    take,
    unit_level,
    unit_phasor,
)
from torchsar.multichannel.check import checked_channels
from torchsar.multichannel.response import ElementPattern, Prior, clutter_covariance
from torchsar.radar import BistaticRadar

# Found by trial: after 12 Newton steps phases still err by 3e-5 rad with a flat band and by 8e-3
# rad with the element pattern; after 25 they have converged.
_ROUNDS = 25
# Found by trial: the second pass lowers the error of the delay from 31 ps to 12 ps (flat band, 256
# pulses by 160 cells, 40 dB); a third changes nothing.
_DELAY_PASSES = 2
# SNR assumed while delays are estimated, found by trial: from 20 dB on they hardly depend on it.
_COARSE_DB = 20.0
# SNR values tried, in dB: a step of 1 dB changes the phases by 1e-3 rad, less than their errors.
_LEVELS_DB = tuple(range(0, 61, 3))
# Difference of the powers of balanced channels over that by chance from which the prior is taken to
# be wrong, by choice.
_UNLIKELY = 4.0
# (mean square)^2 / mean fourth power of the Hann weights: independent looks per pulse.
_HANN_LOOKS = 18 / 35
# Convention: a linear phase error of 0.1 rad, three times as much, already makes false targets of
# about -20 dB when three bands are reconstructed at a PRF of 180 Hz. So do amplitudes. Phases that
# delays turn over the range band weigh less, since their mean is zero.
_LARGEST_STD_RAD, _LARGEST_ACROSS_RAD = 0.033, 0.1


def correct_balance(
    data: Tensor,
    radar: BistaticRadar,
    phase_rad: Tensor,
    gain_db: Tensor,
    delay_s: Tensor | None = None,
    with_range: bool = True,
) -> Tensor:
    """Remove phase, gain and delay differences between the channels.

    Each channel is divided by 10^(gain_db / 20) exp(j phase), and its envelope is advanced in range
    time by its delay; the delay does not change the carrier phase. Differentiable.

    Args:
        data: Channels, shape (..., channel, pulse, range), or (..., channel, pulse) if `with_range`
            is False, complex.
        radar: Radar parameters.
        phase_rad: Phases in radians, float64 (..., channel).
        gain_db: Gains in dB, float64 (..., channel).
        delay_s: Delays in seconds, float64 (..., channel), or None.
        with_range: Whether the data have a range axis.

    Returns:
        Balanced data, same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or if there is
            not one value per channel, or data without a range axis have a delay.
    """
    dims = "channel, pulse, range" if with_range else "channel, pulse"
    data = checked_channels(data, radar, "correct_balance", dims, finite=False)
    refuse_non_finite_values("correct_balance", phase_rad=phase_rad, gain_db=gain_db, delay_s=delay_s)
    for name, value in (("phase_rad", phase_rad), ("gain_db", gain_db), ("delay_s", delay_s)):
        if value is not None and value.shape[-1:] != (radar.channels,):
            raise ValueError(
                f"correct_balance needs {name} of shape (..., {radar.channels}), one value per channel, got "
                f"shape {tuple(value.shape)}"
            )
    factor = (unit_phasor(-phase_rad / (2 * math.pi), torch.complex128) * 10 ** (-gain_db / 20)).to(data.dtype)
    if not with_range:
        if delay_s is not None and bool(delay_s.any()):
            raise ValueError(
                "delay_s must be None or zero for data without a range axis, along which delays act; leave delay_s out"
            )
        return data * factor[..., None]
    balanced = data * factor[..., None, None]
    return balanced if delay_s is None else torch.fft.ifft(torch.fft.fft(balanced) * _advance(delay_s, radar, data))


def _advance(delay_s: Tensor, radar: BistaticRadar, data: Tensor) -> Tensor:
    """Return exp(+j 2 pi fr delay), (..., channel, 1, range frequency), FFT order."""
    n = data.shape[-1]
    return torch.fft.ifftshift(linear_phasor(delay_s * (radar.sampling_hz / n), -(n // 2), n, data.dtype), dim=-1)[
        ..., None, :
    ]


def estimate_balance(
    data: Tensor,
    radar: BistaticRadar,
    prior: Prior | None = None,
    bands: int | None = None,
    delays: bool = True,
    blocks: int = 16,
) -> Estimate:
    """Estimate phase, gain and delay of each channel from stationary clutter.

    The noise level is estimated as well. Not differentiable. Where the clutter fills fewer bands
    than there are channels, prefer the prior `FlatBand(bands * PRF)`: it suits any scene, since it
    only assumes that the rest of the spectrum is empty, and the phases err by 0.03 degree instead
    of 0.3 degree (900 pulses by 256 range cells). A phase that grows linearly along the array
    shifts all clutter in Doppler; it is determined only by the edges of the band or the shape of
    the pattern. It cannot be determined with a flat prior that fills as many bands as there are
    channels. Nor can the phases of channels as far apart as their elements are long, whose clutter
    is uncorrelated: the 3 channels of Table 1 need about 500 pulses by 200 range cells.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape (...,
            channel, pulse, range), complex, mostly stationary clutter.
        radar: Radar parameters.
        prior: Expected power of the clutter over Doppler, `ElementPattern()` by default.
        bands: Number of Doppler bands that the clutter fills, each one PRF wide; None for all at
            which a stationary scene has echoes, 2 v / lambda for the speed v. Side lobes of a
            pattern beyond fewer bands bias the gains by more than the standard deviation says.
        delays: False to assume zero delays.
        blocks: Number of parts into which the range band is divided; within each part a delay is
            approximated by a constant phase. A delay of two samples changes the phase across one of
            16 blocks by a tenth of a cycle.

    Returns:
        `phase_rad`, `gain_db` and `delay_s`, float64 (..., channel), relative to the channel whose
        along-track position is nearest to zero. Standard deviations of phases and gains follow from
        the likelihood; those of gains contain the difference that remains between the powers of the
        balanced channels, as with a wrong prior. Those of delays follow from the scatter of the
        blocks.
        `info` holds `snr_db` (...,), the ratio of the clutter power at the peak of the prior to the
        noise power. `ok` is False, and the values are zero, where a channel has no power, the
        standard deviation of a phase exceeds 0.033 rad or that of a gain 0.29 dB, or that of a
        delay turns the phase by more than 0.1 rad rms over the range band.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the radar has one
            channel, the shape of the data does not match it, `bands` is below 1, or `blocks` does
            not fit the range band.
    """
    data = checked_samples(data, "estimate_balance", "channel, pulse, range")
    _check_data(data, radar, blocks, bands)
    data = unit_level(data, 3)
    with torch.no_grad():
        lines, frequency = _band_lines(data, radar, blocks)
        power = lines.abs().square().mean((-2, -1))
        own = power.mean(-1)[..., None, None, None]
        lines = lines / torch.where(own > 0, own, 1.0).sqrt()
        bands = bands or math.ceil(2 * radar.speed_m_s / (radar.wavelength_m * radar.prf_hz))
        models = _Models.of(radar, prior or ElementPattern(), bands, data.shape[-2], data.device)
        centres, reference = frequency.view(blocks, -1).mean(-1), _reference(radar)
        no_power = (power == 0).any(-1)
        products, delay = (
            _products(lines, blocks, no_power),
            torch.zeros(*data.shape[:-3], radar.channels, dtype=torch.float64, device=data.device),
        )
        delay_std = torch.zeros_like(delay)
        for _ in range(_DELAY_PASSES if delays else 0):
            by_block = models.solve(products.movedim(-3, 0), _COARSE_DB)[0].movedim(0, -2)
            step, delay_std = _slope(by_block, centres, reference)
            delay = delay + step
            products = _products(lines * unit_phasor(delay[..., None, None] * frequency, lines.dtype), blocks, no_power)
        weights, hessian, snr_db, by_snr = models.best(products.mean(-3))
        looks = data.shape[-2] * frequency.numel() * _HANN_LOOKS
        by_snr = by_snr / math.sqrt(2 * looks)
        balanced = lines.abs().square().mean((-2, -1)) * weights.abs().square()
        log_std, phase_std = _standard_deviations(hessian, reference, looks)
        log_std = torch.hypot(log_std, by_snr - by_snr[..., reference, None])
        # balanced channels have equal power, but with a wrong prior other gains are more likely
        uneven = torch.log((balanced / balanced[..., reference, None].clamp_min(1e-300)).clamp_min(1e-3)).abs() / 2
        chance = models.chance(snr_db, reference, looks) / 2
        log_std = torch.where(uneven > _UNLIKELY * chance, torch.hypot(log_std, uneven), log_std)
        return _estimate_of(weights, delay, (log_std, phase_std, delay_std), snr_db, no_power, reference, radar)


def _check_data(data: Tensor, radar: BistaticRadar, blocks: int, bands: int | None) -> None:
    """Raise ValueError unless data, blocks and bands suit the radar."""
    if radar.channels < 2:
        raise ValueError(
            "the balance between channels needs at least two positions in channel_m, but the radar has one"
        )
    if data.ndim < 3 or data.shape[-3] != radar.channels:
        raise ValueError(
            f"the balance is estimated from data (..., {radar.channels}, pulse, range) with one channel for each "
            f"position in the radar's channel_m, got shape {tuple(data.shape)}"
        )
    if bands is not None and bands < 1:
        raise ValueError(f"bands must be at least 1, the number of Doppler bands with clutter, got {bands}")
    inside = int(data.shape[-1] * radar.pulse.bandwidth_hz / radar.sampling_hz)
    if not 2 <= blocks <= inside:
        raise ValueError(
            f"blocks must be at least 2 and at most {inside}, the number of range frequencies of {data.shape[-1]} "
            f"range samples within the bandwidth of the pulse, got {blocks}"
        )


def _reference(radar: BistaticRadar) -> int:
    """Return the index of the channel nearest to the reference point of the track."""
    return min(range(radar.channels), key=lambda m: abs(radar.channel_m[m]))


def _band_lines(data: Tensor, radar: BistaticRadar, blocks: int) -> tuple[Tensor, Tensor]:
    """Return spectra (..., channel, Doppler bin, range frequency) in the band, and frequencies.

    Pulses are Hann weighted: the ends of the record would otherwise leak -30 dB over all Doppler at
    900 pulses, where the response of the array differs.
    """
    n = data.shape[-1]
    width = int(n * radar.pulse.bandwidth_hz / radar.sampling_hz) // blocks * blocks
    inside = slice(n // 2 - width // 2, n // 2 - width // 2 + width)
    taper = (
        torch.hann_window(data.shape[-2], periodic=False, dtype=data.real.dtype, device=data.device)
        if data.shape[-2] > 2
        else data.real.new_ones(data.shape[-2])
    )
    lines = fft_lines(torch.fft.fftshift(torch.fft.fft(data * taper[:, None]), dim=-1)[..., inside])
    return lines, torch.fft.fftshift(radar.range_frequency_hz(n, data.device))[inside]


def _products(lines: Tensor, blocks: int, no_power: Tensor) -> Tensor:
    """Return channel covariances per block, complex128 (..., bin, block, channel, channel).

    Trials in which a channel has no power (...,) get the covariance of white noise.
    """
    by_bin = lines.unflatten(-1, (blocks, -1)).movedim(-4, -2)
    products = (by_bin @ by_bin.mH).to(torch.complex128) / by_bin.shape[-1]
    noise = torch.eye(products.shape[-1], dtype=products.dtype, device=products.device)
    return torch.where(no_power[..., None, None, None, None], noise, products)


@dataclass(frozen=True)
class _Models:
    """Channel covariances of stationary clutter, complex128 (bin, channel, channel)."""

    clutter: Tensor

    @staticmethod
    def of(radar: BistaticRadar, prior: Prior, bands: int, n_pulse: int, device: torch.device) -> _Models:
        """Return the covariances for an expected clutter power, with Doppler bins in FFT order."""
        return _Models(clutter_covariance(radar, prior, n_pulse, bands, device))

    def noisy(self, snr_db: float) -> Tensor:
        """Return the covariances plus white noise.

        The SNR in dB is the ratio of the strongest expected power of a band to the noise.
        """
        return self.clutter + 10 ** (-snr_db / 10) * torch.eye(
            self.clutter.shape[-1], dtype=self.clutter.dtype, device=self.clutter.device
        )

    def solve(self, products: Tensor, snr_db: float) -> tuple[Tensor, Tensor, Tensor]:
        """Fit the channel gains for a given SNR in dB by maximum likelihood.

        Returns:
            Complex weights that balance the channels (..., channel), half the Hessian and the value
            of the negative log-likelihood.
        """
        model = self.noisy(snr_db)
        matrix = (torch.linalg.inv(model) * products.mT).mean(-3)
        weights, hessian, cost = _solved(matrix, self._start(products))
        return weights, hessian, 2 * cost + torch.linalg.slogdet(model)[1].mean()

    def best(self, products: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Fit the channel gains and the SNR by maximum likelihood in each trial.

        Returns:
            Complex weights that balance the channels (..., channel), half the Hessian of the
            negative log-likelihood, the SNR in dB, and what the error of the SNR adds to the
            standard deviations of the logarithms of the gains (..., channel), for one look.
        """
        found = [self.solve(products, level) for level in _LEVELS_DB]
        weights, hessian, cost = (torch.stack(parts, -1) for parts in zip(*found))
        best = cost.argmin(-1)
        around = best.clamp(1, cost.shape[-1] - 2)
        low, middle, high = (take(cost, around + i, -1) for i in (-1, 0, 1))
        bend = low - 2 * middle + high
        # the gains depend smoothly on the SNR: they are interpolated to the minimum of the cost
        step = torch.where(bend > 0, 0.5 * (low - high) / torch.where(bend > 0, bend, 1), 0).clamp(-1.5, 1.5)
        left, centre, right = (take(weights.movedim(-1, best.ndim), around + i, best.ndim) for i in (-1, 0, 1))
        ratios = (torch.log(side / centre) for side in (left, right))
        before, after = (torch.view_as_real(ratio) for ratio in ratios)
        at, slope = step[..., None, None], (after - before) / 2
        moved = torch.view_as_complex((at * slope + at.square() * (after + before) / 2).contiguous())
        levels = torch.tensor(_LEVELS_DB, dtype=torch.float64, device=best.device)
        return (
            centre * torch.exp(moved),
            take(hessian.movedim(-1, best.ndim), best, best.ndim),
            levels[around] + step * (levels[1] - levels[0]),
            torch.where(bend > 0, torch.where(bend > 0, bend, 1).rsqrt(), 0)[..., None] * slope[..., 0],
        )

    def chance(self, snr_db: Tensor, reference: int, looks: float) -> Tensor:
        """Return by how much the powers of balanced channels differ from the reference by chance.

        Args:
            snr_db: SNR, shape (...,).
            reference: Index of the reference channel.
            looks: Number of independent samples in all bins.

        Returns:
            Standard deviations relative to the power, shape (..., channel).
        """
        eye = torch.eye(self.clutter.shape[-1], dtype=self.clutter.dtype, device=self.clutter.device)
        model = self.clutter + 10 ** (-snr_db[..., None, None, None] / 10) * eye
        power = model.diagonal(dim1=-2, dim2=-1).real
        shared = model[..., reference].abs().square()
        variance = (power.square() + power[..., reference, None].square() - 2 * shared).clamp_min(0).mean(-2)
        return (variance / looks).sqrt() / power.mean(-2)

    def _start(self, products: Tensor) -> Tensor:
        """Return inverse gains as the strongest eigenvector of the data matched to the model."""
        matched = (products * self.clutter.conj()).sum(-3)
        gains = torch.linalg.eigh(
            matched / self.clutter.abs().square().sum(-3).clamp_min(torch.finfo(torch.float64).tiny)
        )[1][..., -1]
        size = gains.abs()
        return torch.polar(1 / size.clamp_min(1e-3), -gains.angle())


def _solved(matrix: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise half of w^H Q w - 2 sum(a) over w = exp(a + j p) by damped Newton steps.

    This is the negative log-likelihood of Gaussian samples with gains 1 / w; the common phase is
    kept. Returns the weights (..., channel), the Hessian over (a, p) and the minimum.
    """
    form = (start.conj() * (matrix @ start[..., None])[..., 0]).sum(-1).real
    start = start * (matrix.shape[-1] / form.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()[..., None]
    logs, damping = torch.cat([start.abs().log(), start.angle()], -1), torch.full_like(form, 1e-6)
    cost, gradient, hessian = _expanded(matrix, logs)
    identity = torch.eye(logs.shape[-1], dtype=logs.dtype, device=logs.device)
    for _ in range(_ROUNDS):
        curved = (
            hessian
            + (damping * hessian.diagonal(dim1=-2, dim2=-1).abs().amax(-1)).clamp_min(1e-12)[..., None, None] * identity
        )
        new = logs - torch.linalg.solve(curved, gradient).clamp(-1, 1)
        after = _expanded(matrix, new)
        better = after[0] < cost
        logs = torch.where(better[..., None], new, logs)
        cost, gradient, hessian = (
            torch.where(better[(...,) + (None,) * (a.ndim - better.ndim)], a, b)
            for a, b in zip(after, (cost, gradient, hessian))
        )
        damping = torch.where(better, damping / 10, damping * 30).clamp(1e-9, 1e6)
    half = logs.shape[-1] // 2
    return torch.polar(logs[..., :half].exp(), logs[..., half:]), hessian, cost


def _expanded(matrix: Tensor, logs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return half of w^H Q w - 2 sum(a), with its gradient and Hessian over (a, p)."""
    half = logs.shape[-1] // 2
    weights = torch.polar(logs[..., :half].exp(), logs[..., half:])
    t = weights.conj()[..., :, None] * matrix * weights[..., None, :]
    rows = t.sum(-1)
    gradient = torch.cat([rows.real - 1, rows.imag], -1)
    over_a = t.real + torch.diag_embed(rows.real)
    over_p = t.real - torch.diag_embed(rows.real)
    mixed = -t.imag + torch.diag_embed(rows.imag)
    hessian = torch.cat([torch.cat([over_a, mixed], -1), torch.cat([mixed.mT, over_p], -1)], -2)
    return t.real.sum((-2, -1)) / 2 - logs[..., :half].sum(-1), gradient, hessian


def _slope(weights: Tensor, frequency_hz: Tensor, reference: int) -> tuple[Tensor, Tensor]:
    """Return delays in seconds from the phases of weights (..., block, channel).

    Their standard deviations follow from the scatter of the blocks; shape (..., channel) each.
    """
    turn = weights * weights[..., reference, None].conj()
    step = frequency_hz[1] - frequency_hz[0]
    coarse = torch.angle((turn[..., 1:, :] * turn[..., :-1, :].conj()).sum(-2)) / (2 * math.pi * step)
    turn = turn * unit_phasor(-coarse[..., None, :] * frequency_hz[:, None], turn.dtype)
    angle = torch.angle(turn * turn.sum(-2, keepdim=True).conj())
    f = frequency_hz[:, None] - frequency_hz.mean()
    slope = (angle * f).sum(-2) / f.square().sum()
    left = angle - angle.mean(-2, keepdim=True) - slope[..., None, :] * f
    std = (left.square().sum(-2) / max(1, len(f) - 2) / f.square().sum()).sqrt()
    return coarse + slope / (2 * math.pi), std / (2 * math.pi)


def _estimate_of(
    weights: Tensor,
    delay: Tensor,
    stds: tuple[Tensor, Tensor, Tensor],
    snr_db: Tensor,
    no_power: Tensor,
    reference: int,
    radar: BistaticRadar,
) -> Estimate:
    """Form the estimate relative to the reference channel and judge it."""
    log_std, phase_std, delay_std = stds
    value = {
        "phase_rad": torch.angle(weights.conj() * weights[..., reference, None]),
        "gain_db": 20 * torch.log10(weights[..., reference, None].abs() / weights.abs()),
        "delay_s": delay - delay[..., reference, None],
    }
    std = {"phase_rad": phase_std, "gain_db": log_std * (20 / math.log(10)), "delay_s": delay_std}
    # rms phase over the range band by a delay
    by_delay = math.pi * radar.pulse.bandwidth_hz / math.sqrt(3) * delay_std.amax(-1)
    worst = torch.maximum(phase_std, log_std).amax(-1) / _LARGEST_STD_RAD
    worst = torch.maximum(worst, by_delay / _LARGEST_ACROSS_RAD)
    ok = torch.stack([v.isfinite().all(-1) for v in value.values()]).all(0) & ~no_power & (worst < 1)
    value = {name: torch.where(ok[..., None], v, 0.0) for name, v in value.items()}
    return Estimate(value, torch.where(ok, 1 - worst, 0.0).clamp(0, 1), ok, std, {"snr_db": snr_db})


def _standard_deviations(hessian: Tensor, reference: int, looks: float) -> tuple[Tensor, Tensor]:
    """Return standard deviations of log gains and phases (..., channel), at most 1e3."""
    channels = hessian.shape[-1] // 2
    # the common phase is not determined; the error of the common gain is shared by all channels
    others = [i for i in range(2 * channels) if i != channels + reference]
    values, vectors = torch.linalg.eigh(hessian[..., others, :][..., others])
    scaled = vectors / (2 * looks * values).clamp_min(1e-6).sqrt()[..., None, :]
    scaled = torch.cat([scaled[..., :channels, :] - scaled[..., reference, None, :], scaled[..., channels:, :]], -2)
    std = torch.zeros_like(hessian[..., 0])
    std[..., others] = scaled.square().sum(-1).sqrt()
    return std[..., :channels], std[..., channels:]


class EstimateBalance(Stage):
    """Stage that estimates phase, gain and delay of each channel; see `estimate_balance`.

    The values connect to `CorrectBalance`.

    Args:
        radar: Radar parameters.
        prior: Expected power of the clutter over Doppler, `ElementPattern()` by default.
        bands: Number of Doppler bands that the clutter fills, each one PRF wide; None for all at
            which a stationary scene has echoes.
        delays: False to assume zero delays.
        blocks: Number of parts into which the range band is divided; within each part a delay is
            approximated by a constant phase.
    """

    works_on = ("channel", "pulse", "range")
    provides = ("phase_rad", "gain_db", "delay_s")
    neutral = {"phase_rad": 0.0, "gain_db": 0.0, "delay_s": 0.0}

    def __init__(
        self,
        radar: BistaticRadar,
        prior: Prior | None = None,
        bands: int | None = None,
        delays: bool = True,
        blocks: int = 16,
    ) -> None:
        super().__init__()
        self.radar, self.prior, self.bands, self.delays, self.blocks = radar, prior, bands, delays, blocks

    def forward(self, signal: Signal) -> Estimate:
        """Estimate phase, gain and delay of each channel from stationary clutter.

        Args:
            signal: Range-compressed channels with the axes (channel, pulse, range) and the transmit
                range removed from the phase.

        Returns:
            `phase_rad`, `gain_db` and `delay_s` of shape (..., channel), see `estimate_balance`.
        """
        return estimate_balance(signal.data, self.radar, self.prior, self.bands, self.delays, self.blocks)


class CorrectBalance(Stage):
    """Stage that removes estimated or measured phases, gains and delays of the channels.

    See `correct_balance`. After a stage "balance" that estimates the values, connect it as
    `use(CorrectBalance(radar), phase_rad="balance", gain_db="balance", delay_s="balance")`.

    Args:
        radar: Radar parameters.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar

    def forward(self, signal: Signal, phase_rad: Tensor, gain_db: Tensor, delay_s: Tensor | None = None) -> Signal:
        """Remove phase, gain and delay of each channel.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            phase_rad: Phases in radians, shape (..., channel).
            gain_db: Gains in dB, shape (..., channel).
            delay_s: Delays in seconds, shape (..., channel), or None. Without a range axis they
                must be None or zero.

        Returns:
            Balanced channels on the same axes.
        """
        return signal.with_data(
            correct_balance(signal.data, self.radar, phase_rad, gain_db, delay_s, "range" in signal.names)
        )
