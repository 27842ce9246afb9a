"""Maximum likelihood of velocity and position of a moving point by Gauss-Newton steps.

The complex amplitude is fitted for each motion in closed form. The noise is white, or clutter of
known covariance. In white noise the estimate reaches the Cramer-Rao bound of
`metrics.bistatic_bounds`. Several points in one range line can be fitted together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchsar.core import take
from torchsar.core.derivatives import is_differentiated
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import checked_channels
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import (
    TINY,
    UNKNOWNS,
    Found,
    centred_slopes,
    covariance_in,
    covariance_of,
    moved,
    noise_beside,
    phase_slopes,
    point_phasor,
    refuse_unknowns,
    solved,
)
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.optim import implicit
from torchsar.radar import BistaticRadar


@dataclass(frozen=True)
class PointFit:
    """Least-squares fit of the amplitude of a point for a given motion, per trial.

    Several points that are fitted together have amplitudes (..., point), and the unknowns of all
    of them follow each other.

    Args:
        amplitude: Complex amplitude, shape (...,).
        energy: Energy of the data that the point explains, shape (...,).
        gradient: Gradient of half the explained energy by the unknowns, shape (..., unknown).
        normal: Gauss-Newton normal matrix of half the explained energy, shape (..., unknown,
            unknown).
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
    """Find the motion of highest likelihood near a starting motion by Gauss-Newton steps.

    The start must be so near that its error in Doppler is below half a Doppler cell: |du_r + v dy0
    / R0| < lambda / (2 T) for an aperture of T seconds. Here du_r and dy0 are the errors of the
    start in slant-range speed and along-track position, R0 is the closest range, and v the
    along-track speed of the receiver relative to the point. `interferometry` and `bank_search` give
    such starts.

    The expected amplitude is computed once, for the start, so that the steps do not fit the
    position to the ends of the aperture. A step that does not explain more energy is halved or
    omitted, separately in each trial. A trial takes no further steps when a step would gain less
    than 1e-7 of the noise of a sample.

    Args:
        data: Channels with the transmit range removed and slow time zero at pulse n // 2, shape
            (..., channel, pulse), complex.
        radar: Radar parameters.
        start: Starting motion, shape (...,).
        aperture: Expected amplitude over slow time.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`; the others
            keep the values of the start.
        whitening: Clutter covariance, None for white noise.
        steps: Largest number of Gauss-Newton steps.

    Returns:
        The fit with motion, amplitude, residual noise power and covariance of the unknowns.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if `unknowns` holds other names or a name twice.
    """
    data = checked_channels(data, radar, "maximum_likelihood")
    problem = PointLikelihood.of(data, radar, start, aperture, unknowns, whitening)
    motion = start.each(lambda value: value.expand(data.shape[:-2]))
    with torch.no_grad():
        motion, fit = _climbed(problem.data, problem.fit, motion, unknowns, steps)
    if is_differentiated(problem, problem.whitening, motion):
        motion = problem.at_maximum(motion) if steps else motion
        fit = problem.fit(motion)
    return Found(motion, fit.amplitude, problem.noise_power(fit), problem.covariance(motion, fit), fit.energy, unknowns)


