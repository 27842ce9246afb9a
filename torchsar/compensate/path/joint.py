"""Joint estimate of a scene and of the position errors in three axes, from given samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchsar.compensate.path.ground import corrected, line_free, slope
from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.pulse_phase.fixed_point import Wiener
from torchsar.core import cis
from torchsar.focus.tile_operator import TileOperator
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.spotlight import frequency_samples


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
    rows: Tensor,
    imaging: TileOperator,
    motion_m: Tensor,
    present: Tensor,
    rounds: int = 6,
    *,
    ends: tuple[int, float] = (40, 0.01),
) -> Found:
    """Refine the line of sight, and find the errors across it, together with the scene.

    An error across the line of sight acts with opposite signs on the two sides of a scene. Each
    round estimates the scene and the motion in three axes jointly, linearised about the motion
    found so far. If the scene were estimated alone, it would adapt to the errors, and they would
    decrease slowly. The scene has independent cells, whose variances follow from a first fit to the
    samples. The motion acts on their phases by a polynomial of the position in the scene.

    Then whole fringes are added to the line of sight of pulses whose envelopes match the scene
    clearly better with them. The rounds end when the phases change by less than a share of their
    standard deviation.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the recorded path.
        motion_m: Errors in metres as found so far, recorded minus true: those of half the path over
            the middle of the scene, float64 (pulse,). Or these and the errors along two axes across
            the line of sight, see `Found`, float64 (pulse, axis).
        present: True for the pulses of the profiles among all pulses.
        rounds: Largest number of rounds, at least 1.
        ends: When the fits of the scene end, see `Scene`.

    Returns:
        The errors.
    """
    plan = imaging.plan
    axes = _axes(plan.antennas, float(plan.grid.origin_m[2]))
    found = pad(motion_m[:, None], (0, 2)) if motion_m.ndim == 1 else motion_m
    fringe = LIGHT_M_S / (2 * float(plan.frequency_hz.mean()))
    noise = None
    std = fringes = torch.zeros_like(found[:, 0])
    for _ in range(rounds):
        scene = scene_of(rows, _along(imaging, (found[:, None] @ axes)[:, 0]), noise, ends)
        cells, _ = scene.fitted()
        scene = scene.narrowed(cells)
        unit, lever = _units(scene.imaging, cells, axes)
        motion = Motion(unit, found[:, 0], scene.noise)
        # the prior applies to the whole motion across the line of sight; the motion along it has
        # none
        across = pad(found[:, 1:], (1, 0))
        _, left = replace(scene, rows=rows + motion.echo(across)).fitted(motion.without)
        whole = motion.of(left)
        left = left - motion.echo(whole)
        noise = scene.noise_of(left)
        # the standard deviation exceeds that for a known scene by a tenth of the variance, by trial
        std = motion.std_m() * (1.1 * noise / scene.noise).sqrt()
        fringes = _fringes(rows, rows - left, plan.frequency_hz, noise)
        before, found = found, found + (whole - across)
        found[:, 0] = line_free(found[:, 0] + fringes * fringe, present)
        change = (lever @ (found - before)[..., None]).square().mean()
        # a change of less than 0.3 standard deviations is small, by choice
        if change <= 0.3**2 * std.square().mean() and not bool(fringes.any()):
            break
    assert noise is not None
    offset = (found[:, None] @ axes)[:, 0]
    image = _along(imaging, offset).image(rows[None])[0]
    return Found(found, offset, std, image, noise, (fringes != 0).double().mean())


def _along(imaging: TileOperator, offset_m: Tensor) -> TileOperator:
    """Image formation along the recorded path after its errors are subtracted."""
    path = corrected(imaging.plan.antennas, offset_m)
    return TileOperator(imaging.plan.moved(path.transmitter_m, path.receiver_m, path.reference_m))


def _axes(antennas: AntennaPath, height_m: float) -> Tensor:
    """Line of sight, scaled so that a unit changes half the path by one, and two unit vectors
    perpendicular to it, (pulse, axis, 3).
    """
    sight = slope(antennas.places, antennas.transmitter_m.new_tensor([0.0, 0.0, height_m]))
    up = sight.new_tensor([0.0, 0.0, 1.0]).expand_as(sight)
    level = normalize(torch.linalg.cross(up, sight, dim=-1), dim=-1, eps=1e-9)
    other = normalize(torch.linalg.cross(sight, level, dim=-1), dim=-1, eps=1e-9)
    return torch.stack([sight / sight.square().sum(-1, keepdim=True), level, other], 1)


def _units(operator: TileOperator, scene: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Derivative of the samples by the motion along each axis, per metre, (pulse, range, axis).

    Also returns the derivative of half the path over nine places of the scene, (pulse, place,
    axis). scene: cells, (azimuth, range).
    """
    grid = operator.plan.grid
    # three places along either axis determine the effect of a motion as a polynomial of second
    # order
    some = [torch.linspace(0, n - 1, 3).round().long() for n in grid.counts]
    lines = (torch.linspace(-1, 1, n, dtype=torch.float64, device=scene.device) for n in grid.counts)
    u, v = torch.meshgrid(*lines, indexing="ij")
    # dimensions (term, azimuth, range)
    terms = torch.stack([torch.ones_like(u), u, v, u.square(), u * v, v.square()])
    known = terms[:, some[0]][..., some[1]].flatten(1)
    places = grid.pixels_m()[some[0]][:, some[1]].reshape(-1, 3)
    lever = (slope(operator.plan.antennas.places, places[:, None])[..., None, :] * axes).sum(-1).movedim(0, 1)
    share = torch.linalg.pinv(known.mT) @ lever  # dimensions (pulse, term, axis)
    radians = 4j * math.pi * float(operator.plan.frequency_hz.mean()) / LIGHT_M_S
    # the terms are processed one after another, so that they use the same tables as the other
    # images
    echo = torch.stack([operator.adjoint((scene * term)[None])[0] for term in terms.to(scene.real.dtype)], -1)
    return echo @ (radians * share).to(scene.dtype), lever


