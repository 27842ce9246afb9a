"""Choice of the fastest tile, sub-apertures, kernel and window that meet a wanted error."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch

from torchsar.focus.tiles.expansion import MOMENTS, slopes
from torchsar.focus.tiles.kernels import (
    CROSS_OVERSAMPLING,
    kernel_error,
    rise_for,
    taps_for,
    window_error,
    window_length,
)
from torchsar.focus.tiles.scene import TILES_OF_ZONE, Sampled, Scene, some_of

# Number of pulses in one product of the spreading, by choice. Products of fewer pulses are slow,
# those of more have more zeros.
CHUNK = 64
# Number of pairs of tile and trial whose pixels are formed at once, by choice. It is large enough
# for efficient matrix products, and small enough to limit the memory of each thread and of
# gradients.
GROUP = 16
# number of sub-apertures above which each one is assessed, because the errors of a rough path
# differ between them
_FEW_PARTS = 3


class Unsuitable(ValueError):
    """Tiles do not reach the error in a geometry."""


class Costly(Unsuitable):
    """Tiles cost more than the direct sum."""


@dataclass(frozen=True)
class Choice:
    """Sizes of a tile plan.

    Args:
        width: Pixels of a tile across the range.
        depth: Pixels of a tile along the range.
        parts: Number of sub-apertures.
        order: Highest power of the range coordinate in the expansion, 1 or 2.
        points: Numbers of points of a tile across and along the range between which the weights of
            the pulses are interpolated.
        taps: Width of the kernel over cross range in nodes.
        rise: Samples of either slope of the window over range.
        guard: Share of the band that the slopes of the window may fill.
        oversampling: Fineness of the range profiles relative to the resolution.
        error_db: Predicted error relative to the image of white noise in dB.
        sampling_error: Part of it that kernel, window and weights cause, relative to 1.
    """

    width: int
    depth: int
    parts: int
    order: int
    points: tuple[int, int]
    taps: int
    rise: int
    guard: float
    oversampling: float
    error_db: float
    sampling_error: float


def error_db(scene: Scene, choice: Choice) -> float:
    """Predict the error of an image with these sizes.

    Args:
        scene: Geometry.
        choice: Sizes of tiles and of parts of the aperture.

    Returns:
        Error relative to the image of white noise in dB.
    """
    sizes = choice.width, choice.depth, choice.parts, choice.order
    error = scene.sampled(*sizes, dense=choice.parts > _FEW_PARTS).error
    return 20 * math.log10(math.hypot(error, choice.sampling_error))


def choose(scene: Scene, error_db: float, images: float | None) -> Choice:
    """Choose the cheapest sizes whose predicted error is at most `error_db`.

    Args:
        scene: Geometry.
        error_db: Wanted error relative to the image of white noise in dB, -130 to -20.
        images: Number of images over which the plan and its tables are shared; None for so many
            that neither the plan nor the direct sum counts.

    Returns:
        The sizes.

    Raises:
        Costly: If images by the direct sum take less time.
        Unsuitable: If no sizes meet the error.
    """
    wanted, best, direct_s = 10 ** (error_db / 20), math.inf, direct_seconds(scene)
    # seconds of planning on one core, measured: those of any plan, and those of each attempt
    plan_s, attempt_s = 0.06, 0.012
    images, most_s = (math.inf, math.inf) if images is None else (images, direct_s)
    failed: list[tuple[tuple[int, int, int, int], float]] = []
    # nothing is planned for images that take less time than any plan
    offered = _sizes(scene, error_db, images) if most_s > plan_s / images else []
    least_s, attempts = offered[0][0] if offered else plan_s / images, 0
    for seconds, sizes in offered:
        least_s = seconds + (plan_s + attempts * attempt_s) / images
        if least_s > most_s:
            break
        if any(_hopeless(sizes, *other, wanted) for other in failed):
            continue
        attempts += 1
        sampled = scene.sampled(*sizes)
        if sampled.error < wanted and sizes[2] > _FEW_PARTS:
            sampled = scene.sampled(*sizes, dense=True)
        numbers, errors = zip(*_points(scene, *sizes[:2], wanted), strict=True)
        errors = *errors, scene.raised_error(*sizes[:2])
        error = math.hypot(sampled.error, *errors)
        left = math.sqrt(max(0.0, wanted**2 - error**2))
        turns = scene.node_turns(sizes[0])
        taps = taps_for(0.8 * left, *turns)
        if taps is None:
            best = min(best, error)
        else:
            kernel = kernel_error(taps, *turns)
            # The error of a window is a mean over the places of pixels between its samples. Where
            # the path hardly changes over the pulses, its power can be twice as large.
            found = _choose_slope(scene, sampled, math.sqrt((left**2 - kernel**2) / 2))
            if found is not None:
                slope, window = found
                sampling = math.hypot(kernel, window, *errors)
                reached = 20 * math.log10(math.hypot(sampled.error, sampling))
                return Choice(*sizes, numbers, taps, *slope, reached, sampling)
        failed.append((sizes, sampled.error))
    if least_s > most_s:
        raise Costly(
            f"the direct sum takes about {direct_s / least_s:.2g} of the time of tiles, with their share of a plan for "
            f"images={images:g}"
        )
    reach = f"{20 * math.log10(best):.1f} dB" if best < 1 else "no error below 0 dB"
    raise Unsuitable(
        f"tiles reach {reach} in this geometry, wanted were {error_db:g} dB; admit more, such as "
        f"error_db={error_db + 20:g}, take a finer spacing of the pixels, turn the axes of the grid to the direction "
        f"of the range, or sum directly, which takes about {direct_s:.2g} s for these pulses"
    )


def direct_seconds(scene: Scene) -> float:
    """Estimate the time of an image by the direct sum on one core.

    Args:
        scene: Geometry.

    Returns:
        Time in seconds.
    """
    *_, lit = scene.probed
    pulses = float((lit[..., 1] - lit[..., 0]).clamp_min(0).double().mean())
    # measured per pulse and pixel, for one antenna and for two
    return pulses * math.prod(scene.grid.counts) * (120e-9, 180e-9)[len(scene.places) - 1]


def _points(scene: Scene, width: int, depth: int, wanted: float) -> list[tuple[int, float]]:
    """Number of points of a tile between which weights are interpolated, and their error, for each
    axis.

    The error takes at most half of the wanted error power, by choice.
    """
    return [scene.points(axis, size, wanted / 2) for axis, size in enumerate((width, depth))]


def _choose_slope(scene: Scene, sampled: Sampled, error: float) -> tuple[tuple[int, float, float], float] | None:
    """Choose the window for a wanted error: slope in samples, guard share of the band, and
    oversampling.

    Also returns the error that the window has. The result is None if no window is suitable.
    """
    found, cells, (low, carrier, high) = [], 24, scene.waves
    # A stretched pulse moves the carrier to k / (1 + eps), see expansion.py; a tenth more than in
    # the sampled pulses is admitted.
    most = 1.1 * float((1 / (1 + sampled.stretch) - 1).abs().max())
    for oversampling in (1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0):
        if found and oversampling * cells > min(found)[0]:
            break  # no slope is short enough
        per_metre = scene.samples_per_metre(oversampling)
        # The guard is the share of the sampled band that stays empty even for the most stretched
        # pulse. It is rounded down to 1/64, so that similar scenes share one tabulated window.
        share = 1 - (max(high - carrier, carrier - low) + carrier * most) / (math.pi * per_metre)
        guard, turns = math.floor(64 * share) / 64, scene.sample_turns(oversampling, sampled.stretch)
        away, reach = sampled.away_m * per_metre, sampled.reach_m * per_metre
        rise = rise_for(error, guard, turns, away, reach)
        if rise is not None:
            remaining = window_error(rise, guard, turns, away, reach)
            found.append((oversampling * cells + rise, (rise, guard, oversampling), remaining))
    return min(found)[1:] if found else None


def _hopeless(sizes: tuple[int, int, int, int], other: tuple[int, int, int, int], error: float, wanted: float) -> bool:
    """True if sizes cannot meet the error, because another choice failed by more than they could
    gain.

    Halving a side or doubling the number of sub-apertures gains 24 dB at most.
    """
    gain = sum(max(0.0, math.log2(b / a)) for a, b in zip(sizes[:2], other[:2], strict=True))
    gain += max(0.0, math.log2(sizes[2] / other[2]))
    return sizes[3] == other[3] and not error * 10 ** (-24 * gain / 20) <= wanted


def _sizes(scene: Scene, error_db: float, images: float) -> list[tuple[float, tuple[int, int, int, int]]]:
    """Estimated computing time of an image in s and sizes (width, depth, parts, order) of tiles,
    ordered by the time.

    The time follows from the slopes of the path at pixels that most pulses light. The kernel and
    the window are those for half of the error, which is usual. The factors in ns were fitted to the
    times of 13 plans on one core. They apply per sample of a window or of its spectrum, per flop of
    a product, per element of the expansion, and per tile. Small images take more, because of the
    calls of each group of tiles, and the first image computes tables and matrices.
    """
    grid, (low, _, high) = scene.grid, scene.waves
    usual, per_metre, share = (
        torch.linspace(-0.5, 0.5, 33, dtype=torch.float64),
        1.5 * (high - low) / (2 * math.pi),
        0.5 * 10 ** (error_db / 20),
    )
    rise = rise_for(share, 20 / 64, usual / 1.5, usual * 24, 12) or 24
    points, (first, last) = scene.longest
    some = [v[some_of(first, last, 512)] for v in scene.places]
    _, a, b = slopes(some, points, grid.axes)
    s = a * (b[:, len(some[0]) // 2, None] / b)
    turns = float((s.amax(-1) - s.amin(-1)).max()) * high * grid.step_m * CROSS_OVERSAMPLING / (2 * math.pi)
    pulses = last - first
    numbers = [2**k for k in range(int(math.log2(max(1, pulses // 2))) + 1)]
    widths, depths = (
        [size for size in sizes if size < 2 * n or size == sizes[0]]
        for sizes, n in zip(((8, 16, 32, 64, 128), (4, 8, 16, 32, 64, 128)), grid.counts, strict=True)
    )
    found = []
    for width, depth in itertools.product(widths, depths):
        x, y, taps = width * grid.step_m / 2, depth * grid.step_m / 2, taps_for(share, *scene.node_turns(width)) or 12
        bend = scene.bend * (x + y) ** 2 / 2 + 2 * scene.relief(width, depth)[1]
        reach = (float((a.abs() * x + b.abs() * y).max()) + bend) * per_metre
        if not 2 * reach + 1 <= 4096:
            continue  # longer windows take too much memory
        length, samples = window_length(reach, rise), 2 * reach + 1 + 2 * rise
        (across, _), (along, _) = _points(scene, width, depth, 10 ** (error_db / 20))
        tiles = -(-grid.counts[0] // width) * -(-grid.counts[1] // depth)
        for parts, order in itertools.product(numbers, (1, 2)):
            nodes = turns * width / parts + taps + 1
            flops = 4 * tiles * pulses * (taps + CHUNK * nodes / max(1, pulses / parts)) * length * across * along
            flops += 8 * parts * tiles * length * width * (MOMENTS * nodes * across + (order + 1) * depth) * along
            time = tiles * pulses * (samples + length) * 4.4 + flops * 0.0142
            time += parts * tiles * (length * width * MOMENTS * (order + 1) * 2.1 + 3000)
            calls = parts * math.ceil(tiles / GROUP) * across * along
            image_s, tables_s = 2e-9 * time + 1.5e-3 * calls, 3e-9 * time + 5e-3 * calls
            # matrices that all tiles of a zone share
            tables_s += 30e-9 * parts * math.ceil(tiles / TILES_OF_ZONE) * MOMENTS * length * width * nodes * across
            found.append((image_s + tables_s / images, (width, depth, parts, order)))
    return sorted(found)
