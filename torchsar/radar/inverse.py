"""Instrument description of a radar or ladar that images rotating targets (ISAR, ISAL)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchsar.core import Axis
from torchsar.radar.instrument import LIGHT_M_S, Instrument


@dataclass(frozen=True)
class InverseRadar(Instrument):
    """Inverse synthetic aperture radar or ladar whose range window follows the target.

    >>> from torchsar import radar
    >>> ladar = radar.InverseRadar(193e12, bandwidth_hz=15e9, prf_hz=1e3, rotation_rad_s=0.01)
    >>> axes = ladar.image_axes(ladar.raw_axes(n_pulse=100, n_range=64))
    >>> [(axis.name, round(1e3 * axis.step, 2)) for axis in axes]  # cells in millimetres
    [('azimuth', 0.78), ('range', 9.99)]

    Args:
        carrier_hz: Middle of the band in Hz.
        bandwidth_hz: Bandwidth B of the range-compressed samples in Hz; a range cell is c / (2 B).
        prf_hz: Pulse repetition frequency in Hz.
        rotation_rad_s: Assumed rotation rate of the target in rad/s, which scales cross range. None
            where it is unknown; images then have a Doppler axis in Hz.
        pulse_s: Length in seconds of a pulse that is dechirped on receive, None for
            range-compressed data.
        reference_range_m: Range of the middle of the window in metres, where range coordinates are
            zero.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If a parameter is not finite, a frequency, rate or length is not positive, or
            the reference range is negative.
    """

    carrier_hz: float
    bandwidth_hz: float
    prf_hz: float
    rotation_rad_s: float | None = None
    pulse_s: float | None = None
    reference_range_m: float = 0.0
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        self.refuse_not_positive("bandwidth_hz", "prf_hz", "rotation_rad_s", "pulse_s")
        if not 0 <= self.reference_range_m < math.inf:
            raise ValueError(f"radar.reference_range_m must be a range of 0 m or more, got {self.reference_range_m}")

    @property
    def range_step_m(self) -> float:
        """Range cell c / (2 B) in metres."""
        return self.wave_speed_m_s / (2 * self.bandwidth_hz)

    @property
    def chirp_rate_hz_s(self) -> float:
        """Chirp rate in Hz/s, the bandwidth over the pulse length.

        Raises:
            ValueError: If `pulse_s` is None.
        """
        if self.pulse_s is None:
            raise ValueError("radar.pulse_s is not set; give the length of the dechirped pulse in seconds")
        return self.bandwidth_hz / self.pulse_s

    def raw_axes(self, n_pulse: int, n_range: int, start_s: float = 0.0) -> tuple[Axis, Axis]:
        """Return the axes (pulse, range) of range-compressed pulses.

        Args:
            n_pulse: Number of pulses.
            n_range: Number of range cells.
            start_s: Slow time of the first pulse in seconds.

        Returns:
            Slow time in seconds, and range in metres relative to the middle of the window, which is
            sample n_range // 2.
        """
        return Axis("pulse", n_pulse, start_s, 1 / self.prf_hz, "s"), Axis(
            "range", n_range, -(n_range // 2) * self.range_step_m, self.range_step_m, "m"
        )

    def image_axes(self, raw: tuple[Axis, ...]) -> tuple[Axis, Axis]:
        """Return the axes (azimuth, range) of the image of range-compressed pulses.

        Args:
            raw: Axes of the data, the last two being (pulse, range).

        Returns:
            Cross range in metres (Doppler in Hz where the rotation is unknown) with zero at line n
            // 2, and the range axis. The cross-range cell is lambda / (2 omega T) for pulses that
            last T seconds and the rotation rate omega.
        """
        (pulse, range_), omega = raw[-2:], self.rotation_rad_s
        step = (1 if omega is None else self.wavelength_m / (2 * omega)) / (pulse.n * pulse.step)
        return Axis("azimuth", pulse.n, -(pulse.n // 2) * step, step, "Hz" if omega is None else "m"), range_