def _fringes(
    rows: Tensor, model: Tensor, frequency_hz: Tensor, noise: Tensor, most: int = 4, gain: float = 10.0
) -> Tensor:
    """Whole fringes by which recorded ranges exceed the true ones, float64 (pulse,), at most
    `most`.

    With them, the envelopes of the range profiles lie nearer to those of the model. The number is 0
    where the log likelihood does not rise by `gain`, which noise alone does in one of ten thousand
    pulses.
    """
    number = torch.arange(-most, most + 1, dtype=torch.float64, device=rows.device)
    middle = frequency_hz.mean()
    shift = cis(torch.outer((middle - frequency_hz) * (2 * math.pi / middle), number)).to(rows.dtype)
    match = ((frequency_samples(rows) * frequency_samples(model).conj()) @ shift).abs().square().double()
    score = match / or_one(model.abs().square().double().sum(-1, keepdim=True) * noise)
    best, at = score.max(-1)
    return torch.where(best - score[:, most] > gain, number[at], 0.0)


class Motion:
    """Small motions of the antennas, which change the samples linearly.

    The motion along the line of sight is free at each pulse. The two axes across have a Gaussian
    prior of mean zero, with the spectrum of the motion along the line of sight. With the normal
    equations N of a pulse, the free motion is eliminated. The equations of the axes across then are
    N_ik - N_i0 N_0k / N_00.

    Args:
        unit: Derivative of the samples by the motion along each axis, per metre, shape (pulse,
            range, axis), complex.
        line_of_sight_m: Motion along the line of sight as found so far in metres, float64 (pulse,).
        noise: Variance of the noise of a sample.
    """

    def __init__(self, unit: Tensor, line_of_sight_m: Tensor, noise: Tensor) -> None:
        self.unit, self.noise, pulses = unit, noise, len(line_of_sight_m)
        wide = unit.to(torch.complex128)
        normal = (wide.mH @ wide).real
        self.whole = or_one(normal[:, 0, 0])
        # Motion along the line of sight that has most nearly the same effect on the samples as a
        # unit motion along each axis across, (pulse, 2).
        self.share = normal[:, 0, 1:] / self.whole[:, None]
        self.basis = cosines(pulses, pulses - 2, line_of_sight_m.device)
        power = expected_power((self.basis.mT @ line_of_sight_m).square())
        self.ridge = noise / (2 * torch.cat([power, power]))
        rest = normal[:, 1:, 1:] - normal[:, 1:, :1] * self.share[:, None]
        parts = [torch.cat([self.basis.mT @ (rest[:, i, k, None] * self.basis) for k in range(2)], 1) for i in range(2)]
        self.factor = torch.linalg.cholesky(torch.cat(parts) + torch.diag(self.ridge))

    def of(self, rows: Tensor) -> Tensor:
        """Most probable motion in metres, float64 (pulse, axis), for given changes of the
        samples.
        """
        pull = (self.unit.mH @ rows[..., None])[..., 0].real.double()
        rest = torch.cat([self.basis.mT @ (pull[:, i] - self.share[:, i - 1] * pull[:, 0]) for i in (1, 2)])
        across = self.basis @ torch.cholesky_solve(rest[:, None], self.factor).reshape(2, -1).mT
        return torch.cat([(pull[:, 0] / self.whole - (self.share * across).sum(-1))[:, None], across], 1)

    def echo(self, motion_m: Tensor) -> Tensor:
        """Change of the samples by a motion."""
        return (self.unit @ motion_m[..., None].to(self.unit.dtype))[..., 0]

    def without(self, rows: Tensor) -> Tensor:
        """Samples after the part that a motion explains is subtracted."""
        return rows - self.echo(self.of(rows))

    def std_m(self) -> Tensor:
        """Standard deviation of the line of sight in metres for a known scene, float64 (pulse,)."""
        count = self.basis.shape[-1]
        spread = torch.cholesky_inverse(self.factor).reshape(2, count, 2, count)
        across = torch.einsum("pa,iakb,pb->pik", self.basis, spread, self.basis)
        added = (self.share[:, None] @ across @ self.share[..., None])[:, 0, 0]
        return ((1 / self.whole + added) * self.noise / 2).sqrt()


