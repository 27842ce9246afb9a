"""Turntable with a rotation rate that changes.

Reference:
    Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.radar import InverseRadar
from torchsar.radar.warp import least_rate, warp, warp_rate
from torchsar.scene.trials import finite_numbers, refuse_unless_finite


@dataclass(frozen=True)
@finite_numbers("a rotation", k=None)
class PolynomialRotation:
    """Rotation with a polynomial angle, theta(t) = omega (t + k1 t^2 / 2! + k2 t^3 / 3! + ...).

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 2.5, 5.0], dtype=torch.float64)
    >>> scene.PolynomialRotation(omega_rad_s=0.1, k=[0.2]).rate(time_s).round(decimals=3).tolist()
    [0.1, 0.15, 0.2]

    The time t and the angle theta are zero at the FIRST pulse. The uniform rotation that
    `TurntableWorld.rotation_rad_s` gives is different: its angle is zero at the middle pulse. A
    simulation rejects a rotation whose rate falls to zero; see `refuse_turning_back`.

    Args:
        omega_rad_s: Rotation rate omega at the first pulse in rad/s.
        k: k1, k2, ... in 1/s, 1/s^2, ...: time derivatives of the rotation rate at the first pulse,
            divided by that rate. Either a sequence, each entry of which is a number or one value
            per trial, or one tensor of shape (..., order - 1), with the polynomial degree `order`
            of the angle. Empty for a uniform rotation.

    Raises:
        ValueError: If a number is not finite, or k is a tensor without dimensions.

    Reference:
        Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
    """

    omega_rad_s: Tensor | float
    k: Sequence[Tensor | float] | Tensor = ()

    def __post_init__(self) -> None:
        for order, value in enumerate(self._terms(), start=1):
            refuse_unless_finite(f"k{order} of a rotation", value)

    def _terms(self) -> Sequence[Tensor | float]:
        """Relative derivatives k1, k2, ... of the rotation rate, one by one."""
        return self.k.unbind(-1) if isinstance(self.k, Tensor) else tuple(self.k)

    def omega(self, like: Tensor) -> Tensor:
        """Return the rate at the first pulse.

        Args:
            like: Tensor that gives the device.

        Returns:
            Rate in rad/s, shape (*trials,), float64.
        """
        return per_trial(self.omega_rad_s, 0, like)

    def warp_k(self, like: Tensor) -> Tensor:
        """Return the parameters k1, k2, ... of the rotation as one tensor.

        k_i is derivative i of the rotation rate at the first pulse, divided by that rate.

        Args:
            like: Tensor that gives the device.

        Returns:
            k1, k2, ... in 1/s, 1/s^2, ..., shape (*trials, order - 1), float64.
        """
        terms = [per_trial(value, 0, like) for value in self._terms()]
        return (
            torch.stack(torch.broadcast_tensors(*terms), -1)
            if terms
            else torch.zeros(0, dtype=torch.float64, device=like.device)
        )

    def angle(self, time_s: Tensor) -> Tensor:
        """Return the rotation angle; differentiable in the parameters of the rotation.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Angle in radians, shape (*trials, pulse).
        """
        return self.omega(time_s)[..., None] * warp(time_s, self.warp_k(time_s))

    def rate(self, time_s: Tensor) -> Tensor:
        """Return the rotation rate.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Rate in rad/s, shape (*trials, pulse).
        """
        return self.omega(time_s)[..., None] * warp_rate(time_s, self.warp_k(time_s))

    def acceleration(self, time_s: Tensor) -> Tensor:
        """Return the angular acceleration.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Acceleration in rad/s^2, shape (*trials, pulse).
        """
        k = self.warp_k(time_s)
        if not k.shape[-1]:
            return torch.zeros_like(self.rate(time_s))
        # k1 + k2 t + k3 t^2 / 2 + ... is computed as the rate of a warp with the coefficients k2,
        # k3, ... whose first term is k1 instead of 1
        return self.omega(time_s)[..., None] * (k[..., :1] + warp_rate(time_s, k[..., 1:]) - 1)

    def mean_rate(self, duration_s: float, like: Tensor) -> Tensor:
        """Return the mean rotation rate, which scales cross range in an uncompensated image.

        Args:
            duration_s: Length of the record in seconds.
            like: Tensor that gives the device.

        Returns:
            Total angle divided by the duration in rad/s, shape (*trials,).
        """
        return self.angle(torch.tensor([duration_s], dtype=torch.float64, device=like.device))[..., 0] / duration_s

    def refuse_turning_back(self, duration_s: float) -> None:
        """Raise ValueError if the rate falls to zero within the record in any trial.

        Two times would then have the same angle, and no image could be formed.

        Args:
            duration_s: Length of the record in seconds.

        Raises:
            ValueError: If the rate falls to zero.
        """
        least = float(least_rate(self.warp_k(torch.zeros(0, dtype=torch.float64)).detach(), duration_s).min())
        if not least > 0:
            raise ValueError(
                f"the rotation rate falls to {least:.3g} of its first value within the "
                f"{duration_s:.6g} s of the record, so that two times have the same "
                "angle and no image can be formed; choose smaller k1, k2, ..., or record fewer pulses"
            )


Rotation = Tensor | float | PolynomialRotation


def rotation_angle(radar: InverseRadar, n_pulse: int, rotation: Rotation, like: Tensor) -> Tensor:
    """Return the rotation angle at the middle of each pulse.

    Args:
        radar: Radar parameters.
        n_pulse: Number of pulses.
        rotation: Rate in rad/s of a uniform rotation, a number or one value per trial, with the
            angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the angle zero at the
            first pulse.
        like: Tensor that gives the device.

    Returns:
        Angle in radians, shape (*trials, pulse), float64.

    Raises:
        ValueError: If the rate of a PolynomialRotation falls to zero within the record.
    """
    pulse = torch.arange(n_pulse, dtype=torch.float64, device=like.device)
    if isinstance(rotation, PolynomialRotation):
        rotation.refuse_turning_back(n_pulse / radar.prf_hz)
        return rotation.angle(pulse / radar.prf_hz)
    return per_trial(rotation, 1, like) * ((pulse - n_pulse // 2) / radar.prf_hz)
