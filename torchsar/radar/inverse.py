"""What a radar or ladar that images turning targets knows about itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchsar.core import Axis
from torchsar.radar.stripmap import LIGHT_M_S


@dataclass(frozen=True)
class InverseRadar:
    """Instrument description of an inverse synthetic aperture radar or ladar, whose range window
    follows the target.

    carrier_hz: middle of the band; bandwidth_hz: of the range-compressed samples, whose cell is c /
    (2 B); prf_hz: pulse rate. rotation_rad_s: rate at which the target is taken to turn, which
    scales cross range; None where it is not known, and images then keep a Doppler axis in Hz.
    pulse_s: length of a pulse that is dechirped on receive, None for range-compressed data.
    reference_range_m: middle of the range window, where range coordinates are zero.
    """

    carrier_hz: float
    bandwidth_hz: float
    prf_hz: float
    rotation_rad_s: float | None = None
    pulse_s: float | None = None
    reference_range_m: float = 0.0
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        for name in ("carrier_hz", "bandwidth_hz", "prf_hz", "wave_speed_m_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"radar.{name} must be a positive number, got {getattr(self, name)}")
        for name in ("rotation_rad_s", "pulse_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"radar.{name} must be a positive number or None, got {value}")
        if not (math.isfinite(self.reference_range_m) and self.reference_range_m >= 0):
            raise ValueError(f"radar.reference_range_m must be a range of 0 m or more, got {self.reference_range_m}")

    @property
    def wavelength_m(self) -> float:
        return self.wave_speed_m_s / self.carrier_hz

    @property
    def range_step_m(self) -> float:
        """One range cell, c / (2 B)."""
        return self.wave_speed_m_s / (2 * self.bandwidth_hz)

    @property
    def chirp_rate_hz_s(self) -> float:
        """Bandwidth over pulse length. Raises ValueError where the pulse is not known."""
        if self.pulse_s is None:
            raise ValueError("radar.pulse_s is not set; a dechirped pulse needs its length")
        return self.bandwidth_hz / self.pulse_s

    def cross_range_step_m(self, n_pulse: int) -> float:
        """One cross-range cell, lambda / (2 omega T) with T = n_pulse / prf.

        Raises ValueError where the rotation is not known.
        """
        if self.rotation_rad_s is None:
            raise ValueError(
                "radar.rotation_rad_s is not set; without it images have a Doppler axis, not one in metres"
            )
        return self.wavelength_m * self.prf_hz / (2 * self.rotation_rad_s * n_pulse)

    def raw_axes(self, n_pulse: int, n_range: int, start_s: float = 0.0) -> tuple[Axis, Axis]:
        """Slow time (s) and range relative to the middle of the window (m) of range-compressed
        pulses; the middle is sample n_range // 2.
        """
        return Axis("pulse", n_pulse, start_s, 1 / self.prf_hz, "s"), Axis(
            "range", n_range, -(n_range // 2) * self.range_step_m, self.range_step_m, "m"
        )

    def image_axes(self, raw: tuple[Axis, ...]) -> tuple[Axis, Axis]:
        """Cross range (m), or Doppler (Hz) where the rotation is not known, with zero at line n //
        2; and range (m).
        """
        pulse, range_ = raw[-2:]
        if self.rotation_rad_s is None:
            step, unit = 1 / (pulse.n * pulse.step), "Hz"
        else:
            step, unit = self.wavelength_m / (2 * self.rotation_rad_s * pulse.n * pulse.step), "m"
        return Axis("azimuth", pulse.n, -(pulse.n // 2) * step, step, unit), range_
