"""A small group of range cells, cut out of a recording and focused alone.

Estimators focus such a group many times at low cost. The group may lie at another range in every
trial, so its reference range is a tensor with one value per trial. The group is focused by the
omega-K algorithm: bulk compression at the range of its middle, then refocusing of the other ranges
(`torchsar.focus.omega_k`). The image places each target at the time when its Doppler equals the
frame Doppler, for which estimators take the Doppler centroid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import fft_lines, per_trial, power_of, unit_level
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import FrequencyBasis, bulk_filter, refocus, refocus_turns_per_sample
from torchsar.focus.reference import range_compress
from torchsar.radar import StripmapRadar


def full_columns(n_range: int, pulse_samples: int) -> int:
    """Count the columns (range cells) whose echo lies completely in the recorded line.

    Later columns are compressed from a part of the pulse only.

    Args:
        n_range: Number of range samples of the line.
        pulse_samples: Length of the pulse in samples.

    Returns:
        The number of columns; all of them if the line is hardly longer than the pulse.
    """
    return n_range - pulse_samples if n_range > pulse_samples + 64 else n_range


def compress(raw: Tensor, radar: StripmapRadar, spectrum: Tensor | None) -> Tensor:
    """Compress lines in range and keep the columns (range cells) whose whole echo was recorded.

    Args:
        raw: Lines, shape (..., pulse, range), complex.
        radar: Radar parameters.
        spectrum: Range reference spectrum, shape (range,); None if `raw` is already
            range-compressed.

    Returns:
        Range-compressed lines, shape (..., pulse, column), complex.
    """
    if spectrum is None:
        return raw
    return range_compress(raw, spectrum)[..., : full_columns(raw.shape[-1], radar.pulse_samples)]


@dataclass(frozen=True)
class RangeGroup:
    """Range-compressed lines of neighbouring range cells.

    Args:
        data: Lines, shape (..., pulse, width), complex.
        start: Range sample of the recording at which column 0 lies, shape (...,).
        radar: Radar parameters.
    """

    data: Tensor
    start: Tensor
    radar: StripmapRadar

    @property
    def middle_m(self) -> Tensor:
        """Slant range in metres of column width // 2, shape (...,), float64."""
        return (
            self.radar.near_range_m
            + (self.start + self.data.shape[-1] // 2).to(torch.float64) * self.radar.range_step_m
        )


@dataclass(frozen=True)
class BeamSpectrum:
    """Two-dimensional spectrum of a group of range cells, or some Doppler rows of this spectrum.

    Args:
        group: The group.
        data: Spectrum, shape (..., d, width), complex.
        doppler_hz: Doppler of the rows in Hz, shape (..., d).
    """

    group: RangeGroup
    data: Tensor
    doppler_hz: Tensor

    def rows(self, frame_hz: Tensor, velocity_m_s: Tensor | float) -> Tensor:
        """Focus the group of range cells without the last transform, that from Doppler to azimuth.

        Args:
            frame_hz: Frame Doppler in Hz, shape (...,): the image will hold each target at the time
                when its Doppler has this value.
            velocity_m_s: Effective velocity in m/s, shape (...,) or a number.

        Returns:
            Range-Doppler spectrum of the focused group, shape (..., d, width), complex.
        """
        radar, n = self.group.radar, self.data.shape[-1]
        at = FrameGeometry(radar, self.doppler_hz, per_trial(velocity_m_s, 0, self.data), frame_hz)
        middle = self.group.middle_m[..., None, None]
        rows = self.data * bulk_filter(
            FrequencyBasis(radar, n, self.data.device, wait=False), at, middle, None, self.data.dtype
        )
        return refocus(torch.fft.ifft(rows), refocus_turns_per_sample(at), n // 2)

    def image(self, frame_hz: Tensor, velocity_m_s: Tensor | float) -> Tensor:
        """Focus the group of range cells.

        The image has as many azimuth samples as the spectrum has Doppler rows. Differentiable in
        the velocity.

        Args:
            frame_hz: Frame Doppler in Hz, shape (...,): the image holds each target at the time
                when its Doppler has this value.
            velocity_m_s: Effective velocity in m/s, shape (...,) or a number.

        Returns:
            Image, shape (..., azimuth, width), complex.
        """
        return fft_lines(self.rows(frame_hz, velocity_m_s), inverse=True)


def full_spectrum(group: RangeGroup, doppler_hz: Tensor) -> BeamSpectrum:
    """Compute the whole spectrum of a group of range cells.

    The Doppler of each row is taken within half a PRF of the centroid. The rows are in FFT order,
    so that images of this spectrum have the true phase increment from line to line.

    Args:
        group: The group of range cells.
        doppler_hz: Doppler centroid in Hz, shape (...,).

    Returns:
        The spectrum with all its Doppler rows.
    """
    return BeamSpectrum(
        group, torch.fft.fft2(group.data), group.radar.doppler_hz(group.data.shape[-2], doppler_hz, group.data.device)
    )


def beam_spectrum(group: RangeGroup, doppler_hz: Tensor, margin: float = 1.2) -> BeamSpectrum:
    """Compute the spectrum of a group of range cells within the Doppler band of the beam.

    Outside that band there is only noise. When the velocity changes, the phase of the azimuth
    filter changes most there, so that this noise would make objective functions of the velocity
    rough.

    Args:
        group: The group of range cells.
        doppler_hz: Doppler centroid in Hz, shape (...,).
        margin: Width of the band that is kept, as a multiple of the Doppler band that a target
            sweeps while the beam illuminates it.

    Returns:
        The spectrum with its rows in rising Doppler; all rows if no dwell is known.
    """
    radar, n, full = group.radar, group.data.shape[-2], full_spectrum(group, doppler_hz)
    order = full.doppler_hz.argsort(-1)
    if radar.integration_s is not None:
        share = margin * radar.integration_s * float(radar.azimuth_rate_hz_s(radar.near_range_m)) / radar.prf_hz
        keep = min(n, 32 * math.ceil(max(64.0, share * n) / 32))
        order = order[..., (n - keep) // 2 : (n - keep) // 2 + keep]
    rows = order[..., None].expand(*order.shape, full.data.shape[-1])
    return BeamSpectrum(group, full.data.gather(-2, rows), full.doppler_hz.gather(-1, order))


def column_signal(lines: Tensor) -> Tensor:
    """Measure the energy of each column (range cell) above the background.

    The background is the energy that a tenth of the columns do not exceed, but at least a
    thousandth of that of the brightest column, whose sidelobes fill the others. Four standard
    deviations of noise are subtracted. The result is limited to 1e-3..10: the upper limit prevents
    one ship from outweighing a hundred good columns.

    Args:
        lines: Lines or an image, shape (..., pulse, range), complex.

    Returns:
        The energy above the background, in units of the background, shape (..., range), float64.
    """
    energy = power_of(lines).sum(-2).to(torch.float64)
    floor = energy.kthvalue(max(1, energy.shape[-1] // 10), dim=-1, keepdim=True).values
    floor = torch.maximum(floor, 1e-3 * energy.amax(-1, keepdim=True))
    excess = energy / torch.where(floor > 0, floor, 1) - 1 - 4 / math.sqrt(lines.shape[-2])
    return excess.clamp(1e-3, 10)


def aperture_lines(raw: Tensor, radar: StripmapRadar, spectrum: Tensor | None) -> tuple[Tensor, float]:
    """Compress the middle of a record: four apertures, or 1024 lines if that is more.

    Args:
        raw: Lines, shape (..., pulse, range), complex.
        radar: Radar parameters.
        spectrum: Range reference spectrum, see `compress`.

    Returns:
        Range-compressed lines of unit level, shape (..., pulse, column), complex. And the time in
        seconds for which the beam illuminates a target in the middle of the swath. It is the
        nominal dwell or, if there is none, the time in which the Doppler frequency of the target
        changes by one PRF.
    """
    dwell = radar.aperture_s(radar.near_range_m + raw.shape[-1] / 2 * radar.range_step_m)
    most = max(1024, round(4 * dwell * radar.prf_hz))
    first = max(0, (raw.shape[-2] - most) // 2)
    return compress(unit_level(raw[..., first : first + most, :]), radar, spectrum), dwell


def pick_group(lines: Tensor, radar: StripmapRadar, width: int) -> RangeGroup:
    """Choose the group of neighbouring range cells with the most signal above the background.

    Among groups with similar signal, the one nearest to the middle of the swath is chosen.

    Args:
        lines: Range-compressed lines, shape (..., pulse, range), complex.
        radar: Radar parameters.
        width: Number of range cells in the group.

    Returns:
        The group, which may lie at another range in every trial.
    """
    count = lines.shape[-1]
    width = min(width, count)
    sums = torch.nn.functional.pad(column_signal(lines).cumsum(-1), (1, 0))
    signal = sums[..., width:] - sums[..., : count - width + 1]
    first = torch.arange(count - width + 1, dtype=torch.float64, device=lines.device)
    off = (2 * first / max(1, count - width) - 1).square()
    start = (signal * (1 - 0.3 * off)).argmax(-1)
    columns = start[..., None] + torch.arange(width, device=lines.device)
    return RangeGroup(lines.gather(-1, columns[..., None, :].expand(*lines.shape[:-1], width)), start, radar)


def stays_inside(width: int, radar: StripmapRadar, doppler_hz: Tensor, dwell_s: float, always: bool = True) -> Tensor:
    """Mark the columns of a group of range cells whose targets stay in the group as they migrate.

    Args:
        width: Number of columns of the group.
        radar: Radar parameters.
        doppler_hz: Absolute centroid in Hz, shape (...,).
        dwell_s: Time that a target stays in the beam, in seconds.
        always: Whether the middle half of the columns is marked in any case. Otherwise no column is
            marked if the targets of fewer than half of the columns stay in the group.

    Returns:
        1 where the targets stay in the group, else 0; shape (..., width), float64.
    """
    curvature_m = (radar.velocity_m_s * dwell_s / 2) ** 2 / (2 * radar.near_range_m)
    half_walk = (0.25 * radar.wavelength_m * doppler_hz.abs() * dwell_s + curvature_m) / radar.range_step_m
    reach = width / 2 - half_walk - 2
    reach = reach.clamp_min(width / 4) if always else torch.where(reach >= width / 4, reach, -1.0)
    column = torch.arange(width, dtype=torch.float64, device=doppler_hz.device) - (width - 1) / 2
    return (column.abs() <= reach[..., None]).to(torch.float64)


def block_weights(columns: Tensor, radar: StripmapRadar, doppler_hz: Tensor, dwell_s: float) -> Tensor:
    """Compute the weights of the blocks of about 32 range cells into which a group is divided.

    They serve to average a quantity such as `block_entropy` over the blocks. The weight of a block
    is its signal above the background (`column_signal`). Range cells whose targets migrate out of
    the group within the aperture do not contribute, except those of the middle half of the group.

    Args:
        columns: Lines or an image of the group, shape (..., pulse, width), complex.
        radar: Radar parameters.
        doppler_hz: Absolute centroid in Hz, shape (...,).
        dwell_s: Time that a target stays in the beam, in seconds.

    Returns:
        The weights, shape (..., block), with sum 1.
    """
    width = columns.shape[-1]
    weight = column_signal(columns) * stays_inside(width, radar, doppler_hz, dwell_s)
    weight = torch.stack([part.sum(-1) for part in weight.tensor_split(_block_count(width), -1)], -1)
    return weight / weight.sum(-1, keepdim=True)


def _block_count(width: int) -> int:
    """Number of blocks of 32 columns, which are wide enough for the range walk by a wrong
    velocity.
    """
    return max(1, width // 32)


def block_entropy(image: Tensor) -> Tensor:
    """Compute the entropy of each block of about 32 range cells separately.

    A bright block has no more influence than any other, so a few ships do not dominate. A block is
    wide enough for the range walk that a wrong velocity leaves. Differentiable.

    Args:
        image: Image, shape (..., azimuth, range), complex.

    Returns:
        The entropies in nats, shape (..., block), float64; 0 for an empty block.
    """
    return entropy_parts(image, 1)[0][..., 0]


def entropy_parts(image: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Compute what each part of the azimuth samples adds to the entropy of each block.

    Args:
        image: Image, shape (..., azimuth, range), complex.
        parts: Number of parts along azimuth.

    Returns:
        The summands in nats and the shares of the energy of the block, shape (..., block, parts)
        each, float64. The sum of the summands over the last dimension is `block_entropy`.
    """
    tiny = torch.finfo(image.real.dtype).tiny
    blocks, shares = [], []
    for block in power_of(image).tensor_split(_block_count(image.shape[-1]), -1):
        p = block / block.sum((-2, -1), keepdim=True).clamp_min(tiny * 1e3)
        for sums, x in ((blocks, -(p * torch.log(p.clamp_min(tiny)))), (shares, p)):
            sums.append(torch.stack([part.sum((-2, -1)).to(torch.float64) for part in x.tensor_split(parts, -2)], -1))
    return torch.stack(blocks, -2), torch.stack(shares, -2)


def student_log_likelihood(t: Tensor, degrees: Tensor | int) -> Tensor:
    """Compute the logarithm of Student's t density, without its constant.

    It measures how plausible an error of t predicted standard deviations is. Large errors are more
    plausible than under a normal distribution, so that outliers do not dominate.

    Args:
        t: Error divided by its predicted standard deviation.
        degrees: Degrees of freedom.

    Returns:
        The log-likelihood, in the shape of the arguments broadcast together.
    """
    return -0.5 * (degrees + 1) * torch.log1p(t.square() / degrees)


def quotient(value: Tensor, curvature: Tensor) -> Tensor:
    """Divide by a curvature that may not be positive.

    Args:
        value: Values, any shape.
        curvature: Curvatures, same shape.

    Returns:
        The quotient, infinite where the curvature is not positive.
    """
    good = curvature > 0
    return torch.where(good, value / torch.where(good, curvature, 1), math.inf)
