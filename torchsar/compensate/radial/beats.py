"""Radial velocity from the beat frequencies of both sweeps.

They differ by twice the Doppler shift. It is found by correlation of the range spectra, the
reference method of Remote Sens. 2024, 16, 793, and from the peaks of the strongest scatterer.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, Spectra, inside, window_lines
from torchsar.compensate.radial.blocks import Window, _SweepEstimator, velocities
from torchsar.compensate.radial.measured import Law, Measured
from torchsar.compensate.radial.product import climbed
from torchsar.core import (
    Axis,
    Estimate,
    cis,
    differentiable,
    power_of,
)
from torchsar.radar import TriangularLadar


@differentiable("no")
def spectrum_correlation(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    upsampling: int = 20,
    window_m: tuple[float, float] | None = None,
    azimuth_m: Tensor | float = 0.0,
    assess: bool = True,
) -> Estimate:
    """Estimate the radial velocity from the lag between the range envelopes of both sweeps.

    >>> import torch
    >>> from torchsar.compensate import spectrum_correlation
    >>> from torchsar.radar import TriangularLadar
    >>> ladar = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 64, 128, dtype=torch.complex64)  # a point at the reference range
    >>> found = spectrum_correlation(sweeps, ladar, ladar.sweep_axes(64)[1])
    >>> bool(found["velocity_m_s"].abs().max() < 0.01)
    True

    The range envelopes are the magnitude spectra of the up sweep and of the mirrored down sweep.
    The lag that aligns them is twice the Doppler shift. It is found on a grid with the step
    1 / (upsampling T), where T is the length of a sweep. However strong the signal, an rms error of
    lambda / (4 upsampling T sqrt(12)) remains: 0.70 mm/s for an upsampling of 20 and the ladar of
    Remote Sens. 2024, 16, 793. If the motion is slow, the estimate stays on one step of the grid.
    Not differentiable.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        upsampling: Upsampling of the spectra, 1..64.
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
        bins) and "lit" (True in periods with an echo), shape (..., pulse).

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, the window or the upsampling are invalid.

    Reference:
        Remote Sens. 2024, 16, 793, section 2.3.2.
    """
    if not (isinstance(upsampling, int) and 1 <= upsampling <= 64):
        raise ValueError(f"upsampling must be a whole number of 1..64, got {upsampling}")

    floor = radar.wavelength_m / (4 * upsampling * radar.sweep_s * math.sqrt(12))

    def measure(spectra: Spectra) -> Measured:
        bands = spectra.bands(window_m, taper=0.0)
        doppler = envelope_lag(bands, upsampling) / (2 * radar.sweep_s)
        product = spectra.bands(window_m, taper=0.5, oversampling=2)
        return Measured.of(from_beats(doppler, -doppler, bands), product, Law(3.0, floor_m_s=floor))

    return velocities("spectrum_correlation", measure, sweeps, radar, pulse, azimuth_m, assess)


@torch.no_grad()
def envelope_lag(bands: Bands, upsampling: int) -> Tensor:
    """Find the lag between the range envelopes of the up sweep and of the mirrored down sweep.

    The sweeps were filtered after the Doppler shift was removed to within a bin or two. Therefore
    only lags within 4 bins are searched.

    Args:
        bands: Filtered sweeps.
        upsampling: Upsampling of the spectra.

    Returns:
        The lag of the envelope of the up sweep, which is twice the remaining Doppler shift, in bins
        of 1 / T (T is the length of a sweep), shape (..., pulse), float64.
    """
    m = bands.time_s.shape[-1]
    n = upsampling * m
    envelope = torch.fft.fft(torch.stack([bands.up, bands.down], -3), n).abs()
    spectrum = torch.fft.rfft(envelope - envelope.mean(-1, keepdim=True))
    correlation = torch.fft.irfft(spectrum[..., 0, :, :] * spectrum[..., 1, :, :].conj(), n)
    reach = min(4 * upsampling, n // 2 - 1)
    near = torch.cat([correlation[..., -reach:], correlation[..., : reach + 1]], -1)
    return (near.argmax(-1) - reach).to(torch.float64) / upsampling


class SpectrumCorrelation(_SweepEstimator):
    """Radial velocity by cross-correlation of range envelopes; see `spectrum_correlation`.

    Args:
        radar: Ladar parameters.
        upsampling: Upsampling of the spectra, 1..64.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    differentiable = "no"

    estimator = staticmethod(spectrum_correlation)

    def __init__(
        self,
        radar: TriangularLadar,
        upsampling: int = 20,
        window_m: Window = None,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess, upsampling=upsampling)
        self.upsampling = upsampling


