"""Model of the echo of one moving point in all channels, and least-squares tools for its fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, cholesky_factor, linear_solve, matrix_inverse, unit_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range

UNKNOWNS = ("u_r_m_s", "u_a_m_s", "y0_m")
# Detection threshold over all samples, -15 dB per sample with three channels and 810 pulses. Below
# it the strongest tone is often one of noise.
DETECTED_DB = 19.0
TINY = torch.finfo(torch.float64).tiny  # lowest divisor, against divisions by zero
_ROUNDING = 1e-13  # term added to the unit diagonal of normal matrices


def point_phasor(radar: BistaticRadar, motion: PointMotion, time_s: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the phase history exp(-j 2 pi / lambda (R_m(t) - R_ref)) of a point.

    R_m(t) is the range between the point and channel m, and R_ref the reference range of the radar.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        time_s: Slow time in seconds, float64 (pulse,).
        dtype: Complex dtype of the result.

    Returns:
        Phasor, shape (..., channel, pulse), complex.
    """
    u_r, u_a, y0, near = (
        value[..., None, None] for value in (motion.u_r_m_s, motion.u_a_m_s, motion.y0_m, motion.range_m)
    )
    path = receive_range(time_s, u_r, u_a, y0, near, radar.speed_m_s, radar.channels_at(time_s.device)[:, None]) + (
        near - radar.reference_range_m
    )
    return unit_phasor(-path / radar.wavelength_m, dtype)


def phase_slopes(
    radar: BistaticRadar, motion: PointMotion, time_s: Tensor, unknowns: tuple[str, ...] = UNKNOWNS
) -> Tensor:
    """Return the derivatives of the phase of `point_phasor` with respect to the unknowns.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        time_s: Slow time in seconds, float64 (pulse,).
        unknowns: Names among `u_r_m_s`, `u_a_m_s`, `y0_m`.

    Returns:
        Derivatives in radians per m/s or per metre, float64 (..., unknown, channel, pulse).
    """
    u_r, v, y0, near = (
        value[..., None, None] for value in (motion.u_r_m_s, motion.along_m_s, motion.y0_m, motion.range_m)
    )
    along = v * time_s - y0 - radar.channels_at(time_s.device)[:, None]
    across = near - u_r * time_s
    per_range = 2 * math.pi / radar.wavelength_m / torch.sqrt(along.square() + across.square())
    rows = {"u_r_m_s": time_s * across, "u_a_m_s": time_s * along, "y0_m": along}
    return torch.stack([torch.broadcast_to(rows[name], along.shape) * per_range for name in unknowns], -3)


def centred_slopes(slopes: Tensor, weight: Tensor) -> Tensor:
    """Return derivatives of the phase times the expected amplitude, without their weighted mean.

    The phase of the fitted amplitude takes up the mean.

    Args:
        slopes: Derivatives, float64 (..., unknown, channel, pulse).
        weight: Expected amplitude, shape (..., 1, pulse).

    Returns:
        Weighted derivatives, same shape as `slopes`.
    """
    power = weight.square()[..., None, :, :]
    total = slopes.shape[-2] * power.sum((-2, -1), keepdim=True).clamp_min(TINY)
    return weight[..., None, :, :] * (slopes - (power * slopes).sum((-2, -1), keepdim=True) / total)


@dataclass(frozen=True)
class Found:
    """Motion and amplitude fitted to the echo of one point, per trial.

    Args:
        motion: Motion, shape (...,).
        amplitude: Complex amplitude, shape (...,).
        noise_power: Residual power per sample, shape (...,).
        covariance: Covariance of the unknowns, shape (..., unknown, unknown).
        energy: Energy of the data that the point explains, shape (...,).
        unknowns: Names of the estimated parameters.
    """

    motion: PointMotion
    amplitude: Tensor
    noise_power: Tensor
    covariance: Tensor
    energy: Tensor
    unknowns: tuple[str, ...]

    def each(self, change: Callable[..., Tensor], *others: Found) -> Found:
        """Return the fit with a function applied to all tensors, followed by those of `others`."""
        motion = self.motion.each(change, *(fit.motion for fit in others))
        names = ("amplitude", "noise_power", "covariance", "energy")
        return Found(
            motion, *(change(*(getattr(fit, n) for fit in (self, *others))) for n in names), unknowns=self.unknowns
        )

    @property
    def snr_db(self) -> Tensor:
        """SNR of the point over all its samples in dB, -300 dB for zeros, limited to +-300 dB."""
        ratio = self.energy / self.noise_power.clamp_min(TINY)
        return 10 * torch.log10(ratio.clamp(1e-30, 1e30))


