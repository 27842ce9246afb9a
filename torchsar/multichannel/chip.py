"""Data of one extended moving target ("body"): short-time spectra, deramped by its motion.

All scatterers of a body have one velocity. Range lines around the body are shifted by the range
history of its middle and deramped channel by channel. Each scatterer then is one tone in all
channels, even if aliased. The frequency F of the tone gives the along-track position y = y0 + F
lambda R0 / v of the scatterer. Here y0 is the position and R0 the closest range of the middle, and
v the along-track speed of the receiver relative to the body. Position and velocity determine the
phases of the tone across the channels.

In a short segment of slow time, the sea clutter at the frequency of a tone comes from only a few
look angles, one for each Doppler band. Its covariance across the channels is estimated from range
lines beside the body.

Detection of moving targets in an image, by the mean intensity of small rectangles of pixels.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3 (extraction of moving targets, one velocity for
    scatterers close together).
    Remote Sens. 2020, 12, 1703, section 4.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchsar.core import Signal, checked_samples, differentiable, matrix_inverse, unit_level, unit_phasor
from torchsar.multichannel.migration import Frame, StaticBulk, correct_migration
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

TINY = 1e-100  # lowest divisor; its reciprocal is far from overflow


@dataclass(frozen=True)
class Extraction:
    """Extent of the data that are extracted for one body, an extended moving target.

    >>> from torchsar import multichannel
    >>> multichannel.Extraction(along_m=60.0, integration_s=2.0)
    Extraction(along_m=60.0, range_m=60.0, integration_s=2.0, segment_s=1.0)

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
        """Arguments of the transforms to short-time spectra and back."""
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
        # Threshold found by trial. A lower one would also remove parts of the sea; a higher one
        # would not remove all of the body.
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
            because an error of the model is the same in all cells of a scatterer and is not
            averaged. If the scatter of the steps from single range lines and segments is larger, it
            is that scatter. If the standard deviation between the speeds of range lines, beyond
            that of sea and noise, is still larger, it is that one. Lines of one body have one
            speed; where they have not, two bodies overlap, and u_r lies between their speeds.

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

        step_m_s = 1e-3  # step for the derivative, far below any standard deviation
        speed = self.motion.u_r_m_s + step_m_s
        there = PointMotion.imaged_at(self.radar, self.cells, speed, self.motion.u_a_m_s, image_s, image_m)
        turns = (self.motion.y0_m - there.y0_m) / (step_m_s * self.radar.wavelength_m * there.range_m)
        slope = across(2j * math.pi * turns * self.radar.channels_at(made.device)[:, None, None] * made)
        pull = torch.einsum("lmsf,sfmn->lnsf", slope.conj(), self.inverse)
        curvature = (pull * slope).sum().real.clamp_min(TINY)
        left = across(self.cells - made)
        bright = level > 12.0  # the same limit as in `Picture.bright`
        count = (bright.sum() * (self.radar.channels - 1)).clamp_min(1)
        misfit = (self.whitened(left) * bright).sum() / count
        # every pulse lies in two segments, so that the curvature and the scatter of the segments
        # contain it twice
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
        brightest pixel. Found by trial: 4 to 30 times give the same velocities.
        """
        return self.level > (0.01 * self.level.max()).clamp_min(12.0)


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
    off, least = (frame.range_m - motion.range_m).abs(), 12
    # Side lobes of the body reach the guard cells that are left out. By trial, 2 to 12 cells give
    # the same velocities.
    guarded_m = extraction.range_m + 6 * frame.radar.range_step_m
    body, beside = (near.nonzero()[:, 0] for near in (off <= extraction.range_m, off > guarded_m))
    if not len(body) or len(beside) < least:
        raise ValueError(
            f"the data must hold range cells of the body and at least {least} beside it for the covariance of "
            f"the sea, got {len(body)} cells within {extraction.range_m:g} m of its range of "
            f"{float(motion.range_m):.0f} m and {len(beside)} beside it; give more range cells or a smaller extraction"
        )
    lit = (
        frame.time_s - motion.y0_m / motion.along_m_s
    ).abs() < extraction.integration_s / 2 + extraction.along_m / 2 / motion.along_m_s
    shifted = correct_migration(data.to(torch.complex128), frame, motion, StaticBulk()).movedim(-1, 0)
    deramped = shifted * point_phasor(frame.radar, motion, frame.time_s, torch.complex128).conj()
    segments, tone_hz = _segments(frame, motion, extraction, lit)
    chip = Chip(
        frame.radar,
        motion,
        segments,
        segments.of(deramped[body]),
        segments.of(deramped[beside]),
        tone_hz,
        frame.range_m[body],
        torch.zeros(0, device=data.device),
        lit,
        frame.time_s,
    )
    chip = replace(chip, inverse=_inverse_covariance(chip))
    # Lines beside the body that contain more than sea and noise, such as another target, are left
    # out. Their energy is whitened, so that a target below the sea counts as well. They exceed the
    # median by six standard deviations; one is 1.48 times the median deviation of a normal
    # distribution. By trial, limits of 4 to 8 leave out lines with other ships, and no sea.
    for _ in range(3):
        energy = chip.whitened(chip.beside).sum((-2, -1))
        off = energy - energy.median()
        kept = off <= 6.0 * 1.4826 * off.abs().median()
        if bool(kept.all()) or int(kept.sum()) < least:
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
    first, last = (covered[(middle + side).clamp(0, n)] for side in (-(length // 2), length // 2))
    return Segments(n, length, bins, (last - first > 0).nonzero()[:, 0]), tone_hz[bins]


def _inverse_covariance(chip: Chip) -> Tensor:
    """Return the inverse covariance of the lines beside the body.

    Its phases depend on the tone as those of positions do. Otherwise it is the same for all tones
    of a segment.
    """
    turn = chip.steering(chip.motion, chip.tone_hz)
    aligned = chip.beside.movedim(1, -1) * turn.conj()
    covariance = torch.einsum("lsfm,lsfn->smn", aligned, aligned.conj()) / (aligned.shape[0] * aligned.shape[2])
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1).clamp_min(TINY)[:, None, None]
    # the diagonal term keeps the covariance of noise-free data invertible
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    inverse = matrix_inverse(covariance + 1e-5 * level * eye)
    return turn[..., :, None] * inverse[:, None] * turn.conj()[..., None, :]


@dataclass(frozen=True)
class Detection:
    """Position of one detection in an image.

    Args:
        azimuth_m: Azimuth x = V_R t of the intensity centre in metres, with the speed V_R of the
            receiver.
        range_m: Range of the intensity centre in metres.
        contrast_db: Mean intensity of the brightest neighbourhood, a small rectangle of pixels,
            relative to the median over all neighbourhoods of the image in dB.
    """

    azimuth_m: float
    range_m: float
    contrast_db: float


def contrast(image: Signal, extent_m: tuple[float, float] = (60.0, 10.0)) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Compute the mean intensity of small rectangles of pixels relative to the median of all.

    The rectangles (neighbourhoods) overlap by half along both axes.

    Args:
        image: Image (azimuth, range), complex.
        extent_m: Extent of a neighbourhood in azimuth and range in metres.

    Returns:
        The contrast (intensity ratio), float64 (..., row, column), and the azimuths (row,) and
        ranges (column,) of the middles of the neighbourhoods in metres.
    """
    azimuth, range_ = image.axes
    size = tuple(
        min(axis.n, max(2, 2 * round(extent / axis.step / 2)))
        for axis, extent in zip((azimuth, range_), extent_m, strict=True)
    )
    intensity = unit_level(image.data.detach()).abs().square().to(torch.float64)
    mean = avg_pool2d(
        intensity.flatten(0, -3)[:, None] if intensity.ndim > 2 else intensity[None, None],
        size,
        stride=(max(1, size[0] // 2), max(1, size[1] // 2)),
    )
    mean = mean[:, 0].unflatten(0, image.trials) if image.trials else mean[0, 0]
    typical = mean.flatten(-2).median(-1).values.clamp_min(torch.finfo(torch.float64).tiny)
    middles = [
        axis.start
        + axis.step * ((n - 1) / 2 + max(1, n // 2) * torch.arange(count, dtype=torch.float64, device=mean.device))
        for axis, n, count in zip((azimuth, range_), size, mean.shape[-2:], strict=True)
    ]
    return mean / typical[..., None, None], (middles[0], middles[1])


@differentiable("no")
def detect(
    image: Signal,
    threshold_db: float = 10.0,
    extent_m: tuple[float, float] = (60.0, 10.0),
    apart_m: tuple[float, float] = (200.0, 40.0),
    most: int = 16,
) -> list[Detection]:
    """Detect bright targets in one image, strongest first.

    >>> import torch
    >>> from torchsar import Axis, Signal, multichannel
    >>> axes = Axis("azimuth", 256, -256.0, 2.0, "m"), Axis("range", 64, 4840.0, 5.0, "m")
    >>> image = torch.ones(256, 64, dtype=torch.complex64)
    >>> image[168:188, 31:34] = 10  # a ship at 99 m
    >>> [(round(x.azimuth_m), round(x.range_m)) for x in multichannel.detect(Signal(image, axes))]
    [(98, 5000)]

    The image is divided into rectangles of pixels (neighbourhoods) that overlap by half. Their
    contrast is the mean intensity relative to the median over all of them. Any two detections are
    at least `apart_m` apart along one of the axes. The position of a detection is the
    contrast-weighted mean position of all neighbourhoods that lie within `apart_m` of the brightest
    one and have more than a quarter of its contrast.

    Args:
        image: Image (azimuth, range) without trials, complex.
        threshold_db: Least contrast of a detection in dB.
        extent_m: Extent of a neighbourhood in azimuth and range in metres.
        apart_m: Least separation in azimuth and range in metres.
        most: Largest number of detections.

    Returns:
        The detections, strongest first.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If the image has trials or no samples, or a sample is not finite.
    """
    if image.trials:
        raise ValueError(
            "detect works on one image at a time, got images with the trial dimensions "
            f"{tuple(image.trials)}; call it for each image separately"
        )
    image = image.with_data(checked_samples(image.data, "detect", ", ".join(image.names)))
    level, (rows, columns) = contrast(image, extent_m)
    left, found = level.clone(), []
    while len(found) < most and float(left.max()) >= 10 ** (threshold_db / 10):
        peak = float(left.max())
        row, column = divmod(int(left.argmax()), left.shape[1])
        near = ((rows - rows[row]).abs() < apart_m[0])[:, None] & ((columns - columns[column]).abs() < apart_m[1])
        bright = torch.where(near & (level > peak / 4), level, 0.0)
        azimuth, range_ = ((bright.sum(dim) * middle).sum() / bright.sum() for dim, middle in ((1, rows), (0, columns)))
        found.append(Detection(float(azimuth), float(range_), 10 * float(torch.log10(torch.tensor(peak)))))
        left = torch.where(near, 0.0, left)
    return found
