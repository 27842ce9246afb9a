"""Effective velocity by minimum entropy of a small group of range cells (Tsvetkov 2017).

The group is always focused from the original data: its two-dimensional spectrum is formed once and
focused anew for every velocity. The objective is the mean entropy of blocks of range cells, each
block taken separately, so that a few very bright ships do not dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

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
    entropy_parts,
    pick_group,
)
from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    fft_lines,
    host_value,
    per_trial,
    settle,
    take,
    unit_level,
)
from torchsar.optim.scalar import grid_minimum, parabola_minimum
from torchsar.radar import StripmapRadar

Refine = Callable[..., tuple[Tensor, Tensor]]

# Variance of the entropy of n independent pixels of pure noise, times n: with the exponential
# distribution of their intensity, 0.290.
_NOISE_ENTROPY = 0.29
# Depth of a significant minimum in standard deviations of noise. On noise and on clutter that fills
# the Doppler band evenly the depth is below 5; 20 dB above the noise it is above 100.
_LEAST_DEPTH = 8.0
# Distances from the minimum at which its depth is measured, in steps of the grid. The second pair
# counts where the minimum reaches to the first, because the targets are seen for a short time.
_DISTANCES = (2.0, 8.0)
# Error that remains without noise: the spectrum of a short chirp is not that of the stationary
# phase. It is a share of width^2 / velocity, or of the same with the step of the grid as the width.
# Measured at time-bandwidth products of 19 to 374.
_REST, _REST_STEP = 0.45, 0.11
# Largest standard deviation of an estimate that is ok, over the width of the minimum: an eighth
# of a cycle of phase at the ends of the aperture.
_MOST_WIDTHS = 0.27
_COMBS = 4  # interleaved sets of Doppler rows, of independent noise, for the standard deviation
_PARTS = 8  # parts of the image along azimuth, for the standard deviation
# The refinement stops at this share of the step of the grid, a sixth of the half width of the last
# parabola. With half of that half width, estimates in speckle were displaced by 0.02 m/s.
_STEP_SHARE = 60
_GRID = 16  # largest number of steps of the grid search to either side


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
    weight, _, _ = _nominal(spectrum, doppler_hz, dwell_s)
    return _objective(spectrum, doppler_hz, weight)


@torch.no_grad()
def _nominal(spectrum: BeamSpectrum, doppler_hz: Tensor, dwell_s: float) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of the blocks (..., block), entropy (...,), and the standard deviation (...,) that it
    has if the image is noise, from the image of the nominal velocity.
    """
    radar = spectrum.group.radar
    image = spectrum.image(doppler_hz, radar.velocity_m_s)
    weight = block_weights(image, radar, doppler_hz, dwell_s)
    return weight, (block_entropy(image) * weight).sum(-1), _noise_std(image, weight)


def _objective(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor) -> Callable[[Tensor], Tensor]:
    """Function of the velocity (...,) that returns the weighted entropies (..., block)."""

    def blocks(velocity_m_s: Tensor) -> Tensor:
        return block_entropy(spectrum.image(doppler_hz, velocity_m_s)) * weight

    return blocks


class _Parts(NamedTuple):
    """Entropies of parts of an image, each times the weight of its block.

    The image has twice as many azimuth samples as the spectrum has rows. The entropy of an image of
    one sample per resolution cell changes with the place of a target between two samples, and a
    wrong velocity moves targets.

    Args:
        summands: What parts along azimuth add to the entropies of the blocks, (..., block, part).
        shares: Their shares of the energy, (..., block, part).
        combs: Entropies of the images of interleaved sets of Doppler rows, (..., comb).
        whole: Function that returns the entropy of the image of as many azimuth samples as rows,
            (...,).
    """

    summands: Tensor
    shares: Tensor
    combs: Tensor
    whole: Callable[[], Tensor]


def _parts(spectrum: BeamSpectrum, doppler_hz: Tensor, weight: Tensor, velocity_m_s: Tensor) -> _Parts:
    """Entropies of the parts of the image that belongs to a velocity (...,)."""
    rows = spectrum.rows(doppler_hz, velocity_m_s)
    count = rows.shape[-2]
    image = fft_lines(rows, inverse=True, n=2 * count)
    entropy, share = entropy_parts(image, _PARTS)

    def whole() -> Tensor:
        return (block_entropy(image[..., ::2, :]) * weight).sum(-1)

    sets = [rows[..., first::_COMBS, :] for first in range(min(_COMBS, count))]
    combs = [(block_entropy(fft_lines(part, inverse=True)) * weight).sum(-1) for part in sets]
    return _Parts(entropy * weight[..., None], share * weight[..., None], torch.stack(combs, -1), whole)


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