@dataclass(frozen=True)
class PointLikelihood:
    """Likelihood of the motion of one point: data and settings that do not change in a search.

    Args:
        data: Channels, shape (..., channel, pulse), complex128. With a clutter covariance, their
            whitened Doppler spectra, shape (..., channel, bin).
        radar: Radar parameters.
        weight: Expected amplitude, shape (..., 1, pulse).
        time_s: Slow time in seconds, float64 (pulse,).
        unknowns: Names of the parameters to estimate.
        whitening: Clutter covariance, None for white noise.
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
        """Build the likelihood from channels; arguments as in `maximum_likelihood`."""
        refuse_unknowns(unknowns)
        time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
        weight = aperture.weight(radar, start, time_s)[..., None, :]
        data = data.to(torch.complex128)
        return PointLikelihood(
            data if whitening is None else whitening.applied(data), radar, weight, time_s, unknowns, whitening
        )

    def fit(self, motion: PointMotion) -> PointFit:
        """Fit the amplitude for a motion by least squares, with derivatives with respect to the
        unknowns.
        """
        slopes = phase_slopes(self.radar, motion, self.time_s, self.unknowns)
        phasor = point_phasor(self.radar, motion, self.time_s, torch.complex128)
        if self.whitening is None:
            return _white(self.data * phasor.conj(), self.weight, slopes)
        model = self.weight * phasor
        tilted = self.time_s / self.time_s.abs().amax().clamp_min(TINY) * model
        applied = self.whitening.applied
        return _coloured(self.data, applied(model), applied(tilted), applied(1j * slopes * model[..., None, :, :]))

    def at_maximum(self, motion: PointMotion) -> PointMotion:
        """Return the motion of highest likelihood with its derivatives by data and settings."""

        def at(x: Tensor) -> PointMotion:
            return replace(motion, **dict(zip(self.unknowns, x.unbind(-1), strict=True)))

        found = torch.stack([getattr(motion, name) for name in self.unknowns], -1)
        return at(implicit(lambda x, *data: -self.fit(at(x)).energy, found, self, self.whitening, motion))

    def noise_power(self, fit: PointFit) -> Tensor:
        """Return the residual power per sample in the pulses in which the point is illuminated.

        With a clutter covariance, return the power per sample of the whitened residual, averaged
        over all samples.

        Args:
            fit: Fit of the point for one motion.

        Returns:
            Power, shape (...,).
        """
        power = self.data.abs().square()
        illuminated = (
            torch.ones_like(power)
            if self.whitening is not None
            else (self.weight != 0).expand(power.shape).to(power.dtype)
        )
        left = (power * illuminated).sum((-2, -1)) - fit.energy
        return left.clamp_min(0) / illuminated.sum((-2, -1)).clamp_min(1)

    def covariance(self, motion: PointMotion, fit: PointFit) -> Tensor:
        """Return the covariance of the unknowns, in the noise beside the point.

        With a clutter covariance, the noise is that of all samples.

        Args:
            motion: Fitted motion, shape (...,).
            fit: Fit of the point for this motion.

        Returns:
            Covariances, shape (..., unknown, unknown).
        """
        if self.whitening is not None:
            return covariance_of(fit.normal, self.noise_power(fit))
        deramped = self.data * point_phasor(self.radar, motion, self.time_s, torch.complex128).conj()
        amplitude = fit.amplitude[..., None, None]
        noise = noise_beside(deramped - amplitude * self.weight, self.weight, amplitude, 1 + len(self.unknowns))
        slopes = centred_slopes(phase_slopes(self.radar, motion, self.time_s, self.unknowns), self.weight)
        return covariance_in(noise, slopes, fit.amplitude)


def _white(deramped: Tensor, weight: Tensor, slopes: Tensor) -> PointFit:
    """Fit a point in white noise to deramped data, which are constant if the motion is correct."""
    total = weight.square().expand(deramped.shape).sum((-2, -1)).clamp_min(TINY)
    amplitude = (weight * deramped).sum((-2, -1)) / total
    centred = centred_slopes(slopes, weight)
    gradient = (centred * (amplitude.conj()[..., None, None] * deramped).imag[..., None, :, :]).sum((-2, -1))
    flat = centred.flatten(-2)
    return PointFit(
        amplitude,
        amplitude.abs().square() * total,
        gradient,
        amplitude.abs().square()[..., None, None] * (flat @ flat.mT),
    )


def _coloured(data: Tensor, model: Tensor, tilted: Tensor, columns: Tensor) -> PointFit:
    """Fit a point to whitened data, given the whitened model, model times slow time, and
    derivatives.

    In clutter, a displaced expected amplitude displaces the point. The amplitude may therefore grow
    linearly over slow time, by a real factor.
    """
    x, s, q, d = data.flatten(-2), model.flatten(-2), tilted.flatten(-2), columns.flatten(-2)
    total = s.abs().square().sum(-1).clamp_min(TINY)
    amplitude = (s.conj() * x).sum(-1) / total
    q = q - ((q * s.conj()).sum(-1) / total)[..., None] * s
    d = d - ((d * s.conj()[..., None, :]).sum(-1) / total[..., None])[..., None] * s[..., None, :]
    tilt = q.abs().square().sum(-1).clamp_min(TINY)
    d = d - ((d * q.conj()[..., None, :]).sum(-1).real / tilt[..., None])[..., None] * q[..., None, :]
    gradient = (amplitude.conj()[..., None] * (d.conj() * x[..., None, :]).sum(-1)).real
    normal = (d.conj()[..., :, None, :] * d[..., None, :, :]).sum(-1).real
    power = amplitude.abs().square()
    changed = (amplitude.conj() * (q.conj() * x).sum(-1)).real.square() / (power * tilt).clamp_min(TINY)
    return PointFit(amplitude, power * total + changed, gradient, power[..., None, None] * normal)


def _climbed(
    data: Tensor, fit_at: Callable[[PointMotion], PointFit], motion: PointMotion, unknowns: tuple[str, ...], steps: int
) -> tuple[PointMotion, PointFit]:
    """Take Gauss-Newton steps until none of the trials gains by a step.

    Args:
        data: Data to which one point, or several together, are fitted, (..., channel, pulse).
        fit_at: Fit for a motion, with the unknowns of all points in its gradient.
        motion: Starting motion, shape (...,), or (..., point) for several points.
        unknowns: Names of the parameters to estimate.
        steps: Largest number of steps.

    Returns:
        Motion after the steps, and the fit for it.
    """
    fit = fit_at(motion)
    total = data.abs().square().sum((-2, -1))
    # true where no part of the step gained energy
    stuck = torch.zeros_like(fit.energy, dtype=torch.bool)
    # steps between two decisions whether to stop, by choice
    every = 1 if data.device.type == "cpu" else 4
    for number in range(steps):
        step = solved(fit.normal, fit.gradient[..., None])[..., 0]
        noise = (total - fit.energy).clamp_min(0) / data.shape[-2:].numel()
        # no step is taken for a gain below that of 3e-4 standard deviations, or below rounding
        pending = ~stuck & ((step * fit.gradient).sum(-1) > 1e-7 * noise + 1e-13 * fit.energy)
        if number % every == 0 and not bool(pending.any()):
            break
        motion, fit, failed = _stepped(fit_at, motion, fit, unknowns, step, pending)
        stuck = stuck | failed
    return motion, fit


def _stepped(
    fit_at: Callable[[PointMotion], PointFit],
    motion: PointMotion,
    fit: PointFit,
    unknowns: tuple[str, ...],
    step: Tensor,
    pending: Tensor,
) -> tuple[PointMotion, PointFit, Tensor]:
    """Take a step in the pending trials, halved or omitted where it explains less energy.

    Also returns in which of these trials it was omitted.
    """
    begin, before = motion, fit.energy
    step = step.reshape(*motion.u_r_m_s.shape, len(unknowns))
    # a step changes the along-track speed past the point by at most a tenth
    if "u_a_m_s" in unknowns:
        along = step[..., unknowns.index("u_a_m_s")].abs().clamp_min(TINY)
        step = step * (0.1 * motion.along_m_s / along).clamp_max(1.0)[..., None]
    # the whole step, a half, a quarter or an eighth of it; otherwise it is omitted
    for halvings in range(4):
        there = moved(begin, 0.5**halvings * step, unknowns)
        fit_there = fit_at(there)
        better = pending & (fit_there.energy > before)

        def improved(new: Tensor, old: Tensor, better: Tensor = better) -> Tensor:
            return torch.where(better[(...,) + (None,) * (new.ndim - better.ndim)], new, old)

        values = {name: improved(getattr(there, name), getattr(motion, name)) for name in unknowns}
        motion = replace(motion, **values)
        fit = PointFit(*map(improved, vars(fit_there).values(), vars(fit).values()))
        pending = pending & ~better
        if pending.device.type == "cpu" and not bool(pending.any()):
            break
    return motion, fit, pending


def fitted_together(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, unknowns: tuple[str, ...]
) -> tuple[PointMotion, Found, Tensor, Tensor]:
    """Find the motions of several points of highest likelihood in white noise, near a start.

    Args:
        data: Channels with the transmit range removed and slow time zero at pulse n // 2, shape
            (..., channel, pulse), complex128.
        radar: Radar parameters.
        start: Starting motions, shape (..., point).
        aperture: Expected amplitude over slow time.
        unknowns: Names of the parameters to estimate; the others keep the values of the start.

    Returns:
        Motions, shape (..., point). Fit of the strongest point, with the noise power and the
        covariance in the noise of all samples, which contains the effect of the others. Echo of the
        others, and data without any point, shape (..., channel, pulse).
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, start, time_s)[..., None, :]
    fit_at = partial(_fit_of_points, data, radar, weight, time_s, unknowns)
    # 8 steps suffice for points whose powers differ by 10 dB, by trial
    motion, fit = _climbed(data, fit_at, start, unknowns, 8)
    echoes = fit.amplitude[..., None, None] * weight * point_phasor(radar, motion, time_s, torch.complex128)
    left = data - echoes.sum(-3)
    noise = left.abs().square().mean((-2, -1))
    pairs = (-1, len(unknowns))
    covariance = covariance_of(fit.normal, noise).unflatten(-1, pairs).unflatten(-3, pairs)
    # blocks of single points, (..., point, unknown, unknown)
    own = covariance.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)
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
    return motion, found, echoes.sum(-3) - take(echoes, first, -3), left


