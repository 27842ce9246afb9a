"""Joint estimate of a scene and of the position errors in three axes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.path.ground import line_free, slope
from torchsar.compensate.path.motion import Motion
from torchsar.compensate.path.scene import scene_of
from torchsar.compensate.pulse_phase.data import or_one
from torchsar.core import cis
from torchsar.focus import TileOperator
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.spotlight import frequency_samples

# share of the standard deviation of the phases by which the last round may change them, by choice
_SETTLED = 0.3
# whole fringes that a round may add to the line of sight of a pulse, and logarithm of the
# likelihood that they must gain, by choice: noise alone gains it in one of ten thousand pulses
_FRINGES, _GAIN = 4, 10.0


@dataclass(frozen=True, eq=False)
class Found:
    """Errors of the positions of one trial.

    Args:
        motion_m: Errors along the line of sight, over the middle of the scene, and along two axes
            across it in metres, recorded minus true, float64 (pulse, axis).
        offset_m: Error of the positions in metres, recorded minus true, float64 (pulse, 3).
        std_m: Standard deviation of the line of sight in metres, float64 (pulse,).
        image: Image with the errors removed, complex (azimuth, range).
        noise: Variance of the samples that scene and motion leave.
        restless: Share of the pulses to which the last round still added fringes.
    """

    motion_m: Tensor
    offset_m: Tensor
    std_m: Tensor
    image: Tensor
    noise: Tensor
    restless: Tensor


def three_axes(
    rows: Tensor, imaging: TileOperator, motion_m: Tensor, present: Tensor, rounds: int = 6, *, exact: bool = False
) -> Found:
    """Refine the line of sight, and find the errors across it, together with the scene.

    An error across the line of sight acts with opposite signs on the two sides of a scene. Each
    round estimates the scene and the motion in three axes jointly, linear about the motion found so
    far: a scene alone would adapt itself to the errors, and they would vanish slowly. The scene has
    independent cells, whose variances follow from a first fit to the samples; the motion acts on
    their phases by a polynomial of the place. Then whole fringes are added to the line of sight of
    pulses whose envelopes match the scene so much better. The rounds end when the phases change by
    less than a share of their standard deviation.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the recorded path.
        motion_m: Errors as found so far, recorded minus true: of half the path over the middle of
            the scene, or besides along two axes across the line of sight, see `Found`, in metres,
            float64 (pulse,) or (pulse, axis).
        present: True for the pulses of the profiles among all pulses.
        rounds: Largest number of rounds, at least 1.
        exact: Whether the fits of the scene end later.

    Returns:
        The errors.
    """
    plan = imaging.plan
    axes = _axes(plan.antennas, float(plan.grid.origin_m[2]))
    found = torch.nn.functional.pad(motion_m[:, None], (0, 2)) if motion_m.ndim == 1 else motion_m
    fringe = LIGHT_M_S / (2 * float(plan.frequency_hz.mean()))
    noise = None
    std = fringes = torch.zeros_like(found[:, 0])
    for _ in range(rounds):
        scene = scene_of(rows, _along(imaging, (found[:, None] @ axes)[:, 0]), noise, exact)
        cells, _ = scene.fitted()
        scene = scene.narrowed(cells)
        unit, lever = _units(scene.imaging, cells, axes)
        motion = Motion(unit, found[:, 0], scene.noise)
        # the prior is that of the whole motion across; that along the line of sight has none
        across = torch.nn.functional.pad(found[:, 1:], (1, 0))
        _, left = replace(scene, rows=rows + motion.echo(across)).fitted(motion.without)
        whole = motion.of(left)
        left, step = left - motion.echo(whole), whole - across
        noise = scene.noise_of(left)
        # the variance exceeds that for a known scene by a tenth, by trial
        std = motion.std_m() * (1.1 * noise / scene.noise).sqrt()
        fringes = _fringes(rows, rows - left, plan.frequency_hz, noise)
        before, found = found, found + step
        found[:, 0] = line_free(found[:, 0] + fringes * fringe, present)
        change = (lever @ (found - before)[..., None]).square().mean()
        if change <= _SETTLED**2 * std.square().mean() and not bool(fringes.any()):
            break
    offset = (found[:, None] @ axes)[:, 0]
    image = _along(imaging, offset).image(rows[None])[0]
    assert noise is not None
    return Found(found, offset, std, image, noise, (fringes != 0).double().mean())


def _along(imaging: TileOperator, offset_m: Tensor) -> TileOperator:
    """Image formation along the recorded path less its errors."""
    recorded = imaging.plan.antennas
    receiver = None if recorded.receiver_m is None else recorded.receiver_m - offset_m
    return TileOperator(imaging.plan.moved(recorded.transmitter_m - offset_m, receiver, recorded.reference_m))


def _axes(antennas: AntennaPath, height_m: float) -> Tensor:
    """Line of sight, scaled so that a unit changes half the path by one, and two unit vectors
    perpendicular to it, (pulse, axis, 3).
    """
    sight = slope(antennas.places, antennas.transmitter_m.new_tensor([0.0, 0.0, height_m]))
    up = torch.zeros_like(sight)
    up[:, 2] = 1
    level = torch.linalg.cross(up, sight, dim=-1)
    level = level / torch.linalg.vector_norm(level, dim=-1, keepdim=True).clamp_min(1e-9)
    other = torch.linalg.cross(sight, level, dim=-1)
    other = other / torch.linalg.vector_norm(other, dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.stack([sight / sight.square().sum(-1, keepdim=True), level, other], 1)


def _units(operator: TileOperator, scene: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Derivative of the samples by the motion along each axis, per metre, (pulse, range, axis), and
    derivative of half the path over some places of the scene, (pulse, place, axis).

    scene: cells, (azimuth, range).
    """
    grid = operator.plan.grid
    # three places along either axis show the effect of a motion as a polynomial of second order
    some = [torch.linspace(0, n - 1, 3).round().long() for n in grid.counts]
    lines = (torch.linspace(-1, 1, n, dtype=torch.float64, device=scene.device) for n in grid.counts)
    u, v = torch.meshgrid(*lines, indexing="ij")
    terms = torch.stack([torch.ones_like(u), u, v, u.square(), u * v, v.square()])  # (term, azimuth, range)
    known = terms[:, some[0]][..., some[1]].flatten(1)
    places = grid.pixels_m()[some[0]][:, some[1]].reshape(-1, 3)
    lever = (slope(operator.plan.antennas.places, places[:, None])[..., None, :] * axes).sum(-1).movedim(0, 1)
    share = torch.linalg.pinv(known.mT) @ lever  # (pulse, term, axis)
    radians = 4j * math.pi * float(operator.plan.frequency_hz.mean()) / LIGHT_M_S
    # one after another, with the tables of the other images
    echo = torch.stack([operator.adjoint((scene * term)[None])[0] for term in terms.to(scene.real.dtype)], -1)
    return echo @ (radians * share).to(scene.dtype), lever


def _fringes(rows: Tensor, model: Tensor, frequency_hz: Tensor, noise: Tensor) -> Tensor:
    """Whole fringes by which recorded ranges exceed true ones, float64 (pulse,): the envelopes of
    range profiles then lie nearer than those of the model. 0 unless they are likelier by far.
    """
    number = torch.arange(-_FRINGES, _FRINGES + 1, dtype=torch.float64, device=rows.device)
    middle = frequency_hz.mean()
    shift = cis(torch.outer((middle - frequency_hz) * (2 * math.pi / middle), number)).to(rows.dtype)
    match = ((frequency_samples(rows) * frequency_samples(model).conj()) @ shift).abs().square().double()
    score = match / or_one(model.abs().square().double().sum(-1, keepdim=True) * noise)
    best, at = score.max(-1)
    return torch.where(best - score[:, _FRINGES] > _GAIN, number[at], 0.0)