class VelocityMinimum(NamedTuple):
    """Velocity of least entropy.

    Args:
        velocity_m_s: The velocity in m/s, shape (...,).
        std_m_s: Its predicted standard deviation in m/s, shape (...,).
        most_m_s: Standard deviation in m/s with which an eighth of a cycle of phase remains at the
            ends of the aperture, shape (...,).
        clear: Whether the minimum is that of a focused image, bool (...,).
        grid_m_s: Velocities of the grid search in m/s, shape (grid,).
        grid_entropy: Their entropies in nats, shape (..., grid).
    """

    velocity_m_s: Tensor
    std_m_s: Tensor
    most_m_s: Tensor
    clear: Tensor
    grid_m_s: Tensor
    grid_entropy: Tensor


def minimum_entropy_velocity(
    group: RangeGroup, doppler_hz: Tensor, dwell_s: float, reach_m_s: float, refine: Refine, tolerance_m_s: float
) -> VelocityMinimum:
    """Find the velocity of least entropy: a grid search, a refinement, and a parabola.

    The grid has steps of `grid_step_m_s`. Where that would be more than 33 velocities, only the
    middle of the Doppler band is focused at first, with fewer and wider steps. Then the band is
    doubled, and velocities about the best one are searched, until the band is whole.

    The refinement starts at the vertex of a parabola through the best velocity of the grid and its
    neighbours, and stops at a sixtieth of the step of the grid or at `tolerance_m_s`, whichever is
    larger. The result is the vertex of a parabola through entropies of images with twice as many
    azimuth samples, a tenth of a step to either side.

    The depth of the minimum is measured against velocities 2 steps away, or 8 steps where that
    shows a minimum of more than half this distance. Its width is that of a parabola with this depth
    and with the curvature at the minimum. Neither depends on `reach_m_s`.

    The standard deviation has three parts. The first follows from the parts of the image, blocks of
    range cells times eight parts along azimuth: the slopes of their entropies at the minimum,
    divided by the curvature of the whole entropy. The second follows in the same way from four
    interleaved sets of Doppler rows, whose noise is independent also where one target dominates;
    the larger of both counts. The third is what remains without noise, 0.45 width^2 / velocity
    or 0.11 step^2 / velocity, whichever is larger.

    Args:
        group: Group of range cells.
        doppler_hz: Absolute Doppler centroid in Hz, shape (...,), positive when closing.
        dwell_s: Time that a target stays in the beam, in seconds.
        reach_m_s: Half width of the search about the nominal velocity of the radar, in m/s; at most
            half the nominal velocity is searched.
        refine: `parabola_minimum` or `gradient_minimum` of `torchsar.optim.scalar`.
        tolerance_m_s: Tolerance of the refinement in m/s.

    Returns:
        The minimum. It is clear where it is not at an end of the searched interval, its depth is 8
        standard deviations of the entropy of noise or more (noise that has the powers and
        correlations of the range cells), and the record is not shorter than the
        dwell of the beam, if that is known: in a shorter record every target is cut, differently,
        and the standard deviation does not hold. `most_m_s` is an eighth of
        `grid_step_m_s` or, if the dwell of the beam is not known (`integration_s` of the radar), of
        the step that belongs to the width of the minimum.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no trials or no samples, or a sample is not finite.
    """
    lines = checked_samples(group.data, "minimum_entropy_velocity", "pulse, range", empty=False)
    group = RangeGroup(unit_level(lines), group.start, group.radar)
    spectrum, nominal = beam_spectrum(group, doppler_hz), group.radar.velocity_m_s
    weight, cost, noise_std = _nominal(spectrum, doppler_hz, dwell_s)
    blocks = _objective(spectrum, doppler_hz, weight)

    def whole(velocity_m_s: Tensor) -> Tensor:
        return blocks(velocity_m_s).sum(-1)

    full_step = grid_step_m_s(group.radar, float(group.radar.near_range_m), dwell_s)
    start = torch.full(doppler_hz.shape, nominal, dtype=torch.float64, device=doppler_hz.device)
    reach = min(reach_m_s, nominal / 2)
    grid = _search(spectrum, doppler_hz, weight, start, cost, reach, full_step)
    tolerance = max(tolerance_m_s, full_step / _STEP_SHARE)
    value = grid.vertex_m_s
    if grid.near_m_s > tolerance:
        value, _ = refine(whole, value, grid.near_m_s, tolerance)
    value, _ = settle(value, nominal)
    with torch.no_grad():
        half = min(full_step, nominal / 2) / 10
        low, middle, high = (_parts(spectrum, doppler_hz, weight, value + side * half) for side in (-1, 0, 1))
        curvature = (low.summands - 2 * middle.summands + high.summands).sum((-2, -1)) / half**2
        # without the energy that moves from one part to another, which changes no entropy by itself
        level = middle.summands.sum(-1, keepdim=True) / middle.shares.sum(-1, keepdim=True).clamp_min(1e-300)
        slope = (high.summands - low.summands - level * (high.shares - low.shares)) / (2 * half)
        # the step to the vertex of the parabola, at most to its ends
        value = value - (_over(slope.sum((-2, -1)), curvature)).clamp(-half, half)
        depth, width = _depth(whole, value, middle.whole(), curvature, min(full_step, nominal / 18))
        scatter = torch.maximum(
            _over(slope.flatten(-2).square().sum(-1).sqrt(), curvature),
            _comb_std(low.combs, middle.combs, high.combs, half),
        )
        rest = (_REST * width.square()).clamp_min(_REST_STEP * full_step**2) / nominal
        std = torch.hypot(scatter, rest).clamp_max(1e6)
        known = group.radar.integration_s
        most = _MOST_WIDTHS * width if known is None else full_step / 8
        clear = grid.inside & (curvature > 0) & (depth > _LEAST_DEPTH * noise_std)
        if known is not None and lines.shape[-2] < known * group.radar.prf_hz:
            clear = torch.zeros_like(clear)
    points = nominal + torch.linspace(-reach, reach, grid.costs.shape[-1], dtype=torch.float64, device=start.device)
    return VelocityMinimum(value, std, per_trial(most, 0, std).expand(std.shape), clear, points, grid.costs)


