"""Instrument description of a side-looking stripmap radar."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, per_trial
from torchsar.radar.instrument import LIGHT_M_S, Instrument
from torchsar.radar.waveform import LinearFM


@dataclass(frozen=True)
class StripmapRadar(Instrument):
    """Stripmap radar on a straight path, described in the slant plane.

    >>> from torchsar import radar
    >>> sensor = radar.StripmapRadar(
    ...     carrier_hz=3.2e9,
    ...     pulse=radar.LinearFM(bandwidth_hz=40e6, duration_s=0.5e-6),
    ...     sampling_hz=50e6,
    ...     prf_hz=400.0,
    ...     velocity_m_s=120.0,
    ...     near_range_m=4000.0,
    ... )
    >>> round(sensor.range_step_m, 2), round(sensor.range_resolution_m, 2), sensor.pulse_samples
    (3.0, 3.32, 25)

    The nominal effective velocity also gives images their azimuth axis, x = velocity * slow time.

    Args:
        carrier_hz: Carrier frequency in Hz.
        pulse: Transmitted pulse.
        sampling_hz: Complex sampling rate in Hz, at least the bandwidth of the pulse.
        prf_hz: Pulse repetition frequency in Hz.
        velocity_m_s: Nominal effective velocity in m/s.
        near_range_m: Slant range in metres of a target whose echo has its leading edge exactly on
            sample 0. After range compression this target is at sample 0.
        pointing_doppler_hz: Nominal Doppler of the beam centre in Hz, to which image coordinates
            refer. None where it has yet to be estimated.
        integration_s: Nominal coherent integration time (beam dwell) in seconds. None where the
            beam fills the PRF band.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If a parameter is not positive or not finite, or the bandwidth of the pulse
            exceeds the sampling rate.
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
        self.refuse_not_positive("sampling_hz", "prf_hz", "velocity_m_s", "near_range_m", "integration_s")
        if self.pointing_doppler_hz is not None and not math.isfinite(self.pointing_doppler_hz):
            raise ValueError(
                f"radar.pointing_doppler_hz must be a finite number or None, got {self.pointing_doppler_hz}"
            )
        self.pulse.refuse_aliased(self.sampling_hz)

    @property
    def range_step_m(self) -> float:
        """Slant-range spacing of the samples, c / (2 sampling rate), in metres."""
        return self.wave_speed_m_s / (2 * self.sampling_hz)

    @property
    def range_resolution_m(self) -> float:
        """-3 dB width of the response of a rectangular band, 0.886 c / (2 B), in metres."""
        return 0.886 * self.wave_speed_m_s / (2 * self.pulse.bandwidth_hz)

    @property
    def pulse_samples(self) -> int:
        """Number of samples of a pulse whose leading edge lies on a sample."""
        return self.pulse.n_samples(self.sampling_hz)

    def raw_axes(self, n_pulse: int, n_range: int, start_s: float = 0.0) -> tuple[Axis, Axis]:
        """Return the axes (pulse, range) of a raw data matrix.

        Args:
            n_pulse: Number of pulses.
            n_range: Number of range samples.
            start_s: Slow time of the first pulse in seconds.

        Returns:
            Slow time in seconds and slant range in metres.
        """
        return Axis("pulse", n_pulse, start_s, 1 / self.prf_hz, "s"), Axis(
            "range", n_range, self.near_range_m, self.range_step_m, "m"
        )

    def image_axes(self, raw: tuple[Axis, ...]) -> tuple[Axis, Axis]:
        """Return the axes (azimuth, range) of the image of raw data.

        Args:
            raw: Axes of the raw data, the last two being (pulse, range).

        Returns:
            Azimuth x = nominal velocity * slow time of beam-centre crossing, and slant range at
            that crossing, both in metres.
        """
        pulse, range_ = raw[-2:]
        return Axis("azimuth", pulse.n, pulse.start * self.velocity_m_s, pulse.step * self.velocity_m_s, "m"), range_

    def range_frequency_hz(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the baseband range frequencies (Hz) of an n-point FFT, FFT order, float64 (n,)."""
        return torch.fft.fftfreq(n, 1 / self.sampling_hz, dtype=torch.float64, device=device)

    def doppler_hz(self, n: int, centre_hz: Tensor | float, device: torch.device | str | None = None) -> Tensor:
        """Return the Doppler frequencies of an n-point FFT over pulses, unwrapped about a centre.

        Args:
            n: Number of pulses.
            centre_hz: Centre of the PRF interval in Hz, shape (...,) or a number.
            device: Device of the result.

        Returns:
            Absolute Doppler in Hz within half a PRF of the centre, FFT order, float64 (..., n).
        """
        base = torch.fft.fftfreq(n, 1 / self.prf_hz, dtype=torch.float64, device=device)
        centre = per_trial(centre_hz, 1, base)
        return base + self.prf_hz * torch.round((centre.detach() - base) / self.prf_hz)

    def sin_squint(self, doppler_hz: Tensor | float, velocity_m_s: Tensor | float | None = None) -> Tensor:
        """Return the sine of the squint angle of a Doppler frequency, lambda f / (2 v).

        Args:
            doppler_hz: Doppler frequency in Hz.
            velocity_m_s: Effective velocity in m/s, by default the nominal one. Broadcasts with
                `doppler_hz`.

        Returns:
            Sine of the squint angle, float64, positive when the beam looks ahead (closing range).
        """
        velocity = self.velocity_m_s if velocity_m_s is None else velocity_m_s
        return self.wavelength_m * torch.as_tensor(doppler_hz, dtype=torch.float64) / (2 * velocity)

    def azimuth_rate_hz_s(self, range_m: Tensor | float, velocity_m_s: Tensor | float | None = None) -> Tensor:
        """Return the magnitude of the Doppler rate at closest approach, 2 v^2 / (lambda r).

        Args:
            range_m: Closest range r in metres.
            velocity_m_s: Effective velocity v in m/s, by default the nominal one. Broadcasts with
                `range_m`.

        Returns:
            Doppler rate in Hz/s, float64.
        """
        velocity = torch.as_tensor(self.velocity_m_s if velocity_m_s is None else velocity_m_s, dtype=torch.float64)
        return 2 * velocity.square() / (self.wavelength_m * torch.as_tensor(range_m, dtype=torch.float64))

    def aperture_s(self, range_m: float) -> float:
        """Return the duration of one synthetic aperture, in seconds.

        This is the nominal integration time or, where that is None, the time in which the Doppler
        frequency of a target sweeps one PRF.

        Args:
            range_m: Closest range of the target in metres.
        """
        return (
            self.prf_hz / float(self.azimuth_rate_hz_s(range_m)) if self.integration_s is None else self.integration_s
        )

    def aperture_lines(self, range_m: float) -> int:
        """Return the number of pulses of one synthetic aperture, rounded up.

        Args:
            range_m: Closest range of the target in metres.
        """
        return math.ceil(self.aperture_s(range_m) * self.prf_hz)

    def image_position(
        self,
        zero_doppler_s: Tensor,
        closest_range_m: Tensor,
        frame_doppler_hz: Tensor | float,
        velocity_m_s: Tensor | float,
    ) -> tuple[Tensor, Tensor]:
        """Return the position of a target in an image that refers to a given Doppler frequency.

        The target has the Doppler frequency f at the slant range R = r / cos(squint) and the slow
        time t = t0 - lambda f R / (2 v^2). The image shows it at the azimuth t times the nominal
        velocity and at the slant range R. With f = 0 these are the zero-Doppler coordinates. All
        arguments broadcast.

        Args:
            zero_doppler_s: Slow time t0 of closest approach in seconds.
            closest_range_m: Closest range r in metres.
            frame_doppler_hz: Doppler f to which the image coordinates refer, in Hz.
            velocity_m_s: Effective velocity v of the target in m/s.

        Returns:
            Azimuth and slant range in metres.
        """
        sin = self.sin_squint(frame_doppler_hz, velocity_m_s)
        slant = closest_range_m / torch.sqrt(1 - sin.square())
        crossing = zero_doppler_s - sin * slant / velocity_m_s
        return self.velocity_m_s * crossing, slant