def _fit_of_points(
    data: Tensor, radar: BistaticRadar, weight: Tensor, time_s: Tensor, unknowns: tuple[str, ...], motion: PointMotion
) -> PointFit:
    """Fit the amplitudes of points with motions (..., point) and weights (..., point, 1, pulse)."""
    echo = weight * point_phasor(radar, motion, time_s, torch.complex128)
    x, s = data.flatten(-2), echo.flatten(-2)
    gram = s.conj() @ s.mT
    amplitude = solved(gram, s.conj() @ x[..., None])[..., 0]
    left = x - (amplitude[..., None, :] @ s)[..., 0, :]
    slopes = phase_slopes(radar, motion, time_s, unknowns)
    columns = (amplitude[..., None, None, None] * 1j * slopes * echo[..., None, :, :]).flatten(-2).flatten(-3, -2)
    # Each derivative loses the part that changed amplitudes could also explain. The gradient is
    # then that of the fit with the best amplitudes at every motion.
    columns = columns - solved(gram, s.conj() @ columns.mT).mT @ s
    return PointFit(
        amplitude,
        x.abs().square().sum(-1) - left.abs().square().sum(-1),
        (columns.conj() @ left[..., None])[..., 0].real,
        (columns.conj() @ columns.mT).real,
    )


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
    total = weight.square().expand(data.shape).sum((-2, -1)).clamp_min(TINY)
    return (weight * data.to(torch.complex128) * point_phasor(radar, motion, time_s, torch.complex128).conj()).sum(
        (-2, -1)
    ).abs().square() / total
