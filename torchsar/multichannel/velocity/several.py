"""Several moving points in one range line, fitted together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import take
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.likelihood import PointFit, climbed
from torchsar.multichannel.velocity.model import Found, covariance_of, phase_slopes, point_phasor, solved
from torchsar.radar import BistaticRadar

_STEPS = 8  # Gauss-Newton steps, found by trial: points 10 dB apart have converged


@dataclass(frozen=True)
class Together:
    """Points fitted together, per trial.

    Args:
        motion: Motions, shape (..., point).
        found: Fit of the strongest point, whose covariance contains the effect of the others.
        others: Echo of the others, shape (..., channel, pulse).
        left: Data without the points, shape (..., channel, pulse).
    """

    motion: PointMotion
    found: Found
    others: Tensor
    left: Tensor


def fitted_together(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, unknowns: tuple[str, ...]
) -> Together:
    """Find the motions of several points of highest likelihood in white noise, near a start.

    Args:
        data: Channels with the transmit range removed and slow time zero at pulse n // 2, shape
            (..., channel, pulse), complex128.
        radar: Radar parameters.
        start: Starting motions, shape (..., point).
        aperture: Expected amplitude over slow time.
        unknowns: Names of the parameters to estimate; the others keep the values of the start.

    Returns:
        The fit, with the noise power and the covariance in the noise of all samples.
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, start, time_s)[..., None, :]
    problem, motion = _Points(data, radar, weight, time_s, unknowns), start
    fit = problem.fit(motion)
    motion, fit = climbed(problem, motion, fit, unknowns, _STEPS)
    echoes = fit.amplitude[..., None, None] * problem.echo(motion)
    left = data - echoes.sum(-3)
    noise = left.abs().square().mean((-2, -1))
    count = len(unknowns)
    covariance = covariance_of(fit.normal, noise).unflatten(-1, (-1, count)).unflatten(-3, (-1, count))
    own = covariance.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)  # (..., point, unknown, unknown)
    energy = echoes.abs().square().sum((-2, -1))
    first = energy.argmax(-1)
    found = Found(
        motion.each(lambda value: take(value, first)),
        take(fit.amplitude, first),
        noise,
        take(own, first, -3),
        take(energy, first),
        unknowns,
    )
    return Together(motion, found, echoes.sum(-3) - take(echoes, first, -3), left)


def joined(points: PointMotion, further: PointMotion) -> PointMotion:
    """Append a motion (...,) to motions (..., point).

    Args:
        points: Motions of points, shape (..., point).
        further: Motion of one more point, shape (...,).

    Returns:
        Motions of all points.
    """
    return points.each(lambda these, one: torch.cat([these, one[..., None]], -1), further)


@dataclass(frozen=True)
class _Points:
    """Likelihood of the motions of several points in white noise.

    Args:
        data: Channels, shape (..., channel, pulse), complex128.
        radar: Radar parameters.
        weight: Expected amplitudes, shape (..., point, 1, pulse).
        time_s: Slow time in seconds, float64 (pulse,).
        unknowns: Names of the parameters to estimate.
    """

    data: Tensor
    radar: BistaticRadar
    weight: Tensor
    time_s: Tensor
    unknowns: tuple[str, ...]

    def fit(self, motion: PointMotion) -> PointFit:
        """Return the least-squares amplitudes for motions (..., point), see `PointFit`."""
        echo = self.echo(motion)
        x, s = self.data.flatten(-2), echo.flatten(-2)
        gram = s.conj() @ s.mT
        amplitude = solved(gram, s.conj() @ x[..., None])[..., 0]
        left = x - (amplitude[..., None, :] @ s)[..., 0, :]
        slopes = phase_slopes(self.radar, motion, self.time_s, self.unknowns)
        columns = (amplitude[..., None, None, None] * 1j * slopes * echo[..., None, :, :]).flatten(-2).flatten(-3, -2)
        # without the parts that other amplitudes would take up
        columns = columns - solved(gram, s.conj() @ columns.mT).mT @ s
        return PointFit(
            amplitude,
            x.abs().square().sum(-1) - left.abs().square().sum(-1),
            (columns.conj() @ left[..., None])[..., 0].real,
            (columns.conj() @ columns.mT).real,
        )

    def echo(self, motion: PointMotion) -> Tensor:
        """Return the echoes of unit amplitude of the points, (..., point, channel, pulse)."""
        return self.weight * point_phasor(self.radar, motion, self.time_s, torch.complex128)
