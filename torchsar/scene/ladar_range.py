"""Range history of a scene seen by a triangular-sweep ladar, and models of it within a sweep.

Strongest scatterers of a scene seen by a ladar, and bounds of its ranges and motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.radar import TriangularLadar
from torchsar.radar.ladar import leading
from torchsar.scene.motion import Motion, displacement_m
from torchsar.scene.targets import Points, Scatterers

Effect = Literal["residual_video", "hyperbola", "flight"]


@dataclass(frozen=True)
class Extremes:
    """Largest ranges and motions of a scene, from which neglected phases are predicted.

    The values are plain numbers, common to all trials.

    Args:
        range_m: Smallest and largest range of the scatterers relative to the reference range in
            metres.
        across_m: Largest along-track distance of the ladar from a scatterer in metres.
        velocity_m_s: Largest magnitude of the radial velocity in metres per second.
        velocity_change_m_s: Largest change of the radial velocity over the recording in metres per
            second.
        acceleration_m_s2: Largest magnitude of the radial acceleration in m/s^2.
        jerk_m_s3: Largest magnitude of the derivative of the radial acceleration in m/s^3.
        displacement_m: Difference of largest and smallest displacement along the line of sight in
            metres.
    """

    range_m: tuple[float, float] = (0.0, 0.0)
    across_m: float = 0.0
    velocity_m_s: float = 0.0
    velocity_change_m_s: float = 0.0
    acceleration_m_s2: float = 0.0
    jerk_m_s3: float = 0.0
    displacement_m: float = 0.0

    @staticmethod
    def of(
        radar: TriangularLadar,
        motion: Sequence[Motion],
        n_period: int,
        range_m: tuple[float, float],
        azimuth_m: float,
    ) -> Extremes:
        """Determine the extremes of a scene; the motion is differentiated numerically.

        Args:
            radar: Ladar parameters.
            motion: Motions along the line of sight; only the first trial is used.
            n_period: Number of recorded periods.
            range_m: Smallest and largest range of the scatterers relative to the reference range in
                metres.
            azimuth_m: Largest magnitude of the azimuth of the scatterers in metres.

        Returns:
            The extremes.
        """
        span_s = n_period * radar.pulse_step_s
        # 16 samples per period, but at most 4 million
        n = min(max(8, n_period * radar.keep_every * 16), 1 << 22)
        time_s = torch.arange(n, dtype=torch.float64) * (span_s / n)
        course = displacement_m(motion, time_s).reshape(-1, n)[0]
        velocity = torch.gradient(course, spacing=span_s / n)[0]
        # repeated numerical differentiation is less accurate at the ends, which are left out
        acceleration = torch.gradient(velocity, spacing=span_s / n)[0][2:-2]
        jerk = torch.gradient(acceleration, spacing=span_s / n)[0][2:-2]
        return Extremes(
            range_m,
            radar.speed_m_s * span_s / 2 + azimuth_m,
            float(velocity.abs().max()),
            float(velocity.max() - velocity.min()),
            float(acceleration.abs().max()),
            float(jerk.abs().max()) if len(jerk) else 0.0,
            float(course.max() - course.min()),
        )


def omitted_phase_rad(without: Sequence[Effect], radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
    """Predict the phase error that the omission of each physical effect causes.

    Without the residual video phase ("residual_video") the error is pi K (dtau1^2 - dtau2^2), with
    the chirp rate K and the delays dtau1 and dtau2 of the farthest and the nearest scatterer from
    the reference range, relative to the delay of this range. The sign of the error is opposite in
    up-sweeps and down-sweeps.

    With a parabola instead of the hyperbola ("hyperbola") the error is pi X^4 / (2 lambda R^3),
    with the largest along-track distance X between ladar and scatterer and the smallest range R.

    Without the flight time ("flight") ranges are taken at a time that is wrong by Rref / c, with
    the reference range Rref. The error is 4 pi / lambda dv Rref / c, with the change dv of the
    radial velocity over the recording; a constant velocity would cause only a constant phase.

    Args:
        without: Omitted effects, of "residual_video", "hyperbola" and "flight".
        radar: Ladar parameters.
        extremes: Largest ranges and motions of the scene.

    Returns:
        Phase error in radians by name of the effect.
    """
    near, far = sorted(abs(r) for r in extremes.range_m)
    least = 0.0 if extremes.range_m[0] * extremes.range_m[1] < 0 else near
    reference, per_m = radar.reference_range_m, 2 / radar.wave_speed_m_s
    cube = 2 * radar.wavelength_m * (reference + min(extremes.range_m)) ** 3
    phases = {
        "residual_video": math.pi * radar.chirp_rate_hz_s * per_m**2 * (far**2 - least**2),
        "hyperbola": math.pi * extremes.across_m**4 / cube,
        "flight": 4 * math.pi / radar.wavelength_m * extremes.velocity_change_m_s * reference / radar.wave_speed_m_s,
    }
    return {effect: phases[effect] for effect in without}


@dataclass(frozen=True)
class RangeHistory:
    """Range of scatterers relative to the reference range as a function of slow time.

    At slow time t the range of a scatterer relative to the reference range Rref is
    sqrt((Rref + RD)^2 + (V t - x)^2) - Rref + d(t - start_s), with the relative range RD and the
    azimuth x of the scatterer, the speed V of the ladar and the displacement d by the motions. The
    difference is formed without loss of digits. If "hyperbola" is omitted, a parabola replaces the
    square root.

    The wave that is received at the time t was reflected at about t - R / c, with the range R. If
    "flight" is omitted, the range is taken at t, otherwise at t - R / c: the part Rref / c of this
    delay is exact, the rest is accounted for to first order.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Ladar parameters.
        motion: Motions along the line of sight.
        start_s: Slow time in seconds at which the time of the motions is zero, fixed for all
            trials.
        without: Omitted effects, of "residual_video", "hyperbola" and "flight".
    """

    scatterers: Scatterers
    radar: TriangularLadar
    motion: Sequence[Motion]
    start_s: float
    without: Sequence[Effect] = ()

    def at(self, time_s: Tensor) -> Tensor:
        """Evaluate the relative range.

        Args:
            time_s: Slow time in seconds, any shape, float64.

        Returns:
            Relative range in metres, shape (*trials, *times, target).
        """
        if "flight" in self.without:
            return self._reflected(time_s)
        c = self.radar.wave_speed_m_s
        then = time_s - self.radar.reference_range_m / c
        there = self._reflected(then)
        # The step of the numerical derivative is short compared with any motion. Rounding of a
        # range of 1 m causes an error of 2e-10 m/s.
        short_s = 1e-6
        return there - (there - self._reflected(then - short_s)) / short_s * there / c

    def _reflected(self, time_s: Tensor) -> Tensor:
        """Relative range at given times of reflection, (*trials, *times, target)."""
        x, near = self.scatterers.azimuth_m, self.radar.reference_range_m + self.scatterers.range_m
        x, near, relative = (
            v[(...,) + (None,) * time_s.ndim + (slice(None),)] for v in (x, near, self.scatterers.range_m)
        )
        across = self.radar.speed_m_s * time_s[..., None] - x
        twice = 2 * near if "hyperbola" in self.without else torch.sqrt(near.square() + across.square()) + near
        return relative + across.square() / twice + displacement_m(self.motion, time_s - self.start_s)[..., None]

    def chords(self, middle_s: Tensor, half_s: float) -> tuple[Tensor, Tensor, Tensor]:
        """Approximate the range about given times by value, slope and curvature.

        Args:
            middle_s: Slow times in seconds, any shape, float64.
            half_s: Half the length of the chord in seconds.

        Returns:
            Range in metres, slope of the chord in m/s and second derivative in m/s^2, shape
            (*trials, *times, target) each.
        """
        first, middle, last = (self.at(middle_s + shift) for shift in (-half_s, 0.0, half_s))
        return middle, (last - first) / (2 * half_s), ((last - middle) - (middle - first)) / half_s**2


@dataclass(frozen=True)
class Fidelity:
    """Model of the range within a sweep, the base of all models.

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """

    without: tuple[Effect, ...] = ("flight",)

    def __post_init__(self) -> None:
        if isinstance(self.without, str) or not set(self.without) <= set(get_args(Effect)):
            raise ValueError(
                f"without must be a tuple of the effects to leave out ({', '.join(get_args(Effect))}), got "
                f"{self.without!r}"
            )

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return range, slope and curvature of each scatterer in each sweep.

        Args:
            history: Range of the scatterers.
            middle_s: Slow times of the sweep middles in seconds, shape (2, pulse), up-sweeps first.

        Returns:
            Range in metres, slope of its chord in m/s, shape (*trials, 2, pulse, target), and the
            second derivative in m/s^2, or None where the model has none.
        """
        return (*history.chords(middle_s, history.radar.sweep_s / 2)[:2], None)

    def neglected_phase_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Predict the largest phases that the range model neglects.

        Args:
            radar: Ladar parameters.
            extremes: Largest ranges and motions of the scene.

        Returns:
            Phase in radians by name of the effect: `level` for the approximation of the range
            within a sweep, unless the model is exact, and one value for each omitted effect.
        """
        return {**self._level_rad(radar, extremes), **omitted_phase_rad(self.without, radar, extremes)}

    def _level_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        """Largest phase errors due to the approximation of the range within a sweep, with the key
        "level".
        """
        return {}


@dataclass(frozen=True)
class EverySample(Fidelity):
    """Range evaluated at every sample: the exact model, and the slowest.

    >>> from torchsar import radar, scene
    >>> from torchsar.scene.ladar_range import Extremes
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> model = scene.EverySample(without=("hyperbola",))
    >>> round(model.neglected_phase_rad(ladar, Extremes(across_m=5.0))["hyperbola"], 2)
    0.63

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """


@dataclass(frozen=True)
class QuadraticInSweep(Fidelity):
    """Quadratic phase of each scatterer in each sweep, with one curvature for all scatterers.

    >>> from torchsar import radar, scene
    >>> from torchsar.scene.ladar_range import Extremes
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> largest = Extremes(jerk_m_s3=1e4)
    >>> round(scene.QuadraticInSweep().neglected_phase_rad(ladar, largest)["level"], 1)
    0.1

    The curvature accounts for the acceleration and for the change of the Doppler shift across the
    band. For many scatterers the model takes little longer than `LinearInSweep`. It neglects the
    jerk and differences of the curvature between scatterers.

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        return history.chords(middle_s, history.radar.sweep_s / 2)

    def _level_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        # The phases are due to the radial jerk j and to the radial acceleration over the band.
        # At the time u from the middle of a sweep of length T, the jerk causes the range error j u
        # (u^2 - (T/2)^2) / 6.
        t = radar.sweep_s
        jerk = 4 * math.pi / radar.wavelength_m * extremes.jerk_m_s3 * (t / 2) ** 3 / 6 * 2 / math.sqrt(27)
        band = 2 * math.pi * radar.chirp_rate_hz_s * extremes.acceleration_m_s2 / radar.wave_speed_m_s * (t / 2) ** 3
        return {"level": jerk + band}


