"""A moving body of any extent: one velocity for all of it, its picture, and its echo to be taken out of the data.

Range lines about the body are shifted by its range history and deramped channel by channel. Each part of the body then is one tone in all channels, whatever the
aliasing: the frequency F gives its place along track, y = y0 + F lambda R0 / v, and that place and the velocity give its phases across the channels. Lines beside
the body show the covariance of the sea among the channels of a tone. All parts together then tell the slant-range velocity, by likelihood with a free amplitude
for each; the sharpness of the picture tells the along-track velocity; and what fits both is the body's echo.
Source: brief 001, Velocity (stationary clutter, whitening) and Algorithm 8 (subtraction); Remote Sens. 2020, 12, 1703, section 4.3 (one speed for targets close together).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor
from torchsar.multichannel.migration import Frame, StaticBulk, correct_migration
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny
_GUARD_CELLS = 6
_LEAST_LINES = 12
_LOADING = 1e-5
_BRIGHT = 12.0  # times what sea and noise leave in a pixel
_CLEAR = 4.0
_CREDIBLE = 40.0  # times what sea and noise leave, the mean of the bright pixels


@dataclass(frozen=True)
class Extraction:
    """What belongs to a body: half widths (m) along track and in range about its middle, and the time (s) for which it shines."""

    along_m: float = 110.0
    range_m: float = 30.0
    integration_s: float = 4.5

    def __post_init__(self) -> None:
        for name in ("along_m", "range_m", "integration_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} of an extraction must be positive, got {getattr(self, name)}")


@dataclass(frozen=True)
class Tones:
    """Lines about a body as tones. data: complex128 (line, channel, tone), tone_hz: (tone,); start_s: slow time that their phases count from; range_m: (line,) closest ranges; motion: of the middle, which was deramped.

    inverse: (channel, channel, ...) inverse covariance of sea and noise for tones whose phases over channels are those of the middle, complex128 (tone, channel, channel).
    """

    radar: BistaticRadar
    motion: PointMotion
    data: Tensor
    tone_hz: Tensor
    start_s: float
    range_m: Tensor
    inverse: Tensor

    def steering(self, motion: PointMotion) -> Tensor:
        """Phases over channels of what has this motion and lies at each tone, against what was deramped, complex128 (..., tone, channel)."""
        place = self.place_m(motion) - self.motion.y0_m
        return unit_phasor(-place[..., None] * self.radar.channels_at(place.device) / (self.radar.wavelength_m * motion.range_m[..., None, None]), torch.complex128)

    def place_m(self, motion: PointMotion) -> Tensor:
        """Along-track place at t = 0 of each tone for a motion whose y0 is that of tone zero, (..., tone)."""
        per_hz = self.radar.wavelength_m * motion.range_m / motion.along_m_s
        return motion.y0_m[..., None] + per_hz[..., None] * self.tone_hz

    def amplitudes(self, motion: PointMotion) -> tuple[Tensor, Tensor]:
        """Most likely complex amplitude of every pixel (line, tone) for a motion, and its variance by sea and noise (tone,)."""
        steering = self.steering(motion)
        weight = (self.inverse @ steering[..., None])[..., 0]
        gain = (steering.conj() * weight).sum(-1).real.clamp_min(_TINY)
        return torch.einsum("lmf,fm->lf", self.data, weight.conj()) / gain, 1 / gain

    def energy(self, motions: PointMotion) -> Tensor:
        """What pixels of free amplitude explain of the data for each motion (candidate,): the log-likelihood but for constants."""
        steering = self.steering(motions)
        weight = torch.einsum("fmn,cfn->cfm", self.inverse, steering)
        gain = (steering.conj() * weight).sum(-1).real.clamp_min(_TINY)
        return (torch.einsum("lmf,cfm->clf", self.data, weight.conj()).abs().square() / gain[:, None]).sum((-2, -1))


@dataclass(frozen=True)
class Body:
    """A body that was found. motion: velocity, and along-track place and closest range of its middle, by intensity; std: predicted deviation of u_r (m/s).

    tones: its data; level: mean intensity of its bright pixels over that of sea and noise in a pixel; bright: their number. ok: they stand out by 16 dB, and u_r does not end its search.
    """

    motion: PointMotion
    u_r_std_m_s: Tensor
    tones: Tones
    level: Tensor
    bright: Tensor
    ok: Tensor


def tones_about(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Tones:
    """Lines about a body of this motion as tones. data: complex (channel, pulse, range), range compressed, transmit range removed, with lines beside the body to learn the sea from.

    Raises ValueError where too few lines lie beside it.
    """
    deramped = _deramped(data, frame, motion, extraction)
    spectrum = torch.fft.fft(deramped.movedim(-1, 0))
    n = spectrum.shape[-1]
    tone_hz = torch.fft.fftfreq(n, 1 / frame.radar.prf_hz, dtype=torch.float64, device=data.device)
    near = tone_hz.abs() * frame.radar.wavelength_m * float(motion.range_m / motion.along_m_s) <= extraction.along_m
    off = (frame.range_m - motion.range_m).abs()
    body, beside = off <= extraction.range_m, off > extraction.range_m + _GUARD_CELLS * frame.radar.range_step_m
    if not bool(body.any()):
        raise ValueError(f"no range line lies within {extraction.range_m:g} m of a body at {float(motion.range_m):.0f} m; give lines about it")
    if int(beside.sum()) < _LEAST_LINES:
        raise ValueError(f"a body of +-{extraction.range_m:g} m at {float(motion.range_m):.0f} m needs {_LEAST_LINES} range lines beside it to learn the sea from, got {int(beside.sum())}")
    found = Tones(frame.radar, motion, spectrum[body][..., near], tone_hz[near], float(frame.time_s[0]), frame.range_m[body], torch.zeros(0))
    return replace(found, inverse=_inverse_covariance(found, spectrum[beside][..., near]))


def _deramped(data: Tensor, frame: Frame, motion: PointMotion, extraction: Extraction) -> Tensor:
    """(channel, pulse, range) complex128, lines shifted by the history of the motion and multiplied by its conjugate phase, zero where no part of the body shines."""
    shifted = correct_migration(data.to(torch.complex128), frame, motion, StaticBulk())
    return shifted * _ramp(frame, motion, extraction).conj()[..., None]


def _ramp(frame: Frame, motion: PointMotion, extraction: Extraction) -> Tensor:
    lit = (frame.time_s - motion.y0_m / motion.along_m_s).abs() < extraction.integration_s / 2 + extraction.along_m / 2 / motion.along_m_s
    return point_phasor(frame.radar, motion, frame.time_s, torch.complex128) * lit


def _inverse_covariance(tones: Tones, beside: Tensor) -> Tensor:
    """Inverse of the covariance among channels of lines beside the body (line, channel, tone): it turns with the tone as phases of places do, and else is the same over the body."""
    turn = tones.steering(tones.motion)
    aligned = beside.movedim(-2, -1) * turn.conj()
    covariance = torch.einsum("lfm,lfn->mn", aligned, aligned.conj()) / (aligned.shape[0] * aligned.shape[1])
    covariance = covariance + _LOADING * covariance.diagonal().real.mean().clamp_min(_TINY) * torch.eye(len(covariance), dtype=covariance.dtype, device=covariance.device)
    return turn[..., :, None] * torch.linalg.inv(covariance) * turn.conj()[..., None, :]


def find_body(data: Tensor, frame: Frame, image_s: float, image_m: float, extraction: Extraction, u_r_half_m_s: float | None = None, u_a_half_m_s: float = 20.0, rounds: int = 4) -> Body:
    """Velocity and place of the body that appears at slow time image_s and range image_m (m) of an image of everything at rest.

    data: complex (channel, pulse, range) about the body (see `tones_about`). u_r_half_m_s: of the search, by default half of lambda PRF. Every round shifts and deramps by the motion found so far.
    """
    half = frame.radar.ambiguous_velocity_m_s / 2 if u_r_half_m_s is None else u_r_half_m_s
    tones = tones_about(data, frame, _appearing(frame.radar, data, 0.0, 0.0, image_s, image_m), extraction)
    for number in range(rounds):
        u_r, std, _ = _closing_speed(tones, image_s, image_m, half if number < 2 else 2.0)
        motion = _appearing(frame.radar, data, u_r, tones.motion.u_a_m_s, image_s, image_m)
        if not _covered(frame, motion, extraction):
            return _judged(tones, std, half, lost=True)
        u_a = _along_speed(tones_about(data, frame, motion, extraction), extraction, u_a_half_m_s if number < 2 else 1.0)
        tones = tones_about(data, frame, _appearing(frame.radar, data, u_r, u_a, image_s, image_m), extraction)
        image_s, image_m, motion = _centred(tones, image_s, image_m)
        tones = tones_about(data, frame, motion, extraction)
    u_r, std, _ = _closing_speed(tones, image_s, image_m, 1.0)
    motion = _appearing(frame.radar, data, u_r, tones.motion.u_a_m_s, image_s, image_m)
    return _judged(tones_about(data, frame, motion, extraction), std, half)


def _covered(frame: Frame, motion: PointMotion, extraction: Extraction) -> bool:
    """The lines of the frame hold a body of this motion, and some more."""
    reach = extraction.range_m + _GUARD_CELLS * frame.radar.range_step_m
    return bool((frame.range_m[0] + reach <= motion.range_m) & (motion.range_m <= frame.range_m[-1] - reach))


def _judged(tones: Tones, std: Tensor, half_m_s: float, lost: bool = False) -> Body:
    level, bright = _brightness(tones)
    ok = (level > _CREDIBLE) & (tones.motion.u_r_m_s.abs() < 0.98 * half_m_s)
    return Body(tones.motion, std, tones, level, bright, ok & (not lost))


def _appearing(radar: BistaticRadar, like: Tensor, u_r: Tensor | float, u_a: Tensor | float, image_s: Tensor | float, image_m: Tensor | float) -> PointMotion:
    """The motion of these velocities that an image of everything at rest shows at this slow time and range: Rmin V = v R0 - u_r y0, V^2 t = u_r R0 + v y0."""
    m = PointMotion.of(radar, like.real, u_r, u_a)
    speed = m.square_m2_s2.sqrt()
    least, turned = torch.as_tensor(image_m, dtype=torch.float64), torch.as_tensor(image_s, dtype=torch.float64) * speed
    return replace(m, range_m=(m.along_m_s * least + m.u_r_m_s * turned) / speed, y0_m=(m.along_m_s * turned - m.u_r_m_s * least) / speed)


def _candidates(radar: BistaticRadar, like: Tensor, u_r: Tensor, u_a: Tensor, image_s: float, image_m: float) -> PointMotion:
    return _appearing(radar, like, u_r, u_a.expand(u_r.shape), image_s, image_m)


def _closing_speed(tones: Tones, image_s: float, image_m: float, half_m_s: float) -> tuple[Tensor, Tensor, bool]:
    """The most likely u_r within half_m_s of that of the tones, by grids and a parabola; its predicted deviation; and whether it ends the search."""
    middle, step = tones.motion.u_r_m_s, half_m_s / 40
    for _ in range(3):
        u_r = middle + step * torch.arange(-40, 41, dtype=torch.float64, device=middle.device)
        energy = tones.energy(_candidates(tones.radar, tones.data, u_r, tones.motion.u_a_m_s, image_s, image_m))
        at = int(energy.argmax())
        inner = min(max(at, 1), len(u_r) - 2)
        low, top, high = energy[inner - 1 : inner + 2]
        bend = (2 * top - low - high).clamp_min(_TINY)
        middle = u_r[inner] + step * (0.5 * (high - low) / bend).clamp(-1, 1)
        std, step = step / torch.sqrt(bend), step / 10
    return middle, std, at != inner


def _along_speed(tones: Tones, extraction: Extraction, half_m_s: float) -> Tensor:
    """The u_a within half_m_s of that of the tones whose picture is sharpest (mean square over squared mean of intensities), by grids and a parabola."""
    amplitude, _ = tones.amplitudes(tones.motion)
    radar, motion = tones.radar, tones.motion
    since = torch.arange(-extraction.integration_s / 2, extraction.integration_s / 2, 1 / radar.prf_hz, dtype=torch.float64, device=amplitude.device)
    time_s = since + motion.y0_m / motion.along_m_s
    echo = torch.einsum("lf,ft->lt", amplitude, torch.exp(2j * math.pi * tones.tone_hz[:, None] * (time_s - tones.start_s)))
    middle, step = motion.u_a_m_s, half_m_s / 40
    echo = echo * torch.hann_window(len(since), dtype=torch.float64, device=echo.device)  # side lobes of neighbours would interfere
    alone = replace(radar, channel_m=(0.0,))
    back = point_phasor(alone, motion, time_s, torch.complex128)[0]
    for _ in range(3):
        u_a = middle + step * torch.arange(-40, 41, dtype=torch.float64, device=middle.device)
        there = replace(motion, u_a_m_s=u_a, y0_m=motion.y0_m.expand(u_a.shape), u_r_m_s=motion.u_r_m_s.expand(u_a.shape), range_m=motion.range_m.expand(u_a.shape))
        turn = point_phasor(alone, there, time_s, torch.complex128)[:, 0].conj() * back
        picture = torch.fft.fft(echo * turn[:, None], 2 * echo.shape[-1]).abs().square()
        sharp = picture.square().sum((-2, -1)) / picture.sum((-2, -1)).square().clamp_min(_TINY)
        inner = min(max(int(sharp.argmax()), 1), len(u_a) - 2)
        low, top, high = sharp[inner - 1 : inner + 2]
        middle = u_a[inner] + step * (0.5 * (high - low) / (2 * top - low - high).clamp_min(_TINY)).clamp(-1, 1)
        step = step / 10
    return middle


def _bright(tones: Tones) -> tuple[Tensor, Tensor]:
    """Intensity of the picture over its variance by sea and noise, (line, tone), and where it is bright."""
    amplitude, variance = tones.amplitudes(tones.motion)
    level = amplitude.abs().square() / variance
    return level, level > torch.maximum(level.new_tensor(_BRIGHT), 0.01 * level.max())


def _brightness(tones: Tones) -> tuple[Tensor, Tensor]:
    level, bright = _bright(tones)
    return (level * bright).sum() / bright.sum().clamp_min(1), bright.sum()


def _centred(tones: Tones, image_s: float, image_m: float) -> tuple[float, float, PointMotion]:
    """Where the middle of the bright pixels appears, and its motion."""
    level, bright = _bright(tones)
    weight = level * bright
    total = weight.sum()
    if float(total) == 0:
        return image_s, image_m, tones.motion
    place = (weight.sum(0) * tones.place_m(tones.motion)).sum() / total
    near = (weight.sum(1) * tones.range_m).sum() / total
    motion = replace(tones.motion, y0_m=place, range_m=near)
    return float(motion.image_s), float(motion.closest_m), motion


def body_echo(body: Body, frame: Frame, extraction: Extraction, everything: bool = False) -> Tensor:
    """The echo of all that moves as the body does within its extent, complex128 (channel, pulse, range): what to subtract from the data that the body was found in.

    Only pixels brighter than what sea and noise leave of them count. everything: all that lies in its lines and tones instead, sea included.
    """
    tones, n = body.tones, len(frame.time_s)
    amplitude, variance = tones.amplitudes(tones.motion)
    clear = amplitude.abs().square() > _CLEAR * variance
    fitted = tones.data if everything else (amplitude * clear)[:, None, :] * tones.steering(tones.motion).mT
    full = torch.zeros(len(frame.range_m), frame.radar.channels, n, dtype=torch.complex128, device=amplitude.device)
    lines = torch.isin(frame.range_m, tones.range_m)
    index = torch.round(tones.tone_hz * n / frame.radar.prf_hz).long() % n
    part = torch.zeros(int(lines.sum()), frame.radar.channels, n, dtype=torch.complex128, device=amplitude.device)
    part[..., index] = fitted
    full[lines] = torch.fft.ifft(part)
    ramped = full.movedim(0, -1) * _ramp(frame, tones.motion, extraction)[..., None]
    return _shifted_back(ramped, frame, tones.motion)


def _shifted_back(data: Tensor, frame: Frame, motion: PointMotion) -> Tensor:
    """Inverse of `StaticBulk`: lines moved along range by the history of the motion."""
    n = data.shape[-1]
    turns = -frame.path_m(motion) / (frame.radar.range_step_m * n)
    phasor = torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)
