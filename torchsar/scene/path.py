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
from torchsar.scene.trials import finite_numbers, refuse_unless


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
@finite_numbers("a ground plane")
class PlaneGround(Ground):
    """Plane z = level_m + slope_x x + slope_y y.

    >>> import torch
    >>> from torchsar import scene
    >>> x_m = torch.tensor([0.0, 100.0], dtype=torch.float64)
    >>> scene.PlaneGround(level_m=10.0, slope_x=0.25).height_m(x_m, torch.zeros_like(x_m)).tolist()
    [10.0, 35.0]

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

    def height_m(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        level, a, b = (per_trial(v, 1, x_m) for v in (self.level_m, self.slope_x, self.slope_y))
        return level + a * x_m + b * y_m


@dataclass(frozen=True)
@finite_numbers("a beam", width_deg=None)
class SideBeam:
    """Beam of a uniform aperture along the heading, with pointing errors.

    >>> import torch
    >>> from torchsar import scene
    >>> ahead = torch.deg2rad(torch.tensor([[-5.0, 0.0, 5.0]])).sin()
    >>> scene.SideBeam(width_deg=10.0).gain(torch.zeros(1), ahead).square()  # power
    tensor([[0.5000, 1.0000, 0.5000]], dtype=torch.float64)

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
        # half power of the pattern: sinc^2(0.442946) = 1/2
        return torch.sinc(0.442946 * off / torch.sin(torch.deg2rad(width) / 2))

    def mean_power(self, ahead: Tensor) -> Tensor:
        """Return the two-way power gain of an antenna that transmits and receives.

        It is the mean over a period of the sway.

        Args:
            ahead: Sine of the angle of the line of sight ahead of broadside, shape (point,).

        Returns:
            Gain, shape (..., point), float64.
        """
        time_s = torch.arange(64, dtype=torch.float64) / 64
        # the period of a sway is set to one second
        beam = replace(self, sway_hz=torch.as_tensor(self.sway_hz).sign())
        return beam.gain(time_s, ahead.expand(64, -1)).pow(4).mean(-2)


@dataclass(frozen=True)
class MotionInSweep:
    """Fidelity of frequency-modulated sweeps: antennas also move within a sweep.

    >>> from torchsar import Draws, echo, radar, scene
    >>> fmcw = radar.InverseRadar(1e10, 1e8, 500.0, pulse_s=2e-3)
    >>> flight = scene.Flight(scene.StraightPath((-1000.0, -500.0, 0.0), (0.0, 40.0, 0.0)))
    >>> still = scene.PathWorld(scene.Points([0.0], [0.0]), flight)
    >>> moving = scene.PathWorld(still.scene, flight, fidelity=scene.MotionInSweep())
    >>> [int(echo.simulate_path(fmcw, world, 4, 32, Draws(1))[0].signal.data[0].abs().argmax())
    ...     for world in (still, moving)]  # 3.6 m nearer, 2.4 range cells
    [16, 14]

    The frequency rises by the bandwidth within `pulse_s`, and positions are those of its middle.
    Motion within a sweep displaces a point in range by its range rate times the carrier frequency
    over the chirp rate, and slightly blurs it; `compensate.CorrectSweepMotion` corrects both.

    Motion that changes slowly within a sweep is simulated to rounding (-180 dB in complex128).
    Vibrations with a large part of a cycle within a sweep are less exact: 1 mm along the line of
    sight at 10 GHz, with sweeps of 2 ms, has errors below -180 dB at 20 Hz, -130 to -90 dB at 200
    Hz and -75 to -55 dB at 500 Hz (one cycle), by the extent of the scene.
    """


@dataclass(frozen=True)
@finite_numbers(window_range_m=0.0)
class PathWorld:
    """Scene seen from any path, by one antenna or by a transmitter and a receiver.

    >>> from torchsar import Draws, echo, radar, scene
    >>> imager = radar.InverseRadar(carrier_hz=10e9, bandwidth_hz=150e6, prf_hz=100.0)
    >>> flight = scene.Flight(scene.StraightPath((-1000.0, -16.0, 500.0), (0.0, 50.0, 0.0)))
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]), flight, snr_db=10.0)
    >>> echo.simulate_path(imager, world, 64, 16, Draws(seed=1))[0].signal.data.shape
    torch.Size([64, 16])

    A scatterer lies at x = range, y = azimuth, z = height of the ground and of the scatterer above
    it. The middle of the range window, to which phases refer, follows the point (0, 0, 0) as
    navigation sees it, or has a constant range. Echoes beyond the window are not recorded. Antennas
    are at rest during a pulse (stop and go), unless the fidelity is `MotionInSweep`.

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
        fidelity: Motion within frequency-modulated sweeps; None for antennas at rest.

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
    fidelity: MotionInSweep | None = None
