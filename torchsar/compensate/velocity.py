"""Effective velocity by minimum entropy of a small group of range cells (Tsvetkov 2017).

The group is always focused from the original data: its two-dimensional spectrum is formed once and
focused anew for every velocity. The objective is the mean entropy of blocks of range cells, each
block taken separately, so that a few very bright ships do not dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.compensate.group import (
    BeamSpectrum,
    RangeGroup,
    aperture_s,
    beam_spectrum,
    block_entropy,
    block_weights,
    central_lines,
    compress,
    pick_group,
)
from torchsar.core import Estimate, Signal, Stage, checked_samples, settle, unit_level
from torchsar.optim.scalar import gradient_minimum, grid_minimum
from torchsar.radar import StripmapRadar

Refine = Callable[..., tuple[Tensor, Tensor]]

# Variance of the entropy of n independent pixels of pure noise, times n: with the exponential
# distribution of their intensity, 0.290.
_NOISE_ENTROPY = 0.29
# Depth of a significant minimum in standard deviations of noise. On noise the depth is below 3; of
# 24 points at an SNR of -20 dB it is 4 to 8, at -10 dB above 60.
_LEAST_DEPTH = 8.0
# Systematic part of the standard deviation over the width of the minimum: the entropy of points and
# speckle is least 0.02 widths beside the true velocity, whatever the SNR.
_REST_SHARE = 0.02
_COMBS = 4  # interleaved sets of Doppler rows, of independent noise, for the standard deviation


class Focuser(Protocol):
    """The part of a focusing stage, such as `torchsar.focus.OmegaK`, that `EffectiveVelocity` uses.

    Args:
        radar: Radar parameters of the stage.
    """

    radar: StripmapRadar

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor | None:
        """Compute the range reference spectrum for lines of n samples.

        Args:
            n: Number of range samples.
            device: Device of the result.

        Returns:
            The spectrum, shape (n,), complex; None for range-compressed data.
        """
        ...


def velocity_objective(group: RangeGroup, doppler_hz: Tensor, dwell_s: float) -> Callable[[Tensor], Tensor]:
    """Make the function whose minimum is the effective velocity: the entropy of a group's image.

    The function maps a velocity to the weighted entropies of blocks of range cells and is
    differentiable. A block is weighted with its signal above the background in the image focused
    with the nominal velocity. Range cells whose targets migrate out of the group add nothing to the
    weight, except those of the middle half of the group.

    Args:
        group: Group of range cells.
        doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing.
        dwell_s: Time that a target stays in the beam, in seconds.

    Returns:
        A function of the velocity in m/s, shape (...,), that returns the entropies times their
        weights in nats, shape (..., block). Their sum over the last dimension is the objective.
    """
    lines = checked_samples(group.data, "velocity_objective", "pulse, range")
    group = RangeGroup(unit_level(lines), group.start, group.radar)
    spectrum = beam_spectrum(group, doppler_hz)
    return _objective(spectrum, doppler_hz, _weights(spectrum, doppler_hz, dwell_s))


@torch.no_grad()
def _weights(spectrum: BeamSpectrum, doppler_hz: Tensor, dwell_s: float) -> Tensor:
    """Weights of the blocks (..., block) in the image of the nominal velocity."""
    radar = spectrum.group.radar
    return block_weights(spectrum.image(doppler_hz, radar.velocity_m_s), radar, doppler_hz, dwell_s)


def _objective(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor) -> Callable[[Tensor], Tensor]:
    """Function of the velocity (...,) that returns the weighted entropies (..., block)."""

    def blocks(velocity_m_s: Tensor) -> Tensor:
        return block_entropy(spectrum.image(doppler_hz, velocity_m_s)) * weight

    return blocks


def grid_step_m_s(radar: StripmapRadar, range_m: float, dwell_s: float) -> float:
    """Compute the step of the grid search for the effective velocity.

    It is 2 lambda R / (v T^2), with range R, nominal velocity v and length T of the aperture: the
    velocity error that changes the phase by one cycle between the middle and the end of the
    aperture.

    Args:
        radar: Radar parameters.
        range_m: Slant range in metres.
        dwell_s: Length of the aperture in seconds.

    Returns:
        The step in m/s.
    """
    return 2 * radar.wavelength_m * range_m / (radar.velocity_m_s * dwell_s**2)


def minimum_entropy_velocity(
    group: RangeGroup, doppler_hz: Tensor, dwell_s: float, reach_m_s: float, refine: Refine, tolerance_m_s: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the velocity of least entropy: a grid search, then a refinement.

    The standard deviation has three parts. The first follows from eight parts of the group: the
    scatter of the slopes of their entropies at the common minimum, divided by the curvature of the
    whole entropy. The second follows in the same way from four interleaved sets of Doppler rows,
    whose noise is independent also where one target dominates; the larger of both counts. The third
    is the systematic error, 0.02 times the width of the minimum. The width is that of a parabola
    with the curvature at the minimum and the depth of the minimum below the mean over the grid.

    Args:
        group: Group of range cells.
        doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing.
        dwell_s: Time that a target stays in the beam, in seconds.
        reach_m_s: Half width of the search about the nominal velocity of the radar, in m/s.
        refine: `parabola_minimum` or `gradient_minimum` of `torchsar.optim.scalar`.
        tolerance_m_s: Tolerance of the refinement in m/s.

    Returns:
        The velocity in m/s, shape (...,); its predicted standard deviation in m/s, shape (...,);
        the objective on the grid in nats, shape (..., grid); and whether the minimum is that of a
        focused image, bool (...,). It is where its depth is 8 standard deviations of the entropy of
        noise or more, and its width below that for the dwell: one step of `grid_step_m_s`. A wider
        minimum shows that the targets are seen for a shorter time.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no trials or no samples, or a sample is not finite.
    """
    lines = checked_samples(group.data, "minimum_entropy_velocity", "pulse, range", empty=False)
    group = RangeGroup(unit_level(lines), group.start, group.radar)
    spectrum = beam_spectrum(group, doppler_hz)
    weight = _weights(spectrum, doppler_hz, dwell_s)
    blocks = _objective(spectrum, doppler_hz, weight)

    def cost(velocity: Tensor) -> Tensor:
        return blocks(velocity).sum(-1)

    full_step = grid_step_m_s(group.radar, float(group.radar.near_range_m), dwell_s)
    step = min(full_step, reach_m_s / 2)
    count = 2 * math.ceil(reach_m_s / step) + 1
    start = torch.full(doppler_hz.shape, group.radar.velocity_m_s, dtype=torch.float64, device=doppler_hz.device)
    coarse, costs = grid_minimum(cost, start, reach_m_s, count)
    value, curvature = refine(cost, coarse, 2 * reach_m_s / (count - 1), tolerance_m_s)
    value, _ = settle(value, group.radar.velocity_m_s)
    with torch.no_grad():
        depth = costs.mean(-1) - costs.amin(-1)
        width = (2 * depth / torch.where(curvature > 0, curvature, 1e-12)).clamp_min(0).sqrt()
        scatter = torch.maximum(
            _scatter_std(blocks, value, curvature, max(tolerance_m_s, step / 50)),
            _comb_std(spectrum, doppler_hz, weight, value, max(tolerance_m_s, step / 8)),
        )
        std = torch.hypot(scatter, _REST_SHARE * width).clamp_max(1e6)
        clear = (curvature > 0) & (depth > _LEAST_DEPTH * _noise_std(spectrum, weight)) & (width < full_step)
    return value, std, costs, clear


