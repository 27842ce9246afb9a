"""One picture of a scene at rest and of what moves in it, every target in its place: the whole flow
of Remote Sens. 2020, 12, 1703, Fig. 13.

Conventional image, detection, then for each target, strongest first: extraction of its lines,
velocity, removal from the data, picture by its own velocity, and relocation. Replicas of a target
go with it, so that they are not taken for targets. Weaker targets are looked for in images with the
sea suppressed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, fft_lines, linear_phasor
from torchsar.multichannel.body import Body, Extraction, body_echo, body_image, find_body, known_body
from torchsar.multichannel.detection import Detection, detect
from torchsar.multichannel.migration import Frame
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import LeastSquares, Rebuild, band_matrix, first_bin, shared_response
from torchsar.multichannel.stationary import StationaryImage
from torchsar.multichannel.velocity.whitening import line_whitening
from torchsar.radar import BistaticRadar

Removal = Literal["subtract", "zero"]
_ALIKE_M_S = 5.0
# times those of one point: a body has many, and its brightest pixels stand above the mean
_SIDE_LOBES = 20.0


@dataclass(frozen=True)
class Detector:
    """When something is a target.

    threshold_db: of the mean intensity of extent_m (along track, range) over the median of the
    image; most: targets at most.

    suppressed_m_s: slant-range speeds at which the sea is suppressed to look for more, none to
    leave that out.
    """

    threshold_db: float = 10.0
    extent_m: tuple[float, float] = (60.0, 10.0)
    apart_m: tuple[float, float] = (250.0, 40.0)
    most: int = 8
    suppressed_m_s: Sequence[float] = (-16.0, -10.0, -5.0, 5.0, 10.0, 16.0)

    def __post_init__(self) -> None:
        if not (self.threshold_db > 0 and all(x > 0 for x in (*self.extent_m, *self.apart_m)) and self.most >= 1):
            raise ValueError(
                "a detector needs a threshold_db above 0, positive extents and distances, and most "
                f"of 1 or more, got {self}"
            )

    def found(self, image: Signal) -> list[Detection]:
        return detect(image, self.threshold_db, self.extent_m, self.apart_m, self.most)


@dataclass(frozen=True)
class SceneImage:
    """conventional: the image of everything as if it were at rest.

    rest: of what is left without the movers. fused: rest with every mover in its place. bodies: all
    targets, strongest first.

    estimate: u_r_m_s, u_a_m_s, y0_m, range_m (target,), those of the detector's `most` that do not
    exist being zero and not ok. data: channels without the movers.
    """

    conventional: Signal
    rest: Signal
    fused: Signal
    bodies: list[Body] = field(default_factory=list)
    estimate: Estimate | None = None
    data: Signal | None = None


class ImageMovers(Stage):
    """Channels (channel, pulse, range) of one frame, range compressed and without the transmit
    range, to a `SceneImage`.

    rebuild: for what is at rest. removal: "subtract" the echo that fits a mover, or "zero" all that
    lies in its lines and its extent, sea included (kept for comparison). slowest_m_s: what a target
    must exceed in u_r, u_a to count as a mover; one at rest stays in the image. It takes one frame
    at a time, since the number of targets differs.
    """

    works_on = ("channel", "pulse", "range")

    def __init__(
        self,
        radar: BistaticRadar,
        extraction: Extraction | None = None,
        detector: Detector | None = None,
        rebuild: Rebuild | None = None,
        removal: Removal = "subtract",
        slowest_m_s: tuple[float, float] = (0.3, 1.0),
        u_a_half_m_s: float = 20.0,
    ) -> None:
        super().__init__()
        if removal not in ("subtract", "zero"):
            raise ValueError(f"removal must be 'subtract' or 'zero', got {removal!r}")
        self.radar, self.extraction, self.detector = radar, extraction or Extraction(), detector or Detector()
        self.image, self.removal = StationaryImage(radar, rebuild or LeastSquares()), removal
        self.slowest_m_s, self.u_a_half_m_s = slowest_m_s, u_a_half_m_s

    def forward(self, signal: Signal, known: Sequence[PointMotion] | None = None) -> SceneImage:
        """known: motions of all targets, strongest first, by their middles; nothing is looked for
        then. None to find targets.
        """
        if signal.trials:
            raise ValueError(
                f"ImageMovers works on one frame at a time, got trials {tuple(signal.trials)}; call it for each"
            )
        conventional = self.image(signal)
        axis = signal.axis("range")
        if known is None and not self._whole(Detection(0.0, axis.start + axis.step * (axis.n // 2), 0.0), signal):
            warnings.warn(
                f"no target can be looked for in a swath of {axis.n} range lines: what it walks "
                "through leaves it; give more lines, or a smaller extraction",
                stacklevel=3,
            )
        left, bodies = signal, []
        if known is not None:
            left, bodies = self._told(left, known)
        else:
            for image in self._looks(signal):
                left, bodies = self._taken_out(left, image, bodies)
        rest = self.image(left)
        fused = rest
        for body in bodies:
            if self._moves(body):
                fused = placed(fused, body, self.extraction)
        return SceneImage(conventional, rest, fused, bodies, self._estimate(bodies, signal.data), left)

    def _looks(self, signal: Signal):
        """Ways to look at data, each until it finds nothing new: the conventional image, then
        images with the sea suppressed.
        """
        yield self.image
        if self.detector.suppressed_m_s:
            yield lambda data: suppressed_image(data, self.radar, self.image, self.detector.suppressed_m_s)

    def _taken_out(self, left: Signal, look, bodies: list[Body]) -> tuple[Signal, list[Body]]:
        """Targets found and movers removed, strongest first, until a look shows nothing new."""
        bodies, seen = list(bodies), [self._shown(body) for body in bodies]
        waiting = self.detector.found(look(left))
        while waiting and len(bodies) < self.detector.most:
            place = waiting.pop(0)
            if not self._whole(place, left) or any(self._same(place, other) for other in seen):
                continue
            seen.append(place)
            body = self._body(left, place)
            if not bool(body.ok) or any(self._side_lobe(body, other) for other in bodies):
                continue
            bodies.append(body)
            seen.append(self._shown(body))
            if self._moves(body):
                left = self._without(left, body)
                waiting = self.detector.found(look(left))
        return left, bodies

    def _told(self, left: Signal, known: Sequence[PointMotion]) -> tuple[Signal, list[Body]]:
        """Bodies of known motions, and the data without those that move."""
        if len(known) > self.detector.most:
            raise ValueError(
                f"{len(known)} motions are known, and the detector takes at most {self.detector.most} "
                "targets; raise its `most`"
            )
        bodies = []
        for motion in known:
            lines, frame = self._lines(left, float(motion.range_m))
            body = known_body(left.data[..., lines], frame, motion, self.extraction)
            bodies.append(body)
            if self._moves(body):
                left = self._without(left, body)
        return left, bodies

    def _whole(self, detection: Detection, signal: Signal) -> bool:
        """A target here would lie in the swath whatever its velocity, and be abeam during the
        record.
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

    def _same(self, a: Detection, b: Detection) -> bool:
        return (
            abs(a.azimuth_m - b.azimuth_m) < self.detector.apart_m[0] / 2
            and abs(a.range_m - b.range_m) < self.detector.apart_m[1]
        )

    def _side_lobe(self, body: Body, other: Body) -> bool:
        """What a body shows may be side lobes in range, beyond the lines that were removed, of
        another at the same place along track and of nearly the same velocity.
        """
        away_m = float((body.motion.range_m - other.motion.range_m).abs())
        moves_alike = (
            abs(float(body.motion.u_r_m_s - other.motion.u_r_m_s)) < _ALIKE_M_S
            and abs(float(body.motion.u_a_m_s - other.motion.u_a_m_s)) < _ALIKE_M_S
        )
        beside = abs(self._shown(body).azimuth_m - self._shown(other).azimuth_m) < self.detector.apart_m[0] / 2
        cell_m = self.radar.wave_speed_m_s / self.radar.pulse.bandwidth_hz
        return (
            moves_alike
            and beside
            and float(body.level) < _SIDE_LOBES * float(other.level) * (cell_m / (math.pi * max(away_m, cell_m))) ** 2
        )

    def _shown(self, body: Body) -> Detection:
        """Where an image of everything at rest shows a body."""
        return Detection(
            self.radar.speed_m_s * float(body.motion.image_s),
            float(body.motion.closest_m),
            10 * math.log10(max(float(body.level), 1e-30)),
        )

    def _moves(self, body: Body) -> bool:
        return bool(body.motion.u_r_m_s.abs() > self.slowest_m_s[0]) or bool(
            body.motion.u_a_m_s.abs() > self.slowest_m_s[1]
        )

    def _lines(self, signal: Signal, near_m: float) -> tuple[slice, Frame]:
        """Lines about a range, enough of them to learn the sea from."""
        axis = signal.axis("range")
        half = math.ceil(self.extraction.range_m / axis.step) + 34
        at = round((near_m - axis.start) / axis.step)
        lines = slice(max(0, at - half), min(axis.n, at + half))
        frame = Frame.of(self.radar, signal)
        return lines, replace(frame, range_m=frame.range_m[lines])

    def _body(self, signal: Signal, detection: Detection) -> Body:
        lines, frame = self._lines(signal, detection.range_m)
        return find_body(
            signal.data[..., lines],
            frame,
            detection.azimuth_m / self.radar.speed_m_s,
            detection.range_m,
            self.extraction,
            u_a_half_m_s=self.u_a_half_m_s,
        )

    def _without(self, signal: Signal, body: Body) -> Signal:
        lines, frame = self._lines(signal, float(body.motion.range_m))
        data = signal.data.clone()
        data[..., lines] -= body_echo(body, frame, everything=self.removal == "zero").to(data.dtype)
        return signal.with_data(data)

    def _estimate(self, bodies: list[Body], like: Tensor) -> Estimate:
        """Padded to the detector's `most`."""
        most = self.detector.most

        def row(values: list[Tensor]) -> Tensor:
            kept = torch.stack(values) if values else like.real.new_zeros(0, dtype=torch.float64)
            return torch.cat(
                [kept.to(torch.float64), torch.zeros(most - len(kept), dtype=torch.float64, device=like.device)]
            )

        value = {
            name: row([getattr(body.motion, name) for body in bodies])
            for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
        }
        ok = row([body.ok.to(torch.float64) for body in bodies]) > 0
        level = row([body.level for body in bodies])
        return Estimate(
            value, level / (100 + level), ok, {"u_r_m_s": row([body.u_r_std_m_s for body in bodies])}, {"level": level}
        )


