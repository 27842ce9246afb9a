"""A turntable that changes its rate: the angle is a polynomial of the time since the first pulse
(Remote Sens. 2025, 17, 3447, Eqs. 1-3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.core.warp import least_rate, warp, warp_rate
from torchsar.scene.vibration import refuse_unless_finite


@dataclass(frozen=True)
class PolynomialRotation:
    """theta(t) = omega_rad_s (t + k1 t^2 / 2! + k2 t^3 / 3!

    + ...), zero at the FIRST pulse, where t = 0; of any order.

    Not to be confused with an even rotation given as a number, which is zero at the middle pulse.
    omega_rad_s: rate at the first pulse, a number or a per-trial tensor (...,). k: (k1, k2, ...) in
    1/s, 1/s^2, ..., the TRUE derivatives of the rate at the first pulse over that rate (`core.warp`
    converts to and from coefficients of a polynomial), each a number or a per-trial tensor (...,),
    or all in one tensor (..., order - 1); empty for an even rotation. Raises ValueError for numbers
    that are not finite; a simulation refuses rates that fall to zero, see `refuse_turning_back`.
    """

    omega_rad_s: Tensor | float
    k: Sequence[Tensor | float] | Tensor = ()

    def __post_init__(self) -> None:
        refuse_unless_finite("omega_rad_s of a rotation", self.omega_rad_s)
        for order, value in enumerate(self._terms(), start=1):
            refuse_unless_finite(f"k{order} of a rotation", value)

    def _terms(self) -> Sequence[Tensor | float]:
        if not isinstance(self.k, Tensor):
            return tuple(self.k)
        if not self.k.ndim:
            raise ValueError(
                "k of a rotation must be a sequence (k1, k2, ...) or a tensor (..., order - 1), got "
                "a tensor without dims; write (k1,)"
            )
        return self.k.unbind(-1)

    def omega(self, like: Tensor) -> Tensor:
        """Rate at the first pulse, (*trials,) float64 on the device of `like`."""
        return per_trial(self.omega_rad_s, 0, like)

    def warp_k(self, like: Tensor) -> Tensor:
        """(k1, k2, ...) as one tensor (*trials, order - 1), float64 on the device of `like`."""
        terms = [per_trial(value, 0, like) for value in self._terms()]
        return (
            torch.stack(torch.broadcast_tensors(*terms), -1)
            if terms
            else torch.zeros(0, dtype=torch.float64, device=like.device)
        )

    def angle(self, time_s: Tensor) -> Tensor:
        """theta at float64 times since the first pulse (pulse,), rad, (*trials, pulse).

        Differentiable in omega and k.
        """
        return self.omega(time_s)[..., None] * warp(time_s, self.warp_k(time_s))

    def rate(self, time_s: Tensor) -> Tensor:
        """d theta / dt, rad/s, (*trials, pulse)."""
        return self.omega(time_s)[..., None] * warp_rate(time_s, self.warp_k(time_s))

    def acceleration(self, time_s: Tensor) -> Tensor:
        """d^2 theta / dt^2, rad/s^2, (*trials, pulse)."""
        k = self.warp_k(time_s)
        if not k.shape[-1]:
            return torch.zeros_like(self.rate(time_s))
        # the series of the rate one derivative on: k1 + k2 t + k3 t^2 / 2 ... begins with k1 where
        # a warp's rate begins with 1
        return self.omega(time_s)[..., None] * (k[..., :1] + warp_rate(time_s, k[..., 1:]) - 1)

    def mean_rate(self, duration_s: float, like: Tensor) -> Tensor:
        """Angle over 0..duration_s by the duration, (*trials,): the rate that an image without
        compensation is scaled by.
        """
        return self.angle(torch.tensor([duration_s], dtype=torch.float64, device=like.device))[..., 0] / duration_s

    def refuse_turning_back(self, duration_s: float) -> None:
        """Raise ValueError where, in any trial, the rate falls to zero or below within
        0..duration_s: two times then share an angle.
        """
        least = float(least_rate(self.warp_k(torch.zeros(0, dtype=torch.float64)).detach(), duration_s).min())
        if not least > 0:
            raise ValueError(
                f"the rotation rate falls to {least:.3g} of its first value within the "
                f"{duration_s:.6g} s of the record, so that two times share an angle and no image "
                "forms; "
                "choose other k, or record fewer pulses"
            )
