"""Uniform motion of a point in front of an airborne receiver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import check_value, per_trial
from torchsar.radar import BistaticRadar

Number = Tensor | float
_VALUES = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")


@dataclass(frozen=True)
class PointMotion:
    """Velocity and position of one point per trial, and the speed of the receiver.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> motion = multichannel.PointMotion.of(receiver, torch.zeros(()), u_r_m_s=3.0)
    >>> round(receiver.speed_m_s * motion.image_s.item())  # m, by which an image shows it displaced
    50

    The tensors are float64 and broadcast to (...,). The derived quantities use v = V_R - u_a and
    V^2 = v^2 + u_r^2.

    Args:
        u_r_m_s: Slant-range speed u_r in m/s, closing positive.
        u_a_m_s: Along-track speed u_a in m/s, positive in the flight direction of the receiver.
        y0_m: Along-track position y0 at t = 0 in metres.
        range_m: Closest range R0 between the track and the point at rest in metres.
        speed_m_s: Speed V_R of the receiver in m/s.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (1), (2), (25), with y0 added.
    """

    u_r_m_s: Tensor
    u_a_m_s: Tensor
    y0_m: Tensor
    range_m: Tensor
    speed_m_s: float

    @staticmethod
    def of(
        radar: BistaticRadar,
        like: Tensor,
        u_r_m_s: Number = 0.0,
        u_a_m_s: Number = 0.0,
        y0_m: Number = 0.0,
        range_m: Number | None = None,
    ) -> PointMotion:
        """Build a motion from numbers or tensors (...,) on the device of `like`.

        Args:
            radar: Radar parameters.
            like: Tensor whose device is used.
            u_r_m_s: Slant-range speed in m/s, closing positive.
            u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver.
            y0_m: Along-track position at t = 0 in metres.
            range_m: Closest range in metres, None for the reference range of the radar.

        Returns:
            Motion with float64 tensors.

        Raises:
            ValueError: If a value is not finite, the point is as fast along track as the receiver,
                or the range is not positive.
        """
        near = radar.reference_range_m if range_m is None else range_m
        values = (per_trial(value, 0, like) for value in (u_r_m_s, u_a_m_s, y0_m, near))
        motion = PointMotion(*values, speed_m_s=radar.speed_m_s)
        finite = [torch.isfinite(getattr(motion, name)).all() for name in _VALUES]
        possible = [(value.detach() > 0).all() for value in (motion.along_m_s, motion.range_m)]
        check_value(torch.stack(finite + possible).all(), lambda fine: None if fine else _refuse(motion))
        return motion

    @staticmethod
    def imaged_at(
        radar: BistaticRadar, like: Tensor, u_r_m_s: Number, u_a_m_s: Number, image_s: Number, closest_m: Number
    ) -> PointMotion:
        """Return the motion of given velocities that an image shows at a slow time and range.

        It solves V Rmin = v R0 - u_r y0 and V^2 t = u_r R0 + v y0 for y0 and R0, see `image_s` and
        `closest_m`.

        Args:
            radar: Radar parameters.
            like: Tensor whose device is used.
            u_r_m_s: Slant-range speed in m/s, closing positive.
            u_a_m_s: Along-track speed in m/s.
            image_s: Slow time t in seconds at which an image of the stationary scene shows the
                point.
            closest_m: Range Rmin in metres at which it does.

        Returns:
            Motion with float64 tensors.

        Raises:
            ValueError: As `of`.
        """
        motion = PointMotion.of(radar, like.real, u_r_m_s, u_a_m_s)
        speed = motion.square_m2_s2.sqrt()
        least = torch.as_tensor(closest_m, dtype=torch.float64)
        turned = torch.as_tensor(image_s, dtype=torch.float64) * speed
        return replace(
            motion,
            range_m=(motion.along_m_s * least + motion.u_r_m_s * turned) / speed,
            y0_m=(motion.along_m_s * turned - motion.u_r_m_s * least) / speed,
        )

    def each(self, change: Callable[..., Tensor], *others: PointMotion) -> PointMotion:
        """Return the motion with a function applied to u_r_m_s, u_a_m_s, y0_m and range_m.

        The arguments of the function are the value of this motion, followed by those of `others`.
        """
        values = [change(*(getattr(motion, name) for motion in (self, *others))) for name in _VALUES]
        return PointMotion(*values, speed_m_s=self.speed_m_s)

    @property
    def along_m_s(self) -> Tensor:
        """Along-track speed of the receiver minus that of the point, v = V_R - u_a, in m/s."""
        return self.speed_m_s - self.u_a_m_s

    @property
    def square_m2_s2(self) -> Tensor:
        """Squared relative speed V^2 = v^2 + u_r^2 in m^2/s^2.

        v is the along-track speed of the receiver relative to the point, u_r the slant-range speed.
        """
        return self.along_m_s.square() + self.u_r_m_s.square()

    @property
    def effective_m_s(self) -> Tensor:
        """Relative sensor velocity v_e = V^2 / v in m/s.

        v is the along-track speed of the receiver relative to the point, and V^2 = v^2 + u_r^2 with
        the slant-range speed u_r.

        Reference:
            Remote Sens. 2020, 12, 1703, Eq. (25).
        """
        return self.square_m2_s2 / self.along_m_s

    @property
    def trial_dims(self) -> int:
        """Number of trial dimensions of the velocities u_r_m_s and u_a_m_s after broadcasting."""
        return max(self.u_r_m_s.ndim, self.u_a_m_s.ndim)

    @property
    def image_s(self) -> Tensor:
        """Slow time in seconds at which the point has zero Doppler and appears in an image.

        It is t0 = (u_r R0 + v y0) / V^2, with the slant-range speed u_r, the along-track speed v of
        the receiver relative to the point, V^2 = v^2 + u_r^2, the along-track position y0 at t = 0
        and the closest range R0 of the point at rest.
        """
        return (self.u_r_m_s * self.range_m + self.along_m_s * self.y0_m) / self.square_m2_s2

    @property
    def closest_m(self) -> Tensor:
        """Least range in metres between the receiver and the moving point.

        It is sqrt(R0^2 + y0^2 - (u_r R0 + v y0)^2 / V^2), with the closest range R0 of the point at
        rest, the along-track position y0 at t = 0, the slant-range speed u_r, the along-track speed
        v of the receiver relative to the point, and V^2 = v^2 + u_r^2.
        """
        return (self.along_m_s * self.range_m - self.u_r_m_s * self.y0_m) / self.square_m2_s2.sqrt()

    def position_m(self, image_s: Tensor) -> Tensor:
        """Return the along-track position y0 at t = 0 of a point that appears at a given slow time.

        This corrects the azimuth displacement of a moving target: a closing target (slant-range
        speed u_r > 0) appears displaced by +V_R u_r R0 / V^2 in azimuth x = V_R t, with the speed
        V_R of the receiver, the closest range R0 and the relative speed V.

        Args:
            image_s: Slow time in seconds at which the image shows the point, shape (...,).

        Returns:
            Along-track position in metres, shape (...,).

        Reference:
            Remote Sens. 2020, 12, 1703, Eq. (30), which is printed with the opposite sign.
        """
        return (self.square_m2_s2 * image_s - self.u_r_m_s * self.range_m) / self.along_m_s


def _refuse(motion: PointMotion) -> None:
    """Raise ValueError with the reason why a motion is impossible."""
    not_finite = [name for name in _VALUES if not bool(torch.isfinite(getattr(motion, name)).all())]
    slowest, nearest = (float(value.detach().min()) for value in (motion.along_m_s, motion.range_m))
    if not_finite:
        raise ValueError(
            f"velocity and position of a point must be finite, got NaN or Inf in {', '.join(not_finite)}; "
            "replace failed estimates before using them"
        )
    if not slowest > 0:
        fastest = motion.speed_m_s - slowest
        raise ValueError(
            f"a point moves along track at {fastest:g} m/s, as fast as the receiver "
            f"({motion.speed_m_s:g} m/s) or faster, so that no aperture forms; give a smaller u_a_m_s"
        )
    if not nearest > 0:
        raise ValueError(f"the closest range of a point must be positive, got range_m={nearest:g}")
