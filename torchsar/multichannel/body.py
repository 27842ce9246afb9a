"""A moving body of any extent: one velocity for all of it, its picture, and its echo to be taken
out of the data.

Range lines about the body are shifted by its range history and deramped channel by channel. Each
part of the body then is one tone in all channels, whatever the aliasing: the frequency F gives its
place along track, y = y0 + F lambda R0 / v, and that place and the velocity give its phases across
the channels. In short segments of slow time the sea behind a tone comes from as few directions as
there are Doppler bands; lines beside the body show its covariance. All parts and segments together
tell the slant-range velocity, by likelihood with a free amplitude for each; the sharpness of the
picture tells the along-track velocity; what fits both is its echo. Source: brief 001, Velocity
(stationary clutter, whitening) and Algorithm 8 (subtraction); Remote Sens. 2020, 12, 1703, section
4.3 (one speed for targets close together).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.migration import Frame, StaticBulk, correct_migration
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

_TINY = 1e-100  # far from where reciprocals overflow
_GUARD_CELLS = 6
_LINES_USED = 8  # for the sharpness of a picture
_LEAST_LINES = 12
_LOADING = 1e-5
_BRIGHT = 12.0  # times what sea and noise leave in a pixel
_CLEAR = 2.0
_CREDIBLE = 40.0  # times what sea and noise leave, the mean of the bright pixels


@dataclass(frozen=True)
class Extraction:
    """What belongs to a body: half widths (m) along track and in range about its middle, the time
    (s) for which a point shines, and the length (s) of segments.
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
    """Short Fourier transforms of slow time: half-overlapping segments and the bins kept of each.

    bins: (tone,) FFT indices; rows: (segment,) of those in which a body shines.
    """

    n: int
    length: int
    bins: Tensor
    rows: Tensor

    @property
    def hop(self) -> int:
        return self.length // 2

    def window(self) -> Tensor:
        return torch.hann_window(self.length, dtype=torch.float64, device=self.bins.device)

    def of(self, x: Tensor) -> Tensor:
        """(..., pulse) complex128 to (..., segment, tone)."""
        made = torch.stft(
            x.flatten(0, -2),
            self.length,
            self.hop,
            window=self.window(),
            center=True,
            pad_mode="constant",
            onesided=False,
            return_complex=True,
        )
        return made[:, self.bins][..., self.rows].mT.unflatten(0, x.shape[:-1])

    def back(self, cells: Tensor) -> Tensor:
        """Inverse of `of`, zero where segments or bins were left out."""
        full = torch.zeros(
            cells.shape[:-2].numel(), self.length, self.n // self.hop + 1, dtype=cells.dtype, device=cells.device
        )
        full[:, self.bins[:, None], self.rows] = cells.flatten(0, -3).mT
        made = torch.istft(
            full,
            self.length,
            self.hop,
            window=self.window(),
            center=True,
            onesided=False,
            length=self.n,
            return_complex=True,
        )
        return made.unflatten(0, cells.shape[:-2])


