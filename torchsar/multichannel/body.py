"""Velocity, image and echo of extended moving targets ("bodies").

The slant-range velocity of a body is the one of highest likelihood over all tones and segments of
its data, each with a free amplitude. At the end it is fitted to the tones of the pixels of the
body's image. The along-track velocity is the one of the sharpest image. The echo is the fit with
both velocities.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3 (extraction of moving targets, one velocity for
    scatterers close together).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Outcome, unit_level, worst
from torchsar.core.fft import smooth_length
from torchsar.multichannel.chip import TINY, Chip, Extraction, Picture, chip_about
from torchsar.multichannel.migration import Frame, envelope_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import checked_channels
from torchsar.multichannel.velocity.model import point_phasor


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
            not finite. Also if the data have no range cell of the body, or fewer than 12 beside it.
    """
    data = checked_channels(data, frame.radar, "find_body", "channel, pulse, range")
    # least number of pulses, by convention: two overlapping segments of two pulses
    if data.shape[-2] < 4:
        raise ValueError(f"find_body needs at least 4 pulses, got {data.shape[-2]}; give a longer record")
    half = frame.radar.ambiguous_velocity_m_s / 2 if u_r_half_m_s is None else u_r_half_m_s

    def shown(u_r: Tensor | float, u_a: Tensor | float) -> PointMotion:
        return PointMotion.imaged_at(frame.radar, data, u_r, u_a, image_s, image_m)

    chip = chip_about(data, frame, shown(0.0, 0.0), extraction)
    for number in range(rounds):
        # later rounds search only near the velocities found, because the motion then changes by
        # little
        wide = number < 2
        u_r, std = _closing_speed(chip, image_s, image_m, half if wide else 2.0)
        motion, reach = shown(u_r, chip.motion.u_a_m_s), extraction.range_m / 2
        # the lines must contain the body around its middle, and the record must contain a pulse
        # that illuminates it
        inside = bool(frame.range_m[0] + reach <= motion.range_m <= frame.range_m[-1] - reach)
        moved = chip_about(data, frame, motion, extraction) if inside else chip
        if not inside or not bool(moved.lit.any()):
            return _body_of(chip, std, half, lost=True)
        u_a = _along_speed(moved, u_a_half_m_s if wide else 1.0)
        chip = chip_about(data, frame, shown(u_r, u_a), extraction)
        motion = centred_motion(chip)
        if motion is not chip.motion:
            image_s, image_m = float(motion.image_s), float(motion.closest_m)
        chip = chip_about(data, frame, motion, extraction)
    u_r, std = _closing_speed(chip, image_s, image_m, 1.0)
    # a third step would change u_r by at most a hundredth of its standard deviation
    for _ in range(2):
        chip = chip_about(data, frame, shown(u_r, chip.motion.u_a_m_s), extraction)
        step, std, _ = chip.fit(chip.picture(), image_s, image_m)
        u_r = u_r + step.clamp(-1.0, 1.0)
    return _body_of(chip_about(data, frame, shown(u_r, chip.motion.u_a_m_s), extraction), std, half)


def _body_of(chip: Chip, std: Tensor, half_m_s: float, lost: bool = False) -> Body:
    """Form the body of a chip and judge it.

    The limits were found by trial. Of 200 pairs of ships in one place, 35 had a predicted standard
    deviation below 0.3 m/s. Their rms error was 1.1 standard deviations, and one exceeded 5. Ships
    on a sea stay below 0.13 m/s; u_r displaces a body by about 20 m per m/s. In sea without a ship,
    the mean of the bright pixels was below 18 in 15 trials. For a ship that is weak but visible (4
    dB in the frames of the tests) it reaches 7000.
    """
    picture = chip.picture()
    level = (picture.level * picture.bright).sum() / picture.bright.sum().clamp_min(1)
    # a velocity in the last 2 % of the search counts as one at its end
    inside = (chip.motion.u_r_m_s.abs() < 0.98 * half_m_s) & (not lost)
    outcome = worst(
        (Outcome.NOISE, ~(level > 40.0)), (Outcome.OUTSIDE_SEARCH, ~inside), (Outcome.INEXACT, ~(std < 0.3))
    )
    return Body(chip.motion, std, chip, picture, level, outcome)


def _closing_speed(chip: Chip, image_s: float, image_m: float, half_m_s: float) -> tuple[Tensor, Tensor]:
    """Return the most likely slant-range speed u_r near that of the chip, and its standard
    deviation.
    """

    def energy(u_r: Tensor) -> Tensor:
        u_a, where = chip.motion.u_a_m_s, (image_s, image_m)
        # all speeds at once take two thirds of the time, but nine times the memory
        parts = (PointMotion.imaged_at(chip.radar, chip.cells, x, u_a.expand(x.shape), *where) for x in u_r.split(9))
        return torch.cat([chip.energy(part) for part in parts])

    return _highest(energy, chip.motion.u_r_m_s, half_m_s)


def _highest(
    value: Callable[[Tensor], Tensor], middle: Tensor, half_m_s: float, half: int = 40, grids: int = 3
) -> tuple[Tensor, Tensor]:
    """Return the speed of the highest value, by grids about the middle, and its standard deviation.

    A grid takes 40 steps to either side of its middle (0.5 m/s in a search of +-20 m/s, as in
    `Search`). The next one is centred on the maximum and has a tenth of the step. A parabola
    refines the maximum. The value is a log-likelihood, from which the standard deviation follows.
    """
    std = step = torch.as_tensor(half_m_s / half, dtype=torch.float64)
    grid = torch.arange(-half, half + 1, dtype=torch.float64, device=middle.device)
    for _ in range(grids):
        values = value(middle + step * grid)
        inner = values.argmax().clamp(1, len(values) - 2)
        low, top, high = values[inner + torch.arange(-1, 2, device=values.device)]
        curvature = (2 * top - low - high).clamp_min(TINY)
        shift = grid[inner] + (0.5 * (high - low) / curvature).clamp(-1, 1)
        middle, std, step = middle + step * shift, step / torch.sqrt(curvature), step / 10
    return middle, std


def _along_speed(chip: Chip, half_m_s: float) -> Tensor:
    """Return the along-track speed u_a with the sharpest image, within half_m_s of that of the
    chip.

    Sharpness is the mean square of the intensities over their squared mean.
    """
    radar, motion = replace(chip.radar, channel_m=(0.0,)), chip.motion
    time_s = chip.time_s[chip.lit]
    # Hann weights prevent interference by side lobes of neighbouring scatterers
    echo = chip.echo(chip.cells)[:, chip.lit] * torch.hann_window(
        len(time_s), dtype=torch.float64, device=time_s.device
    )
    # The brightest eight lines are used. By trial, 4 to 16 give the same velocities, and 16 take a
    # quarter more time. Lines are scaled to unit level, because squares of squares must fit into
    # single precision.
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
