"""Least squares of a slow motion from the phases of many scatterers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# share of an information that is added to it, so that rounding does not make it singular
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Curve:
    """Phases of scatterers as functions of a motion, which is a sum of cosines.

    The phase of a scatterer is that of the motion of the antennas, plus terms of its own: a
    constant, and displacements of its place.

    Args:
        basis: Cosines, float64 (pulse, cosine).
        pulses: Numbers of the pulses that see each scatterer, int64 (scatterer, seen).
        lever: Change of the phase by a motion along each axis in rad per metre, float64 (scatterer,
            seen, axis).
        own: Change of the phase by the terms of the scatterer, float64 (scatterer, seen, term).
    """

    basis: Tensor
    pulses: Tensor
    lever: Tensor
    own: Tensor

    def phase(self, motion_m: Tensor) -> Tensor:
        """Phase by a motion (pulse, axis), float64 (scatterer, seen)."""
        return (self.lever * motion_m[self.pulses]).sum(-1)

    def solved(self, phase: Tensor, weight: Tensor, power: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the most probable motion and terms of the scatterers.

        The coefficients of the motion and the terms of the scatterers are independent and Gaussian.

        Args:
            phase: Measured phases in rad, float64 (scatterer, seen).
            weight: Inverse variances of their errors, float64 (scatterer, seen).
            power: Expected power of the coefficients in square metres, float64 (axis, cosine).
            known: Inverse variances of the terms of the scatterers, whose mean is zero, float64
                (scatterer, term).

        Returns:
            Coefficients of the motion, float64 (axis, cosine); their covariance, float64 (axis *
            cosine, axis * cosine); and the phase that the terms of each scatterer add, float64
            (scatterer, seen).
        """
        axes, count = power.shape
        pull = weight[..., None] * self.own
        normal = pull.mT @ self.own
        seen = normal.diagonal(dim1=-2, dim2=-1)  # zero for a scatterer that no pulse sees
        ridge = torch.where(seen > 0, _RIDGE * seen + known, 1.0)
        inverse = torch.linalg.inv(normal + torch.diag_embed(ridge))
        own = (pull.mT @ phase[..., None])[..., 0]
        share = torch.zeros(len(self.basis), axes, axes, dtype=torch.float64, device=phase.device)
        drive = torch.zeros(len(self.basis), axes, dtype=torch.float64, device=phase.device)
        weighted = weight[..., None] * self.lever
        at = self.pulses.flatten()
        share.index_add_(0, at, (weighted[..., None] * self.lever[..., None, :]).flatten(0, 1))
        drive.index_add_(0, at, (weighted * phase[..., None]).flatten(0, 1))
        whole = torch.einsum("pm,pik,pn->imkn", self.basis, share, self.basis).reshape(axes * count, -1)
        whole.diagonal().mul_(1 + _RIDGE)
        cross = torch.cat([self._through(pull * self.lever[..., i : i + 1]) for i in range(axes)], -1)
        tied = inverse @ cross
        whole = whole - cross.flatten(0, 1).mT @ tied.flatten(0, 1) + torch.diag(1 / power.flatten())
        right = (self.basis.mT @ drive).mT.flatten() - tied.flatten(0, 1).mT @ own.flatten()
        factor = torch.linalg.cholesky(whole)
        found = torch.cholesky_solve(right[:, None], factor)[:, 0]
        terms = (inverse @ own[..., None])[..., 0] - tied @ found
        added = (self.own @ terms[..., None])[..., 0]
        return found.reshape(axes, count), torch.cholesky_inverse(factor), added

    def _through(self, terms: Tensor) -> Tensor:
        """Products of terms (scatterer, seen, term) with the cosines, (scatterer, term, cosine),
        some scatterers at once.
        """
        parts = zip(terms.split(16), self.pulses.split(16), strict=True)
        return torch.cat([term.mT @ self.basis[pulses] for term, pulses in parts])
