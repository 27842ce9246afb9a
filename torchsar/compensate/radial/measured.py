"""Radial velocities measured in sweeps, with the SNR of the sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, filled
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Estimate, cis, power_of

Intercept = Literal["known", "record", "free"]
TINY = torch.finfo(torch.float64).tiny
# _LEAST_SNR: SNR after compression, 16 dB, from which on the peaks of single sweeps exceed the
# noise. In 1000 periods, one slip was measured at 13 dB, and none from 14 dB on. The measured SNR
# is wrong by a decibel or two.
# LEAST_SQUARED: the same limit for a product of sweeps, after the squaring loss, 15 dB, found by
# trial.
_LEAST_SNR, LEAST_SQUARED = 10**1.6, 10**1.5


@dataclass(frozen=True)
class Law:
    """How noise enters the velocity of a method.

    White noise gives the variance factor * (lambda / 2)^2 / ((2 pi T)^2 g), plus the square of
    `floor_m_s`, where T is the length of a sweep and g the energy of a sweep over the noise
    variance of a sample.

    Args:
        factor: Factor of the variance.
        intercept: Intercept of a method that measures the product of up and mirrored down sweeps,
            see `mirror_product`; the variance then includes the squaring loss at low SNR.
        floor_m_s: Standard deviation in m/s that remains however strong the signal.
        changes: Function without arguments that returns the velocities in m/s, shape (..., pulse),
            which the changes of power between both sweeps give with the weights of the method, as
            if they were changes of phase; None for those of the product of the sweeps.
    """

    factor: float
    intercept: Intercept | None = None
    floor_m_s: float = 0.0
    changes: Callable[[], Tensor] | None = None


class Levels(NamedTuple):
    """Scene and noise in a record, shape (...,) each, float64.

    Args:
        share: Share of the power that the up sweep and the mirrored down sweep have in common.
        noise: Mean power per sample of the rest.
        after: Energy of a sweep over the noise variance of a sample, the SNR after compression.
        squared: The same, less the loss of a product of two noisy sweeps.
    """

    share: Tensor
    noise: Tensor
    after: Tensor
    squared: Tensor

    @staticmethod
    def of(common: Tensor, bands: Bands) -> Levels:
        """Divide the mean power of the periods with an echo into scene and noise.

        Args:
            common: Power that both sweeps have in common in every period, shape (..., pulse).
            bands: Filtered sweeps.
        """
        up, down = (power_of(x.detach()[..., bands.inner]).mean(-1).to(torch.float64) for x in (bands.up, bands.down))
        shared, total = (mean_of(x, bands.lit)[..., 0] for x in (common, (up + down) / 2))
        # The magnitude of a mean of noise is not zero. Up to 1.5 times what noise alone would give
        # does not count as scene.
        chance = total / math.sqrt(min(len(bands.time_s[bands.inner]), 2 * bands.noise_lines))
        scene = torch.where(shared > 1.5 * chance, shared, 0).clamp_max(total)
        ratio = _ratio(scene, total - scene)
        after = ratio * bands.noise_lines
        return Levels(scene / total.clamp_min(TINY), total - scene, after, after / (1 + 1 / (2 * ratio)))


@dataclass(frozen=True)
class Measured:
    """Radial velocities that a method measured, and the echo and noise of the sweeps at these
    velocities.

    Args:
        velocity_m_s: Velocities at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse). They include the geometric velocity of a static scatterer, see
            `geometric_velocity_m_s`. In periods that are not clear they are interpolated.
        raw_m_s: The velocities before this interpolation.
        product: Sweeps filtered to the range window, with two samples per bin.
        still: Product of up and mirrored down sweeps with the phase of the velocities removed,
            without the ends of the sweeps, shape (..., pulse, m), complex.
        common: Power that both sweeps have in common in every period, shape (..., pulse), float64.
        levels: Mean powers of scene and noise.
        lit: False for periods in which no scatterer is illuminated, shape (..., pulse), bool.
        clear: False also for periods that have faded, shape (..., pulse), bool.
        law: How noise enters the velocities.
        info: Further entries for `info` of the estimate.
    """

    velocity_m_s: Tensor
    raw_m_s: Tensor
    product: Bands
    still: Tensor
    common: Tensor
    levels: Levels
    lit: Tensor
    clear: Tensor
    law: Law
    info: Mapping[str, Tensor] = field(default_factory=dict)

    @staticmethod
    def of(velocity_m_s: Tensor, product: Bands, law: Law, lit: Tensor | None = None, **info: Tensor) -> Measured:
        """Interpolate velocities in periods without a clear echo, and measure the SNR.

        Args:
            velocity_m_s: Measured velocities at the turning points in m/s, shape (..., pulse).
            product: Sweeps filtered to the range window, with two samples per bin.
            law: How noise enters the velocities.
            lit: False for periods in which the method found no echo, shape (..., pulse), bool.
            **info: Further entries for `info` of the estimate.
        """
        finite = torch.isfinite(velocity_m_s.detach())
        lit = (product.lit if lit is None else product.lit & lit) & finite
        raw = filled(torch.where(finite, velocity_m_s, 0), lit)
        # product of the up and the mirrored down sweeps, with the phase of the velocities removed
        inner, radar = product.inner, product.radar
        up, down = product.up.detach()[..., inner], product.down.detach()[..., inner]
        turns = 4 * radar.carrier_hz / radar.wave_speed_m_s * (raw.detach() - product.shift_m_s)
        turn = cis((-2 * math.pi * turns[..., None] * product.time_s[inner]).to(up.real.dtype))
        still = up * down.conj() * turn
        common = still.mean(-1).abs().to(torch.float64)
        levels = Levels.of(common, product)
        counted = lit | ~lit.any(-1, keepdim=True)
        own = _ratio(common, levels.noise[..., None])
        # An echo is clear unless it is below 12 dB, where noise may exceed its peak, or below a
        # twentieth of the mean power, where interference disturbs the phase.
        clear = common > 0.05 * mean_of(common, counted)
        clear = lit & clear & (own * product.noise_lines / (1 + 1 / (2 * own)) >= 10**1.2)
        return Measured(filled(raw, clear), raw, product, still, common, levels, lit, clear, law, info)

    @property
    def enough(self) -> Tensor:
        """True where the SNR suffices for peaks that exceed the noise in all periods,
        shape (...,).
        """
        return self.levels.squared >= LEAST_SQUARED if self.law.intercept else self.levels.after >= _LEAST_SNR

    @property
    def white_m_s(self) -> Tensor:
        """Standard deviation in m/s due to white noise alone, shape (...,)."""
        after = self.levels.squared if self.law.intercept else self.levels.after
        return self.product.radar.ambiguous_velocity_m_s / (2 * math.pi) * torch.sqrt(self.law.factor / after)

    def estimate(self, pulse: Axis, azimuth_m: Tensor | float) -> Estimate:
        """Return the velocities as an estimate that is not assessed.

        Args:
            pulse: Slow-time axis; each entry is a period of one up and one down sweep.
            azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).

        Returns:
            `velocity_m_s` without the geometric velocity. `quality` is the share of the power in
            the window that both sweeps have in common. `info` holds "snr_db", the SNR after
            compression, and "noise_m_s", the standard deviation that is due to noise, shape (...,)
            each. It also holds "shift", the Doppler shift removed from the sweeps in whole bins,
            and "lit", False for periods in which no scatterer is illuminated, shape (..., pulse)
            each. The entries of the method are added.
        """
        bands = self.product
        centre = (bands.first + bands.lines / 2) * bands.radar.range_step_m
        geometric = geometric_velocity_m_s(bands.radar, pulse, azimuth_m, centre, self.velocity_m_s.device)
        info = {
            "snr_db": 10 * torch.log10(self.levels.after),
            "noise_m_s": (self.white_m_s.square() + self.law.floor_m_s**2).sqrt(),
            "shift": bands.shift,
            "lit": self.lit,
        }
        value = {"velocity_m_s": self.velocity_m_s - geometric}
        return Estimate(value, quality=self.levels.share, info={**info, **self.info})


def mean_of(x: Tensor, counted: Tensor) -> Tensor:
    """Compute the mean over the periods that are counted.

    Args:
        x: Values, shape (..., pulse).
        counted: True for periods that count, shape (..., pulse), bool.

    Returns:
        The mean, shape (..., 1); zero where no period counts.
    """
    return torch.where(counted, x, 0).sum(-1, keepdim=True) / counted.sum(-1, keepdim=True).clamp_min(1)


def _ratio(signal: Tensor, noise: Tensor) -> Tensor:
    """Ratio of signal to noise, between 1e-6 and 1e18."""
    return (signal / noise.clamp_min(TINY)).clamp(1e-6, 1e18)