def covariance_of(normal: Tensor, noise_power: Tensor) -> Tensor:
    """Return the covariance of the unknowns of a fit.

    Args:
        normal: Normal matrices of half the explained energy, shape (..., n, n).
        noise_power: Noise power per sample, shape (...,).

    Returns:
        Covariances, shape (..., n, n), infinite for unknowns that the data do not determine.
    """
    undetermined = torch.diag_embed((normal.diagonal(dim1=-2, dim2=-1) <= 0).to(normal.dtype)) > 0
    eye = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    return torch.where(
        undetermined, torch.inf, noise_power[..., None, None] / 2 * solved(normal, eye.expand(normal.shape))
    )


def noise_beside(left: Tensor, weight: Tensor, amplitude: Tensor, fitted: int, cells: int = 16) -> Tensor:
    """Return the covariance across channels of the noise at the Doppler frequencies of a point.

    It is taken from what the fit leaves over within sixteen Doppler cells of the point, in
    quadrature to it. Targets and clutter at other Doppler frequencies, and differences from the
    expected amplitude, do not act on the phase of the point and are excluded. Fewer samples than
    channels do not show how the noise is shared; it is taken as independent and equal then.

    Args:
        left: Deramped data without the fitted point, shape (..., channel, pulse), complex.
        weight: Expected amplitude, shape (..., 1, pulse).
        amplitude: Fitted amplitude, shape (..., 1, 1) or (..., channel, 1), complex.
        fitted: Number of real unknowns of the phase.
        cells: Doppler cells on either side; with 16, standard deviations scatter by 12 %.

    Returns:
        Covariance per sample, float64 (..., channel, channel).
    """
    n = left.shape[-1]
    energy = weight.square().sum((-2, -1))
    # width of a bin of the FFT in Doppler cells
    per_bin = energy.square() / weight.square().square().sum((-2, -1)).clamp_min(TINY) / n
    inside = torch.fft.fftfreq(n, 1 / n, dtype=torch.float64, device=left.device).abs() * per_bin[..., None] <= cells
    turned = (left * torch.polar(torch.ones_like(amplitude.abs()), -amplitude.angle())).imag
    spectrum = torch.fft.fft(weight * turned) * inside[..., None, :]
    samples = inside.sum(-1) * energy / n - fitted / left.shape[-2]
    found = 2 * (spectrum @ spectrum.mH).real / (n * samples.clamp_min(1.0))[..., None, None]
    channels = left.shape[-2]
    equal = found.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(
        channels, dtype=found.dtype, device=found.device
    )
    return torch.where((samples < channels)[..., None, None], equal, found)


def covariance_in(noise: Tensor, slopes: Tensor, amplitude: Tensor) -> Tensor:
    """Return the covariance of the unknowns of a least-squares fit in noise that channels share.

    Args:
        noise: Covariance of the noise across channels, float64 (..., channel, channel).
        slopes: Derivatives of the phase times the expected amplitude, without their part that the
            fit of the amplitude removes, shape (..., unknown, channel, pulse).
        amplitude: Fitted amplitude, shape (...,), complex.

    Returns:
        Covariances, shape (..., unknown, unknown), infinite for unknowns that the data do not
        determine.
    """
    power = amplitude.abs().square()[..., None, None]
    flat = slopes.flatten(-2)
    unit, scale = _of_unit_diagonal(power * (flat @ flat.mT))
    spread = power / 2 * (flat @ (noise[..., None, :, :] @ slopes).flatten(-2).mT)
    # where unknowns cannot be separated, rounding must not make their standard deviation small
    level = noise.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] / 2
    spread = scale[..., :, None] * spread * scale[..., None, :] + _ROUNDING * level * torch.eye(
        unit.shape[-1], dtype=unit.dtype, device=unit.device
    )
    inverse = scale[..., :, None] * matrix_inverse(unit)
    undetermined = torch.diag_embed((flat.square().sum(-1) * power[..., 0] <= 0).to(unit.dtype)) > 0
    return torch.where(undetermined, torch.inf, inverse @ spread @ inverse.mT)


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Solve the normal equations normal x = right of a least-squares fit.

    A small diagonal term keeps the solution finite where unknowns can hardly be separated. An
    unknown with a zero diagonal, which the data do not determine, gets its right-hand side as
    solution.

    Args:
        normal: Normal matrices, shape (..., n, n).
        right: Right-hand sides, shape (..., n, k).

    Returns:
        Solutions, shape (..., n, k).
    """
    unit, scale = _of_unit_diagonal(normal)
    return scale[..., :, None] * linear_solve(unit, scale[..., :, None] * right)


def round_units(normal: Tensor) -> Tensor:
    """Return coordinates in which the explained energy falls off equally in all directions.

    The coordinates x are related to the unknowns by a matrix U: a step x changes the unknowns by U
    x. With the normal matrix N, U^T N U is a multiple of the identity.

    Args:
        normal: Normal matrices N of the fit, shape (..., n, n).

    Returns:
        Matrices U, shape (..., n, n), of Frobenius norm 1.
    """
    unit, scale = _of_unit_diagonal(normal)
    units = scale[..., :, None] * matrix_inverse(cholesky_factor(unit)).mT
    return units / torch.linalg.matrix_norm(units, keepdim=True)


def _of_unit_diagonal(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Return matrices scaled to unit diagonal, plus a small diagonal term, and the scale (..., n)
    on either side.
    """
    diagonal = normal.diagonal(dim1=-2, dim2=-1).real
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    unit = normal * scale[..., :, None] * scale[..., None, :] + torch.diag_embed((diagonal <= 0).to(normal.dtype))
    return unit + _ROUNDING * torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device), scale


