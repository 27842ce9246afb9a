"""World of an acquisition from any path: scene and ground, true paths, navigation and beam."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.scene.flight import Flight, Navigation
from torchsar.scene.targets import Scene
from torchsar.scene.trials import positive, refuse_unless, refuse_unless_finite

# one-way amplitude pattern sinc(x) of a uniform aperture: x at half power, where sinc^2 is 1/2
_HALF_POWER = 0.442946
# times within a period of the sway at which its power is averaged, by choice
_SWAY_TIMES = 64


class Ground(Protocol):
    """Height of the ground."""

    def height_m(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Return the height.

        Args:
            x_m: Ground coordinates x in metres, shape (..., point), float64.
            y_m: Ground coordinates y in metres, same shape.

        Returns:
            Height z in metres, shape (..., point), float64.
        """
        ...


@dataclass(frozen=True)
class PlaneGround:
    """Plane z = height + slope_x x + slope_y y.

    Args:
        level_m: Height at x = y = 0 in metres.
        slope_x: Slope along x in metres per metre.
        slope_y: Slope along y in metres per metre.

    Raises:
        ValueError: If a number is not finite.
    """

    level_m: Tensor | float = 0.0
    slope_x: Tensor | float = 0.0
    slope_y: Tensor | float = 0.0

    def __post_init__(self) -> None:
        for name in ("level_m", "slope_x", "slope_y"):
            refuse_unless_finite(f"{name} of a ground plane", getattr(self, name))

    def height_m(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Return the height.

        Args:
            x_m: Ground coordinates x in metres, shape (..., point), float64.
            y_m: Ground coordinates y in metres, same shape.

        Returns:
            Height z in metres, shape (..., point), float64.
        """
        level, a, b = (per_trial(v, 1, x_m) for v in (self.level_m, self.slope_x, self.slope_y))
        return level + a * x_m + b * y_m


@dataclass(frozen=True, eq=False)
class GridGround:
    """Heights on a grid, interpolated linearly in both directions.

    Beyond the grid the height is that of the nearest edge.

    Args:
        level_m: Heights in metres, float64 (i, j), at x = x0_m + i step_m and y = y0_m + j step_m.
        x0_m: First coordinate x in metres.
        y0_m: First coordinate y in metres.
        step_m: Spacing in metres.

    Raises:
        ValueError: If there are fewer than 2 x 2 heights, a number is not finite, or the spacing is
            not positive.
    """

    level_m: Tensor
    x0_m: float
    y0_m: float
    step_m: float

    def __post_init__(self) -> None:
        level = torch.as_tensor(self.level_m, dtype=torch.float64)
        object.__setattr__(self, "level_m", level)
        if level.ndim != 2 or min(level.shape) < 2:
            raise ValueError(f"a ground grid needs at least 2 x 2 heights, got the shape {tuple(level.shape)}")
        refuse_unless_finite("level_m of a ground grid", level)
        refuse_unless_finite("the origin of a ground grid", (self.x0_m, self.y0_m))
        refuse_unless("step_m of a ground grid must be a positive number", self.step_m, positive)

    def height_m(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Return the height.

        Args:
            x_m: Ground coordinates x in metres, shape (..., point), float64.
            y_m: Ground coordinates y in metres, same shape.

        Returns:
            Height z in metres, shape (..., point), float64.
        """
        level = self.level_m.to(x_m.device)
        (i, u), (j, v) = (
            self._cell((at - start) / self.step_m, n)
            for at, start, n in ((x_m, self.x0_m, level.shape[0]), (y_m, self.y0_m, level.shape[1]))
        )
        low, high = (level[k, j] * (1 - v) + level[k, j + 1] * v for k in (i, i + 1))
        return low * (1 - u) + high * u

    @staticmethod
    def _cell(at: Tensor, n: int) -> tuple[Tensor, Tensor]:
        """Index of the cell, and position within it from 0 to 1."""
        at = at.clamp(0, n - 1)
        cell = at.detach().floor().clamp(max=n - 2)
        return cell.long(), at - cell


@dataclass(frozen=True)
class SideBeam:
    """Beam of a uniform aperture along the heading, with pointing errors.

    The one-way amplitude gain is sinc(x), where x is proportional to the difference between the
    sines of two angles ahead of broadside: that of the line of sight, and that of the beam centre,
    squint + yaw + sway sin(2 pi f t).

    Args:
        width_deg: One-way half-power width in degrees.
        squint_deg: Nominal angle of the beam centre ahead of broadside in degrees.
        yaw_deg: Constant pointing error in degrees.
        sway_deg: Amplitude of a sinusoidal pointing error in degrees.
        sway_hz: Its frequency in hertz.

    Raises:
        ValueError: If a number is not finite or the width is not between 0 and 180 degrees.
    """

    width_deg: Tensor | float
    squint_deg: Tensor | float = 0.0
    yaw_deg: Tensor | float = 0.0
    sway_deg: Tensor | float = 0.0
    sway_hz: Tensor | float = 0.0

    def __post_init__(self) -> None:
        within = "width_deg of a beam must be a number between 0 and 180 degrees, or one per trial"
        refuse_unless(within, self.width_deg, lambda x: (x > 0) & (x < 180))
        for name in ("squint_deg", "yaw_deg", "sway_deg", "sway_hz"):
            refuse_unless_finite(f"{name} of a beam", getattr(self, name))

    def gain(self, time_s: Tensor, ahead: Tensor) -> Tensor:
        """Return the one-way amplitude gain.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.
            ahead: Sine of the angle of the line of sight ahead of broadside, shape (..., pulse,
                point).

        Returns:
            Gain, shape (..., pulse, point), float64.
        """
        width, squint, yaw, sway, hz = (
            per_trial(v, 2, time_s)
            for v in (self.width_deg, self.squint_deg, self.yaw_deg, self.sway_deg, self.sway_hz)
        )
        centre = squint + yaw + sway * torch.sin(2 * math.pi * hz * time_s[:, None])
        off = ahead - torch.sin(torch.deg2rad(centre))
        return torch.sinc(_HALF_POWER * off / torch.sin(torch.deg2rad(width) / 2))

    def mean_power(self, ahead: Tensor) -> Tensor:
        """Return the two-way power gain of an antenna that transmits and receives.

        It is the mean over a period of the sway.

        Args:
            ahead: Sine of the angle of the line of sight ahead of broadside, shape (point,).

        Returns:
            Gain, shape (..., point), float64.
        """
        time_s = torch.arange(_SWAY_TIMES, dtype=torch.float64) / _SWAY_TIMES
        beam = replace(self, sway_hz=torch.as_tensor(self.sway_hz).sign())  # one period in a second, if it sways
        return beam.gain(time_s, ahead.expand(_SWAY_TIMES, -1)).pow(4).mean(-2)


@dataclass(frozen=True)
class PathWorld:
    """Scene seen from any path, by one antenna or by a transmitter and a receiver.

    A scatterer lies at x = range, y = azimuth, z = height of the ground. The middle of the range
    window, to which phases refer, follows the point (0, 0, 0) as navigation sees it, or has a
    constant range. Echoes beyond the window are not recorded.

    Args:
        scene: Scatterers.
        transmitter: True path of the transmitter.
        receiver: True path of the receiver; None if both share an antenna.
        navigation: What is recorded of the path of the transmitter.
        receiver_navigation: What is recorded of the path of the receiver.
        ground: Height of the ground.
        beam: Beam of the receiver, and of the transmitter if they share an antenna; None if the
            scene is always lit.
        window_range_m: Constant range of the middle of the window in metres, half the path of a
            bistatic pair; None to follow the middle of the scene.
        snr_db: Mean power of the samples of lit pulses over the noise variance in decibels, None
            for no noise.

    Raises:
        ValueError: If a number is not finite, or the range is negative.
    """

    scene: Scene
    transmitter: Flight
    receiver: Flight | None = None
    navigation: Navigation = field(default_factory=Navigation)
    receiver_navigation: Navigation = field(default_factory=Navigation)
    ground: Ground = field(default_factory=PlaneGround)
    beam: SideBeam | None = None
    window_range_m: float | None = None
    snr_db: Tensor | float | None = None

    def __post_init__(self) -> None:
        refuse_unless_finite("snr_db", self.snr_db)
        refuse_unless_finite("window_range_m", self.window_range_m, 0.0)
