"""Motion compensation of a nearly straight path, so that omega-K can image its data.

The nominal track is a straight line, see `StraightTrack`. A pulse at the coordinate u along the
track has the deviation d from it, perpendicular to the track. A point of the imaged plane has the
closest range R in the direction of the unit vector e(R). It is seen at the angle theta ahead of
broadside, at the range r = R / cos(theta) from the nominal track. From the true position its range
is

    r' = sqrt(r^2 - 2 R e.d + |d|^2),    D(theta, R) = r' - r = -cos(theta) e.d + O(|d|^2 / r).

Compensation subtracts the range D at one angle per pulse, as if the beam were narrow. Its cosine is
the mean over the processed beam, cos(m), which leaves the least mean square error:

1. First order: the whole echo of a pulse is moved by D(m) for the middle of the swath, phase and
   envelope, in the domain of frequencies.
2. Second order: after range compression, the range cell at r is multiplied by the phase of D(m) at
   R = r cos(m) less that of the first order. The envelope does not move.

What remains for a point (theta, R) at the frequency f0 + g is the phase

    phi = (4 pi / c) [f0 (D(theta, R) - D2(r)) + g (D(theta, R) - D1)],

where D1 and D2 are the corrections of the first and of both orders. To first order in d, phi has
three parts. The first is the change of D with the angle, -(cos(theta) - cos(m)) e.d, which a narrow
beam would not have. The second is cos(m) (R cos(m) / cos(theta) - R) (de/dR).d: a point migrates
over range cells while it is seen, and each range cell is corrected instead of each closest range.
The third is the envelope, which the second order does not move. For white noise each pulse, range,
angle and frequency contributes independently to the image. The relative image error is therefore
the mean of |exp(j phi) - 1|^2 over them, which `MotionCompensation.predicted_db` evaluates. For
points in a beam the mean over angles is weighted by the pattern of the antenna.

Uneven steps along the track are resampled by a non-uniform Fourier transform, the sum over pulses
in which backprojection also adds them, with the weight of the processed beam.

Reference:
    Moreira and Huang 1994, Airborne SAR processing of highly squinted data using a chirp scaling
    approach with integrated motion compensation, IEEE Trans. Geosci. Remote Sens. 32(5); Fornaro
    1999, Trajectory deviations in airborne SAR: analysis and compensation, IEEE Trans. Aerosp.
    Electron. Syst. 35(3) (first-order and range-dependent compensation).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import checked_samples, unit_phasor
from torchsar.core.fft import smooth_length
from torchsar.core.nufft import Kernel, Nufft, Points
from torchsar.focus.backprojection import direct_sum, expanded_history
from torchsar.focus.frame_geometry import BAND_EDGE
from torchsar.focus.gridding import PulseNufft
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.omega_k import STATIONARY_TURNS
from torchsar.focus.processed_beam import ProcessedBeam
from torchsar.focus.stolt import omega_k_stolt
from torchsar.radar import (
    LIGHT_M_S,
    AntennaPath,
    LinearFM,
    StraightTrack,
    StripmapRadar,
    frequency_samples,
    range_profiles,
)
from torchsar.radar.antenna_path import refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz

# number of zeros that are appended to the frequencies on each side, into which the spectrum of
# moved envelopes may spread, by choice
_MARGIN = 16
# relative errors of interpolations by dtype, by choice
_EPS = {torch.complex64: 1e-5, torch.complex128: 1e-11}


class MotionCompensation:
    """Motion compensation and omega-K imaging of one nearly straight path.

    >>> import torch
    >>> from torchsar import focus, radar
    >>> place_m = torch.tensor([[-300.0, 0.2 * y, 100.0] for y in range(-80, 80)]).double()
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> antennas = radar.AntennaPath(place_m, None, 2 * place_m.norm(dim=-1))
    >>> divmod(int(focus.MotionCompensation(9.6e9 + 1e7 * torch.arange(16).double(), antennas, grid,
    ...     focus.ProcessedBeam(3.0)).image(torch.ones(160, 16) + 0j).abs().argmax()), 17)
    (8, 8)

    The geometry is computed once, for any number of histories, whose phases are those of
    `backproject`. Differentiable in the histories.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        antennas: Path of an antenna that transmits and receives, without leading dimensions.
        grid: Pixels; the points of the scene are supposed to lie in their plane.
        beam: Processed beam.
        order: 1 to compensate for the middle of the swath only, 2 for all ranges.

    Raises:
        TypeError: If the frequencies are not float64.
        ValueError: If the path is bistatic or has leading dimensions, the order is not 1 or 2, the
            frequencies do not rise in equal steps, the antenna does not advance, the pulses
            undersample the beam, the image does not lie to one side of the track, the range window
            reaches the antenna, or the path is so far from straight that the predicted error
            exceeds -6 dB.
    """

    def __init__(
        self, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid, beam: ProcessedBeam, order: int = 2
    ) -> None:
        refuse_unusable(frequency_hz=frequency_hz)
        if antennas.receiver_m is not None:
            raise ValueError(
                "motion compensation refers to the straight track of one antenna, but this path is bistatic; image it "
                "by tiles"
            )
        if antennas.trials or order not in (1, 2):
            raise ValueError(
                "motion compensation has the order 1 or 2 and takes one path without leading dimensions, got the order "
                f"{order} and leading dimensions {tuple(antennas.trials)}"
            )
        n, step_hz = len(frequency_hz), frequency_step_hz(frequency_hz)
        self.frequency_hz, self.antennas, self.grid, self.beam, self.order = frequency_hz, antennas, grid, beam, order
        self.carrier_hz, self.sampling_hz = float(frequency_hz[n // 2]), n * step_hz
        self.track = StraightTrack.fitted(antennas.transmitter_m)
        # the pulses must sample the processed beam at each frequency
        spread = self.sampling_hz / self.carrier_hz
        band = beam.band * (1 + BAND_EDGE) * (1 + spread / 2) + abs(beam.middle) * spread
        needed, held = 2 * self.carrier_hz / LIGHT_M_S * band, 1 / self.track.step_m
        if needed > held:
            raise ValueError(
                f"pulses {self.track.step_m:.4g} m apart hold {held:.4g} cycles/m along the track, but a processed "
                f"beam of {beam.width_deg:g} degrees has {needed:.4g} with its edges; raise the PRF, or choose a "
                "narrower beam"
            )
        sine, share = beam.quadrature()
        self._cosine = float((share * torch.sqrt(1 - sine.square())).sum())
        # largest tangent of an angle that has a weight
        steepest = math.tan(math.asin(max(map(abs, beam.ends))))
        self._set_plane(steepest)
        # range to which the phases of all pulses refer
        self.window_m = float(antennas.reference_m.mean()) / 2
        middle = torch.full_like(self._pulse_m, sum(self._closest_m) / 2 / self._cosine)
        self._first_m = self._correction_m(middle[:, None])[:, 0]
        self._set_cells(step_hz, steepest)
        left = self.predicted_db()
        if left > -6:  # -6 dB, half the amplitude
            raise ValueError(
                f"the path is too far from straight, {float(self._off_m.abs().max()):.3g} m at most: motion "
                f"compensation would leave an image error of {left:.3g} dB; choose a narrower beam or image it by tiles"
            )

    def _set_cells(self, step_hz: float, steepest: float) -> None:
        """Choose the frequencies of the compensated data, which exceed those of the history, and
        compute the ranges of the cells.
        """
        n = len(self.frequency_hz)
        window = LIGHT_M_S / (2 * step_hz)
        if not self.window_m > window / 2:
            raise ValueError(
                f"the range window of {window:.4g} m about {self.window_m:.4g} m reaches the antenna; choose larger "
                "steps of frequency or image it by tiles"
            )
        # Omega-K lowers frequencies by their distance from the middle of the beam, and the second
        # order shifts them by the slope of the correction. Zeros make room for both, and for the
        # leakage of frequencies between two samples.
        lowered = 1 - math.cos(math.atan(steepest) - math.asin(abs(self.beam.middle)))
        ends = torch.tensor([self._closest_m], dtype=torch.float64, device=self._pulse_m.device)
        change = self._correction_m(ends / self._cosine).diff(dim=-1)
        slope = float(change.abs().max()) / max(self._closest_m[1] - self._closest_m[0], window / n)
        self.cells = smooth_length(n + 2 * _MARGIN + math.ceil(2 * self.carrier_hz * (lowered + slope) / step_hz))
        cell = torch.arange(self.cells, dtype=torch.float64, device=self.frequency_hz.device) - self.cells // 2
        self.range_m = self.window_m + cell * (window / self.cells)
        self._all_hz = self.carrier_hz + cell * step_hz

    def _set_plane(self, steepest: float) -> None:
        """Compute pulses and corners of the image in coordinates of the track."""
        grid, track = self.grid, self.track
        normal = torch.linalg.cross(grid.axes[0], grid.axes[1])
        up = normal - (normal @ track.along) * track.along
        tilt = torch.linalg.vector_norm(up).clamp_min(1e-6)
        side = torch.linalg.cross(track.along, up / tilt)
        pixels = grid.pixels_m(*(slice(None, None, max(1, n - 1)) for n in grid.counts)).reshape(-1, 3)
        across = track.across_m(pixels)
        off = across @ side
        if not bool((off > 0).all() | (off < 0).all()):
            raise ValueError(
                "motion compensation needs an image to one side of the track, but this one lies "
                f"{float(off.min()):.4g} m to {float(off.max()):.4g} m across; image it by tiles"
            )
        along, closest = track.along_m(pixels), torch.linalg.vector_norm(across, dim=-1)
        self._closest_m = float(closest.min()), float(closest.max())
        self._along_m = float(along.min()), float(along.max())
        # height of the plane above the track along `up`, and its slope along the track
        self._height_m = normal @ (grid.origin_m - track.origin_m) / tilt
        self._slope = normal @ track.along / tilt
        place = self.antennas.transmitter_m
        self._pulse_m = track.along_m(place)
        # deviations of the pulses to the side of the image and up, (pulse, 2)
        self._off_m = track.across_m(place) @ torch.stack([side * torch.sign(off[0]), up / tilt], -1)
        reach = self._closest_m[1] * steepest
        first = min(float(self._pulse_m.min()), float(along.min()) - reach)
        last = max(float(self._pulse_m.max()), float(along.max()) + reach)
        self.start_m, self.lines = first, smooth_length(math.ceil((last - first) / track.step_m) + 1)

    def _excess(self, along_m: Tensor, closest_m: Tensor, off_m: Tensor) -> Tensor:
        """Squared range of points from deviating pulses minus that from the track, in m^2.

        The points of the plane have the given coordinate along the track and closest range; off_m
        (..., 2) broadcasts with them.
        """
        sine = ((self._height_m - self._slope * along_m) / closest_m).clamp(-1, 1)
        toward = torch.sqrt(1 - sine.square()) * off_m[..., 0] + sine * off_m[..., 1]
        return off_m.square().sum(-1) - 2 * closest_m * toward

    def _correction_m(self, range_m: Tensor) -> Tensor:
        """Range correction in metres: range from each pulse minus that from the track, at ranges
        from the track, float64 (pulse, range).
        """
        along = self._pulse_m[:, None] + self.beam.middle * range_m
        excess = self._excess(along, self._cosine * range_m, self._off_m[:, None])
        return excess / (torch.sqrt((range_m.square() + excess).clamp_min(0)) + range_m)

    def predicted_db(self, pattern: Callable[[Tensor], Tensor] | None = None) -> float:
        """Predict the error of `image` relative to `exact`.

        Args:
            pattern: Power of the echo of a point over the sine of its angle ahead of broadside,
                such as that of an antenna; None for a history of white noise, which has all angles
                alike.

        Returns:
            Relative square error in dB. It is the mean of |exp(j phi) - 1|^2 over pulses, angles,
            closest ranges and frequencies, where phi is the phase that motion compensation leaves.
            The change over the swath of the Fresnel ripple of the beam's edges, and the leakage
            beyond the band, are added.
        """
        device, (low, high) = self._pulse_m.device, self._closest_m
        node, weight = (torch.from_numpy(x).to(device) for x in np.polynomial.legendre.leggauss(9))
        closest = (low + high) / 2 + node * (high - low) / 2
        weight = weight * closest / (weight * closest).sum()
        # the ripple depends on the product of range and frequency
        spread = self.sampling_hz / self.carrier_hz / math.sqrt(12)
        used, ripple = self._filter((low + high) / 2), torch.zeros_like(closest)
        for i, r in enumerate(closest.tolist()):
            for exact in (self._filter(r * (1 + side * spread)) for side in (-1, 1)):
                ripple[i] += (used - exact).abs().square().sum() / exact.abs().square().sum() / 2
        error = float((weight * (self._phase_error(closest, pattern) + ripple)).sum())
        # relative error power of the spread beyond the appended zeros, measured for white noise
        return 10 * math.log10(error + 0.025 / (_MARGIN * len(self.frequency_hz)))

    def _phase_error(self, closest_m: Tensor, pattern: Callable[[Tensor], Tensor] | None) -> Tensor:
        """Mean of |exp(j phi) - 1|^2 at closest ranges, float64 (range,)."""
        sine, share = (x.to(closest_m.device) for x in self.beam.quadrature())
        share = share if pattern is None else share * pattern(sine)
        some = slice(None, None, max(1, len(self._pulse_m) // 512))
        # shape (pulse, range, angle)
        range_m = closest_m[:, None] / torch.sqrt(1 - sine.square())
        along = self._pulse_m[some, None, None] + range_m * sine
        low, high = self._along_m
        share = share * ((along >= low) & (along <= high))
        excess = self._excess(along, closest_m[:, None], self._off_m[some, None, None])
        true = excess / (torch.sqrt(range_m.square() + excess) + range_m)
        first = self._first_m[some, None, None]
        both = self._correction_m(range_m.reshape(1, -1))[some].reshape(true.shape) if self.order == 2 else first
        wave = 4 * math.pi / LIGHT_M_S
        error = torch.zeros_like(true)
        for offset, part in zip(*np.polynomial.legendre.leggauss(5), strict=True):
            phase = self.carrier_hz * (true - both) + float(offset) * self.sampling_hz / 2 * (true - first)
            error += float(part) * (1 - torch.cos(wave * phase))
        return (share * error).sum((0, 2)) / share.sum((0, 2)).clamp_min(1e-30)

    def even_pulses(self, profiles: Tensor) -> Tensor:
        """Resample compensated pulses to even steps along the track, within the processed beam.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.

        Returns:
            Range profiles of the nominal track, shape (..., line, range). Line i lies at start_m +
            i step_m along the track.
        """
        dtype, f, length = profiles.dtype, self._all_hz, self.lines * self.track.step_m
        number = self._bins()
        first = int(number[0])
        plan = PulseNufft(self.lines, Kernel.of(_EPS[dtype]), dtype, f.device)
        point = (self.start_m - self._pulse_m) / length
        samples = frequency_samples(profiles) * unit_phasor(point * (first + self.lines // 2), dtype)[:, None]
        spectrum = plan.type1(samples, plan.points(point))
        filtered = self._filter(sum(self._closest_m) / 2)
        # the filter depends on the angle, which at each frequency belongs to another line
        at = (number[:, None] * (self.carrier_hz / f) - first).clamp(0, self.lines - 1.001)
        below = at.floor().long()
        weight = torch.lerp(filtered[below], filtered[below + 1], (at - below).to(filtered))
        weight = weight * torch.sqrt(self.carrier_hz / f)
        spectrum = (spectrum * weight.to(dtype)).roll(first, -2)
        return range_profiles(torch.fft.ifft(spectrum, dim=-2))

    def _bins(self) -> Tensor:
        """Frequency numbers along the track, in cycles per circular length of all lines, around the
        middle of the beam, float64 (line,).
        """
        middle = 2 * self.carrier_hz / LIGHT_M_S * self.beam.middle * self.lines * self.track.step_m
        number = torch.arange(self.lines, dtype=torch.float64, device=self._pulse_m.device)
        return number + (round(middle) - self.lines // 2)

    def _filter(self, closest_m: float) -> Tensor:
        """Spectrum along the track of the weighted sum over pulses for a point at a closest range,
        complex128 (line,).

        It is relative to that of omega-K. By stationary phase it is the weight at the angle times
        cos^(-3/2). The exact sum also has the Fresnel ripple of the edges of the beam.
        """
        step, wave, r = self.track.step_m, 2 * self.carrier_hz / LIGHT_M_S, closest_m
        number = torch.arange(self.lines, dtype=torch.float64, device=self._pulse_m.device)
        behind = step * torch.where(2 * number < self.lines, number, number - self.lines)
        slant = torch.sqrt(r**2 + behind.square())
        kernel = self.beam.weight(-behind / slant) * unit_phasor(wave * behind.square() / (slant + r), torch.complex128)
        number = self._bins()
        exact = torch.fft.ifft(kernel, norm="forward")[number.long() % self.lines]
        sine = (number / (self.lines * step * wave)).clamp(-1, 1)
        turns = -wave * r * sine.square() / (1 + torch.sqrt(1 - sine.square())) + STATIONARY_TURNS
        return exact * unit_phasor(-turns, torch.complex128) * (step * math.sqrt(wave / r))

    def straight(self, history: Tensor) -> Tensor:
        """Compute the range profiles that the nominal track would have recorded at even pulses.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.

        Returns:
            Range profiles, shape (..., line, range), see `even_pulses`.
        """
        # First order: the middle of the swath is moved to its nominal range. Phases refer to the
        # range `window_m` at all pulses.
        moved = 2 * (self._first_m + self.window_m) - self.antennas.reference_m
        history = history * unit_phasor(moved[:, None] * self.frequency_hz / LIGHT_M_S, history.dtype)
        before = self.cells // 2 - history.shape[-1] // 2
        profiles = range_profiles(pad(history, (before, self.cells - history.shape[-1] - before)))
        if self.order == 2:
            # phase that the first order leaves in each range cell
            left = self._correction_m(self.range_m[None]) - self._first_m[:, None]
            profiles = profiles * unit_phasor(2 * self.carrier_hz / LIGHT_M_S * left, profiles.dtype)
        return self.even_pulses(profiles)

    def image(self, history: Tensor) -> Tensor:
        """Form the image by motion compensation and omega-K.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.

        Returns:
            Image, shape (..., i, j), the sum of `backproject` over pulses with the weights of the
            processed beam.

        Raises:
            TypeError: If the history is not complex64 or complex128.
            ValueError: If its size is not that of the path and the frequencies.
        """
        history = checked_samples(history, "motion compensation", "pulse, frequency", finite=False)
        history = expanded_history(history, self.antennas, self.frequency_hz, "motion compensation")
        data = self.straight(history)
        step, beam = self.track.step_m, self.beam
        doppler = 2 * self.carrier_hz / LIGHT_M_S * beam.middle
        sampling = self.sampling_hz * self.cells / len(self.frequency_hz)
        near = self.window_m - self.cells // 2 * LIGHT_M_S / (2 * sampling)
        # slow time is the coordinate along the track at a speed of 1 m/s; the aperture is that of
        # the beam
        pulse, aperture = LinearFM(self.sampling_hz, 1.0), near * beam.band / (1 - beam.middle**2)
        radar = StripmapRadar(self.carrier_hz, pulse, sampling, 1 / step, 1.0, near, None, aperture)
        eps = 1e-12 if data.dtype == torch.complex128 else 2e-4
        return self._on_grid(omega_k_stolt(data, radar, doppler_hz=doppler, eps=eps))

    def _on_grid(self, image: Tensor) -> Tensor:
        """Interpolate the image of omega-K at the pixels, with the phase and scale of the sum."""
        lines, n = image.shape[-2:]
        step, sine = self.track.step_m * self.lines / lines, self.beam.middle
        cosine, wave = math.sqrt(1 - sine**2), 2 * self.carrier_hz / LIGHT_M_S
        middle = round(wave * sine * lines * step)
        eps = _EPS[image.dtype]
        plans = [Nufft(size, eps, image.dtype, image.device) for size in (lines, n)]
        spectrum = torch.fft.fft2(image).roll((lines // 2 - middle, n // 2), (-2, -1)) / (lines * n)
        grid = plans[0].grid(plans[1].grid(spectrum).mT)  # shape (..., range, line)
        made = []
        for pixels in self.grid.pixels_m().reshape(-1, 3).split(1 << 18):
            closest = torch.linalg.vector_norm(self.track.across_m(pixels), dim=-1)
            slant = closest / cosine
            line = (self.track.along_m(pixels) - sine * slant - self.start_m) / step
            beyond = slant - self.window_m
            cell = beyond * (2 * self.sampling_hz / LIGHT_M_S * n / len(self.frequency_hz)) + n // 2
            points = [plan.points(-at / size) for plan, at, size in zip(plans, (line, cell), (lines, n), strict=True)]
            turns = wave * beyond + middle / lines * line
            scale = torch.sqrt(closest * n / wave) / self.track.step_m
            made.append(interpolate_plane(grid, points[1], points[0]) * unit_phasor(turns, image.dtype) * scale)
        return torch.cat(made, -1).to(image.dtype).unflatten(-1, self.grid.counts)

    def exact(self, history: Tensor, pixels_m: Tensor, eps: float = 1e-10) -> Tensor:
        """Sum over the pulses of the true path with the weights of the processed beam: the direct
        sum that `image` approximates.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            pixels_m: Positions of pixels in metres, float64 (pixel, 3).
            eps: Relative error of the interpolation in range.

        Returns:
            Image, shape (..., pixel).
        """
        along, closest = self.track.along_m(pixels_m), torch.linalg.vector_norm(self.track.across_m(pixels_m), dim=-1)

        def path(pulses: slice, pixels: slice) -> tuple[Tensor, Tensor]:
            ahead = along[pixels] - self._pulse_m[pulses, None]
            weight = self.beam.weight(ahead / torch.sqrt(ahead.square() + closest[pixels].square()))
            return self.antennas.path_m(pixels_m[pixels], pulses), weight

        return direct_sum(history, self.frequency_hz, path, len(pixels_m), eps=eps)


def compensated_omega_k(
    history: Tensor,
    frequency_hz: Tensor,
    transmitter_m: Tensor,
    reference_m: Tensor,
    grid: ImageGrid,
    beam: ProcessedBeam,
    order: int = 2,
) -> Tensor:
    """Form the image of one antenna on a nearly straight path by motion compensation and omega-K.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.2 * y, 100.0] for y in range(-80, 80)]).double()
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> image = focus.compensated_omega_k(
    ...     torch.ones(160, 16) + 0j, 9.6e9 + 1e7 * torch.arange(16).double(), place_m,
    ...     2 * place_m.norm(dim=-1), grid, focus.ProcessedBeam(3.0))
    >>> divmod(int(image.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    It takes a fraction of the time of tiles, with the error that `MotionCompensation.predicted_db`
    predicts; `image_tiles` serves any path. Differentiable in the history.

    Args:
        history: Phase history, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the antenna in metres, float64 (..., pulse, 3).
        reference_m: Path to which the phases refer in metres, twice the reference range, float64
            (..., pulse).
        grid: Pixels; the points of the scene are supposed to lie in their plane.
        beam: Processed beam.
        order: 1 to compensate for the middle of the swath only, 2 for all ranges.

    Returns:
        Image, shape (..., i, j), the sum of `backproject` over pulses with the weights of the
        processed beam.

    Raises:
        TypeError: If the history is not complex64 or complex128, or frequencies or positions are
            not float64.
        ValueError: If shapes do not match, values are not finite, or a path does not suit, see
            `MotionCompensation`.
    """
    return compensated_image(history, frequency_hz, AntennaPath(transmitter_m, None, reference_m), grid, beam, order)


def compensated_image(
    history: Tensor, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid, beam: ProcessedBeam, order: int
) -> Tensor:
    """Form the image of `compensated_omega_k` for a path of one antenna.

    Args:
        history: Phase history, shape (..., pulse, frequency).
        frequency_hz: Frequencies in Hz, shape (frequency,).
        antennas: Path of the antenna, which may have trials.
        grid: Pixels of the image.
        beam: Processed beam.
        order: Order of the compensation.

    Returns:
        The image, shape (..., row, column).
    """
    history = checked_samples(history, "compensated_omega_k", "pulse, frequency", finite=False)
    history = expanded_history(history, antennas, frequency_hz, "compensated_omega_k")
    if not antennas.trials:
        return MotionCompensation(frequency_hz, antennas, grid, beam, order).image(history)
    trials = history.shape[:-2]
    images = [
        MotionCompensation(frequency_hz, antennas.of_trial(index, trials), grid, beam, order).image(history[index])
        for index in itertools.product(*map(range, trials))
    ]
    return torch.stack(images).unflatten(0, trials)


def interpolate_plane(grid: Tensor, rows: Points, columns: Points) -> Tensor:
    """Interpolate a periodic grid at points of a plane.

    Args:
        grid: Grid, shape (..., row, column), complex.
        rows: Coordinates of the points along the rows, shape (m,).
        columns: Coordinates along the columns, shape (m,).

    Returns:
        Values at the points, shape (..., m).
    """
    size = grid.shape[-2:]
    flat = grid.flatten(-2)
    value = None
    for i, across in enumerate(rows.weights):
        row = (rows.first + i) % size[0] * size[1]
        for j, along in enumerate(columns.weights):
            one = flat.index_select(-1, row + (columns.first + j) % size[1]) * (across * along)
            value = one if value is None else value + one
    assert value is not None
    return value