def cosines(pulses: int, count: int, device: torch.device) -> Tensor:
    """Return an orthonormal basis of motions, slow ones first.

    A constant and a linear term are not observable, and the slowest cosine has one period.

    Args:
        pulses: Number of pulses.
        count: Number of cosines.
        device: Device of the result.

    Returns:
        Cosines of 1, 1.5, 2, ... periods over the pulses, float64 (pulse, cosine).
    """
    order = torch.arange(2, 2 + count, dtype=torch.float64, device=device)
    time = torch.arange(pulses, dtype=torch.float64, device=device) + 0.5
    return torch.cos(torch.outer(time, order) * (math.pi / pulses)) * math.sqrt(2 / pulses)


def expected_power(power: Tensor) -> Tensor:
    """Return the mean over neighbours of the power of each coefficient of `cosines`.

    Args:
        power: Power of the coefficients, float64 (cosine,).

    Returns:
        Smooth power, never zero, float64 (cosine,).
    """
    order = torch.arange(2, 2 + len(power), dtype=torch.float64, device=power.device)
    # the numbers of neighbours differ by at most a quarter of the number of the coefficient, plus 2
    near = (order[:, None] - order).abs() <= order[:, None] * 0.25 + 2
    mean = (near * power).sum(-1) / near.sum(-1)
    return mean.clamp_min(1e-9 * float(mean.max()) + 1e-18)