@dataclass(frozen=True)
class Chip:
    """Lines about a body, deramped by the motion of its middle, in segments.

    cells: complex128 (line, channel, segment, tone); beside: the same of lines beside it; tone_hz:
    (tone,).

    range_m: (line,) closest ranges; inverse: (segment, tone, channel, channel) inverse covariance
    of the sea and noise; lit: (pulse,) bool, some part of the body shines.
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
        """Phases over channels of what has this motion and lies at tones, against what was
        deramped, complex128 (..., tone, channel).
        """
        place = self.place_m(motion, tone_hz) - self.motion.y0_m
        return unit_phasor(
            -place[..., None]
            * self.radar.channels_at(place.device)
            / (self.radar.wavelength_m * motion.range_m[..., None, None]),
            torch.complex128,
        )

    def place_m(self, motion: PointMotion, tone_hz: Tensor) -> Tensor:
        """Along-track place at t = 0 of tones for a motion whose y0 is that of tone zero, (...,
        tone).
        """
        per_hz = self.radar.wavelength_m * motion.range_m / motion.along_m_s
        return motion.y0_m[..., None] + per_hz[..., None] * tone_hz

    def _weights(self, motion: PointMotion) -> tuple[Tensor, Tensor]:
        """R^-1 a (..., segment, tone, channel) and a^H R^-1 a (..., segment, tone)."""
        steering = self.steering(motion, self.tone_hz)
        weight = torch.einsum("sfmn,...fn->...sfm", self.inverse, steering)
        return weight, (steering[..., None, :, :].conj() * weight).sum(-1).real.clamp_min(_TINY)

    def energy(self, motions: PointMotion) -> Tensor:
        """What cells of free amplitude explain of the data for each motion (candidate,): the
        log-likelihood but for constants.
        """
        weight, gain = self._weights(motions)
        return (torch.einsum("lmsf,csfm->clsf", self.cells, weight.conj()).abs().square() / gain[:, None]).sum(
            (-3, -2, -1)
        )

    def echo(self, cells: Tensor) -> Tensor:
        """Most likely deramped echo, seen from the reference of the track, of what has the chip's
        motion: (line, channel, segment, tone) to (line, pulse), zero where nothing shines.
        """
        weight, gain = self._weights(self.motion)
        return self.segments.back(torch.einsum("lmsf,sfm->lsf", cells, weight.conj()) / gain) * self.lit

    def picture(self) -> Picture:
        """Of the body: spectra of its echo, and the mean intensity that sea and noise leave in
        them, by the lines beside it.
        """
        n = self.segments.n
        hz = torch.fft.fftfreq(n, 1 / self.radar.prf_hz, dtype=torch.float64, device=self.lit.device)
        inside = (hz.abs() <= self.tone_hz.abs().max()).nonzero()[:, 0]
        own, others = (torch.fft.fft(self.echo(cells))[:, inside] for cells in (self.cells, self.beside))
        return Picture(own, others.abs().square().mean().clamp_min(_TINY), hz[inside], inside)


@dataclass(frozen=True)
class Picture:
    """Complex amplitudes (line, tone) of a body, sum over lit pulses of its echo at each tone;
    left: mean intensity of sea and noise in them (); index: of the tones in an FFT of all pulses.
    """

    amplitude: Tensor
    left: Tensor
    tone_hz: Tensor
    index: Tensor

    @property
    def level(self) -> Tensor:
        """Intensity over what sea and noise leave."""
        return self.amplitude.abs().square() / self.left

    @property
    def bright(self) -> Tensor:
        level = self.level
        return level > torch.maximum(level.new_tensor(_BRIGHT), 0.01 * level.max())


@dataclass(frozen=True)
class Body:
    """A body that was found.

    motion: velocity, and along-track place and closest range of its middle, by intensity;
    u_r_std_m_s: predicted deviation of u_r.

    chip, picture: its data, deramped by that motion, and what they show; level: mean of the bright
    pixels over what sea and noise leave. ok: it stands out by 16 dB, and u_r does not end its
    search.
    """

    motion: PointMotion
    u_r_std_m_s: Tensor
    chip: Chip
    picture: Picture
    level: Tensor
    ok: Tensor


def chip_about(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Chip:
    """Lines about a body of this motion.

    data: complex (channel, pulse, range), range compressed, transmit range removed, with lines
    beside the body to learn the sea from.

    Raises ValueError where the body lies outside the lines, or too few lie beside it.
    """
    off = (frame.range_m - motion.range_m).abs()
    body, beside = off <= extraction.range_m, off > extraction.range_m + _GUARD_CELLS * frame.radar.range_step_m
    if not bool(body.any()) or int(beside.sum()) < _LEAST_LINES:
        counts = (
            f"{int(body.sum())} lines within {extraction.range_m:g} m of "
            f"{float(motion.range_m):.0f} m and {int(beside.sum())} beside them"
        )
        raise ValueError(
            f"a body needs range lines about it and {_LEAST_LINES} beside it to learn the sea from, got {counts}"
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
    return replace(chip, inverse=_inverse_covariance(chip))


def _segments(frame: Frame, motion: PointMotion, extraction: Extraction, lit: Tensor) -> tuple[Segments, Tensor]:
    """Segments in which the body shines, and the tones at which it may lie."""
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
    """Of the lines beside the body: from tone to tone it turns as phases of places do, and else is
    the same for all tones of a segment.
    """
    turn = chip.steering(chip.motion, chip.tone_hz)
    aligned = chip.beside.movedim(1, -1) * turn.conj()
    covariance = torch.einsum("lsfm,lsfn->smn", aligned, aligned.conj()) / (aligned.shape[0] * aligned.shape[2])
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1).clamp_min(_TINY)
    covariance = covariance + _LOADING * level[:, None, None] * torch.eye(
        covariance.shape[-1], dtype=covariance.dtype, device=covariance.device
    )
    return turn[..., :, None] * torch.linalg.inv(covariance)[:, None] * turn.conj()[..., None, :]


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
    """Velocity and place of the body that appears at slow time image_s and range image_m (m) of an
    image of everything at rest.

    data: complex (channel, pulse, range) about the body (see `chip_about`). u_r_half_m_s: of the
    search, by default half of lambda PRF. Every round shifts and deramps by the motion found so
    far.
    """
    half = frame.radar.ambiguous_velocity_m_s / 2 if u_r_half_m_s is None else u_r_half_m_s
    chip = chip_about(data, frame, _appearing(frame.radar, data, 0.0, 0.0, image_s, image_m), extraction)
    for number in range(rounds):
        u_r, std = _closing_speed(chip, image_s, image_m, half if number < 2 else 2.0)
        motion = _appearing(frame.radar, data, u_r, chip.motion.u_a_m_s, image_s, image_m)
        if not _covered(frame, motion, extraction):
            return _judged(chip, std, half, lost=True)
        u_a = _along_speed(chip_about(data, frame, motion, extraction), extraction, u_a_half_m_s if number < 2 else 1.0)
        chip = chip_about(data, frame, _appearing(frame.radar, data, u_r, u_a, image_s, image_m), extraction)
        image_s, image_m, motion = _centred(chip, image_s, image_m)
        chip = chip_about(data, frame, motion, extraction)
    u_r, std = _closing_speed(chip, image_s, image_m, 1.0)
    motion = _appearing(frame.radar, data, u_r, chip.motion.u_a_m_s, image_s, image_m)
    return _judged(chip_about(data, frame, motion, extraction), std, half)


def _covered(frame: Frame, motion: PointMotion, extraction: Extraction) -> bool:
    """The lines of the frame hold a body of this motion, and some more."""
    reach = extraction.range_m / 2
    return bool((frame.range_m[0] + reach <= motion.range_m) & (motion.range_m <= frame.range_m[-1] - reach))


def _judged(chip: Chip, std: Tensor, half_m_s: float, lost: bool = False) -> Body:
    picture = chip.picture()
    bright = picture.bright
    level = (picture.level * bright).sum() / bright.sum().clamp_min(1)
    ok = (level > _CREDIBLE) & (chip.motion.u_r_m_s.abs() < 0.98 * half_m_s)
    return Body(chip.motion, std, chip, picture, level, ok & (not lost))


def _appearing(
    radar: BistaticRadar,
    like: Tensor,
    u_r: Tensor | float,
    u_a: Tensor | float,
    image_s: Tensor | float,
    image_m: Tensor | float,
) -> PointMotion:
    """The motion of these velocities that an image of everything at rest shows at this slow time
    and range: Rmin V = v R0 - u_r y0, V^2 t = u_r R0 + v y0.
    """
    m = PointMotion.of(radar, like.real, u_r, u_a)
    speed = m.square_m2_s2.sqrt()
    least, turned = torch.as_tensor(image_m, dtype=torch.float64), torch.as_tensor(image_s, dtype=torch.float64) * speed
    return replace(
        m,
        range_m=(m.along_m_s * least + m.u_r_m_s * turned) / speed,
        y0_m=(m.along_m_s * turned - m.u_r_m_s * least) / speed,
    )


def _closing_speed(chip: Chip, image_s: float, image_m: float, half_m_s: float) -> tuple[Tensor, Tensor]:
    """The most likely u_r within half_m_s of that of the chip, by grids and a parabola, and its
    predicted deviation.
    """
    middle, step = chip.motion.u_r_m_s, torch.as_tensor(half_m_s / 40, dtype=torch.float64)
    std = step
    for _ in range(3):
        u_r = middle + step * torch.arange(-40, 41, dtype=torch.float64, device=middle.device)
        energy = torch.cat(
            [
                chip.energy(
                    _appearing(chip.radar, chip.cells, part, chip.motion.u_a_m_s.expand(part.shape), image_s, image_m)
                )
                for part in u_r.split(9)
            ]
        )
        shift, bend = _peak(energy)
        middle, std, step = middle + step * shift, step / torch.sqrt(bend), step / 10
    return middle, std


def _peak(values: Tensor) -> tuple[Tensor, Tensor]:
    """Place of the greatest value against the middle, in steps, by a parabola through its
    neighbours, and minus the second difference there.
    """
    inner = min(max(int(values.argmax()), 1), len(values) - 2)
    low, top, high = values[inner - 1 : inner + 2]
    bend = (2 * top - low - high).clamp_min(_TINY)
    return inner - len(values) // 2 + (0.5 * (high - low) / bend).clamp(-1, 1), bend


def _along_speed(chip: Chip, extraction: Extraction, half_m_s: float) -> Tensor:
    """The u_a within half_m_s of that of the chip whose picture is sharpest (mean square over
    squared mean of intensities), by grids and a parabola.
    """
    radar, motion = replace(chip.radar, channel_m=(0.0,)), chip.motion
    time_s = chip.time_s[chip.lit]
    # a taper, since side lobes of neighbours would interfere
    echo = chip.echo(chip.cells)[:, chip.lit] * torch.hann_window(
        len(time_s), dtype=torch.float64, device=time_s.device
    )
    echo = echo[echo.abs().square().sum(-1).topk(min(_LINES_USED, len(echo))).indices]
    back = point_phasor(radar, motion, time_s, torch.complex128)[0]
    middle, step = motion.u_a_m_s, half_m_s / 40
    for _ in range(3):
        u_a = middle + step * torch.arange(-40, 41, dtype=torch.float64, device=middle.device)
        there = replace(motion.each(lambda value: value.expand(81)), u_a_m_s=u_a)
        turn = point_phasor(radar, there, time_s, torch.complex128)[:, 0].conj() * back
        picture = (
            torch.fft.fft((echo * turn[:, None]).to(torch.complex64), smooth_length(2 * echo.shape[-1]))
            .abs()
            .square()
            .to(torch.float64)
        )
        shift, _ = _peak(picture.square().sum((-2, -1)) / picture.sum((-2, -1)).square().clamp_min(_TINY))
        middle, step = middle + step * shift, step / 10
    return middle


def _centred(chip: Chip, image_s: float, image_m: float) -> tuple[float, float, PointMotion]:
    """Where the middle of the bright pixels appears, and its motion."""
    motion = centred_motion(chip)
    return (
        (image_s, image_m, chip.motion)
        if motion is chip.motion
        else (float(motion.image_s), float(motion.closest_m), motion)
    )


def centred_motion(chip: Chip) -> PointMotion:
    """The motion of a chip with the place and range of the middle, by intensity, of the bright
    pixels of its picture; the very motion where nothing is bright.
    """
    picture = chip.picture()
    weight = picture.level * picture.bright
    total = weight.sum()
    if not float(total) > 0:
        return chip.motion
    place = (weight.sum(0) * chip.place_m(chip.motion, picture.tone_hz)).sum() / total
    near = (weight.sum(1) * chip.range_m).sum() / total
    return replace(chip.motion, y0_m=place, range_m=near)


def known_body(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Body:
    """The body of a known motion: its velocity is kept, its middle is put where its picture has it.

    Data and errors as in `chip_about`.
    """
    chip = chip_about(data, frame, motion, extraction)
    chip = chip_about(data, frame, centred_motion(chip), extraction)
    return _judged(chip, torch.zeros_like(motion.u_r_m_s), math.inf)


def body_echo(body: Body, frame: Frame, everything: bool = False) -> Tensor:
    """The echo of a body, complex128 (channel, pulse, range): what to subtract from the data of the
    frame in which it was found.

    It is what pixels hold that stand above sea and noise. everything: all that lies in its lines
    and tones instead, sea included.
    """
    chip, picture = body.chip, body.picture
    if everything:
        deramped = chip.segments.back(chip.cells)
    else:
        clear = picture.amplitude * (picture.level > _CLEAR)
        spectrum = torch.zeros(
            len(clear), frame.radar.channels, chip.segments.n, dtype=clear.dtype, device=clear.device
        )
        spectrum[..., picture.index] = clear[:, None] * chip.steering(chip.motion, picture.tone_hz).mT
        deramped = torch.fft.ifft(spectrum)
    full = torch.zeros(
        len(frame.range_m), frame.radar.channels, chip.segments.n, dtype=deramped.dtype, device=deramped.device
    )
    full[torch.isin(frame.range_m, chip.range_m)] = deramped * chip.lit
    ramped = full.movedim(0, -1) * point_phasor(frame.radar, chip.motion, frame.time_s, torch.complex128)[..., None]
    return _shifted_back(ramped, frame, chip.motion)


def _shifted_back(data: Tensor, frame: Frame, motion: PointMotion) -> Tensor:
    """Inverse of `StaticBulk`: lines moved along range by the history of the motion."""
    n = data.shape[-1]
    turns = -frame.path_m(motion) / (frame.radar.range_step_m * n)
    phasor = torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)


def body_image(body: Body, place_m: Tensor, extraction: Extraction) -> Tensor:
    """Complex amplitudes of the points of a body at along-track places (place,) at t = 0, (place,
    line), the sea suppressed: that of a point of amplitude 1 is 1.
    """
    chip, motion = body.chip, body.chip.motion
    echo, time_s = chip.echo(chip.cells)[:, chip.lit], chip.time_s[chip.lit]
    hz = (place_m - motion.y0_m) * motion.along_m_s / (chip.radar.wavelength_m * motion.range_m)
    kernel = torch.exp(-2j * math.pi * hz[:, None] * time_s)
    return (kernel @ echo.mT) / (extraction.integration_s * chip.radar.prf_hz)
