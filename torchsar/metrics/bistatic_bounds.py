"""What no estimator of a moving point can beat: bounds of its velocities and place in the data of a
receiver with channels along track (brief 001, Velocity).

snr is everywhere the power of the point over the noise variance, of one range-compressed sample of
one channel where the gate is one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial, unit_phasor
from torchsar.radar import BistaticRadar, receive_range

UNKNOWNS = ("u_r_m_s", "u_a_m_s", "y0_m")
_SINGULAR = 1e-13  # eigenvalues of a correlation matrix below it are rounding
_TOUCHED = 1e-12  # squared share of an unknown in a direction that nothing is known about

Value = Tensor | float


def radial_velocity_bound_m_s(radar: BistaticRadar, snr: Value, n_seen: Value, u_a_m_s: Value = 0.0) -> Tensor:
    """Bound of u_r (m/s) with u_a, y0 and amplitude unknown, in closed form: v lambda / (2 pi
    sqrt(2 Ns snr sum (dx_m - mean dx)^2)), float64.

    n_seen: pulses Ns with the point in the gate. Three channels d apart give v lambda / (4 pi d
    sqrt(Ns snr)). It is what the look angle between the channels tells; the curvature of the
    Doppler history, which `bistatic_bounds` includes, adds almost nothing. Infinite for a single
    channel.
    """
    places = radar.channels_at()
    spread = (places - places.mean()).square().sum()
    speed = radar.speed_m_s - torch.as_tensor(u_a_m_s, dtype=torch.float64)
    energy = torch.as_tensor(n_seen, dtype=torch.float64) * torch.as_tensor(snr, dtype=torch.float64)
    return speed * radar.wavelength_m / (2 * math.pi * torch.sqrt(2 * energy * spread))


def bistatic_bounds(
    radar: BistaticRadar,
    n_pulse: int,
    snr: Value,
    u_r_m_s: Value = 0.0,
    u_a_m_s: Value = 0.0,
    y0_m: Value = 0.0,
    range_m: Value | None = None,
    *,
    integration_s: float | None = None,
    unknown: Sequence[str] = UNKNOWNS,
    gate_tells: bool = False,
    covariance: Tensor | None = None,
) -> dict[str, Tensor]:
    """Least standard deviations of the unknowns among u_r_m_s, u_a_m_s and y0_m (m/s, m), float64
    (...,) each, infinite where the data tell nothing.

    Samples are a w exp(-j 2 pi / lambda R_m(t)) of n_pulse pulses and all channels, transmit range
    removed, complex amplitude a unknown, R0 and the noise known. Values broadcast over trials.
    integration_s: length of a rectangular gate |t - y0/v| < T/2; None for the one-way pattern of
    the radar's elements. unknown: the others are known. With u_a and y0 known, u_r is a mere
    frequency and its bound means little for an estimator that must find them. gate_tells: count
    what the slopes of the pattern tell about where the point is; by default only phases count.
    covariance: of noise and clutter across channels in each bin, FFT order, of the unitary FFT over
    the pulses, (..., n_pulse, channel, channel), where white noise of unit variance is the
    identity. Information 2 snr Re(D^H C^-1 D) with the amplitude projected out; at 0 dB, PRF 180
    Hz, T 4.5 s and three channels 0.8 m apart 0.251 m/s, with u_a known 0.148, with y0 known too
    0.00042. Raises ValueError for names that are no unknowns, a rectangular gate that is to tell,
    and shapes that do not fit.
    """
    _refuse(radar, n_pulse, unknown, integration_s, gate_tells, covariance)
    like = next((x for x in (u_r_m_s, u_a_m_s, y0_m, snr, covariance) if isinstance(x, Tensor)), torch.zeros(()))
    values = [
        per_trial(x, 2, like) for x in (u_r_m_s, u_a_m_s, y0_m, radar.reference_range_m if range_m is None else range_m)
    ]
    seen = _Seen.of(radar, radar.pulse_axis(n_pulse).values(like.device), *values)
    weight, slopes = (
        (seen.pattern(), seen.pattern_slopes()) if integration_s is None else (seen.rectangle(integration_s), None)
    )
    turned = -2 * math.pi / radar.wavelength_m * weight[..., None] * seen.range_slopes()
    columns = torch.complex(
        slopes.expand_as(turned) if gate_tells and slopes is not None else torch.zeros_like(turned), turned
    )
    columns = columns[..., [UNKNOWNS.index(name) for name in unknown]]
    samples = torch.cat([weight[..., None].to(columns.dtype).expand(*columns.shape[:-1], 1), columns], -1)
    if covariance is not None:
        samples = _whitened(samples * seen.phasor()[..., None], covariance)
    bounds = _deviations(_information(samples.flatten(-3, -2))) / per_trial(snr, 1, like).sqrt()
    return dict(zip(unknown, bounds.unbind(-1), strict=True))


@dataclass(frozen=True)
class _Seen:
    """A point over channels and pulses: (..., channel, pulse), values with two unit dims behind the
    trials.
    """

    radar: BistaticRadar
    time_s: Tensor
    speed_m_s: Tensor
    y0_m: Tensor
    closing_m: Tensor
    along_m: Tensor
    excess_m: Tensor
    path_m: Tensor

    @staticmethod
    def of(radar: BistaticRadar, time_s: Tensor, u_r: Tensor, u_a: Tensor, y0: Tensor, range_m: Tensor) -> _Seen:
        dx, speed = radar.channels_at(time_s.device)[:, None], radar.speed_m_s - u_a
        excess = receive_range(time_s, u_r, u_a, y0, range_m, radar.speed_m_s, dx)
        return _Seen(
            radar, time_s, speed, y0, range_m - u_r * time_s, speed * time_s - y0 - dx, excess, excess + range_m
        )

    def range_slopes(self) -> Tensor:
        """dR_m / d(u_r, u_a, y0), (..., channel, pulse, 3)."""
        sine = self.along_m / self.path_m
        return torch.stack([-self.closing_m * self.time_s / self.path_m, -sine * self.time_s, -sine], -1)

    def phasor(self) -> Tensor:
        return unit_phasor(-self.excess_m / self.radar.wavelength_m, torch.complex128)

    def rectangle(self, integration_s: float) -> Tensor:
        inside = (self.time_s - self.y0_m / self.speed_m_s).abs() < integration_s / 2
        return inside.to(torch.float64).expand(self.along_m.shape)

    def pattern(self) -> Tensor:
        return torch.sinc(self._offset())

    def pattern_slopes(self) -> Tensor:
        """dw / d(u_r, u_a, y0), (..., channel, pulse, 3)."""
        x = self._offset()[..., None]
        near = x.abs() < 1e-4
        safe = torch.where(near, 1.0, x)
        slope = torch.where(near, -(math.pi**2) / 3 * x, (torch.cos(math.pi * safe) - torch.sinc(safe)) / safe)
        path = self.path_m[..., None]
        moved = torch.stack(
            torch.broadcast_tensors(torch.zeros_like(self.along_m), -self.time_s, -torch.ones_like(self.along_m)), -1
        )
        return (
            slope
            * self.radar.element_m
            / self.radar.wavelength_m
            * (moved - self.along_m[..., None] / path * self.range_slopes())
            / path
        )

    def _offset(self) -> Tensor:
        return self.radar.element_m / self.radar.wavelength_m * self.along_m / self.path_m


def _whitened(samples: Tensor, covariance: Tensor) -> Tensor:
    """C^-1/2 over the channels of each Doppler bin of (..., channel, pulse, column); bins take the
    place of pulses.
    """
    spectra = torch.fft.fft(samples, dim=-2, norm="ortho").movedim(-3, -2)
    root = torch.linalg.cholesky(covariance.to(spectra.dtype))
    return torch.linalg.solve_triangular(root, spectra, upper=False)


def _information(samples: Tensor) -> Tensor:
    """2 Re(D^H D) (..., unknown, unknown) of the columns (..., sample, 1 + unknown) after the
    first, their part along the first taken out.
    """
    point, columns = samples[..., :1], samples[..., 1:]
    energy = point.abs().square().sum(-2, keepdim=True)
    unit = point * torch.where(energy > 0, energy, 1).rsqrt()
    for _ in range(2):  # a second pass takes out what rounding leaves
        columns = columns - unit * (unit.conj() * columns).sum(-2, keepdim=True)
    return 2 * (columns.mH @ columns).real


def _deviations(information: Tensor) -> Tensor:
    """Square roots of the diagonal of the inverse (..., n, n) -> (..., n), infinite for unknowns
    that a direction without information takes part in.
    """
    size = information.diagonal(dim1=-2, dim2=-1)
    root = torch.where(size > 0, size, 1).rsqrt()
    value, vector = torch.linalg.eigh(information * root[..., :, None] * root[..., None, :])
    blind, share = (value < _SINGULAR)[..., None, :], vector.square()
    variance = torch.where(blind, 0.0, share / torch.where(blind, 1.0, value[..., None, :])).sum(-1)
    return torch.where((share * blind).sum(-1) > _TOUCHED, torch.inf, variance.sqrt() * root)


def _refuse(
    radar: BistaticRadar,
    n_pulse: int,
    unknown: Sequence[str],
    integration_s: float | None,
    gate_tells: bool,
    covariance: Tensor | None,
) -> None:
    if not unknown or len(set(unknown)) != len(unknown) or not set(unknown) <= set(UNKNOWNS):
        raise ValueError(f"bistatic_bounds: unknown names some of {UNKNOWNS}, each once, got {tuple(unknown)}")
    if integration_s is not None and not integration_s > 0:
        raise ValueError(
            "bistatic_bounds: integration_s must be positive, or None for the pattern of the "
            f"elements, got {integration_s}"
        )
    if integration_s is not None and gate_tells:
        raise ValueError(
            "bistatic_bounds: the edges of a rectangular gate have no Cramer-Rao bound; leave "
            "gate_tells out, or use the pattern (integration_s=None)"
        )
    expected = (n_pulse, radar.channels, radar.channels)
    if covariance is not None and tuple(covariance.shape[-3:]) != expected:
        raise ValueError(
            f"bistatic_bounds: covariance is (..., n_pulse, channel, channel), here {expected}, "
            f"got the shape {tuple(covariance.shape)}"
        )
