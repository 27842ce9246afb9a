"""A scene that fits the samples, found together with errors that are linear in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.pulse_phase.fixed_point import Wiener
from torchsar.focus import TileOperator

# most iterations of conjugate gradients, and share of the energy of the noise by which the last one
# may lower the cost, by trial: with .1 a fit left 70 times the noise at 40 dB, with .01 6
# times, where 12 iterations left 50 times; at 0 dB the errors of the path were equal
_STEPS, _LEFT = 40, 0.01


@dataclass(frozen=True, eq=False)
class Scene:
    """Prior of a scene, independent Gaussian cells of known standard deviations, and its fit.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the assumed path.
        size: Standard deviations of the reflectivity of the cells, shape (azimuth, range).
        noise: Variance of the noise of a sample.
        pixels: Number of cells per resolution cell.
        exact: Whether fits end later, nearer to the most probable scene.
    """

    rows: Tensor
    imaging: TileOperator
    size: Tensor
    noise: Tensor
    pixels: Tensor
    exact: bool = False

    def echo(self, cells: Tensor) -> Tensor:
        """Range profiles of a scene, given in units of its standard deviations."""
        return self.imaging.adjoint((self.size * cells)[None])[0]

    def image_of(self, rows: Tensor) -> Tensor:
        """The adjoint of `echo`."""
        return self.size * self.imaging.image(rows[None])[0]

    def fitted(self, without: Callable[[Tensor], Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Find the most probable scene by conjugate gradients.

        Args:
            without: Removes from profiles what other unknowns can explain, symmetric and positive;
                the scene is then that of the joint estimate (variable projection: Golub and Pereyra
                1973, SIAM Journal on Numerical Analysis 10).

        Returns:
            The scene (azimuth, range), and the profiles less its echo.
        """
        without = without or (lambda rows: rows)
        left, cells = self.rows, torch.zeros_like(self.size, dtype=self.rows.dtype)
        gradient = self.image_of(without(left))
        toward, power = gradient, _energy(gradient)
        # the first for the last rounds where there is little noise, by trial, see `path_autofocus`
        steps, share = (120, 0.001) if self.exact else (_STEPS, _LEFT)
        enough = share * self.noise * left.numel()
        for _ in range(steps):
            echo = self.echo(toward)
            bend = (echo.conj() * without(echo)).sum().real + self.noise * _energy(toward)
            length = power / or_one(bend)
            step = length.to(self.size.dtype)
            cells, left = cells + step * toward, left - step * echo
            if length * power <= enough:  # by which this step lowered the cost
                break
            gradient = self.image_of(without(left)) - self.noise.to(self.size.dtype) * cells
            now = _energy(gradient)
            toward, power = gradient + (now / power).to(self.size.dtype) * toward, now
        return self.size * cells, left

    def noise_of(self, left: Tensor) -> Tensor:
        """Variance of the noise from the samples that a fit leaves.

        A fit explains some of the noise. A cell of fixed size would take the share w of the noise
        of its samples. The size follows the noise too: with w = (p / (p + c))^2, where p is the
        power of the cell, the divergence of the fit (Stein 1981, Annals of Statistics 9) is
        w (3 - 2 sqrt(w)).
        """
        samples = self.rows.numel()
        gain = self.size.double().square() * (samples * self.pixels)
        share = gain / (gain + self.noise)
        explained = (share * (3 - 2 * share.sqrt())).sum() / (samples * self.pixels)
        return _floored(_energy(left) / (left.numel() * (1 - explained.clamp_max(0.9))), self.rows)

    def narrowed(self, cells: Tensor) -> Scene:
        """The scene with the sizes that its most probable reflectivities (azimuth, range) have, and
        at least 1e-4 of their mean variance.
        """
        power = cells.abs().square()
        return _scaled(power + 1e-4 * power.mean(), self)


def scene_of(rows: Tensor, imaging: TileOperator, noise: Tensor | None = None, exact: bool = False) -> Scene:
    """The scene whose sizes follow from a Wiener estimate of the image of range profiles.

    Args:
        rows: Range profiles, shape (pulse, range), complex.
        imaging: Image formation along the assumed path.
        noise: Variance of the noise of a sample; by default of what the Wiener estimate leaves.
        exact: Whether fits end later, nearer to the most probable scene.

    Returns:
        The scene.
    """
    image = imaging.image(rows[None])[0]
    power = image.abs().square()
    weight = Wiener.filter(power, Wiener.level * or_one(power.mean()), -1)
    if noise is None:
        # without its mean the weight leaves out what each pulse adds to its own model
        echo = imaging.adjoint((image * (weight - weight.mean(-2, keepdim=True)))[None])[0]
        left = rows - echo * ((echo.conj() * rows).sum().real / or_one(_energy(echo)).to(power.dtype))
        noise = _floored(_energy(left) / (left.numel() * (1 - weight.double().mean()).square()), rows)
    # the energy of the image of a point in the middle is the number of pixels per resolution cell
    point = torch.zeros_like(image[None])
    point[0, image.shape[0] // 2, image.shape[1] // 2] = 1
    pixels = _energy(imaging.image(imaging.adjoint(point))) / rows.numel() ** 2
    return _scaled(_smoothed(power) * weight, Scene(rows, imaging, torch.zeros_like(power), noise, pixels, exact))


def _scaled(power: Tensor, scene: Scene) -> Scene:
    """The scene with sizes of these powers, of which the energy of the samples is expected.

    At least a thousandth of this energy is taken as echo.
    """
    whole = _energy(scene.rows)
    energy = (whole - scene.noise * scene.rows.numel()).clamp_min(1e-3 * whole)
    size = (power * (energy / (scene.rows.numel() * or_one(power.double().sum()))).to(power.dtype)).sqrt()
    return replace(scene, size=size)


def _smoothed(power: Tensor) -> Tensor:
    """Averages over three neighbours along either axis, weights 1/4, 1/2 and 1/4, circular."""
    for dim in (-1, -2):
        power = (power.roll(1, dim) + 2 * power + power.roll(-1, dim)) / 4
    return power


def _floored(noise: Tensor, rows: Tensor) -> Tensor:
    """Variance of the noise, at least 1e-8 of the samples: below it float32 rounds."""
    return noise.clamp_min(1e-8 * float(_energy(rows) / rows.numel()))


def _energy(x: Tensor) -> Tensor:
    """Sum of the squares of an image, float64."""
    return x.abs().square().double().sum()
