"""Image of a stationary scene and of its moving targets at their true positions.

The conventional image is formed and targets are detected in it. The targets are then processed one
after the other, the strongest first. The range lines around a target are extracted and its velocity
is estimated. Its echo is removed from the data, and it is imaged with its own velocity at its true
position. Removal of the echo also removes the false targets that it causes, so that these are not
detected as targets. Weaker targets are then sought in an image in which the sea is suppressed.

Reference:
    Remote Sens. 2020, 12, 1703, Fig. 13 and section 4.3.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, Signal, Stage, fft_lines, linear_phasor
from torchsar.multichannel.balance import estimate_balance
from torchsar.multichannel.body import Body, body_echo, body_image, find_body, known_body
from torchsar.multichannel.chip import Detection, Extraction, detect
from torchsar.multichannel.migration import Frame
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import LeastSquares, MinimumMeanSquare, Rebuild
from torchsar.multichannel.response import FlatBand, band_matrix, first_bin, shared_response
from torchsar.multichannel.stationary import StationaryImage, stationary_axis
from torchsar.multichannel.velocity.whitening import line_whitening
from torchsar.radar import BistaticRadar

Removal = Literal["subtract", "zero"]


@dataclass(frozen=True)
class Detector:
    """Settings of the detection of moving targets in images.

    >>> import torch
    >>> from torchsar import Axis, Signal, multichannel
    >>> axes = Axis("azimuth", 256, -256.0, 2.0, "m"), Axis("range", 64, 4840.0, 5.0, "m")
    >>> image = torch.ones(256, 64, dtype=torch.complex64)
    >>> image[168:188, 31:34], image[40:60, 10:13] = 10, 5  # two ships
    >>> [len(multichannel.Detector(level).found(Signal(image, axes))) for level in (5, 15)]  # dB
    [2, 1]

    Args:
        threshold_db: Least contrast of a target in dB: the mean intensity of a small rectangle of
            pixels (neighbourhood) relative to the median over all of them.
        extent_m: Extent of a neighbourhood in azimuth and range in metres.
        apart_m: Least separation of detections in azimuth and range in metres.
        most: Largest number of targets.
        suppressed_m_s: Slant-range speeds in m/s, closing positive, to which an image with
            suppressed sea is matched. Weaker targets are detected in this image. Empty to omit it.

    Raises:
        ValueError: If the threshold, an extent or a separation is not positive, or `most` is below
            1.
    """

    threshold_db: float = 10.0
    extent_m: tuple[float, float] = (60.0, 10.0)
    apart_m: tuple[float, float] = (250.0, 40.0)
    most: int = 8
    suppressed_m_s: Sequence[float] = (-16.0, -10.0, -5.0, 5.0, 10.0, 16.0)

    def __post_init__(self) -> None:
        if not (self.threshold_db > 0 and all(x > 0 for x in (*self.extent_m, *self.apart_m)) and self.most >= 1):
            raise ValueError(
                "a detector needs threshold_db above 0, positive extent_m and apart_m, and at least 1 for most, "
                f"the largest number of targets, got {self}"
            )

    def found(self, image: Signal) -> list[Detection]:
        """Return the targets that are detected in an image (azimuth, range), strongest first."""
        return detect(image, self.threshold_db, self.extent_m, self.apart_m, self.most)


@dataclass(frozen=True)
class SceneImage:
    """Images of a scene with moving targets.

    >>> import torch
    >>> from torchsar import Signal, multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> channels = Signal(torch.ones(3, 32, 64, dtype=torch.complex64), receiver.axes(32, 64))
    >>> images = multichannel.ImageMovers(receiver)(channels, known=[])
    >>> images.fused.names, len(images.bodies)
    (('azimuth', 'range'), 0)

    Args:
        conventional: Image (..., azimuth, range) of all data as if the whole scene were stationary.
        rest: Image of the data without the moving targets.
        fused: Image `rest` with every moving target at its true position.
        bodies: All targets, strongest first; with trials, a list of them for each trial, in the
            order of the flattened trials.
        estimate: `u_r_m_s`, `u_a_m_s`, `y0_m`, `range_m` of the targets, (..., target). Each has as
            many entries as the detector may find targets (`Detector.most`); entries without a
            target are zero, and their outcome is `ABSENT`, but `NOISE` if there is no target at
            all. Outcomes of targets are those of `Body`, or `UNBALANCED` where the stationary
            clutter shows that the channels differ by as much as a slant-range speed of 0.3 m/s.
        data: Channels from which the moving targets were removed.
    """

    conventional: Signal
    rest: Signal
    fused: Signal
    bodies: list[Any]
    estimate: Estimate
    data: Signal


class ImageMovers(Stage):
    """Stage that images a scene and its moving targets, from channels to a `SceneImage`.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([6], [0], [0], [0]), scene.BandLimited(0.5))
    >>> channels = echo.simulate_bistatic(receiver, world, 160, 84, Draws(seed=1))[0].signal
    >>> images = multichannel.ImageMovers(receiver, multichannel.Extraction(60, 30, 0.5, 0.25))(
    ...     channels, known=[multichannel.PointMotion.of(receiver, channels.data, 6.0)]
    ... )  # the target is at azimuth sample 160
    >>> [int(x.data.abs().amax(-1).argmax()) for x in (images.conventional, images.fused)]
    [280, 160]

    The channels (channel, pulse, range) are range compressed and balanced, and the transmit range
    has been removed from their phase.

    Args:
        radar: Radar parameters.
        extraction: Extent of a target in the data.
        detector: Settings of the detection.
        rebuild: Reconstruction method for the stationary scene, `LeastSquares()` by default.
        removal: "subtract" removes the echo fitted to a moving target. "zero" removes all data in
            the range lines and Doppler bins of the target, including the sea, as in Remote Sens.
            2020, 12, 1703.
        slowest_m_s: Least slant-range and least along-track speed in m/s. A target that exceeds one
            of them counts as moving; other targets stay in the image as stationary ones.
        u_a_half_m_s: Half width of the search in the along-track speed u_a in m/s.
        assess: Whether the outcomes of the targets are reported. A target is removed and focused
            again only if its motion is reliable, with either value.

    Raises:
        ValueError: If `removal` is unknown, or there are too few channels for the bands.
    """

    works_on = ("channel", "pulse", "range")
    differentiable = "no"

    def __init__(
        self,
        radar: BistaticRadar,
        extraction: Extraction | None = None,
        detector: Detector | None = None,
        rebuild: Rebuild | None = None,
        removal: Removal = "subtract",
        slowest_m_s: tuple[float, float] = (0.3, 1.0),
        u_a_half_m_s: float = 20.0,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__()
        if removal not in ("subtract", "zero"):
            raise ValueError(f"removal must be 'subtract' or 'zero', got {removal!r}")
        self.radar, self.extraction, self.detector = radar, extraction or Extraction(), detector or Detector()
        self.image, self.removal = StationaryImage(radar, rebuild or LeastSquares()), removal
        self.slowest_m_s, self.u_a_half_m_s, self.assess = slowest_m_s, u_a_half_m_s, assess

    def forward(self, signal: Signal, known: Sequence[PointMotion] | None = None) -> SceneImage:
        """Image recordings with their moving targets.

        A warning is given if the swath is too narrow for any target to be detected.

        Args:
            signal: Channels with the axes (channel, pulse, range).
            known: Motions of the middles of all targets, strongest first, if they are known a
                priori; their values have the shape of the trials, or broadcast to it. No targets
                are then detected. None to detect the targets in the images.

        Returns:
            The images and the targets.

        Raises:
            ValueError: If more motions are known than the detector allows, or as in
                `StationaryImage.forward` and `chip_about`.
        """
        axis, trials = signal.axis("range"), signal.trials
        if known is None and not self._inside_frame(
            Detection(0.0, axis.start + axis.step * (axis.n // 2), 0.0), signal
        ):
            warnings.warn(
                f"no target can be detected in a swath of {axis.n} range lines, since its range walk "
                "exceeds the swath; give more lines, or a smaller extraction",
                stacklevel=3,
            )
        made = []
        for i, data in enumerate(signal.data.reshape(-1, *signal.data.shape[-3:])):
            own = None if known is None else [motion.each(partial(_of_trial, trials, i)) for motion in known]
            left, found = self._extracted(Signal(data, signal.axes), own)
            rest = fused = self.image(left)
            for body in filter(self._moves, found):
                fused = placed(fused, body, self.extraction)
            made.append((found, self.image(Signal(data, signal.axes)), rest, fused, left))
        bodies, *parts = zip(*made, strict=True)
        conventional, rest, fused, data = (
            Signal(torch.stack([x.data for x in of]).unflatten(0, trials) if trials else of[0].data, of[0].axes)
            for of in parts
        )
        estimate = Estimate.joined([self._estimate(found, signal.data) for found in bodies], trials)
        if self.assess and any(bodies):
            unequal = unbalanced(signal.data, self.radar, self.image.rebuild)[..., None]
            outcome = torch.where(unequal, estimate.outcome.clamp_min(Outcome.UNBALANCED), estimate.outcome)
            estimate = replace(estimate, outcome=outcome)
        return SceneImage(conventional, rest, fused, list(bodies) if trials else bodies[0], estimate, data)

    def _extracted(self, remaining: Signal, known: Sequence[PointMotion] | None) -> tuple[Signal, list[Body]]:
        """Return the data of one trial without its moving bodies, and a list of all bodies."""
        if known is not None:
            return self._extract_known(remaining, known)
        remaining, bodies = self._extract_detected(remaining, self.image, [])
        if self.detector.suppressed_m_s:
            speeds_m_s = self.detector.suppressed_m_s
            shown = partial(suppressed_image, radar=self.radar, image=self.image, speeds_m_s=speeds_m_s)
            remaining, bodies = self._extract_detected(remaining, shown, bodies)
        return remaining, bodies

    def _extract_detected(self, remaining: Signal, image_of, bodies: list[Body]) -> tuple[Signal, list[Body]]:
        """Detect targets and remove those that move, strongest first, until no new one is found."""
        bodies, visited = list(bodies), [self._apparent_position(body) for body in bodies]
        candidates, apart_m = self.detector.found(image_of(remaining)), self.detector.apart_m
        while candidates and len(bodies) < self.detector.most:
            candidate = candidates.pop(0)
            away = [(abs(candidate.azimuth_m - x.azimuth_m), abs(candidate.range_m - x.range_m)) for x in visited]
            known = any(along < apart_m[0] / 2 and across < apart_m[1] for along, across in away)
            if known or not self._inside_frame(candidate, remaining):
                continue
            visited.append(candidate)
            lines, frame = self._lines(remaining, candidate.range_m)
            image_s, image_m = candidate.azimuth_m / self.radar.speed_m_s, candidate.range_m
            data = remaining.data[..., lines]
            body = find_body(data, frame, image_s, image_m, self.extraction, u_a_half_m_s=self.u_a_half_m_s)
            if not bool(body.ok) or any(self._side_lobe(body, other) for other in bodies):
                continue
            bodies.append(body)
            visited.append(self._apparent_position(body))
            if self._moves(body):
                remaining = self._removed(remaining, body)
                candidates = self.detector.found(image_of(remaining))
        return remaining, bodies

    def _extract_known(self, remaining: Signal, known: Sequence[PointMotion]) -> tuple[Signal, list[Body]]:
        """Form the bodies of known motions and remove those that move."""
        if len(known) > self.detector.most:
            raise ValueError(
                f"{len(known)} motions are known, but the detector allows at most {self.detector.most} "
                "targets; increase the setting `most` of the detector"
            )
        bodies = []
        for motion in known:
            lines, frame = self._lines(remaining, float(motion.range_m))
            body = known_body(remaining.data[..., lines], frame, motion, self.extraction)
            bodies.append(body)
            if self._moves(body):
                remaining = self._removed(remaining, body)
        return remaining, bodies

    def _inside_frame(self, detection: Detection, signal: Signal) -> bool:
        """Test if a target remains in the swath at any velocity and is broadside within
        the record.
        """
        axis, pulse = signal.axis("range"), signal.axis("pulse")
        abeam_s = detection.azimuth_m / self.radar.speed_m_s
        walk = self.extraction.range_m + self.radar.ambiguous_velocity_m_s / 2 * (
            abs(abeam_s) + self.extraction.integration_s / 2
        )
        curvature = (self.extraction.integration_s * self.radar.speed_m_s) ** 2 / (8 * self.radar.reference_range_m)
        return (
            axis.start + walk <= detection.range_m <= axis.stop - walk - curvature
            and pulse.start < abeam_s < pulse.stop
        )

    def _side_lobe(self, body: Body, other: Body) -> bool:
        """Test whether a body may be range side lobes of another one, outside the removed lines.

        It then has the same azimuth and nearly the same velocity as the other one. Side lobes have
        the Doppler rate of their target, (v - u_a)^2 / R at the speed v, but at a range R of their
        own, which changes the along-track speed that is found.
        """
        # Both limits were found by trial. A larger difference than 5 m/s rejects targets beside a
        # ship, a smaller one accepts its side lobes as targets. The factor of 20 allows for the
        # many points of a body, whose brightest ones exceed the mean level.
        away_m, cell_m = (
            float((body.motion.range_m - other.motion.range_m).abs()),
            self.radar.wave_speed_m_s / self.radar.pulse.bandwidth_hz,
        )
        along_m_s = other.motion.along_m_s * (body.motion.range_m / other.motion.range_m).sqrt()
        off_m_s = (body.motion.u_r_m_s - other.motion.u_r_m_s, body.motion.along_m_s - along_m_s)
        off_m = abs(self._apparent_position(body).azimuth_m - self._apparent_position(other).azimuth_m)
        most = 20.0 * float(other.level) * (cell_m / (math.pi * max(away_m, cell_m))) ** 2
        near = max(abs(float(off)) for off in off_m_s) < 5.0 and off_m < self.detector.apart_m[0] / 2
        return near and float(body.level) < most

    def _apparent_position(self, body: Body) -> Detection:
        """Return the position at which an image of the stationary scene shows a body."""
        return Detection(
            self.radar.speed_m_s * float(body.motion.image_s),
            float(body.motion.closest_m),
            10 * math.log10(max(float(body.level), 1e-30)),
        )

    def _moves(self, body: Body) -> bool:
        """Test whether a body exceeds the least speed of a moving target."""
        return bool(body.motion.u_r_m_s.abs() > self.slowest_m_s[0]) or bool(
            body.motion.u_a_m_s.abs() > self.slowest_m_s[1]
        )

    def _lines(self, signal: Signal, near_m: float) -> tuple[slice, Frame]:
        """Return the lines around a range, with lines beside it for the covariance of the sea."""
        axis = signal.axis("range")
        # 6 guard cells, and 28 lines for the covariance of the sea. By trial, 20 to 80 lines give
        # the same velocities, and 80 take 1.4 times the time. They also cover the migration of the
        # body.
        half = math.ceil(self.extraction.range_m / axis.step) + 34
        at = round((near_m - axis.start) / axis.step)
        lines = slice(max(0, at - half), min(axis.n, at + half))
        frame = Frame.of(self.radar, signal)
        return lines, replace(frame, range_m=frame.range_m[lines])

    def _removed(self, signal: Signal, body: Body) -> Signal:
        """Return the data without the echo of a body."""
        lines, frame = self._lines(signal, float(body.motion.range_m))
        data = signal.data.clone()
        data[..., lines] -= body_echo(body, frame, everything=self.removal == "zero").to(data.dtype)
        return signal.with_data(data)

    def _estimate(self, bodies: list[Body], like: Tensor) -> Estimate:
        """Form the estimate of all targets, padded to the `most` of the detector, (1, target)."""
        most = self.detector.most

        def row(values: list[Tensor]) -> Tensor:
            kept = torch.stack(values) if values else like.real.new_zeros(0, dtype=torch.float64)
            rest = torch.zeros(most - len(kept), dtype=torch.float64, device=like.device)
            return torch.cat([kept.to(torch.float64), rest])[None]

        names = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
        value = {name: row([getattr(body.motion, name) for body in bodies]) for name in names}
        missing = row([torch.ones_like(body.level) for body in bodies]) == 0
        outcome = row([body.outcome for body in bodies]).long()
        if not self.assess:
            outcome = Outcome.NOT_ASSESSED.like(outcome)
        level = row([body.level for body in bodies])
        return Estimate(
            value,
            {"u_r_m_s": row([body.u_r_std_m_s for body in bodies])},
            level / (100.0 + level),  # the quality is one half at 20 dB, by convention
            outcome.masked_fill(missing, Outcome.ABSENT if bodies else Outcome.NOISE),
            info={"level": level},
        )


def _of_trial(trials: torch.Size, i: int, x: Tensor) -> Tensor:
    """Value () for one trial of a tensor that broadcasts to the trials."""
    return x.expand(trials).reshape(-1)[i]


def unbalanced(data: Tensor, radar: BistaticRadar, rebuild: Rebuild, most_m_s: float = 0.3) -> Tensor:
    """Test whether stationary clutter shows that the channels are not balanced.

    The channels are balanced once more. They count as unbalanced if the clutter determines their
    differences, and one of these is large. It is at least the phase, in radians or nepers, that a
    slant-range speed of `most_m_s` causes over the array, and exceeds four standard deviations.
    Clutter that does not determine the differences is no evidence.

    Args:
        data: Range-compressed channels with the transmit range removed, shape (..., channel, pulse,
            range), complex.
        radar: Radar parameters.
        rebuild: Reconstruction method, which says what Doppler bands the clutter is expected in.
        most_m_s: The slant-range speed in m/s; by default, the deviation from which on the speed of
            a target is `INEXACT`.

    Returns:
        True where they are not balanced, bool (...,).
    """
    prior = rebuild.prior if isinstance(rebuild, MinimumMeanSquare) else FlatBand(rebuild.bands * radar.prf_hz)
    bands = math.ceil(prior.bandwidth_hz / radar.prf_hz) if isinstance(prior, FlatBand) else None
    inside = int(data.shape[-1] * radar.pulse.bandwidth_hz / radar.sampling_hz)
    found = estimate_balance(data, radar, prior, bands, blocks=min(16, inside))
    reach_m = max(radar.channel_m) - min(radar.channel_m)
    least = math.pi * reach_m * most_m_s / (radar.wavelength_m * radar.speed_m_s)
    # rms over the band of the phase of a delay
    scales = {
        "phase_rad": 1.0,
        "gain_db": math.log(10) / 20,
        "delay_s": math.pi * radar.pulse.bandwidth_hz / math.sqrt(3),
    }
    off = [(scale * found[k].abs() > least) & (found[k].abs() > 4.0 * found.std[k]) for k, scale in scales.items()]
    return found.ok & torch.stack(off).any(0).any(-1)


class MoversImage(Stage):
    """Stage for chains that images the scene and the moving targets of every trial.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([6], [0], [0], [0]), scene.BandLimited(0.5))
    >>> recording, truth = echo.simulate_bistatic(receiver, world, 160, 84, Draws(seed=1))
    >>> images = multichannel.MoversImage(
    ...     receiver, multichannel.LeastSquares(2), "subtract",
    ...     multichannel.Extraction(60, 30, 0.5, 0.25), multichannel.Detector(most=2),
    ... )
    >>> images(recording.signal, **{n: truth.values[n] for n in images.provides})[1]["u_r_m_s"]
    tensor([6., 0.], dtype=torch.float64)

    It applies `ImageMovers`. Its outputs are the image with every moving target at
    its true position, and an estimate of the motions.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction method for the stationary scene.
        removal: "subtract" or "zero", see `ImageMovers`.
        extraction: Extent of a target in the data.
        detector: Settings of the detection.
        u_a_half_m_s: Half width of the search in the along-track speed u_a in m/s.
        assess: Whether the outcomes of the targets are reported. A target is removed and focused
            again only if its motion is reliable, with either value.
    """

    works_on = ("channel", "pulse", "range")
    provides = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
    differentiable = "no"

    def __init__(
        self,
        radar: BistaticRadar,
        rebuild: Rebuild,
        removal: Removal,
        extraction: Extraction,
        detector: Detector,
        u_a_half_m_s: float = 20.0,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__()
        self.flow = ImageMovers(radar, extraction, detector, rebuild, removal, u_a_half_m_s=u_a_half_m_s, assess=assess)
        self.neutral = {**dict.fromkeys(self.provides, 0.0), "range_m": radar.reference_range_m}

    def forward(
        self,
        signal: Signal,
        u_r_m_s: Tensor | None = None,
        u_a_m_s: Tensor | None = None,
        y0_m: Tensor | None = None,
        range_m: Tensor | None = None,
    ) -> tuple[Signal, Estimate]:
        """Image the scene and the moving targets of every trial.

        Args:
            signal: Range-compressed channels (..., channel, pulse, range) with the transmit range
                removed from the phase.
            u_r_m_s, u_a_m_s, y0_m, range_m: Motions of all targets, (..., target) each, strongest
                first, if known a priori: all four, or none.

        Returns:
            The images with every moving target at its true position, (..., azimuth, range), and the
            estimate of the motions with values of shape (..., target), padded with zeros to
            `Detector.most` targets, see `SceneImage`. The `info` of the estimate holds `level`, the
            ratio of the mean intensity of each target to the residual sea and noise (0 where there
            is no target), and the images `rest` and `conventional`, see `SceneImage`.

        Raises:
            ValueError: If some of the four values are missing, or as in `ImageMovers`.
        """
        values = [x for x in (u_r_m_s, u_a_m_s, y0_m, range_m) if x is not None]
        if len(values) not in (0, 4):
            raise ValueError(
                "known targets need all of u_r_m_s, u_a_m_s, y0_m and range_m, got only some of them; "
                "connect all four, or none to detect the targets"
            )
        known = zip(*(x.to(torch.float64).unbind(-1) for x in values), strict=True) if values else None
        motions = None if known is None else [PointMotion.of(self.flow.radar, signal.data.real, *of) for of in known]
        made = self.flow(signal, motions)
        info = {**made.estimate.info, "rest": made.rest.data, "conventional": made.conventional.data}
        return made.fused, replace(made.estimate, info=info)


def suppressed_image(
    signal: Signal, radar: BistaticRadar, image: StationaryImage, speeds_m_s: Sequence[float]
) -> Signal:
    """Image moving targets with suppressed sea, matched to several slant-range speeds.

    In every Doppler bin the channels are weighted by the inverse of their covariance, which is
    estimated from all range lines and neighbouring bins. They are then weighted by the channel
    response to a point of each speed. This extends the Doppler filter of the Reference to several
    channels. The intensity image of each speed is divided by its median, and the maximum over the
    speeds is taken in each pixel.

    Args:
        signal: Channels with the axes (channel, pulse, range), without trials.
        radar: Radar parameters.
        image: Stage that forms the conventional image.
        speeds_m_s: Slant-range speeds in m/s, closing positive.

    Returns:
        Amplitudes (real values with the complex dtype of the signal) on the axes (azimuth, range)
        of the conventional image.

    Reference:
        Remote Sens. 2020, 12, 1703, section 4.3 (clutter suppression via Doppler filtering).
    """
    data = signal.data.movedim(-1, -3)
    # the covariance is averaged over all lines and four neighbouring Doppler bins
    whitening = line_whitening(data, radar, samples=4 * data.shape[-3])
    backed = whitening.backed(data.to(torch.complex128)).movedim(-3, -1).to(signal.data.dtype)
    best = signal.data.real.new_zeros(())
    for speed in speeds_m_s:
        motion = PointMotion.of(radar, signal.data.real, speed)
        shown = image.focused(_matched(backed, radar, motion, image.rebuild.bands), signal)
        level = shown.data.abs().square()
        best = torch.maximum(best, level / level.median().clamp_min(torch.finfo(level.dtype).tiny))
    axes = (stationary_axis(radar, signal.axis("pulse"), image.rebuild.bands), signal.axis("range"))
    return Signal(best.sqrt().to(signal.data.dtype), axes)


def _matched(data: Tensor, radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """Return the Doppler spectrum of points of one speed in channels (channel, pulse, range).

    Bins lie about zero Doppler, shape (bands * pulse, range).
    """
    n = data.shape[-2]
    spectrum = torch.roll(fft_lines(torch.fft.ifftshift(data, dim=-2)), -first_bin(n, bands), -2)
    # Bins lie about zero Doppler, not about the Doppler centre f_dc of the point. Its response at
    # Doppler f is that at offset f - f_dc.
    turns = motion.u_r_m_s / radar.wavelength_m * radar.channels_at(data.device) / motion.effective_m_s
    shift = linear_phasor(-turns, 1, 1, data.dtype)
    response = (
        shared_response(radar, replace(motion, u_r_m_s=torch.zeros_like(motion.u_r_m_s)), n, bands, data.dtype)
        * shift.conj()
    )
    weights = band_matrix(radar, motion, bands).mH.to(data.dtype)
    return (
        (weights @ (spectrum * response.conj()[..., None]).flatten(-2)).unflatten(-1, spectrum.shape[-2:]).flatten(0, 1)
    )


def placed(image: Signal, body: Body, extraction: Extraction) -> Signal:
    """Add a moving body, focused with its velocity, to an image at its true position.

    In azimuth the image of the body is placed at its along-track position at t = 0, in range at the
    closest range of each of its range lines. Its amplitude is scaled as that of stationary points.

    Args:
        image: Image (azimuth, range).
        body: Body to add.
        extraction: Extent of the body.

    Returns:
        The image with the body.
    """
    azimuth, range_ = image.axes
    chip, motion = body.chip, body.chip.motion
    position = azimuth.values(image.data.device)
    rows = ((position - motion.y0_m).abs() <= extraction.along_m).nonzero()[:, 0]
    columns = torch.round((chip.range_m - range_.start) / range_.step).long()
    scale = extraction.integration_s * motion.along_m_s / torch.sqrt(chip.radar.wavelength_m * motion.range_m)
    data = image.data.clone()
    data[rows[:, None], columns] += (scale * body_image(body, position[rows], extraction)).to(data.dtype)
    return image.with_data(data)
