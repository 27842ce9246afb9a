"""Orbit of a transmitter as given in a config, and the range polynomial that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from torchsar.radar.orbit import Orbit, range_coefficients, seen_point


@dataclass(frozen=True)
class Ephemeris:
    """Orbit of a transmitter over a rotating spherical Earth, and its line of sight to the scene.

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
