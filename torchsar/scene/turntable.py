"""Everything that is true about a turning target, and how finely its echo is modelled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from torchsar.radar import InverseRadar
from torchsar.scene.targets import Scene
from torchsar.scene.vibration import Motion, PulsePhase, refuse_unless_finite


@dataclass(frozen=True)
class PhaseOnly:
    """Range-compressed pulses whose envelopes stand still: rotation, motion and start phases turn phases alone (Ruan et al. 2013, Eqs. 1, 9).

    The level for studies of phase errors. Neglects migration of the envelopes, motion inside the pulse, coupling of range and Doppler, and
    the residual video phase, see neglected_phase_rad; `Dechirped` is the next level.
    """

    def neglected_phase_rad(self, radar: InverseRadar, n_pulse: int, cross_range_m: float, range_m: float, speed_m_s: float = 0.0, rotation_rad_s: float | None = None) -> float:
        """Bound of the phase, over the samples of all pulses, by which the dechirped echo of a scatterer at (cross_range_m, range_m) differs.

        Sum of migration at the ends of the band, of the carrier's phase that rotation and speed_m_s (left of the motion by the tracking) run
        through in half a pulse, of the same at the ends of the band, and of the residual video phase.
        """
        omega = _rotation(radar, rotation_rad_s)
        theta, half_s, per_m = omega * n_pulse / (2 * radar.prf_hz), _pulse_s(radar) / 2, 4 * math.pi / radar.wave_speed_m_s
        migration = abs(cross_range_m) * math.sin(theta) + abs(range_m) * (1 - math.cos(theta))
        inside = (omega * (abs(cross_range_m) + abs(range_m) * theta) + abs(speed_m_s)) * half_s
        reach = abs(range_m) + migration + inside
        video = math.pi * radar.chirp_rate_hz_s * (2 * reach / radar.wave_speed_m_s) ** 2
        return per_m * (radar.bandwidth_hz / 2 * (migration + inside) + radar.carrier_hz * inside) + video


@dataclass(frozen=True)
class Dechirped:
    """Dechirped pulses, the range evaluated at every sample of the pulse: rotation, translation and vibration go on inside it.

    Phase -2 pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2) with the delay dtau against the reference and the time t' from the middle of the
    pulse. track: motions that the receiver's reference follows, from pulse to pulse; the echo is relative to it, and the recording holds it
    as aux `reference_m`. Neglects the curvature of the wavefront, see neglected_phase_rad, and the motion during the time of flight.
    """

    track: Sequence[Motion] = ()

    def neglected_phase_rad(self, radar: InverseRadar, n_pulse: int, cross_range_m: float, range_m: float, rotation_rad_s: float | None = None) -> float:
        """Largest change over the aperture of the carrier's phase by the curvature of the wavefront, 4 pi / lambda w^2 / (2 R), w across the line of sight.

        Raises ValueError where radar.reference_range_m is zero, that is not known.
        """
        if not radar.reference_range_m:
            raise ValueError("radar.reference_range_m is 0; the curvature of the wavefront needs the range of the target")
        theta = _rotation(radar, rotation_rad_s) * n_pulse / (2 * radar.prf_hz)
        across = (cross_range_m * math.cos(theta) + abs(range_m) * math.sin(theta), cross_range_m * math.cos(theta) - abs(range_m) * math.sin(theta))
        sag = max(abs(w * w - cross_range_m**2) for w in across) / (2 * radar.reference_range_m)
        return 4 * math.pi / radar.wavelength_m * sag


Fidelity = PhaseOnly | Dechirped


@dataclass(frozen=True)
class TurntableWorld:
    """A scene that turns by theta = rotation_rad_s (t - t of the middle pulse, n_pulse // 2) while it moves along the line of sight.

    rotation_rad_s: true rate, None for what the radar takes it to be. motion, start_phase: lists of effects. snr_db: mean power of ALL range-compressed
    samples over noise variance, None for no noise. Rate and SNR are numbers or per-trial tensors (...,). fidelity: PhaseOnly() or Dechirped().
    """

    scene: Scene
    rotation_rad_s: Tensor | float | None = None
    motion: Sequence[Motion] = ()
    start_phase: Sequence[PulsePhase] = ()
    snr_db: Tensor | float | None = None
    fidelity: Fidelity = field(default_factory=PhaseOnly)

    def __post_init__(self) -> None:
        for name in ("rotation_rad_s", "snr_db"):
            if getattr(self, name) is not None:
                refuse_unless_finite(name, getattr(self, name))
        if not isinstance(self.fidelity, PhaseOnly | Dechirped):
            raise TypeError(f"fidelity must be PhaseOnly() or Dechirped(), got {self.fidelity!r}")


def _rotation(radar: InverseRadar, rotation_rad_s: float | None) -> float:
    rate = radar.rotation_rad_s if rotation_rad_s is None else rotation_rad_s
    if rate is None:
        raise ValueError("neither the radar nor the call names a rotation rate; give rotation_rad_s")
    return abs(rate)


def _pulse_s(radar: InverseRadar) -> float:
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; what happens inside a pulse needs its length")
    return radar.pulse_s
