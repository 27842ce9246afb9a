"""Whether a velocity that is known modulo lambda PRF lies whole pulse rates off: judged by the
cubic phase of the range history, which neither Doppler nor channels show.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.bank import tone_energy
from torchsar.radar import BistaticRadar

_AROUND_M_S, _STEP_M_S, _REACH_M = 22.0, 0.5, 150.0
_CLEARLY = 1.3
_FASTEST = 0.9  # of the receiver: fits that failed may end anywhere


def better_pulse_rate(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """How many pulse rates (..., whole, -1..1) must be added to the Doppler of a fitted motion to
    explain clearly more of data (..., channel, pulse); 0 where it is right as it is.

    One pulse rate is lambda PRF of slant-range velocity. Each alternative has the direction that
    the channels measured, and the best along-track speed within 22 m/s of the one that keeps the
    curvature of the phase: what an estimator was told of it may be wrong.
    """
    begin = motion.each(lambda value: value.expand(data.shape[:-2])[..., None])
    offsets = torch.arange(
        -_AROUND_M_S, _AROUND_M_S + _STEP_M_S / 2, _STEP_M_S, dtype=torch.float64, device=data.device
    )
    level = data.abs().amax((-2, -1), keepdim=True)
    # its squares must fit into single precision
    data, energies = data / torch.where(level > 0, level, 1.0), []
    for number in (-1, 0, 1):
        u_r = begin.u_r_m_s + number * radar.ambiguous_velocity_m_s
        u_a = begin.speed_m_s - torch.sqrt((begin.square_m2_s2 - u_r.square()).clamp_min(1.0))
        energies.append(
            tone_energy(
                data,
                radar,
                replace(begin, u_r_m_s=u_r, u_a_m_s=(u_a + offsets).clamp_max(_FASTEST * begin.speed_m_s)),
                aperture,
                _REACH_M,
            )
        )
    energy = torch.stack(energies)
    return torch.where(energy.amax(0) > _CLEARLY * energy[1], energy.argmax(0) - 1, 0).to(torch.float64)


def warned_of_ambiguity(
    estimate: Estimate, data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture
) -> Estimate:
    """The estimate with `pulse_rates` in its info, not ok where they are not zero; warns if there
    are such trials.
    """
    off = better_pulse_rate(data, radar, motion, aperture)
    wrong = (off != 0) & estimate.ok
    if bool(wrong.any()):
        span, count = radar.ambiguous_velocity_m_s, f"{int(wrong.sum())} of {wrong.numel()} trials"
        what = (
            f"in {count} the slant-range velocity is whole pulse rates, {span:.4g} m/s each, off: "
            f"values here are known modulo {span:.4g} m/s alone"
        )
        warnings.warn(
            f"{what}; search farther (MovingPointVelocity), or resolve the range walk (WalkAmbiguity)", stacklevel=4
        )
    return replace(estimate, ok=estimate.ok & (off == 0), info={**estimate.info, "pulse_rates": off})