def suppressed_image(
    signal: Signal, radar: BistaticRadar, image: StationaryImage, speeds_m_s: Sequence[float]
) -> Signal:
    """Intensity root of images in which the sea is suppressed, the greatest over slant-range
    speeds, each over its own median: what moves stands out.

    The channels of every Doppler bin are weighted by the inverse covariance of all range lines,
    then by the response of a point of that speed: the Doppler filter of the paper with the channels
    taken along. Real amplitudes on the axes of `image`.
    """
    data = signal.data.movedim(-1, -3)
    whitening = line_whitening(data, radar, samples=4 * data.shape[-3])
    backed = whitening.expanded(data.shape[-3]).backed(data.to(torch.complex128)).movedim(-3, -1).to(signal.data.dtype)
    best, shown = None, None
    for speed in speeds_m_s:
        matched = image.focused(
            _matched(backed, radar, PointMotion.of(radar, signal.data.real, speed), image.rebuild.bands), signal
        )
        level = matched.data.abs().square()
        level = level / level.median().clamp_min(torch.finfo(level.dtype).tiny)
        best, shown = level if best is None else torch.maximum(best, level), matched
    assert best is not None and shown is not None
    return shown.with_data(best.sqrt().to(signal.data.dtype))


def _matched(data: Tensor, radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """Doppler spectrum of what channels (channel, pulse, range) hold of points of this speed, bins
    about zero Doppler, (bands * pulse, range).
    """
    n = data.shape[-2]
    spectrum = torch.roll(fft_lines(torch.fft.ifftshift(data, dim=-2)), -first_bin(n, bands), -2)
    # bins lie about zero, not about the point's Doppler: its response at Doppler f is that at
    # offset f - f_dc
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
    """The image (azimuth, range) with the picture of a body added in its place: along track at t =
    0, at its closest ranges, scaled as points at rest are.
    """
    azimuth, range_ = image.axes
    chip, motion = body.chip, body.chip.motion
    place = azimuth.values(image.data.device)
    rows = ((place - motion.y0_m).abs() <= extraction.along_m).nonzero()[:, 0]
    columns = torch.round((chip.range_m - range_.start) / range_.step).long()
    scale = extraction.integration_s * motion.along_m_s / torch.sqrt(chip.radar.wavelength_m * motion.range_m)
    data = image.data.clone()
    data[rows[:, None], columns] += (scale * body_image(body, place[rows], extraction)).to(data.dtype)
    return image.with_data(data)
