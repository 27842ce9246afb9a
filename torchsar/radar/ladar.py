"""Instrument description of a synthetic aperture ladar with a triangular sweep."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.core import Axis
from torchsar.radar.instrument import LIGHT_M_S, Instrument

DechirpSign = Literal["lo_conj_echo", "echo_conj_lo"]
Detection = Literal["complex", "real"]


@dataclass(frozen=True)
class TriangularLadar(Instrument):
    """Symmetric triangular FMCW ladar that is dechirped on receive (STLFMCW).

    >>> from torchsar import radar
    >>> ladar = radar.TriangularLadar(
    ...     carrier_hz=2e14,
    ...     bandwidth_hz=5e9,
    ...     period_s=16e-6,
    ...     sample_rate_hz=64e6,
    ...     speed_m_s=60.0,
    ...     reference_range_m=3000.0,
    ... )
    >>> ladar.sweep_samples, round(ladar.range_step_m, 3), round(ladar.beat_hz(3.0) / 1e6, 1)
    (512, 0.03, 12.5)

    In a period that starts at t the middle of the up sweep is at t + period / 4, the turning point
    at t + period / 2, and the middle of the down sweep at t + 3 period / 4.

    Args:
        carrier_hz: Middle of the band in Hz.
        bandwidth_hz: Bandwidth swept by each half of the triangle in Hz.
        period_s: Length of the full triangle, up and down, in seconds (the PRT of the paper).
        sample_rate_hz: Sampling rate of the beat signal in Hz; a sweep must hold a whole number of
            samples, at least 16.
        speed_m_s: Speed in m/s along track, or of the target across the line of sight.
        reference_range_m: Delay of the local oscillator as a range in metres; ranges of scatterers
            are relative to it.
        beam_rad: Illuminated azimuth angle in radians, None where the beam covers the whole scene.
        keep_every: Of every `keep_every` periods, one is recorded.
        detection: "complex" for complex samples, "real" for those of a one-channel detector.
        dechirp_sign: Sign of the dechirped phase. "lo_conj_echo" is the local oscillator times the
            conjugate echo, as in the paper: the phase is +2 pi carrier_hz times the delay relative
            to the local oscillator, and a scatterer beyond the reference range has a positive beat
            frequency in the up sweep. "echo_conj_lo" is the conjugate.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If a parameter lies outside its range, or a sweep does not hold a whole number
            of samples, 16 or more.

    Reference:
        Remote Sens. 2024, 16, 793.
    """

    carrier_hz: float
    bandwidth_hz: float
    period_s: float
    sample_rate_hz: float
    speed_m_s: float
    reference_range_m: float
    beam_rad: float | None = None
    keep_every: int = 1
    detection: Detection = "complex"
    dechirp_sign: DechirpSign = "lo_conj_echo"
    wave_speed_m_s: float = LIGHT_M_S

    def __post_init__(self) -> None:
        self.refuse_not_positive("bandwidth_hz", "period_s", "sample_rate_hz", "reference_range_m")
        if not (math.isfinite(self.speed_m_s) and self.speed_m_s >= 0):
            raise ValueError(f"radar.speed_m_s must be a number of 0 or more, got {self.speed_m_s}")
        if self.beam_rad is not None and not 0 < self.beam_rad < math.pi:
            raise ValueError(
                "radar.beam_rad must be above 0 and below pi rad, or None where the beam covers the whole scene, "
                f"got {self.beam_rad}"
            )
        if not (isinstance(self.keep_every, int) and self.keep_every >= 1):
            raise ValueError(f"radar.keep_every must be a whole number of 1 or more, got {self.keep_every}")
        for name, kinds in (("detection", get_args(Detection)), ("dechirp_sign", get_args(DechirpSign))):
            if getattr(self, name) not in kinds:
                raise ValueError(f"radar.{name} must be one of {', '.join(kinds)}, got {getattr(self, name)!r}")
        samples = self.sweep_s * self.sample_rate_hz
        if round(samples) < 16 or abs(samples - round(samples)) > 1e-6 * samples:
            raise ValueError(
                "radar.sample_rate_hz must give a whole number of samples, 16 or more, in a sweep of "
                f"{self.sweep_s:g} s, got {samples:g} samples at {self.sample_rate_hz:g} Hz"
            )

    @property
    def sweep_s(self) -> float:
        """Length of one sweep in seconds, half of the period."""
        return self.period_s / 2

    @property
    def chirp_rate_hz_s(self) -> float:
        """Chirp rate 2 B / period in Hz/s, with the bandwidth B of one sweep."""
        return self.bandwidth_hz / self.sweep_s

    @property
    def sweep_samples(self) -> int:
        """Number of samples of one sweep."""
        return round(self.sweep_s * self.sample_rate_hz)

    @property
    def range_step_m(self) -> float:
        """Range cell c / (2 B) in metres, with the bandwidth B of one sweep.

        It corresponds to a step 1 / sweep_s of the beat frequency.
        """
        return self.wave_speed_m_s / (2 * self.bandwidth_hz)

    @property
    def pulse_step_s(self) -> float:
        """Time in seconds from one recorded period to the next."""
        return self.keep_every * self.period_s

    @property
    def ambiguous_velocity_m_s(self) -> float:
        """Radial velocity lambda / (2 T) in m/s that shifts the phase by one cycle per sweep.

        T is the length of a sweep. An estimator that compares the phase of the first half of each
        sweep with that of the second (segmented interference) measures the radial velocity modulo
        this interval.

        Reference:
            Remote Sens. 2024, 16, 793, Eq. (17).
        """
        return self.wavelength_m / (2 * self.sweep_s)

    def beat_hz(self, relative_range_m: float) -> float:
        """Return the beat frequency 2 K R / c of a scatterer at rest in the up sweep, in Hz.

        K is the chirp rate; the sign is that of the dechirp sign "lo_conj_echo".

        Args:
            relative_range_m: Range R of the scatterer relative to the reference range in metres.
        """
        return self.chirp_rate_hz_s * 2 * relative_range_m / self.wave_speed_m_s

    def doppler_hz(self, velocity_m_s: float) -> float:
        """Return the shift 2 v / lambda of the beat frequency by a radial velocity, in Hz.

        The sign is that of the dechirp sign "lo_conj_echo", in the up sweep and the down sweep.

        Args:
            velocity_m_s: Radial velocity v in m/s, receding positive.
        """
        return 2 * velocity_m_s / self.wavelength_m

    def fast_time_axis(self) -> Axis:
        """Return the axis of the time from the middle of a sweep, in seconds.

        Sample n of N lies at (n - (N - 1) / 2) / sample_rate_hz. The samples are symmetric about
        zero, so that a sweep can be reversed in time.
        """
        n, step = self.sweep_samples, 1 / self.sample_rate_hz
        return Axis("fast_time", n, -(n - 1) / 2 * step, step, "s")

    def sweep_axes(self, n_period: int, start_s: float | None = None) -> tuple[Axis, Axis, Axis]:
        """Return the axes (ramp, pulse, fast time) of separated sweeps.

        Args:
            n_period: Number of recorded periods.
            start_s: Start of the first period in seconds. By default the turning point of period
                n_period // 2 lies at slow time zero, where a scatterer at azimuth zero is at
                broadside.

        Returns:
            Ramp (0 up, 1 down), start of each period in seconds, and fast time in seconds.
        """
        start = -(n_period // 2) * self.pulse_step_s - self.period_s / 2 if start_s is None else start_s
        return (
            Axis("ramp", 2, 0.0, 1.0, ""),
            Axis("pulse", n_period, start, self.pulse_step_s, "s"),
            self.fast_time_axis(),
        )

    def record_axes(self, n_period: int, n_sample: int, start_s: float | None = None) -> tuple[Axis, Axis]:
        """Return the axes (pulse, time) of a continuous record in blocks, one per recorded period.

        The first sample lies half a sampling interval after the start of its block. If blocks start
        with the up sweep, the samples of separated sweeps therefore are samples of the record.

        Args:
            n_period: Number of recorded periods.
            n_sample: Number of samples of a block.
            start_s: Start of the first block in seconds, by default as in `sweep_axes`.

        Returns:
            Start of each block in seconds, and time within the block in seconds.
        """
        return self.sweep_axes(n_period, start_s)[1], Axis(
            "time", n_sample, 0.5 / self.sample_rate_hz, 1 / self.sample_rate_hz, "s"
        )


def sweep_middles(radar: TriangularLadar, pulse: Axis, device: torch.device | str | None = None) -> Tensor:
    """Return the slow times of the middles of the up and down sweeps.

    >>> from torchsar import radar
    >>> ladar = radar.TriangularLadar(2e14, 5e9, 16e-6, 64e6, 60.0, 3000.0)
    >>> _, pulse, _ = ladar.sweep_axes(n_period=3, start_s=0.0)
    >>> (1e6 * radar.sweep_middles(ladar, pulse)).round(decimals=3).tolist()  # in microseconds
    [[4.0, 20.0, 36.0], [12.0, 28.0, 44.0]]

    Args:
        radar: Radar parameters.
        pulse: Axis with the start of each period in seconds.
        device: Device of the result.

    Returns:
        Slow times in seconds, float64 (2, pulse), up sweeps first.
    """
    start = pulse.values(device)
    return torch.stack([start + 0.25 * radar.period_s, start + 0.75 * radar.period_s])


def leading(level: Tensor) -> Tensor:
    """Mark the scatterers whose amplitude is within 10 dB of the strongest and above zero.

    Scatterers more than 10 dB below the strongest do not lead an estimator.

    Args:
        level: Amplitudes, shape (..., target).

    Returns:
        True for these scatterers, bool, shape (..., target).
    """
    return (level >= 10 ** (-10 / 20) * level.amax(-1, keepdim=True)) & (level > 0)