@differentiable("where ok")
def ml_peak(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    window_m: tuple[float, float] | None = None,
    azimuth_m: Tensor | float = 0.0,
    assess: bool = True,
) -> Estimate:
    """Estimate the radial velocity from the periodogram peaks of both sweeps.

    >>> import torch
    >>> from torchsar.compensate import ml_peak
    >>> from torchsar.radar import TriangularLadar
    >>> ladar = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 64, 128, dtype=torch.complex64)  # a point at the reference range
    >>> found = ml_peak(sweeps, ladar, ladar.sweep_axes(64)[1])
    >>> bool(found["velocity_m_s"].abs().max() < 0.01)
    True

    The Doppler shift is half the difference between the beat frequencies of the up sweep and of the
    mirrored down sweep. Each beat frequency is the peak of a periodogram, refined by Newton steps.
    For one scatterer this is the maximum-likelihood estimate if the phase of each sweep is unknown.
    The peak is searched within two range cells of the peak of the mean periodogram of the record.
    Differentiable, except for this search.

    Assumes one dominant scatterer; use `radial_motion` for extended scenes.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        window_m: Lowest and highest range in metres, relative to the reference range, between which
            the peak of the mean periodogram is searched; None for the whole band. The sweeps are
            not filtered.
        azimuth_m: Azimuth of the scatterer in metres, a number or shape (...,).
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
        bins) and "lit" (True in periods with an echo), shape (..., pulse).

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps or the window are invalid.
    """
    window_lines(radar, window_m)

    def measure(spectra: Spectra) -> Measured:
        bands = spectra.bands(video=True)
        up, down, lit = peak_frequencies(bands, window_m)

        def changes() -> Tensor:
            of_up, of_down = (_amplitude_slope(x, hz, bands) for x, hz in ((bands.up, up), (bands.down, down)))
            return radar.wavelength_m / 2 * (of_up - of_down) / 2

        product = spectra.bands(window_m, taper=0.5, oversampling=2)
        return Measured.of(from_beats(up, down, bands), product, Law(3.0, changes=changes), bands.lit & lit)

    return velocities("ml_peak", measure, sweeps, radar, pulse, azimuth_m, assess)


def from_beats(up_hz: Tensor, down_hz: Tensor, bands: Bands) -> Tensor:
    """Compute the radial velocity from the beat frequencies of up and mirrored down sweeps.

    The range changes between the middles of the two sweeps, which leads to a factor 1 + B / (2 fc),
    with bandwidth B and carrier frequency fc.

    Args:
        up_hz: Beat frequency of the up sweep in Hz, shape (..., pulse).
        down_hz: Beat frequency of the mirrored down sweep in Hz, same shape.
        bands: Filtered sweeps.

    Returns:
        The velocity in m/s, receding positive, shape (..., pulse).
    """
    radar = bands.radar
    doppler = bands.shift.to(torch.float64) / radar.sweep_s + (up_hz - down_hz) / 2
    return radar.wavelength_m / 2 * doppler * (1 + radar.bandwidth_hz / (2 * radar.carrier_hz))


@torch.no_grad()
def _amplitude_slope(x: Tensor, beat_hz: Tensor, bands: Bands) -> Tensor:
    """Slope in Hz (..., pulse) that follows if the relative slope of the amplitude of a tone is
    taken as one of the phase.
    """
    u = bands.time_s
    tone = x * cis((-2 * math.pi * beat_hz[..., None] * u).to(x.real.dtype))
    level = tone.mean(-1)
    slope = (level.conj() * (tone * u.to(x.real.dtype)).mean(-1)).real
    power = power_of(level).clamp_min(torch.finfo(x.real.dtype).tiny)
    return (slope / power).to(torch.float64) / float(2 * math.pi * u.square().mean())


def shining(up: Tensor, down: Tensor) -> Tensor:
    """Mark the periods in which a scatterer is illuminated in both sweeps.

    In these periods its power is at least a fifth of its mean power over the record, in the up
    sweep and in the down sweep.

    Args:
        up: Power in the up sweeps, shape (..., pulse).
        down: Power in the down sweeps, same shape.

    Returns:
        True where the scatterer is illuminated, shape (..., pulse), bool.
    """
    return torch.stack([power >= 0.2 * power.mean(-1, keepdim=True) for power in (up, down)]).all(0) & (up + down > 0)


def peak_frequencies(bands: Bands, window_m: tuple[float, float] | None) -> tuple[Tensor, Tensor, Tensor]:
    """Find the beat frequencies of the strongest scatterer in both sweeps.

    Args:
        bands: Filtered sweeps.
        window_m: Lowest and highest range in metres, relative to the reference range, between which
            the scatterer is searched; None for the whole band.

    Returns:
        The beat frequencies in the up and in the mirrored down sweeps in Hz, shape (..., pulse)
        each, float64, and True where the scatterer is illuminated, shape (..., pulse), bool.
    """
    both = torch.stack([bands.up, bands.down], -3)
    m, n = both.shape[-1], 2 * both.shape[-1]
    power = power_of(torch.fft.fft(both.detach(), n))
    searched = inside(bands.radar, window_m, n, 2, both.device)
    centre = torch.where(searched, power.mean((-3, -2), keepdim=True), -1).argmax(-1, keepdim=True)
    distance = (torch.arange(n, device=both.device) - centre + n // 2) % (n) - n // 2
    # the search is within two range cells of the peak of the whole record
    peak, best = torch.where(distance.abs() <= 4, power, -1).max(-1)
    best = torch.where(best >= n // 2, best - n, best)
    frequency = best.to(torch.float64) / (2 * bands.radar.sweep_s)
    # three Newton steps, enough to converge by trial
    frequency = climbed(both, bands.radar.sweep_s / m, frequency, 3)
    return frequency[..., 0, :], frequency[..., 1, :], shining(peak[..., 0, :], peak[..., 1, :])


class MlPeak(_SweepEstimator):
    """Radial velocity by periodogram peaks of one scatterer; see `ml_peak`.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scatterer in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(ml_peak)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess)
