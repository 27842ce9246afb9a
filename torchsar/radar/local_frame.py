"""Local Cartesian coordinates (east, north, up) and geocentric ones (ECEF), in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar.antenna_path import refuse_unusable
from torchsar.radar.orbit import EARTH_RADIUS_M

FLATTENING = 1 / 298.257223563  # flattening of the ellipsoid of WGS 84
# square of the first eccentricity of the ellipsoid
_ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def geocentric(latitude_deg: Tensor, longitude_deg: Tensor, height_m: Tensor) -> Tensor:
    """Convert geodetic coordinates on WGS 84 to geocentric Cartesian ones (ECEF).

    >>> import torch
    >>> from torchsar import radar
    >>> latitude, longitude, height = torch.tensor([90.0, 0.0, 100.0]).double()  # over the pole
    >>> radar.geocentric(latitude, longitude, height).round(decimals=1).tolist()
    [0.0, 0.0, 6356852.3]

    With the radius N = a / sqrt(1 - e^2 sin^2 lat) of curvature in the prime vertical:

        x = (N + h) cos lat cos lon,  y = (N + h) cos lat sin lon,  z = (N (1 - e^2) + h) sin lat.

    Args:
        latitude_deg: Geodetic latitude in degrees, north positive, float64 (...).
        longitude_deg: Longitude in degrees, east positive, float64 (...).
        height_m: Height above the ellipsoid in metres, float64 (...).

    Returns:
        Positions in metres, float64 (..., 3). Axis z is that of the Earth, axis x meets the zero
        meridian.

    Raises:
        TypeError: If a tensor is not float64.
        ValueError: If a value is not finite, or a latitude is beyond +-90 degrees.
    """
    refuse_unusable(latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_m=height_m)
    if not bool((latitude_deg.detach().abs() <= 90).all()):
        raise ValueError(
            "latitude_deg must be -90 to 90 degrees, got values up to "
            f"{float(latitude_deg.detach().abs().max()):g} in magnitude; check the order of latitude and longitude"
        )
    latitude, longitude = torch.deg2rad(latitude_deg), torch.deg2rad(longitude_deg)
    sin, cos = torch.sin(latitude), torch.cos(latitude)
    normal = EARTH_RADIUS_M / torch.sqrt(1 - _ECCENTRICITY2 * sin.square())
    around = (normal + height_m) * cos
    z = (normal * (1 - _ECCENTRICITY2) + height_m) * sin
    return torch.stack(torch.broadcast_tensors(around * torch.cos(longitude), around * torch.sin(longitude), z), -1)


@dataclass(frozen=True)
class LocalFrame:
    """Local Cartesian coordinates (east, north, up) about a point on or above the Earth.

    >>> import torch
    >>> from torchsar import radar
    >>> frame = radar.LocalFrame(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0)
    >>> latitude, longitude, height = torch.tensor([48.01, 11.0, 600.0]).double()
    >>> frame.local_m(radar.geocentric(latitude, longitude, height)).round().long().tolist()
    [0, 1112, 100]

    The frame is tangent to the ellipsoid of WGS 84. With the geocentric position o of the origin,
    east = (x - o) . (-sin lon, cos lon, 0), north = (x - o) . (-sin lat cos lon, -sin lat sin lon,
    cos lat) and up = (x - o) . (cos lat cos lon, cos lat sin lon, sin lat): a rotation, so that
    ranges are those of the geocentric positions to 1e-9 m.

    Args:
        latitude_deg: Geodetic latitude of the origin in degrees, north positive.
        longitude_deg: Longitude of the origin in degrees, east positive.
        height_m: Height of the origin above the ellipsoid in metres.

    Raises:
        ValueError: If a number is not finite, or the latitude is beyond +-90 degrees.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0

    def __post_init__(self) -> None:
        geocentric(
            *(torch.tensor(v, dtype=torch.float64) for v in (self.latitude_deg, self.longitude_deg, self.height_m))
        )

    def local_m(self, geocentric_m: Tensor) -> Tensor:
        """Convert geocentric positions to this frame.

        Args:
            geocentric_m: Positions (ECEF) in metres, float64 (..., 3).

        Returns:
            East, north and up in metres, float64 (..., 3).

        Raises:
            TypeError: If the tensor is not float64.
            ValueError: If its last dimension is not 3, or a value is not finite.
        """
        origin, axes = self._axes("geocentric_m", geocentric_m)
        return (geocentric_m - origin) @ axes.mT

    def geocentric_m(self, local_m: Tensor) -> Tensor:
        """Convert positions in this frame to geocentric ones, the inverse of `local_m`.

        Args:
            local_m: East, north and up in metres, float64 (..., 3).

        Returns:
            Positions (ECEF) in metres, float64 (..., 3).

        Raises:
            TypeError: If the tensor is not float64.
            ValueError: If its last dimension is not 3, or a value is not finite.
        """
        origin, axes = self._axes("local_m", local_m)
        return local_m @ axes + origin

    def _axes(self, name: str, like: Tensor) -> tuple[Tensor, Tensor]:
        """Geocentric position of the origin, and unit vectors east, north and up, (3, 3).

        Raises an error unless `like` holds finite float64 positions of shape (..., 3).
        """
        refuse_unusable(**{name: like})
        if like.shape[-1:] != (3,):
            raise ValueError(f"{name} must have the shape (..., 3), got {tuple(like.shape)}")
        origin = geocentric(*(like.new_tensor(v) for v in (self.latitude_deg, self.longitude_deg, self.height_m)))
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        (s, c), (sl, cl) = ((math.sin(angle), math.cos(angle)) for angle in (latitude, longitude))
        return origin, like.new_tensor([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