def _noise_std(spectrum: BeamSpectrum, weight: Tensor) -> Tensor:
    """Standard deviation (...,) in nats of the weighted entropy of an image of noise."""
    radar = spectrum.group.radar
    filled = min(1.0, radar.pulse.bandwidth_hz / radar.sampling_hz)  # neighbouring samples are alike
    pixels = filled * spectrum.data.shape[-2] * spectrum.data.shape[-1] / weight.shape[-1]
    return (_NOISE_ENTROPY / pixels * weight.square().sum(-1)).sqrt()


def _scatter_std(blocks: Callable[[Tensor], Tensor], velocity: Tensor, curvature: Tensor, half: float) -> Tensor:
    """Standard deviation (...,) in m/s from the slopes of eight parts at the minimum."""
    slopes = (blocks(velocity + half) - blocks(velocity - half)) / (2 * half)
    parts = torch.stack([part.sum(-1) for part in slopes.tensor_split(8, -1)], -1)
    spread = parts.std(-1) * math.sqrt(parts.shape[-1])
    return torch.where(curvature > 0, spread / torch.where(curvature > 0, curvature, 1), 1e6).clamp_max(1e6)


def _comb_std(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor, velocity: Tensor, half: float) -> Tensor:
    """Standard deviation (...,) in m/s from the slopes of interleaved sets of Doppler rows."""
    if spectrum.data.shape[-2] < _COMBS:
        return torch.full_like(velocity, 1e6)
    values = []
    for first in range(_COMBS):
        rows = replace(
            spectrum, data=spectrum.data[..., first::_COMBS, :], doppler_hz=spectrum.doppler_hz[..., first::_COMBS]
        )
        part = _objective(rows, doppler_hz, weight)
        values.append(torch.stack([part(velocity + step * half).sum(-1) for step in (-1, 0, 1)], -1))
    low, middle, high = torch.stack(values, -1).unbind(-2)
    curvature = (low - 2 * middle + high).mean(-1) / half**2
    spread = ((high - low) / (2 * half)).std(-1) / math.sqrt(_COMBS)
    return torch.where(curvature > 0, spread / torch.where(curvature > 0, curvature, 1), 1e6).clamp_max(1e6)