class _Grid(NamedTuple):
    """Result of the grid search.

    Args:
        vertex_m_s: Vertex of the parabola through the best velocity and its neighbours, or the best
            velocity where it has only one neighbour, (...,).
        near_m_s: Half width about the vertex for its refinement.
        inside: Whether the best velocity of the first grid is not at an end, (...,).
        costs: Entropies of the first grid, (..., grid).
    """

    vertex_m_s: Tensor
    near_m_s: float
    inside: Tensor
    costs: Tensor


def _search(
    spectrum: BeamSpectrum,
    doppler_hz: Tensor,
    weight: Tensor,
    start: Tensor,
    cost: Tensor,
    reach: float,
    full_step: float,
) -> _Grid:
    """Search the whole band; first its middle, with few and wide steps, where it has many.

    cost: Entropy of the image of the whole band at the start, (...,).
    """
    share, value, first = min(1.0, math.sqrt(_GRID * full_step / reach)), start, None
    while True:
        blocks = _objective(_middle_rows(spectrum, share), doppler_hz, weight)
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
    bend = low - 2 * middle + high
    bent = (best > 0) & (best < count - 1) & (bend > 0)
    vertex = torch.where(bent, value + 0.5 * step * (low - high) / torch.where(bent, bend, 1), value)
    best = first.argmin(-1)
    return _Grid(vertex, step / 4, (best > 0) & (best < first.shape[-1] - 1), first)


