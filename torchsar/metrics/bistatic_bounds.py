"""Cramer-Rao bounds of a moving point seen by a receiver with several channels along track.

`snr` is the power ratio of the point to the noise in one range-compressed sample of one channel, at
the maximum of the antenna pattern.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial, refuse_non_finite, unit_phasor
from torchsar.metrics.bounds import nonnegative, range_of_point
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range

# slant-range speed towards the receiver, along-track speed, and along-track position at t = 0
UNKNOWNS = ("u_r_m_s", "u_a_m_s", "y0_m")
# eigenvalues of a correlation matrix below this are float64 rounding errors and count as zero
_SINGULAR = 1e-13
# If the square of an unknown's component in an unobservable direction exceeds this limit of float64
# rounding, its bound is infinite.
_INVOLVED = 1e-12

Value = Tensor | float


def bistatic_bounds(
    radar: BistaticRadar,
    n_pulse: int,
    snr: Value,
    u_r_m_s: Value = 0.0,
    u_a_m_s: Value = 0.0,
    y0_m: Value = 0.0,
    range_m: Value | None = None,
    *,
    integration_s: Value | None = None,
    unknown: Sequence[str] = UNKNOWNS,
    gate_tells: bool = False,
    covariance: Tensor | None = None,
) -> dict[str, Tensor]:
    """Compute the least standard deviations of the velocities and the position of a moving point.

    >>> from torchsar import metrics, radar
    >>> pulse = radar.LinearFM(bandwidth_hz=50e6, duration_s=1e-6)
    >>> receiver = radar.BistaticRadar(5e9, pulse, 60e6, 180.0, 300.0, 6500.0)
    >>> bounds = metrics.bistatic_bounds(receiver, n_pulse=400, snr=1.0, integration_s=2.0)
    >>> {name: float(f"{float(std):.2g}") for name, std in bounds.items()}
    {'u_r_m_s': 0.094, 'u_a_m_s': 0.015, 'y0_m': 2.0}

    The samples are a w exp(-j 2 pi / lambda R_m(t)) over `n_pulse` pulses and all channels. R_m is
    the range from the point to channel m, and w the antenna pattern or a rectangular gate; the
    transmit range has been removed from the phase. The complex amplitude a is unknown. The range of
    the point across the track and the noise are known.

    The Fisher information is 2 snr Re(D^H C^-1 D). The columns of D are the derivatives of the
    samples with respect to the unknowns. Their components along the samples themselves are removed,
    because a is unknown. C is the covariance of noise and clutter.

    At 0 dB, PRF 180 Hz, 4.5 s and three channels 0.8 m apart the bound of u_r is 0.251 m/s; with
    u_a known 0.148 m/s; with y0 known too 0.00042 m/s. In the last case u_r follows from the
    Doppler frequency alone, and the bound says little about an estimator that must find u_a and y0
    as well.

    Args:
        radar: Radar with the positions of the channels along track.
        n_pulse: Number of pulses.
        snr: Power ratio of the point to the noise per sample.
        u_r_m_s: Slant-range speed u_r of the point in m/s, closing positive.
        u_a_m_s: Along-track speed u_a of the point in m/s.
        y0_m: Along-track position y0 of the point at t = 0 in metres.
        range_m: Range from the track to the position of the point at t = 0, across the track, in
            metres; None for the reference range of the radar.
        integration_s: Length T in seconds of a rectangular gate |t - y0/v| < T/2 in which the point
            is illuminated, a number or shape (...,); None for the one-way pattern of the radar's
            elements.
        unknown: Names of the unknowns among "u_r_m_s", "u_a_m_s" and "y0_m"; the others are known.
        gate_tells: Whether to include what the slopes of the antenna pattern reveal about the
            position; by default only phases are used.
        covariance: Covariance of noise and clutter across the channels, shape (..., n_pulse,
            channel, channel), for each bin of the unitary FFT over the pulses in FFT order, in
            units of the noise power of `snr`; None for white noise.

    Returns:
        Bounds of the unknowns by name in m/s and m, shape (...,) each, float64; infinite for
        unknowns that the data do not determine.

    Raises:
        ValueError: If `unknown` has other names, `gate_tells` is set with a rectangular gate,
            `range_m` is not positive and finite, or `covariance` has another shape.
    """
    _check(radar, n_pulse, unknown, integration_s, gate_tells, covariance)
    like = next((x for x in (u_r_m_s, u_a_m_s, y0_m, snr, covariance) if isinstance(x, Tensor)), torch.zeros(()))
    values = [per_trial(x, 2, like) for x in (u_r_m_s, u_a_m_s, y0_m, range_of_point(radar, range_m))]
    point = _MovingPoint.of(radar, radar.pulse_axis(n_pulse).values(like.device), *values)
    weight, slopes = (
        (point.pattern(), point.pattern_slopes())
        if integration_s is None
        else (point.rectangle(per_trial(integration_s, 2, like)), None)
    )
    turned = -2 * math.pi / radar.wavelength_m * weight[..., None] * point.range_slopes()
    columns = torch.complex(
        slopes.expand_as(turned) if gate_tells and slopes is not None else torch.zeros_like(turned), turned
    )
    columns = columns[..., [UNKNOWNS.index(name) for name in unknown]]
    samples = torch.cat([weight[..., None].to(columns.dtype).expand(*columns.shape[:-1], 1), columns], -1)
    if covariance is not None:
        samples = _whitened(samples * point.phasor()[..., None], covariance)
    bounds = _standard_deviations(_information(samples.flatten(-3, -2))) / per_trial(nonnegative(snr), 1, like).sqrt()
    return dict(zip(unknown, bounds.unbind(-1), strict=True))


@dataclass(frozen=True)
class _MovingPoint:
    """Geometry of a moving point for all channels and pulses, (..., channel, pulse).

    The values of the point have two dimensions of length one after the trial dimensions.
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
    def of(radar: BistaticRadar, time_s: Tensor, u_r: Tensor, u_a: Tensor, y0: Tensor, range_m: Tensor) -> _MovingPoint:
        """Compute the range history of a point with the given velocities, position and range."""
        dx, speed = radar.channels_at(time_s.device)[:, None], radar.speed_m_s - u_a
        excess = receive_range(time_s, u_r, u_a, y0, range_m, radar.speed_m_s, dx)
        return _MovingPoint(
            radar, time_s, speed, y0, range_m - u_r * time_s, speed * time_s - y0 - dx, excess, excess + range_m
        )

    def range_slopes(self) -> Tensor:
        """Derivatives of the range R_m of each channel with respect to u_r, u_a and y0, (...,
        channel, pulse, 3).
        """
        sine = self.along_m / self.path_m
        return torch.stack([-self.closing_m * self.time_s / self.path_m, -sine * self.time_s, -sine], -1)

    def phasor(self) -> Tensor:
        """Phasors exp(-j 2 pi (R_m - R0) / lambda) of the point, complex128."""
        return unit_phasor(-self.excess_m / self.radar.wavelength_m, torch.complex128)

    def rectangle(self, integration_s: Tensor) -> Tensor:
        """Rectangular gate: 1 within the integration time, and 0 outside."""
        inside = (self.time_s - self.y0_m / self.speed_m_s).abs() < integration_s / 2
        return inside.to(torch.float64).expand(self.along_m.shape)

    def pattern(self) -> Tensor:
        """One-way amplitude pattern of a receive element."""
        return torch.sinc(self._offset())

    def pattern_slopes(self) -> Tensor:
        """Derivatives of the antenna pattern with respect to the velocities u_r and u_a and the
        position y0 of the point, (..., channel, pulse, 3).
        """
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
        """Argument of the sinc function of the antenna pattern."""
        return self.radar.element_m / self.radar.wavelength_m * self.along_m / self.path_m


