"""Differences of phase, gain and delay between the channels, from the clutter itself.

Clutter at rest is a Gaussian process whose covariance over the channels is known at every Doppler
but for those differences: band b comes with the response of the array there, and with the power
that the antenna gives it. The estimate is that of maximum likelihood: with more channels than bands
of any power it makes the balanced data fit into the space of the bands (a noise subspace method),
otherwise it goes by the power over Doppler. Source: own derivation; brief 001, Algorithm 2;
Gaussian self-calibration after Weiss and Friedlander 1990 (subspace form).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, fft_lines, linear_phasor, take, unit_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import (
    ElementPattern,
    Prior,
    band_matrix,
    doppler_offsets,
    first_bin,
    shared_response,
)
from torchsar.radar import BistaticRadar

_ROUNDS, _DELAY_PASSES = 25, 2
_COARSE_DB, _LEVELS_DB = 20.0, tuple(range(0, 61, 3))
# (mean square)^2 / mean fourth power of the weights: independent looks among so many pulses
_HANN_SHARE = 18 / 35
_TRUSTED_RAD = 0.1


def correct_balance(
    data: Tensor,
    radar: BistaticRadar,
    phase_rad: Tensor,
    gain_db: Tensor,
    delay_s: Tensor | None = None,
    with_range: bool = True,
) -> Tensor:
    """Channels without their differences: over 10^(gain_db / 20) exp(j phase), and earlier by the
    delay, which moves envelopes only.

    data: (..., channel, pulse, range), or (..., channel, pulse) where not with_range; differences
    float64 (..., channel). Differentiable. Raises ValueError for differences of another number of
    channels, or a delay of data without range.
    """
    for name, value in (("phase_rad", phase_rad), ("gain_db", gain_db), ("delay_s", delay_s)):
        if value is not None and value.shape[-1:] != (radar.channels,):
            raise ValueError(
                f"correct_balance needs {name} (..., {radar.channels}), one number a channel, got "
                f"shape {tuple(value.shape)}"
            )
    factor = (unit_phasor(-phase_rad / (2 * math.pi), torch.complex128) * 10 ** (-gain_db / 20)).to(data.dtype)
    if not with_range:
        if delay_s is not None and bool(delay_s.any()):
            raise ValueError("data without a range axis cannot be shifted along it; leave delay_s out")
        return data * factor[..., None]
    balanced = data * factor[..., None, None]
    return balanced if delay_s is None else torch.fft.ifft(torch.fft.fft(balanced) * _advance(delay_s, radar, data))


def _advance(delay_s: Tensor, radar: BistaticRadar, data: Tensor) -> Tensor:
    """exp(+j 2 pi fr delay), (..., channel, 1, range frequency)."""
    n = data.shape[-1]
    return torch.fft.ifftshift(linear_phasor(delay_s * (radar.sampling_hz / n), -(n // 2), n, data.dtype), dim=-1)[
        ..., None, :
    ]


def estimate_balance(
    data: Tensor,
    radar: BistaticRadar,
    prior: Prior | None = None,
    bands: int = 5,
    delays: bool = True,
    blocks: int = 16,
) -> Estimate:
    """`phase_rad`, `gain_db` and `delay_s` (..., channel) of each channel against the one nearest
    to the reference of the track, by maximum likelihood.

    data: (..., channel, pulse, range), range compressed, transmit range removed, clutter at rest in
    most of it. prior: expected power of clutter over Doppler, `ElementPattern()` by default; bands:
    how many it fills, each one pulse rate wide. Where these are fewer than the channels,
    `FlatBand(bands * PRF)` asks for nothing but an empty rest, which serves any scene, and better:
    0.03 against 0.3 degree for 900 pulses by 256 cells. The noise level is estimated along. delays:
    False leaves them at zero. blocks: parts of the range band in which a delay may pass for a
    phase; a delay of two samples turns it by a tenth of a cycle in one of 16. What shifts all
    clutter in Doppler, a phase that grows along the array, is told from the edges of the band or
    the shape of the pattern: a prior as flat and wide as all bands of as many channels tells
    nothing of it. std follows from the likelihood; info: `snr_db` (...,), of the strongest expected
    power over noise. Not ok, with zeros: a channel without power, or a phase that is not known to
    0.1 rad. Not differentiable. Raises ValueError for data of another number of channels or without
    range, or a single channel.
    """
    _refuse_data(data, radar, blocks, bands)
    with torch.no_grad():
        lines, frequency = _band_lines(data, radar, blocks)
        power = lines.abs().square().mean((-2, -1))
        own = power.mean(-1)[..., None, None, None]
        lines = lines / torch.where(own > 0, own, 1.0).sqrt()
        models = _Models.of(radar, prior or ElementPattern(), bands, data.shape[-2], data.device)
        centres, reference = frequency.view(blocks, -1).mean(-1), _reference(radar)
        silent = (power == 0).any(-1)
        products, delay = (
            _products(lines, blocks, silent),
            torch.zeros(*data.shape[:-3], radar.channels, dtype=torch.float64, device=data.device),
        )
        for _ in range(_DELAY_PASSES if delays else 0):
            delay = delay + _slope(
                models.solve(products.movedim(-3, 0), _COARSE_DB)[0].movedim(0, -2), centres, reference
            )
            products = _products(lines * unit_phasor(delay[..., None, None] * frequency, lines.dtype), blocks, silent)
        weights, hessian, snr_db = models.best(products.mean(-3))
        looks = data.shape[-2] * frequency.numel() * _HANN_SHARE
        return _judged(weights, hessian, delay, snr_db, silent, reference, looks, centres if delays else None)


def _refuse_data(data: Tensor, radar: BistaticRadar, blocks: int, bands: int) -> None:
    if radar.channels < 2:
        raise ValueError("balance compares channels, and the radar has one")
    if data.ndim < 3 or data.shape[-3] != radar.channels:
        raise ValueError(
            f"balance works on data (..., {radar.channels}, pulse, range) as the radar's "
            f"channel_m says, got shape {tuple(data.shape)}"
        )
    if bands < 1:
        raise ValueError(f"clutter fills at least one Doppler band, got bands={bands}")
    inside = int(data.shape[-1] * radar.pulse.bandwidth_hz / radar.sampling_hz)
    if not 2 <= blocks <= inside:
        raise ValueError(
            f"the band of {data.shape[-1]} range samples holds {inside} range frequencies: blocks "
            f"must lie in 2..{inside}, got {blocks}"
        )


def _reference(radar: BistaticRadar) -> int:
    return min(range(radar.channels), key=lambda m: abs(radar.channel_m[m]))


def _band_lines(data: Tensor, radar: BistaticRadar, blocks: int) -> tuple[Tensor, Tensor]:
    """Spectra (..., channel, Doppler bin, range frequency) in the pulse's band, cut to whole
    blocks, and those range frequencies (Hz), rising.

    Pulses are weighted, or the ends of the record would leak over all Doppler, where the response
    of the array is another: -30 dB over 900 pulses.
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


