"""Effective velocity by minimum entropy of a small group of range cells (Tsvetkov 2017).

The group is always focused from the original data: its two-dimensional spectrum is formed once and
focused anew for every velocity. The objective is the mean entropy of blocks of range cells, each
block taken separately, so that a few very bright ships do not dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchsar.compensate.group import (
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
    radar = group.radar
    lines = checked_samples(group.data, "velocity_objective", "pulse, range")
    group = RangeGroup(unit_level(lines), group.start, radar)
    spectrum = beam_spectrum(group, doppler_hz)
    with torch.no_grad():
        weight = block_weights(spectrum.image(doppler_hz, radar.velocity_m_s), radar, doppler_hz, dwell_s)

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
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the velocity of least entropy: a grid search, then a refinement.

    The standard deviation is predicted from eight parts of the group. The slope of the entropy of
    each part is taken at the common minimum. The scatter of the eight slopes gives the standard
    deviation of their sum; divided by the curvature of the whole entropy it is that of the
    velocity.

    Args:
        group: Group of range cells.
        doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing.
        dwell_s: Time that a target stays in the beam, in seconds.
        reach_m_s: Half width of the search about the nominal velocity of the radar, in m/s.
        refine: `parabola_minimum` or `gradient_minimum` of `torchsar.optim.scalar`.
        tolerance_m_s: Tolerance of the refinement in m/s.

    Returns:
        The velocity in m/s, shape (...,); its predicted standard deviation in m/s, shape (...,);
        and the objective on the grid in nats, shape (..., grid).
    """
    blocks = velocity_objective(group, doppler_hz, dwell_s)

    def cost(velocity: Tensor) -> Tensor:
        return blocks(velocity).sum(-1)

    step = min(grid_step_m_s(group.radar, float(group.radar.near_range_m), dwell_s), reach_m_s / 2)
    count = 2 * math.ceil(reach_m_s / step) + 1
    start = torch.full(doppler_hz.shape, group.radar.velocity_m_s, dtype=torch.float64, device=doppler_hz.device)
    coarse, costs = grid_minimum(cost, start, reach_m_s, count)
    value, curvature = refine(cost, coarse, 2 * reach_m_s / (count - 1), tolerance_m_s)
    value, _ = settle(value, group.radar.velocity_m_s)
    return value, _scatter_std(blocks, value, curvature, max(tolerance_m_s, step / 50)), costs


def _scatter_std(blocks: Callable[[Tensor], Tensor], velocity: Tensor, curvature: Tensor, half: float) -> Tensor:
    """Standard deviation (...,) in m/s from the slopes of eight parts at the minimum."""
    with torch.no_grad():
        slopes = (blocks(velocity + half) - blocks(velocity - half)) / (2 * half)
    parts = torch.stack([part.sum(-1) for part in slopes.tensor_split(8, -1)], -1)
    spread = parts.std(-1) * math.sqrt(parts.shape[-1])
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
            exponentially with the standard deviation, to 1/e at 5 m/s. `ok` is False where the
            entropy is least at an end of the searched interval, or the standard deviation is 5 m/s
            or more. info: grid_velocity_m_s, the velocities of the grid search, shape (grid,);
            grid_entropy, their entropies in nats, shape (..., grid); and group_start, the first
            range sample of the group of range cells used, shape (...,).
        """
        raw = signal.data.detach()
        radar, doppler = self._focuser[0].radar, self._doppler(raw, doppler_hz)
        group, dwell = self.group(raw)
        value, std, costs = minimum_entropy_velocity(
            group, doppler, dwell, self.reach_m_s, self.refine, self.tolerance_m_s
        )
        best = costs.argmin(-1)
        inside = (best > 0) & (best < costs.shape[-1] - 1)
        grid = (
            torch.linspace(-self.reach_m_s, self.reach_m_s, costs.shape[-1], dtype=torch.float64, device=raw.device)
            + radar.velocity_m_s
        )
        return Estimate(
            {"velocity_m_s": value},
            torch.exp(-std / 5),
            inside & (std < 5),
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
