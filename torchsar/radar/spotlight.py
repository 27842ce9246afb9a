"""From where the pulses of a spotlight or turntable recording saw the scene, and what plane waves
neglect.

Ground points are x, y, z in metres about the scene centre. A scatterer at range r behind that
centre (r grows away from the radar) has the phase -4 pi f r / c at the frequency f; range profiles
are the centred unitary transform of such samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import centred_fft, centred_ifft
from torchsar.radar.stripmap import LIGHT_M_S

_STEP_TOLERANCE = 0.01


def range_profiles(samples: Tensor) -> Tensor:
    """Range profiles of frequency samples, both (..., n).

    Cell n // 2 lies at range zero, range grows away from the radar. Unitary.
    """
    return centred_ifft(samples) * math.sqrt(samples.shape[-1])


def frequency_samples(profiles: Tensor) -> Tensor:
    """Inverse and adjoint of range_profiles, (..., n) -> (..., n)."""
    return centred_fft(profiles) / math.sqrt(profiles.shape[-1])


def frequency_step_hz(frequency_hz: Tensor) -> float:
    """Step of a rising, uniform frequency axis (n,).

    Raises ValueError where it is neither, or has fewer than two entries.
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
    """Plane waves: the range of a ground point is direction . (x, y) + offset.

    frequency_hz: (n,), rising in equal steps. direction: (pulse, 2), what a step along x and along
    y adds to the range (the ground part of the unit vector away from the radar). offset_m:
    (pulse,), range of the scene centre. All float64. Neglects the curvature of the wavefront:
    `plane_wave_loss`, and exactly `Spotlight.neglected_range_m`.
    """

    frequency_hz: Tensor
    direction: Tensor
    offset_m: Tensor
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        frequency_step_hz(self.frequency_hz)
        if self.direction.ndim != 2 or self.direction.shape[-1] != 2 or self.offset_m.shape != self.direction.shape[:1]:
            raise ValueError(
                "direction must be (pulse, 2) and offset_m (pulse,), got "
                f"{tuple(self.direction.shape)} and {tuple(self.offset_m.shape)}"
            )

    @classmethod
    def turntable(cls, frequency_hz: Tensor, angle_rad: Tensor, wave_speed_m_s: float = LIGHT_M_S) -> FarField:
        """Range x cos a + y sin a for a target turned by a = angle_rad (pulse,)."""
        angle = _float64(angle_rad, "angle_rad", 1)
        return cls(
            _float64(frequency_hz, "frequency_hz", 1),
            torch.stack([torch.cos(angle), torch.sin(angle)], -1),
            torch.zeros_like(angle),
            wave_speed_m_s,
        )

    def turned(self, angle_rad: float) -> FarField:
        """The same waves in coordinates whose first axis points angle_rad from x towards y."""
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64, device=self.direction.device)
        return replace(self, direction=self.direction @ turn)

    def to(self, device: torch.device | str) -> FarField:
        """The same waves on another device."""
        return replace(
            self,
            frequency_hz=self.frequency_hz.to(device),
            direction=self.direction.to(device),
            offset_m=self.offset_m.to(device),
        )

    @property
    def pulses(self) -> int:
        return self.direction.shape[0]

    def range_m(self, pulses: slice, x: Tensor, y: Tensor) -> Tensor:
        """Range of the ground points x, y (point,) in the given pulses, float64 (pulse, point)."""
        u = self.direction[pulses]
        return u[:, :1] * x + u[:, 1:] * y + self.offset_m[pulses, None]


