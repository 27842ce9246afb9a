"""Filtering of the up and down sweeps of a triangular-FMCW ladar to a range window.

The down sweeps are mirrored in time, and the Doppler shift is removed in whole bins of beat
frequency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, checked_samples, cis, level_of, power_of, real_dtype
from torchsar.radar import TriangularLadar

SWEEPS = ("ramp", "pulse", "fast_time")  # axes of the signals of the stages
# periods over which envelopes are averaged, found by trial: more of them raise the SNR, fewer
# follow vibration
_BLOCK = 8


@dataclass(frozen=True)
class Bands:
    """Both sweeps of every period, filtered to a range window, without the bulk Doppler shift.

    A bin is the frequency 1 / T, where T is the length of a sweep in seconds. Let up(u) and down(u)
    be the sweeps, u the time from the middle of a sweep, and s the removed Doppler shift in bins.
    Then `up` is up(u) exp(-2j pi s u / T), and `down` is the mirrored sweep
    down(-u) exp(+2j pi s u / T). Both have the sign convention of Remote Sens. 2024, 16, 793
    (dechirp sign "lo_conj_echo"). A scatterer has the beat frequency of its range plus the
    remaining Doppler shift in `up`, and that of its range minus the remaining shift in `down`. The
    remaining shift is about a bin or less. The residual video phase is removed unless
    `Spectra.bands` was asked to keep it. The samples of each trial are multiplied by a power of two
    that brings them to about one.

    Args:
        up: Up sweeps, shape (..., pulse, m), complex, sampled symmetrically about the middle of the
            sweep.
        down: Mirrored down sweeps, same shape.
        time_s: Times of the samples from the middle of the sweep, shape (m,).
        shift: Removed Doppler shift s in bins, shape (..., pulse), int64.
        lit: False for periods in which no echo was found, shape (..., pulse), bool; their shift is
            that of the neighbouring periods.
        lines: Number of bins that the window keeps.
        first: Beat frequency of the first bin of the window, in bins.
        noise_lines: Noise bandwidth of the filter in bins.
        radar: Ladar parameters.
    """

    up: Tensor
    down: Tensor
    time_s: Tensor
    shift: Tensor
    lit: Tensor
    lines: int
    first: int
    noise_lines: float
    radar: TriangularLadar

    @property
    def shift_m_s(self) -> Tensor:
        """Radial velocity that corresponds to the Doppler shift removed from the sweeps.

        In m/s, receding positive, shape (..., pulse), float64.
        """
        return self.shift.to(torch.float64) * self.radar.ambiguous_velocity_m_s

    def product(self) -> Tensor:
        """Multiply the up sweeps by the conjugate of the mirrored down sweeps.

        Samples of equal optical frequency are multiplied, so that the scene cancels from the phase
        and the radial velocity remains, see `mirror_product`. The removed shift s leaves the phase
        factor exp(-2j pi s K u / fc (1 - 2u / T)), with carrier frequency fc and chirp rate K; it
        is removed too.

        Returns:
            The product, shape (..., pulse, m), complex.
        """
        u, radar = self.time_s, self.radar
        small = 2 * math.pi * radar.chirp_rate_hz_s * u / radar.carrier_hz * (1 - 2 * u / radar.sweep_s)
        turn = cis((self.shift.to(torch.float64)[..., None] * small).to(self.up.real.dtype))
        return self.up * self.down.conj() * turn

    @property
    def inner(self) -> slice:
        """Slice of the samples of a sweep without 1/32 of them at each end, where filters ring."""
        drop = round(self.time_s.shape[-1] / 32)
        return slice(drop, self.time_s.shape[-1] - drop)


def refuse_other_sweeps(sweeps: Tensor, radar: TriangularLadar, what: str, pulse: Axis | None = None) -> None:
    """Check the type and shape of sweeps.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters, of which the number of samples per sweep N is used.
        what: Name of the calling function for the error message.
        pulse: Slow-time axis of the periods of one up and one down sweep, or None.

    Raises:
        TypeError: If the sweeps are not a complex tensor.
        ValueError: If the sweeps have another shape, are not finite, or do not match the axis.
    """
    n = radar.sweep_samples
    if not isinstance(sweeps, Tensor) or sweeps.is_floating_point():
        raise TypeError(
            f"{what} works on complex sweeps (..., 2, pulse, {n}), got "
            f"{getattr(sweeps, 'dtype', type(sweeps).__name__)}; pass the record of "
            "a real-valued detector through SplitSweeps first"
        )
    if sweeps.ndim < 3 or sweeps.shape[-3] != 2 or sweeps.shape[-1] != n or sweeps.shape[-2] < 1:
        raise ValueError(
            f"{what} works on sweeps of shape (..., 2, pulse, {n}), with the up sweep before the down sweep, "
            f"got shape {tuple(sweeps.shape)}"
        )
    if pulse is not None and pulse.n != sweeps.shape[-2]:
        raise ValueError(
            f"{what}: pulse must be the axis of the {sweeps.shape[-2]} periods of the sweeps, got an axis of "
            f"{pulse.n} periods"
        )
    checked_samples(sweeps, what, f"2, pulse, {n}")


def window_lines(radar: TriangularLadar, window_m: tuple[float, float] | None) -> tuple[int, int]:
    """Convert a range window to bins of beat frequency; a bin is a range cell.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.

    Returns:
        The first bin and the number of bins.

    Raises:
        ValueError: If the window is not an interval, exceeds the beat band, or holds fewer than
            four range cells.
    """
    n = radar.sweep_samples
    if window_m is None:
        return -(n // 2), n
    low, high = (float(edge) for edge in window_m)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(
            "window_m must be two ranges (low, high) in metres relative to the reference range"
            f" with low < high, got {tuple(window_m)}"
        )
    first, last = round(low / radar.range_step_m), round(high / radar.range_step_m)
    if first < -(n // 2) or last >= n // 2:
        raise ValueError(
            f"window_m {tuple(window_m)} reaches beyond the beat band of "
            f"+-{n // 2 * radar.range_step_m:.4g} m; make it smaller"
        )
    if last - first + 1 < 4:
        raise ValueError(
            f"window_m {tuple(window_m)} holds {last - first + 1} range cells of "
            f"{radar.range_step_m:.3g} m; make it 4 cells or wider"
        )
    return first, last - first + 1


def inside(
    radar: TriangularLadar, window_m: tuple[float, float] | None, bins: int, per_line: float, device: torch.device
) -> Tensor:
    """Mark the bins of the Fourier transform of a sweep that lie in a range window.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        bins: Length of the transform, zero frequency first.
        per_line: Bins of the transform per range cell (zero-padding).
        device: Device of the result.

    Returns:
        The mask, shape (bins,), bool.

    Raises:
        ValueError: If the window is invalid, see `window_lines`.
    """
    first, lines = window_lines(radar, window_m)
    at = torch.arange(bins, device=device)
    at = torch.where(at >= bins // 2, at - bins, at) / per_line
    return (at >= first - 0.5) & (at <= first + lines - 0.5)


def bulk_shift(blocks: Tensor, pulses: int) -> tuple[Tensor, Tensor]:
    """Find the Doppler shift of every period in whole bins, from the range spectra of both sweeps.

    The lag that aligns the range spectra of the up and the down sweep is twice the Doppler shift
    (Remote Sens. 2024, 16, 793, Eq. (13)). Lags beyond half the band, which a circular correlation
    would wrap, are resolved by zero-padding. Periods whose two spectra are not similar take the
    shift of the neighbouring periods.

    Args:
        blocks: Power spectra of the up sweeps and of the down sweeps, which are not mirrored,
            averaged over blocks of 8 periods (the last block may hold fewer), zero frequency first,
            shape (..., 2, block, N).
        pulses: Number of periods.

    Returns:
        The Doppler shift in bins, shape (..., pulse), int64, and True where the spectra are
        similar, shape (..., pulse), bool.
    """
    n = blocks.shape[-1]
    blocks = torch.stack([blocks[..., 0, :, :], blocks[..., 1, :, :].roll(-1, -1).flip(-1)], -3)
    likeness, lag = _best_lag(torch.fft.fftshift(blocks, dim=-1), 2 * n)
    alike = likeness > 0.35  # limit found by trial, which pure noise does not reach
    lag = filled(_median_of_three(filled(lag.to(torch.float64), alike)), alike)
    shift = torch.round(_through_blocks(lag, pulses) / 2).to(torch.int64)
    return shift, alike.repeat_interleave(_BLOCK, -1)[..., :pulses]


def _best_lag(power: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Greatest correlation coefficient of up and mirrored down spectra, and its lag, (..., pulse).

    power: (..., 2, pulse, bin). length: number of samples of the circular correlation.
    """
    power = power - power.mean(-1, keepdim=True)
    level = power.square().sum(-1, keepdim=True).clamp_min(torch.finfo(power.dtype).tiny).sqrt()
    transform = torch.fft.rfft(power / level, length)
    likeness, lag = torch.fft.irfft(transform[..., 0, :, :] * transform[..., 1, :, :].conj(), length).max(-1)
    return likeness, torch.where(lag >= length // 2, lag - length, lag)


def filled(values: Tensor, known: Tensor) -> Tensor:
    """Replace unknown values by interpolation between their known neighbours.

    Values before the first known value are set to that value, and values after the last known value
    to the last. If no value is known, all are returned unchanged.

    Args:
        values: Values, shape (..., n).
        known: False where a value is unknown, shape (..., n), bool.

    Returns:
        The values, shape (..., n).
    """
    n = values.shape[-1]
    index = torch.arange(n, device=values.device).expand(values.shape)
    known = torch.where(known.any(-1, keepdim=True), known, True)
    before = torch.where(known, index, -1).cummax(-1).values
    after = torch.where(known, index, n).flip(-1).cummin(-1).values.flip(-1)
    low, high = torch.where(before < 0, after, before), torch.where(after >= n, before, after)
    share = (index - low).to(values.dtype) / (high - low).clamp_min(1).to(values.dtype)
    return torch.where(known, values, values.gather(-1, low) * (1 - share) + values.gather(-1, high) * share)


def _median_of_three(x: Tensor) -> Tensor:
    """Median of every entry and its two neighbours along the last dimension; ends are unchanged."""
    if x.shape[-1] < 3:
        return x
    return torch.cat([x[..., :1], x.unfold(-1, 3, 1).median(-1).values, x[..., -1:]], -1)


def _through_blocks(values: Tensor, pulses: int) -> Tensor:
    """Interpolate values (..., block) at the middles of blocks linearly to (..., pulse).

    The first and the last straight line are continued to the ends.
    """
    if values.shape[-1] == 1:
        return values.expand(*values.shape[:-1], pulses)
    first = torch.arange(0, pulses, _BLOCK, dtype=torch.float64, device=values.device)
    middle = (first + (first + _BLOCK - 1).clamp_max(pulses - 1)) / 2
    at = torch.arange(pulses, dtype=torch.float64, device=values.device)
    low = (torch.searchsorted(middle, at, right=True) - 1).clamp(0, values.shape[-1] - 2)
    share = (at - middle[low]) / (middle[low + 1] - middle[low])
    return values[..., low] * (1 - share) + values[..., low + 1] * share


@dataclass(frozen=True)
class Spectra:
    """Beat spectra of both sweeps of every period, and the bulk of the Doppler shift.

    Args:
        data: Spectra of the sweeps in the sign convention of `Bands`, zero frequency first, shape
            (..., 2, pulse, N), complex.
        smooth: Spectra of Hann-windowed sweeps, times the scale, same shape.
        scale: Power of two that brings the samples of a trial to about one, shape (..., 1, 1, 1).
        shift: Doppler shift in whole bins, shape (..., pulse), int64, see `bulk_shift`.
        alike: True where the spectra of both sweeps are similar, shape (..., pulse), bool.
        radar: Ladar parameters.
    """

    data: Tensor
    smooth: Tensor
    scale: Tensor
    shift: Tensor
    alike: Tensor
    radar: TriangularLadar

    @staticmethod
    def of(sweeps: Tensor, radar: TriangularLadar) -> Spectra:
        """Transform sweeps and find the bulk of their Doppler shift.

        Args:
            sweeps: Up and down sweeps of N samples as recorded, shape (..., 2, pulse, N), complex.
            radar: Ladar parameters.

        Returns:
            The spectra.
        """
        middle = sweeps.shape[-1] // 2
        # the scale is a power of two, with which squares neither underflow nor overflow
        scale = 1 / level_of(sweeps.detach()[..., middle - 4 : middle + 4], 3)
        spectrum = torch.fft.fft(sweeps.conj() if radar.dechirp_sign == "echo_conj_lo" else sweeps)
        # a Hann window, because with a rectangular one a peak between two bins would lose more than
        # half of its power
        whole = spectrum.detach()
        between = torch.cat([whole[..., -1:], whole, whole[..., :1]], -1)
        smooth = torch.sub(whole, between[..., :-2] + between[..., 2:], alpha=0.5).mul_(scale)
        blocks = torch.stack([power_of(part).mean(-2) for part in smooth.split(_BLOCK, -2)], -2)
        return Spectra(spectrum, smooth, scale, *bulk_shift(blocks, sweeps.shape[-2]), radar)

    def bands(
        self,
        window_m: tuple[float, float] | None = None,
        taper: float = 1.0,
        oversampling: int = 1,
        video: bool = False,
    ) -> Bands:
        """Filter both sweeps of every period to a range window.

        The down sweeps are mirrored in time, and the Doppler shift is removed in whole bins.
        Differentiable, except that the removed shift is held constant.

        Args:
            window_m: Lowest and highest range in metres, relative to the reference range; None for
                the whole band.
            taper: Share of the window that its raised-cosine edges take, 0..1. At 0 the window is
                cut sharply; ringing at the ends of the sweep then limits the accuracy of
                `mirror_product` at high SNR. At 1 the edges meet in the middle.
            oversampling: Samples per bin; the number of samples is rounded up to a power of two.
                Products of sweeps need 2.
            video: True keeps the residual video phase. This suits methods that use single
                scatterers, which that phase does not affect, because the filter that removes it
                rings at the ends of the sweep.

        Returns:
            The filtered sweeps.

        Raises:
            ValueError: If the window is invalid, see `window_lines`.
        """
        spectrum, radar = self.data, self.radar
        first, lines = window_lines(radar, window_m)
        n, device = radar.sweep_samples, spectrum.device
        shift, certain = _corrected_shift(self.smooth, self.shift, first, lines)
        m = 2 ** max(3, math.ceil(math.log2(oversampling * lines)))
        kept = _in_window(spectrum, shift, first, lines)
        edges = taper if window_m is not None else 0.0
        shape = _raised_cosine(torch.arange(lines, dtype=torch.float64, device=device), lines, edges)
        filters = torch.stack(
            [shape.to(kept.dtype) * _line_phase(first, lines, m, sign, not video, radar, kept) for sign in (1, -1)]
        )
        # middle of the window in bins; the phases are made to refer to the middle of the sweep
        middle = torch.stack([first + shift, shift - first], -2).to(torch.float64)
        turned = cis((math.pi * middle * ((n - 1) / n) % (2 * math.pi)).to(real_dtype(kept.dtype)))
        series = torch.fft.ifft(kept * filters[:, None, :] * (turned * self.scale[..., 0])[..., None], m) * (m / n)
        index = torch.arange(m, dtype=torch.float64, device=device) - (m - 1) / 2
        # the factor exp(2j pi first u / T) makes bins count from zero beat frequency again
        series = series * torch.exp(2j * math.pi * ((first * index / m) % 1)).to(series.dtype)
        up, down = series[..., 0, :, :], series[..., 1, :, :]
        # a period without an echo has much less energy in the window than usual, by trial
        energy = power_of(series.detach()).sum(-1)
        usual = torch.where(self.alike, energy.mean(-2), torch.nan).nanmedian(-1, keepdim=True).values
        faint = energy.amin(-2) < 0.3 * usual
        return Bands(
            up,
            down,
            index * (radar.sweep_s / m),
            shift,
            self.alike & (certain | ~faint),
            lines,
            first,
            # computed on the host, so that no value need be read from the device
            float(_raised_cosine(torch.arange(lines, dtype=torch.float64), lines, edges).square().sum()),
            radar,
        )


def _corrected_shift(smooth: Tensor, shift: Tensor, first: int, lines: int) -> tuple[Tensor, Tensor]:
    """The shift of every period, corrected by the envelopes of that period alone, and where it is
    certain.

    It is corrected where the envelopes of both sweeps are similar and their lag is two bins or
    more. Eight periods together have a higher SNR, but one period alone follows a vibration of a
    few periods. A scatterer that enters the beam between the two sweeps of a period is seen in one
    of them only. Therefore a single period whose shift differs from both neighbours by three bins
    or more takes the shift of one of them; the search for the velocity reaches further than that.
    """
    power = power_of(_in_window(smooth, shift, first, lines))
    likeness, lag = _best_lag(power, 2 ** math.ceil(math.log2(2 * lines)))
    # Limits found by trial. Envelopes that are this similar are used even if the neighbouring
    # periods have another lag. A lag beyond 14 bins is the distance to another scatterer, which was
    # illuminated in one sweep only.
    certain = (likeness > 0.7) & (lag.abs() <= 14)
    own = shift + torch.where(certain & (lag.abs() >= 2), torch.round(lag / 2).to(torch.int64), 0)
    typical = _median_of_three(own)
    return torch.where((own - typical).abs() >= 3, typical, own), certain


def _in_window(spectrum: Tensor, shift: Tensor, first: int, lines: int) -> Tensor:
    """Bins of a range window in the spectra of up sweeps and of mirrored down sweeps.

    The Doppler shift (..., pulse) in bins moves the window. A mirrored sweep has the mirrored
    spectrum.
    """
    line = torch.arange(first, first + lines, device=spectrum.device)
    at = torch.stack([line + shift[..., None], shift[..., None] - line], -3)
    return spectrum.gather(-1, at % spectrum.shape[-1])


def _line_phase(
    first: int, lines: int, m: int, sign: int, remove_video: bool, radar: TriangularLadar, like: Tensor
) -> Tensor:
    """Phase factor of each bin of the up sweep (sign 1) or the mirrored down sweep (sign -1).

    It removes the residual video phase and the half-sample offset between the grids of n and m
    samples.
    """
    j = torch.arange(lines, dtype=torch.float64, device=like.device)
    video = sign * remove_video * math.pi * ((first + j) / radar.sweep_s).square() / radar.chirp_rate_hz_s
    offset = math.pi * j * (1 / m - sign / radar.sweep_samples)
    return torch.exp(1j * ((video + offset) % (2 * math.pi))).to(like.dtype)


def _raised_cosine(j: Tensor, lines: int, taper: float) -> Tensor:
    """Window over bins 0..lines-1 with cosine edges, each `taper` times half the window wide."""
    if not taper:
        return torch.ones_like(j)
    distance = (j - (lines - 1) / 2).abs() / ((lines + 1) / 2)
    return torch.where(distance > 1 - taper, 0.5 * (1 + torch.cos(math.pi * (distance - 1 + taper) / taper)), 1.0)