def _middle_rows(spectrum: BeamSpectrum, share: float) -> BeamSpectrum:
    """A share of the rows in the middle of the Doppler band, but at least 64."""
    count = spectrum.data.shape[-2]
    rows = min(count, max(64, round(share * count)))
    part = slice((count - rows) // 2, (count - rows) // 2 + rows)
    return replace(spectrum, data=spectrum.data[..., part, :], doppler_hz=spectrum.doppler_hz[..., part])


def _depth(
    cost: Callable[[Tensor], Tensor], value: Tensor, least: Tensor, curvature: Tensor, step: float
) -> tuple[Tensor, Tensor]:
    """Depth of the minimum in nats and its width in m/s, (...,) each.

    least: Entropy at the minimum, (...,).
    """
    near, far = _DISTANCES

    def measured(distance: float) -> tuple[Tensor, Tensor]:
        beside = 0.5 * (cost(value - distance * step) + cost(value + distance * step)) - least
        return beside, _over(2 * beside.clamp_min(0), curvature).sqrt()

    depth, width = measured(near)
    wide = width > near * step / 2
    if not host_value(wide.any(), True):
        return depth, width
    far_depth, far_width = measured(far)
    return torch.where(wide, far_depth, depth), torch.where(wide, far_width, width)


def _over(value: Tensor, curvature: Tensor) -> Tensor:
    """Quotient, 1e6 at most and where the curvature is not positive."""
    good = curvature > 0
    return torch.where(good, value / torch.where(good, curvature, 1), 1e6).clamp_max(1e6)


def _noise_std(image: Tensor, weight: Tensor) -> Tensor:
    """Standard deviation (...,) in nats of the weighted entropy of an image (..., azimuth, range)
    of noise that has the powers and the correlations of the image's range cells.

    Cells of equal power without correlation have the variance 0.29 / number of pixels. In general,
    the squared elements of the covariance between cells take the place of 1 / number of cells.
    """
    n, parts = image.shape[-2], image.tensor_split(weight.shape[-1], -1)
    norms = [torch.linalg.vector_norm(part, dim=(-2, -1)).clamp_min(1e-30) for part in parts]
    scale = weight.sqrt() / torch.stack(norms, -1)
    scaled = [part * share[..., None, None] for part, share in zip(parts, scale.to(norms[0]).unbind(-1), strict=True)]
    lines = torch.cat(scaled, -1)
    squares = torch.linalg.vector_norm(lines.mH @ lines, dim=(-2, -1)).square().to(torch.float64)
    # less what independent cells contribute because the number of pixels is finite
    return (_NOISE_ENTROPY / n * (squares - 1 / n).clamp_min(1 / image.shape[-1])).sqrt()


def _comb_std(low: Tensor, middle: Tensor, high: Tensor, half: float) -> Tensor:
    """Standard deviation (...,) in m/s from the slopes of interleaved sets of Doppler rows.

    low, middle, high: Entropies of the sets (..., comb) at three velocities, `half` m/s apart.
    """
    if middle.shape[-1] < _COMBS:
        return torch.full_like(middle[..., 0], 1e6)
    curvature = (low - 2 * middle + high).mean(-1) / half**2
    return _over(((high - low) / (2 * half)).std(-1) / math.sqrt(_COMBS), curvature)


class EffectiveVelocity(Stage):
    """Effective velocity of least image entropy.

    Provides `velocity_m_s` and leaves the signal unchanged. In a chain, connect `doppler_hz` to the
    stage that estimates the absolute Doppler centroid. Only lines about the middle of the record
    are used: as many as four synthetic apertures, or 1024 if that is more.

    Args:
        focuser: Focusing stage of the chain, whose radar and range reference spectrum are used.
        reach_m_s: Largest error of the nominal velocity in m/s.
        lines: Number of range cells that are used, at least 16.
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
        refine: Refine = parabola_minimum,
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
            interval, where its minimum is not deep enough for a focused image, and where the record
            is shorter than the dwell of the beam: see `minimum_entropy_velocity`. Clutter that
            fills the Doppler band evenly has no image that is sharper than others, so that `ok` is
            False. info: grid_velocity_m_s, the velocities of the first grid search, shape (grid,);
            grid_entropy, their entropies in nats, shape (..., grid); and group_start, the first
            range sample of the group of range cells used, shape (...,).
        """
        raw = signal.data.detach()
        group, dwell = self.group(raw)
        found = minimum_entropy_velocity(
            group, self._doppler(raw, doppler_hz), dwell, self.reach_m_s, self.refine, self.tolerance_m_s
        )
        return Estimate(
            {"velocity_m_s": found.velocity_m_s},
            {"velocity_m_s": found.std_m_s},
            torch.exp(-found.std_m_s / found.most_m_s.clamp_min(1e-12)),
            Outcome.of(found.clear & (found.std_m_s < found.most_m_s), Outcome.NOISE),
            info={"grid_velocity_m_s": found.grid_m_s, "grid_entropy": found.grid_entropy, "group_start": group.start},
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
