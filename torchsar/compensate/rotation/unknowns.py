"""The unknowns of a search for the rotation of a target, and conversion from and to rotations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchsar.core.warp import k_of_shape, least_rate, shape_of, warp
from torchsar.radar import InverseRadar

Variables = Literal["raw", "shape"]


class RotationParameters(NamedTuple):
    """Parameters of the rotation of a target, one set per trial.

    Args:
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
            1/s^2, ..., shape (..., order - 1); 0 where the rotation is not feasible.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), shape (...,).
        feasible: True where the rotation neither stops nor reverses, shape (...,), bool.
    """

    omega_rad_s: Tensor
    warp_k: Tensor
    yc_m: Tensor
    feasible: Tensor


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a search for the rotation of a target, as vectors of shape (..., n).

    With the variables "raw" a vector holds the rotation rate omega at the first pulse (rad/s), its
    relative derivatives k1, k2, ... (1/s, 1/s^2, ...), and the range centre deviation yc (m): a
    cell at range y lies at y + yc from the rotation centre. With the variables "shape" it holds the
    total rotation angle A over the aperture (rad), the Legendre coefficients q2, q3, ... of the
    rotation angle over time (`torchsar.core.warp.shape_of`), and yc. Estimation errors of k1 and k2
    are correlated: the error of k1 is about -T/2 times that of k2, with the length T of the
    aperture. Those of q2 and q3 are not.

    Args:
        duration_s: Duration of the aperture in seconds.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        range_term: True compensates the phase that depends on the range of a scatterer. Otherwise
            omega (or A) and yc do not affect the entropy and are not unknowns.
        yc: True makes the range centre deviation an unknown; otherwise it is known a priori.
        variables: "raw" or "shape".

    Raises:
        ValueError: If there is nothing to search for, `yc` is an unknown without the range term, or
            `variables` is neither "raw" nor "shape".
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
                f"order must be {least} or more{'' if self.range_term else ' without the range term'}, got "
                f"{self.order}: such a rotation has no unknowns to search for"
            )
        if self.yc and not self.range_term:
            raise ValueError(
                "yc_m must be known if range_term is False, because the range centre deviation affects the range "
                "term alone; give yc_m, or set range_term to True"
            )
        if self.variables not in ("raw", "shape"):
            raise ValueError(f"variables must be 'raw' or 'shape', got {self.variables!r}")

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

    def turn(self, x: Tensor, yc_m: Tensor) -> RotationParameters:
        """Convert vectors of unknowns to the rotations that they describe.

        Differentiable where the rotation is feasible.

        Args:
            x: Unknowns, shape (..., n).
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), shape (...,), used if it is not an unknown.

        Returns:
            The rotation.
        """
        first = 1 if self.range_term else 0
        size, k = x[..., 0] if first else torch.zeros_like(x[..., 0]), x[..., first : first + self.order - 1]
        yc = x[..., -1] if self.yc else yc_m.expand(x.shape[:-1])
        finite = torch.isfinite(x).all(-1)
        k = torch.where(finite[..., None], k, 0)
        if self.variables == "shape":
            # the warp grows at the first pulse if 1 + sum q_j P_j'(-1) > 0, with
            # P_j'(-1) = -(-1)^j j (j + 1) / 2; below 1e-6, k, relative to that, would be infinite
            j = torch.arange(2, k.shape[-1] + 2, dtype=k.dtype, device=k.device)
            slope = torch.where(j.remainder(2) == 0, -0.5, 0.5) * j * (j + 1)
            grows = 1 + (k * slope).sum(-1) > 1e-6
            finite, k = finite & grows, k_of_shape(torch.where(grows[..., None], k, 0), self.duration_s)
        feasible = finite & (least_rate(k, self.duration_s) > 0)
        k = torch.where(feasible[..., None], k, 0)
        size = torch.where(feasible, size, 0)
        return RotationParameters(
            size / self._phi(k) if self.variables == "shape" else size, k, torch.where(feasible, yc, 0), feasible
        )

    def at(self, omega_rad_s: Tensor, warp_k: Tensor, yc_m: Tensor) -> Tensor:
        """Convert rotations to vectors of unknowns; the inverse of `turn`.

        Args:
            omega_rad_s: Rotation rate in rad/s, shape (...,).
            warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
                1/s^2, ..., shape (..., order - 1).
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), shape (...,).

        Returns:
            The unknowns, shape (..., n).
        """
        size = omega_rad_s * self._phi(warp_k) if self.variables == "shape" else omega_rad_s
        k = shape_of(warp_k, self.duration_s) if self.variables == "shape" else warp_k
        columns = [*((size,) if self.range_term else ()), *k.unbind(-1), *((yc_m,) if self.yc else ())]
        return torch.stack(torch.broadcast_tensors(*columns), -1)

    def units(self, x: Tensor, wavelength_m: float, extent_m: float, n_pulse: int) -> Tensor:
        """Compute a scale for each unknown: the change that alters phases by about a radian.

        The phases are those of scatterers at the edge of the target, which is assumed to be as wide
        as the pulse rate allows. The change of the rotation rate (or of the angle) is limited to
        its value in `x`, that of yc to `extent_m`.

        Args:
            x: Unknowns, shape (..., n).
            wavelength_m: Wavelength in metres.
            extent_m: Extent of the target in range in metres.
            n_pulse: Number of pulses.

        Returns:
            The changes, positive, shape (..., n).
        """
        raw, t = self.variables == "raw", self.duration_s
        # of a raw unknown: the k_i that makes q_(i+1) = 1 where all others are 0 and small
        scales = [
            math.factorial(2 * i + 2) / (2 * math.factorial(i + 1) * t**i) if raw else 1 for i in range(1, self.order)
        ]
        k = [torch.full_like(x[..., 0], scale * (4 / n_pulse)) for scale in scales]
        if not self.range_term:
            return torch.stack(k, -1)
        size = torch.where(x[..., 0] != 0, x[..., 0].abs(), 1)
        angle = size * t if raw else size
        depth = wavelength_m / (2 * math.pi * angle.square())
        return torch.stack(
            [size * (depth / extent_m).clamp_max(1), *k, *((depth.clamp_max(extent_m),) if self.yc else ())], -1
        )

    def vector(self, values: Sequence[float] | Tensor, what: str) -> Tensor:
        """Convert numbers, one per unknown, to a vector, and check how many they are.

        Args:
            values: The numbers, shape (..., n).
            what: Name of the argument for the error message.

        Returns:
            The vector, shape (..., n), float64.

        Raises:
            ValueError: If there is not one value per unknown.
        """
        x = torch.as_tensor(values, dtype=torch.float64)
        if x.ndim == 0 or x.shape[-1] != len(self.names):
            raise ValueError(
                f"{what} must hold the {len(self.names)} values {', '.join(self.names)}, got "
                f"{x.shape[-1] if x.ndim else 1}"
            )
        return x

    def _phi(self, k: Tensor) -> Tensor:
        """phi(T), (...,)."""
        return warp(torch.full((1,), self.duration_s, dtype=k.dtype, device=k.device), k)[..., 0]


def k_name(i: int) -> str:
    """Return the name, with its unit, of the relative derivative k_i of the rotation rate.

    Args:
        i: Order of the derivative, from 1.

    Returns:
        The name: k1_per_s, k2_per_s2, and so on.
    """
    return f"k{i}_per_s{i if i > 1 else ''}"


def values_of(omega_rad_s: Tensor, warp_k: Tensor, yc_m: Tensor) -> dict[str, Tensor]:
    """Name the parameters of a rotation as an estimate does.

    Args:
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: Relative derivatives k1, k2, ... of the rotation rate in 1/s, 1/s^2, ..., shape
            (..., order - 1).
        yc_m: Range centre deviation in metres, shape (...,).

    Returns:
        `omega_rad_s`, `yc_m`, `warp_k`, and each entry of `warp_k` as `k1_per_s`, `k2_per_s2`, ...
    """
    named = {k_name(i): k for i, k in enumerate(warp_k.unbind(-1), 1)}
    return {"omega_rad_s": omega_rad_s, "yc_m": yc_m, "warp_k": warp_k, **named}


def uniform_rotation(radar: InverseRadar, names: Iterable[str], yc_m: Tensor | float | None) -> Mapping[str, Any]:
    """Return the rotation that is assumed where it cannot be estimated.

    Args:
        radar: Radar parameters.
        names: Names of the parameters of the rotation.
        yc_m: Range centre deviation in metres that is known a priori; None for an unknown one.

    Returns:
        Values by name: the nominal `omega_rad_s` of the radar (0 if there is none), the known
        `yc_m` (0 if there is none), and 0 for all others.
    """
    known = {"omega_rad_s": radar.rotation_rad_s or 0.0, "yc_m": 0.0 if yc_m is None else yc_m}
    return {name: known.get(name, 0.0) for name in names}
