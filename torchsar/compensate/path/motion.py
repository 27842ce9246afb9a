"""Least squares of the motion in three axes, of given samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one

# lowest coefficients, of the constant and the linear term, which are not observable
_UNSEEN = 2


@dataclass(frozen=True, eq=False)
class Motion:
    """Small motions of the antennas, which change the samples linearly.

    The motion along the line of sight is free at each pulse. The two axes across have a Gaussian
    prior of mean zero, with the spectrum of the motion along the line of sight.

    Args:
        unit: Derivative of the samples by the motion along each axis, per metre, shape (pulse,
            range, axis), complex.
        line_of_sight_m: Motion along the line of sight as found so far in metres, float64 (pulse,).
        noise: Variance of the noise of a sample.
    """

    unit: Tensor
    line_of_sight_m: Tensor
    noise: Tensor

    @cached_property
    def _normal(self) -> Tensor:
        """Normal equations of each pulse, (pulse, axis, axis)."""
        unit = self.unit.to(torch.complex128)
        return (unit.mH @ unit).real

    @cached_property
    def _whole(self) -> Tensor:
        """Those of the line of sight, (pulse,)."""
        return or_one(self._normal[:, 0, 0])

    @cached_property
    def _share(self) -> Tensor:
        """Change of the line of sight by a unit of the axes across, (pulse, 2)."""
        return self._normal[:, 0, 1:] / self._whole[:, None]

    @cached_property
    def _prior(self) -> tuple[Tensor, Tensor]:
        """Basis (pulse, coefficient), and the ridge of its coefficients for both axes across."""
        pulses = len(self.line_of_sight_m)
        basis = cosines(pulses, pulses - _UNSEEN, self.line_of_sight_m.device)
        power = expected_power((basis.mT @ self.line_of_sight_m).square())
        return basis, self.noise / (2 * torch.cat([power, power]))

    @cached_property
    def _factor(self) -> Tensor:
        """Cholesky factor of the equations of the coefficients across."""
        basis, ridge = self._prior
        rest = self._normal[:, 1:, 1:] - self._normal[:, 1:, :1] * self._share[:, None]
        parts = [torch.cat([basis.mT @ (rest[:, i, k, None] * basis) for k in range(2)], 1) for i in range(2)]
        return torch.linalg.cholesky(torch.cat(parts) + torch.diag(ridge))

    def of(self, rows: Tensor) -> Tensor:
        """Most probable motion in metres, float64 (pulse, axis), that made samples."""
        basis, _ = self._prior
        pull = (self.unit.mH @ rows[..., None])[..., 0].real.double()
        rest = torch.cat([basis.mT @ (pull[:, i] - self._share[:, i - 1] * pull[:, 0]) for i in (1, 2)])
        across = basis @ torch.cholesky_solve(rest[:, None], self._factor).reshape(2, -1).mT
        return torch.cat([(pull[:, 0] / self._whole - (self._share * across).sum(-1))[:, None], across], 1)

    def echo(self, motion_m: Tensor) -> Tensor:
        """Change of the samples by a motion."""
        return (self.unit @ motion_m[..., None].to(self.unit.dtype))[..., 0]

    def without(self, rows: Tensor) -> Tensor:
        """Samples less what a motion explains of them."""
        return rows - self.echo(self.of(rows))

    def std_m(self) -> Tensor:
        """Standard deviation of the line of sight for a known scene, float64 (pulse,)."""
        basis, _ = self._prior
        count = basis.shape[-1]
        spread = torch.cholesky_inverse(self._factor).reshape(2, count, 2, count)
        across = torch.einsum("pa,iakb,pb->pik", basis, spread, basis)
        added = (self._share[:, None] @ across @ self._share[..., None])[:, 0, 0]
        return ((1 / self._whole + added) * self.noise / 2).sqrt()


def cosines(pulses: int, count: int, device: torch.device) -> Tensor:
    """Return an orthonormal basis of motions without constant and linear terms, slow ones first.

    Args:
        pulses: Number of pulses.
        count: Number of cosines.
        device: Device of the result.

    Returns:
        Cosines of 1, 1.5, 2, ... periods over the pulses, float64 (pulse, cosine).
    """
    order = torch.arange(_UNSEEN, _UNSEEN + count, dtype=torch.float64, device=device)
    time = torch.arange(pulses, dtype=torch.float64, device=device) + 0.5
    return torch.cos(torch.outer(time, order) * (math.pi / pulses)) * math.sqrt(2 / pulses)


def expected_power(power: Tensor) -> Tensor:
    """Return the mean over neighbours of the power of each coefficient of `cosines`.

    Args:
        power: Power of the coefficients, float64 (cosine,).

    Returns:
        Smooth power, never zero, float64 (cosine,).
    """
    order = torch.arange(_UNSEEN, _UNSEEN + len(power), dtype=torch.float64, device=power.device)
    # over a share of the number of the coefficient, plus a number of coefficients
    near = (order[:, None] - order).abs() <= order[:, None] * 0.25 + 2
    mean = (near * power).sum(-1) / near.sum(-1)
    return mean.clamp_min(1e-9 * float(mean.max()) + 1e-18)
