"""The ground that autofocus images along a path, and estimates of single trials."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import without_line
from torchsar.core import Estimate
from torchsar.focus import ImageGrid, TileOperator, TilePlan
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.spotlight import frequency_step_hz

# pixel spacing in resolution cells, by choice: images are sampled above their bandwidth
STEP = 0.7
# the same where the scene is fitted to the samples, by choice: two in a resolution cell
FINE_STEP = 0.5
# error of the images in dB, by choice: far below what noise and side lobes leave
_ERROR_DB = -40.0


def trials_of(name: str, profiles: Tensor, frequency_hz: Tensor, antennas: AntennaPath) -> torch.Size:
    """Return the leading dimensions of profiles and paths.

    Args:
        name: Name of the calling function, for the message.
        profiles: Range profiles, shape (..., pulse, range).
        frequency_hz: Frequencies in Hz, shape (range,).
        antennas: Recorded path.

    Returns:
        The leading dimensions to which they broadcast.

    Raises:
        ValueError: If the sizes do not match.
    """
    size = antennas.pulses, len(frequency_hz)
    if profiles.shape[-2:] != size:
        raise ValueError(f"{name} needs profiles (..., pulse, range) of {size}, got {tuple(profiles.shape)}")
    return torch.broadcast_shapes(profiles.shape[:-2], antennas.trials)


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
    data = profiles.expand(*trials, *profiles.shape[-2:])
    every = itertools.product(*map(range, trials))
    found = [find(data[index], antennas.of_trial(index, trials)) for index in every]

    def joined(parts: list[Tensor]) -> Tensor:
        return torch.stack(parts).reshape((*trials, *parts[0].shape))

    def table(name: str) -> dict[str, Tensor]:
        return {key: joined([getattr(one, name)[key] for one in found]) for key in getattr(found[0], name)}

    quality, outcome = (joined([getattr(one, name) for one in found]) for name in ("quality", "outcome"))
    return Estimate(table("value"), table("std"), quality, outcome, table("info"))


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
    """Put values of the pulses that are present at their places among all, with zeros elsewhere.

    Args:
        x: Values, (n,).
        present: True for the pulses that are present, (pulse,), of which n are.

    Returns:
        Values of all pulses, (pulse,).
    """
    return x.new_zeros(len(present)).masked_scatter(present, x)


def sights(antennas: AntennaPath, height_m: float = 0.0) -> Tensor:
    """Return the direction in which positions lengthen half the path over the middle of the scene.

    Args:
        antennas: Path.
        height_m: Height z of the middle in metres.

    Returns:
        Gradient of half the path by the position of the antennas, which move together, (..., pulse,
        3); a unit vector if they share one place.
    """
    middle = antennas.transmitter_m.new_tensor([0.0, 0.0, height_m])
    ways = [place - middle for place in antennas.places]
    units = [way / torch.linalg.vector_norm(way, dim=-1, keepdim=True) for way in ways]
    return torch.stack(torch.broadcast_tensors(*units)).mean(0)


def ground_image(
    frequency_hz: Tensor, antennas: AntennaPath, height_m: float, extent_m: float | None = None, step: float = STEP
) -> TileOperator:
    """Return the image of the ground about the origin, for one path.

    Its second axis is that of the range.

    Args:
        frequency_hz: Frequencies in Hz, float64 (range,).
        antennas: Path of one trial.
        height_m: Height z of the ground in metres.
        extent_m: Side of the imaged square in metres; None for all of the unambiguous ground.
        step: Spacing of the pixels in resolution cells.

    Returns:
        Image formation of range profiles, with its adjoint.

    Raises:
        ValueError: If the line of sight does not turn over the ground.
    """
    middle = torch.zeros(3, dtype=torch.float64, device=frequency_hz.device)
    middle[2] = height_m
    with torch.no_grad():
        slope = -2 * sights(antennas, height_m)[:, :2]  # change of the path per metre, (pulse, 2)
        away = slope.mean(0)
        steep = float(torch.linalg.vector_norm(away))
        across = torch.stack([-away[1], away[0]]) / max(steep, 1e-300)
        turn = slope @ across
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
    axes = torch.zeros(2, 3, dtype=torch.float64, device=frequency_hz.device)
    axes[0, :2], axes[1, :2] = across, away / steep
    corner = middle - spacing * sum(n // 2 * axis for n, axis in zip(counts, axes, strict=True))
    grid = ImageGrid(corner, axes, (counts[0], counts[1]), spacing)
    places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
    return TileOperator(TilePlan(frequency_hz, *places, grid, _ERROR_DB))
