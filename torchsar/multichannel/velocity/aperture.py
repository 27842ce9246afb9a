"""Expected amplitude of the echo of a moving point over slow time, and the amplitude that the data
show.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.model import TINY, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.radar import BistaticRadar


@dataclass(frozen=True)
class Dwell:
    """Expected amplitude 1 for a duration centred on the time at broadside, 0 outside.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> multichannel.Dwell(1.5).weight(receiver, still, torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0]))
    tensor([0., 1., 1., 1., 0.], dtype=torch.float64)

    The time at broadside follows from the motion of the point, without a gradient. Estimators
    therefore do not fit the ends of the interval to the data.

    Args:
        duration_s: Duration in seconds.

    Raises:
        ValueError: If the duration is not positive and finite.
    """

    duration_s: float

    def __post_init__(self) -> None:
        if not 0 < self.duration_s < float("inf"):
            raise ValueError(
                f"a dwell needs a positive, finite duration_s, got {self.duration_s}; use ElementBeam() for no limit"
            )

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude of the echo of a point in each pulse.

        Args:
            radar: Radar parameters.
            motion: Motion of the point, shape (...,).
            time_s: Slow time in seconds, float64 (pulse,).

        Returns:
            1 within the duration and 0 outside, float64 (..., pulse).
        """
        # time since the point was at broadside
        since = time_s - (motion.y0_m / motion.along_m_s).detach()[..., None]
        return (since.abs() < self.duration_s / 2).to(torch.float64)


@dataclass(frozen=True)
class ElementBeam:
    """Expected amplitude by the one-way antenna pattern of a channel.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> weight = multichannel.ElementBeam().weight(receiver, still, torch.tensor([0.0, 1.0, 3.0]))
    >>> [round(value, 2) for value in weight.tolist()]  # after 0, 1 and 3 s
    [1.0, 0.94, 0.52]

    The pattern is sinc(L sin(look) / lambda) with the length L = `radar.element_m` of the aperture
    of a channel and the look angle from broadside. Side lobes and their signs are included.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the pattern over slow time, see `Dwell.weight`.

        Not differentiable in the motion.
        """
        along = motion.along_m_s.detach()[..., None] * time_s - motion.y0_m.detach()[..., None]
        across = motion.range_m.detach()[..., None] - motion.u_r_m_s.detach()[..., None] * time_s
        turns = radar.element_m * along / torch.sqrt(along.square() + across.square()) / radar.wavelength_m
        return torch.sinc(turns)


@dataclass(frozen=True)
class Kept:
    """Expected amplitude that is the same for all motions.

    Args:
        amplitude: Expected amplitude, float64 (..., pulse).
    """

    amplitude: Tensor

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude, see `Dwell.weight`."""
        return self.amplitude


@dataclass(frozen=True)
class SeenAperture:
    """Expected amplitude, multiplied in some trials by a profile over slow time that was measured
    in the data.

    Args:
        aperture: Expected amplitude.
        profile: Factor of the expected amplitude, float64 (..., pulse).
    """

    aperture: Aperture
    profile: Tensor

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude times the profile, see `Dwell.weight`."""
        # dimensions of length one for several hypotheses per trial
        more = max(0, motion.trial_dims + 1 - self.profile.ndim)
        return self.aperture.weight(radar, motion, time_s) * self.profile[(..., *[None] * more, slice(None))]


# type of the apertures that stages accept, and the default
Expected = Dwell | ElementBeam
ELEMENT_BEAM = ElementBeam()
# expected amplitude of the echo of a point, centred on the time at which it is at broadside
Aperture = Dwell | ElementBeam | Kept | SeenAperture


@torch.no_grad()
def lit_as_expected(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    whitening: Whitening | None = None,
) -> Tensor:
    """Decide whether the echo of a point has the expected amplitude over the whole aperture.

    The aperture is divided into eight parts of equal expected energy, and the amplitude a_s of the
    point is fitted in each. The point may be illuminated in a share of the parts only, because it
    enters or leaves the beam, is lit for a shorter time, or migrates to another range line. Then
    (sum |a_s|)^2 / (8 sum |a_s|^2) is that share. Standard deviations that assume the whole
    aperture are then too small.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Fitted motion, shape (...,).
        aperture: Expected amplitude over slow time.
        whitening: Clutter covariance, None for white noise.

    Returns:
        True where this share is at least 0.8, bool (...,).
    """
    # each of 8 parts has 10 dB at the SNR of 19 dB from which a point counts as detected
    amplitude = _Pulses.of(data, radar, motion, aperture, 8, whitening).amplitudes(8)
    squares = 8 * amplitude.square().sum(-1)
    # noise at this SNR lowers the share to 0.93, an aperture lit for 75 % to 0.75
    return (amplitude.sum(-1).square() >= 0.8 * squares) | (squares == 0)