@dataclass(frozen=True, eq=False)
class Scene:
    """Prior of a scene, whose cells are independent and Gaussian with known standard deviations,
    and its fit.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the assumed path.
        size: Standard deviations of the reflectivity of the cells, shape (azimuth, range).
        noise: Variance of the noise of a sample.
        pixels: Number of cells per resolution cell.
        ends: Most iterations of conjugate gradients, and share of the energy of the noise by which
            the last one may lower the cost. By trial, with .1 a fit left 70 times the noise at 40
            dB, with .01 6 times, where 12 iterations left 50 times; at 0 dB the errors of the path
            were equal.
    """

    rows: Tensor
    imaging: TileOperator
    size: Tensor
    noise: Tensor
    pixels: Tensor
    ends: tuple[int, float]

    def fitted(self, without: Callable[[Tensor], Tensor] = lambda rows: rows) -> tuple[Tensor, Tensor]:
        """Find the most probable scene by conjugate gradients.

        Args:
            without: Removes from profiles what other unknowns can explain, symmetric and positive;
                the scene is then that of the joint estimate (variable projection: Golub and Pereyra
                1973, SIAM Journal on Numerical Analysis 10).

        Returns:
            The scene (azimuth, range), and the profiles less its echo.
        """
        size, left, cells = self.size, self.rows, torch.zeros_like(self.size, dtype=self.rows.dtype)
        gradient = size * self.imaging.image(without(left)[None])[0]
        toward, power = gradient, _energy(gradient)
        for _ in range(self.ends[0]):
            echo = self.imaging.adjoint((size * toward)[None])[0]
            bend = (echo.conj() * without(echo)).sum().real + self.noise * _energy(toward)
            length = power / or_one(bend)
            step = length.to(size.dtype)
            cells, left = cells + step * toward, left - step * echo
            # the left side is the decrease of the cost by this step
            if length * power <= self.ends[1] * self.noise * left.numel():
                break
            gradient = size * self.imaging.image(without(left)[None])[0] - self.noise.to(size.dtype) * cells
            now = _energy(gradient)
            toward, power = gradient + (now / power).to(size.dtype) * toward, now
        return size * cells, left

    def noise_of(self, left: Tensor) -> Tensor:
        """Variance of the noise, from the residual of a fit.

        A fit explains a part of the noise. A cell of fixed size would take the share w of the noise
        of its samples. The size follows the noise too: with w = (p / (p + c))^2, where p is the
        power of the cell, the divergence of the fit (Stein 1981, Annals of Statistics 9) is w (3 -
        2 sqrt(w)).
        """
        resolved = self.rows.numel() * self.pixels
        gain = self.size.double().square() * resolved
        share = gain / (gain + self.noise)
        explained = (share * (3 - 2 * share.sqrt())).sum() / resolved
        return _noise(left, 1 - explained.clamp_max(0.9), self.rows)

    def narrowed(self, cells: Tensor) -> Scene:
        """The scene with standard deviations that follow from the most probable reflectivities,
        (azimuth, range).

        The variance of a cell is raised by 1e-4 of the mean power.
        """
        power = cells.abs().square()
        return replace(self, size=_sizes(power + 1e-4 * power.mean(), self.rows, self.noise))


def scene_of(
    rows: Tensor, imaging: TileOperator, noise: Tensor | None = None, ends: tuple[int, float] = (40, 0.01)
) -> Scene:
    """Return the scene whose standard deviations follow from a Wiener estimate of the image of
    range profiles.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the assumed path.
        noise: Variance of the noise of a sample; by default of what the Wiener estimate leaves.
        ends: When fits end, see `Scene`.

    Returns:
        The scene.
    """
    image = imaging.image(rows[None])[0]
    power = image.abs().square()
    weight = Wiener.filter(power, Wiener.level * or_one(power.mean()), -1)
    if noise is None:
        # subtracting the mean weight of each range cell removes the contribution of each pulse to
        # its own model
        echo = imaging.adjoint((image * (weight - weight.mean(-2, keepdim=True)))[None])[0]
        left = rows - echo * ((echo.conj() * rows).sum().real / or_one(_energy(echo)).to(power.dtype))
        noise = _noise(left, (1 - weight.double().mean()).square(), rows)
    # the energy of the image of a point in the middle is the number of pixels per resolution cell
    point = torch.zeros_like(image[None])
    point[0, image.shape[0] // 2, image.shape[1] // 2] = 1
    pixels = _energy(imaging.image(imaging.adjoint(point))) / rows.numel() ** 2
    for dim in (-1, -2):  # average over three neighbours along either axis
        power = (power.roll(1, dim) + 2 * power + power.roll(-1, dim)) / 4
    return Scene(rows, imaging, _sizes(power * weight, rows, noise), noise, pixels, ends)


def _sizes(power: Tensor, rows: Tensor, noise: Tensor) -> Tensor:
    """Standard deviations of the cells in proportion to the root of `power`.

    They are scaled so that the expected energy of the echo is that of the samples minus the noise,
    and at least a thousandth of that of the samples.
    """
    whole = _energy(rows)
    energy = (whole - noise * rows.numel()).clamp_min(1e-3 * whole)
    return (power * (energy / (rows.numel() * or_one(power.double().sum()))).to(power.dtype)).sqrt()


def _noise(left: Tensor, share: Tensor, rows: Tensor) -> Tensor:
    """Estimate the noise variance from the residual `left` of a fit, which contains the share
    `share` of the noise.

    It is at least 1e-8 of the mean power of the samples, the limit of float32.
    """
    return (_energy(left) / (left.numel() * share)).clamp_min(1e-8 * float(_energy(rows) / rows.numel()))


def _energy(x: Tensor) -> Tensor:
    """Energy of an image, float64."""
    return x.abs().square().double().sum()
