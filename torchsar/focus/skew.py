"""Doppler spectra of a squinted beam, whose centroid is proportional to the transmitted frequency.

At the range frequency f relative to the carrier f0, a beam with the Doppler centroid f_dc at the
carrier has the centroid f_dc (1 + f / f0). The spectrum of a target is thus skewed: over the pulse
bandwidth B its centroid moves by |f_dc| B / f0. Pulses sample it modulo the PRF. It can be
recovered if the Doppler band at each range frequency is narrower than the PRF. A multiple of the
PRF is added to the Doppler frequency of each sample of the two-dimensional spectrum, so that it
comes nearest to the centroid of its range frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import (
    Signal,
    block_bytes_of,
    host_largest,
    is_traced,
    over_blocks,
    real_dtype,
    transform_in_blocks,
    untraced,
)
from torchsar.focus.frame_geometry import BAND_EDGE, FrameGeometry, band_weight, raised_cosine_band
from torchsar.focus.omega_k import is_whole, tabulated, through_doppler
from torchsar.radar import StripmapRadar

# Tolerated excess of the band of an image over its sampling rate, relative to this rate. The
# measured error of the azimuth width of the interpolated image was 0.1 % at 0.07, 0.7 % at 0.14 and
# 8 % at 0.21.
EXCESS = 0.05
# Skew relative to the processed band below which all range frequencies have the band weights of the
# carrier, by choice. The edges of the weights are 0.1 wide.
_LEAST_SKEW = 1e-3


@untraced()
def skew_hz(radar: StripmapRadar, doppler_hz: Tensor | float) -> float:
    """Compute by how much the Doppler centroid moves over the bandwidth of the pulse.

    Args:
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler centroid at the carrier in Hz, a number or one per trial.

    Returns:
        Largest |doppler_hz| B / f0 of the trials in Hz; 0 where values cannot be read.
    """
    given = isinstance(doppler_hz, Tensor)
    largest = host_largest(doppler_hz.detach().to(torch.float64).abs(), 0.0) if given else abs(doppler_hz)
    return largest * radar.pulse.bandwidth_hz / radar.carrier_hz


def aperture_band_hz(radar: StripmapRadar, range_m: float, doppler_hz: float, velocity_m_s: float) -> float:
    """Compute the Doppler bandwidth of the nominal aperture of a radar at the carrier.

    Args:
        radar: Radar of the recording.
        range_m: Slant range in metres.
        doppler_hz: Absolute Doppler centroid in Hz.
        velocity_m_s: Effective velocity in m/s.

    Returns:
        Doppler rate times the integration time in Hz; the PRF where the radar has none.
    """
    if radar.integration_s is None:
        return radar.prf_hz
    cos2 = 1 - float(radar.sin_squint(doppler_hz, velocity_m_s)) ** 2
    return float(radar.azimuth_rate_hz_s(range_m, velocity_m_s)) * cos2 * radar.integration_s


def azimuth_factor(radar: StripmapRadar, doppler_hz: Tensor | float, band_hz: float | None = None) -> int:
    """Compute how many lines per pulse sample the image of a squinted beam.

    The image of a target spans the Doppler band of its aperture plus |doppler_hz| B / f0, by which
    the centroid moves over the pulse bandwidth B. An image with one line per pulse holds this sum
    up to the PRF. The largest centroid counts, of all trials and of the nominal pointing of the
    radar, so that estimates near the nominal pointing give images of one size.

    Args:
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler centroid at the carrier in Hz, a number or one per trial.
        band_hz: Processed Doppler bandwidth in Hz; None for that of the nominal aperture of the
            radar at its near range, or the whole PRF where it has no integration time.

    Returns:
        The least whole number of lines per pulse whose rate holds the sum within a twentieth.
    """
    skew = max(skew_hz(radar, doppler_hz), skew_hz(radar, radar.pointing_doppler_hz or 0.0))
    if band_hz is not None:
        band = band_hz * (1 + BAND_EDGE)
    else:
        band = aperture_band_hz(radar, radar.near_range_m, 0.0, radar.velocity_m_s)
    return max(1, math.ceil((min(band, radar.prf_hz) + skew) / radar.prf_hz - EXCESS))


def common_lines(one: Signal, other: Signal) -> tuple[Signal, Signal]:
    """Reduce two images of one recording, with different numbers of lines per pulse, to their
    common lines.

    Args:
        one: Image with axes (azimuth, range).
        other: Image with axes (azimuth, range), whose number of lines is a multiple or a divisor.

    Returns:
        The two images with the lines of the coarser one.
    """
    lines = min(image.axis("azimuth").n for image in (one, other))

    def coarser(image: Signal) -> Signal:
        axis = image.axis("azimuth")
        factor = axis.n // lines
        every = replace(axis, n=lines, step=axis.step * factor)
        return image if factor == 1 else Signal(image.data[..., ::factor, :], (every, image.axis("range")))

    return coarser(one), coarser(other)


@dataclass(frozen=True)
class DopplerSkew:
    """Doppler centroid of each range frequency of a recording, and how its spectrum is sampled.

    Args:
        radar: Radar of the recording.
        centre_hz: Absolute Doppler centroid at the carrier in Hz, shape (...,), float64.
        base_hz: Doppler of each row within half a PRF of zero in Hz, FFT order, shape (d,).
        frequency_hz: Range frequencies in Hz, FFT order, shape (f,).
        band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.
        factor: Lines of the image per pulse.
    """

    radar: StripmapRadar
    centre_hz: Tensor
    base_hz: Tensor
    frequency_hz: Tensor
    band_hz: float | None
    factor: int

    @staticmethod
    def of(
        radar: StripmapRadar,
        raw: Tensor,
        doppler_hz: Tensor | float,
        velocity_m_s: Tensor,
        band_hz: float | None,
    ) -> DopplerSkew:
        """Describe the spectrum of raw data.

        Args:
            radar: Radar of the recording.
            raw: Raw data, shape (..., pulse, range).
            doppler_hz: Absolute Doppler centroid at the carrier in Hz, a number or shape (...,).
            velocity_m_s: Effective velocity in m/s, shape (...,).
            band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.

        Raises:
            ValueError: If `band_hz` is not positive, or is None and the Doppler band of the nominal
                aperture of a squinted radar exceeds the PRF at the highest range frequency.
        """
        with untraced(doppler_hz, velocity_m_s):
            centre = torch.as_tensor(doppler_hz, dtype=torch.float64, device=raw.device).detach()
            if band_hz is None:
                _refuse_aliased(radar, raw.shape[-1], centre, velocity_m_s.detach())
            else:
                band_weight(radar, centre.new_zeros(1), band_hz)
            base = torch.fft.fftfreq(raw.shape[-2], 1 / radar.prf_hz, dtype=torch.float64, device=raw.device)
            frequency = radar.range_frequency_hz(raw.shape[-1], raw.device)
            return DopplerSkew(radar, centre, base, frequency, band_hz, azimuth_factor(radar, centre, band_hz))

    @untraced()
    def sin_reach(self, geometry: FrameGeometry) -> float:
        """Compute a bound of the sine of the squint, at the carrier, over all range frequencies.

        The Doppler of each row grows with the centroid, at most in proportion to the highest
        sampled frequency, and by one PRF where the nearest multiple is rounded up.

        Args:
            geometry: Geometry of all Doppler rows, at the centroid of the carrier.

        Returns:
            Magnitude of the sine; 0 where values cannot be read.
        """
        skewed = skew_hz(self.radar, self.centre_hz) * self.radar.sampling_hz / (2 * self.radar.pulse.bandwidth_hz)
        changes = math.ceil(skewed / self.radar.prf_hz) if skewed else 0
        one = host_largest(self.radar.sin_squint(self.radar.prf_hz, geometry.velocity_m_s.detach()), 0.0)
        return geometry.sin_reach + changes * one

    def orders(self, part: slice, scale: Tensor | float = 1.0) -> Tensor:
        """Compute the number of PRFs to add to the base Doppler of each row.

        Args:
            part: Slice of the Doppler axis.
            scale: Frequency relative to the carrier, 1 + f / f0, a number or shape (f,).

        Returns:
            Whole numbers, shape (..., d, f), float64; f is 1 for a number.
        """
        centre = self.centre_hz[..., None, None] * scale
        return torch.round((centre - self.base_hz[part, None]) / self.radar.prf_hz)

    @untraced()
    def jumps(self, part: slice) -> tuple[list[int] | slice, range]:
        """Find rows in which the number of PRFs changes over the range frequencies.

        Args:
            part: Slice of the Doppler axis.

        Returns:
            Indices of these rows within the slice, and the changes relative to the number at the
            carrier. Where values cannot be read, all rows and changes by one PRF.
        """
        reach = self.radar.sampling_hz / (2 * self.radar.carrier_hz)
        ends = self.orders(part, torch.tensor([1 - reach, 1 + reach]).to(self.base_hz)) - self.orders(part)
        if is_traced(ends):
            return slice(None), range(-1, 2)
        try:
            rows = (ends != 0).any(-1).reshape(-1, ends.shape[-2]).any(0).nonzero()[:, 0].tolist()
            return rows, range(int(ends.min()), int(ends.max()) + 1)
        except RuntimeError as error:
            if "vmap" not in str(error):
                raise
            return slice(None), range(-1, 2)

    def changes(self, part: slice, rows: list[int] | slice) -> Tensor:
        """Compute the change of the number of PRFs over the range frequencies of some rows.

        Args:
            part: Slice of the Doppler axis.
            rows: Indices within the slice.

        Returns:
            Number of PRFs minus that at the carrier, shape (..., row, f).
        """
        scale = 1 + self.frequency_hz / self.radar.carrier_hz
        return self._some(part, rows).orders(slice(None), scale) - self._some(part, rows).orders(slice(None))

    def _some(self, part: slice, rows: list[int] | slice) -> DopplerSkew:
        return replace(self, base_hz=self.base_hz[part][rows])

    def weighted(self, rows: Tensor, part: slice) -> Tensor:
        """Weight the samples of a spectrum by the processed band about the centroid of each range
        frequency.

        Args:
            rows: Rows of the two-dimensional spectrum, shape (..., d, f), complex.
            part: Their slice of the Doppler axis.

        Returns:
            Weighted rows, same shape.
        """
        if self.band_hz is None:
            return rows
        prf, lean = self.radar.prf_hz, self.frequency_hz / self.radar.carrier_hz
        skewed = skew_hz(self.radar, self.centre_hz) > _LEAST_SKEW * self.band_hz
        scale = 1 + (lean if skewed else torch.zeros_like(lean[:1]))
        offset = self.base_hz[part, None] - self.centre_hz[..., None, None] * scale
        offset = offset - prf * torch.round(offset / prf)
        return rows * raised_cosine_band(offset / self.band_hz).to(real_dtype(rows.dtype))

    def planes(self, part: slice, change: int) -> Tensor:
        """Compute which multiple of the PRF the rows occupy in the spectrum of the image.

        Args:
            part: Slice of the Doppler axis.
            change: Number of PRFs added to that at the carrier.

        Returns:
            Index from 0 to factor - 1, shape (..., d).
        """
        whole = self.orders(part)[..., 0] + change - (self.base_hz[part] < 0).to(torch.float64)
        return torch.remainder(whole, self.factor)


def _refuse_aliased(radar: StripmapRadar, n_range: int, centre_hz: Tensor, velocity_m_s: Tensor) -> None:
    """Raise ValueError for a squinted aperture whose Doppler band exceeds the PRF."""
    skew = skew_hz(radar, centre_hz)
    if radar.integration_s is None or skew <= EXCESS * radar.prf_hz:
        return
    middle = radar.near_range_m + n_range // 2 * radar.range_step_m
    doppler, velocity = float(centre_hz.abs().min()), float(velocity_m_s.max())
    top = 1 + radar.pulse.bandwidth_hz / (2 * radar.carrier_hz)
    band = top * aperture_band_hz(radar, middle, doppler, velocity)
    if band > (1 + EXCESS) * radar.prf_hz:
        raise ValueError(
            f"the Doppler band of a {radar.integration_s:g} s aperture, {band:.5g} Hz at the highest range frequency, "
            f"exceeds the PRF of {radar.prf_hz:g} Hz; shorten integration_s of the radar, or process a band_hz of at "
            f"most {radar.prf_hz / (1 + BAND_EDGE):.5g} Hz"
        )


def through_skewed_doppler(
    raw: Tensor,
    focus_rows: Callable[..., Tensor],
    build: Callable[[FrameGeometry], tuple[Tensor, ...]],
    geometry: FrameGeometry,
    skew: DopplerSkew,
    once: bool = True,
) -> Tensor:
    """Apply a function to the rows of the unwrapped two-dimensional spectrum, then an azimuth FFT.

    Rows in which the number of PRFs changes over the range frequencies are divided into parts of
    equal Doppler, which are focused separately and added.

    Args:
        raw: Raw data, shape (..., pulse, range), complex.
        focus_rows: Maps rows (..., d, range frequency) and their tables to (..., d, range).
        build: Computes the tables (..., d, m) of the rows of a geometry.
        geometry: Geometry of all Doppler rows, at the centroid of the carrier.
        skew: Doppler centroid over range frequency.
        once: Compute the tables of all rows at once, see `tabulated`.

    Returns:
        Image, shape (..., azimuth, range), with `skew.factor` lines per pulse.
    """

    tables = tabulated(build, geometry, once)
    even = skew.jumps(slice(None))[0] == []

    def parts(rows: Tensor, part: slice) -> Iterator[tuple[Tensor, int, list[int] | slice]]:
        """Generate parts of focused lines, the change of their number of PRFs, and their rows."""
        rows = skew.weighted(rows, part)
        jumping, changes = ([], range(1)) if even else skew.jumps(part)
        if jumping == []:
            yield focus_rows(rows, *tables(part)), 0, slice(None)
            return
        at = geometry.rows(part)
        some, change = rows[..., jumping, :], skew.changes(part, jumping)
        mine = (change == 0).to(real_dtype(rows.dtype))
        if jumping == slice(None):
            still = some * mine
        else:
            still = rows.index_copy(-2, torch.tensor(jumping, device=rows.device), some * mine)
        yield focus_rows(still, *tables(part)), 0, slice(None)
        for k in changes:
            if k:
                there = replace(at, doppler_hz=at.doppler_hz[..., jumping] + k * skew.radar.prf_hz)
                yield focus_rows(some * (change == k).to(mine.dtype), *build(there)), k, jumping

    def whole(rows: Tensor, part: slice) -> Tensor:
        """Sum of the parts, shape (..., d, range). For several lines per pulse it is (..., factor,
        d, range).
        """
        total: Tensor | None = None
        for lines, k, which in parts(rows, part):
            if skew.factor > 1:
                index = torch.arange(skew.factor, device=rows.device)[:, None]
                plane = skew.planes(part, k)[..., which]
                lines = lines[..., None, :, :] * (plane[..., None, :] == index)[..., None]
            if total is None:
                total = lines
            elif which == slice(None):
                total = total + lines
            else:
                total = total.index_add(-2, torch.tensor(which, device=rows.device), lines)
        assert total is not None
        return total

    differentiable = geometry.requires_grad or raw.requires_grad
    if skew.factor == 1:
        return through_doppler(raw, whole, differentiable)
    if is_whole(raw, differentiable):
        spectrum = whole(torch.fft.fft2(raw), slice(None))
        return torch.fft.ifft(spectrum.flatten(-3, -2), dim=-2) * skew.factor
    work = transform_in_blocks(raw, -2, out=torch.empty_like(raw, memory_format=torch.contiguous_format))
    fine = work.new_empty((*work.shape[:-2], skew.factor, *work.shape[-2:]))
    height = max(1, block_bytes_of(raw.device) // max(1, work[..., 0, :].numel() * work.element_size()))

    def focus(part: slice) -> None:
        fine[..., part, :] = whole(torch.fft.fft(work[..., part, :]), part)

    over_blocks(focus, (slice(first, first + height) for first in range(0, work.shape[-2], height)), work)
    return transform_in_blocks(fine.flatten(-3, -2), -2, inverse=True).mul_(skew.factor)
