"""A small group of range lines cut out of a recording, focused by itself, quickly and as often as
an estimator likes.

The group may lie elsewhere in every trial, so its reference range is a per-trial tensor. Focusing
is the bulk + refocus omega-K of the chain (`torchsar.focus.omega_k`) referred to the middle of the
group, in the frame of the Doppler centroid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import fft_lines
from torchsar.focus.omega_k import FrameGeometry, FrequencyBasis, bulk_filter, refocus, refocus_turns_per_sample
from torchsar.focus.reference import range_compress
from torchsar.radar import StripmapRadar

BLOCK_COLUMNS = 32


def aperture_s(radar: StripmapRadar, n_range: int) -> float:
    """Time a target stays in the recorded band: the nominal dwell, or the time to sweep one PRF
    where none is known.
    """
    middle = radar.near_range_m + n_range / 2 * radar.range_step_m
    return radar.aperture_s(middle)


def central_lines(raw: Tensor, most: int) -> Tensor:
    """At most `most` lines about the middle of the record, (..., pulse, range)."""
    first = max(0, (raw.shape[-2] - most) // 2)
    return raw[..., first : first + most, :]


def full_columns(n_range: int, pulse_samples: int) -> int:
    """Columns of a compressed line that hold the whole pulse; all of them where the line is hardly
    longer than the pulse.
    """
    return n_range - pulse_samples if n_range > pulse_samples + 64 else n_range


def compress(raw: Tensor, radar: StripmapRadar, spectrum: Tensor | None) -> Tensor:
    """Range-compressed lines, only the fully compressed columns.

    spectrum: range reference, None for compressed data.
    """
    if spectrum is None:
        return raw
    return range_compress(raw, spectrum)[..., : full_columns(raw.shape[-1], radar.pulse_samples)]


@dataclass(frozen=True)
class RangeGroup:
    """Compressed lines (..., pulse, width) whose column 0 is column `start` (...,) of the
    recording.
    """

    data: Tensor
    start: Tensor
    radar: StripmapRadar

    @property
    def middle_m(self) -> Tensor:
        """Slant range of column width // 2, (...,) float64."""
        return (
            self.radar.near_range_m
            + (self.start + self.data.shape[-1] // 2).to(torch.float64) * self.radar.range_step_m
        )


@dataclass(frozen=True)
class BeamSpectrum:
    """Two-dimensional spectrum of a group, or those of its rows that are wanted: data (..., d,
    width), doppler_hz (..., d).
    """

    group: RangeGroup
    data: Tensor
    doppler_hz: Tensor

    def moved(self, by_hz: Tensor | float) -> BeamSpectrum:
        """The same samples read as lying by_hz higher in absolute Doppler."""
        return replace(self, doppler_hz=self.doppler_hz + by_hz)

    def rows(self, frame_hz: Tensor, velocity_m_s: Tensor | float) -> Tensor:
        """Range-Doppler rows of the focused group, (..., d, width)."""
        radar, n = self.group.radar, self.data.shape[-1]
        at = FrameGeometry(
            radar,
            self.doppler_hz,
            torch.as_tensor(velocity_m_s, dtype=torch.float64, device=self.data.device),
            frame_hz,
        )
        middle = self.group.middle_m[..., None, None]
        rows = self.data * bulk_filter(FrequencyBasis(radar, n, self.data.device), at, middle, None, self.data.dtype)
        return refocus(torch.fft.ifft(rows), refocus_turns_per_sample(at), n // 2)

    def image(self, frame_hz: Tensor, velocity_m_s: Tensor | float) -> Tensor:
        """Image of the group, (..., azimuth, width), sampled as coarsely as the band allows.

        Differentiable in the velocity.
        """
        return fft_lines(self.rows(frame_hz, velocity_m_s), inverse=True)


def full_spectrum(group: RangeGroup, doppler_hz: Tensor) -> BeamSpectrum:
    """All rows in FFT order, unwrapped about the centroid (...,): images of it keep the phase from
    line to line.
    """
    return BeamSpectrum(
        group, torch.fft.fft2(group.data), group.radar.doppler_hz(group.data.shape[-2], doppler_hz, group.data.device)
    )


def beam_spectrum(group: RangeGroup, doppler_hz: Tensor, margin: float = 1.2) -> BeamSpectrum:
    """Rows of a group about the centroid (...,) in rising Doppler: `margin` times the band of the
    beam's dwell, all where no dwell is known.

    Outside that band there is only noise, whose phase under the azimuth filter changes fastest with
    velocity: it would make objectives rough.
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
    """Energy of each column above the background, in backgrounds, limited to 10: (..., pulse,
    range) -> (..., range) float64, never quite 0.

    The background is the column at the lowest tenth; what four deviations of noise could be does
    not count. The limit keeps one ship from outweighing a hundred good columns.
    """
    energy = (lines.detach().real.square() + lines.detach().imag.square()).sum(-2).to(torch.float64)
    floor = energy.kthvalue(max(1, energy.shape[-1] // 10), dim=-1, keepdim=True).values
    excess = energy / torch.where(floor > 0, floor, 1) - 1 - 4 / math.sqrt(lines.shape[-2])
    return excess.clamp(1e-3, 10)


def pick_group(lines: Tensor, radar: StripmapRadar, width: int) -> RangeGroup:
    """The group of `width` columns with the most signal above the background, nearer to mid-swath
    where several are alike.
    """
    count = lines.shape[-1]
    width = min(width, count)
    sums = torch.nn.functional.pad(column_signal(lines).cumsum(-1), (1, 0))
    signal = sums[..., width:] - sums[..., : count - width + 1]
    place = torch.arange(count - width + 1, dtype=torch.float64, device=lines.device)
    off = (2 * place / max(1, count - width) - 1).square()
    start = (signal * (1 - 0.3 * off)).argmax(-1)
    columns = start[..., None] + torch.arange(width, device=lines.device)
    return RangeGroup(lines.gather(-1, columns[..., None, :].expand(*lines.shape[:-1], width)), start, radar)


def stays_inside(width: int, radar: StripmapRadar, doppler_hz: Tensor, dwell_s: float) -> Tensor:
    """1 for the columns of a group of `width` whose targets stay in it while they migrate for
    dwell_s, else 0, (..., width) float64.

    doppler_hz: absolute centroid (...,). The middle half always counts.
    """
    curvature_m = (radar.velocity_m_s * dwell_s / 2) ** 2 / (2 * radar.near_range_m)
    half_walk = (0.25 * radar.wavelength_m * doppler_hz.abs() * dwell_s + curvature_m) / radar.range_step_m
    reach = (width / 2 - half_walk - 2).clamp_min(width / 4)
    place = torch.arange(width, dtype=torch.float64, device=doppler_hz.device) - (width - 1) / 2
    return (place.abs() <= reach[..., None]).to(torch.float64)


def block_weights(columns: Tensor, radar: StripmapRadar, doppler_hz: Tensor, dwell_s: float) -> Tensor:
    """Weights of the range blocks of a group in an objective, (..., block) with sum 1: their signal
    (`column_signal`).

    Columns whose targets would walk out of the group within the aperture do not count; those of the
    middle half always do. columns: (..., n, width), lines or an image.
    """
    width = columns.shape[-1]
    weight = column_signal(columns) * stays_inside(width, radar, doppler_hz, dwell_s)
    weight = torch.stack([part.sum(-1) for part in weight.tensor_split(_block_count(width), -1)], -1)
    return weight / weight.sum(-1, keepdim=True)


def _block_count(width: int) -> int:
    return max(1, width // BLOCK_COLUMNS)


def block_entropy(image: Tensor) -> Tensor:
    """Entropy of each block of about 32 range lines by itself, (..., azimuth, range) -> (...,
    block), nats, float64.

    A bright block counts no more than any other, so that a few ships do not rule; a block is wide
    enough for the range walk that a wrong velocity leaves. Differentiable; 0 for an empty block.
    """
    power = image.real.square() + image.imag.square()
    tiny = torch.finfo(power.dtype).tiny
    blocks = []
    for part in power.tensor_split(_block_count(image.shape[-1]), -1):
        p = part / part.sum((-2, -1), keepdim=True).clamp_min(tiny * 1e3)
        blocks.append(-(p * torch.log(p.clamp_min(tiny))).sum((-2, -1)).to(torch.float64))
    return torch.stack(blocks, -1)


def student_log_likelihood(t: Tensor, degrees: Tensor | int) -> Tensor:
    """Logarithm of Student's density at t without its constant: how well a deviation of t predicted
    ones is explained, outliers included.
    """
    return -0.5 * (degrees + 1) * torch.log1p(t.square() / degrees)


def jackknife_std(left_out: Tensor) -> Tensor:
    """Standard deviation from leave-one-out values, (..., block) -> (...,)."""
    n = left_out.shape[-1]
    return math.sqrt((n - 1) / n) * torch.linalg.vector_norm(left_out - left_out.mean(-1, keepdim=True), dim=-1)
