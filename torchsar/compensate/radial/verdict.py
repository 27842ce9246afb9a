"""Accuracy and reliability of an estimated radial velocity."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, filled
from torchsar.compensate.radial.newton import climbed
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Estimate, Outcome, cis, power_of, settle

Intercept = Literal["known", "record", "free"]
# SNR of a sweep after compression below which noise may exceed the peak in single periods and the
# gradient may slip: measured 1 slip in 1000 periods at 13 dB, none from 14 dB on; the measured SNR
# has an error of a decibel or two
LEAST_SNR_DB = 16.0
LEAST_SQUARED_DB = 15.0  # the same for a product of sweeps, after the squaring loss, found by trial
# SNR after the squaring loss below which a period has faded: noise may exceed its peak
_FADED_DB = 12.0
# share of the mean power below which it has faded too: interference then spoils the phase
_DEEP = 0.05
# A difference from the peaks of the product of this share of wavelength over sweep length
# contradicts a velocity where the peak is higher by this factor, which is that of a tone at this
# difference; if it occurs in more than a twentieth of the periods, it contradicts the estimate;
# zero-padding.
_CONTRADICTION, _HIGHER, _CHANCE, _PAD = 0.06, 1.1, 0.05, 2
# bias of the peaks of the product that the edges of the window leave, in halves of wavelength over
# sweep length
_BIAS = 5e-4
# least share of an echo in its mean over the record, and over what noise alone would give
_DARK, _CLEAR = 0.2, 3.0
# a difference of so many standard deviations is no chance
_GROSS = 4.0
# periods for which the deviation that noise explains counts beside the measured one
_EXPECTED = 4.0
# standard deviation, in halves of wavelength over sweep length, beyond which a velocity is of no
# use; noise alone gives 0.05 where the SNR is just enough
_USELESS = 0.07


def signal_and_noise(bands: Bands, residual_m_s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Measure the mean power per sample of the scene and of the noise.

    After the motion is removed, the power that the up sweep and the mirrored down sweep have in
    common is taken as scene, and the rest as noise.

    Args:
        bands: Filtered sweeps.
        residual_m_s: Radial velocity minus that of the Doppler shift already removed from `bands`,
            in m/s, shape (..., pulse).

    Returns:
        The powers of scene and noise, shape (...,) each, and the power in common in every period,
        shape (..., pulse), float64.
    """
    inner = bands.inner
    up, down = bands.up.detach()[..., inner], bands.down.detach()[..., inner]
    turns = 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s * residual_m_s.detach()
    static = cis((-2 * math.pi * turns[..., None] * bands.time_s[inner]).to(up.real.dtype))
    weight = bands.lit.to(torch.float64)
    weight = weight / weight.sum(-1, keepdim=True).clamp_min(1)
    common = (up * down.conj() * static).mean(-1).abs().to(torch.float64)
    shared = (common * weight).sum(-1)
    total = (sum(power_of(x).mean(-1).to(torch.float64) for x in (up, down)) * weight).sum(-1) / 2
    # the magnitude of a mean of noise is not zero: what noise alone would give counts as no signal
    chance = total / math.sqrt(min(up.shape[-1], 2 * bands.noise_lines))
    signal = torch.where(shared > 1.5 * chance, shared, 0).clamp_max(total)
    return signal, total - signal, common


