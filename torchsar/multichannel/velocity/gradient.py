"""The likelihood of a moving point as a differentiable objective, and its maximum by a descent on
gradients of autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.interferometry import DETECTED_DB
from torchsar.multichannel.velocity.likelihood import PointLikelihood, maximum_likelihood
from torchsar.multichannel.velocity.model import UNKNOWNS, estimate_of, moved, point_phasor, round_units
from torchsar.optim import lbfgs
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny


def explained_energy(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor) -> Tensor:
    """Energy of data (..., channel, pulse) that a point of this motion explains with its best
    complex amplitude, (...,): the log-likelihood but for constants.

    weight: expected amplitude (..., pulse), `aperture.weight(...)` at the start of a search: where
    it ends must say nothing about the place. Differentiable in data and motion.
    """
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
) -> Estimate:
    """Maximum likelihood near `start` by limited-memory BFGS: the check of `maximum_likelihood`,
    and the pattern for objectives of your own. Arguments as there.
    """
    energy = data.abs().to(torch.float64).square().sum((-2, -1)).clamp_min(_TINY)
    at_start = maximum_likelihood(data, radar, start, aperture, unknowns, steps=0)
    # unknowns are nearly alike in their phases: in units of their deviations the objective is round
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
    return estimate_of(
        fit,
        found.ok & (fit.snr_db >= DETECTED_DB),
        torch.sigmoid((fit.snr_db - DETECTED_DB) / 3),
        converged=found.converged,
    )
