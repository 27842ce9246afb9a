"""Effective velocity by minimum entropy of a small group of range cells (Tsvetkov 2017).

The group is always focused from the original data: its two-dimensional spectrum is formed once and
focused again for every velocity. The objective is the mean entropy of blocks of range cells, each
block taken separately, so that a few very bright ships do not dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from torchsar.compensate import velocity_assess
from torchsar.compensate.group import (
    BeamSpectrum,
    RangeGroup,
    aperture_lines,
    beam_spectrum,
    block_entropy,
    block_weights,
    entropy_parts,
    pick_group,
    quotient,
)
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    differentiable,
    fft_lines,
    settle,
    take,
    unit_level,
)
from torchsar.focus.omega_k import OmegaK
from torchsar.optim import implicit
from torchsar.optim.scalar import grid_minimum, parabola_minimum, vertex
from torchsar.radar import StripmapRadar


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
    spectrum, _, weight = _nominal(group, doppler_hz, dwell_s)
    return _objective(spectrum, doppler_hz, weight)


def _nominal(group: RangeGroup, doppler_hz: Tensor, dwell_s: float) -> tuple[BeamSpectrum, Tensor, Tensor]:
    """Spectrum of a group, its image for the nominal velocity, and weights of its blocks (...,
    block).
    """
    spectrum, radar = beam_spectrum(replace(group, data=unit_level(group.data)), doppler_hz), group.radar
    image = spectrum.image(doppler_hz, radar.velocity_m_s)
    return spectrum, image, block_weights(image, radar, doppler_hz, dwell_s)


def _objective(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor) -> Callable[[Tensor], Tensor]:
    """Function of the velocity (...,) that returns the weighted entropies (..., block)."""

    def blocks(velocity_m_s: Tensor) -> Tensor:
        return block_entropy(spectrum.image(doppler_hz, velocity_m_s)) * weight

    return blocks


def _parts(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor, velocity_m_s: Tensor) -> tuple[Tensor, ...]:
    """Range-Doppler spectrum (..., row, range) of the image for a velocity (...,), and weighted
    contributions of eight parts along azimuth.

    The second result is the contribution of each part to the entropies of the blocks, and the third
    that to the shares of the energy, (..., block, part) each. Both are multiplied by the weights of
    the blocks. The image has twice as many azimuth samples as the spectrum has rows. With one
    sample per resolution cell, the entropy would change with the position of a target between two
    samples, and a wrong velocity moves targets. The parts serve to find the standard deviation.
    """
    rows = spectrum.rows(doppler_hz, velocity_m_s)
    entropy, share = entropy_parts(fft_lines(rows, inverse=True, n=2 * rows.shape[-2]), 8)
    return rows, entropy * weight[..., None], share * weight[..., None]


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


@differentiable("where ok")
def minimum_entropy_velocity(
    group: RangeGroup,
    doppler_hz: Tensor,
    dwell_s: float,
    reach_m_s: float,
    tolerance_m_s: float,
    *,
    assess: bool = True,
) -> Estimate:
    """Find the velocity of least entropy: a grid search, a refinement, and a parabola.

    >>> from torchsar import Draws, compensate, echo, focus, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 100.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0], [0]), scene.Dwell(1.0), velocity_m_s=125.0)
    >>> raw, truth = echo.simulate(strip, world, 128, 64, Draws(1))
    >>> group, _ = compensate.EffectiveVelocity(focus.OmegaK(strip)).group(raw.signal.data)
    >>> compensate.minimum_entropy_velocity(
    ...     group, truth.values["doppler_hz"], dwell_s=1.0, reach_m_s=20.0, tolerance_m_s=0.1
    ... )["velocity_m_s"].round()
    tensor(125., dtype=torch.float64)

    The grid has steps of `grid_step_m_s`. Where that would be more than 33 velocities, only the
    middle of the Doppler band is focused at first, with fewer and wider steps. Then the band is
    doubled, and velocities about the best one are searched, until the band is whole.

    The refinement starts at the vertex of a parabola through the best velocity of the grid and its
    neighbours, and stops at a sixtieth of the step of the grid or at `tolerance_m_s`, whichever is
    larger. The result is the vertex of a parabola through entropies of images with twice as many
    azimuth samples, a tenth of a step to either side.

    Args:
        group: Group of range cells.
        doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing.
        dwell_s: Time that a target stays in the beam, in seconds.
        reach_m_s: Half width of the search about the nominal velocity of the radar, in m/s; at most
            half the nominal velocity is searched.
        tolerance_m_s: Tolerance of the refinement in m/s.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `velocity_m_s` of shape (...,). `info` holds "grid_velocity_m_s", the velocities of the
        first grid search, shape (grid,), and "grid_entropy", their entropies in nats, shape (...,
        grid). The assessment, with its outcomes, is that of `EffectiveVelocity`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no trials or no samples, or a sample is not finite.
    """
    checked_samples(group.data, "minimum_entropy_velocity", "pulse, range", empty=False)
    (spectrum, image, weight), nominal = _nominal(group, doppler_hz, dwell_s), group.radar.velocity_m_s
    blocks = _objective(spectrum, doppler_hz, weight)

    def objective(velocity_m_s: Tensor) -> Tensor:
        return blocks(velocity_m_s).sum(-1)

    step = grid_step_m_s(group.radar, float(group.radar.near_range_m), dwell_s)
    start = torch.full(doppler_hz.shape, nominal, dtype=torch.float64, device=doppler_hz.device)
    reach, known = min(reach_m_s, nominal / 2), (block_entropy(image) * weight).sum(-1)
    with torch.no_grad():
        value, near, inside, costs = _search(spectrum, doppler_hz, weight, start, known, reach, step)
    # The refinement stops at this share of the step of the grid, a sixth of the half width of the
    # last parabola. With half of that half width, estimates in speckle were displaced by 0.02 m/s.
    tolerance = max(tolerance_m_s, step / 60)
    if near > tolerance:
        value, _ = parabola_minimum(objective, value, near, tolerance)
    value, _ = settle(value, nominal)
    value = implicit(lambda x, *data: objective(x[..., 0]), value[..., None], group, doppler_hz)[..., 0]
    half = torch.full_like(value.detach(), min(step, nominal / 2) / 10)
    if group.radar.integration_s is None:
        with torch.no_grad():
            half = _scale_m_s(objective, value.detach(), 2 * min(step, nominal / 18), nominal * 4 / 9) / 20
        half = half.detach()  # derivatives in forward mode are not stopped by no_grad
    parts = [_parts(spectrum, doppler_hz, weight, value + side * half) for side in (-1, 0, 1)]
    rows, (low, middle, high), shares = zip(*parts, strict=True)
    curvature = (low - 2 * middle + high).sum((-2, -1)) / half.square()
    # energy that moves from one part to another, which does not change the entropy by itself,
    # is left out
    level = middle.sum(-1, keepdim=True) / shares[1].sum(-1, keepdim=True).clamp_min(1e-300)
    slope = (high - low - level * (shares[2] - shares[0])) / (2 * half[..., None, None])
    # the step leads to the vertex of the parabola, and at most to its ends
    value = value - torch.minimum(torch.maximum(quotient(slope.sum((-2, -1)), curvature), -half), half)
    inside = inside & ((value.detach() - nominal).abs() <= reach)
    value = value.clamp(nominal - reach, nominal + reach)
    points = nominal + torch.linspace(-reach, reach, costs.shape[-1], dtype=torch.float64, device=start.device)
    found = Estimate({"velocity_m_s": value}, info={"grid_velocity_m_s": points, "grid_entropy": costs})
    if not assess:
        return found
    with torch.no_grad():
        minimum = objective, weight, inside, step
        return velocity_assess.assessed(found, spectrum.group, image, minimum, rows, half, slope, curvature)


def _scale_m_s(
    objective: Callable[[Tensor], Tensor], velocity_m_s: Tensor, least_m_s: float, most_m_s: float
) -> Tensor:
    """Distance from a minimum (...,) in m/s that is about four times its half width.

    The entropy is compared at distances that grow by factors of four. Within the width it grows
    with the square of the distance, by sixteen from one to the next, and beyond it with the
    logarithm. The first distance beyond the width is the largest whose entropy is more than four
    times that of the one before. Going from large to small ones, the entropy of noise, whose
    minima are as narrow as the least distance, is met only where there is no wider minimum. The
    width w follows from the growth to the next distance, for an entropy that rises with
    d^2 / (w^2 + d^2).

    Args:
        objective: Entropy (...,) for a velocity (...,).
        velocity_m_s: The velocity of the minimum.
        least_m_s: Least distance.
        most_m_s: Largest distance, greater than the least one.
    """
    levels = int(math.log(most_m_s / least_m_s, 4)) + 1
    distances = [least_m_s * 4.0**k for k in range(levels)]
    least = objective(velocity_m_s)
    rise = [(objective(velocity_m_s - d) + objective(velocity_m_s + d)) / 2 - least for d in distances]
    growth = [(above / below.clamp_min(1e-12)).clamp(1, 16) for below, above in pairwise(rise)]
    # beyond the largest distance the growth is not known; the result is this distance then
    growth.append(torch.ones_like(least))
    found, after = torch.full_like(velocity_m_s, least_m_s), growth[0]
    for k in range(1, levels):
        wider = growth[k - 1] > 4
        found, after = torch.where(wider, distances[k], found), torch.where(wider, growth[k], after)
    times = 16 * ((after - 1) / (16 - after).clamp_min(1e-12)).sqrt()  # 4 w over the distance
    return (found * times.clamp(1, 8)).clamp_max(most_m_s)


def _search(
    spectrum: BeamSpectrum,
    doppler_hz: Tensor,
    weight: Tensor,
    start: Tensor,
    cost: Tensor,
    reach: float,
    full_step: float,
) -> tuple[Tensor, float, Tensor, Tensor]:
    """Search with the whole Doppler band, and before that with its middle, for which fewer and
    wider steps suffice.

    Args:
        spectrum: Spectrum of the group.
        doppler_hz: Absolute Doppler centroid in Hz, (...,).
        weight: Weights of the blocks, (..., block).
        start: Velocity in the middle of the search in m/s, (...,).
        cost: Entropy of the image of the whole band at the start, (...,).
        reach: Half width of the search in m/s.
        full_step: Step for the whole band in m/s; there are at most 16 steps to either side.

    Returns:
        The vertex of the parabola through the best velocity and its neighbours, or the best
        velocity where it has only one neighbour, (...,). The half width about it for its
        refinement. True where the best velocity of the first grid is not at an end, (...,). And the
        entropies of the first grid, (..., grid).
    """
    share, value, first, rows = min(1.0, math.sqrt(16 * full_step / reach)), start, None, spectrum.data.shape[-2]
    while True:
        kept = min(rows, max(64, round(share * rows)))
        part = slice((rows - kept) // 2, (rows - kept) // 2 + kept)
        middle = replace(spectrum, data=spectrum.data[..., part, :], doppler_hz=spectrum.doppler_hz[..., part])
        blocks = _objective(middle, doppler_hz, weight)
        step = min(full_step / share**2, reach / 2)
        count = 2 * math.ceil(reach / step - 1e-9) + 1
        known = cost if share == 1 and first is None else None
        value, costs = grid_minimum(lambda velocity, f=blocks: f(velocity).sum(-1), value, reach, count, known)
        first = costs if first is None else first
        if share == 1:
            break
        reach, share = 2 * step, min(1.0, 2 * share)
    step, best = 2 * reach / (count - 1), costs.argmin(-1)
    low, middle, high = (take(costs, (best + side).clamp(0, count - 1)) for side in (-1, 0, 1))
    inner = (best > 0) & (best < count - 1)
    value = torch.where(inner, value + step * vertex(-low, -middle, -high), value)
    best = first.argmin(-1)
    return value, step / 4, (best > 0) & (best < first.shape[-1] - 1), first


class EffectiveVelocity(Stage):
    """Effective velocity of least image entropy.

    >>> from torchsar import Draws, compensate, echo, focus, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 100.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0], [0]), scene.Dwell(1.0), velocity_m_s=125.0)
    >>> recording, _ = echo.simulate(strip, world, 128, 64, Draws(1))
    >>> estimate = compensate.EffectiveVelocity(focus.OmegaK(strip), reach_m_s=20.0, lines=16)
    >>> estimate(recording.signal)["velocity_m_s"].round()
    tensor(125., dtype=torch.float64)

    Provides `velocity_m_s` and leaves the signal unchanged. In a chain, connect `doppler_hz` to the
    stage that estimates the absolute Doppler centroid. Only lines about the middle of the record
    are used: as many as four synthetic apertures, or 1024 if that is more.

    Args:
        focuser: Focusing stage of the chain, whose radar and range reference spectrum are used.
        reach_m_s: Largest error of the nominal velocity in m/s.
        lines: Number of range cells that are used, at least 16.
        tolerance_m_s: Tolerance of the refinement in m/s.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Raises:
        ValueError: If `reach_m_s` or `tolerance_m_s` is not positive, or `lines` is below 16.

    Reference:
        Tsvetkov 2017, focusing algorithm, remark on step 4.
    """

    provides = ("velocity_m_s",)
    takes_empty = False
    differentiable = "where ok"

    def __init__(
        self,
        focuser: OmegaK,
        reach_m_s: float = 80.0,
        lines: int = 512,
        tolerance_m_s: float = 0.01,
        assess: bool = True,
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
        self.reach_m_s, self.lines, self.tolerance_m_s, self.assess = reach_m_s, lines, tolerance_m_s, assess

    def group(self, raw: Tensor) -> tuple[RangeGroup, float]:
        """Cut out the group of range cells that the estimate uses.

        Args:
            raw: Lines, shape (..., pulse, range), complex.

        Returns:
            The group, and the time that a target stays in the beam, in seconds.
        """
        focuser = self._focuser[0]
        lines, dwell = aperture_lines(raw, focuser.radar, focuser.spectrum(raw.shape[-1], raw.device))
        return pick_group(lines, focuser.radar, self.lines), dwell

    def _doppler(self, raw: Tensor, doppler_hz: Tensor | None) -> Tensor:
        """Doppler centroid in Hz, shape (...,): the given one, or otherwise that of the pointing of
        the antenna.
        """
        pointing = self._focuser[0].radar.pointing_doppler_hz or 0.0
        given = torch.as_tensor(pointing if doppler_hz is None else doppler_hz, dtype=torch.float64, device=raw.device)
        return given.expand(raw.shape[:-2])

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate the effective velocity of a signal of axes (pulse, range).

        Args:
            signal: Lines, shape (..., pulse, range), complex.
            doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing; by
                default `pointing_doppler_hz` of the radar, or 0 if that is None.

        Returns:
            `velocity_m_s` of shape (...,) in m/s. `info` holds "grid_velocity_m_s", the velocities
            of the first grid search, shape (grid,); "grid_entropy", their entropies in nats, shape
            (..., grid); and "group_start", the first range sample of the group of range cells used,
            shape (...,). The assessment adds a standard deviation, and a quality that falls
            exponentially with it. The quality is 1/e where an eighth of a cycle of phase remains at
            the ends of the aperture. This is an eighth of `grid_step_m_s` or, where the dwell of
            the beam is not known, of the step that belongs to the width of the minimum. The outcome
            is EMPTY or NOISE where no minimum is deep enough for a focused image, as with clutter
            that fills the Doppler band evenly; OUTSIDE_SEARCH where the entropy is least at an end
            of the searched interval; MISFIT where the record is shorter than the dwell of the beam,
            so that every target is cut; and INEXACT where the standard deviation exceeds that
            eighth.
        """
        (group, dwell), doppler = self.group(signal.data), self._doppler(signal.data, doppler_hz)
        found = minimum_entropy_velocity(group, doppler, dwell, self.reach_m_s, self.tolerance_m_s, assess=self.assess)
        return replace(found, info={**found.info, "group_start": group.start})

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
        (group, dwell), doppler = self.group(signal.data), self._doppler(signal.data, doppler_hz)
        blocks = velocity_objective(group, doppler, dwell)
        return torch.stack([blocks(v.to(doppler).expand(doppler.shape)).sum(-1) for v in velocity_m_s], -1)