@torch.no_grad()
def product_spread(bands: Bands, residual_m_s: Tensor, intercept: Intercept) -> tuple[Tensor, Tensor]:
    """Compute the velocities that the changes of power between both sweeps would give as phases.

    Noise, and the interference of scatterers of random phases, disturb the power of the echo as
    much as its phase, and independently: for a complex amplitude s that changes by ds, the real and
    the imaginary part of conj(s) ds have equal variances. Motion changes the phase only. Therefore
    the estimator has the same deviation if it is applied to the changes of power in place of those
    of the phase, whatever the scene.

    Args:
        bands: Filtered sweeps with two samples per bin.
        residual_m_s: Radial velocity minus that of the Doppler shift already removed from `bands`,
            in m/s, shape (..., pulse).
        intercept: "known", "record" or "free", see `mirror_product`.

    Returns:
        The velocities in m/s, and the share of a second difference of the velocity over a period
        that jerk adds to the velocity, shape (..., pulse) each, float64.
    """
    inner, radar = bands.inner, bands.radar
    u, up, down = bands.time_s[inner], bands.up[..., inner], bands.down[..., inner]
    between_s = radar.sweep_s - 2 * u  # from a sample of the up sweep to that of the down sweep
    w = -4 * math.pi * radar.carrier_hz / radar.wave_speed_m_s * between_s
    static = cis((-residual_m_s[..., None] * w).to(up.real.dtype))
    power = (up * down.conj() * static).real.to(torch.float64)
    excess = (power_of(up) - power_of(down)).to(torch.float64) / 2
    # the mean velocity over a time s about the turning point exceeds v there by s^2 / 24 d2v/dt2
    jerk = power * w * (between_s / radar.period_s).square() / 24
    return _fitted(power, excess, w, intercept), _fitted(power, jerk, w, intercept)


