"""What a side-looking stripmap radar knows about itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, per_trial
from torchsar.radar.waveform import LinearFM

LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True)
class StripmapRadar:
    """Instrument description of a stripmap radar on a straight path (slant plane).

    carrier_hz, sampling_hz (complex), prf_hz; near_range_m: slant range of sample 0, counted from
    the leading edge of the echo; velocity_m_s: nominal effective velocity, which also fixes the
    azimuth scale of images (x = velocity * slow time); pointing_doppler_hz: nominal Doppler of the
    beam centre, the frame of image coordinates; None where it is not known before it is estimated;
    integration_s: nominal coherent integration (beam dwell), None where the beam fills the PRF
    band.
    """

    carrier_hz: float
    pulse: LinearFM
    sampling_hz: float
    prf_hz: float
    velocity_m_s: float
    near_range_m: float
    pointing_doppler_hz: float | None = None
    integration_s: float | None = None
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        for name in ("carrier_hz", "sampling_hz", "prf_hz", "velocity_m_s", "near_range_m", "wave_speed_m_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"radar.{name} must be a positive number, got {getattr(self, name)}")
        if self.pointing_doppler_hz is not None and not math.isfinite(self.pointing_doppler_hz):
            raise ValueError(
                f"radar.pointing_doppler_hz must be a finite number or None, got {self.pointing_doppler_hz}"
            )
        if self.integration_s is not None and not self.integration_s > 0:
            raise ValueError(f"radar.integration_s must be a positive number or None, got {self.integration_s}")
        if self.pulse.bandwidth_hz > self.sampling_hz:
            raise ValueError(
                f"pulse bandwidth {self.pulse.bandwidth_hz:g} Hz exceeds the complex sampling rate "
                f"{self.sampling_hz:g} Hz; sample at least as fast as the bandwidth"
            )

    @property
    def wavelength_m(self) -> float:
        return self.wave_speed_m_s / self.carrier_hz

    @property
    def range_step_m(self) -> float:
        return self.wave_speed_m_s / (2 * self.sampling_hz)

    @property
    def range_resolution_m(self) -> float:
        """-3 dB width of a rectangular band, 0.886 c / (2 B)."""
        return 0.886 * self.wave_speed_m_s / (2 * self.pulse.bandwidth_hz)

    @property
    def pulse_samples(self) -> int:
        return self.pulse.n_samples(self.sampling_hz)

    def raw_axes(self, n_pulse: int, n_range: int, start_s: float = 0.0) -> tuple[Axis, Axis]:
        """Slow time (s) and slant range (m) of a raw matrix."""
        return Axis("pulse", n_pulse, start_s, 1 / self.prf_hz, "s"), Axis(
            "range", n_range, self.near_range_m, self.range_step_m, "m"
        )

    def image_axes(self, raw: tuple[Axis, ...]) -> tuple[Axis, Axis]:
        """Azimuth x = nominal velocity * slow time of beam-centre crossing (m), and slant range at
        that crossing (m).
        """
        pulse, range_ = raw[-2:]
        return Axis("azimuth", pulse.n, pulse.start * self.velocity_m_s, pulse.step * self.velocity_m_s, "m"), range_

    def range_frequency_hz(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Baseband range frequencies of an n-point FFT, FFT order, float64 (n,)."""
        return torch.fft.fftfreq(n, 1 / self.sampling_hz, dtype=torch.float64, device=device)

    def doppler_hz(self, n: int, centre_hz: Tensor | float, device: torch.device | str | None = None) -> Tensor:
        """Absolute Doppler of an n-point FFT over pulses, unwrapped into one PRF about the centre.

        (...,) -> (..., n), FFT order.
        """
        base = torch.fft.fftfreq(n, 1 / self.prf_hz, dtype=torch.float64, device=device)
        centre = per_trial(centre_hz, 1, base)
        return base + self.prf_hz * torch.round((centre.detach() - base) / self.prf_hz)

    def sin_squint(self, doppler_hz: Tensor | float, velocity_m_s: Tensor | float | None = None) -> Tensor:
        """Sine of the squint angle of a Doppler frequency: lambda f / (2 v), positive when the beam
        looks ahead (closing).
        """
        velocity = self.velocity_m_s if velocity_m_s is None else velocity_m_s
        return self.wavelength_m * torch.as_tensor(doppler_hz, dtype=torch.float64) / (2 * velocity)

    def azimuth_rate_hz_s(self, range_m: Tensor | float, velocity_m_s: Tensor | float | None = None) -> Tensor:
        """Magnitude of the Doppler rate at closest approach, 2 v^2 / (lambda r)."""
        velocity = torch.as_tensor(self.velocity_m_s if velocity_m_s is None else velocity_m_s, dtype=torch.float64)
        return 2 * velocity.square() / (self.wavelength_m * torch.as_tensor(range_m, dtype=torch.float64))

    def aperture_s(self, range_m: float) -> float:
        """Time of one synthetic aperture at this range: the nominal dwell, or the time to sweep one
        PRF where none is known.
        """
        return (
            self.prf_hz / float(self.azimuth_rate_hz_s(range_m)) if self.integration_s is None else self.integration_s
        )

    def aperture_lines(self, range_m: float) -> int:
        """Lines of one synthetic aperture at this range."""
        return math.ceil(self.aperture_s(range_m) * self.prf_hz)

    def image_position(
        self,
        zero_doppler_s: Tensor,
        closest_range_m: Tensor,
        frame_doppler_hz: Tensor | float,
        velocity_m_s: Tensor | float,
    ) -> tuple[Tensor, Tensor]:
        """Where a target appears in an image of frame Doppler f: (azimuth_m, range_m).

        The target is met at the slant range R = r / cos(squint) and at the slow time t = t0 -
        lambda f R / (2 v^2); an image holds it at (nominal velocity * t, R). With f = 0 these are
        the zero-Doppler coordinates. All arguments broadcast.
        """
        sin = self.sin_squint(frame_doppler_hz, velocity_m_s)
        slant = closest_range_m / torch.sqrt(1 - sin.square())
        crossing = zero_doppler_s - sin * slant / velocity_m_s
        return self.velocity_m_s * crossing, slant
