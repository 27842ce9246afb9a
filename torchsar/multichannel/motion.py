"""Uniform motion of a point before a receiver that flies past: what its range history comes to, per
trial.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.radar import BistaticRadar

Number = Tensor | float


@dataclass(frozen=True)
class PointMotion:
    """Velocity and place of one point per trial, float64 tensors that broadcast to (...,), against
    the receiver's speed.

    u_r_m_s: slant-range speed, closing positive; u_a_m_s: along track, positive with the receiver;
    y0_m: along-track place at t = 0; range_m: closest range R0 of the track at rest. With v = speed
    - u_a and V^2 = v^2 + u_r^2 (brief 001, Symbols).
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
        """From numbers or tensors (...,), on the device of `like`; range_m: None for the radar's
        reference range. Raises ValueError for a point as fast as the receiver.
        """
        near = radar.reference_range_m if range_m is None else range_m
        motion = PointMotion(
            per_trial(u_r_m_s, 0, like),
            per_trial(u_a_m_s, 0, like),
            per_trial(y0_m, 0, like),
            per_trial(near, 0, like),
            radar.speed_m_s,
        )
        _refuse_overtaking(motion)
        return motion

    def each(self, change: Callable[[Tensor], Tensor]) -> PointMotion:
        """All four tensors changed alike, such as `lambda value: value[..., None]`."""
        return PointMotion(
            change(self.u_r_m_s), change(self.u_a_m_s), change(self.y0_m), change(self.range_m), self.speed_m_s
        )

    @property
    def along_m_s(self) -> Tensor:
        """v, along-track speed of the receiver past the point."""
        return self.speed_m_s - self.u_a_m_s

    @property
    def square_m2_s2(self) -> Tensor:
        """V^2."""
        return self.along_m_s.square() + self.u_r_m_s.square()

    @property
    def effective_m_s(self) -> Tensor:
        """v_e = V^2 / v, Eq. (25)."""
        return self.square_m2_s2 / self.along_m_s

    @property
    def trial_dims(self) -> int:
        """Number of trial dims of what depends on the velocities."""
        return max(self.u_r_m_s.ndim, self.u_a_m_s.ndim)

    @property
    def image_s(self) -> Tensor:
        """Slow time t0 of zero Doppler, where the focused point appears: (u_r R0 + v y0) / V^2."""
        return (self.u_r_m_s * self.range_m + self.along_m_s * self.y0_m) / self.square_m2_s2

    @property
    def closest_m(self) -> Tensor:
        """Least range of the whole straight path, sqrt(R0^2 + y0^2 - (u_r R0 + v y0)^2 / V^2)."""
        cross = self.along_m_s * self.range_m - self.u_r_m_s * self.y0_m
        return cross / self.square_m2_s2.sqrt()

    def place_m(self, image_s: Tensor) -> Tensor:
        """Along-track place y0 at t = 0 of a point that appears at this slow time: the location
        correction, Eq. (30) with its sign put right (brief 001, erratum 7).
        """
        return (self.square_m2_s2 * image_s - self.u_r_m_s * self.range_m) / self.along_m_s


def _refuse_overtaking(motion: PointMotion) -> None:
    try:
        slowest, nearest = float(motion.along_m_s.detach().min()), float(motion.range_m.detach().min())
        wild = [
            name
            for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
            if not bool(torch.isfinite(getattr(motion, name)).all())
        ]
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if wild:
        raise ValueError(
            f"velocity and place of a point must be finite, got NaN or Inf in {', '.join(wild)}; "
            "replace estimates that failed before they are used"
        )
    if not slowest > 0:
        fastest = motion.speed_m_s - slowest
        raise ValueError(
            f"a point moves along track at {fastest:g} m/s, as fast as the receiver "
            f"({motion.speed_m_s:g} m/s) or faster, so that no aperture forms; give u_a_m_s below "
            "that"
        )
    if not nearest > 0:
        raise ValueError(f"the closest range of a point must be positive, got range_m={nearest:g}")
