"""What a synthetic aperture ladar with a triangular sweep knows about itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.core import Axis
from torchsar.radar.stripmap import LIGHT_M_S

DechirpSign = Literal["lo_conj_echo", "echo_conj_lo"]
Detection = Literal["complex", "real"]


@dataclass(frozen=True)
class TriangularLadar:
    """Instrument description of a symmetric triangular FMCW ladar that is dechirped on receive
    (STLFMCW).

    carrier_hz: middle of the band; bandwidth_hz: swept by each half; period_s: the full triangle,
    up and down (the paper's PRT); sample_rate_hz: of the beat signal, which must make a whole
    number of samples of a sweep. speed_m_s: along track, or of the target across the line of sight.
    reference_range_m: delay of the local oscillator as a range; ranges of scatterers are relative
    to it. beam_rad: azimuth angle that the beam lights, None where it lights the whole scene.
    keep_every: of so many periods one is recorded.

    detection: complex samples, or one real channel. dechirp_sign: "lo_conj_echo" (as the paper
    prints it: phase +2 pi fc dtau, a scatterer beyond the reference has a positive beat in the up
    sweep) or its conjugate "echo_conj_lo".

    Of a period that starts at t: the up sweep has its middle at t + period/4, the TURNING POINT is
    at t + period/2, the middle of the down sweep at t + 3 period/4. Raises ValueError for
    parameters that make no instrument.
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
        for name in ("carrier_hz", "bandwidth_hz", "period_s", "sample_rate_hz", "reference_range_m", "wave_speed_m_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"radar.{name} must be a positive number, got {getattr(self, name)}")
        if not (math.isfinite(self.speed_m_s) and self.speed_m_s >= 0):
            raise ValueError(f"radar.speed_m_s must be a number of 0 or more, got {self.speed_m_s}")
        if self.beam_rad is not None and not 0 < self.beam_rad < math.pi:
            raise ValueError(
                "radar.beam_rad must lie in 0..pi, or be None where the beam lights the whole scene, "
                f"got {self.beam_rad}"
            )
        if not (isinstance(self.keep_every, int) and self.keep_every >= 1):
            raise ValueError(f"radar.keep_every must be a whole number of 1 or more, got {self.keep_every}")
        if not self.bandwidth_hz < 2 * self.carrier_hz:
            raise ValueError(
                f"radar.bandwidth_hz of {self.bandwidth_hz:g} Hz does not fit about a carrier of {self.carrier_hz:g} Hz"
            )
        for name, kinds in (("detection", get_args(Detection)), ("dechirp_sign", get_args(DechirpSign))):
            if getattr(self, name) not in kinds:
                raise ValueError(f"radar.{name} must be one of {', '.join(kinds)}, got {getattr(self, name)!r}")
        samples = self.sweep_s * self.sample_rate_hz
        if round(samples) < 16 or abs(samples - round(samples)) > 1e-6 * samples:
            raise ValueError(
                f"a sweep of {self.sweep_s:g} s holds {samples:g} samples at {self.sample_rate_hz:g} "
                "Hz; choose a sample rate that makes it a whole number of 16 or more"
            )

    @property
    def wavelength_m(self) -> float:
        return self.wave_speed_m_s / self.carrier_hz

    @property
    def sweep_s(self) -> float:
        """Length of ONE sweep, half of the period."""
        return self.period_s / 2

    @property
    def chirp_rate_hz_s(self) -> float:
        """K = 2 B / period."""
        return self.bandwidth_hz / self.sweep_s

    @property
    def sweep_samples(self) -> int:
        """Samples of one sweep."""
        return round(self.sweep_s * self.sample_rate_hz)

    @property
    def range_step_m(self) -> float:
        """One range cell, c / (2 B), which is one bin 1 / sweep_s of the beat frequency."""
        return self.wave_speed_m_s / (2 * self.bandwidth_hz)

    @property
    def pulse_step_s(self) -> float:
        """Time from one recorded period to the next."""
        return self.keep_every * self.period_s

    @property
    def ambiguous_velocity_m_s(self) -> float:
        """Change of velocity that turns the phase between half sweeps once, lambda / (2 sweep_s):
        what integers count (brief 000, erratum 8).
        """
        return self.wavelength_m / (2 * self.sweep_s)

    def beat_hz(self, relative_range_m: float) -> float:
        """Beat frequency in the up sweep of a scatterer at rest, K 2 RD / c."""
        return self.chirp_rate_hz_s * 2 * relative_range_m / self.wave_speed_m_s

    def doppler_hz(self, velocity_m_s: float) -> float:
        """Shift of the beat by a radial velocity, 2 v / lambda, receding positive."""
        return 2 * velocity_m_s / self.wavelength_m

    def fast_time_axis(self) -> Axis:
        """Time u from the middle of a sweep, u_n = (n - (N - 1) / 2) / fs: symmetric, so that a
        sweep can be mirrored.
        """
        n, step = self.sweep_samples, 1 / self.sample_rate_hz
        return Axis("fast_time", n, -(n - 1) / 2 * step, step, "s")

    def sweep_axes(self, n_period: int, start_s: float | None = None) -> tuple[Axis, Axis, Axis]:
        """Axes of separated sweeps: ramp (0 up, 1 down), pulse (start of each period, s), fast time
        (s).

        start_s: start of the first period; by default the TURNING POINT of period n_period // 2
        lies at slow time zero, where a scatterer at azimuth zero is abeam.
        """
        start = -(n_period // 2) * self.pulse_step_s - self.period_s / 2 if start_s is None else start_s
        return (
            Axis("ramp", 2, 0.0, 1.0, ""),
            Axis("pulse", n_period, start, self.pulse_step_s, "s"),
            self.fast_time_axis(),
        )

    def record_axes(self, n_period: int, n_sample: int, start_s: float | None = None) -> tuple[Axis, Axis]:
        """Axes of blocks of a continuous record, one block a recorded period: pulse (start of each
        block, s) and time within the block (s).

        The first sample lies half a step after the start, so that samples of separated sweeps are
        samples of the record where the triangle starts with the block.
        """
        return self.sweep_axes(n_period, start_s)[1], Axis(
            "time", n_sample, 0.5 / self.sample_rate_hz, 1 / self.sample_rate_hz, "s"
        )


def sweep_middles(radar: TriangularLadar, pulse: Axis, device: torch.device | str | None = None) -> Tensor:
    """Slow times (s) of the middles of the up and the down sweeps, float64 (2, pulse).

    pulse: starts of the periods.
    """
    start = pulse.values(device)
    return torch.stack([start + 0.25 * radar.period_s, start + 0.75 * radar.period_s])
