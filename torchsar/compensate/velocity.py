"""Effective velocity by minimum entropy of a small group of range lines (brief 004, item 8;
Tsvetkov 2017).

Always evaluated on the original data: the group's two-dimensional spectrum is formed once and
focused anew with every velocity. The objective is the mean entropy of blocks of range lines, each
taken by itself, so that a few very bright ships do not rule it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchsar.compensate.doppler import unit_peak
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
from torchsar.core import Estimate, Signal, Stage, settle
from torchsar.optim.scalar import gradient_minimum, grid_minimum
from torchsar.radar import StripmapRadar

Refine = Callable[..., tuple[Tensor, Tensor]]


class Focuser(Protocol):
    """What the estimator needs to know of the chain's focusing stage (`torchsar.focus.OmegaK` and
    its relatives).
    """

    radar: StripmapRadar

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor | None: ...


def velocity_objective(group: RangeGroup, doppler_hz: Tensor, dwell_s: float) -> Callable[[Tensor], Tensor]:
    """Function velocity (...,) -> entropies of the range blocks (..., block) times their weights,
    whose sum over the last dim is the objective.

    Differentiable in the velocity. Columns whose targets walk out of the group do not count; the
    others with their signal above the background in the image of the nominal velocity, where
    migration is already undone.
    """
    radar = group.radar
    spectrum = beam_spectrum(group, doppler_hz)
    with torch.no_grad():
        weight = block_weights(spectrum.image(doppler_hz, radar.velocity_m_s), radar, doppler_hz, dwell_s)

    def blocks(velocity_m_s: Tensor) -> Tensor:
        return block_entropy(spectrum.image(doppler_hz, velocity_m_s)) * weight

    return blocks


def grid_step_m_s(radar: StripmapRadar, range_m: float, dwell_s: float) -> float:
    """Velocity error that bends the phase by one turn between the middle and the end of the
    aperture: 2 lambda R / (v T^2).
    """
    return 2 * radar.wavelength_m * range_m / (radar.velocity_m_s * dwell_s**2)


def minimum_entropy_velocity(
    group: RangeGroup, doppler_hz: Tensor, dwell_s: float, reach_m_s: float, refine: Refine, tolerance_m_s: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity (...,) of least entropy within the radar's nominal one +- reach, its predicted
    deviation, and the costs of the grid (..., grid).

    refine: `parabola_minimum` or `gradient_minimum` of torchsar.optim. The deviation is how far the
    minima of separate parts of the group scatter about the common one (eight parts, by their slopes
    at the minimum and the common curvature).
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
    with torch.no_grad():
        slopes = (blocks(velocity + half) - blocks(velocity - half)) / (2 * half)
    parts = torch.stack([part.sum(-1) for part in slopes.tensor_split(8, -1)], -1)
    spread = parts.std(-1) * math.sqrt(parts.shape[-1])
    return torch.where(curvature > 0, spread / torch.where(curvature > 0, curvature, 1), 1e6).clamp_max(1e6)


class EffectiveVelocity(Stage):
    """`velocity_m_s` of least entropy; leaves the signal alone.

    The Doppler centroid (absolute) is a value to connect.

    focuser: the chain's focusing stage, from which the radar and the range reference are taken.
    reach_m_s: how far the nominal velocity may be off. lines: range lines in the group; at most
    four apertures of pulses about the middle of the record are used. ok where the minimum lies
    inside the grid and its predicted deviation is below 5 m/s. info: grid_velocity_m_s,
    grid_entropy (..., grid), group_start (...,).
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
                "a velocity search needs a positive reach and tolerance and at least 16 lines, got "
                f"{reach_m_s}, {tolerance_m_s}, {lines}"
            )
        # in a list, so that the chain's focuser does not become a submodule twice
        self._focuser = [focuser]
        self.reach_m_s, self.lines, self.refine, self.tolerance_m_s = reach_m_s, lines, refine, tolerance_m_s

    def group(self, raw: Tensor) -> tuple[RangeGroup, float]:
        """The group of range lines the estimate is made on, and the time a target stays in it."""
        focuser = self._focuser[0]
        radar, n = focuser.radar, raw.shape[-1]
        dwell = aperture_s(radar, n)
        lines = compress(
            unit_peak(central_lines(raw, max(1024, round(4 * dwell * radar.prf_hz)))),
            radar,
            focuser.spectrum(n, raw.device),
        )
        return pick_group(lines, radar, self.lines), dwell

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        raw = signal.data.detach()
        radar = self._focuser[0].radar
        doppler = torch.as_tensor(
            (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else doppler_hz,
            dtype=torch.float64,
            device=raw.device,
        )
        doppler = doppler.detach().expand(raw.shape[:-2])
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