@dataclass(frozen=True, eq=False)
class Spotlight:
    """Antenna positions (pulse, 3) about the scene centre and the ranges (pulse,) to which the
    profiles refer, in metres, float64.

    frequency_hz: (n,), rising in equal steps. The range of a point p is |position - p| - reference.
    height_m: ground points lie at this z.
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
                "position_m must be (pulse, 3) and reference_m (pulse,), got "
                f"{tuple(self.position_m.shape)} and {tuple(self.reference_m.shape)}"
            )

    def turned(self, angle_rad: float) -> Spotlight:
        """The same antennas in coordinates whose first axis points angle_rad from x towards y."""
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        turn = torch.tensor(
            [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64, device=self.position_m.device
        )
        return replace(self, position_m=self.position_m @ turn)

    def to(self, device: torch.device | str) -> Spotlight:
        """The same antennas on another device."""
        return replace(
            self,
            frequency_hz=self.frequency_hz.to(device),
            position_m=self.position_m.to(device),
            reference_m=self.reference_m.to(device),
        )

    @property
    def pulses(self) -> int:
        return self.position_m.shape[0]

    def range_m(self, pulses: slice, x: Tensor, y: Tensor) -> Tensor:
        """Range of the ground points x, y (point,) in the given pulses, float64 (pulse, point)."""
        antenna = self.position_m[pulses, None, :]
        square = (
            (antenna[..., 0] - x).square() + (antenna[..., 1] - y).square() + (antenna[..., 2] - self.height_m).square()
        )
        return torch.sqrt(square) - self.reference_m[pulses, None]

    def far_field(self) -> FarField:
        """Plane waves that agree with this geometry, in range and in its first derivatives, at the
        centre of the ground plane.
        """
        down = self.position_m.new_tensor([0.0, 0.0, self.height_m]) - self.position_m
        distance = torch.linalg.vector_norm(down, dim=-1)
        return FarField(
            self.frequency_hz, down[:, :2] / distance[:, None], distance - self.reference_m, self.wave_speed_m_s
        )

    def neglected_range_m(self, x: Tensor, y: Tensor) -> Tensor:
        """Exact range minus that of plane waves, (pulse, point): rho^2 / (2 range) and smaller
        terms.
        """
        every = slice(None)
        return self.range_m(every, x, y) - self.far_field().range_m(every, x, y)

    def apparent(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Where plane waves show the ground points x, y (point,): the least-squares fit of their
        exact ranges over all pulses.

        Sampling a polar-format image there puts it on the true ground; what the fit leaves is its
        defocus. Needs an aperture that turns.
        """
        waves = self.far_field()
        fit = torch.linalg.lstsq(waves.direction, self.neglected_range_m(x, y)).solution
        return x + fit[0], y + fit[1]


@dataclass(frozen=True)
class PlaneWaveLoss:
    """What plane waves neglect at the edge of an image: where a point appears wrongly, and how far
    it is out of focus.

    total_rad: phase of the neglected range; all but defocus_rad of it only moves the point, by up
    to displacement_m on the ground, either way.
    """

    total_rad: float
    displacement_m: float
    defocus_rad: float


def plane_wave_loss(
    radius_m: float, range_m: float, aperture_rad: float, wavelength_m: float, elevation_rad: float = 0.0
) -> PlaneWaveLoss:
    """Upper bounds for a ground point radius_m from the scene centre, range_m from the radar, over
    an azimuth aperture of aperture_rad.

    The neglected range is d = (rho^2 - (u . p)^2) / (2 R) with u . p = rho cos(el) cos(azimuth from
    the line of sight). Its mean shifts range and its slope over the aperture shifts cross range;
    what a shifted point does not explain is d'' + d, at most rho^2 (1 + cos(el)^2) / (2 R), whose
    phase at the ends of the aperture is defocus_rad. For apertures below about 1 rad; terms of
    rho^3 / R^2 are left out.
    """
    if not (
        0 <= radius_m < range_m
        and 0 <= aperture_rad <= 2 * math.pi
        and wavelength_m > 0
        and abs(elevation_rad) < math.pi / 2
    ):
        got = f"{radius_m}, {range_m}, {aperture_rad}, {wavelength_m}, {elevation_rad}"
        raise ValueError(
            "need 0 <= radius_m < range_m, 0 <= aperture_rad <= 2 pi, wavelength_m > 0 and "
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
    """The geometry in the recorded side data: a turntable where there are angles, a spotlight where
    there are antenna positions.

    reference_m: by default the distance of the antenna from the scene centre. Raises ValueError
    where neither or both are given.
    """
    if frequency_hz is None or (angle_rad is None) == (position_m is None):
        given = [
            n
            for n, v in (("frequency_hz", frequency_hz), ("angle_rad", angle_rad), ("position_m", position_m))
            if v is not None
        ]
        raise ValueError(
            "need frequency_hz and either angle_rad or position_m (connect them with `use`, such "
            f"as angle_rad='aux.angle_rad'), got {given or 'none of them'}"
        )
    if angle_rad is not None:
        return FarField.turntable(frequency_hz, angle_rad)
    position = _float64(position_m, "position_m", 2)
    reference = (
        torch.linalg.vector_norm(position, dim=-1) if reference_m is None else _float64(reference_m, "reference_m", 1)
    )
    return Spotlight(_float64(frequency_hz, "frequency_hz", 1), position, reference, height_m)


def _float64(value: Tensor | None, name: str, ndim: int) -> Tensor:
    if not isinstance(value, Tensor) or value.dtype != torch.float64 or value.ndim != ndim:
        got = f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} must be a float64 tensor with {ndim} dims, shared by all trials, got {got}")
    return value