def _products(lines: Tensor, blocks: int, silent: Tensor) -> Tensor:
    """Mean of x_m conj(x_m') over each block of range frequencies, complex128 (..., bin, block,
    channel, channel); those of plain noise for silent trials (...,).
    """
    by_bin = lines.unflatten(-1, (blocks, -1)).movedim(-4, -2)
    products = (by_bin @ by_bin.mH).to(torch.complex128) / by_bin.shape[-1]
    noise = torch.eye(products.shape[-1], dtype=products.dtype, device=products.device)
    return torch.where(silent[..., None, None, None, None], noise, products)


@dataclass(frozen=True)
class _Models:
    """Covariances over the channels of clutter at rest, complex128 (Doppler bin in FFT order,
    channel, channel), to which noise of any level is added.
    """

    clutter: Tensor

    @staticmethod
    def of(radar: BistaticRadar, prior: Prior, bands: int, n_pulse: int, device: torch.device) -> _Models:
        motion = PointMotion.of(radar, torch.zeros((), device=device))
        offset = doppler_offsets(n_pulse, bands, radar.prf_hz, device).view(bands, n_pulse).T
        power = prior.power(offset, radar, motion)[:, None, :].to(torch.complex128)
        response = shared_response(radar, motion, n_pulse, bands, torch.complex128).T[..., None] * band_matrix(
            radar, motion, bands
        )
        return _Models(torch.roll((response * power) @ response.mH, first_bin(n_pulse, bands), 0))

    def noisy(self, snr_db: float) -> Tensor:
        return self.clutter + 10 ** (-snr_db / 10) * torch.eye(
            self.clutter.shape[-1], dtype=self.clutter.dtype, device=self.clutter.device
        )

    def solve(self, products: Tensor, snr_db: float) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (..., channel), half the Hessian, and minus the mean log-likelihood of a sample
        (...,). products: (..., bin, channel, channel).
        """
        model = self.noisy(snr_db)
        matrix = (torch.linalg.inv(model) * products.mT).mean(-3)
        weights, hessian, cost = _solved(matrix, self._start(products))
        return weights, hessian, 2 * cost + torch.linalg.slogdet(model)[1].mean()

    def best(self, products: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weights and half the Hessian of the most likely noise level, and that level, per
        trial.
        """
        found = [self.solve(products, level) for level in _LEVELS_DB]
        weights, hessian, cost = (torch.stack(parts, -1) for parts in zip(*found))
        best = cost.argmin(-1)
        levels = torch.tensor(_LEVELS_DB, dtype=torch.float64, device=best.device)
        return (
            take(weights.movedim(-1, best.ndim), best, best.ndim),
            take(hessian.movedim(-1, best.ndim), best, best.ndim),
            levels[best],
        )

    def _start(self, products: Tensor) -> Tensor:
        """Inverse gains from the products of channels, each against what the model expects: the
        strongest eigenvector of their sum over Doppler.
        """
        matched = (products * self.clutter.conj()).sum(-3)
        gains = torch.linalg.eigh(
            matched / self.clutter.abs().square().sum(-3).clamp_min(torch.finfo(torch.float64).tiny)
        )[1][..., -1]
        size = gains.abs()
        return torch.polar(1 / size.clamp_min(1e-3), -gains.angle())


