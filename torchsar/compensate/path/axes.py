"""Three axes of the position error, from the phases of the parts of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.path.ground import line_free, sights
from torchsar.compensate.pulse_phase.data import or_one, safe_angle
from torchsar.compensate.pulse_phase.sharpen import Wiener
from torchsar.core import cis
from torchsar.focus import TileOperator
from torchsar.radar import LIGHT_M_S, AntennaPath

# blocks of the image along either axis, by choice: several scatterers in each, yet blocks so far
# apart that errors across the line of sight act differently on them
_BLOCKS = 3
# steps that fit the scene to the samples, and share of the residual energy that a step may leave
# to be kept, by trial: begun at the true path, errors at 20 dB were 7 times the bound with 6 and
# 0.8, and 1.4 times with these, and no larger at -5 dB
_FITS, _WORTH = 20, 0.97
# share of the mean power of the blocks that is added as a ridge, so that empty blocks get no gain
_RIDGE = 1e-3
# neighbourhood over which the spectrum of the motion is averaged: share of the number of the
# coefficient, plus a number of coefficients
_WIDE, _LEAST_WIDE = 0.25, 2
# lowest coefficients, of the constant and the linear term, which are not observable
_UNSEEN = 2


def wiener(power: Tensor, mean: Tensor) -> Tensor:
    """Weigh the cells of an image (..., azimuth, range) by a Wiener estimate, see `Wiener`.

    Args:
        power: Power of the cells.
        mean: Its mean over the image.

    Returns:
        Weights 0..1, without the subtracted mean of `Wiener`.
    """
    pairs = power + power.roll(1, -1)
    local = pairs + pairs.roll(-1, -1)
    share = local / (local + 4 * Wiener().level * mean)
    return share * share


@dataclass(frozen=True, eq=False)
class Found:
    """Errors of the positions of one trial.

    Args:
        line_of_sight_m: Half the path over the middle of the scene in metres, recorded minus true,
            float64 (pulse,).
        offset_m: Error of the positions in metres, recorded minus true, float64 (pulse, 3).
        std_m: Standard deviation of the line of sight in metres, float64 (pulse,).
        image: Image with the errors removed, complex (azimuth, range).
    """

    line_of_sight_m: Tensor
    offset_m: Tensor
    std_m: Tensor
    image: Tensor


def three_axes(rows: Tensor, imaging: TileOperator, line_of_sight_m: Tensor, present: Tensor, rounds: int = 4) -> Found:
    """Refine the line of sight, and find the errors across it, by phases of blocks of the image.

    An error across the line of sight acts with opposite signs on the two sides of a scene. In each
    round the phase of every pulse is measured in each of nine blocks, against a Wiener estimate of
    the scene; least squares fit three axes to the phases of each pulse, with a ridge for the two
    across: their expected spectrum is that of the motion along the line of sight. What the Wiener
    estimate leaves of the samples is taken as noise, from which the standard deviation follows.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the recorded path.
        line_of_sight_m: Recorded minus true half path in metres as found so far, float64 (pulse,).
        present: True for the pulses of the profiles among all pulses.
        rounds: Rounds of measurement and correction, at least 1.

    Returns:
        The errors.
    """
    plan = imaging.plan
    antennas = plan.antennas
    height = float(plan.grid.origin_m[2])
    axes = _axes(antennas, height)
    motion = torch.nn.functional.pad(line_of_sight_m[:, None], (0, 2))
    masks = _masks(plan.grid.counts, rows.device)
    radians = 4 * math.pi * float(plan.frequency_hz.mean()) / LIGHT_M_S
    std = torch.zeros_like(line_of_sight_m)
    for _ in range(rounds):
        offset = (motion[:, None] @ axes)[:, 0]
        operator = _along(imaging, offset)
        angles, information, places = _measured(rows, operator, masks)
        lever = _levers(operator.plan.antennas, places, axes).movedim(0, 1)
        step, std = _fitted(angles / radians, information * radians**2, lever, motion)
        motion = motion + step
        motion[:, 0] = line_free(motion[:, 0], present)
    offset = (motion[:, None] @ axes)[:, 0]
    return Found(motion[:, 0], offset, std, _along(imaging, offset).image(rows[None])[0])


def _along(imaging: TileOperator, offset_m: Tensor) -> TileOperator:
    """Image formation along the recorded path less its errors."""
    recorded = imaging.plan.antennas
    receiver = None if recorded.receiver_m is None else recorded.receiver_m - offset_m
    return TileOperator(imaging.plan.moved(recorded.transmitter_m - offset_m, receiver, recorded.reference_m))


def _axes(antennas: AntennaPath, height_m: float) -> Tensor:
    """Line of sight, scaled so that a unit changes half the path by one, and two unit vectors
    perpendicular to it, (pulse, axis, 3).
    """
    sight = sights(antennas, height_m)
    up = torch.zeros_like(sight)
    up[:, 2] = 1
    level = torch.linalg.cross(up, sight, dim=-1)
    level = level / torch.linalg.vector_norm(level, dim=-1, keepdim=True).clamp_min(1e-9)
    other = torch.linalg.cross(sight, level, dim=-1)
    other = other / torch.linalg.vector_norm(other, dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.stack([sight / sight.square().sum(-1, keepdim=True), level, other], 1)


def _masks(counts: tuple[int, int], device: torch.device) -> Tensor:
    """Blocks of the image, (block, azimuth, range)."""
    number = [torch.arange(n, device=device) * _BLOCKS // n for n in counts]
    block = number[0][:, None] * _BLOCKS + number[1]
    return torch.stack([block == i for i in range(_BLOCKS**2)])


def _scene(rows: Tensor, operator: TileOperator) -> tuple[Tensor, Tensor]:
    """Scene (azimuth, range) whose echo fits the samples, and the variance of the samples that a
    Wiener estimate of it leaves.

    Each step adds the image of the residual samples, weighted by the Wiener estimate, with the
    factor that leaves the least residual.
    """
    left, noise = rows[None], torch.zeros_like(rows.real[0, 0]).double()
    image = operator.image(left)
    power = image.real.square() + image.imag.square()
    weight = wiener(power, or_one(power.mean((-2, -1), keepdim=True)))
    scene = torch.zeros_like(image)
    for step in range(_FITS):
        # without its mean the first weight leaves out what each pulse adds to its own model
        part = operator.image(left) * weight if step else image * (weight - weight.mean(-2, keepdim=True))
        echo = operator.adjoint(part)
        size = (echo.conj() * left).sum().real / or_one(echo.abs().square().sum())
        rest = left - echo * size
        if step == 0:
            noise = rest.abs().square().double().mean() / (1 - weight.double().mean()) ** 2
        elif rest.abs().square().sum() > _WORTH * left.abs().square().sum():
            break  # what is left is noise
        scene, left = scene + part * size, rest
    return scene[0], noise


def _measured(rows: Tensor, operator: TileOperator, masks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phases in rad of each pulse in the blocks (pulse, block), their Fisher information (pulse,
    block, block), and the centroids of the power of the blocks in metres (block, 3).

    Blocks at the same range overlap in a pulse; least squares fit all blocks at once, each with a
    complex gain.
    """
    scene, noise = _scene(rows, operator)
    parts = scene * masks
    power = (parts.real.square() + parts.imag.square()).flatten(1).double()
    pixels = operator.plan.grid.pixels_m().reshape(-1, 3)
    places = (power @ pixels) / or_one(power.sum(-1, keepdim=True))
    model = operator.adjoint(parts).movedim(0, -1)  # (pulse, range, block)
    # phases that are far off are common to all blocks; what is left of them is small
    common = safe_angle((rows * model.sum(-1).conj()).sum(-1))
    rows = rows * cis(-common)[:, None]
    # the model holds some noise too
    excess = model.sum(-1).abs().square().double().mean() / or_one(rows.abs().square().double().mean() - noise)
    gram = (model.mH @ model).to(torch.complex128)
    ridge = _RIDGE * or_one(gram.diagonal(dim1=-2, dim2=-1).real.mean())
    inverse = torch.linalg.inv(gram + ridge * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device))
    gain = (inverse @ (model.mH @ rows[..., None]).to(inverse.dtype))[..., 0]
    return (
        gain.imag + common[:, None],
        torch.linalg.inv(inverse.real) * (2 / or_one(noise * excess.clamp_min(1))),
        places,
    )


