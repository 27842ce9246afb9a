"""Which numbers a search for the rotation moves, and what rotation they stand for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchsar.core.warp import k_of_shape, least_rate, shape_of, warp

Variables = Literal["raw", "shape"]

# slope of the warp at the first pulse over its mean one, below which the shape has no k
_LEAST_START = 1e-6


class Turn(NamedTuple):
    """A rotation per trial: omega_rad_s (...,), warp_k (..., order - 1), yc_m (...,), and whether
    its warp grows all the time; where not, k is 0.
    """

    omega_rad_s: Tensor
    warp_k: Tensor
    yc_m: Tensor
    feasible: Tensor


@dataclass(frozen=True)
class Unknowns:
    """The vector (..., n) that is searched, in this order, over an aperture of duration_s.

    "raw": omega (rad/s), k1, k2, ... (1/s, 1/s^2, ...), yc (m). "shape": the total angle A = omega
    * phi(T) (rad), the Legendre shape q2, q3, ... of the warp (`torchsar.core.warp.shape_of`), yc
    (m): errors of k1 and k2 pull against each other (dk1 about -T/2 dk2), those of q2 and q3 do
    not. order: of the warp, 1 being even rotation. range_term: whether the range-dependent phase is
    compensated; without it omega and yc leave no trace in the entropy and are no unknowns. yc:
    whether the centre deviation is searched, else it is known.
    """

    duration_s: float
    order: int = 3
    range_term: bool = True
    yc: bool = False
    variables: Variables = "raw"

    def __post_init__(self) -> None:
        least = 1 if self.range_term else 2
        if self.order < least:
            raise ValueError(
                "a rotation of order "
                f"{self.order}{'' if self.range_term else ' without its range term'} has nothing to "
                f"search for; choose an order of at least {least}"
            )
        if self.yc and not self.range_term:
            raise ValueError(
                "the centre deviation shows in the range term alone; leave yc known, or compensate the range term"
            )
        if self.variables not in ("raw", "shape"):
            raise ValueError(f"variables {self.variables!r} are not known; choose 'raw' or 'shape'")

    @property
    def names(self) -> tuple[str, ...]:
        """One name per unknown, with its unit."""
        raw = self.variables == "raw"
        first = ("omega_rad_s" if raw else "angle_rad",) if self.range_term else ()
        return (
            *first,
            *(k_name(i) if raw else f"q{i + 1}" for i in range(1, self.order)),
            *(("yc_m",) if self.yc else ()),
        )

    def turn(self, x: Tensor, yc_m: Tensor) -> Turn:
        """The rotation that x (..., n) stands for, with the known yc_m (...,) where it is no
        unknown. Differentiable where feasible.
        """
        size, k, yc = self._parts(x, yc_m)
        finite = torch.isfinite(x).all(-1)
        k = torch.where(finite[..., None], k, 0)
        if self.variables == "shape":
            starts = _starts(k)
            finite, k = finite & starts, k_of_shape(torch.where(starts[..., None], k, 0), self.duration_s)
        feasible = finite & (least_rate(k, self.duration_s) > 0)
        k = torch.where(feasible[..., None], k, 0)
        size = torch.where(feasible, size, 0)
        return Turn(
            size / self._phi(k) if self.variables == "shape" else size, k, torch.where(feasible, yc, 0), feasible
        )

    def at(self, omega_rad_s: Tensor, warp_k: Tensor, yc_m: Tensor) -> Tensor:
        """The vector (..., n) of a rotation. Inverse of `turn`."""
        size = omega_rad_s * self._phi(warp_k) if self.variables == "shape" else omega_rad_s
        k = shape_of(warp_k, self.duration_s) if self.variables == "shape" else warp_k
        columns = [*((size,) if self.range_term else ()), *k.unbind(-1), *((yc_m,) if self.yc else ())]
        return torch.stack(torch.broadcast_tensors(*columns), -1)

    def units(self, x: Tensor, wavelength_m: float, extent_m: float, n_pulse: int) -> Tensor:
        """Steps (..., n) that bend the phase of an outer scatterer by about a radian, for a target
        as wide as the pulse rate carries and extent_m deep.

        Of omega or A at most its size in x (..., n); of yc at most the extent.
        """
        bend = 4 / n_pulse
        parts = [self._k_unit(i) * bend if self.variables == "raw" else bend for i in range(1, self.order)]
        k = [torch.full_like(x[..., 0], part) for part in parts]
        if not self.range_term:
            return torch.stack(k, -1)
        size = torch.where(x[..., 0] != 0, x[..., 0].abs(), 1)
        angle = size * self.duration_s if self.variables == "raw" else size
        depth = wavelength_m / (2 * math.pi * angle.square())
        return torch.stack(
            [size * (depth / extent_m).clamp_max(1), *k, *((depth.clamp_max(extent_m),) if self.yc else ())], -1
        )

    def _k_unit(self, i: int) -> float:
        """k_i that makes q_(i+1) = 1 where all others are 0 and small."""
        return math.factorial(2 * i + 2) / (2 * math.factorial(i + 1) * self.duration_s**i)

    def vector(self, values: Sequence[float] | Tensor, what: str) -> Tensor:
        """Numbers, one per unknown, as float64 (..., n).

        Raises ValueError naming the unknowns where their count differs.
        """
        x = torch.as_tensor(values, dtype=torch.float64)
        if x.ndim == 0 or x.shape[-1] != len(self.names):
            raise ValueError(
                f"{what} needs the {len(self.names)} values {', '.join(self.names)}, got {x.shape[-1] if x.ndim else 1}"
            )
        return x

    def _parts(self, x: Tensor, yc_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        first = 1 if self.range_term else 0
        size = x[..., 0] if self.range_term else torch.zeros_like(x[..., 0])
        return size, x[..., first : first + self.order - 1], x[..., -1] if self.yc else yc_m.expand(x.shape[:-1])

    def _phi(self, k: Tensor) -> Tensor:
        """phi(T), (...,)."""
        return warp(torch.full((1,), self.duration_s, dtype=k.dtype, device=k.device), k)[..., 0]


def k_name(i: int) -> str:
    """Name of k_i with its unit: k1_per_s, k2_per_s2, ..."""
    return f"k{i}_per_s{i if i > 1 else ''}"


def _starts(shape: Tensor) -> Tensor:
    """Whether the warp of a shape (..., order - 1) grows at the first pulse: 1 + sum q_j P_j'(-1) >
    0, P_j'(-1) = -(-1)^j j (j + 1) / 2.
    """
    j = torch.arange(2, shape.shape[-1] + 2, dtype=shape.dtype, device=shape.device)
    slope = torch.where(j.remainder(2) == 0, -0.5, 0.5) * j * (j + 1)
    return 1 + (shape * slope).sum(-1) > _LEAST_START
