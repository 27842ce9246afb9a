"""Everything that is true about a scene seen by a triangular-sweep ladar, and how finely its range
is followed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args

import torch
from torch import Tensor

from torchsar.radar import TriangularLadar
from torchsar.scene.fluctuation import LogAmplitude, RandomMotion
from torchsar.scene.targets import Scatterers, Scene
from torchsar.scene.vibration import Motion, displacement_m, refuse_unless_finite

Effect = Literal["residual_video", "hyperbola", "flight"]
# over so long a time the speed is taken that moves a target on during the last metres of the flight
_SHORT_S = 1e-6


@dataclass(frozen=True)
class Extremes:
    """What a scene and its motion reach, for predictions of neglected phases.

    range_m: nearest and farthest relative range; across_m: largest |V t - x|; velocity_m_s,
    acceleration_m_s2, jerk_m_s3: largest magnitudes of the whole range, velocity_change_m_s: over
    the recording.
    """

    range_m: tuple[float, float] = (0.0, 0.0)
    across_m: float = 0.0
    velocity_m_s: float = 0.0
    velocity_change_m_s: float = 0.0
    acceleration_m_s2: float = 0.0
    jerk_m_s3: float = 0.0


def omitted_phase_rad(without: Sequence[Effect], radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
    """Phase (rad) that each omitted effect would have made, brief 000, section 10.

    residual_video: pi K (dtau1^2 - dtau2^2) between the nearest and farthest scatterer, opposite in
    up and down sweeps. hyperbola: pi X^4 / (2 lambda R^3). flight: 4 pi / lambda times the change
    of the velocity times R / c, the shift of the epoch by a constant velocity being a constant
    phase.
    """
    near, far = sorted(abs(r) for r in extremes.range_m)
    least = 0.0 if extremes.range_m[0] * extremes.range_m[1] < 0 else near
    reference, per_m = radar.reference_range_m, 2 / radar.wave_speed_m_s
    phases = {
        "residual_video": math.pi * radar.chirp_rate_hz_s * per_m**2 * (far**2 - least**2),
        "hyperbola": math.pi
        * extremes.across_m**4
        / (2 * radar.wavelength_m * (reference + min(extremes.range_m)) ** 3),
        "flight": 4 * math.pi / radar.wavelength_m * extremes.velocity_change_m_s * reference / radar.wave_speed_m_s,
    }
    return {effect: phases[effect] for effect in without}


@dataclass(frozen=True)
class RangeHistory:
    """Range of scatterers against the reference range as a function of slow time: sqrt((Rref +
    RD)^2 + (V t - x)^2) - Rref + d(t - start_s).

    Formed as a difference. motion counts time from start_s. Without "flight" the range at the time
    of reception is taken, with it that at the reflection: R(t - R / c), where R / c is Rref / c and
    a first-order step for the rest. Without "hyperbola" the square root is a parabola.
    """

    scatterers: Scatterers
    radar: TriangularLadar
    motion: Sequence[Motion]
    start_s: float
    without: Sequence[Effect] = ()

    def at(self, time_s: Tensor) -> Tensor:
        """Relative range (m) at float64 times of any shape, (*trials, *times, target)."""
        if "flight" in self.without:
            return self._reflected(time_s)
        c = self.radar.wave_speed_m_s
        then = time_s - self.radar.reference_range_m / c
        there = self._reflected(then)
        return there - (there - self._reflected(then - _SHORT_S)) / _SHORT_S * there / c

    def _reflected(self, time_s: Tensor) -> Tensor:
        x, near = self.scatterers.azimuth_m, self.radar.reference_range_m + self.scatterers.range_m
        x, near, relative = (
            v[(...,) + (None,) * time_s.ndim + (slice(None),)] for v in (x, near, self.scatterers.range_m)
        )
        across = self.radar.speed_m_s * time_s[..., None] - x
        twice = 2 * near if "hyperbola" in self.without else torch.sqrt(near.square() + across.square()) + near
        return relative + across.square() / twice + displacement_m(self.motion, time_s - self.start_s)[..., None]

    def chords(self, middle_s: Tensor, half_s: float) -> tuple[Tensor, Tensor, Tensor]:
        """Range at middle_s, slope (m/s) of the chord from half_s before to half_s after, and bend
        (m/s^2), (*trials, *middles, target) each.
        """
        first, middle, last = (self.at(middle_s + shift) for shift in (-half_s, 0.0, half_s))
        return middle, (last - first) / (2 * half_s), ((last - middle) - (middle - first)) / half_s**2


Lines = tuple[Tensor, Tensor, Tensor | None]


class Fidelity(Protocol):
    """How finely the range is followed: what sweeps are made of, what is left out, and the phase
    that this costs.
    """

    @property
    def without(self) -> tuple[Effect, ...]: ...

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines: ...

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]: ...


@dataclass(frozen=True)
class _Level:
    """What every level has.

    without: effects that are left out, of "residual_video", "hyperbola", "flight".
    """

    without: tuple[Effect, ...] = ("flight",)

    def __post_init__(self) -> None:
        _refuse_effects(self.without)


@dataclass(frozen=True)
class EverySample(_Level):
    """The range at each sample: the yardstick.

    without: effects that are left out, of "residual_video", "hyperbola", "flight".
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines:
        """Range at the middles of sweeps and slope (m/s) of its chord, by which beats are judged:
        the echo itself asks for every sample.
        """
        return (*history.chords(middle_s, history.radar.sweep_s / 2)[:2], None)

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase (rad) of each thing left out, by name."""
        return omitted_phase_rad(self.without, radar, extremes)


@dataclass(frozen=True)
class QuadraticInSweep(_Level):
    """Line of the phase of each scatterer in each sweep, and one bend of it for all scatterers:
    acceleration, and the band that velocity takes along.

    Between `LinearInSweep` and `EverySample`, at little more than the cost of lines where
    scatterers are many. Neglects the jerk and what bends differ.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines:
        """Range at the middles of sweeps, slope (m/s) of its chord, and bend (m/s^2), (*trials,
        *middles, target) each.
        """
        return history.chords(middle_s, history.radar.sweep_s / 2)

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase (rad) of each thing left out, by name: `level` is that of the jerk, j u
        (u^2 - (T/2)^2) / 6, and of the band times the acceleration.
        """
        t = radar.sweep_s
        jerk = 4 * math.pi / radar.wavelength_m * extremes.jerk_m_s3 * (t / 2) ** 3 / 6 * 2 / math.sqrt(27)
        band = 2 * math.pi * radar.chirp_rate_hz_s * extremes.acceleration_m_s2 / radar.wave_speed_m_s * (t / 2) ** 3
        return {"level": jerk + band, **omitted_phase_rad(self.without, radar, extremes)}


@dataclass(frozen=True)
class LinearInSweep(_Level):
    """Phase and frequency of each scatterer in each sweep: the range goes along a straight line in
    it. The default (brief 000, section 10).

    Neglects acceleration and the band that velocity takes along, see neglected_phase_rad; the next
    levels are `QuadraticInSweep` and `EverySample`.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines:
        """Range at the middles of sweeps and slope (m/s) of its chord, (*trials, *middles, target)
        each.
        """
        return (*history.chords(middle_s, history.radar.sweep_s / 2)[:2], None)

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase (rad) of each thing left out, by name: `level` is that at the ends of a
        sweep, 4 pi / lambda a T^2 / 8 + pi K v T^2 / c.
        """
        t = radar.sweep_s
        bend = 4 * math.pi / radar.wavelength_m * extremes.acceleration_m_s2 * t**2 / 8
        band = math.pi * radar.chirp_rate_hz_s * extremes.velocity_m_s * t**2 / radar.wave_speed_m_s
        return {"level": bend + band, **omitted_phase_rad(self.without, radar, extremes)}


@dataclass(frozen=True)
class OnePerSweep(_Level):
    """Stop and go: the range stands still during each sweep.

    Velocity then does not exist for methods that look into sweeps; for comparisons only.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines:
        """Range at the middles of sweeps, slope zero."""
        middle = history.at(middle_s)
        return middle, torch.zeros_like(middle), None

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase (rad) of each thing left out, by name: `level` is that of the velocity at
        the ends of a sweep, there at the upper end of the band.
        """
        upper = radar.carrier_hz + radar.bandwidth_hz / 2
        return {
            "level": 4 * math.pi * upper / radar.wave_speed_m_s * extremes.velocity_m_s * radar.sweep_s / 2,
            **omitted_phase_rad(self.without, radar, extremes),
        }


@dataclass(frozen=True)
class OnePerPeriod(_Level):
    """Stop and go from period to period: both sweeps see the range of the turning point between
    them. For comparisons only.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> Lines:
        """Range at the turning points, slope zero. middle_s: (2, pulse), up sweeps first."""
        middle = history.at(middle_s.mean(0, keepdim=True).expand_as(middle_s))
        return middle, torch.zeros_like(middle), None

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase (rad) of each thing left out, by name: `level` is that of the velocity at
        the ends of the period.
        """
        upper = radar.carrier_hz + radar.bandwidth_hz / 2
        return {
            "level": 4 * math.pi * upper / radar.wave_speed_m_s * extremes.velocity_m_s * radar.sweep_s,
            **omitted_phase_rad(self.without, radar, extremes),
        }


class SweepError(Protocol):
    """Phase error of the laser in its sweeps: float64 times u (s) from the middle of a sweep, ramp
    0 (up) or 1 (down) -> turns of u's shape.
    """

    def turns(self, time_s: Tensor, ramp: int) -> Tensor: ...


@dataclass(frozen=True)
class CalibrationFibre:
    """An internal channel that beats the sweep against itself through a fibre of known delay (s),
    with its own SNR per sample.

    every_period: recorded in every period, or once for the whole recording.
    """

    delay_s: float
    snr_db: Tensor | float | None = None
    every_period: bool = False

    def __post_init__(self) -> None:
        refuse_unless_finite("delay_s of a calibration fibre", self.delay_s, 0.0)
        if not self.delay_s > 0:
            raise ValueError(
                "delay_s of a calibration fibre must be longer than 0 s; leave the fibre out where there is none"
            )
        if self.snr_db is not None:
            refuse_unless_finite("snr_db of a calibration fibre", self.snr_db)


@dataclass(frozen=True)
class LadarWorld:
    """A scene, what moves its line of sight, what the air and the laser do, and the noise.

    motion: list of motions, fixed or random (`drawn`), time from the start of the first recorded
    period. log_amplitude: scintillation. snr_db: PER SAMPLE of a scatterer of amplitude 1, before
    any compression, a number or per-trial tensor (...,); None for no noise. fidelity: how finely
    the range is followed. gate_m: (low, high) relative range; scatterers outside it are not
    recorded. sweep_error: phase error of the laser's sweeps; calibration: an internal fibre that
    shows it to the processor. What is None is absent.
    """

    scene: Scene
    motion: Sequence[Motion | RandomMotion] = ()
    log_amplitude: LogAmplitude | None = None
    snr_db: Tensor | float | None = None
    fidelity: Fidelity = field(default_factory=LinearInSweep)
    gate_m: tuple[float, float] | None = None
    sweep_error: SweepError | None = None
    calibration: CalibrationFibre | None = None

    def __post_init__(self) -> None:
        if self.snr_db is not None:
            refuse_unless_finite("snr_db", self.snr_db)
        if not hasattr(self.scene, "scatterers"):
            raise TypeError(f"scene must be an object with scatterers, such as Points or LetterE, got {self.scene!r}")
        if hasattr(self.motion, "displacement_m") or hasattr(self.motion, "drawn"):
            raise TypeError("motion must be a list of motions; put a single one in brackets")
        if self.gate_m is not None and not (
            isinstance(self.gate_m, tuple | list) and len(self.gate_m) == 2 and self.gate_m[0] < self.gate_m[1]
        ):
            raise ValueError(f"gate_m must be (low, high) relative range in m with low < high, got {self.gate_m}")
        if isinstance(self.fidelity, type) or not hasattr(self.fidelity, "sweep_range_m"):
            raise TypeError(
                "fidelity must be LinearInSweep(), QuadraticInSweep(), EverySample(), OnePerSweep() "
                f"or OnePerPeriod(), got {self.fidelity!r}"
            )


def _refuse_effects(without: Sequence[str]) -> None:
    if isinstance(without, str) or not set(without) <= set(get_args(Effect)):
        raise ValueError(
            f"effects that may be left out are {', '.join(get_args(Effect))}, got {without!r}; give a tuple of them"
        )