def refuse_unknowns(unknowns: tuple[str, ...]) -> None:
    """Raise ValueError unless there are names, among `u_r_m_s`, `u_a_m_s` and `y0_m`, each once.

    Args:
        unknowns: Names of the parameters to estimate.
    """
    if not unknowns or len(set(unknowns)) != len(unknowns) or not set(unknowns) <= set(UNKNOWNS):
        raise ValueError(f"unknowns must be names among {UNKNOWNS}, each once, got {tuple(unknowns)}")


def moved(motion: PointMotion, step: Tensor, unknowns: tuple[str, ...]) -> PointMotion:
    """Return a motion with a step added to some of its parameters.

    Args:
        motion: Motion with parameters of shape (...,).
        step: Steps in the units of the unknowns, shape (..., unknown).
        unknowns: Names of these parameters, in the order of the steps.

    Returns:
        Motion after the step.
    """
    return replace(motion, **{name: getattr(motion, name) + step[..., i] for i, name in enumerate(unknowns)})


def chosen(motion: PointMotion, other: PointMotion, first: Tensor) -> PointMotion:
    """Select one of two motions per trial: `motion` where first (...,) is True, else `other`.

    Args:
        motion: First motion, parameters of shape (...,).
        other: Second motion, same shape.
        first: True where the first motion is taken, shape (...,), bool.

    Returns:
        Motion with parameters of shape (...,).
    """
    return motion.each(lambda mine, others: torch.where(first, mine, others), other)


def estimate_of(found: Found, outcome: Tensor | None = None, info: Mapping[str, Tensor] | None = None) -> Estimate:
    """Form an estimate of u_r_m_s, u_a_m_s and y0_m from a fit.

    Args:
        found: Fit of the point.
        outcome: Codes of the outcome, int64 (...,), None for a fit that was not assessed.
        info: Further tensors by name, added to `info` of the estimate.

    Returns:
        The estimate, with standard deviations of the unknowns of the fit. Its quality is one half
        at an SNR of 19 dB over all samples.
    """
    snr_db = found.snr_db
    value = {name: getattr(found.motion, name).expand(snr_db.shape) for name in UNKNOWNS}
    std_all = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    std = {name: std_all[..., i] for i, name in enumerate(found.unknowns)}
    root, wrong = torch.linalg.cholesky_ex(found.covariance)
    root = torch.where((wrong == 0)[..., None, None], root, torch.diag_embed(std_all))
    factor = dict(zip(found.unknowns, root.unbind(-2), strict=True))
    info = {"snr_db": snr_db, "noise_power": found.noise_power, **(info or {})}
    if outcome is None:
        return Estimate(value, std, outcome=Outcome.NOT_ASSESSED.like(snr_db), info=info, factor=factor)
    return Estimate(value, std, quality_of(snr_db), outcome, info, factor=factor)


def quality_of(snr_db: Tensor) -> Tensor:
    """Map the SNR over all samples to a quality of 0 to 1, one half at the detection threshold.

    Args:
        snr_db: SNR in dB, any shape.

    Returns:
        Quality, same shape.
    """
    return ((snr_db - DETECTED_DB) / 3).sigmoid()
