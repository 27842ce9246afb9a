"""The ground that autofocus images along a path, and the joining of estimates of single trials."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils._pytree import tree_map

from torchsar.compensate.pulse_phase.data import without_line
from torchsar.core import Estimate, Outcome, checked_samples
from torchsar.focus import ImageGrid, TilePlan
from torchsar.focus.tile_operator import TileOperator
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.antenna_path import refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz

# pixel spacing in resolution cells where the scene is fitted to the samples, by choice
FINE_STEP = 0.5
# error of the images in dB, by choice, far below noise and side lobes
ERROR_DB = -40.0


def trials_of(name: str, profiles: Tensor, frequency_hz: Tensor, antennas: AntennaPath) -> torch.Size:
    """Check range profiles and their path, and return their leading dimensions.

    Args:
        name: Name of the calling function, for the message.
        profiles: Range profiles, shape (..., pulse, range), complex.
        frequency_hz: Frequencies in Hz, float64 (range,).
        antennas: Recorded path.

    Returns:
        The leading dimensions to which they broadcast.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If values are not finite, or the sizes do not match.
    """
    checked_samples(profiles, name, "pulse, range")
    refuse_unusable(frequency_hz=frequency_hz)
    size = antennas.pulses, len(frequency_hz)
    if profiles.shape[-2:] != size:
        raise ValueError(f"{name} needs profiles (..., pulse, range) of {size}, got {tuple(profiles.shape)}")
    return torch.Size(np.broadcast_shapes(profiles.shape[:-2], antennas.trials))


def nothing(present: Tensor, info: dict[str, float], outcome: Outcome | None) -> Estimate:
    """Return the estimate of a trial in which nothing is found.

    Args:
        present: Tensor of the shape (pulse,).
        info: Numbers of the trial.
        outcome: Why there is nothing; None without assessment.

    Returns:
        Estimate of no errors.
    """
    zero = torch.zeros(len(present), dtype=torch.float64, device=present.device)
    value = {"line_of_sight_m": zero, "offset_m": zero[:, None].expand(-1, 3)}
    numbers = {name: zero.new_tensor(number) for name, number in info.items()}
    if outcome is None:
        return Estimate(value, quality=zero.new_ones(()), info=numbers)
    none = zero.new_zeros(())
    return Estimate(value, {"line_of_sight_m": zero + 1}, none, outcome.like(none), numbers)


def for_each(
    find: Callable[[Tensor, AntennaPath], Estimate], profiles: Tensor, antennas: AntennaPath, trials: torch.Size
) -> Estimate:
    """Join the estimates of single trials.

    Trials are processed one after another, because each has an image plan of its own.

    Args:
        find: Estimator of one trial, given its profiles (pulse, range) and its path.
        profiles: Range profiles, shape (..., pulse, range).
        antennas: Paths.
        trials: Leading dimensions of the result.

    Returns:
        Estimate of all trials, with the leading dimensions.
    """
    data, every = profiles.expand(*trials, *profiles.shape[-2:]), itertools.product(*map(range, trials))
    found = [find(data[index], antennas.of_trial(index, trials)) for index in every]
    return tree_map(lambda *parts: torch.stack(parts).reshape((*trials, *parts[0].shape)), *found)


def corrected(antennas: AntennaPath, offset_m: Tensor) -> AntennaPath:
    """Subtract the errors of the positions from a recorded path.

    Args:
        antennas: Recorded path.
        offset_m: Errors in metres, recorded minus true, of both antennas alike, (..., pulse, 3).

    Returns:
        The path without these errors.
    """
    receiver = None if antennas.receiver_m is None else antennas.receiver_m - offset_m
    return AntennaPath(antennas.transmitter_m - offset_m, receiver, antennas.reference_m)


def line_free(range_m: Tensor, present: Tensor) -> Tensor:
    """Subtract the line in time that fits ranges of the pulses that are present best.

    Args:
        range_m: Ranges of these pulses in metres, float64 (n,).
        present: True for the pulses that are present, (pulse,), of which n are.

    Returns:
        Ranges without constant and linear terms, (n,).
    """
    return without_line(placed(range_m, present), present)[present]


def placed(x: Tensor, present: Tensor) -> Tensor:
    """Put values of the pulses that are present at their positions among all pulses, with zeros
    elsewhere.

    Args:
        x: Values, (n,).
        present: True for the pulses that are present, (pulse,), of which n are.

    Returns:
        Values of all pulses, (pulse,).
    """
    return x.new_zeros(len(present)).masked_scatter(present, x)


def slope(places: Sequence[Tensor], points_m: Tensor) -> Tensor:
    """Return the derivative of half the path with respect to the position of the antennas.

    Args:
        places: Positions of one or both antennas, which move together, in metres, (..., 3).
        points_m: Points in metres, (..., 3).

    Returns:
        Gradient of half the path, (..., 3); a unit vector if both share one place.
    """
    units = [normalize(place - points_m, dim=-1, eps=0.0) for place in places]
    return torch.stack(torch.broadcast_tensors(*units)).mean(0)


def ground_image(
    frequency_hz: Tensor, antennas: AntennaPath, height_m: float, extent_m: float | None = None, step: float = 0.7
) -> TileOperator:
    """Return the operator that images the ground around the origin, for one path. The second axis
    of the image is that of the range.

    Args:
        frequency_hz: Frequencies in Hz, float64 (range,).
        antennas: Path of one trial.
        height_m: Height z of the ground in metres.
        extent_m: Side of the imaged square in metres; None for all of the unambiguous ground.
        step: Spacing of the pixels in resolution cells, by default finer than the bandwidth needs.

    Returns:
        Image formation of range profiles, with its adjoint.

    Raises:
        ValueError: If the line of sight does not turn over the ground.
    """
    middle = torch.tensor([0.0, 0.0, height_m], dtype=torch.float64, device=frequency_hz.device)
    with torch.no_grad():
        # change of the path per metre of a position on the ground, (pulse, 2)
        by_place = -2 * slope(antennas.places, middle)[:, :2]
        away = by_place.mean(0)
        steep = float(torch.linalg.vector_norm(away))
        across = torch.stack([-away[1], away[0]]) / max(steep, 1e-300)
        turn = by_place @ across
        span, per_pulse = float(turn.max() - turn.min()), float(turn.diff().abs().mean())
    band = float(frequency_hz[-1] - frequency_hz[0])
    wavelength = LIGHT_M_S / float(frequency_hz.mean())
    if not (span > 0 and steep > 0):
        raise ValueError("autofocus of a path needs a line of sight that turns over the ground; the path has none")
    extent = wavelength / per_pulse, LIGHT_M_S / (frequency_step_hz(frequency_hz) * steep)
    if extent_m is not None:
        extent = min(extent[0], extent_m), min(extent[1], extent_m)
    spacing = step * min(wavelength / span, LIGHT_M_S / (band * steep))
    counts = tuple(max(2, math.ceil(x / spacing)) for x in extent)
    axes = torch.nn.functional.pad(torch.stack([across, away / steep]), (0, 1))
    corner = middle - spacing * sum(n // 2 * axis for n, axis in zip(counts, axes, strict=True))
    grid = ImageGrid(corner, axes, (counts[0], counts[1]), spacing)
    places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
    return TileOperator(TilePlan(frequency_hz, *places, grid, ERROR_DB, images=None))
