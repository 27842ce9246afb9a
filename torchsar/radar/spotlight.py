"""Geometry of spotlight and turntable recordings, and the error of the plane-wave approximation.

Ground points have coordinates x, y, z in metres about the scene centre. A scatterer at the range r
relative to that centre (r grows away from the radar) has the phase -4 pi f r / c at the frequency
f. Range profiles are the centred, unitary inverse Fourier transform of such samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import centred_fft, centred_ifft, checked_samples
from torchsar.radar.stripmap import LIGHT_M_S

# Largest relative error of a frequency step: stored frequencies are rounded, by 6e-4 of a step in
# the GOTCHA recording; 1 % of a step still rejects a missing or repeated frequency.
_STEP_TOLERANCE = 0.01


def range_profiles(samples: Tensor) -> Tensor:
    """Transform frequency samples to range profiles by a unitary inverse Fourier transform.

    Args:
        samples: Frequency samples, shape (..., n), complex.

    Returns:
        Range profiles, same shape. Cell n // 2 lies at range zero; range grows away from the radar.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    samples = checked_samples(samples, "range_profiles", "frequency", finite=False)
    return centred_ifft(samples) * math.sqrt(samples.shape[-1])


def frequency_samples(profiles: Tensor) -> Tensor:
    """Transform range profiles (..., n) to frequency samples, the inverse of `range_profiles`.

    The transform is unitary, so that it is also the adjoint.

    Args:
        profiles: Range profiles, shape (..., n), complex.

    Returns:
        Frequency samples, shape (..., n), complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    profiles = checked_samples(profiles, "frequency_samples", "range", finite=False)
    return centred_fft(profiles) / math.sqrt(profiles.shape[-1])


def frequency_step_hz(frequency_hz: Tensor) -> float:
    """Return the step of a rising, uniform frequency axis in Hz.

    Args:
        frequency_hz: Frequencies in Hz, shape (n,).

    Returns:
        Step in Hz.

    Raises:
        ValueError: If there are fewer than two frequencies, one of them is not positive, or the
            steps are not positive and equal within 1 %.
    """
    f = frequency_hz
    if f.ndim != 1 or f.shape[0] < 2 or not bool((torch.isfinite(f) & (f > 0)).all()):
        raise ValueError(
            f"frequency_hz must be two or more positive numbers (n,), got {f.dtype} of shape {tuple(f.shape)}"
        )
    step = float(f[-1] - f[0]) / (f.shape[0] - 1)
    steps = f.diff()
    if not (step > 0 and float((steps - step).abs().max()) <= _STEP_TOLERANCE * step):
        raise ValueError(
            f"frequency_hz must rise in equal steps, got steps of {float(steps.min()):g} to "
            f"{float(steps.max()):g} Hz; sort or resample the frequencies"
        )
    return step


@dataclass(frozen=True, eq=False)
class FarField:
    """Plane-wave geometry: the range of a ground point (x, y) is direction . (x, y) + offset.

    The curvature of the wavefront is neglected. `Spotlight.neglected_range_m` gives the resulting
    range error, `plane_wave_loss` bounds its effect on the image.

    Args:
        frequency_hz: Frequencies in Hz, float64 (n,), rising in equal steps.
        direction: Change of range per metre along x and y, float64 (pulse, 2): the x and y
            components of the unit vector that points away from the radar.
        offset_m: Range of the scene centre relative to range zero of the profiles in metres,
            float64 (pulse,).
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If the frequencies are not rising in equal steps, or the shapes do not match.
    """

    frequency_hz: Tensor
    direction: Tensor
    offset_m: Tensor
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        frequency_step_hz(self.frequency_hz)
        if self.direction.ndim != 2 or self.direction.shape[-1] != 2 or self.offset_m.shape != self.direction.shape[:1]:
            raise ValueError(
                "direction must have the shape (pulse, 2) and offset_m the shape (pulse,), got "
                f"{tuple(self.direction.shape)} and {tuple(self.offset_m.shape)}"
            )

    @classmethod
    def turntable(cls, frequency_hz: Tensor, angle_rad: Tensor, wave_speed_m_s: float = LIGHT_M_S) -> FarField:
        """Return the plane-wave geometry of a rotating target, with range x cos a + y sin a.

        Args:
            frequency_hz: Frequencies in Hz, float64 (n,).
            angle_rad: Rotation angles a in radians, float64 (pulse,).
            wave_speed_m_s: Propagation speed in m/s.

        Raises:
            TypeError: If a tensor is not float64 with one dimension.
        """
        angle = _float64(angle_rad, "angle_rad", 1)
        return cls(
            _float64(frequency_hz, "frequency_hz", 1),
            torch.stack([torch.cos(angle), torch.sin(angle)], -1),
            torch.zeros_like(angle),
            wave_speed_m_s,
        )

    def turned(self, angle_rad: float) -> FarField:
        """Return the same geometry in ground coordinates that are turned about the scene centre.

        Args:
            angle_rad: Angle in radians by which the new x axis is turned towards the old y axis.
        """
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64, device=self.direction.device)
        return replace(self, direction=self.direction @ turn)

    def to(self, device: torch.device | str) -> FarField:
        """Return the same plane-wave geometry with its tensors on another device."""
        return replace(
            self,
            frequency_hz=self.frequency_hz.to(device),
            direction=self.direction.to(device),
            offset_m=self.offset_m.to(device),
        )

    @property
    def pulses(self) -> int:
        """Number of pulses."""
        return self.direction.shape[0]

    def range_m(self, pulses: slice, x: Tensor, y: Tensor) -> Tensor:
        """Return the range of ground points in given pulses.

        Range is counted from range zero of the range profiles.

        Args:
            pulses: Slice of the pulses.
            x: Coordinate x of the points in metres, shape (point,).
            y: Coordinate y of the points in metres, shape (point,).

        Returns:
            Range in metres, float64 (pulse, point).
        """
        u = self.direction[pulses]
        return u[:, :1] * x + u[:, 1:] * y + self.offset_m[pulses, None]


@dataclass(frozen=True, eq=False)
class Spotlight:
    """Spotlight geometry: antenna positions about the scene centre, and reference ranges.

    In a range profile the point p lies at the range |position - p| - reference.

    Args:
        frequency_hz: Frequencies in Hz, float64 (n,), rising in equal steps.
        position_m: Antenna positions in metres, float64 (pulse, 3).
        reference_m: Range from the antenna in metres that is range zero of each profile, float64
            (pulse,).
        height_m: Coordinate z of the ground points in metres.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If the frequencies are not rising in equal steps, or the shapes do not match.
    """

    frequency_hz: Tensor
    position_m: Tensor
    reference_m: Tensor
    height_m: float = 0.0
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        frequency_step_hz(self.frequency_hz)
        if (
            self.position_m.ndim != 2
            or self.position_m.shape[-1] != 3
            or self.reference_m.shape != self.position_m.shape[:1]
        ):
            raise ValueError(
                "position_m must have the shape (pulse, 3) and reference_m the shape (pulse,), got "
                f"{tuple(self.position_m.shape)} and {tuple(self.reference_m.shape)}"
            )

    def turned(self, angle_rad: float) -> Spotlight:
        """Return the same geometry in ground coordinates that are turned about the scene centre.

        Args:
            angle_rad: Angle in radians by which the new x axis is turned towards the old y axis.
        """
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        turn = torch.tensor(
            [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64, device=self.position_m.device
        )
        return replace(self, position_m=self.position_m @ turn)

    def to(self, device: torch.device | str) -> Spotlight:
        """Return the same spotlight geometry with its tensors on another device."""
        return replace(
            self,
            frequency_hz=self.frequency_hz.to(device),
            position_m=self.position_m.to(device),
            reference_m=self.reference_m.to(device),
        )

    @property
    def pulses(self) -> int:
        """Number of pulses."""
        return self.position_m.shape[0]

    def range_m(self, pulses: slice, x: Tensor, y: Tensor) -> Tensor:
        """Return the range of ground points in given pulses.

        Range is counted from range zero of the range profiles.

        Args:
            pulses: Slice of the pulses.
            x: Coordinate x of the points in metres, shape (point,).
            y: Coordinate y of the points in metres, shape (point,).

        Returns:
            Range in metres, float64 (pulse, point).
        """
        antenna = self.position_m[pulses, None, :]
        square = (
            (antenna[..., 0] - x).square() + (antenna[..., 1] - y).square() + (antenna[..., 2] - self.height_m).square()
        )
        return torch.sqrt(square) - self.reference_m[pulses, None]

    def far_field(self) -> FarField:
        """Return the plane-wave approximation of this geometry about the scene centre.

        The range and its first derivatives are exact at x = y = 0 on the ground plane.
        """
        down = self.position_m.new_tensor([0.0, 0.0, self.height_m]) - self.position_m
        distance = torch.linalg.vector_norm(down, dim=-1)
        return FarField(
            self.frequency_hz, down[:, :2] / distance[:, None], distance - self.reference_m, self.wave_speed_m_s
        )

    def neglected_range_m(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the range that the plane-wave approximation neglects at ground points.

        It is the exact range minus that of the approximation, at most about rho^2 / (2 R) for a
        point at the distance rho from the scene centre and the antenna at the distance R.

        Args:
            x: Coordinate x of the points in metres, shape (point,).
            y: Coordinate y of the points in metres, shape (point,).

        Returns:
            Neglected range in metres, shape (pulse, point).
        """
        every = slice(None)
        return self.range_m(every, x, y) - self.far_field().range_m(every, x, y)

    def apparent(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the positions at which the plane-wave approximation shows ground points.

        The plane-wave ranges of these positions fit the exact ranges of the points in least squares
        over all pulses; the residual of the fit defocuses the points. A polar-format image that is
        sampled at these positions has no distortion. The azimuth angle must change over the
        aperture.

        Args:
            x: True coordinate x of the points in metres, shape (point,).
            y: True coordinate y of the points in metres, shape (point,).

        Returns:
            Apparent coordinates x and y in metres, shape (point,) each.
        """
        waves = self.far_field()
        fit = torch.linalg.lstsq(waves.direction, self.neglected_range_m(x, y)).solution
        return x + fit[0], y + fit[1]


@dataclass(frozen=True)
class PlaneWaveLoss:
    """Displacement and defocus of a point that the plane-wave approximation causes.

    Args:
        total_rad: Phase in radians of the range that the approximation neglects. All of it except
            `defocus_rad` only displaces the point.
        displacement_m: Largest displacement on the ground in metres, in range or in cross range.
        defocus_rad: Phase error at the ends of the aperture, in radians, that remains after the
            displacement.
    """

    total_rad: float
    displacement_m: float
    defocus_rad: float


def plane_wave_loss(
    radius_m: float, range_m: float, aperture_rad: float, wavelength_m: float, elevation_rad: float = 0.0
) -> PlaneWaveLoss:
    """Bound the displacement and defocus of a ground point by the plane-wave approximation.

    With the elevation el of the line of sight and the azimuth a of the point relative to the line
    of sight, the neglected range is d(a) = (rho^2 - (rho cos(el) cos(a))^2) / (2 R). Its mean over
    the aperture displaces the point in range, its slope in cross range.

    A displacement changes the range by terms in cos(a) and sin(a), for which the second derivative
    plus the function is zero. The defocus therefore follows from d'' + d, which is at most
    rho^2 (1 + cos(el)^2) / (2 R). At the ends of an aperture A it leaves the range error
    (d'' + d) (A / 2)^2 / 2, whose phase is `defocus_rad`.

    The bounds hold for apertures below about 1 rad, and leave out terms of order rho^3 / R^2.

    Args:
        radius_m: Distance rho of the point from the scene centre in metres.
        range_m: Range R of the scene centre in metres.
        aperture_rad: Azimuth aperture in radians.
        wavelength_m: Wavelength in metres.
        elevation_rad: Elevation of the line of sight in radians.

    Returns:
        Upper bounds of the phase of the neglected range, of the displacement and of the defocus.

    Raises:
        ValueError: If an argument is out of range.
    """
    if not (
        0 <= radius_m < range_m
        and 0 <= aperture_rad <= 2 * math.pi
        and wavelength_m > 0
        and abs(elevation_rad) < math.pi / 2
    ):
        got = f"{radius_m=}, {range_m=}, {aperture_rad=}, {wavelength_m=}, {elevation_rad=}"
        raise ValueError(
            "plane_wave_loss needs 0 <= radius_m < range_m, 0 <= aperture_rad <= 2 pi, wavelength_m > 0 and "
            f"|elevation_rad| < pi / 2, got {got}"
        )
    per_metre = 4 * math.pi / wavelength_m
    shift = radius_m**2 / (2 * range_m)
    cos = math.cos(elevation_rad)
    bend = (1 + cos**2) / 2 * (aperture_rad / 2) ** 2
    return PlaneWaveLoss(per_metre * shift, shift / cos, per_metre * shift * bend)


def geometry_of(
    frequency_hz: Tensor | None,
    angle_rad: Tensor | None = None,
    position_m: Tensor | None = None,
    reference_m: Tensor | None = None,
    height_m: float = 0.0,
) -> FarField | Spotlight:
    """Build the imaging geometry from the frequencies and angles or positions of a recording.

    Args:
        frequency_hz: Frequencies in Hz, float64 (n,).
        angle_rad: Rotation angles in radians, float64 (pulse,), or None.
        position_m: Antenna positions in metres, float64 (pulse, 3), or None.
        reference_m: Range from the antenna in metres that is range zero of each profile, float64
            (pulse,); by default the distance of the antenna from the scene centre.
        height_m: Coordinate z of the ground points in metres.

    Returns:
        FarField of a turntable if angles are given, Spotlight if antenna positions are given.

    Raises:
        ValueError: If the frequencies are missing, or not exactly one of angles and positions is
            given.
        TypeError: If a tensor is not float64 or has the wrong number of dimensions.
    """
    if frequency_hz is None or (angle_rad is None) == (position_m is None):
        given = [
            n
            for n, v in (("frequency_hz", frequency_hz), ("angle_rad", angle_rad), ("position_m", position_m))
            if v is not None
        ]
        raise ValueError(
            "the imaging geometry needs frequency_hz and either angle_rad or position_m (connect them with "
            f"`use`, such as angle_rad='aux.angle_rad'), got {given or 'none of them'}"
        )
    if angle_rad is not None:
        return FarField.turntable(frequency_hz, angle_rad)
    position = _float64(position_m, "position_m", 2)
    reference = (
        torch.linalg.vector_norm(position, dim=-1) if reference_m is None else _float64(reference_m, "reference_m", 1)
    )
    return Spotlight(_float64(frequency_hz, "frequency_hz", 1), position, reference, height_m)


def _float64(value: Tensor | None, name: str, ndim: int) -> Tensor:
    """Return the value if it is a float64 tensor with ndim dimensions, else raise TypeError."""
    if not isinstance(value, Tensor) or value.dtype != torch.float64 or value.ndim != ndim:
        got = f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} must be a float64 tensor with {ndim} dims, the same for all trials, got {got}")
    return value