def _solved(matrix: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The weights exp(a + j p) that minimise half of w^H Q w - 2 sum(a), (..., channel), with the
    Hessian of that over (a, p) and the minimum.

    Minus the log-likelihood of Gaussian samples with gains 1 / w. Newton steps, damped where they
    do not descend; the common phase stays.
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
    """Half of (w^H Q w - 2 sum(a)) with its gradient and Hessian over (a, p), w = exp(a + j p)."""
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


def _slope(weights: Tensor, frequency_hz: Tensor, reference: int) -> Tensor:
    """Delay (s) from the phases of weights (..., block, channel) against the reference channel over
    the middle frequencies of the blocks, (..., channel).
    """
    turn = weights * weights[..., reference, None].conj()
    step = frequency_hz[1] - frequency_hz[0]
    coarse = torch.angle((turn[..., 1:, :] * turn[..., :-1, :].conj()).sum(-2)) / (2 * math.pi * step)
    turn = turn * unit_phasor(-coarse[..., None, :] * frequency_hz[:, None], turn.dtype)
    angle = torch.angle(turn * turn.sum(-2, keepdim=True).conj())
    f = frequency_hz[:, None] - frequency_hz.mean()
    return coarse + (angle * f).sum(-2) / f.square().sum() / (2 * math.pi)


def _judged(
    weights: Tensor,
    hessian: Tensor,
    delay_s: Tensor,
    snr_db: Tensor,
    silent: Tensor,
    reference: int,
    looks: float,
    centres: Tensor | None,
) -> Estimate:
    value = {
        "phase_rad": torch.angle(weights.conj() * weights[..., reference, None]),
        "gain_db": 20 * torch.log10(weights[..., reference, None].abs() / weights.abs()),
        "delay_s": delay_s - delay_s[..., reference, None],
    }
    log_std, phase_std = _deviations(hessian, reference, looks)
    per_hz = 0.0 if centres is None else 1 / (2 * math.pi * float(centres.square().mean().sqrt()))
    std = {"phase_rad": phase_std, "gain_db": log_std * (20 / math.log(10)), "delay_s": phase_std * per_hz}
    worst = phase_std.amax(-1)
    ok = torch.stack([v.isfinite().all(-1) for v in value.values()]).all(0) & ~silent & (worst < _TRUSTED_RAD)
    value = {name: torch.where(ok[..., None], v, 0.0) for name, v in value.items()}
    return Estimate(value, torch.where(ok, 1 - worst / _TRUSTED_RAD, 0.0).clamp(0, 1), ok, std, {"snr_db": snr_db})


def _deviations(hessian: Tensor, reference: int, looks: float) -> tuple[Tensor, Tensor]:
    """Of log gains and phases (..., channel) against the reference, from half the Hessian of minus
    the log-likelihood of a sample; 1e3 where nothing holds them.
    """
    channels = hessian.shape[-1] // 2
    others = [i for i in range(2 * channels) if i % channels != reference]
    values, vectors = torch.linalg.eigh(hessian[..., others, :][..., others])
    variance = (vectors.square() / (2 * looks * values).clamp_min(1e-6)[..., None, :]).sum(-1)
    std = torch.zeros_like(hessian[..., 0])
    std[..., others] = variance.sqrt()
    return std[..., :channels], std[..., channels:]


class EstimateBalance(Stage):
    """`estimate_balance` as a stage; its values go into `CorrectBalance`."""

    works_on = ("channel", "pulse", "range")
    provides = ("phase_rad", "gain_db", "delay_s")

    def __init__(
        self, radar: BistaticRadar, prior: Prior | None = None, bands: int = 5, delays: bool = True, blocks: int = 16
    ) -> None:
        super().__init__()
        self.radar, self.prior, self.bands, self.delays, self.blocks = radar, prior, bands, delays, blocks

    def forward(self, signal: Signal) -> Estimate:
        return estimate_balance(signal.data, self.radar, self.prior, self.bands, self.delays, self.blocks)


class CorrectBalance(Stage):
    """`correct_balance` by values that were estimated or measured: `use(CorrectBalance(radar),
    phase_rad="balance", gain_db="balance", delay_s="balance")`.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar

    def forward(self, signal: Signal, phase_rad: Tensor, gain_db: Tensor, delay_s: Tensor | None = None) -> Signal:
        return signal.with_data(
            correct_balance(signal.data, self.radar, phase_rad, gain_db, delay_s, "range" in signal.names)
        )
