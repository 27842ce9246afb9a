"""Geometry of spotlight and turntable recordings, exact and for plane waves.

Ground points have coordinates x, y, z in metres about the scene centre. A scatterer at the range r
relative to that centre (r grows away from the radar) has the phase -4 pi f r / c at the frequency
f. Range profiles are the centred, unitary inverse Fourier transform of such samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchsar.core import centred_fft, centred_ifft, checked_samples
from torchsar.radar.instrument import LIGHT_M_S


def range_profiles(samples: Tensor) -> Tensor:
    """Transform frequency samples to range profiles by a unitary inverse Fourier transform.

    >>> import torch
    >>> from torchsar import radar
    >>> samples = torch.ones(4, dtype=torch.complex64)  # of a point at range zero
    >>> radar.range_profiles(samples).abs().round(decimals=3).tolist()
    [0.0, 0.0, 2.0, 0.0]

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

    >>> import torch
    >>> from torchsar import radar
    >>> profile = torch.tensor([0, 0, 2, 0], dtype=torch.complex64)  # a point at range zero
    >>> radar.frequency_samples(profile).abs().round(decimals=3).tolist()
    [1.0, 1.0, 1.0, 1.0]

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
    step, steps = float(f[-1] - f[0]) / (f.shape[0] - 1), f.diff()
    # Stored frequencies are rounded, by 6e-4 of a step in the GOTCHA recording. A limit of 1 % of a
    # step still detects a missing or repeated frequency.
    if not (step > 0 and float((steps - step).abs().max()) <= 0.01 * step):
        raise ValueError(
            f"frequency_hz must rise in equal steps, got steps of {float(steps.min()):g} to "
            f"{float(steps.max()):g} Hz; sort or resample the frequencies"
        )
    return step


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Base class of geometries with frequencies, and with a vector and a range for each pulse.

    In `_names`, subclasses give the names of the fields with the vectors (pulse, 2 or 3) and with
    the ranges (pulse,), and in `_dims` the length of a vector.
    """

    frequency_hz: Tensor
    _names: ClassVar[tuple[str, str]]
    _dims: ClassVar[int]

    def __post_init__(self) -> None:
        frequency_step_hz(self.frequency_hz)
        vectors, ranges = (tuple(getattr(self, name).shape) for name in self._names)
        if vectors != (*ranges, self._dims) or len(ranges) != 1:
            raise ValueError(
                f"{self._names[0]} must have the shape (pulse, {self._dims}) and {self._names[1]} the shape (pulse,), "
                f"got {vectors} and {ranges}"
            )

    @property
    def pulses(self) -> int:
        """Number of pulses."""
        return getattr(self, self._names[0]).shape[0]

    def turned(self, angle_rad: float) -> Self:
        """Return the same geometry in ground coordinates that are turned about the scene centre.

        Args:
            angle_rad: Angle in radians by which the new x axis is turned towards the old y axis.
        """
        vectors, (cos, sin) = getattr(self, self._names[0]), (math.cos(angle_rad), math.sin(angle_rad))
        turn = vectors.new_tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])[: self._dims, : self._dims]
        return replace(self, **{self._names[0]: vectors @ turn})

    def to(self, device: torch.device | str) -> Self:
        """Return the same geometry with its tensors on another device."""
        names = ("frequency_hz", *self._names)
        return replace(self, **{name: getattr(self, name).to(device) for name in names})


@dataclass(frozen=True, eq=False)
class FarField(_Geometry):
    """Plane-wave geometry: the range of a ground point (x, y) is direction . (x, y) + offset.

    >>> import torch
    >>> from torchsar import radar
    >>> frequency_hz = torch.linspace(9e9, 10e9, 64, dtype=torch.float64)
    >>> angle_rad = torch.tensor([0.0, torch.pi / 2], dtype=torch.float64)
    >>> waves = radar.FarField.turntable(frequency_hz, angle_rad)
    >>> waves.range_m(slice(None), torch.tensor([3.0]), torch.tensor([2.0]))[:, 0].round(decimals=3)
    tensor([3., 2.], dtype=torch.float64)

    The curvature of the wavefront is neglected. `Spotlight.neglected_range_m` gives the resulting
    range error.

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

    direction: Tensor
    offset_m: Tensor
    wave_speed_m_s: float = LIGHT_M_S
    _names, _dims = ("direction", "offset_m"), 2

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
class Spotlight(_Geometry):
    """Spotlight geometry: antenna positions about the scene centre, and reference ranges.

    >>> import torch
    >>> from torchsar import radar
    >>> frequency_hz = torch.linspace(9e9, 10e9, 64).double()
    >>> position_m = torch.tensor([[0.0, -1000.0, 0.0]]).double()
    >>> geometry = radar.Spotlight(frequency_hz, position_m, torch.tensor([1000.0]).double())
    >>> round(geometry.neglected_range_m(torch.tensor([20.0]), torch.tensor([0.0])).item(), 3)
    0.2

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

    position_m: Tensor
    reference_m: Tensor
    height_m: float = 0.0
    wave_speed_m_s: float = LIGHT_M_S
    _names, _dims = ("position_m", "reference_m"), 3

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


def geometry_of(
    frequency_hz: Tensor | None,
    angle_rad: Tensor | None = None,
    position_m: Tensor | None = None,
    reference_m: Tensor | None = None,
    height_m: float = 0.0,
) -> FarField | Spotlight:
    """Build the imaging geometry from the frequencies and angles or positions of a recording.

    >>> import torch
    >>> from torchsar import radar
    >>> frequency_hz = torch.linspace(9e9, 10e9, 64, dtype=torch.float64)
    >>> position_m = torch.tensor([[-3.0, 0.0, 4.0]]).double()
    >>> geometry = radar.geometry_of(frequency_hz, position_m=position_m)
    >>> type(geometry).__name__, geometry.reference_m.tolist()
    ('Spotlight', [5.0])

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
