"""Two-body orbits of a transmitter, points that turn with the Earth, and the series of the range
between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial

EARTH_RADIUS_M = 6_378_137.0
EARTH_GRAVITY_M3_S2 = 3.986004418e14
EARTH_RATE_RAD_S = 7.2921159e-5
_NEWTON_STEPS = 30


@dataclass(frozen=True)
class Orbit:
    """A Kepler orbit about a spherical Earth, in the Earth-centred inertial frame: z along the axis
    of the Earth, angles from x.

    semi_major_m; eccentricity 0..0.9; inclination_deg, raan_deg (right ascension of the ascending
    node), argument_of_perigee_deg; mean_anomaly_deg at t = 0. Each a number or a tensor (...,) that
    may require gradients. Raises ValueError for what is no closed orbit above the ground.
    """

    semi_major_m: Tensor | float
    eccentricity: Tensor | float = 0.0
    inclination_deg: Tensor | float = 0.0
    raan_deg: Tensor | float = 0.0
    argument_of_perigee_deg: Tensor | float = 0.0
    mean_anomaly_deg: Tensor | float = 0.0

    def __post_init__(self) -> None:
        semi, eccentricity = (
            torch.as_tensor(x, dtype=torch.float64).detach() for x in (self.semi_major_m, self.eccentricity)
        )
        if not bool(((eccentricity >= 0) & (eccentricity <= 0.9)).all()):
            raise ValueError(f"eccentricity of an orbit must lie in 0..0.9, got {self.eccentricity}")
        if not bool((torch.isfinite(semi) & (semi * (1 - eccentricity) > EARTH_RADIUS_M)).all()):
            raise ValueError(
                f"an orbit of semi_major_m={self.semi_major_m} and eccentricity={self.eccentricity} "
                f"meets the ground; its perigee must exceed {EARTH_RADIUS_M:g} m"
            )
        for name in ("inclination_deg", "raan_deg", "argument_of_perigee_deg", "mean_anomaly_deg"):
            if not bool(torch.isfinite(torch.as_tensor(getattr(self, name), dtype=torch.float64).detach()).all()):
                raise ValueError(f"{name} of an orbit must be finite, got {getattr(self, name)}")

    @staticmethod
    def at_height(height_m: float, **elements: Tensor | float) -> Orbit:
        """With the semi-major axis height_m above the mean surface of the Earth."""
        return Orbit(EARTH_RADIUS_M + height_m, **elements)

    def state(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        """Position (m) and velocity (m/s) at float64 times (time,), (..., time, 3) each.

        Differentiable in the elements and in time.
        """
        semi, eccentricity = (per_trial(x, 1, time_s) for x in (self.semi_major_m, self.eccentricity))
        motion = torch.sqrt(EARTH_GRAVITY_M3_S2 / semi**3)
        anomaly = eccentric_anomaly(_radians(self.mean_anomaly_deg, time_s) + motion * time_s, eccentricity)
        flat, cos, sin = torch.sqrt(1 - eccentricity.square()), torch.cos(anomaly), torch.sin(anomaly)
        speed = semi * motion / (1 - eccentricity * cos)
        return self._turned(semi * (cos - eccentricity), semi * flat * sin), self._turned(
            -speed * sin, speed * flat * cos
        )

    def _turned(self, perigee: Tensor, ahead: Tensor) -> Tensor:
        """From the plane of the orbit, axes to the perigee and a quarter turn ahead, to the
        inertial frame: (..., time) -> (..., time, 3).
        """
        argument, tilt, node = (
            _radians(x, perigee) for x in (self.argument_of_perigee_deg, self.inclination_deg, self.raan_deg)
        )
        along = torch.cos(argument) * perigee - torch.sin(argument) * ahead
        across = torch.sin(argument) * perigee + torch.cos(argument) * ahead
        x = torch.cos(node) * along - torch.sin(node) * torch.cos(tilt) * across
        y = torch.sin(node) * along + torch.cos(node) * torch.cos(tilt) * across
        return torch.stack([x, y, (torch.sin(tilt) * across).expand(x.shape)], -1)


def _radians(degrees: Tensor | float, like: Tensor) -> Tensor:
    return per_trial(degrees, 1, like) * (math.pi / 180)


def eccentric_anomaly(mean_rad: Tensor, eccentricity: Tensor) -> Tensor:
    """E with E - e sin E = M, by Newton's method.

    The last step alone carries gradients, which at the solution are those of E itself.
    """
    with torch.no_grad():
        solution = mean_rad + eccentricity * torch.sin(mean_rad)
        for _ in range(_NEWTON_STEPS):
            solution = _newton(solution, mean_rad, eccentricity)
    return _newton(solution, mean_rad, eccentricity)


def _newton(anomaly: Tensor, mean_rad: Tensor, eccentricity: Tensor) -> Tensor:
    return anomaly - (anomaly - eccentricity * torch.sin(anomaly) - mean_rad) / (1 - eccentricity * torch.cos(anomaly))


def gravity_m_s2(position_m: Tensor) -> Tensor:
    """Acceleration of a body at (..., 3)."""
    return -EARTH_GRAVITY_M3_S2 * position_m / torch.linalg.vector_norm(position_m, dim=-1, keepdim=True) ** 3


def turned_with_earth(point_m: Tensor, time_s: Tensor) -> Tensor:
    """Where a point of the Earth, at point_m (..., 3) at t = 0 in the inertial frame, is at times
    (time,): (..., time, 3).
    """
    cos, sin = torch.cos(EARTH_RATE_RAD_S * time_s), torch.sin(EARTH_RATE_RAD_S * time_s)
    x, y, z = (point_m[..., None, i] for i in range(3))
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(torch.broadcast_shapes(x.shape, cos.shape))], -1)


def earth_velocity_m_s(point_m: Tensor) -> Tensor:
    """Velocity in the inertial frame of what turns with the Earth at (..., 3)."""
    x, y, z = point_m.unbind(-1)
    return EARTH_RATE_RAD_S * torch.stack([-y, x, torch.zeros_like(z)], -1)


def seen_point(
    position_m: Tensor,
    velocity_m_s: Tensor,
    off_nadir_deg: Tensor | float,
    squint_deg: Tensor | float = 0.0,
    side: float = 1.0,
) -> Tensor:
    """Point of the spherical Earth that a satellite (..., 3) sees off_nadir_deg from straight down,
    (..., 3) in the inertial frame.

    squint_deg turns the look about the nadir, from 0 across the path over the turning Earth (there
    k1 = 0 on a circular orbit) to 90 ahead along it; side: 1 right of the path, -1 left.
    off_nadir_deg, squint_deg: numbers or (...,). Raises ValueError where the look misses the Earth.
    """
    down = -torch.nn.functional.normalize(position_m, dim=-1)
    relative = velocity_m_s - earth_velocity_m_s(position_m)
    ahead = torch.nn.functional.normalize(relative - (relative * down).sum(-1, keepdim=True) * down, dim=-1)
    right = torch.linalg.cross(down, ahead)
    tilt, squint = (_radians(x, position_m) for x in (off_nadir_deg, squint_deg))
    look = torch.cos(tilt) * down + torch.sin(tilt) * (side * torch.cos(squint) * right + torch.sin(squint) * ahead)
    height = torch.linalg.vector_norm(position_m, dim=-1, keepdim=True)
    inside = EARTH_RADIUS_M**2 - (height * torch.sin(tilt)).square()
    if not bool((inside.detach() > 0).all()):
        raise ValueError(
            f"a look of {off_nadir_deg} degrees off nadir misses the Earth from "
            f"{float(height.detach().max()) / 1e3:g} km; stay below {_horizon_deg(height):.4g} "
            "degrees"
        )
    return position_m + (height * torch.cos(tilt) - torch.sqrt(inside)) * look


def _horizon_deg(height_m: Tensor) -> float:
    return math.degrees(math.asin(EARTH_RADIUS_M / float(height_m.detach().max())))


def power_series(series: Sequence[Tensor], power: float) -> list[Tensor]:
    """Taylor coefficients of s(t)^power from those of s(t), as many; s(0) must be positive
    (recurrence of J. C. P. Miller).
    """
    out = [series[0] ** power]
    for n in range(1, len(series)):
        terms = (((power + 1) * k - n) * series[k] * out[n - k] for k in range(1, n + 1))
        out.append(sum(terms, torch.zeros_like(series[0])) / (n * series[0]))
    return out


def _dot_series(series: Sequence[Tensor]) -> list[Tensor]:
    """Coefficients (..., 1) of the square of a vector's length."""
    return [
        sum(
            ((series[k] * series[n - k]).sum(-1, keepdim=True) for k in range(n + 1)),
            torch.zeros_like(series[0][..., :1]),
        )
        for n in range(len(series))
    ]