class EffectiveVelocity(Stage):
    """Effective velocity of least image entropy.

    Provides `velocity_m_s` and leaves the signal unchanged. In a chain, connect `doppler_hz` to the
    stage that estimates the absolute Doppler centroid. Only lines about the middle of the record
    are used: as many as four synthetic apertures, or 1024 if that is more.

    Args:
        focuser: Focusing stage of the chain, whose radar and range reference spectrum are used.
        reach_m_s: Largest error of the nominal velocity in m/s.
        lines: Number of range cells in the group, at least 16.
        refine: `parabola_minimum` or `gradient_minimum` of `torchsar.optim.scalar`.
        tolerance_m_s: Tolerance of the refinement in m/s.

    Raises:
        ValueError: If `reach_m_s` or `tolerance_m_s` is not positive, or `lines` is below 16.

    Reference:
        Tsvetkov 2017, focusing algorithm, remark on step 4.
    """

    provides = ("velocity_m_s",)
    takes_empty = False

    def __init__(
        self,
        focuser: Focuser,
        reach_m_s: float = 80.0,
        lines: int = 512,
        refine: Refine = gradient_minimum,
        tolerance_m_s: float = 0.01,
    ) -> None:
        super().__init__()
        if not (reach_m_s > 0 and tolerance_m_s > 0 and lines >= 16):
            raise ValueError(
                "EffectiveVelocity: reach_m_s and tolerance_m_s must be positive and lines (range cells) 16 or "
                f"more, got reach_m_s {reach_m_s}, tolerance_m_s {tolerance_m_s} and lines {lines}"
            )
        # in a list, so that torch does not register the focuser of the chain as a submodule twice
        self._focuser = [focuser]
        self.neutral = {"velocity_m_s": focuser.radar.velocity_m_s}
        self.reach_m_s, self.lines, self.refine, self.tolerance_m_s = reach_m_s, lines, refine, tolerance_m_s

    def group(self, raw: Tensor) -> tuple[RangeGroup, float]:
        """Cut out the group of range cells that the estimate uses.

        Args:
            raw: Lines, shape (..., pulse, range), complex.

        Returns:
            The group, and the time that a target stays in the beam, in seconds.
        """
        focuser = self._focuser[0]
        radar, n = focuser.radar, raw.shape[-1]
        dwell = aperture_s(radar, n)
        lines = compress(
            unit_level(central_lines(raw, max(1024, round(4 * dwell * radar.prf_hz)))),
            radar,
            focuser.spectrum(n, raw.device),
        )
        return pick_group(lines, radar, self.lines), dwell

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate the effective velocity of a signal of axes (pulse, range).

        Args:
            signal: Lines, shape (..., pulse, range), complex.
            doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing; by
                default `pointing_doppler_hz` of the radar, or 0 if that is None.

        Returns:
            `velocity_m_s` of shape (...,) with its standard deviation in m/s. quality falls
            exponentially with the standard deviation, to 1/e where an eighth of a cycle of phase
            remains at the ends of the aperture (an eighth of `grid_step_m_s`). `ok` is False where
            the standard deviation is larger, where the entropy is least at an end of the searched
            interval, and where its minimum is not that of a focused image: see
            `minimum_entropy_velocity`. info: grid_velocity_m_s, the velocities of the grid search,
            shape (grid,); grid_entropy, their entropies in nats, shape (..., grid); and
            group_start, the first range sample of the group of range cells used, shape (...,).
        """
        raw = signal.data.detach()
        radar, doppler = self._focuser[0].radar, self._doppler(raw, doppler_hz)
        group, dwell = self.group(raw)
        value, std, costs, clear = minimum_entropy_velocity(
            group, doppler, dwell, self.reach_m_s, self.refine, self.tolerance_m_s
        )
        most = grid_step_m_s(radar, float(radar.near_range_m), dwell) / 8
        best = costs.argmin(-1)
        inside = (best > 0) & (best < costs.shape[-1] - 1)
        grid = (
            torch.linspace(-self.reach_m_s, self.reach_m_s, costs.shape[-1], dtype=torch.float64, device=raw.device)
            + radar.velocity_m_s
        )
        return Estimate(
            {"velocity_m_s": value},
            torch.exp(-std / most),
            inside & clear & (std < most),
            {"velocity_m_s": std},
            {"grid_velocity_m_s": grid, "grid_entropy": costs, "group_start": group.start},
        )

    @torch.no_grad()
    def entropy(self, signal: Signal, velocity_m_s: Tensor, doppler_hz: Tensor | None = None) -> Tensor:
        """Compute the image entropy that the search minimises, at given velocities.

        Args:
            signal: Lines, shape (..., pulse, range), complex.
            velocity_m_s: Effective velocities in m/s, shape (n,).
            doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing; by
                default `pointing_doppler_hz` of the radar, or 0 if that is None.

        Returns:
            The entropy in nats, a weighted mean over blocks of range cells, shape (..., n).
        """
        raw = signal.data.detach()
        doppler = self._doppler(raw, doppler_hz)
        group, dwell = self.group(raw)
        blocks = velocity_objective(group, doppler, dwell)
        return torch.stack([blocks(v.to(doppler).expand(doppler.shape)).sum(-1) for v in velocity_m_s], -1)

    def _doppler(self, raw: Tensor, doppler_hz: Tensor | None) -> Tensor:
        """The given Doppler centroid, or that of the pointing, shape (...,)."""
        pointing = self._focuser[0].radar.pointing_doppler_hz or 0.0
        given = torch.as_tensor(pointing if doppler_hz is None else doppler_hz, dtype=torch.float64, device=raw.device)
        return given.detach().expand(raw.shape[:-2])
