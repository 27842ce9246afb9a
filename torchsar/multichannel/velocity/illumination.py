"""Illumination of a moving point over slow time, found from the data."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

_PARTS = 8  # chosen: each has 10 dB at the SNR of 19 dB from which on a point counts as detected
# found by trial: noise at this SNR lowers the share to 0.93, an aperture lit for 75 % to 0.75
_LEAST_SHARE = 0.8
# chosen: amplitude relative to that of the strongest part below which a part counts as dark; noise
# in a dark part rarely reaches it where the point is detected
_DARK = 0.35
_FINE = 32  # chosen: parts of the profile, whose ends then lie within 2 % of the aperture
_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class SeenAperture:
    """Expected amplitude, in some trials times a profile over slow time that the data have shown.

    Args:
        aperture: Expected amplitude.
        profile: Factor of the expected amplitude, float64 (..., pulse).
    """

    aperture: Aperture
    profile: Tensor

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude times the profile, see `Aperture.weight`."""
        more = max(0, motion.trial_dims + 1 - self.profile.ndim)  # several hypotheses per trial
        return self.aperture.weight(radar, motion, time_s) * self.profile[(..., *[None] * more, slice(None))]


@torch.no_grad()
def lit_as_expected(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """Tell whether the echo of a point has the expected amplitude over the whole aperture.

    The aperture is divided into eight parts of equal expected energy, and the amplitude a_s of the
    point is fitted in each. Where the point is seen in a share of the parts only, because it enters
    or leaves the beam, is lit for a shorter time, or migrates to another range line,

        (sum |a_s|)^2 / (8 sum |a_s|^2)

    is that share. Standard deviations that assume the whole aperture are then too small.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Fitted motion, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        True where this share is at least 0.8, bool (...,).
    """
    amplitude, _ = _amplitudes(data, radar, motion, aperture, _PARTS)
    squares = _PARTS * amplitude.square().sum(-1)
    return (amplitude.sum(-1).square() >= _LEAST_SHARE * squares) | (squares == 0)


@torch.no_grad()
def seen_aperture(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture
) -> tuple[Aperture, Tensor]:
    """Adapt the expected amplitude where the point is not lit over the whole aperture.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion whose residual Doppler lies within half a Doppler cell, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        The aperture, in these trials times the amplitudes of 32 parts relative to the strongest, or
        zero for parts below 0.35; and where this is so, bool (...,).
    """
    uneven = ~lit_as_expected(data, radar, motion, aperture)
    if not bool(uneven.any()):
        return aperture, uneven
    amplitude, part = _amplitudes(data, radar, motion, aperture, _FINE)
    level = amplitude / amplitude.amax(-1, keepdim=True).clamp_min(_TINY)
    level = torch.where(level >= _DARK, level, 0)
    profile = torch.where(uneven[..., None], level.gather(-1, part), 1.0)
    return SeenAperture(aperture, profile), uneven


def _amplitudes(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture, parts: int
) -> tuple[Tensor, Tensor]:
    """Modulus of the amplitude in parts of equal expected energy, and the part of each pulse."""
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s).expand(*data.shape[:-2], -1)
    energy = weight.square()
    before = energy.cumsum(-1) - energy / 2
    part = (parts * before / energy.sum(-1, keepdim=True).clamp_min(_TINY)).floor().clamp(0, parts - 1).long()
    inside = (part[..., None] == torch.arange(parts, device=data.device)).to(torch.float64)
    deramped = data.to(torch.complex128) * point_phasor(radar, motion, time_s, torch.complex128).conj()
    level = ((deramped.sum(-2) * weight)[..., None, :] @ inside.to(torch.complex128)).abs()[..., 0, :]
    return level / (energy[..., None, :] @ inside)[..., 0, :].clamp_min(_TINY), part