@dataclass(frozen=True)
class LinearInSweep(Fidelity):
    """Linear phase of each scatterer in each sweep: the range follows a straight line. The default.

    >>> from torchsar import radar, scene
    >>> from torchsar.scene.ladar_range import Extremes
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> largest = Extremes(acceleration_m_s2=0.5)
    >>> round(scene.LinearInSweep().neglected_phase_rad(ladar, largest)["level"], 1)
    0.1

    The model neglects the acceleration and the change of the Doppler shift across the band; see
    `neglected_phase_rad`. `QuadraticInSweep` and `EverySample` are more exact.

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """

    def _level_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        # The phase at the ends of a sweep of length T and chirp rate K is 4 pi / lambda a T^2 / 8 +
        # pi K v T^2 / c. It is due to the radial acceleration a and the radial velocity v.
        t = radar.sweep_s
        bend = 4 * math.pi / radar.wavelength_m * extremes.acceleration_m_s2 * t**2 / 8
        band = math.pi * radar.chirp_rate_hz_s * extremes.velocity_m_s * t**2 / radar.wave_speed_m_s
        return {"level": bend + band}


@dataclass(frozen=True)
class OnePerSweep(Fidelity):
    """Stop-and-go approximation: the range is constant during each sweep.

    >>> from torchsar import radar, scene
    >>> from torchsar.scene.ladar_range import Extremes
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> largest = Extremes(velocity_m_s=0.001)
    >>> round(scene.OnePerSweep().neglected_phase_rad(ladar, largest)["level"], 1)
    2.0

    There is no Doppler shift within a sweep, so that methods that measure the velocity within
    sweeps find none. For comparisons only.

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        middle = history.at(middle_s)
        return middle, torch.zeros_like(middle), None

    def _level_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        # phase at the ends of a sweep due to the radial velocity, at the upper edge of the band
        upper = radar.carrier_hz + radar.bandwidth_hz / 2
        return {"level": 4 * math.pi * upper / radar.wave_speed_m_s * extremes.velocity_m_s * radar.sweep_s / 2}


@dataclass(frozen=True)
class OnePerPeriod(OnePerSweep):
    """Stop-and-go approximation by period, with the range at the turning point for both sweeps.

    >>> from torchsar import radar, scene
    >>> from torchsar.scene.ladar_range import Extremes
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> largest = Extremes(velocity_m_s=0.001)
    >>> round(scene.OnePerPeriod().neglected_phase_rad(ladar, largest)["level"], 1)
    4.0

    For comparisons only.

    Args:
        without: Effects that are omitted, a tuple of "residual_video", "hyperbola" and "flight".

    Raises:
        ValueError: If an effect is unknown.
    """

    def sweep_range_m(self, history: RangeHistory, middle_s: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        return super().sweep_range_m(history, middle_s.mean(0, keepdim=True).expand_as(middle_s))

    def _level_rad(self, radar: TriangularLadar, extremes: Extremes) -> dict[str, float]:
        # a period has twice the length of a sweep
        return {"level": 2 * super()._level_rad(radar, extremes)["level"]}


@dataclass(frozen=True)
class Moved:
    """Strongest scatterers and bounds of ranges and motion, of one trial of a ladar scene.

    Args:
        azimuth_m, range_m: Positions in metres of the strongest scatterers, those within 10 dB of
            the largest amplitude, shape (target,).
        peak: Largest amplitude.
        motion: Motions along the line of sight, random ones already drawn.
        extremes: Bounds of ranges and motion.
    """

    azimuth_m: Tensor
    range_m: Tensor
    peak: float
    motion: Sequence[Motion]
    extremes: Extremes

    @property
    def farthest(self) -> Points:
        """Of the strongest scatterers, the one farthest from the middle of the scene."""
        far = int((self.range_m.abs() + self.azimuth_m.abs()).argmax())
        return Points([float(self.azimuth_m[far])], [float(self.range_m[far])])

    @staticmethod
    def of(
        radar: TriangularLadar,
        scene: Scatterers,
        motion: Sequence[Motion],
        periods: int,
        gate_m: tuple[float, float] | None = None,
    ) -> Moved:
        """Find the strongest scatterers and the bounds of the first trial of a scene.

        Args:
            radar: Ladar parameters.
            scene: Scatterers.
            motion: Drawn motions.
            periods: Number of sweep periods.
            gate_m: Smallest and largest range that is seen, relative to the reference range in
                metres; None for all ranges.

        Returns:
            Strongest scatterers within the gate, motions and bounds.

        Raises:
            ValueError: If no scatterer can be seen, or one lies where no sweep can show it.
        """
        azimuth, ranges, level = (
            v.reshape(-1, v.shape[-1])[0] for v in (scene.azimuth_m, scene.range_m, scene.amplitude.abs())
        )
        low, high = gate_m or (-math.inf, math.inf)
        inside = (level > 0) & (ranges >= low) & (ranges <= high)
        leads = leading(torch.where(inside, level, 0))
        if not bool(leads.any()):
            raise ValueError(
                "world: no scatterer of the scene within the gate has an amplitude above 0; add such a scatterer, "
                "or widen gate_m"
            )
        reach = float(ranges[inside].min()), float(ranges[inside].max())
        _refuse_unseen_ranges(radar, *reach)
        extremes = Extremes.of(radar, motion, periods, reach, float(azimuth.abs().max()))
        return Moved(azimuth[leads], ranges[leads], float(level[leads].max()), motion, extremes)


def _refuse_unseen_ranges(radar: TriangularLadar, near_m: float, far_m: float) -> None:
    """Raise ValueError if the relative ranges of scatterers in metres cannot be observed.

    A scatterer must be in front of the ladar, and its beat frequency must not be aliased.
    """
    if near_m <= -radar.reference_range_m:
        raise ValueError(
            f"world: a scatterer at the relative range {near_m:g} m lies behind the ladar, whose reference range is "
            f"{radar.reference_range_m:g} m; ranges of scatterers are relative to it"
        )
    reach = radar.sample_rate_hz / 2 / radar.beat_hz(1.0)
    if max(-near_m, far_m) >= reach:
        raise ValueError(
            f"world: relative ranges of scatterers must lie within +-{reach:.4g} m, since larger ranges have beat "
            f"frequencies that alias, got {near_m:g} to {far_m:g} m; bring the reference range nearer, or sample faster"
        )
