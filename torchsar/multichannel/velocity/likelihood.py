"""Maximum likelihood of velocity and place of a moving point by Gauss-Newton steps, its complex
amplitude profiled out, in white noise or in clutter of known covariance.

Source: brief 001, Velocity (ML). In white noise it reaches the Cramer-Rao bound of
`metrics.bistatic_bounds`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import (
    UNKNOWNS,
    Found,
    chosen,
    covariance_of,
    moved,
    phase_slopes,
    point_phasor,
    refuse_unknowns,
    solved,
)
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny
_HALVINGS = 4


@dataclass(frozen=True)
class PointFit:
    """Of data at a motion, per trial: amplitude, energy explained, gradient (..., unknown) and
    normal matrix (..., unknown, unknown) of half the explained energy.
    """

    amplitude: Tensor
    energy: Tensor
    gradient: Tensor
    normal: Tensor


def maximum_likelihood(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    unknowns: tuple[str, ...] = UNKNOWNS,
    whitening: Whitening | None = None,
    steps: int = 12,
) -> Found:
    """The most likely motion near `start`, whose residual tone (du_r + v dy0 / R0) / lambda must
    lie within half a Doppler cell: 0.03 m/s at 4.5 s. `interferometry` and `bank_search` do.

    data: complex (..., channel, pulse), slow time zero at pulse n // 2, transmit range removed.
    aperture: expected amplitude. unknowns: of u_r_m_s, u_a_m_s, y0_m, what is estimated; the rest
    stays at the start. whitening: covariance of what is not the point, None for white noise. The
    expected amplitude stays where the start puts it: where it ends says nothing about the place. A
    step is halved, or not taken, in trials where it explains no more energy than before, so that
    neighbours change nothing.
    """
    problem = PointLikelihood.of(data, radar, start, aperture, unknowns, whitening)
    motion = start.each(lambda value: value.expand(data.shape[:-2]))
    fit = problem.fit(motion)
    for _ in range(steps):
        motion, fit = _stepped(problem, motion, fit)
    noise = problem.noise_power(fit)
    covariance = covariance_of(fit.normal, noise)
    return Found(motion, fit.amplitude, noise, covariance, fit.energy, unknowns)


@dataclass(frozen=True)
class PointLikelihood:
    """Data (..., channel, pulse), whitened where there is a covariance, and all that stays the same
    from step to step of a search.

    weight: expected amplitude (..., 1, pulse); unknowns: of u_r_m_s, u_a_m_s, y0_m.
    """

    data: Tensor
    radar: BistaticRadar
    weight: Tensor
    time_s: Tensor
    unknowns: tuple[str, ...]
    whitening: Whitening | None

    @staticmethod
    def of(
        data: Tensor,
        radar: BistaticRadar,
        start: PointMotion,
        aperture: Aperture,
        unknowns: tuple[str, ...],
        whitening: Whitening | None,
    ) -> PointLikelihood:
        refuse_unknowns(unknowns)
        time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
        weight = aperture.weight(radar, start, time_s)[..., None, :]
        data = data.to(torch.complex128)
        return PointLikelihood(
            data if whitening is None else whitening.applied(data), radar, weight, time_s, unknowns, whitening
        )

    def fit(self, motion: PointMotion) -> PointFit:
        """Least squares of the amplitude at a motion, and its slopes by the unknowns."""
        slopes = phase_slopes(self.radar, motion, self.time_s, self.unknowns)
        phasor = point_phasor(self.radar, motion, self.time_s, torch.complex128)
        if self.whitening is None:
            return _white(self.data * phasor.conj(), self.weight, slopes)
        model = self.weight * phasor
        return _coloured(
            self.data, self.whitening.applied(model), self.whitening.applied(1j * slopes * model[..., None, :, :])
        )

    def noise_power(self, fit: PointFit) -> Tensor:
        """Power per sample that the point leaves, where it shines; relative to the covariance where
        there is one.
        """
        power = self.data.abs().square()
        shines = (
            torch.ones_like(power)
            if self.whitening is not None
            else (self.weight != 0).expand(power.shape).to(power.dtype)
        )
        left = (power * shines).sum((-2, -1)) - fit.energy
        return left.clamp_min(0) / shines.sum((-2, -1)).clamp_min(1)


def _white(deramped: Tensor, weight: Tensor, slopes: Tensor) -> PointFit:
    """In white noise all happens on the deramped data, which are constant where the motion is
    right.
    """
    power = weight.square().expand(deramped.shape)
    total = power.sum((-2, -1)).clamp_min(_TINY)
    amplitude = (weight * deramped).sum((-2, -1)) / total
    centred = slopes - ((power[..., None, :, :] * slopes).sum((-2, -1)) / total[..., None])[..., None, None]
    turned = (weight * (amplitude.conj()[..., None, None] * deramped).imag)[..., None, :, :]
    gradient = (centred * turned).sum((-2, -1))
    flat = (centred * weight[..., None, :, :]).flatten(-2)
    return PointFit(
        amplitude,
        amplitude.abs().square() * total,
        gradient,
        amplitude.abs().square()[..., None, None] * (flat @ flat.mT),
    )


def _coloured(data: Tensor, model: Tensor, columns: Tensor) -> PointFit:
    """The same on whitened data, model and columns (..., unknown, channel, bin)."""
    x, s, d = data.flatten(-2), model.flatten(-2), columns.flatten(-2)
    total = s.abs().square().sum(-1).clamp_min(_TINY)
    amplitude = (s.conj() * x).sum(-1) / total
    d = d - ((d * s.conj()[..., None, :]).sum(-1) / total[..., None])[..., None] * s[..., None, :]
    gradient = (amplitude.conj()[..., None] * (d.conj() * x[..., None, :]).sum(-1)).real
    normal = (d.conj()[..., :, None, :] * d[..., None, :, :]).sum(-1).real
    return PointFit(
        amplitude, amplitude.abs().square() * total, gradient, amplitude.abs().square()[..., None, None] * normal
    )


def _stepped(problem: PointLikelihood, motion: PointMotion, fit: PointFit) -> tuple[PointMotion, PointFit]:
    """One Gauss-Newton step, halved where it explains less."""
    step = _bounded(solved(fit.normal, fit.gradient[..., None])[..., 0], motion, problem.unknowns)
    pending = torch.ones_like(fit.energy, dtype=torch.bool)
    for _ in range(_HALVINGS):
        there = moved(motion, step, problem.unknowns)
        fit_there = problem.fit(there)
        better = pending & (fit_there.energy > fit.energy)
        motion = chosen(there, motion, better)
        fit = PointFit(
            *(
                torch.where(better[(...,) + (None,) * (new.ndim - better.ndim)], new, old)
                for new, old in zip(vars(fit_there).values(), vars(fit).values(), strict=True)
            )
        )
        pending = pending & ~better
        if not bool(pending.any()):
            break
        step = torch.where(pending[..., None], step / 2, 0.0)
    return motion, fit


def _bounded(step: Tensor, motion: PointMotion, unknowns: tuple[str, ...]) -> Tensor:
    """Steps that stay far from the receiver's speed: at most a tenth of the speed past the point
    along track.
    """
    if "u_a_m_s" not in unknowns:
        return step
    at = unknowns.index("u_a_m_s")
    reach = 0.1 * motion.along_m_s / step[..., at].abs().clamp_min(_TINY)
    return step * reach.clamp_max(1.0)[..., None]
