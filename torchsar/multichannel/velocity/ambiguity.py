"""Detection of Doppler ambiguities by the cubic phase of the range history.

The channels measure the slant-range velocity modulo lambda PRF. The ambiguity number counts these
intervals. It shows neither in the Doppler frequency nor in the phases across the channels, but in
the cubic phase.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate, unit_level
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.bank import tone_energy
from torchsar.radar import BistaticRadar

# Half width of the search in u_a: an assumed u_a may be wrong by the usual bounds of +-20 m/s.
_U_A_HALF_M_S = 22.0
# Step of the search in u_a and reach in y0, as in the defaults of `Search`.
_U_A_STEP_M_S, _REACH_M = 0.5, 150.0
# Found by trial at -14 to 20 dB per sample: the right number explains 2.6 to 5.3 times as much
# energy as a wrong one that was assumed, other numbers at most 1.07 times as much.
_ENERGY_RATIO = 1.3
# Largest u_a tried, relative to the speed of the receiver: a failed fit may end at any speed.
_FASTEST = 0.9


def better_pulse_rate(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """Find by how many PRFs the Doppler of a fitted motion is wrong.

    Three slant-range speeds are compared: the fitted one, and those larger and smaller by lambda
    PRF, which is one PRF of Doppler. For each, the along-track position is fitted again. The
    along-track speed is searched as well, since the fit may have assumed a wrong one: within 22 m/s
    of the speed that keeps the curvature of the phase.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Fitted motion, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        Number of PRFs to add to the Doppler, -1, 0 or 1, float64 (...,). It is 0 unless another
        slant-range speed explains more than 1.3 times the energy that the fitted one explains.
    """
    begin = motion.each(lambda value: value.expand(data.shape[:-2])[..., None])
    offsets = torch.arange(
        -_U_A_HALF_M_S, _U_A_HALF_M_S + _U_A_STEP_M_S / 2, _U_A_STEP_M_S, dtype=torch.float64, device=data.device
    )
    data, energies = unit_level(data), []
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
    return torch.where(energy.amax(0) > _ENERGY_RATIO * energy[1], energy.argmax(0) - 1, 0).to(torch.float64)


def warned_of_ambiguity(
    estimate: Estimate, data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture
) -> Estimate:
    """Check an estimate for a Doppler ambiguity, and warn where one is found.

    Args:
        estimate: Estimate of the velocity.
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Fitted motion, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        The estimate with `pulse_rates` in its info: the number of PRFs to add to the Doppler, see
        `better_pulse_rate`. `ok` is False where this number is not zero.
    """
    off = better_pulse_rate(data, radar, motion, aperture)
    wrong = (off != 0) & estimate.ok
    if bool(wrong.any()):
        span, count = radar.ambiguous_velocity_m_s, f"{int(wrong.sum())} of {wrong.numel()} trials"
        what = (
            f"in {count} the slant-range velocity is off by whole pulse rates (multiples of "
            f"{span:.4g} m/s), which this estimator cannot resolve"
        )
        warnings.warn(
            f"{what}; use a wider search (MovingPointVelocity), or the range walk (WalkAmbiguity)", stacklevel=4
        )
    return replace(estimate, ok=estimate.ok & (off == 0), info={**estimate.info, "pulse_rates": off})