def _whitened(samples: Tensor, covariance: Tensor) -> Tensor:
    """Whiten (..., channel, pulse, column) over the channels in each Doppler bin.

    The samples are transformed to Doppler bins and multiplied by L^-1, where L is the Cholesky
    factor of the covariance of a bin.
    """
    spectra = torch.fft.fft(samples, dim=-2, norm="ortho").movedim(-3, -2)
    root = torch.linalg.cholesky(covariance.to(spectra))
    return torch.linalg.solve_triangular(root, spectra, upper=False)


def _information(samples: Tensor) -> Tensor:
    """Fisher information 2 Re(D^H D) of the unknowns, (..., unknown, unknown).

    The first of the columns (..., sample, 1 + unknown) is the echo of the point. D is the other
    columns after removal of their components along the first.
    """
    point, columns = samples[..., :1], samples[..., 1:]
    energy = point.abs().square().sum(-2, keepdim=True)
    unit = point * torch.where(energy > 0, energy, 1).rsqrt()
    for _ in range(2):  # the second pass removes rounding errors of the first
        columns = columns - unit * (unit.conj() * columns).sum(-2, keepdim=True)
    return 2 * (columns.mH @ columns).real


def _standard_deviations(information: Tensor) -> Tensor:
    """Standard deviations from Fisher information (..., n, n): roots of the diagonal of its
    inverse, (..., n).

    They are infinite for unknowns with a component in an unobservable direction.
    """
    refuse_non_finite(
        information,
        "bistatic_bounds: the Fisher information",
        "give finite parameters of a possible instrument",
        "elements",
    )
    size = information.diagonal(dim1=-2, dim2=-1)
    root = torch.where(size > 0, size, 1).rsqrt()
    value, vector = torch.linalg.eigh(information * root[..., :, None] * root[..., None, :])
    unobservable, share = (value < _SINGULAR)[..., None, :], vector.square()
    variance = torch.where(unobservable, 0.0, share / torch.where(unobservable, 1.0, value[..., None, :])).sum(-1)
    return torch.where((share * unobservable).sum(-1) > _INVOLVED, torch.inf, variance.sqrt() * root)


def _check(
    radar: BistaticRadar,
    n_pulse: int,
    unknown: Sequence[str],
    integration_s: Value | None,
    gate_tells: bool,
    covariance: Tensor | None,
) -> None:
    """Raise ValueError for arguments that contradict each other."""
    if not unknown or len(set(unknown)) != len(unknown) or not set(unknown) <= set(UNKNOWNS):
        raise ValueError(
            f"bistatic_bounds: unknown must name some of {UNKNOWNS}, each at most once, got {tuple(unknown)}"
        )
    if integration_s is not None and not bool((torch.as_tensor(integration_s) > 0).all()):
        raise ValueError(
            "bistatic_bounds: integration_s must be positive, or None for the pattern of the "
            f"elements, got {integration_s}"
        )
    if integration_s is not None and gate_tells:
        raise ValueError(
            "bistatic_bounds: gate_tells needs the antenna pattern (integration_s=None), since there is no "
            "Cramer-Rao bound for the edges of a rectangular gate; leave out one of the two arguments"
        )
    expected = (n_pulse, radar.channels, radar.channels)
    if covariance is not None and tuple(covariance.shape[-3:]) != expected:
        raise ValueError(
            f"bistatic_bounds: covariance must have the shape (..., n_pulse, channel, channel), here {expected}, "
            f"got the shape {tuple(covariance.shape)}"
        )
