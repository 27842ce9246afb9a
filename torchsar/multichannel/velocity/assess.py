"""Assessment of the fit of one moving point: whether its velocity and position can be relied on.

Four questions are asked of a fit. Does the point rise above the noise? Is it illuminated as the fit
assumes? Does another number of pulse rates explain the data as well? And, asked by the estimators
that search, has the search ended inside its range?
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Outcome, unit_level, unit_phasor, worst
from torchsar.core.fft import smooth_length
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture, Kept, lit_as_expected
from torchsar.multichannel.velocity.likelihood import maximum_likelihood
from torchsar.multichannel.velocity.model import DETECTED_DB, Found, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.radar import BistaticRadar

# log-likelihood by which other numbers of pulse rates must be worse, by choice: a chance of e^-10
_RESOLVED = 10.0
# half width and step of the search in u_a; an assumed u_a may be wrong by the usual +-20 m/s
_U_A_HALF_M_S, _U_A_STEP_M_S = 22.0, 0.5
_FASTEST = 0.9  # largest u_a tried, relative to the speed of the receiver
# Gauss-Newton steps of a hypothesis, found by trial; further ones gain less energy than the noise
# of a sample
_STEPS = 6


@torch.no_grad()
def outcome_of_point(
    data: Tensor,
    radar: BistaticRadar,
    found: Found,
    aperture: Aperture,
    reasons: Sequence[tuple[Outcome, Tensor]] = (),
    inside: Callable[[PointMotion], Tensor] | None = None,
    assumed: bool = False,
    whitening: Whitening | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the outcome of the fit of a point, and the number of pulse rates it seems to be off.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        found: Fit of the point.
        aperture: Expected amplitude over slow time, as the fit used it.
        reasons: Further outcomes, with a bool tensor (...,) that is True where each applies.
        inside: Tells of a motion with another number of pulse rates whether it lies within the
            search, bool (...,). Where it does, the data must exclude it; where it does not, it must
            only explain the data no better. None for no comparison.
        assumed: Whether the along-track speed of the fit was assumed, and may be wrong.
        whitening: Clutter covariance, None for white noise.

    Returns:
        Codes of shape (...,): `EMPTY` for zeros, and `NOISE` below an SNR of 19 dB over all
        samples. `MISFIT` where the illumination does not agree with the expected one (see
        `lit_as_expected`), or only another along-track speed than the assumed one rises above the
        noise. `AMBIGUOUS` where another number of pulse rates explains the data as well. Or one of
        `reasons`. With `inside`, also `pulse_rates` of shape (...,): the number of PRFs to add to
        the Doppler, -1, 0 or 1, and 0 where nothing is found.
    """
    # the ratio is set to -300 dB for samples of zero
    empty, weak = found.snr_db < -250.0, found.snr_db < DETECTED_DB
    codes = [
        (Outcome.EMPTY, empty),
        (Outcome.MISFIT, weak | ~lit_as_expected(data, radar, found.motion, aperture, whitening)),
        *((code, applies & ~empty) for code, applies in reasons),
    ]
    if inside is None:
        return worst((Outcome.NOISE, weak), *codes), {}
    if not (assumed or bool((~weak).any())):
        return worst((Outcome.NOISE, weak), *codes), {"pulse_rates": torch.zeros_like(found.energy)}
    off, ambiguous, snr_db = _compared(unit_level(data), radar, found, aperture, inside, assumed, whitening)
    noise = weak & (snr_db < DETECTED_DB)
    off, before = torch.where(noise, 0, off), worst((Outcome.NOISE, noise), *codes)
    wrong = (off != 0) & (before == Outcome.OK)
    if bool(wrong.any()):
        warnings.warn(
            f"in {int(wrong.sum())} of {wrong.numel()} trials the slant-range velocity is off by whole pulse rates "
            f"(multiples of {radar.ambiguous_velocity_m_s:.4g} m/s), which this estimator cannot resolve; use a wider "
            "search (MovingPointVelocity), or the range walk (WalkAmbiguity)",
            stacklevel=3,
        )
    return torch.maximum(before, worst((Outcome.AMBIGUOUS, ambiguous))), {"pulse_rates": off}


