"""The echo of one moving point in all channels as a model with unknown velocity and place, and data
with its phase taken out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Estimate, unit_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar, receive_range

UNKNOWNS = ("u_r_m_s", "u_a_m_s", "y0_m")


def point_phasor(radar: BistaticRadar, motion: PointMotion, time_s: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(-j 2 pi / lambda (R_m(t) - R_ref)) of a point of this motion, (..., channel, pulse) of
    `dtype`; R_ref: the radar's reference range.
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
    """Derivatives of the phase of `point_phasor` by the unknowns (rad per unit), float64 (...,
    unknown, channel, pulse).
    """
    u_r, v, y0, near = (
        value[..., None, None] for value in (motion.u_r_m_s, motion.along_m_s, motion.y0_m, motion.range_m)
    )
    along = v * time_s - y0 - radar.channels_at(time_s.device)[:, None]
    across = near - u_r * time_s
    per_range = 2 * math.pi / radar.wavelength_m / torch.sqrt(along.square() + across.square())
    rows = {"u_r_m_s": time_s * across, "u_a_m_s": time_s * along, "y0_m": along}
    return torch.stack([torch.broadcast_to(rows[name], along.shape) * per_range for name in unknowns], -3)


@dataclass(frozen=True)
class Found:
    """A fitted point per trial: its motion, complex amplitude (...,), the power per sample that it
    leaves unexplained, and covariance of the unknowns.
    """

    motion: PointMotion
    amplitude: Tensor
    noise_power: Tensor
    covariance: Tensor
    energy: Tensor
    unknowns: tuple[str, ...]

    @property
    def snr_db(self) -> Tensor:
        """Of the point over all its samples together, within +-300 dB: what decides whether it was
        found at all.
        """
        return energy_ratio_db(self.energy, self.noise_power)


def energy_ratio_db(energy: Tensor, noise_power: Tensor) -> Tensor:
    """In dB, within +-300 dB; -300 dB where there is neither."""
    return 10 * torch.log10((energy / noise_power.clamp_min(torch.finfo(torch.float64).tiny)).clamp(1e-30, 1e30))


def covariance_of(normal: Tensor, noise_power: Tensor) -> Tensor:
    """Of the unknowns of a fit with normal matrices (..., n, n) of half the explained energy,
    variances infinite where data say nothing.
    """
    silent = torch.diag_embed((normal.diagonal(dim1=-2, dim2=-1) <= 0).to(normal.dtype)) > 0
    eye = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    return torch.where(silent, torch.inf, noise_power[..., None, None] / 2 * solved(normal, eye.expand(normal.shape)))


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """normal^-1 right (..., n, k), with a floor for unknowns that data hardly tell apart; those
    that they say nothing about keep what is on the right.
    """
    unit, scale = _of_unit_diagonal(normal)
    return scale[..., :, None] * torch.linalg.solve(unit, scale[..., :, None] * right)


def round_units(normal: Tensor) -> Tensor:
    """Combinations (..., unknown, n) of the unknowns in which the explained energy falls off alike
    in all directions.
    """
    unit, scale = _of_unit_diagonal(normal)
    units = scale[..., :, None] * torch.linalg.inv(torch.linalg.cholesky(unit)).mT
    return units / torch.linalg.matrix_norm(units, keepdim=True)


def _of_unit_diagonal(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices with a unit diagonal and a floor, and the scale (..., n) on either side that makes
    them.
    """
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    unit = normal * scale[..., :, None] * scale[..., None, :] + torch.diag_embed((diagonal <= 0).to(normal.dtype))
    return unit + 1e-13 * torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device), scale


def refuse_unknowns(unknowns: tuple[str, ...]) -> None:
    """Raise ValueError unless these are some of UNKNOWNS, each once."""
    if not unknowns or len(set(unknowns)) != len(unknowns) or not set(unknowns) <= set(UNKNOWNS):
        raise ValueError(f"unknowns names some of {UNKNOWNS}, each once, got {tuple(unknowns)}")


def moved(motion: PointMotion, step: Tensor, unknowns: tuple[str, ...]) -> PointMotion:
    """The motion with `step` (..., unknown) added."""
    return replace(motion, **{name: getattr(motion, name) + step[..., i] for i, name in enumerate(unknowns)})


def chosen(motion: PointMotion, other: PointMotion, first: Tensor) -> PointMotion:
    """Per trial the one or the other: `motion` where first (...,) is True."""
    pairs = {
        name: torch.where(first, getattr(motion, name), getattr(other, name))
        for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
    }
    return PointMotion(**pairs, speed_m_s=motion.speed_m_s)


def estimate_of(found: Found, ok: Tensor, quality: Tensor, **info: Tensor) -> Estimate:
    """An Estimate of u_r_m_s, u_a_m_s and y0_m, with predicted deviations of those that were
    estimated.
    """
    motion = found.motion
    shape = ok.shape
    value = {name: getattr(motion, name).expand(shape) for name in UNKNOWNS}
    deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    std = {name: deviation[..., i] for i, name in enumerate(found.unknowns)}
    return Estimate(value, quality, ok, std, {"snr_db": found.snr_db, "noise_power": found.noise_power, **info})
