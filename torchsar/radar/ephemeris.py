"""The orbit of a transmitter in the numbers of a config, and the range that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from torchsar.radar.orbit import Orbit, range_coefficients, seen_point


@dataclass(frozen=True)
class Ephemeris:
    """Orbit of a transmitter over a rotating spherical Earth, and the point that it looks at.

    Args:
        height_m: Height above the Earth, at perigee and apogee alike where eccentricity is 0.
        eccentricity: Eccentricity of the orbit.
        inclination_deg: Inclination.
        raan_deg: Right ascension of the ascending node.
        argument_of_perigee_deg: Argument of perigee.
        mean_anomaly_deg: Mean anomaly at time zero.
        off_nadir_deg: Angle of the line of sight from the nadir.
        squint_deg: Angle of the line of sight ahead of the plane across the track.
        side: Side of the track that it looks to.
        time_s: Slow time zero after the mean anomaly given.
        order: Number of coefficients k1, k2, ... of the range to the transmitter.

    Raises:
        ValueError: If the height is not positive, or eccentricity or order are out of their range.
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
                "an orbit needs a positive height_m, eccentricity of 0 to 0.9 and order of 1 to 6, got "
                f"{self.height_m}, {self.eccentricity} and {self.order}"
            )

    def transmit_coefficients(self) -> tuple[float, ...]:
        """Compute k1, k2, ... of the range from the satellite to the point that it looks at.

        Returns:
            Coefficients of the polynomial in slow time, k_i in m/s^i.
        """
        names = ("eccentricity", "inclination_deg", "raan_deg", "argument_of_perigee_deg", "mean_anomaly_deg")
        orbit = Orbit.at_height(self.height_m, **{name: getattr(self, name) for name in names})
        time_s, side = torch.tensor([self.time_s], dtype=torch.float64), 1.0 if self.side == "right" else -1.0
        point = seen_point(*orbit.state(time_s), self.off_nadir_deg, self.squint_deg, side)
        return tuple(range_coefficients(orbit, point, time_s, self.order)[0].tolist())
