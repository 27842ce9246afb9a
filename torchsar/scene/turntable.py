"""Everything that is true about a turning target, and how finely its echo is modelled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchsar.radar import InverseRadar
from torchsar.scene.rotation import PolynomialRotation
from torchsar.scene.targets import Scene
from torchsar.scene.vibration import Motion, PulsePhase, refuse_unless_finite


@dataclass(frozen=True)
class PhaseOnly:
    """Range-compressed pulses whose envelopes stand still: rotation, motion and start phases turn
    phases alone (Ruan et al. 2013, Eqs. 1, 9).

    The level for studies of phase errors. Neglects migration of the envelopes, motion inside the
    pulse, coupling of range and Doppler, and the residual video phase, see neglected_phase_rad;
    `Dechirped` is the next level.
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
        """Bound of the phase, over the samples of all pulses, by which the dechirped echo of a
        scatterer at (cross_range_m, range_m) differs.

        Sum of migration at the ends of the band (pi x A / dr over the total angle A of a
        PolynomialRotation, half that for an even rotation, which is zero at the middle), of the
        carrier's phase that rotation and speed_m_s (left of the motion by the tracking) run through
        in half a pulse, of the same at the ends of the band, and of the residual video phase. The
        worst of all trials of a rotation.
        """
        theta, omega = _swing(radar, n_pulse, rotation_rad_s)
        half_s, per_m = _pulse_s(radar) / 2, 4 * math.pi / radar.wave_speed_m_s
        lever = abs(range_m + centre_deviation_m)
        migration = abs(cross_range_m) * math.sin(theta) + lever * (1 - math.cos(theta))
        inside = (omega * (abs(cross_range_m) + lever * theta) + abs(speed_m_s)) * half_s
        reach = abs(range_m) + migration + inside
        video = math.pi * radar.chirp_rate_hz_s * (2 * reach / radar.wave_speed_m_s) ** 2
        return per_m * (radar.bandwidth_hz / 2 * (migration + inside) + radar.carrier_hz * inside) + video


@dataclass(frozen=True)
class Dechirped:
    """Dechirped pulses, the range evaluated at every sample of the pulse: rotation, translation and
    vibration go on inside it.

    Phase -2 pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2) with the delay dtau against the
    reference and the time t' from the middle of the pulse. track: motions that the receiver's
    reference follows, from pulse to pulse; the echo is relative to it, and the recording holds it
    as aux `reference_m`. Neglects the curvature of the wavefront, see neglected_phase_rad, and the
    motion during the time of flight.
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
        """Largest change over the aperture of the carrier's phase by the curvature of the
        wavefront, 4 pi / lambda w^2 / (2 R), w across the line of sight.

        The worst of all trials of a rotation, turning either way. Raises ValueError where
        radar.reference_range_m is zero, that is not known.
        """
        if not radar.reference_range_m:
            raise ValueError(
                "radar.reference_range_m is 0; the curvature of the wavefront needs the range of the target"
            )
        theta, _ = _swing(radar, n_pulse, rotation_rad_s)
        lever = abs(range_m + centre_deviation_m)
        across = (
            cross_range_m * math.cos(theta) + lever * math.sin(theta),
            cross_range_m * math.cos(theta) - lever * math.sin(theta),
        )
        sag = max(abs(w * w - cross_range_m**2) for w in across) / (2 * radar.reference_range_m)
        return 4 * math.pi / radar.wavelength_m * sag


Fidelity = PhaseOnly | Dechirped


@dataclass(frozen=True)
class TurntableWorld:
    """A scene that turns by theta = rotation_rad_s (t - t of the middle pulse, n_pulse // 2) while
    it moves along the line of sight.

    rotation_rad_s: true rate, None for what the radar takes it to be. motion, start_phase: lists of
    effects. snr_db: mean power of ALL range-compressed samples over noise variance, None for no
    noise. Rate and SNR are numbers or per-trial tensors (...,). fidelity: PhaseOnly() or
    Dechirped(). rotation: a rotation of changing rate in place of rotation_rad_s; its angle is zero
    at the FIRST pulse. centre_deviation_m: yc, a number or per-trial tensor (...,): a scatterer at
    range_m y of the window turns at y + yc from the centre of rotation, so that phases follow y +
    yc where envelopes stay at y.
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
        for name in ("rotation_rad_s", "snr_db", "centre_deviation_m"):
            if getattr(self, name) is not None:
                refuse_unless_finite(name, getattr(self, name))
        if not isinstance(self.fidelity, PhaseOnly | Dechirped):
            raise TypeError(f"fidelity must be PhaseOnly() or Dechirped(), got {self.fidelity!r}")
        if not isinstance(self.rotation, PolynomialRotation | None):
            raise TypeError(
                f"rotation must be a PolynomialRotation or None, got {self.rotation!r}; an even rate "
                "belongs into rotation_rad_s"
            )
        if self.rotation is not None and self.rotation_rad_s is not None:
            raise ValueError(
                f"the world turns by rotation_rad_s={self.rotation_rad_s} and by a polynomial "
                "rotation; give one of them"
            )


def _swing(radar: InverseRadar, n_pulse: int, rotation: float | PolynomialRotation | None) -> tuple[float, float]:
    """Largest angle from where theta is zero (rad) and largest rate (rad/s), both without sign."""
    if isinstance(rotation, PolynomialRotation):
        time_s = torch.arange(n_pulse + 1, dtype=torch.float64) / radar.prf_hz
        return float(rotation.angle(time_s).detach().abs().max()), float(rotation.rate(time_s).detach().abs().max())
    rate = radar.rotation_rad_s if rotation is None else rotation
    if rate is None:
        raise ValueError("neither the radar nor the call names a rotation rate; give rotation_rad_s")
    return abs(rate) * n_pulse / (2 * radar.prf_hz), abs(rate)


def _pulse_s(radar: InverseRadar) -> float:
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; what happens inside a pulse needs its length")
    return radar.pulse_s
