"""Two-body orbits of a transmitter, points on the rotating Earth, and the range between them.

`Ephemeris` describes an orbit and a line of sight as a config gives them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchsar.core import per_trial

EARTH_RADIUS_M = 6_378_137.0  # equatorial radius of WGS 84
EARTH_GRAVITY_M3_S2 = 3.986004418e14  # gravitational parameter GM of WGS 84
# rotation rate of the Earth: one rotation in a sidereal day of 86164.09 s
EARTH_RATE_RAD_S = 7.2921159e-5


@dataclass(frozen=True)
class Orbit:
    """Kepler orbit about a spherical Earth in the Earth-centred inertial frame.

    >>> import torch
    >>> from torchsar import radar
    >>> position_m, velocity_m_s = radar.Orbit.at_height(500e3).state(torch.zeros(1).double())
    >>> round(position_m.norm().item()), round(velocity_m_s.norm().item())
    (6878137, 7613)

    The z axis is the axis of the Earth; angles are counted from the x axis. Each element is a
    number or a tensor (...,) that may require gradients.

    Args:
        semi_major_m: Semi-major axis in metres.
        eccentricity: Eccentricity, 0 to 0.9.
        inclination_deg: Inclination in degrees.
        raan_deg: Right ascension of the ascending node in degrees.
        argument_of_perigee_deg: Argument of perigee in degrees.
        mean_anomaly_deg: Mean anomaly at t = 0 in degrees.

    Raises:
        ValueError: If the eccentricity is out of range, the perigee does not lie above the ground,
            or an angle is not finite.
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
                f"meets the ground; its perigee must lie above {EARTH_RADIUS_M:g} m from the centre of the Earth"
            )
        for name in ("inclination_deg", "raan_deg", "argument_of_perigee_deg", "mean_anomaly_deg"):
            if not bool(torch.isfinite(torch.as_tensor(getattr(self, name), dtype=torch.float64).detach()).all()):
                raise ValueError(f"{name} of an orbit must be finite, got {getattr(self, name)}")

    @staticmethod
    def at_height(height_m: float, **elements: Tensor | float) -> Orbit:
        """Return the orbit whose semi-major axis is the radius of the Earth plus a height.

        Args:
            height_m: Height in metres.
            **elements: Other elements of the orbit by name, such as `inclination_deg`.
        """
        return Orbit(EARTH_RADIUS_M + height_m, **elements)

    def state(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the position and velocity of the satellite at given times.

        Both are in the Earth-centred inertial frame, and differentiable in the elements of the
        orbit and in time.

        Args:
            time_s: Times in seconds, float64 (time,).

        Returns:
            Position in metres and velocity in m/s, float64 (..., time, 3) each.
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
        """Rotate components in the orbital plane (..., time) to the inertial frame (...,
        time, 3).
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
    """Convert degrees to radians, per trial."""
    return per_trial(degrees, 1, like) * (math.pi / 180)


def eccentric_anomaly(mean_rad: Tensor, eccentricity: Tensor) -> Tensor:
    """Solve Kepler's equation E - e sin E = M by Newton's method.

    Autograd differentiates only the last Newton step, whose gradient at the solution is that of E.

    Args:
        mean_rad: Mean anomaly M in radians.
        eccentricity: Eccentricity e; broadcasts with `mean_rad`.

    Returns:
        Eccentric anomaly E in radians.
    """

    def stepped(e: Tensor) -> Tensor:
        return e - (e - eccentricity * torch.sin(e) - mean_rad) / (1 - eccentricity * torch.cos(e))

    with torch.no_grad():
        solution = mean_rad + eccentricity * torch.sin(mean_rad)
        # the same number of steps for all trials; seven reach 1e-15 rad at the eccentricity 0.9
        for _ in range(30):
            solution = stepped(solution)
    return stepped(solution)


def turned_with_earth(point_m: Tensor, time_s: Tensor) -> Tensor:
    """Return the positions over time of a point that rotates with the Earth.

    Args:
        point_m: Position at t = 0 in the inertial frame in metres, shape (..., 3).
        time_s: Times in seconds, shape (time,).

    Returns:
        Positions in the inertial frame in metres, shape (..., time, 3).
    """
    cos, sin = torch.cos(EARTH_RATE_RAD_S * time_s), torch.sin(EARTH_RATE_RAD_S * time_s)
    x, y, z = (point_m[..., None, i] for i in range(3))
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(np.broadcast_shapes(x.shape, cos.shape))], -1)


def earth_velocity_m_s(point_m: Tensor) -> Tensor:
    """Return the inertial velocity in m/s of points (..., 3) that rotate with the Earth.

    Args:
        point_m: Inertial positions in metres, shape (..., 3).

    Returns:
        Velocity in m/s, shape (..., 3).
    """
    x, y, z = point_m.unbind(-1)
    return EARTH_RATE_RAD_S * torch.stack([-y, x, torch.zeros_like(z)], -1)


def seen_point(
    position_m: Tensor,
    velocity_m_s: Tensor,
    off_nadir_deg: Tensor | float,
    squint_deg: Tensor | float = 0.0,
    side: float = 1.0,
) -> Tensor:
    """Return the point of the spherical Earth on the line of sight of a satellite.

    >>> import torch
    >>> from torchsar import radar
    >>> position_m, velocity_m_s = radar.Orbit.at_height(500e3).state(torch.zeros(1).double())
    >>> point_m = radar.seen_point(position_m, velocity_m_s, off_nadir_deg=30.0)
    >>> round((point_m - position_m).norm().item() / 1e3)  # slant range in km
    585

    The squint rotates the line of sight about the nadir: 0 degrees is across the path of the
    satellite relative to the rotating Earth (on a circular orbit the range rate is then zero), 90
    degrees is ahead along that path.

    Args:
        position_m: Position of the satellite in the inertial frame in metres, shape (..., 3).
        velocity_m_s: Velocity of the satellite in m/s, shape (..., 3).
        off_nadir_deg: Angle between the line of sight and the nadir in degrees, shape (...,) or a
            number.
        squint_deg: Squint in degrees, shape (...,) or a number.
        side: 1 for the right of the path, -1 for the left.

    Returns:
        The point in the inertial frame in metres, shape (..., 3).

    Raises:
        ValueError: If the line of sight misses the Earth.
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
        highest = float(height.detach().max())
        raise ValueError(
            f"a line of sight {off_nadir_deg} degrees off nadir misses the Earth; stay below "
            f"{math.degrees(math.asin(EARTH_RADIUS_M / highest)):.4g} degrees for a satellite {highest / 1e3:g} km "
            "from the centre of the Earth"
        )
    return position_m + (height * torch.cos(tilt) - torch.sqrt(inside)) * look


def power_series(series: Sequence[Tensor], power: float) -> list[Tensor]:
    """Return the Taylor coefficients of s(t)^power from those of s(t).

    This is the recurrence of J. C. P. Miller.

    Args:
        series: Coefficients of s(t) in rising order; s(0) must be positive.
        power: Exponent.

    Returns:
        Taylor coefficients of s(t)^power, as many as in `series`.
    """
    out = [series[0] ** power]
    for n in range(1, len(series)):
        terms = (((power + 1) * k - n) * series[k] * out[n - k] for k in range(1, n + 1))
        out.append(sum(terms, torch.zeros_like(series[0])) / (n * series[0]))
    return out


def _dot_series(series: Sequence[Tensor]) -> list[Tensor]:
    """Taylor coefficients (..., 1) of the squared length of a vector, from those of the vector."""
    return [
        sum(
            ((series[k] * series[n - k]).sum(-1, keepdim=True) for k in range(n + 1)),
            torch.zeros_like(series[0][..., :1]),
        )
        for n in range(len(series))
    ]


def orbit_series(position_m: Tensor, velocity_m_s: Tensor, order: int) -> list[Tensor]:
    """Return the Taylor coefficients of the position on a two-body orbit, up to t^order.

    Args:
        position_m: Position at t = 0 in the inertial frame in metres, shape (..., 3).
        velocity_m_s: Velocity at t = 0 in m/s, shape (..., 3).
        order: Highest power of time.

    Returns:
        order + 1 coefficients in m, m/s, m/s^2, ..., shape (..., 3) each.
    """
    series = [position_m, velocity_m_s]
    for n in range(order - 1):
        inverse = power_series(_dot_series(series), -1.5)
        pull = sum((inverse[k] * series[n - k] for k in range(n + 1)), torch.zeros_like(position_m))
        series.append(-EARTH_GRAVITY_M3_S2 * pull / ((n + 1) * (n + 2)))
    return series[: order + 1]


def earth_series(point_m: Tensor, order: int) -> list[Tensor]:
    """Return the Taylor coefficients up to t^order of the path of a point fixed to the Earth.

    Args:
        point_m: Position at t = 0 in the inertial frame in metres, shape (..., 3).
        order: Highest power of time.

    Returns:
        order + 1 coefficients in m, m/s, m/s^2, ..., shape (..., 3) each.
    """
    series = [point_m]
    for n in range(order):
        series.append(earth_velocity_m_s(series[-1]) / (n + 1))
    return series


def range_coefficients(orbit: Orbit, point_m: Tensor, time_s: Tensor, order: int = 4) -> Tensor:
    """Return the Taylor coefficients k1, k2, ... of the transmit range about given times.

    >>> import torch
    >>> from torchsar import radar
    >>> orbit, time_s = radar.Orbit.at_height(500e3), torch.zeros(1).double()
    >>> point_m = radar.seen_point(*orbit.state(time_s), off_nadir_deg=30.0, squint_deg=20.0)
    >>> radar.range_coefficients(orbit, point_m, time_s, order=2).round().long().tolist()
    [[-1216, 39]]

    The transmit range R is that from the transmitter to the scene point. At the time t after a time
    of expansion it is R + k1 t + k2 t^2 + ...; the coefficients are exact and differentiable. With
    dr, dv, da the differences of position, velocity and acceleration between transmitter and point,
    k1 = dr.dv / R and k2 = (dv.dv / R + dr.da / R - k1^2 / R) / 2. Eqs. (10) and (11) as printed in
    the paper have another sign and other factors. Higher orders follow by series arithmetic from
    the equations of motion.

    Args:
        orbit: Orbit of the transmitter.
        point_m: Scene point in the inertial frame at each of the times in metres, shape (..., time,
            3); it rotates with the Earth.
        time_s: Times of expansion in seconds, float64 (time,).
        order: Number of coefficients.

    Returns:
        k1, k2, ... in m/s, m/s^2, ..., float64 (..., time, order).

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (8), (10), (11), corrected.
    """
    position, velocity = orbit.state(time_s)
    apart = [a - b for a, b in zip(orbit_series(position, velocity, order), earth_series(point_m, order), strict=True)]
    return torch.cat(power_series(_dot_series(apart), 0.5)[1:], -1)


def orbit_range(orbit: Orbit, point_m: Tensor, epoch_s: Tensor | float, time_s: Tensor) -> Tensor:
    """Return how the range from the transmitter to a scene point changes after an epoch.

    The change is exact. It is computed without subtracting two large ranges, so that it keeps its
    precision.

    Args:
        orbit: Orbit of the transmitter.
        point_m: Scene point at the epoch in the inertial frame in metres, shape (..., 3).
        epoch_s: Epoch in seconds, a number or shape (...,).
        time_s: Times t after the epoch in seconds, float64 (time,).

    Returns:
        Range at epoch + t minus range at the epoch, in metres, float64 (..., time).
    """
    epoch = torch.as_tensor(epoch_s, dtype=torch.float64, device=time_s.device)[..., None]
    start = orbit.state(epoch)[0] - point_m[..., None, :]
    now = orbit.state(epoch + time_s)[0] - turned_with_earth(point_m, time_s)
    lengths = torch.linalg.vector_norm(now, dim=-1) + torch.linalg.vector_norm(start, dim=-1)
    return ((now - start) * (now + start)).sum(-1) / lengths


@dataclass(frozen=True)
class Ephemeris:
    """Orbit of a transmitter over a rotating spherical Earth, and its line of sight to the scene.

    >>> from torchsar import radar
    >>> satellite = radar.Ephemeris(height_m=600e3, off_nadir_deg=30.0, squint_deg=20.0)
    >>> [round(k) for k in satellite.transmit_coefficients()[:2]]  # m/s and m/s^2
    [-1249, 34]

    Args:
        height_m: Semi-major axis minus the radius of the Earth, in metres; the height of the orbit
            where the eccentricity is 0.
        eccentricity: Eccentricity of the orbit, 0 to 0.9.
        inclination_deg: Inclination in degrees.
        raan_deg: Right ascension of the ascending node in degrees.
        argument_of_perigee_deg: Argument of perigee in degrees.
        mean_anomaly_deg: Mean anomaly at the epoch of the orbit, in degrees.
        off_nadir_deg: Angle between the line of sight and the nadir in degrees.
        squint_deg: Rotation of the line of sight about the nadir in degrees; 0 is across the track,
            90 is ahead.
        side: Side of the track to which the transmitter looks.
        time_s: Time in seconds from the epoch of the orbit to slow time zero.
        order: Number of coefficients k1, k2, ... of the range polynomial from the transmitter to
            the scene, 1 to 6.

    Raises:
        ValueError: If the height is not positive, or the eccentricity or the order is out of range.
    """

    height_m: float = 36_500e3
    eccentricity: float = 0.0
    inclination_deg: float = 60.0
    raan_deg: float = 195.5
    argument_of_perigee_deg: float = 270.0
    mean_anomaly_deg: float = 0.0
    off_nadir_deg: float = 7.0
    squint_deg: float = 0.0
    side: Literal["right", "left"] = "right"
    time_s: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        if not self.height_m > 0 or not 0 <= self.eccentricity <= 0.9 or not 1 <= self.order <= 6:
            raise ValueError(
                "an orbit needs a positive height_m, an eccentricity of 0 to 0.9 and an order of 1 to 6, got "
                f"height_m={self.height_m}, eccentricity={self.eccentricity} and order={self.order}"
            )

    def transmit_coefficients(self) -> tuple[float, ...]:
        """Compute the coefficients of the range from the satellite to the point that it looks at.

        Returns:
            Coefficients k1, k2, ... in m/s, m/s^2, ... of the change of range k1 t + k2 t^2 + ...
            with the slow time t.
        """
        names = ("eccentricity", "inclination_deg", "raan_deg", "argument_of_perigee_deg", "mean_anomaly_deg")
        orbit = Orbit.at_height(self.height_m, **{name: getattr(self, name) for name in names})
        time_s, side = torch.tensor([self.time_s], dtype=torch.float64), 1.0 if self.side == "right" else -1.0
        point = seen_point(*orbit.state(time_s), self.off_nadir_deg, self.squint_deg, side)
        return tuple(range_coefficients(orbit, point, time_s, self.order)[0].tolist())
