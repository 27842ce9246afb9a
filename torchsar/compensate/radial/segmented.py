"""Radial velocity by segmented interference, the method of Remote Sens. 2024, 16, 793."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, Spectra, inside, window_lines
from torchsar.compensate.radial.beats import envelope_lag, from_beats, shining
from torchsar.compensate.radial.blocks import Window, _SweepEstimator, velocities
from torchsar.compensate.radial.measured import Law, Measured
from torchsar.core import (
    Axis,
    Estimate,
    cis,
    differentiable,
    power_of,
    take,
)
from torchsar.radar import TriangularLadar

Bins = Literal["peak", "sum"]
Unwrap = Literal["gradient", "per_pulse"]


@differentiable("where ok")
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
    assess: bool = True,
) -> Estimate:
    """Estimate the radial velocity from the phase between the halves of both sweeps.

    >>> import torch
    >>> from torchsar.compensate import segmented_interference
    >>> from torchsar.radar import TriangularLadar
    >>> ladar = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 64, 128, dtype=torch.complex64)  # a point at the reference range
    >>> found = segmented_interference(sweeps, ladar, ladar.sweep_axes(64)[1])
    >>> bool(found["velocity_m_s"].abs().max() < 0.01)
    True

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
        assess: False leaves out the standard deviation and the outcome.

    Returns:
        `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps), receding
        positive.
        `assess=True` adds the standard deviation and the outcome, see `assessed_velocity`:
        `Outcome.INEXACT` where the SNR is too low or the standard deviation exceeds
        0.035 lambda / T (T is the length of a sweep), `PARTS_DISAGREE` where a part of the echo has
        another velocity, `AMBIGUOUS` where both sweeps have more power in common at another
        velocity, `NOISE` where they have no more in common than noise, and `EMPTY` for samples of
        zero. `quality` is the share of the power in the window that both
        sweeps have in common. `info` holds "snr_db" (after compression) and "noise_m_s"
        (standard deviation that noise explains), shape (...,); "shift" (Doppler shift in whole
        bins) and "lit" (True in periods with an echo), shape (..., pulse); and

        - "phase_rad" and "integer" (whole turns), shape (..., pulse);
        - "slips", the number of changes between periods in which "gradient" and "per_pulse" differ
          by a turn, shape (...,);
        - "weights" of the scatterers, averaged over the periods, shape (..., scatterers).

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, an option or the window are invalid.

    Reference:
        Remote Sens. 2024, 16, 793, Eqs. (14)-(20), corrected.
    """
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

    def measure(spectra: Spectra) -> Measured:
        bands = spectra.bands(video=bins == "peak")
        windowed = spectra.bands(window_m, taper=0.0)
        # "sum" uses the upsampling factor of section 3.3.2 of the paper
        coarse = envelope_lag(windowed, 20 if bins == "sum" else 4) / 2 + (windowed.shift - bands.shift)
        moved = bands
        if bins == "sum":  # bands without the Doppler shift that the envelopes show
            turn = cis((2 * math.pi * coarse[..., None] * (bands.time_s / radar.sweep_s)).to(bands.up.real.dtype))
            moved = replace(bands, up=bands.up * turn.conj(), down=bands.down * turn)
        halves = _halves(moved, padding, hann)
        searched = inside(radar, window_m, halves[0].shape[-1], padding / 2, sweeps.device)
        phases, weights, of_power = (
            _summed(halves, searched, coarse) if bins == "sum" else _at_peaks(halves, searched, padding, scatterers)
        )
        bands = replace(bands, lit=bands.lit & (weights > 0).any(-2))
        phase, integer, slips = _unwrapped(phases, weights, coarse, bands, unwrap)
        doppler = (integer - phase / (2 * math.pi)) / radar.sweep_s
        return Measured.of(
            from_beats(doppler, -doppler, bands),
            spectra.bands(window_m, taper=0.5, oversampling=2),
            Law(4.0, changes=lambda: _weighted(of_power(), weights) * radar.ambiguous_velocity_m_s / (2 * math.pi)),
            bands.lit,
            phase_rad=phase,
            integer=integer + bands.shift,
            slips=slips,
            weights=weights.mean(-1),
        )

    return velocities("segmented_interference", measure, sweeps, radar, pulse, azimuth_m, assess)


def _halves(bands: Bands, padding: int, hann: bool) -> tuple[Tensor, ...]:
    """Spectra of both halves of the up and of the mirrored down sweeps, (..., pulse, bin) each.

    Their phases have the same reference.
    """
    h = bands.time_s.shape[-1] // 2
    window = torch.hann_window(h, periodic=False, dtype=bands.up.real.dtype, device=bands.up.device) if hann else None
    parts = [x[..., half] for x in (bands.up, bands.down) for half in (slice(0, h), slice(h, 2 * h))]
    up1, up2, down1, down2 = (torch.fft.fft(x if window is None else x * window, padding * h) for x in parts)
    # the halves of the conjugated down sweep are the conjugate halves of the mirrored sweep, in
    # reverse order
    return up1, up2, down2, down1


def _summed(
    halves: tuple[Tensor, ...], searched: Tensor, coarse: Tensor
) -> tuple[Tensor, Tensor, Callable[[], Tensor]]:
    """Phase (..., 1, pulse) between the halves, from products summed over bins, and weights of one.

    The third result is a function that returns the phase that corresponds to the changes of power,
    see `Law`. Up and down spectra are multiplied and summed before the halves are combined. After
    the Doppler shift `coarse` (bins) is removed, each sum is the power spectrum of the scene times
    one phasor, for any scene. Otherwise the distribution of a dense scene within a half would
    change the phase. The removed phase is added again.
    """
    up1, up2, down1, down2 = (x[..., searched] for x in halves)
    first, second = ((up * down.conj()).sum(-1) for up, down in ((up1, down2), (up2, down1)))
    phase = (torch.angle(first * second.conj()).to(torch.float64) - 2 * math.pi * coarse)[..., None, :]

    def changed(up: Tensor, down: Tensor, both: Tensor) -> Tensor:
        tiny = torch.finfo(both.dtype).tiny
        return (power_of(up).sum(-1) - power_of(down).sum(-1)) / (2 * both.abs()).clamp_min(tiny)

    def changes() -> Tensor:
        return (changed(up1, down2, first) - changed(up2, down1, second)).to(torch.float64)[..., None, :]

    return phase, torch.ones_like(phase), changes


def _at_peaks(
    halves: tuple[Tensor, ...], searched: Tensor, padding: int, scatterers: int
) -> tuple[Tensor, Tensor, Callable[[], Tensor]]:
    """Phases at the peaks of up and of down spectra, and the weights of Eq. (18).

    The third result is a function that returns the phase that corresponds to the changes of power,
    see `Law`. All are (..., scatterer, pulse). A weight is zero in periods where the scatterer is
    not illuminated.
    """
    up, down = (power_of(first) + power_of(second) for first, second in (halves[:2], halves[2:]))
    both = (up + down).detach()
    phases, weights, picked = [], [], []
    for peak in _strongest(torch.where(searched, both.mean(-2), -1), scatterers, padding).unbind(-1):
        near = (_around(power.detach(), peak, padding) for power in (up, down))
        at_up, at_down = (take(index, level.argmax(-1)) for index, level in near)
        up1, up2, down1, down2 = (take(x, at) for x, at in zip(halves, (at_up, at_up, at_down, at_down), strict=True))
        phases.append(torch.angle(up1 * up2.conj() * down1 * down2.conj()).to(torch.float64))
        picked.append(torch.stack([up1, up2, down1, down2]))
        # Eq. (18), made independent of scale: standard deviation of the amplitudes near a peak,
        # over their mean
        part = _around(both, peak, 4 * padding)[1].sqrt()
        mean = part.mean((-2, -1))
        spread = (part - mean[..., None, None]).square().mean((-2, -1)).sqrt()
        weight = torch.where(mean > 0, spread / torch.where(mean > 0, mean, 1), 0).to(torch.float64)
        weights.append(weight[..., None] * shining(take(up, at_up), take(down, at_down)))

    def changes() -> Tensor:
        level = power_of(torch.stack(picked, -2)).to(torch.float64)
        first, second, third, fourth = level.clamp_min(torch.finfo(both.dtype).tiny).log() / 2
        return first - second + third - fourth

    return torch.stack(phases, -2), torch.stack(weights, -2), changes


def _strongest(profile: Tensor, count: int, spacing: int) -> Tensor:
    """Bins (..., count) of the greatest values of a circular profile, at least two
    spacings apart.
    """
    n = profile.shape[-1]
    left, found = profile, []
    index = torch.arange(n, device=profile.device)
    for _ in range(count):
        found.append(left.argmax(-1, keepdim=True))
        distance = ((index - found[-1] + n // 2) % n - n // 2).abs()
        left = torch.where(distance < 2 * spacing, -1.0, left)
    return torch.cat(found, -1)


def _around(power: Tensor, peak: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Bins near a peak (...,), and the power (..., pulse, n) in these bins in every period."""
    near = (peak[..., None] + torch.arange(-reach, reach + 1, device=power.device)) % power.shape[-1]
    near = near[..., None, :].expand(*power.shape[:-1], -1)
    return near, power.gather(-1, near)


def _unwrapped(
    phases: Tensor, weights: Tensor, coarse: Tensor, bands: Bands, unwrap: Unwrap
) -> tuple[Tensor, Tensor, Tensor]:
    """One phase per period and its number of whole turns, (..., pulse) each, and the number of
    slips (...,).

    coarse: Doppler shift fd T that the envelopes show beyond the removed shift.
    """
    turn = 2 * math.pi
    integer = torch.round(coarse[..., None, :] + phases.detach() / turn)
    # phase without whole turns: fd T = -own / 2 pi
    own = _weighted(phases - turn * integer, weights)
    pairs = torch.minimum(weights[..., 1:], weights[..., :-1])
    change = phases.diff(dim=-1)
    step = _weighted(change - turn * torch.round(change.detach() / turn), pairs)
    # the removed shift is added, which the gradient of the phase does not contain
    beyond = own - turn * bands.shift.to(torch.float64)
    both = bands.lit[..., 1:] & bands.lit[..., :-1] & (pairs > 0).any(-2)
    step = torch.where(both, step, beyond.diff(dim=-1))
    gradient = torch.cat([torch.zeros_like(own[..., :1]), step.cumsum(-1)], -1)
    first = bands.lit.to(torch.int8).argmax(-1, keepdim=True)
    gradient = gradient + (beyond - gradient).gather(-1, first)
    slips = ((torch.round((gradient - beyond).detach() / turn).diff(dim=-1) != 0) & both).sum(-1).to(torch.float64)
    chosen = gradient + turn * bands.shift.to(torch.float64) if unwrap == "gradient" else own
    whole = -torch.round(chosen.detach() / turn)
    return chosen + turn * whole, whole, slips


def _weighted(x: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over scatterers, (..., pulse); zero where all weights are zero."""
    return (x * weights).sum(-2) / weights.sum(-2).clamp_min(torch.finfo(weights.dtype).tiny)


class SegmentedInterference(_SweepEstimator):
    """Radial velocity by segmented interference; see `segmented_interference`.

    Args:
        radar: Ladar parameters.
        bins: Frequency bins in which the phase is read: "peak" (those of the strongest scatterers)
            or "sum" (all).
        unwrap: How the whole turns of the phase are found: "gradient" (from period to period) or
            "per_pulse" (from the envelopes of every period).
        scatterers: Number of scatterers with "peak".
        padding: Factor of the zero-padding of the halves, 1..16.
        hann: True applies a Hann window to each half.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(segmented_interference)

    def __init__(
        self,
        radar: TriangularLadar,
        bins: Bins = "peak",
        unwrap: Unwrap = "gradient",
        scatterers: int = 1,
        padding: int = 4,
        hann: bool = False,
        window_m: Window = None,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(
            radar,
            window_m,
            azimuth_m,
            assess,
            bins=bins,
            unwrap=unwrap,
            scatterers=scatterers,
            padding=padding,
            hann=hann,
        )
