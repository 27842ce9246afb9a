"""Radial velocity by segmented interference, the method of Remote Sens. 2024, 16, 793."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, bands_of, inside, refuse_other_sweeps, window_lines
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.correlation import envelope_lag
from torchsar.compensate.radial.peak import from_beats, shining
from torchsar.compensate.radial.verdict import velocity_estimate
from torchsar.core import Axis, Estimate, cis
from torchsar.radar import TriangularLadar

Bins = Literal["peak", "sum"]
Unwrap = Literal["gradient", "per_pulse"]
_SUM_UPSAMPLING = 20  # of the spectra whose lag is removed first with "sum", as in section 3.3.2 of the paper


def segmented_interference(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    bins: Bins = "peak",
    unwrap: Unwrap = "gradient",
    scatterers: int = 1,
    padding: int = 4,
    hann: bool = False,
    window_m: tuple[float, float] | None = None,
    azimuth_m: Tensor | float = 0.0,
) -> Estimate:
    """Estimate the radial velocity from the phase between the halves of both sweeps.

    Let U1 and U2 be the spectra of the first and the second half of the up sweep, and D1 and D2
    those of the halves of the conjugated down sweep. The phase
    phi = arg{U1 conj(D1) conj(U2 conj(D2))} is then -2 pi T fd, with sweep length T and Doppler
    shift fd. Two conditions that the printed equations omit are met: the phase of each spectrum
    refers to the centre of its half, and up and down sweeps are each evaluated at their own peaks.
    Differentiable; peaks and whole turns are held constant.

    For scenes with scatterers closer in range than c / B, where B is the bandwidth of a sweep, use
    `bins="sum"` or `mirror_product`.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        bins: Frequency bins in which the phase is read. "peak" takes those of the strongest
            scatterers, which must be c / B or more apart. The phase changes of the scatterers from
            period to period are averaged with weights from the contrast (Eqs. (18) and (19)). "sum"
            adds the complex products of all bins, for dense scenes.
        unwrap: How the whole turns of the phase are found. "per_pulse" takes them for every period
            from the lag between the range envelopes of the two sweeps. "gradient", the published
            method, does so for one period only and then adds the wrapped phase changes from period
            to period. It slips by a turn where the velocity changes by lambda / (4 T) per period,
            or where the SNR after compression is below 16 dB.
        scatterers: Number of scatterers with "peak". Each is used in the periods in which it is
            illuminated.
        padding: Factor of the zero-padding of the halves, 1..16.
        hann: True applies a Hann window to each half, for range windows with other scatterers.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).

    Returns:
        `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps), receding
        positive, with its standard deviation, see `mirror_product`. `ok` is False where the SNR
        after compression is below 16 dB, the standard deviation exceeds 0.035 lambda / T, the
        product of up and mirrored down sweeps contradicts the velocities in many periods, or no
        scatterer is illuminated in any period. `info` holds

        - "phase_rad" and "integer" (whole turns), shape (..., pulse);
        - "slips", the number of changes between periods in which "gradient" and "per_pulse" differ
          by a turn, shape (...,);
        - "dispersion", the standard deviation of the amplitude over the periods divided by its
          mean, shape (...,);
        - "weights" of the scatterers, averaged over the periods, shape (..., scatterers);
        - "snr_db", "shift" and "lit", as for `mirror_product`.

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, an option or the window are invalid.

    Reference:
        Remote Sens. 2024, 16, 793, Eqs. (14)-(20), corrected.
    """
    refuse_other_sweeps(sweeps, radar, "segmented_interference", pulse)
    if bins not in ("peak", "sum") or unwrap not in ("gradient", "per_pulse"):
        raise ValueError(
            f"bins must be 'peak' or 'sum' and unwrap 'gradient' or 'per_pulse', got bins {bins!r} and unwrap "
            f"{unwrap!r}"
        )
    if not (isinstance(scatterers, int) and scatterers >= 1 and isinstance(padding, int) and 1 <= padding <= 16):
        raise ValueError(
            "scatterers must be 1 or more and padding 1..16, both whole numbers, got scatterers "
            f"{scatterers} and padding {padding}"
        )
    window_lines(radar, window_m)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = bands_of(sweeps, radar, video=bins == "peak")
        windowed = bands_of(sweeps, radar, window_m, taper=0.0)
        coarse = envelope_lag(windowed, _SUM_UPSAMPLING if bins == "sum" else 4) / 2 + (windowed.shift - bands.shift)
        spectra = _halves(_shifted(bands, coarse) if bins == "sum" else bands, padding, hann)
        searched = inside(radar, window_m, spectra[0].shape[-1], padding / 2, sweeps.device)
        phases, weights, changes = (
            _summed(spectra, searched, coarse) if bins == "sum" else _at_peaks(spectra, searched, padding, scatterers)
        )
        bands = replace(bands, lit=bands.lit & (weights > 0).any(-2))
        phase, integer, slips = _unwrapped(phases, weights, coarse, bands, unwrap)
        doppler = (integer - phase / (2 * math.pi)) / radar.sweep_s
        info = {
            "phase_rad": phase,
            "integer": integer + bands.shift,
            "slips": slips,
            "weights": weights.mean(-1),
            "dispersion": _dispersion(bands),
        }
        return velocity_estimate(
            from_beats(doppler, -doppler, bands),
            bands_of(sweeps, radar, window_m, taper=0.5, oversampling=2),
            pulse,
            factor=4.0,
            azimuth_m=azimuth_m,
            spread_m_s=_weighted(changes, weights) * (radar.ambiguous_velocity_m_s / (2 * math.pi)),
            lit=bands.lit,
            info=info,
        )

    return by_trials(estimator, sweeps, azimuth_m)


def _halves(bands: Bands, padding: int, hann: bool) -> tuple[Tensor, ...]:
    """Spectra of both halves of up and of mirrored down sweeps, (..., pulse, bin) each.

    Their phases have the same reference.
    """
    h = bands.time_s.shape[-1] // 2
    window = torch.hann_window(h, periodic=False, dtype=bands.up.real.dtype, device=bands.up.device) if hann else None
    parts = [x[..., half] for x in (bands.up, bands.down) for half in (slice(0, h), slice(h, 2 * h))]
    up1, up2, down1, down2 = (torch.fft.fft(x if window is None else x * window, padding * h) for x in parts)
    # the halves of the conjugated down sweep are the conjugate halves of the mirrored sweep, in
    # reverse order
    return up1, up2, down2, down1


def _power(*parts: Tensor) -> Tensor:
    """Sum of the powers of several spectra."""
    total = torch.zeros_like(parts[0].real)
    for x in parts:
        total = total + x.real.square() + x.imag.square()
    return total


def _shifted(bands: Bands, shift: Tensor) -> Bands:
    """The sweeps with a further Doppler shift in bins, (..., pulse), removed."""
    angle = 2 * math.pi * shift[..., None] * (bands.time_s / bands.radar.sweep_s)
    turn = cis(angle.to(bands.up.real.dtype))
    return replace(bands, up=bands.up * turn.conj(), down=bands.down * turn)


def _summed(halves: tuple[Tensor, ...], searched: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phase (..., 1, pulse) between the halves from products summed over bins, and weights of one.

    The third result is the phase that the changes of power would give, see `product_spread`.

    Up and down spectra are multiplied and summed before the halves are combined: each sum is then
    the power spectrum of the scene times one phasor, for any scene, after the Doppler shift
    `coarse` (bins) is removed. Otherwise a dense scene would determine where in its half the phase
    is read. The removed phase is added again.
    """
    up1, up2, down1, down2 = (x[..., searched] for x in halves)
    first, second = ((up * down.conj()).sum(-1) for up, down in ((up1, down2), (up2, down1)))
    phase = (torch.angle(first * second.conj()).to(torch.float64) - 2 * math.pi * coarse)[..., None, :]
    changes = [
        (_power(up).sum(-1) - _power(down).sum(-1)) / (2 * both.abs()).clamp_min(torch.finfo(up.real.dtype).tiny)
        for up, down, both in ((up1, down2, first.detach()), (up2, down1, second.detach()))
    ]
    return phase, torch.ones_like(phase), (changes[0] - changes[1]).to(torch.float64)[..., None, :]


def _at_peaks(
    halves: tuple[Tensor, ...], searched: Tensor, padding: int, scatterers: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Phases at the peaks of up and of down spectra, and the weights of Eq. (18).

    The third result is the phase that the changes of power would give, see `product_spread`. All
    are (..., scatterer, pulse). A weight is zero in periods where the scatterer is not illuminated.
    """
    up1, up2, down1, down2 = halves
    up, down = _power(up1, up2), _power(down1, down2)
    peaks = _strongest(torch.where(searched, (up + down).detach().mean(-2), -1), scatterers, padding)
    reach, tiny = max(1, padding), torch.finfo(up.dtype).tiny
    phases, weights, changes = [], [], []
    for peak in peaks.unbind(-1):
        at_up, at_down = (_own_peak(power.detach(), peak, reach) for power in (up, down))
        turn = _picked(up1 * up2.conj(), at_up) * _picked(down1 * down2.conj(), at_down)
        phases.append(torch.angle(turn).to(torch.float64))
        levels = [_picked(_power(x), at) for x, at in ((up1, at_up), (up2, at_up), (down1, at_down), (down2, at_down))]
        first, second, third, fourth = (x.to(torch.float64).clamp_min(tiny).log() / 2 for x in levels)
        changes.append(first - second + third - fourth)
        weight = _contrast_about((up + down).detach().sqrt(), peak, reach).to(torch.float64)
        weights.append(weight[..., None] * shining(_picked(up, at_up), _picked(down, at_down)))
    return torch.stack(phases, -2), torch.stack(weights, -2), torch.stack(changes, -2)


def _strongest(profile: Tensor, count: int, spacing: int) -> Tensor:
    """Bins (..., count) of the greatest values of a circular profile, at a spacing or more."""
    n = profile.shape[-1]
    left, found = profile.clone(), []
    index = torch.arange(n, device=profile.device)
    for _ in range(count):
        best = left.argmax(-1, keepdim=True)
        found.append(best)
        distance = ((index - best + n // 2) % n - n // 2).abs()
        left = torch.where(distance < 2 * spacing, torch.full_like(left, -1.0), left)
    return torch.cat(found, -1)


def _own_peak(power: Tensor, peak: Tensor, reach: int) -> Tensor:
    """Bin (..., pulse) of the greatest power (..., pulse, n) near a peak (...,)."""
    n = power.shape[-1]
    near = (peak[..., None] + torch.arange(-reach, reach + 1, device=power.device)) % n
    near = near[..., None, :].expand(*power.shape[:-1], -1)
    best = power.gather(-1, near).argmax(-1, keepdim=True)
    return near.gather(-1, best)[..., 0]


def _picked(x: Tensor, index: Tensor) -> Tensor:
    """Values at one index per period."""
    return x.gather(-1, index[..., None])[..., 0]


def _contrast_about(amplitude: Tensor, peak: Tensor, reach: int) -> Tensor:
    """Standard deviation over mean of amplitudes (..., pulse, n) in a window about a peak (...,).

    Eq. (18) of the paper, made independent of scale.
    """
    n = amplitude.shape[-1]
    near = (peak[..., None] + torch.arange(-4 * reach, 4 * reach + 1, device=amplitude.device)) % n
    part = amplitude.gather(-1, near[..., None, :].expand(*amplitude.shape[:-1], -1))
    mean = part.mean((-2, -1))
    spread = (part - mean[..., None, None]).square().mean((-2, -1)).sqrt()
    return torch.where(mean > 0, spread / torch.where(mean > 0, mean, 1), 0)


def _unwrapped(
    phases: Tensor, weights: Tensor, coarse: Tensor, bands: Bands, unwrap: Unwrap
) -> tuple[Tensor, Tensor, Tensor]:
    """One phase and its integer per period, (..., pulse) each, and the number of slips (...,).

    coarse: fd T of the envelopes beyond the removed shift.
    """
    turn = 2 * math.pi
    integer = torch.round(coarse[..., None, :] + phases.detach() / turn)
    own = _weighted(phases - turn * integer, weights)  # phase minus whole turns: fd T = -own / 2 pi
    pairs = torch.minimum(weights[..., 1:], weights[..., :-1])
    step = _weighted(_wrapped(_steps(phases)), pairs)
    # with the removed shift, which the gradient of the phase does not contain
    beyond = own - turn * bands.shift.to(torch.float64)
    both = bands.lit[..., 1:] & bands.lit[..., :-1] & (pairs > 0).any(-2)
    step = torch.where(both, step, _steps(beyond))
    gradient = torch.cat([torch.zeros_like(own[..., :1]), step.cumsum(-1)], -1)
    first = bands.lit.to(torch.int8).argmax(-1, keepdim=True)
    gradient = gradient + (beyond - gradient).gather(-1, first)
    slips = ((_steps(torch.round((gradient - beyond).detach() / turn)) != 0) & both).sum(-1).to(torch.float64)
    chosen = gradient + turn * bands.shift.to(torch.float64) if unwrap == "gradient" else own
    whole = -torch.round(chosen.detach() / turn)
    return chosen + turn * whole, whole, slips


def _weighted(x: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over scatterers, (..., pulse); zero where all weights are zero."""
    return (x * weights).sum(-2) / weights.sum(-2).clamp_min(torch.finfo(weights.dtype).tiny)


def _steps(x: Tensor) -> Tensor:
    """Differences between successive entries."""
    return x[..., 1:] - x[..., :-1]


def _wrapped(x: Tensor) -> Tensor:
    """Phases modulo 2 pi; the removed turns are detached."""
    return x - 2 * math.pi * torch.round(x.detach() / (2 * math.pi))


def _dispersion(bands: Bands) -> Tensor:
    """Standard deviation over mean, (...,), of the amplitude in the window over the periods."""
    level = bands.up.detach().abs().mean(-1).to(torch.float64)
    mean = level.mean(-1)
    return torch.where(mean > 0, level.std(-1, correction=0) / torch.where(mean > 0, mean, 1), 0)
