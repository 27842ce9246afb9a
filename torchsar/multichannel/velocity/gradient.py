"""Likelihood of a moving point as a differentiable objective, and its maximum by gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome
from torchsar.multichannel.check import checked_channels
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.assess import outcome_of_point
from torchsar.multichannel.velocity.illumination import seen_aperture
from torchsar.multichannel.velocity.likelihood import PointLikelihood, maximum_likelihood
from torchsar.multichannel.velocity.model import UNKNOWNS, estimate_of, moved, point_phasor, round_units
from torchsar.optim import lbfgs
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny  # keeps divisions by zero finite


def explained_energy(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor) -> Tensor:
    """Return the energy of the data that a point explains with its best complex amplitude.

    Up to constants this is the log-likelihood. Differentiable in data and motion.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        weight: Expected amplitude, shape (..., pulse). In a search, compute it once for the
            starting motion with `aperture.weight(...)` and keep it. Otherwise the search fits the
            position to the ends of the aperture.

    Returns:
        Energy, shape (...,).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or the channels are not those of the radar.
    """
    data = checked_channels(data, radar, "explained_energy", finite=False)
    time_s, weight = radar.pulse_axis(data.shape[-1]).values(data.device), weight[..., None, :]
    total = weight.square().expand(data.shape).sum((-2, -1)).clamp_min(_TINY)
    return (weight * data.to(torch.complex128) * point_phasor(radar, motion, time_s, torch.complex128).conj()).sum(
        (-2, -1)
    ).abs().square() / total


def gradient_likelihood(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    unknowns: tuple[str, ...] = UNKNOWNS,
    steps: int = 60,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the motion of highest likelihood by limited-memory BFGS with autograd gradients.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, PointMotion, gradient_likelihood
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.zeros(3, 90, dtype=torch.complex64)
    >>> gradient_likelihood(data, radar, PointMotion.of(radar, data.real), Dwell(0.5)).failed
    tensor(True)

    The function serves as a check of `maximum_likelihood`, which is faster, and as an example for
    other objectives.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        start: Starting motion, shape (...,). Its residual Doppler must lie within half a Doppler
            cell, as for `maximum_likelihood`.
        aperture: Expected amplitude over slow time.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`.
        steps: Largest number of steps.
        assess: Whether the outcome is assessed.

    Returns:
        `u_r_m_s`, `u_a_m_s`, `y0_m` of shape (...,) with standard deviations of the unknowns.
        `info` holds `snr_db` (over all samples), `noise_power` (per sample) and `converged`. Where
        the point is lit in a part of the aperture only, this part is used, see `seen_aperture`.
        Outcomes: those of `outcome_of_point`, and `NOT_CONVERGED` where the search failed.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if `unknowns` holds other names or a name twice.
    """
    data = checked_channels(data, radar, "gradient_likelihood")
    aperture, _ = seen_aperture(data, radar, start, aperture)
    energy = data.abs().to(torch.float64).square().sum((-2, -1)).clamp_min(_TINY)
    at_start = maximum_likelihood(data, radar, start, aperture, unknowns, steps=0)
    # the phases of the unknowns are nearly alike: in whitened units the objective is isotropic
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, at_start.motion, time_s)
    echo = weight[..., None, :] * point_phasor(radar, at_start.motion, time_s, torch.complex128)
    units = round_units(
        PointLikelihood.of(echo, radar, at_start.motion, aperture, unknowns, None).fit(at_start.motion).normal
    )

    def there(x: Tensor) -> PointMotion:
        return moved(at_start.motion, (units @ x[..., None])[..., 0], unknowns)

    def cost(x: Tensor) -> Tensor:
        return -explained_energy(data, radar, there(x), weight) / energy

    found = lbfgs(
        cost, torch.zeros(*data.shape[:-2], len(unknowns), dtype=torch.float64, device=data.device), steps=steps
    )
    fit = maximum_likelihood(data, radar, there(found.x), aperture, unknowns, steps=0)
    outcome = None
    if assess:
        outcome, _ = outcome_of_point(data, radar, fit, aperture, [(Outcome.NOT_CONVERGED, ~found.ok)])
    return estimate_of(fit, outcome, {"converged": found.converged})
