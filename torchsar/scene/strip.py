"""World of a strip: a scene seen from a straight path, range histories and beams."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from torchsar.radar import StripmapRadar
from torchsar.scene.movers import MovingScene
from torchsar.scene.targets import Scene
from torchsar.scene.trials import finite_numbers, with_dims


class Path(Protocol):
    """Range history of a target on a straight path."""

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor:
        """Return the slant range.

        Args:
            since_s: Slow time since closest approach in seconds, float64.
            closest_m: Closest range in metres, float64.
            velocity_m_s: Effective velocity in m/s, float64.

        Returns:
            Slant range in metres; all arguments broadcast.
        """
        ...

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float:
        """Return the largest phase that this range history neglects within an aperture.

        Args:
            radar: Radar parameters.
            range_m: Closest range in metres.
            since_s: Slow time of the aperture end since closest approach in seconds.

        Returns:
            Phase in radians.
        """
        ...


@dataclass(frozen=True)
class Hyperbola(Path):
    """Exact range history of a straight path, r(t) = sqrt(r0^2 + v^2 t^2), constant during a pulse.

    >>> import torch
    >>> from torchsar import scene
    >>> since_s = torch.tensor([-30.0, 0.0, 30.0])
    >>> scene.Hyperbola().range_m(since_s, torch.tensor(4000.0), torch.tensor(100.0)).tolist()
    [5000.0, 4000.0, 5000.0]

    The history neglects the motion within the pulse. The Doppler shift, which this motion causes,
    would displace the echo of a chirp in range and change its phase.
    """

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor:
        x2 = (velocity_m_s * since_s).square()
        return closest_m + x2 / (torch.sqrt(closest_m.square() + x2) + closest_m)

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float:
        """Return the phase at the ends of the pulse due to motion within the pulse.

        The phase is pi f_d T, with the Doppler shift f_d at the end of the aperture relative to
        that at closest approach, and the length T of the pulse.

        Args:
            radar: Radar parameters.
            range_m: Closest range in metres.
            since_s: Slow time of the aperture end since closest approach in seconds.

        Returns:
            Phase in radians.
        """
        closing = radar.velocity_m_s**2 * since_s / math.hypot(range_m, radar.velocity_m_s * since_s)
        return 2 * math.pi * closing / radar.wavelength_m * radar.pulse.duration_s


@dataclass(frozen=True)
class Parabola(Path):
    """Second-order range history, r(t) = r0 + v^2 t^2 / (2 r0).

    >>> import torch
    >>> from torchsar import scene
    >>> since_s = torch.tensor([-30.0, 0.0, 30.0])
    >>> scene.Parabola().range_m(since_s, torch.tensor(4000.0), torch.tensor(100.0)).tolist()
    [5125.0, 4000.0, 5125.0]

    This range history neglects the terms of the hyperbola from t^4 on; see `neglected_phase_rad`.

    Reference:
        Tsvetkov 2017, Eq. (2).
    """

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor:
        return closest_m + (velocity_m_s * since_s).square() / (2 * closest_m)

    def neglected_db(
        self, radar: StripmapRadar, doppler_hz: float, velocity_m_s: float, range_m: float, dwell_s: float
    ) -> float:
        """Predict the relative error of the echo of a target, mean |exp(j phi) - 1|^2 in dB.

        phi is the phase difference between the echoes by the parabola and by the exact hyperbola;
        the mean is over the time for which the target is illuminated.

        Args:
            radar: Radar parameters.
            doppler_hz: Doppler of the beam centre in Hz.
            velocity_m_s: Effective velocity in m/s.
            range_m: Slant range of the target at the beam centre in metres.
            dwell_s: Time for which the target is illuminated in seconds.

        Returns:
            Error in dB.
        """
        sine = radar.sin_squint(doppler_hz, velocity_m_s)
        closest, velocity = range_m * torch.sqrt(1 - sine**2), torch.tensor(velocity_m_s, dtype=torch.float64)
        since = range_m * sine / velocity_m_s + dwell_s * torch.linspace(-0.5, 0.5, 65, dtype=torch.float64)
        wrong = self.range_m(since, closest, velocity) - Hyperbola().range_m(since, closest, velocity)
        error = float((2 - 2 * torch.cos(4 * math.pi / radar.wavelength_m * wrong)).mean())
        return 10 * math.log10(max(error, 1e-30))

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float:
        """Return the phase difference to the exact hyperbola at the end of the aperture.

        The phase is about pi x^4 / (2 lambda r^3), with the closest range r and the along-track
        distance x of the end of the aperture from closest approach.

        Args:
            radar: Radar parameters.
            range_m: Closest range in metres.
            since_s: Slow time of the aperture end since closest approach in seconds.

        Returns:
            Phase in radians.
        """
        x2 = (radar.velocity_m_s * since_s) ** 2
        exact = x2 / (math.sqrt(range_m**2 + x2) + range_m)
        return 4 * math.pi / radar.wavelength_m * (x2 / (2 * range_m) - exact)


class Beam(Protocol):
    """Two-way illumination of a target."""

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        """Return the two-way amplitude gain.

        Args:
            since_s: Slow time since the beam centre crossed the target in seconds, shape (...,
                pulse, target), float64.
            doppler_offset_hz: Doppler frequency of the target relative to the beam centre in hertz,
                same shape.
            velocity_m_s: Effective velocity in m/s, broadcastable.

        Returns:
            Gain, shape (..., pulse, target), float64.
        """
        ...


@dataclass(frozen=True)
class AlwaysLit(Beam):
    """Beam that illuminates every target in every pulse.

    >>> import torch
    >>> from torchsar import scene
    >>> since_s = torch.tensor([[-1.0], [0.0], [1.0]])  # pulses, one target
    >>> scene.AlwaysLit().weight(since_s, 25 * since_s, torch.tensor(50.0))[:, 0]
    tensor([1., 1., 1.])
    """

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        return torch.ones_like(since_s)


@dataclass(frozen=True)
@finite_numbers(dwell_s="positive")
class Dwell(Beam):
    """Beam of constant gain and limited dwell time.

    >>> import torch
    >>> from torchsar import scene
    >>> since_s = torch.tensor([[-1.0], [0.0], [1.0]])  # pulses, one target
    >>> scene.Dwell(dwell_s=1.5).weight(since_s, 25 * since_s, torch.tensor(50.0))[:, 0]
    tensor([0., 1., 0.])

    Args:
        dwell_s: Time for which a target is illuminated, centred on its crossing of the beam centre,
            in seconds.

    Raises:
        ValueError: If the time is not positive.
    """

    dwell_s: Tensor | float

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        # A tolerance includes the pulses at both ends of a dwell. Otherwise rounding errors would
        # decide, and the result would depend on the processor.
        half = with_dims(self.dwell_s, 2, since_s) / 2 * (1 + 1e-9)
        return (since_s.abs() <= half).to(since_s.dtype)


@dataclass(frozen=True)
@finite_numbers(length_m="positive")
class Antenna(Beam):
    """Beam of a uniform aperture, side lobes included.

    >>> import torch
    >>> from torchsar import scene
    >>> since_s = torch.tensor([[-1.0], [0.0], [1.0]])  # pulses, one target
    >>> scene.Antenna(length_m=2.0).weight(since_s, 25 * since_s, torch.tensor(50.0))[:, 0]
    tensor([0.4053, 1.0000, 0.4053])

    The two-way amplitude gain is sinc^2(length_m f / (2 v)) at the Doppler frequency f relative to
    the beam centre, with the velocity v and sinc(x) = sin(pi x) / (pi x).

    Args:
        length_m: Length of the aperture in metres.

    Raises:
        ValueError: If the length is not positive.
    """

    length_m: Tensor | float

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        return torch.sinc(with_dims(self.length_m, 2, since_s) * doppler_offset_hz / (2 * velocity_m_s)).square()


@dataclass(frozen=True)
@finite_numbers()
class StripmapWorld:
    """Scene seen from a straight path, with its illumination, true motion of the radar and noise.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sensor = radar.StripmapRadar(3.2e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.1), doppler_hz=25.0)
    >>> recording, truth = echo.simulate(sensor, world, n_pulse=64, n_range=128, draws=Draws(1))
    >>> recording.signal.data.shape, float(truth.values["doppler_hz"])
    (torch.Size([64, 128]), 25.0)

    Args:
        scene: Scatterers.
        beam: Illumination.
        path: Range history.
        velocity_m_s: True effective velocity in m/s, None for the nominal one of the radar.
        doppler_hz: True Doppler frequency of the beam centre in hertz, None for the nominal
            pointing of the radar.
        snr_db: Mean signal power of the illuminated raw samples over the noise variance in
            decibels, None for no noise.
        movers: Moving targets, such as MovingPoints, None for none. Their positions are those at
            the middle pulse, in the frame of the scene, and their speeds those along the track and
            along the closest range.

    Raises:
        ValueError: If a number is not finite.
    """

    scene: Scene
    beam: Beam = field(default_factory=AlwaysLit)
    path: Path = field(default_factory=Hyperbola)
    velocity_m_s: Tensor | float | None = None
    doppler_hz: Tensor | float | None = None
    snr_db: Tensor | float | None = None
    movers: MovingScene | None = None