def orbit_series(position_m: Tensor, velocity_m_s: Tensor, order: int) -> list[Tensor]:
    """Taylor coefficients of a two-body orbit up to t^order, (..., 3) each."""
    series = [position_m, velocity_m_s]
    for n in range(order - 1):
        inverse = power_series(_dot_series(series), -1.5)
        pull = sum((inverse[k] * series[n - k] for k in range(n + 1)), torch.zeros_like(position_m))
        series.append(-EARTH_GRAVITY_M3_S2 * pull / ((n + 1) * (n + 2)))
    return series[: order + 1]


def earth_series(point_m: Tensor, order: int) -> list[Tensor]:
    """Taylor coefficients of the way of a point that turns with the Earth up to t^order, (..., 3)
    each.
    """
    series = [point_m]
    for n in range(order):
        series.append(earth_velocity_m_s(series[-1]) / (n + 1))
    return series


def range_coefficients(orbit: Orbit, point_m: Tensor, time_s: Tensor, order: int = 4) -> Tensor:
    """k1, k2, ... (m/s, m/s^2, ...) of R_T(t) = R_1T + k1 t + k2 t^2 + ...

    about time_s, float64 (..., time, order), exact and differentiable.

    point_m: (..., time, 3), the scene in the inertial frame at each of the times (time,), from
    where it turns with the Earth. With dr, dv, da the differences of position, velocity and
    acceleration, k1 = dr.dv / R and k2 = (dv.dv / R + dr.da / R - k1^2 / R) / 2: Remote Sens. 2020,
    12, 1703, Eqs. (8), (10), (11) with signs and factors put right (brief 001, erratum 2); higher
    ones by series arithmetic on the equations of motion.
    """
    position, velocity = orbit.state(time_s)
    apart = [a - b for a, b in zip(orbit_series(position, velocity, order), earth_series(point_m, order), strict=True)]
    return torch.cat(power_series(_dot_series(apart), 0.5)[1:], -1)


def orbit_range(orbit: Orbit, point_m: Tensor, epoch_s: float, time_s: Tensor) -> Tensor:
    """R_T(epoch + t) - R_T(epoch) (m), exact, float64 (..., time), formed as a difference.

    point_m: (..., 3), the scene at the epoch in the inertial frame.
    """
    start = (
        orbit.state(torch.as_tensor([epoch_s], dtype=torch.float64, device=time_s.device))[0] - point_m[..., None, :]
    )
    now = orbit.state(epoch_s + time_s)[0] - turned_with_earth(point_m, time_s)
    lengths = torch.linalg.vector_norm(now, dim=-1) + torch.linalg.vector_norm(start, dim=-1)
    return ((now - start) * (now + start)).sum(-1) / lengths