@torch.no_grad()
def seen_aperture(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    whitening: Whitening | None = None,
) -> tuple[Aperture, Tensor]:
    """Adapt the expected amplitude where the point is not lit over the whole aperture.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion whose residual Doppler lies within half a Doppler cell, shape (...,).
        aperture: Expected amplitude over slow time.
        whitening: Clutter covariance, None for white noise.

    Returns:
        The aperture, in these trials times the amplitudes of 32 parts relative to the strongest,
        and zero beyond the nearest parts below 0.35 on either side of it; and where this is so,
        bool (...,). The ends are those pulses between which the point explains most energy.
    """
    uneven = ~lit_as_expected(data, radar, motion, aperture, whitening)
    if not bool(uneven.any()):
        return aperture, uneven
    # the ends of 32 parts of the profile lie within 2 % of the aperture
    pulses = _Pulses.of(data, radar, motion, aperture, 32, whitening)
    amplitude = pulses.amplitudes(32)
    level = amplitude / amplitude.amax(-1, keepdim=True).clamp_min(TINY)
    # Beyond a dark part there is only noise, whose phase far from the point would distort the fit.
    # The limit is a choice: noise in a dark part rarely reaches 0.35 where the point is detected.
    gaps = (level < 0.35).cumsum(-1)
    lit = (level >= 0.35) & (gaps == gaps.gather(-1, level.argmax(-1, keepdim=True)))
    return SeenAperture(aperture, torch.where(uneven[..., None], pulses.ended(level, lit), 1.0)), uneven


@dataclass(frozen=True)
class _Pulses:
    """Contribution of each pulse to the correlation of the data with the echo, and to its energy.

    In clutter, both are those of the matched filter in clutter. The parts have equal expected
    energy. Each tensor has the shape (..., pulse).
    """

    value: Tensor
    energy: Tensor
    part: Tensor

    @staticmethod
    def of(
        data: Tensor,
        radar: BistaticRadar,
        motion: PointMotion,
        aperture: Aperture,
        parts: int,
        whitening: Whitening | None,
    ) -> _Pulses:
        """Correlate the data with the echo of a motion, and divide the aperture."""
        time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
        weight = aperture.weight(radar, motion, time_s).expand(*data.shape[:-2], -1)
        echo = weight[..., None, :] * point_phasor(radar, motion, time_s, torch.complex128)
        filtered = data.to(torch.complex128), echo
        if whitening is not None:
            filtered = tuple(whitening.backed(x) for x in filtered)
        value, energy = ((echo.conj() * x).sum(-2) for x in filtered)
        energy = energy.real.clamp_min(0)
        before = energy.cumsum(-1) - energy / 2
        # samples that are NaN are rejected later, and until then must not become an index
        share = (before / energy.sum(-1, keepdim=True).clamp_min(TINY)).nan_to_num()
        part = (parts * share).floor().clamp(0, parts - 1).long()
        return _Pulses(value, energy, part)

    def amplitudes(self, parts: int) -> Tensor:
        """Modulus of the amplitude in each part, (..., part)."""
        inside = (self.part[..., None] == torch.arange(parts, device=self.part.device)).to(torch.float64)
        level = (self.value[..., None, :] @ inside.to(torch.complex128)).abs()[..., 0, :]
        return level / (self.energy[..., None, :] @ inside)[..., 0, :].clamp_min(TINY)

    def ended(self, level: Tensor, lit: Tensor) -> Tensor:
        """Profile (..., pulse) of the lit parts, which follow each other, with levels (..., part).

        If there are three or more, each end of the profile is a pulse in the outermost lit part or
        a part beside it. The two ends are those between which the point explains most energy. The
        level near an end is that of the next part inside.
        """
        index = torch.arange(level.shape[-1], device=level.device)
        first = lit.to(torch.int8).argmax(-1, keepdim=True)
        last = first + lit.sum(-1, keepdim=True) - 1
        inner = torch.minimum(torch.maximum(index, first + 1), last - 1).clamp_min(0)
        wide = level.gather(-1, inner).gather(-1, self.part)
        phase = (self.value * lit.gather(-1, self.part)).sum(-1, keepdim=True).angle()
        near = (self.part >= first - 1) & (self.part <= last + 1)
        match = torch.where(near, wide * (self.value * torch.polar(torch.ones_like(phase), -phase)).real, 0)
        power = torch.where(near, wide.square() * self.energy, 0)

        def from_to(begin: Tensor, end: Tensor, tried: Tensor) -> Tensor:
            """Index of the tried pulse with the most explained energy, given sums (2,
            ..., pulse).
            """
            found, power = (end - begin).unbind(0)
            explained = found.clamp_min(0).square() / power.clamp_min(TINY)
            return torch.where(tried, explained, -1).argmax(-1, keepdim=True)

        both, pulse = torch.stack([match, power]), torch.arange(self.part.shape[-1], device=self.part.device)
        sums = both.cumsum(-1)
        to_last = (both * (self.part <= last)).sum(-1, keepdim=True)
        begin = from_to(sums - both, to_last, (self.part == first) | (self.part == first - 1))
        before = (both * (pulse < begin)).sum(-1, keepdim=True)
        end = from_to(before, sums, (self.part == last) | (self.part == last + 1))
        ended = torch.where((pulse >= begin) & (pulse <= end), wide, 0)
        return torch.where(last - first >= 2, ended, torch.where(lit, level, 0).gather(-1, self.part))