def _fitted(power: Tensor, phase: Tensor, w: Tensor, intercept: Intercept) -> Tensor:
    """Velocity (..., pulse) of a phase times power (..., pulse, m), with dphase/dvelocity w."""
    total = power.sum(-1, keepdim=True)
    total = torch.where(total.abs() > torch.finfo(torch.float64).tiny, total, 1)
    centred = w - (w * power).sum(-1, keepdim=True) / total
    free = _ratio((centred * phase).sum(-1), (centred.square() * power).sum(-1))
    if intercept == "free":
        return free
    if intercept == "record":
        rest = (phase - w * free[..., None] * power).sum((-2, -1), keepdim=True)
        phase = phase - power * rest / total.sum(-2, keepdim=True)
    return _ratio((w * phase).sum(-1), (w.square() * power).sum(-1))


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b, zero where b is not positive."""
    return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)


@torch.no_grad()
def _product_peaks(bands: Bands) -> tuple[Tensor, Tensor, Tensor]:
    """Velocities in m/s of the peaks of the product of up and mirrored down sweeps, (..., pulse).

    The velocity of the Doppler shift already removed from the bands is not included. The peaks are
    searched over all velocities. The second result is the power per sample that both sweeps share
    there. Periods with an echo are marked True: what both sweeps share is
    then a fifth of the mean over the record or more, and three times what noise alone would share.
    """
    inner = bands.inner
    u = bands.time_s[inner]
    z = bands.product()[..., inner]
    level = z.abs().mean(-1, keepdim=True)
    z = z / level.clamp_min(torch.finfo(z.real.dtype).tiny)
    spectrum = torch.fft.fft(z, _PAD * z.shape[-1])
    n = spectrum.shape[-1]
    bins = power_of(spectrum).argmax(-1)
    bins = torch.where(bins >= n // 2, bins - n, bins)
    per = 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s
    peak = climbed(z, 2 * math.pi * per * u, bins.to(torch.float64) / (n * (u[1] - u[0]) * per), 3)
    shared = spectrum.abs().amax(-1).to(torch.float64) * level[..., 0] / z.shape[-1]
    chance = level.to(torch.float64).mean(-2) / math.sqrt(min(z.shape[-1], 2 * bands.noise_lines))
    return peak, shared, shared > torch.maximum(_DARK * shared.mean(-1, keepdim=True), _CLEAR * chance)


def _mean(x: Tensor, weight: Tensor) -> Tensor:
    """Mean over the periods with weight (bool), (..., pulse) to (..., 1)."""
    return torch.where(weight, x, 0).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1)


def _rms_difference(velocity: Tensor, known: Tensor, order: int, noise: Tensor) -> Tensor:
    """Rms first or second difference of velocities (..., pulse) in known periods beyond that of
    noise with the variance (..., 1); (..., 1).
    """
    if velocity.shape[-1] <= order:
        return torch.zeros_like(velocity[..., :1])
    square = _mean(velocity.diff(n=order).square(), known.unfold(-1, order + 1, 1).all(-1))
    return (square - math.comb(2 * order, order) * noise).clamp_min(0).sqrt()


def _interpolated(known: Tensor, slope: Tensor, bend: Tensor) -> Tensor:
    """Error (..., pulse) of `filled` in the periods that are not known; zero elsewhere.

    slope, bend: rms first and second difference of the values, (..., 1).
    """
    at = torch.arange(known.shape[-1], device=known.device).expand(known.shape)
    before = at - torch.where(known, at, -1).cummax(-1).values
    after = torch.where(known, at, 2 * at.shape[-1]).flip(-1).cummin(-1).values.flip(-1) - at
    inside = (before <= at) & (after < at.shape[-1])
    return torch.where(inside, bend * before * after / 2, slope * torch.minimum(before, after))


def velocity_estimate(
    velocity_m_s: Tensor,
    product: Bands,
    pulse: Axis,
    *,
    factor: float,
    azimuth_m: Tensor | float,
    spread_m_s: Tensor | None = None,
    intercept: Intercept | None = None,
    floor_m_s: float = 0.0,
    lit: Tensor | None = None,
    info: dict[str, Tensor] | None = None,
) -> Estimate:
    """Complete a measured radial velocity to an estimate with its accuracy and reliability.

    White noise gives the variance factor * (lambda / 2)^2 / ((2 pi T)^2 g), plus the square of
    `floor_m_s`, where T is the length of a sweep and g the energy of a sweep over the noise
    variance of a sample. Noise and interference together are measured by the changes of power
    between both sweeps, see `product_spread`; the variance is inversely proportional to the power
    of a period. Added are the effect of jerk, the error of interpolation in periods that have faded
    or in which no scatterer is illuminated, and, for a method that does not use the product of up
    and mirrored down sweeps, its mean difference from the peaks of that product, because the
    scatterer that it follows may have another velocity than the scene. The variance of such a
    method is also no less than that of these differences less the variance of the peaks: where
    scatterers have equal phases, their interference changes the power less than the phase.

    Args:
        velocity_m_s: Measured velocity at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse). It still includes the geometric velocity of a static scatterer, see
            `geometric_velocity_m_s`.
        product: Sweeps filtered to the range window, with two samples per bin, from whose product
            the estimate is judged.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        factor: Factor of the variance, which depends on the method of measurement.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).
        spread_m_s: Velocities in m/s that the changes of power give with the weights of the
            method, shape (..., pulse); by default those of the slope of the phase of the product.
        intercept: Intercept of a method that measures the product itself, see `mirror_product`; the
            variance then includes the squaring loss at low SNR.
        floor_m_s: Standard deviation in m/s that remains however strong the signal.
        lit: False for periods in which the method found no echo, shape (..., pulse), bool.
        info: Further entries for `info` of the estimate.

    Returns:
        `velocity_m_s` of shape (..., pulse), receding positive, without the geometric velocity,
        with its standard deviation. `quality` is the share of the power in the window that both
        sweeps have in common. `ok` is False where the SNR after compression is below 16 dB (with
        `intercept`, where this SNR less the squaring loss is below 15 dB), where the standard
        deviation exceeds 0.035 lambda / T, where the product of up and mirrored down sweeps
        contradicts the velocities, where no scatterer is illuminated in any period, or where a
        velocity is not finite. `info` holds "snr_db", the SNR after compression, and "noise_m_s",
        the standard deviation that is due to noise, shape (...,) each; "shift", the Doppler shift
        removed from `product` in whole bins, and "lit", False for periods in which no scatterer is
        illuminated, both of shape (..., pulse); and the entries given.
    """
    radar, tiny = product.radar, torch.finfo(torch.float64).tiny
    bin_m_s = radar.wavelength_m / (2 * radar.sweep_s)
    lit = product.lit if lit is None else product.lit & lit
    measured, finite = settle(filled(velocity_m_s, lit), 0.0)
    signal, noise, common = signal_and_noise(product, measured - product.shift_m_s)
    ratio = (signal / noise.clamp_min(tiny)).clamp(1e-6, 1e18)
    after = ratio * product.noise_lines  # energy of a sweep over the noise variance of a sample
    loss = 1 + 1 / (2 * ratio)
    expected = bin_m_s * torch.sqrt(factor * (loss if intercept else 1) / after) / (2 * math.pi)
    snr_db, squared_db = 10 * torch.log10(after), 10 * torch.log10(after / loss)
    enough = squared_db >= LEAST_SQUARED_DB if intercept else snr_db >= LEAST_SNR_DB
    own = (common / noise.clamp_min(tiny)[..., None]).clamp(1e-6, 1e18)
    mean = _mean(common, lit | ~lit.any(-1, keepdim=True))
    share = (common / mean.clamp_min(tiny)).clamp_min(1e-6)  # power of a period over the mean
    clear = lit & (share > _DEEP) & (10 * torch.log10(own * product.noise_lines / (1 + 1 / (2 * own))) >= _FADED_DB)
    velocity = filled(measured, clear)

    # deviation: noise and interference, jerk, and differences from the peaks of the product
    residual = (velocity - product.shift_m_s).detach()
    slope, jerk = product_spread(product, residual, "free")
    if intercept is not None:
        spread, jerk = product_spread(product, residual, intercept)
    else:
        spread = slope / loss.sqrt()[..., None] if spread_m_s is None else spread_m_s
    count = clear.sum(-1, keepdim=True)

    def variance(of: Tensor, expected: Tensor) -> Tensor:
        # a constant part is that of the detector or of the laser: sweeps that differ in power
        changes = of - _mean(of * share, clear) / _mean(share, clear).clamp_min(tiny)
        counted = count * _mean(changes.square() * share, clear) + _EXPECTED * expected.square()[..., None]
        return counted / ((count - 1).clamp_min(0) + _EXPECTED)

    square = filled(variance(spread, expected) / share, clear)
    differences = [_rms_difference(measured.detach(), clear, order, _mean(square, clear)) for order in (1, 2)]
    square = square + _interpolated(clear, *differences).square()
    bend = differences[1] * (radar.period_s / pulse.step) ** 2
    square = square + (_mean(jerk * share, clear) * bend).square() + floor_m_s**2
    peaks, shared, echo = _product_peaks(product)
    away = residual - peaks
    far_m_s = 2 * _CONTRADICTION * bin_m_s
    off = echo & (away.abs() > far_m_s) & (shared > _HIGHER * common)
    best_signal, best_noise, _ = signal_and_noise(product, peaks)
    best = (best_signal / best_noise.clamp_min(tiny)).clamp(1e-6, 1e18)
    judged = 10 * torch.log10(best * product.noise_lines / (1 + 1 / (2 * best))) >= LEAST_SQUARED_DB
    contradicted = judged & (off.sum(-1) > _CHANCE * echo.sum(-1))
    if intercept is None:
        offset = _mean(away, echo & ~off)
        chance = (variance(spread, expected) + variance(slope, expected)) / count.clamp_min(1) + floor_m_s**2
        constant = (offset.square() - 2 * chance - (_BIAS * bin_m_s) ** 2).clamp_min(0)
        wrong = off & (away.square() > _GROSS**2 * variance(slope, expected) / share)
        square = square + torch.where(judged[..., None], constant + torch.where(wrong, away.square(), 0), 0)
        # the variance is no less than that of the distance from the peaks, less their own
        near, own = echo & clear & ~off, variance(slope.clamp(-far_m_s, far_m_s), expected)
        apart = _mean(away.square() * share - own, near) / _mean(share, near).clamp_min(tiny)
        apart = apart - (_BIAS * bin_m_s) ** 2
        square = torch.where(judged[..., None], torch.maximum(square, apart), square)
    std = square.sqrt()
    found = signal > 0
    centre = (product.first + product.lines / 2) * radar.range_step_m
    geometric = geometric_velocity_m_s(radar, pulse, azimuth_m, centre, velocity.device)
    return Estimate(
        {"velocity_m_s": velocity - geometric},
        {"velocity_m_s": std},
        torch.where(found, signal / (signal + noise).clamp_min(tiny), 0),
        Outcome.of(
            enough
            & finite.all(-1)
            & found
            & lit.any(-1)
            & ~contradicted
            & (_mean(square, product.lit)[..., 0] < (_USELESS * bin_m_s) ** 2),
            Outcome.NOISE,
        ),
        info={
            "snr_db": snr_db,
            "noise_m_s": torch.hypot(expected, torch.full_like(expected, floor_m_s)),
            "shift": product.shift,
            "lit": lit,
            **(info or {}),
        },
    )