def _compared(
    data: Tensor,
    radar: BistaticRadar,
    found: Found,
    aperture: Aperture,
    inside: Callable[[PointMotion], Tensor],
    assumed: bool,
    whitening: Whitening | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the number of pulse rates by which a fit is wrong, whether it is ambiguous, and the
    best SNR.

    Speeds that differ by lambda PRF differ in the cubic phase of the range history.
    """
    seen, unknowns = data if whitening is None else whitening.backed(data), found.unknowns
    if assumed:
        unknowns = tuple(dict.fromkeys((*unknowns, "u_a_m_s")))
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    # fixed weights, so that the energies of all hypotheses are those of the same pulses
    aperture = Kept(aperture.weight(radar, found.motion, time_s))
    fits = []
    for number in (-1, 0, 1):
        there = found.motion.each(lambda value: value.expand(data.shape[:-2]))
        u_r = there.u_r_m_s + number * radar.ambiguous_velocity_m_s
        # the along-track speed is adapted, so that the curvature of the phase remains the same
        if "u_a_m_s" in unknowns:
            u_a = there.speed_m_s - (there.square_m2_s2 - u_r.square()).clamp_min(1.0).sqrt()
            there = replace(there, u_a_m_s=u_a.clamp_max(_FASTEST * there.speed_m_s))
        there, steps = replace(there, u_r_m_s=u_r), _STEPS if number or assumed else 0
        if assumed:
            there = _sharpest(seen, radar, there, aperture)
        fits.append(maximum_likelihood(data, radar, there, aperture, unknowns, whitening, steps))
    energy, own = torch.stack([fit.energy for fit in fits]), fits[1].energy
    noise = torch.stack([fit.noise_power for fit in fits]).amin(0)
    off = torch.where(energy.amax(0) - own > _RESOLVED * noise, energy.argmax(0) - 1, 0).to(torch.float64)
    rivals = torch.stack([torch.where(inside(fit.motion), fit.energy, 0) for fit in fits[::2]]).amax(0)
    snr_db = torch.stack([fit.snr_db for fit in fits]).amax(0)
    return off, (off != 0) | (own - rivals <= _RESOLVED * noise), snr_db


def _sharpest(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> PointMotion:
    """Return the motion with the along-track speed and position of the strongest tone near it.

    An error of the along-track speed causes a quadratic phase, and one of the position a tone.
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    # rate: Hz per metre of position; middle: Hz/s per m/s of half the speed
    rate = motion.along_m_s / (radar.wavelength_m * motion.range_m)
    middle = radar.speed_m_s / (radar.wavelength_m * radar.reference_range_m)
    # as many neighbouring pulses are added as the frequencies of the tried chirps allow
    factor = int(radar.prf_hz**2 / (2 * _U_A_HALF_M_S * middle * data.shape[-1]))
    factor = min(max(1, factor), data.shape[-1])
    echo = data * point_phasor(radar, motion, time_s, data.dtype).conj()
    line = (echo.sum(-2) * aperture.weight(radar, motion, time_s)).to(torch.complex64)
    whole = line.shape[-1] // factor * factor
    line, time_s = (x[..., :whole].unflatten(-1, (-1, factor)) for x in (line, time_s))
    line, time_s = line.sum(-1), time_s.mean(-1)
    count = 2 * round(_U_A_HALF_M_S / _U_A_STEP_M_S) + 1
    error = torch.linspace(-_U_A_HALF_M_S, _U_A_HALF_M_S, count, dtype=torch.float64, device=data.device)
    chirps = unit_phasor(-middle * error[:, None] * time_s.square(), torch.complex64)
    length = smooth_length(2 * line.shape[-1])
    power = torch.fft.fft(line[..., None, :] * chirps, length).abs()
    at = power.flatten(-2).argmax(-1)
    frequency = torch.fft.fftfreq(length, factor / radar.prf_hz, dtype=torch.float64, device=data.device)
    return replace(
        motion,
        u_a_m_s=(motion.u_a_m_s + error[at // length] * middle / rate).clamp_max(_FASTEST * motion.speed_m_s),
        y0_m=motion.y0_m + frequency[at % length] / rate,
    )
