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

from torchsar.core import Estimate, Outcome, unit_level
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.bank import sharpest_tone
from torchsar.multichannel.velocity.likelihood import maximum_likelihood
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
# Log-likelihood by which other ambiguity numbers must be worse, by choice: a chance of e^-10.
RESOLVED = 10.0


def _hypotheses(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture
) -> list[tuple[PointMotion, Tensor]]:
    """Fit slant-range speeds that differ by -1, 0 and 1 PRF of Doppler, with explained energies.

    For each, the along-track position is fitted again. The along-track speed is searched as well,
    since the fit may have assumed a wrong one: within 22 m/s of the speed that keeps the curvature
    of the phase.
    """
    begin = motion.each(lambda value: value.expand(data.shape[:-2])[..., None])
    offsets = torch.arange(
        -_U_A_HALF_M_S, _U_A_HALF_M_S + _U_A_STEP_M_S / 2, _U_A_STEP_M_S, dtype=torch.float64, device=data.device
    )
    found = []
    for number in (-1, 0, 1):
        u_r = begin.u_r_m_s + number * radar.ambiguous_velocity_m_s
        u_a = begin.speed_m_s - torch.sqrt((begin.square_m2_s2 - u_r.square()).clamp_min(1.0))
        there = replace(begin, u_r_m_s=u_r, u_a_m_s=(u_a + offsets).clamp_max(_FASTEST * begin.speed_m_s))
        found.append(sharpest_tone(data, radar, there, aperture, _REACH_M))
    return found


def _excluded(
    data: Tensor, radar: BistaticRadar, motions: list[PointMotion], aperture: Aperture, own: int = 1
) -> Tensor:
    """Whether the log-likelihoods of all motions but one are lower by more than 10, bool (...,)."""
    fits = [maximum_likelihood(data, radar, motion, aperture) for motion in motions]
    others = torch.stack([fit.energy for i, fit in enumerate(fits) if i != own]).amax(0)
    return fits[own].energy - others > RESOLVED * fits[own].noise_power


def warned_of_ambiguity(
    estimate: Estimate,
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    exclude: bool = False,
) -> Estimate:
    """Check an estimate for a Doppler ambiguity, and warn where one is found.

    The fitted slant-range speed is compared with those larger and smaller by lambda PRF, which is
    one PRF of Doppler. The Doppler is wrong where another explains more than 1.3 times the energy.

    Args:
        estimate: Estimate of the velocity.
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Fitted motion, shape (...,).
        aperture: Expected amplitude over slow time.
        exclude: Whether `ok` is False also where the data do not exclude the other speeds, that is
            where their log-likelihood is not lower by more than 10. This is so for short apertures,
            since they differ in the cubic phase.

    Returns:
        The estimate with `pulse_rates` in its info: the number of PRFs to add to the Doppler, -1, 0
        or 1, float64 (...,). `ok` is False where this number is not zero.
    """
    with torch.no_grad():
        data = unit_level(data)
        motions, energies = zip(*_hypotheses(data, radar, motion, aperture), strict=True)
        energy = torch.stack(energies)
        off = torch.where(energy.amax(0) > _ENERGY_RATIO * energy[1], energy.argmax(0) - 1, 0).to(torch.float64)
        sure = _excluded(data, radar, list(motions), aperture) if exclude else torch.ones_like(estimate.ok)
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
    return replace(
        estimate,
        outcome=torch.maximum(estimate.outcome, Outcome.of((off == 0) & sure, Outcome.AMBIGUOUS)),
        info={**estimate.info, "pulse_rates": off},
    )