def _levers(antennas: AntennaPath, places_m: Tensor, axes: Tensor) -> Tensor:
    """Change of half the path over places by a unit of each axis, (place, pulse, axis)."""
    ways = [place - places_m[:, None] for place in antennas.places]
    units = [way / torch.linalg.vector_norm(way, dim=-1, keepdim=True) for way in ways]
    return (torch.stack(torch.broadcast_tensors(*units)).mean(0)[..., None, :] * axes).sum(-1)


def _fitted(range_m: Tensor, information: Tensor, lever: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Least-squares step of the motion (pulse, 3), and standard deviation of the line of sight.

    range_m: errors of half the path in the blocks, (pulse, block), with their Fisher information
    (pulse, block, block); lever: change of half the path by a unit of each axis, (pulse, block,
    axis).
    """
    pull = (lever.mT @ (information @ range_m[..., None]))[..., 0]  # (pulse, axis)
    normal = lever.mT @ information @ lever
    whole = or_one(normal[:, 0, 0])
    step, variance = torch.zeros_like(motion), 1 / whole
    share = normal[:, 0, 1:] / whole[:, None]
    basis, prior = _spectrum(motion[:, 0])
    rest = pull[:, 1:] - share * pull[:, :1]
    seen = normal[:, 1:, 1:] - normal[:, 1:, :1] * share[:, None]
    parts = [[basis.mT @ (seen[:, i, k, None] * basis) for k in range(2)] for i in range(2)]
    ridge = torch.cat([prior, prior]).reciprocal()
    spread = torch.linalg.inv(torch.cat([torch.cat(row, 1) for row in parts]) + torch.diag(ridge))
    now = (basis.mT @ motion[:, 1:]).mT.reshape(-1)
    found = spread @ ((basis.mT @ rest).mT.reshape(-1) - ridge * now)
    step[:, 1:] = basis @ found.reshape(2, -1).mT
    blocks = spread.reshape(2, len(prior), 2, len(prior))
    of_pulse = torch.einsum("pa,iakb,pb->pik", basis, blocks, basis)
    variance = variance + (share[:, None] @ of_pulse @ share[..., None])[:, 0, 0]
    step[:, 0] = pull[:, 0] / whole - (share * step[:, 1:]).sum(-1)
    return step, variance.clamp_min(0).sqrt()


def _spectrum(motion_m: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine basis over the pulses, (pulse, coefficient), and the expected power of its
    coefficients: that of a motion, averaged over neighbours. The lowest are not observable.
    """
    pulses = len(motion_m)
    order = torch.arange(_UNSEEN, pulses, dtype=torch.float64, device=motion_m.device)
    time = torch.arange(pulses, dtype=torch.float64, device=motion_m.device) + 0.5
    basis = torch.cos(torch.outer(time, order) * (math.pi / pulses)) * math.sqrt(2 / pulses)
    power = (basis.mT @ motion_m).square()
    near = (order[:, None] - order).abs() <= order[:, None] * _WIDE + _LEAST_WIDE
    mean = (near * power).sum(-1) / near.sum(-1)
    return basis, mean.clamp_min(1e-9 * float(mean.max()) + 1e-18)
