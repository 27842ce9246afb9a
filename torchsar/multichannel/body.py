"""Velocity, image and echo of extended moving targets ("bodies").

All scatterers of a body have one velocity. Range lines around the body are shifted by the range
history of its middle and deramped channel by channel. Each scatterer then is one tone in all
channels, even if aliased. The frequency F of the tone gives the along-track position y = y0 + F
lambda R0 / v of the scatterer, with the position y0 and the closest range R0 of the middle and the
along-track speed v of the receiver relative to the body. Position and velocity determine the phases
of the tone across the channels.

In a short segment of slow time, the sea clutter at the frequency of a tone comes from only a few
look angles, one for each Doppler band. Its covariance across the channels is estimated from range
lines beside the body.

The slant-range velocity of a body is the one of highest likelihood over all tones and segments,
each with a free amplitude; at the end it is fitted to the tones of the pixels of the body's image.
The along-track velocity is the one of the sharpest image. The echo is the fit with both velocities.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3 (extraction of moving targets, one velocity for
    scatterers close together).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Outcome, matrix_inverse, unit_level, unit_phasor, worst
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.migration import Frame, StaticBulk, correct_migration, envelope_phasor
from torchsar.multichannel.motion import PointMotion, checked_channels
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

TINY = 1e-100  # floor of divisors, far from the overflow of reciprocals
# Lines beside a body are left out beyond this many standard deviations of their energies, which are
# 1.48 times the median deviation of a normal distribution. Found by trial: 4 to 8 leave out lines
# that hold other ships, and no sea.
_OUTLIER, _OUTLIER_ROUNDS, _MAD_TO_STD = 6.0, 3, 1.4826
_LEAST_LINES = 12  # convention: fewest lines beside a body for the covariance of the sea
# Intensities in units of the residual sea and noise of a pixel, all found by trial. Pixels of a
# body exceed _BRIGHT (4 to 30 give the same velocities) and this share of the brightest pixel.
_BRIGHT, _BRIGHT_SHARE = 12.0, 0.01
# Largest predicted standard deviation of a reliable body, found by trial: of 200 pairs of ships in
# one place, 35 were below it, 1.1 deviations off in the rms, one by more than 5. Ships on a sea
# stay below 0.13. u_r displaces a body by about 20 m per m/s.
# Least mean of the bright pixels of a reliable body: sea alone stays below 18 in 15 trials, a ship
# that is weak but visible (4 dB in the frames of the tests) reaches 7000.
_USABLE_M_S, _CREDIBLE = 0.3, 40.0
# A grid search takes 40 steps to either side of its middle (0.5 m/s in a search of +-20 m/s, as in
# `Search`) and is repeated _GRIDS times, each time with a tenth of the step about the best point.
_GRID_HALF, _GRID_REFINEMENT, _GRIDS = 40, 10, 3
# Rounds over the whole search; later rounds search near the velocities found, since the motion then
# changes by little. Trades time against the number of rounds.
_WIDE_ROUNDS, _NEAR_U_R_M_S, _NEAR_U_A_M_S, _LAST_U_R_M_S = 2, 2.0, 1.0, 1.0


@dataclass(frozen=True)
class Extraction:
    """Extent of the data that are extracted for one body, an extended moving target.

    Args:
        along_m: Half width along track about the middle of the body in metres.
        range_m: Half width in range about the middle of the body in metres.
        integration_s: Time in seconds for which a scatterer is illuminated.
        segment_s: Length in seconds of the segments of slow time in which the clutter is
            suppressed.

    Raises:
        ValueError: If a value is not positive and finite.
    """

    along_m: float = 120.0
    range_m: float = 60.0
    integration_s: float = 4.5
    segment_s: float = 1.0

    def __post_init__(self) -> None:
        for name in ("along_m", "range_m", "integration_s", "segment_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} of an extraction must be positive and finite, got {getattr(self, name)}")


@dataclass(frozen=True)
class Segments:
    """Short-time Fourier transform of slow time with half-overlapping Hann windows.

    Args:
        n: Number of pulses.
        length: Number of pulses of a segment.
        bins: Indices of the FFT bins (tones) that are kept of each segment, shape (tone,).
        rows: Indices of the segments in which a body is illuminated, shape (segment,).
    """

    n: int
    length: int
    bins: Tensor
    rows: Tensor

    @property
    def _windows(self) -> dict[str, Any]:
        """Arguments of the transforms in both directions."""
        window = torch.hann_window(self.length, dtype=torch.float64, device=self.bins.device)
        return {"n_fft": self.length, "hop_length": self.length // 2, "window": window, "onesided": False}

    def of(self, x: Tensor) -> Tensor:
        """Return the short-time spectra (..., segment, tone) of complex128 data (..., pulse)."""
        made = torch.stft(x.flatten(0, -2), **self._windows, pad_mode="constant", return_complex=True)
        return made[:, self.bins][..., self.rows].mT.unflatten(0, x.shape[:-1])

    def back(self, cells: Tensor) -> Tensor:
        """Transform short-time spectra (..., segment, tone) back to slow time (..., pulse).

        This is the inverse of `of`; segments and FFT bins that were left out count as zero.
        """
        full = torch.zeros(
            cells.shape[:-2].numel(),
            self.length,
            self.n // (self.length // 2) + 1,
            dtype=cells.dtype,
            device=cells.device,
        )
        full[:, self.bins[:, None], self.rows] = cells.flatten(0, -3).mT
        made = torch.istft(full, **self._windows, length=self.n, return_complex=True)
        return made.unflatten(0, cells.shape[:-2])


@dataclass(frozen=True)
class Chip:
    """Short-time spectra of the range lines around a body, deramped by the motion of its middle.

    Args:
        radar: Radar parameters.
        motion: Motion of the middle of the body.
        segments: Short-time Fourier transform of slow time.
        cells: Spectra of the range lines of the body, complex128 (line, channel, segment, tone).
        beside: Spectra of the range lines beside the body, complex128 (line, channel, segment,
            tone).
        tone_hz: Doppler frequencies of the kept bins after deramping in Hz, shape (tone,).
        range_m: Closest ranges of the range lines of the body in metres, shape (line,).
        inverse: Inverse covariance of sea and noise across the channels, complex128 (segment, tone,
            channel, channel).
        lit: True for pulses at which some part of the body is illuminated, bool (pulse,).
        time_s: Slow time in seconds, float64 (pulse,).
    """

    radar: BistaticRadar
    motion: PointMotion
    segments: Segments
    cells: Tensor
    beside: Tensor
    tone_hz: Tensor
    range_m: Tensor
    inverse: Tensor
    lit: Tensor
    time_s: Tensor

    def steering(self, motion: PointMotion, tone_hz: Tensor) -> Tensor:
        """Return the phases across the channels of scatterers with given tones in deramped data.

        A scatterer at along-track position y has the phasor exp(-j 2 pi (y - y0) dx_m / (lambda
        R0)) in the channel at dx_m, with the along-track position y0 of the middle of the body and
        the closest range R0.

        Args:
            motion: Motion of the scatterers, shape (...,).
            tone_hz: Frequencies of the tones in Hz, shape (tone,).

        Returns:
            Phasors, complex128 (..., tone, channel).
        """
        position = self.position_m(motion, tone_hz) - self.motion.y0_m
        return unit_phasor(
            -position[..., None]
            * self.radar.channels_at(position.device)
            / (self.radar.wavelength_m * motion.range_m[..., None, None]),
            torch.complex128,
        )

    def position_m(self, motion: PointMotion, tone_hz: Tensor) -> Tensor:
        """Return the along-track positions of scatterers with given tones in deramped data.

        Args:
            motion: Motion of the scatterers, shape (...,); its along-track position is that of a
                tone of frequency zero.
            tone_hz: Frequencies of the tones in Hz, shape (tone,).

        Returns:
            Positions at t = 0 in metres, shape (..., tone).
        """
        per_hz = self.radar.wavelength_m * motion.range_m / motion.along_m_s
        return motion.y0_m[..., None] + per_hz[..., None] * tone_hz

    def _weights(self, motion: PointMotion) -> tuple[Tensor, Tensor]:
        """Return R^-1 a (..., segment, tone, channel) and a^H R^-1 a (..., segment, tone)."""
        steering = self.steering(motion, self.tone_hz)
        weight = torch.einsum("sfmn,...fn->...sfm", self.inverse, steering)
        return weight, (steering[..., None, :, :].conj() * weight).sum(-1).real.clamp_min(TINY)

    def energy(self, motions: PointMotion) -> Tensor:
        """Return the energy of the data that scatterers with each candidate motion explain.

        Each cell (range line, segment, tone) has a free complex amplitude. The energy is relative
        to the covariance of sea and noise; up to constants it is the log-likelihood.

        Args:
            motions: Candidate motions, shape (candidate,).

        Returns:
            Energy summed over all cells, without unit, shape (candidate,).
        """
        weight, gain = self._weights(motions)
        return (torch.einsum("lmsf,csfm->clsf", self.cells, weight.conj()).abs().square() / gain[:, None]).sum(
            (-3, -2, -1)
        )

    def whitened(self, cells: Tensor) -> Tensor:
        """Return the energy of cells relative to the covariance of sea and noise.

        Args:
            cells: Short-time spectra of range lines, complex128 (line, channel, segment, tone).

        Returns:
            Energies, (line, segment, tone); of sea and noise, their mean is the number of channels.
        """
        return torch.einsum("lmsf,sfmn,lnsf->lsf", cells.conj(), self.inverse, cells).real

    def model(self, picture: Picture) -> Tensor:
        """Return the deramped echo of an image of the body in every channel.

        Args:
            picture: Image of the body. Pixels count that exceed twice the mean intensity of the
                residual sea and noise.

        Returns:
            Echo, complex128 (line, channel, pulse), zero in pulses in which no part of the body is
            illuminated.
        """
        # by trial: a lower level removes sea as well, a higher one leaves some of the body
        clear = picture.amplitude * (picture.level > 2.0)
        spectrum = torch.zeros(len(clear), self.radar.channels, self.segments.n, dtype=clear.dtype, device=clear.device)
        spectrum[..., picture.index] = clear[:, None] * self.steering(self.motion, picture.tone_hz).mT
        return torch.fft.ifft(spectrum) * self.lit

    def fit(self, picture: Picture, image_s: float, image_m: float) -> tuple[Tensor, Tensor, Tensor]:
        """Fit u_r to the echo of an image of the body, in which each pixel has a tone of its own.

        The phases that `energy` gives a cell are those of the middle of its Doppler bin, up to half
        a bin off. The pixels of the image are much finer.

        Args:
            picture: Image of the body.
            image_s: Slow time in seconds at which an image of the stationary scene shows the body.
            image_m: Range in metres at which it does.

        Returns:
            One Gauss-Newton step of the maximum-likelihood fit, with a free amplitude in each cell.

            The change of u_r that explains more of the data, in m/s.

            The predicted standard deviation of u_r in m/s: that of sea and noise times the misfit,
            since an error of the model is the same in all cells of a scatterer and does not
            average; or the scatter of the steps that single range lines and segments ask for, if
            that is more; or the standard deviation between the speeds of range lines, beyond that
            of sea and noise, if that is still more: lines of one body have one speed, and where
            they have not, two bodies overlap, and u_r lies between their speeds.

            The misfit, the energy that is left of the bright cells for each free dimension,
            relative to the covariance of sea and noise: 1 if scatterers of one velocity explain
            them.
        """
        made = self.segments.of(self.model(picture))
        backed = torch.einsum("sfmn,lnsf->lmsf", self.inverse, made)
        level = (made.conj() * backed).sum(1).real

        def across(cells: Tensor) -> Tensor:
            """Return the part of cells that no amplitude of the model explains."""
            return cells - ((backed.conj() * cells).sum(1) / level.clamp_min(TINY))[:, None] * made

        step_m_s = 1e-3  # for the derivative, far below any standard deviation
        speed = self.motion.u_r_m_s + step_m_s
        there = PointMotion.imaged_at(self.radar, self.cells, speed, self.motion.u_a_m_s, image_s, image_m)
        turns = (self.motion.y0_m - there.y0_m) / (step_m_s * self.radar.wavelength_m * there.range_m)
        slope = across(2j * math.pi * turns * self.radar.channels_at(made.device)[:, None, None] * made)
        pull = torch.einsum("lmsf,sfmn->lnsf", slope.conj(), self.inverse)
        curvature = (pull * slope).sum().real.clamp_min(TINY)
        left = across(self.cells - made)
        bright = level > _BRIGHT
        count = (bright.sum() * (self.radar.channels - 1)).clamp_min(1)
        misfit = (self.whitened(left) * bright).sum() / count
        # every pulse lies in two segments, so that the curvature, and the segments, count it twice
        step = (pull * left).sum(1).real / curvature
        by_line, share = step.sum((-2, -1)), (pull * slope).sum((1, 2, 3)).real / curvature
        scatter = by_line.square().sum() + 2 * step.sum((0, -1)).square().sum()
        apart = (by_line.square() / share.clamp_min(TINY)).sum() - step.sum().square()
        apart = apart - 2 * (share > 0).sum() / curvature
        std = torch.sqrt(2 / curvature) * misfit.clamp_min(1.0)
        return step.sum(), torch.maximum(std, torch.maximum(scatter, apart).sqrt()), misfit

    def echo(self, cells: Tensor) -> Tensor:
        """Return the most likely deramped echo of scatterers that move as the middle of the body.

        Args:
            cells: Short-time spectra of range lines, complex128 (line, channel, segment, tone).

        Returns:
            Echo as received by a channel at the along-track position 0, complex128 (line, pulse),
            zero in pulses in which no part of the body is illuminated.
        """
        weight, gain = self._weights(self.motion)
        return self.segments.back(torch.einsum("lmsf,sfm->lsf", cells, weight.conj()) / gain) * self.lit

    def picture(self) -> Picture:
        """Return the image of the body: the Doppler spectra of its deramped echo.

        The image includes the mean intensity of the residual sea and noise, which is measured in
        the range lines beside the body.
        """
        n = self.segments.n
        hz = torch.fft.fftfreq(n, 1 / self.radar.prf_hz, dtype=torch.float64, device=self.lit.device)
        inside = (hz.abs() <= self.tone_hz.abs().max()).nonzero()[:, 0]
        own, others = (torch.fft.fft(self.echo(cells))[:, inside] for cells in (self.cells, self.beside))
        return Picture(own, others.abs().square().mean().clamp_min(TINY), hz[inside], inside)


@dataclass(frozen=True)
class Picture:
    """Image of a body over range lines and tones, the Doppler bins of its deramped echo.

    Args:
        amplitude: Spectrum of the echo, summed over the illuminated pulses, complex128 (line,
            tone).
        left: Mean intensity of the residual sea and noise in a pixel, shape ().
        tone_hz: Frequencies of the tones in Hz, shape (tone,).
        index: Index of each tone in an FFT over all pulses, shape (tone,).
    """

    amplitude: Tensor
    left: Tensor
    tone_hz: Tensor
    index: Tensor

    @property
    def level(self) -> Tensor:
        """Ratio of the intensity of each pixel to the mean residual sea and noise, (line, tone)."""
        return self.amplitude.abs().square() / self.left

    @property
    def bright(self) -> Tensor:
        """True for pixels of the body, shape (line, tone).

        They exceed 12 times the mean intensity of the residual sea and noise, and 1 % of the
        brightest pixel.
        """
        return self.level > (_BRIGHT_SHARE * self.level.max()).clamp_min(_BRIGHT)


def chip_about(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Chip:
    """Extract the range cells of a body, deramped with its motion, as short-time spectra.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape
            (channel, pulse, range), complex, with the range cells of the body and at least 12
            beside it.
        frame: Radar, slow time and ranges of the data.
        motion: Motion of the body.
        extraction: Extent of the body.

    Returns:
        Short-time spectra of the range cells, with the inverse covariance of sea and noise.

    Raises:
        ValueError: If the data have no range cell of the body, or fewer than 12 beside it.
    """
    off = (frame.range_m - motion.range_m).abs()
    # side lobes of the body reach the cells left out; by trial, 2 to 12 give the same velocities
    guarded_m = extraction.range_m + 6 * frame.radar.range_step_m
    body, beside = (near.nonzero()[:, 0] for near in (off <= extraction.range_m, off > guarded_m))
    if not len(body) or len(beside) < _LEAST_LINES:
        raise ValueError(
            f"the data must hold range cells of the body and at least {_LEAST_LINES} beside it for the covariance of "
            f"the sea, got {len(body)} cells within {extraction.range_m:g} m of its range of "
            f"{float(motion.range_m):.0f} m and {len(beside)} beside it; give more range cells or a smaller extraction"
        )
    lit = (
        frame.time_s - motion.y0_m / motion.along_m_s
    ).abs() < extraction.integration_s / 2 + extraction.along_m / 2 / motion.along_m_s
    shifted = correct_migration(data.to(torch.complex128), frame, motion, StaticBulk()).movedim(-1, 0)
    deramped = shifted * point_phasor(frame.radar, motion, frame.time_s, torch.complex128).conj()
    segments, tone_hz = _segments(frame, motion, extraction, lit)
    empty = torch.zeros(0, device=data.device)
    chip = Chip(
        frame.radar,
        motion,
        segments,
        segments.of(deramped[body]),
        segments.of(deramped[beside]),
        tone_hz,
        frame.range_m[body],
        empty,
        lit,
        frame.time_s,
    )
    return _without_outliers(replace(chip, inverse=_inverse_covariance(chip)))


def _without_outliers(chip: Chip) -> Chip:
    """Leave out lines beside the body that hold more than sea and noise, such as another target.

    The energy of a line is whitened, so that a target counts that the sea hides. The spread of the
    energies is measured by their median deviation, so at most half of the lines are left out.
    """
    for _ in range(_OUTLIER_ROUNDS):
        energy = chip.whitened(chip.beside).sum((-2, -1))
        off = energy - energy.median()
        kept = off <= _OUTLIER * _MAD_TO_STD * off.abs().median()
        if bool(kept.all()) or int(kept.sum()) < _LEAST_LINES:
            break
        chip = replace(chip, beside=chip.beside[kept])
        chip = replace(chip, inverse=_inverse_covariance(chip))
    return chip


def _segments(frame: Frame, motion: PointMotion, extraction: Extraction, lit: Tensor) -> tuple[Segments, Tensor]:
    """Return the segments in which the body is illuminated, and the frequencies of its tones."""
    n, prf = len(frame.time_s), frame.radar.prf_hz
    length = min(2 * max(4, round(extraction.segment_s * prf / 2)), n // 2 * 2)
    tone_hz = torch.fft.fftfreq(length, 1 / prf, dtype=torch.float64, device=lit.device)
    reach = extraction.along_m * float(motion.along_m_s / motion.range_m) / frame.radar.wavelength_m + 2 * prf / length
    bins = (tone_hz.abs() <= reach).nonzero()[:, 0]
    middle = torch.arange(n // (length // 2) + 1, device=lit.device) * (length // 2)
    covered = torch.cat([torch.zeros(1, device=lit.device), lit.to(torch.float32).cumsum(0)])
    rows = (covered[(middle + length // 2).clamp(0, n)] - covered[(middle - length // 2).clamp(0, n)] > 0).nonzero()[
        :, 0
    ]
    return Segments(n, length, bins, rows), tone_hz[bins]


def _inverse_covariance(chip: Chip) -> Tensor:
    """Return the inverse covariance of the lines beside the body.

    Its phases depend on the tone as those of positions do; otherwise it is the same for all tones
    of a segment.
    """
    turn = chip.steering(chip.motion, chip.tone_hz)
    aligned = chip.beside.movedim(1, -1) * turn.conj()
    covariance = torch.einsum("lsfm,lsfn->smn", aligned, aligned.conj()) / (aligned.shape[0] * aligned.shape[2])
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1).clamp_min(TINY)
    # the diagonal keeps the covariance of noise-free data invertible
    covariance = covariance + 1e-5 * level[:, None, None] * torch.eye(
        covariance.shape[-1], dtype=covariance.dtype, device=covariance.device
    )
    return turn[..., :, None] * matrix_inverse(covariance)[:, None] * turn.conj()[..., None, :]


def centred_motion(chip: Chip) -> PointMotion:
    """Return the motion of a body with its position and range measured at its middle.

    The middle is the mean position of the bright pixels of its image, weighted by intensity.
    Without bright pixels the motion is unchanged.

    Args:
        chip: Short-time spectra of the range lines about one body.

    Returns:
        Motion with tensors of shape (); the velocity is that of `chip.motion`.
    """
    picture = chip.picture()
    weight = picture.level * picture.bright
    total = weight.sum()
    if not float(total) > 0:
        return chip.motion
    position = (weight.sum(0) * chip.position_m(chip.motion, picture.tone_hz)).sum() / total
    near = (weight.sum(1) * chip.range_m).sum() / total
    return replace(chip.motion, y0_m=position, range_m=near)


@dataclass(frozen=True)
class Body:
    """Extended moving target (body) that was found in the data.

    Args:
        motion: Velocity of the body, and along-track position and closest range of its middle by
            intensity.
        u_r_std_m_s: Predicted standard deviation of the slant-range speed u_r in m/s.
        chip: Data of the body, deramped by its motion.
        picture: Image of the body.
        level: Mean intensity of the pixels of the body (`picture.bright`) divided by that of the
            residual sea and noise in `picture`.
        outcome: Code of an `Outcome`: `NOISE` if `level` is below 40 (16 dB); `OUTSIDE_SEARCH` if
            u_r lies at an end of its search interval, or the motion found during the search left
            the range lines or the pulses of the data; `INEXACT` if the standard deviation of u_r is
            0.3 m/s or more, as where the echoes of two bodies overlap.
    """

    motion: PointMotion
    u_r_std_m_s: Tensor
    chip: Chip
    picture: Picture
    level: Tensor
    outcome: Tensor

    @property
    def ok(self) -> Tensor:
        """True if the motion is reliable, bool, shape ()."""
        return self.outcome < Outcome.INEXACT


def find_body(
    data: Tensor,
    frame: Frame,
    image_s: float,
    image_m: float,
    extraction: Extraction,
    u_r_half_m_s: float | None = None,
    u_a_half_m_s: float = 20.0,
    rounds: int = 4,
) -> Body:
    """Find velocity and position of a body that appears in an image of the stationary scene.

    Each round shifts and deramps the data by the motion found so far, and then estimates the
    slant-range speed u_r, the along-track speed u_a and the middle of the body again.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape
            (channel, pulse, range), complex, with the range cells of the body and at least 12
            beside it.
        frame: Radar, slow time and ranges of the data.
        image_s: Slow time in seconds at which the image shows the body.
        image_m: Range in metres at which the image shows the body.
        extraction: Extent of the body.
        u_r_half_m_s: Half width of the search in u_r in m/s, by default lambda PRF / 2, half the
            ambiguity interval.
        u_a_half_m_s: Half width of the search in u_a in m/s.
        rounds: Number of rounds.

    Returns:
        The body, with its outcome.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if the data have no range cell of the body, or fewer than 12 beside it.
    """
    data = checked_channels(data, frame.radar, "find_body", "channel, pulse, range")
    if data.shape[-2] < 4:  # convention: two overlapping segments of two pulses
        raise ValueError(f"find_body needs at least 4 pulses, got {data.shape[-2]}; give a longer record")
    half = frame.radar.ambiguous_velocity_m_s / 2 if u_r_half_m_s is None else u_r_half_m_s
    chip = chip_about(data, frame, PointMotion.imaged_at(frame.radar, data, 0.0, 0.0, image_s, image_m), extraction)
    for number in range(rounds):
        u_r, std = _closing_speed(chip, image_s, image_m, half if number < _WIDE_ROUNDS else _NEAR_U_R_M_S)
        motion = PointMotion.imaged_at(frame.radar, data, u_r, chip.motion.u_a_m_s, image_s, image_m)
        reach = extraction.range_m / 2  # of a body about its middle, which the lines must contain
        if not frame.range_m[0] + reach <= motion.range_m <= frame.range_m[-1] - reach:
            return _body_of(chip, std, half, lost=True)
        moved = chip_about(data, frame, motion, extraction)
        if not len(moved.time_s[moved.lit]):  # the motion has left every pulse of the record
            return _body_of(chip, std, half, lost=True)
        u_a = _along_speed(moved, u_a_half_m_s if number < _WIDE_ROUNDS else _NEAR_U_A_M_S)
        chip = chip_about(data, frame, PointMotion.imaged_at(frame.radar, data, u_r, u_a, image_s, image_m), extraction)
        motion = centred_motion(chip)
        if motion is not chip.motion:
            image_s, image_m = float(motion.image_s), float(motion.closest_m)
        chip = chip_about(data, frame, motion, extraction)
    u_r, std = _closing_speed(chip, image_s, image_m, _LAST_U_R_M_S)
    for _ in range(2):  # a third step changes u_r by a hundredth of its standard deviation at most
        motion = PointMotion.imaged_at(frame.radar, data, u_r, chip.motion.u_a_m_s, image_s, image_m)
        chip = chip_about(data, frame, motion, extraction)
        step, std, _ = chip.fit(chip.picture(), image_s, image_m)
        u_r = u_r + step.clamp(-_LAST_U_R_M_S, _LAST_U_R_M_S)
    motion = PointMotion.imaged_at(frame.radar, data, u_r, chip.motion.u_a_m_s, image_s, image_m)
    return _body_of(chip_about(data, frame, motion, extraction), std, half)


def _body_of(chip: Chip, std: Tensor, half_m_s: float, lost: bool = False) -> Body:
    """Form the body of a chip and judge it."""
    picture = chip.picture()
    bright = picture.bright
    level = (picture.level * bright).sum() / bright.sum().clamp_min(1)
    # a velocity in the last part of the search counts as at its end
    inside = (chip.motion.u_r_m_s.abs() < 0.98 * half_m_s) & (not lost)
    outcome = worst(
        (Outcome.NOISE, ~(level > _CREDIBLE)),
        (Outcome.OUTSIDE_SEARCH, ~inside),
        (Outcome.INEXACT, ~(std < _USABLE_M_S)),
    )
    return Body(chip.motion, std, chip, picture, level, outcome)


def _closing_speed(chip: Chip, image_s: float, image_m: float, half_m_s: float) -> tuple[Tensor, Tensor]:
    """Return the most likely u_r near that of the chip, and its standard deviation."""

    def energy(u_r: Tensor) -> Tensor:
        u_a = chip.motion.u_a_m_s.expand(u_r.shape)
        return chip.energy(PointMotion.imaged_at(chip.radar, chip.cells, u_r, u_a, image_s, image_m))

    # all at once take two thirds of the time and nine times the memory
    return _highest(lambda u_r: torch.cat([energy(part) for part in u_r.split(9)]), chip.motion.u_r_m_s, half_m_s)


def _highest(value: Callable[[Tensor], Tensor], middle: Tensor, half_m_s: float) -> tuple[Tensor, Tensor]:
    """Return the speed of the highest value, by grids about the middle, and its standard deviation.

    A parabola refines the maximum of each grid. The deviation is that of a log-likelihood.
    """
    std = step = torch.as_tensor(half_m_s / _GRID_HALF, dtype=torch.float64)
    for _ in range(_GRIDS):
        grid = torch.arange(-_GRID_HALF, _GRID_HALF + 1, dtype=torch.float64, device=middle.device)
        values = value(middle + step * grid)
        inner = values.argmax().clamp(1, len(values) - 2)
        low, top, high = values[inner + torch.arange(-1, 2, device=values.device)]
        curvature = (2 * top - low - high).clamp_min(TINY)
        shift = grid[inner] + (0.5 * (high - low) / curvature).clamp(-1, 1)
        middle, std, step = middle + step * shift, step / torch.sqrt(curvature), step / _GRID_REFINEMENT
    return middle, std


def _along_speed(chip: Chip, half_m_s: float) -> Tensor:
    """Return the u_a within half_m_s of that of the chip with the sharpest image.

    Sharpness is the mean square of the intensities over their squared mean.
    """
    radar, motion = replace(chip.radar, channel_m=(0.0,)), chip.motion
    time_s = chip.time_s[chip.lit]
    # Hann weighted, since side lobes of neighbouring scatterers would interfere
    echo = chip.echo(chip.cells)[:, chip.lit] * torch.hann_window(
        len(time_s), dtype=torch.float64, device=time_s.device
    )
    # the brightest lines: by trial, 4 to 16 give the same velocities, 16 take a quarter more time;
    # squares of squares must fit into single precision
    echo = unit_level(echo[echo.abs().square().sum(-1).topk(min(8, len(echo))).indices])
    back = point_phasor(radar, motion, time_s, torch.complex128)[0]

    def sharpness(u_a: Tensor) -> Tensor:
        there = replace(motion.each(lambda value: value.expand(u_a.shape)), u_a_m_s=u_a)
        turn = point_phasor(radar, there, time_s, torch.complex128)[:, 0].conj() * back
        turned = (echo * turn[:, None]).to(torch.complex64)
        picture = torch.fft.fft(turned, smooth_length(2 * echo.shape[-1])).abs().square().to(torch.float64)
        return picture.square().sum((-2, -1)) / picture.sum((-2, -1)).square().clamp_min(TINY)

    return _highest(sharpness, motion.u_a_m_s, half_m_s)[0]


def known_body(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Body:
    """Extract a body of known velocity from the data and measure the position of its middle.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape
            (channel, pulse, range), complex, with the range cells of the body and at least 12
            beside it.
        frame: Radar, slow time and ranges of the data.
        motion: Known motion of the body.
        extraction: Extent of the body.

    Returns:
        Body; the standard deviation of its velocity is zero.

    Raises:
        ValueError: If the data have no range cell of the body, or fewer than 12 beside it.
    """
    chip = chip_about(data, frame, motion, extraction)
    chip = chip_about(data, frame, centred_motion(chip), extraction)
    return _body_of(chip, torch.zeros_like(motion.u_r_m_s), math.inf)


def body_echo(body: Body, frame: Frame, everything: bool = False) -> Tensor:
    """Return the echo of a body, to be subtracted from the data in which the body was found.

    The echo consists of the pixels of more than twice the intensity of the residual sea and noise.

    Args:
        body: Body that was found in these data.
        frame: Radar, slow time and ranges of the data.
        everything: True to return all data in the range lines and Doppler bins of the body instead,
            including the sea.

    Returns:
        Echo, complex128 (channel, pulse, range).
    """
    chip, picture = body.chip, body.picture
    deramped = chip.segments.back(chip.cells) if everything else chip.model(picture)
    full = torch.zeros(
        len(frame.range_m), frame.radar.channels, chip.segments.n, dtype=deramped.dtype, device=deramped.device
    )
    full[torch.isin(frame.range_m, chip.range_m)] = deramped * chip.lit
    ramped = full.movedim(0, -1) * point_phasor(frame.radar, chip.motion, frame.time_s, torch.complex128)[..., None]
    phasor = envelope_phasor(-frame.path_m(chip.motion), frame.radar, ramped)
    return torch.fft.ifft(torch.fft.fft(ramped) * phasor)


def body_image(body: Body, position_m: Tensor, extraction: Extraction) -> Tensor:
    """Return the complex image of a body at given along-track positions, with the sea suppressed.

    Args:
        body: Body that was found in the data.
        position_m: Along-track positions at t = 0 in metres, float64 (position,).
        extraction: Extent of the body.

    Returns:
        Amplitudes, complex128 (position, line); a scatterer of amplitude 1 has the value 1.
    """
    chip, motion = body.chip, body.chip.motion
    echo, time_s = chip.echo(chip.cells)[:, chip.lit], chip.time_s[chip.lit]
    hz = (position_m - motion.y0_m) * motion.along_m_s / (chip.radar.wavelength_m * motion.range_m)
    kernel = torch.exp(-2j * math.pi * hz[:, None] * time_s)
    return (kernel @ echo.mT) / (extraction.integration_s * chip.radar.prf_hz)
