"""World of a rotating target, and models of its echo.

Turntable with a rotation rate that changes.

Reference:
    Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.radar import InverseRadar
from torchsar.radar.warp import least_rate, warp, warp_rate
from torchsar.scene.motion import Motion, PulsePhase, displacement_m
from torchsar.scene.targets import Scene
from torchsar.scene.trials import finite_numbers, refuse_unless_finite


@dataclass(frozen=True)
@finite_numbers("a rotation", k=None)
class PolynomialRotation:
    """Rotation with a polynomial angle, theta(t) = omega (t + k1 t^2 / 2! + k2 t^3 / 3! + ...).

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 2.5, 5.0], dtype=torch.float64)
    >>> scene.PolynomialRotation(omega_rad_s=0.1, k=[0.2]).rate(time_s).round(decimals=3).tolist()
    [0.1, 0.15, 0.2]

    The time t and the angle theta are zero at the FIRST pulse. The uniform rotation that
    `TurntableWorld.rotation_rad_s` gives is different: its angle is zero at the middle pulse. A
    simulation rejects a rotation whose rate falls to zero; see `refuse_turning_back`.

    Args:
        omega_rad_s: Rotation rate omega at the first pulse in rad/s.
        k: k1, k2, ... in 1/s, 1/s^2, ...: time derivatives of the rotation rate at the first pulse,
            divided by that rate. Either a sequence, each entry of which is a number or one value
            per trial, or one tensor of shape (..., order - 1), with the polynomial degree `order`
            of the angle. Empty for a uniform rotation.

    Raises:
        ValueError: If a number is not finite, or k is a tensor without dimensions.

    Reference:
        Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
    """

    omega_rad_s: Tensor | float
    k: Sequence[Tensor | float] | Tensor = ()

    def __post_init__(self) -> None:
        for order, value in enumerate(self._terms(), start=1):
            refuse_unless_finite(f"k{order} of a rotation", value)

    def _terms(self) -> Sequence[Tensor | float]:
        """Relative derivatives k1, k2, ... of the rotation rate, one by one."""
        return self.k.unbind(-1) if isinstance(self.k, Tensor) else tuple(self.k)

    def omega(self, like: Tensor) -> Tensor:
        """Return the rate at the first pulse.

        Args:
            like: Tensor that gives the device.

        Returns:
            Rate in rad/s, shape (*trials,), float64.
        """
        return per_trial(self.omega_rad_s, 0, like)

    def warp_k(self, like: Tensor) -> Tensor:
        """Return the parameters k1, k2, ... of the rotation as one tensor.

        k_i is derivative i of the rotation rate at the first pulse, divided by that rate.

        Args:
            like: Tensor that gives the device.

        Returns:
            k1, k2, ... in 1/s, 1/s^2, ..., shape (*trials, order - 1), float64.
        """
        terms = [per_trial(value, 0, like) for value in self._terms()]
        return (
            torch.stack(torch.broadcast_tensors(*terms), -1)
            if terms
            else torch.zeros(0, dtype=torch.float64, device=like.device)
        )

    def angle(self, time_s: Tensor) -> Tensor:
        """Return the rotation angle; differentiable in the parameters of the rotation.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Angle in radians, shape (*trials, pulse).
        """
        return self.omega(time_s)[..., None] * warp(time_s, self.warp_k(time_s))

    def rate(self, time_s: Tensor) -> Tensor:
        """Return the rotation rate.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Rate in rad/s, shape (*trials, pulse).
        """
        return self.omega(time_s)[..., None] * warp_rate(time_s, self.warp_k(time_s))

    def acceleration(self, time_s: Tensor) -> Tensor:
        """Return the angular acceleration.

        Args:
            time_s: Time since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Acceleration in rad/s^2, shape (*trials, pulse).
        """
        k = self.warp_k(time_s)
        if not k.shape[-1]:
            return torch.zeros_like(self.rate(time_s))
        # k1 + k2 t + k3 t^2 / 2 + ... is computed as the rate of a warp with the coefficients k2,
        # k3, ... whose first term is k1 instead of 1
        return self.omega(time_s)[..., None] * (k[..., :1] + warp_rate(time_s, k[..., 1:]) - 1)

    def mean_rate(self, duration_s: float, like: Tensor) -> Tensor:
        """Return the mean rotation rate, which scales cross range in an uncompensated image.

        Args:
            duration_s: Length of the record in seconds.
            like: Tensor that gives the device.

        Returns:
            Total angle divided by the duration in rad/s, shape (*trials,).
        """
        return self.angle(torch.tensor([duration_s], dtype=torch.float64, device=like.device))[..., 0] / duration_s

    def refuse_turning_back(self, duration_s: float) -> None:
        """Raise ValueError if the rate falls to zero within the record in any trial.

        Two times would then have the same angle, and no image could be formed.

        Args:
            duration_s: Length of the record in seconds.

        Raises:
            ValueError: If the rate falls to zero.
        """
        least = float(least_rate(self.warp_k(torch.zeros(0, dtype=torch.float64)).detach(), duration_s).min())
        if not least > 0:
            raise ValueError(
                f"the rotation rate falls to {least:.3g} of its first value within the "
                f"{duration_s:.6g} s of the record, so that two times have the same "
                "angle and no image can be formed; choose smaller k1, k2, ..., or record fewer pulses"
            )


Rotation = Tensor | float | PolynomialRotation


def rotation_angle(radar: InverseRadar, n_pulse: int, rotation: Rotation, like: Tensor) -> Tensor:
    """Return the rotation angle at the middle of each pulse.

    Args:
        radar: Radar parameters.
        n_pulse: Number of pulses.
        rotation: Rate in rad/s of a uniform rotation, a number or one value per trial, with the
            angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the angle zero at the
            first pulse.
        like: Tensor that gives the device.

    Returns:
        Angle in radians, shape (*trials, pulse), float64.

    Raises:
        ValueError: If the rate of a PolynomialRotation falls to zero within the record.
    """
    pulse = torch.arange(n_pulse, dtype=torch.float64, device=like.device)
    if isinstance(rotation, PolynomialRotation):
        rotation.refuse_turning_back(n_pulse / radar.prf_hz)
        return rotation.angle(pulse / radar.prf_hz)
    return per_trial(rotation, 1, like) * ((pulse - n_pulse // 2) / radar.prf_hz)


@dataclass(frozen=True)
class PhaseOnly:
    """Range-compressed pulses with fixed envelopes, in which only the phases change.

    >>> from torchsar import radar, scene
    >>> imager = radar.InverseRadar(10e9, 150e6, 100.0, rotation_rad_s=0.05, pulse_s=1e-4)
    >>> round(scene.PhaseOnly().neglected_phase_rad(imager, 64, cross_range_m=1.0, range_m=1.0), 2)
    0.05

    Rotation, motion and start phases act on the phases. The model is meant for studies of phase
    errors. It neglects migration of the envelopes, motion within the pulse, coupling of range and
    Doppler, and the residual video phase; see `neglected_phase_rad`. `Dechirped` is the more exact
    model.

    Reference:
        Ruan et al. 2013, Eqs. (1), (9).
    """

    def neglected_phase_rad(
        self,
        radar: InverseRadar,
        n_pulse: int,
        cross_range_m: float,
        range_m: float,
        speed_m_s: float = 0.0,
        rotation_rad_s: float | PolynomialRotation | None = None,
        centre_deviation_m: float = 0.0,
    ) -> float:
        """Return a bound of the phase difference between this model and the dechirped echo.

        The bound is the sum of the phases of four effects:

        - range migration, at the ends of the signal band. This is about pi x A / dr, with the cross
          range x of the scatterer, the largest rotation angle A and the range cell dr = c / (2 B);
        - motion by rotation and residual speed during half a pulse, at the carrier frequency;
        - what this motion adds at the ends of the signal band;
        - the residual video phase.

        Args:
            radar: Radar, with a pulse length.
            n_pulse: Number of pulses.
            cross_range_m: Cross range of the scatterer in metres.
            range_m: Range of the scatterer in metres.
            speed_m_s: Residual speed along the line of sight, not removed by tracking, in m/s.
            rotation_rad_s: Rotation rate in rad/s or rotation, None for the rate of the radar.
            centre_deviation_m: Distance yc in metres: the centre of rotation lies at the range -yc
                from the middle of the range window.

        Returns:
            Phase in radians, the largest of all pulses, samples and trials.

        Raises:
            ValueError: If the pulse length or the rotation rate is not known.
        """
        theta, omega = _swing(radar, n_pulse, rotation_rad_s)
        half_s, per_m = pulse_length_s(radar) / 2, 4 * math.pi / radar.wave_speed_m_s
        lever = abs(range_m + centre_deviation_m)
        migration = abs(cross_range_m) * math.sin(theta) + lever * (1 - math.cos(theta))
        inside = (omega * (abs(cross_range_m) + lever * theta) + abs(speed_m_s)) * half_s
        reach = abs(range_m) + migration + inside
        video = math.pi * radar.chirp_rate_hz_s * (2 * reach / radar.wave_speed_m_s) ** 2
        return per_m * (radar.bandwidth_hz / 2 * (migration + inside) + radar.carrier_hz * inside) + video

    def neglected_db(
        self, radar: InverseRadar, world: TurntableWorld, n_pulse: int, cross_range_m: float, range_m: float
    ) -> float:
        """Return the relative error of this model for one scatterer, mean |exp(j phi) - 1|^2 in dB.

        phi is the phase of the dechirped echo minus that of this model, and the mean is over a grid
        of pulses and of times within a pulse. Two parts of phi are left out: the residual video
        phase, which compression removes, and the Doppler phase within a pulse by the mean velocity
        of the range that the receiver tracks (`Dechirped.track`).

        Args:
            radar: Radar, with a pulse length.
            world: World with the rotation and the motion; only its first trial is used.
            n_pulse: Number of pulses.
            cross_range_m: Cross range of the scatterer in metres.
            range_m: Range of the scatterer in metres.

        Returns:
            Error in dB.
        """
        pulse = torch.linspace(0, n_pulse - 1, min(n_pulse, 65), dtype=torch.float64)[:, None]
        inside = torch.linspace(-0.5, 0.5, 65, dtype=torch.float64) * pulse_length_s(radar)
        track = world.fidelity.track if isinstance(world.fidelity, Dechirped) else ()
        lever_m = range_m + float(torch.as_tensor(world.centre_deviation_m).reshape(-1)[0])

        def range_at(time_s: Tensor) -> Tensor:
            if world.rotation is None:
                rate = radar.rotation_rad_s if world.rotation_rad_s is None else world.rotation_rad_s
                theta = float(torch.as_tensor(rate or 0.0).reshape(-1)[0]) * (time_s - n_pulse // 2 / radar.prf_hz)
            else:
                theta = world.rotation.angle(time_s).reshape(-1, *time_s.shape)[0]
            moved = displacement_m(world.motion, time_s).reshape(-1, *time_s.shape)[0]
            return range_m + cross_range_m * torch.sin(theta) + lever_m * (torch.cos(theta) - 1) + moved

        middle, reference = range_at(pulse / radar.prf_hz), displacement_m(track, pulse / radar.prf_hz)
        delay = 2 * (range_at(pulse / radar.prf_hz + inside) - reference) / radar.wave_speed_m_s
        exact = radar.carrier_hz * delay + radar.chirp_rate_hz_s * inside * delay
        rest = 2 * range_m / radar.wave_speed_m_s
        model = radar.carrier_hz * 2 * (middle - reference) / radar.wave_speed_m_s
        model = model + radar.chirp_rate_hz_s * inside * rest
        phase = -2 * math.pi * (exact - model)
        drift = -2 * math.pi * radar.carrier_hz * 2 * inside / radar.wave_speed_m_s
        velocity = float((reference.flatten(-2)[..., -1] - reference.flatten(-2)[..., 0]).reshape(-1)[0])
        velocity *= radar.prf_hz / max(1, n_pulse - 1)
        error = (2 - 2 * torch.cos(phase - drift * velocity)).mean()
        return 10 * math.log10(max(float(error), 1e-30))


@dataclass(frozen=True)
class Dechirped:
    """Dechirped pulses with the range evaluated at every sample.

    >>> from torchsar import Draws, echo, radar, scene
    >>> imager = radar.InverseRadar(10e9, 150e6, 100.0, rotation_rad_s=0.05, pulse_s=1e-4)
    >>> target, motion = scene.Points([0.0], [0.0]), [scene.Polynomial([10.0])]
    >>> world = scene.TurntableWorld(target, motion=motion, fidelity=scene.Dechirped(track=motion))
    >>> recording, truth = echo.simulate_turntable(imager, world, 3, 32, Draws(seed=1))
    >>> recording.aux["reference_m"].round(decimals=2).tolist()
    [0.0, 0.1, 0.2]

    Rotation, translation and vibration continue during the pulse. The phase of a scatterer is
    -2 pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2), with the carrier f0, the chirp rate gamma,
    the delay dtau relative to the reference of the receiver and the time t' from the middle of the
    pulse. The model neglects the curvature of the wavefront, see `neglected_phase_rad`, and the
    motion during the time of flight.

    Args:
        track: Motions that the reference range of the receiver follows from pulse to pulse. Delays
            are relative to this reference. The recording holds its displacement in metres in
            `Recording.aux["reference_m"]`.
    """

    track: Sequence[Motion] = ()

    def neglected_phase_rad(
        self,
        radar: InverseRadar,
        n_pulse: int,
        cross_range_m: float,
        range_m: float,
        rotation_rad_s: float | PolynomialRotation | None = None,
        centre_deviation_m: float = 0.0,
    ) -> float:
        """Return the largest change of the carrier phase due to the curvature of the wavefront.

        For a target at the range R, a scatterer at the distance w from the line of sight has the
        phase 4 pi / lambda w^2 / (2 R), which changes as w changes with the rotation. Both senses
        of rotation are considered.

        Args:
            radar: Radar, with the range of the target.
            n_pulse: Number of pulses.
            cross_range_m: Cross range of the scatterer in metres.
            range_m: Range of the scatterer in metres.
            rotation_rad_s: Rotation rate in rad/s or rotation, None for the rate of the radar.
            centre_deviation_m: Distance yc in metres: the centre of rotation lies at the range -yc
                from the middle of the range window.

        Returns:
            Phase in radians, the largest over the aperture and all trials.

        Raises:
            ValueError: If the range of the target or the rotation rate is not known.
        """
        if not radar.reference_range_m:
            raise ValueError(
                "radar.reference_range_m is 0; set it to the range of the target (m), on which the curvature of the "
                "wavefront depends"
            )
        theta, _ = _swing(radar, n_pulse, rotation_rad_s)
        lever = abs(range_m + centre_deviation_m)
        across = [cross_range_m * math.cos(theta) + side * lever * math.sin(theta) for side in (1, -1)]
        sag = max(abs(w * w - cross_range_m**2) for w in across) / (2 * radar.reference_range_m)
        return 4 * math.pi / radar.wavelength_m * sag


Fidelity = PhaseOnly | Dechirped


@dataclass(frozen=True)
@finite_numbers()
class TurntableWorld:
    """Scene that rotates while it moves along the line of sight.

    >>> from torchsar import Draws, echo, radar, scene
    >>> imager = radar.InverseRadar(10e9, 150e6, prf_hz=100.0, rotation_rad_s=0.05)
    >>> world = scene.TurntableWorld(scene.Points([0.0, 2.0], [0.0, 3.0]), snr_db=10.0)
    >>> recording, truth = echo.simulate_turntable(imager, world, 64, 32, Draws(1, trials=range(3)))
    >>> recording.signal.data.shape, truth.values["range_m"].shape
    (torch.Size([3, 64, 32]), torch.Size([2]))

    A uniform rotation has the angle theta = rotation_rad_s (t - t_mid), with the time t_mid of
    pulse n_pulse // 2.

    Args:
        scene: Scatterers; `azimuth_m` is cross range.
        rotation_rad_s: True uniform rotation rate in rad/s, None for the nominal rate of the radar.
        motion: Motions along the line of sight.
        start_phase: Start phases of the pulses.
        snr_db: Mean power of ALL range-compressed samples over the noise variance in decibels, None
            for no noise.
        fidelity: Model of the echo, `PhaseOnly` or `Dechirped`.
        rotation: Rotation with a changing rate instead of rotation_rad_s; its angle is zero at the
            FIRST pulse.
        centre_deviation_m: Range yc in metres from the centre of rotation to the middle of the
            range window. A scatterer at the range y from the middle of the window lies at the range
            y + yc from the centre of rotation. Its phase follows y + yc; its envelope lies at y.

    Raises:
        TypeError: If the fidelity or the rotation has the wrong type.
        ValueError: If a number is not finite, or both kinds of rotation are given.
    """

    scene: Scene
    rotation_rad_s: Tensor | float | None = None
    motion: Sequence[Motion] = ()
    start_phase: Sequence[PulsePhase] = ()
    snr_db: Tensor | float | None = None
    fidelity: Fidelity = field(default_factory=PhaseOnly)
    rotation: PolynomialRotation | None = None
    centre_deviation_m: Tensor | float = 0.0

    def __post_init__(self) -> None:
        if self.rotation is not None and self.rotation_rad_s is not None:
            raise ValueError(
                f"rotation_rad_s={self.rotation_rad_s} and a polynomial rotation are both given for the world; "
                "give one of them"
            )


def _swing(radar: InverseRadar, n_pulse: int, rotation: float | PolynomialRotation | None) -> tuple[float, float]:
    """Largest magnitude of the angle from theta = 0 in rad, and of the rotation rate in rad/s."""
    if isinstance(rotation, PolynomialRotation):
        time_s = torch.arange(n_pulse + 1, dtype=torch.float64) / radar.prf_hz
        return float(rotation.angle(time_s).detach().abs().max()), float(rotation.rate(time_s).detach().abs().max())
    rate = radar.rotation_rad_s if rotation is None else rotation
    if rate is None:
        raise ValueError("neither the radar nor the call has a rotation rate; give rotation_rad_s")
    return abs(rate) * n_pulse / (2 * radar.prf_hz), abs(rate)


def pulse_length_s(radar: InverseRadar) -> float:
    """Return the length of a dechirped pulse.

    Args:
        radar: Radar parameters.

    Returns:
        Length in seconds.

    Raises:
        ValueError: If it is not set.
    """
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; give the pulse length (s), on which phases within a pulse depend")
    return radar.pulse_s
