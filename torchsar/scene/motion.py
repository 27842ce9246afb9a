"""Random motions along the line of sight, scintillation, and measured motions.

Motions of a target along the line of sight, and start phases of pulses.

A simulation takes motions and start phases as lists; an empty list stands for no such effect.
Displacements are positive away from the radar; a displacement d changes the phase by
-4 pi d / lambda. Time counts from the first pulse.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchsar.core import Draws, Spline, per_trial
from torchsar.scene.trials import finite, finite_numbers, positive, refuse_unless, refuse_unless_finite, with_dims

# form amplitude_frequency_phase, such as 1_0.1_90
_NAME = re.compile(r"(\d+(?:\.\d+)?)_(\d+(?:\.\d+)?)_(-?\d+(?:\.\d+)?)")


class Motion(Protocol):
    """Displacement of the whole target along the line of sight.

    >>> import torch
    >>> from torchsar import scene
    >>> class Step(scene.Motion):
    ...     def displacement_m(self, time_s):
    ...         return 0.5 * (time_s > 1)
    >>> Step().displacement_m(torch.tensor([0.5, 1.5])).tolist()
    [0.0, 0.5]
    """

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Return the displacement.

        Args:
            time_s: Time since the first pulse in seconds, any shape, float64.

        Returns:
            Displacement in metres, receding positive, shape (*trials, *times).
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a vibration", frequency_hz=0.0)
class Sinusoid(Motion):
    """Sinusoidal vibration, d(t) = A sin(2 pi f t + phase).

    >>> import torch
    >>> from torchsar import scene
    >>> shake = scene.Sinusoid(amplitude_m=0.002, frequency_hz=0.25)
    >>> shake.displacement_m(torch.tensor([0.0, 1.0], dtype=torch.float64)).tolist()
    [0.0, 0.002]

    This SINE reproduces the results of the Reference. With a cosine, the vibration `1_0.1_90` of
    the Reference (amplitude 1, 0.1 Hz, 90 degrees) would be nearly linear in time and hardly
    defocus.

    Args:
        amplitude_m: Amplitude A in metres.
        frequency_hz: Frequency f in hertz.
        phase_deg: Phase at the first pulse in degrees.

    Raises:
        ValueError: If a number is not finite or the frequency is negative.

    Reference:
        Ruan et al. 2013, Table 1.
    """

    amplitude_m: Tensor | float
    frequency_hz: Tensor | float
    phase_deg: Tensor | float = 0.0

    @classmethod
    def named(cls, name: str, *, unit: Literal["mm", "um"]) -> Sinusoid:
        """Return the sinusoidal vibration of a name amplitude_frequency_phase, such as `1_0.1_90`.

        Args:
            name: Amplitude in `unit`, frequency in hertz and phase in degrees.
            unit: Unit of the amplitude, "mm" or "um". The figures of the Reference agree with mm,
                although a vibration of 1 mm at 100 Hz then adds 4 rad within a pulse, which the
                Reference neglects.

        Returns:
            The vibration.

        Raises:
            ValueError: If the name or the unit has another form.

        Reference:
            Ruan et al. 2013, Table 1.
        """
        metres = {"mm": 1e-3, "um": 1e-6}
        if unit not in metres:
            raise ValueError(f"unit {unit!r} of a vibration's amplitude is unknown; choose 'mm' or 'um'")
        found = _NAME.fullmatch(name) if isinstance(name, str) else None
        if found is None:
            raise ValueError(
                f"vibration {name!r} does not have the form amplitude_frequency_phase (amplitude in {unit}, frequency "
                "in Hz, phase in degrees), such as '1_100_90' or '1_0.1_90'"
            )
        amplitude, frequency, phase = (float(part) for part in found.groups())
        return cls(amplitude * metres[unit], frequency, phase)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        amplitude, frequency, phase = (
            per_trial(v, time_s.ndim, time_s) for v in (self.amplitude_m, self.frequency_hz, self.phase_deg)
        )
        turns = frequency * time_s + phase / 360
        return amplitude * torch.sin(2 * math.pi * (turns - torch.round(turns.detach())))


@dataclass(frozen=True)
@finite_numbers("a translation", coefficients_m=None)
class Polynomial(Motion):
    """Translation d(t) = c1 t + c2 t^2 + ...

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    >>> scene.Polynomial([1.0, 0.5]).displacement_m(time_s).tolist()
    [0.0, 1.5, 4.0]

    There is no constant term: the range window is centred on the initial position.

    Args:
        coefficients_m: c1, c2, ... in m/s, m/s^2, ...: velocity, half the acceleration, and so on;
            each a number or one value per trial.

    Raises:
        ValueError: If there is no coefficient, or one is not finite.
    """

    coefficients_m: Sequence[Tensor | float]

    def __post_init__(self) -> None:
        if not len(self.coefficients_m):
            raise ValueError(
                "a translation needs at least one coefficient, its velocity in m/s; leave the motion "
                "out if there is no translation"
            )
        for degree, value in enumerate(self.coefficients_m, start=1):
            refuse_unless_finite(f"coefficient {degree} of a translation", value)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        total = torch.zeros_like(time_s)
        for value in reversed(self.coefficients_m):
            total = (total + per_trial(value, time_s.ndim, time_s)) * time_s
        return total


def displacement_m(motion: Sequence[Motion], time_s: Tensor) -> Tensor:
    """Return the total displacement of several motions.

    Args:
        motion: Motions; an empty sequence gives zero displacement.
        time_s: Time since the first pulse in seconds, any shape, float64.

    Returns:
        Displacement in metres, receding positive, shape (*trials, *times).
    """
    return sum((part.displacement_m(time_s) for part in motion), torch.zeros_like(time_s))


class PulsePhase(Protocol):
    """Start phase of the pulses."""

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        """Draw the phases.

        Args:
            draws: Random draws.
            n_pulse: Number of pulses.

        Returns:
            Phase in radians, shape (*trials, pulse), float64.
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a start phase", sigma_rad=0.0)
class StartPhase(PulsePhase):
    """Independent normally distributed phase of each pulse.

    >>> from torchsar import Draws, scene
    >>> phase_rad = scene.StartPhase(sigma_rad=0.5).phase_rad(Draws(seed=1), n_pulse=1000)
    >>> phase_rad.shape, round(float(phase_rad.std()), 1)
    (torch.Size([1000]), 0.5)

    Args:
        sigma_rad: Standard deviation in radians.

    Raises:
        ValueError: If the standard deviation is negative or not finite.
    """

    sigma_rad: Tensor | float

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        unit = draws.normal("scene.start_phase.normal", (n_pulse,))
        return per_trial(self.sigma_rad, 1, unit) * unit


@dataclass(frozen=True)
class UniformStartPhase(PulsePhase):
    """Independent phase of each pulse, uniform in 0 to 2 pi: pulses are incoherent.

    >>> from torchsar import Draws, scene
    >>> phase_rad = scene.UniformStartPhase().phase_rad(Draws(seed=1), n_pulse=1000)
    >>> [round(float(bound), 1) for bound in phase_rad.aminmax()]
    [0.0, 6.3]
    """

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        return draws.uniform("scene.start_phase.uniform", (n_pulse,), 0.0, 2 * math.pi)


def start_phase_rad(effects: Sequence[PulsePhase], draws: Draws, n_pulse: int) -> Tensor:
    """Draw the start phases of several effects and return their sum.

    Args:
        effects: Effects. The position of an effect in the list decides which random numbers it
            draws.
        draws: Random draws.
        n_pulse: Number of pulses.

    Returns:
        Phase in radians, shape (*trials, pulse), float64.
    """
    drawn = (effect.phase_rad(draws.part(f"start_phase.{at}"), n_pulse) for at, effect in enumerate(effects))
    return sum(drawn, torch.zeros(n_pulse, dtype=torch.float64))


@runtime_checkable
class RandomMotion(Protocol):
    """Motion that is drawn in each trial."""

    def drawn(self, draws: Draws, span_s: float) -> Motion:
        """Draw the motion of each trial.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            The drawn motion, a different one in each trial.
        """
        ...


def drawn_motion(motion: Sequence[Motion | RandomMotion], draws: Draws, span_s: float) -> list[Motion]:
    """Draw the random motions of a list.

    Args:
        motion: Fixed and random motions.
        draws: Source of random numbers; the numbers of each motion depend on its position in the
            list.
        span_s: Length of the recording in seconds.

    Returns:
        Fixed motions and drawn ones, in the order of the list.
    """
    return [
        part.drawn(draws.part(f"motion.{position}"), span_s) if isinstance(part, RandomMotion) else part
        for position, part in enumerate(motion)
    ]


@dataclass(frozen=True)
class Tones(Motion):
    """Sum of sinusoids, sum_i cosine_i cos(2 pi f_i t) + sine_i sin(2 pi f_i t).

    Args:
        frequency_hz: Frequencies in hertz, shape (tone,) if shared by all trials, which takes less
            time, or (..., tone), float64.
        cosine: Cosine amplitudes, shape (..., tone), float64; in metres for a motion.
        sine: Sine amplitudes, shape (..., tone), float64.
    """

    frequency_hz: Tensor
    cosine: Tensor
    sine: Tensor

    def value(self, time_s: Tensor) -> Tensor:
        """Evaluate the sum in blocks of times, which limits the memory.

        Args:
            time_s: Times in seconds, any shape, shared by all trials, float64.

        Returns:
            Sum in the unit of the amplitudes, shape (*trials, *times), float64.
        """
        # the phases of 64 sinusoids then take 8 MB, about the size of a processor's cache
        times = max(1, (1 << 14) // self.frequency_hz.shape[:-1].numel())
        parts = [self._block(block) for block in time_s.flatten().split(times)]
        values = torch.cat(parts, -1)
        return values.reshape((*values.shape[:-1], *time_s.shape))

    displacement_m = value

    def _block(self, time_s: Tensor) -> Tensor:
        """Sum of the sinusoids at times (time,), (*trials, time)."""
        turns = self.frequency_hz.to(time_s.device)[..., None] * time_s
        angle = 2 * math.pi * (turns - torch.round(turns.detach()))
        cosine, sine = self.cosine.to(time_s.device), self.sine.to(time_s.device)
        if angle.ndim == 2:  # the frequencies are the same in all trials
            return cosine @ torch.cos(angle) + sine @ torch.sin(angle)
        return (cosine[..., None, :] @ torch.cos(angle) + sine[..., None, :] @ torch.sin(angle))[..., 0, :]


@dataclass(frozen=True)
class _PowerLaw:
    """Base of random functions of time whose power spectral density follows a power of the
    frequency.
    """

    def __post_init__(self) -> None:
        expected = "a random motion needs 0 < lowest_hz <= highest_hz and a finite slope"
        low, high, slope, count = self._band
        refuse_unless(expected, slope, finite)
        for bound in (low, high):
            if bound is not None:
                refuse_unless(expected, bound, positive)
        if low is not None and high is not None:
            refuse_unless(expected, low, lambda x: x <= high, f"highest_hz is {high}")
        if not (isinstance(count, int) and count >= 1):
            raise ValueError(f"count of sinusoids of a random motion must be a whole number of 1 or more, got {count}")

    @property
    def _band(self) -> tuple[Tensor | float | None, Tensor | float | None, Tensor | float, int]:
        """Lower and upper limit of the band in Hz, exponent of the density, and number of
        sinusoids.
        """
        return tuple(getattr(self, name) for name in ("lowest_hz", "highest_hz", "slope", "count"))  # pyright: ignore

    @property
    def _rms(self) -> Tensor | float:
        """Root mean square value, which is the first parameter of the class."""
        return getattr(self, fields(self)[0].name)

    def drawn(self, draws: Draws, span_s: float) -> Tones:
        """Draw the phases of the sinusoids.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            The sinusoids, amplitudes in the unit of the rms value.

        Raises:
            ValueError: If the band is empty, because its upper end is below one cycle in the
                recording.
        """
        lowest, highest, slope, count = self._band
        lowest = 1 / span_s if lowest is None else lowest
        if highest is None:
            default = torch.as_tensor(10 * lowest, dtype=torch.float64).clamp_min(2000.0)
            highest = default if isinstance(lowest, Tensor) else float(default)
        return random_tones(draws, self._rms, lowest, highest, slope, count)


@dataclass(frozen=True)
@finite_numbers("a random motion", rms_m=0.0, lowest_hz=None, highest_hz=None, slope=None)
class VibrationSpectrum(_PowerLaw):
    """Random vibration whose power spectral density follows a power of the frequency.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> drawn = scene.VibrationSpectrum(1e-6, 10.0, 100.0).drawn(Draws(seed=1), span_s=10.0)
    >>> round(1e6 * float(drawn.displacement_m(torch.arange(0, 10, 1e-3)).std()), 1)
    1.0

    The motion is a sum of sinusoids with random phases. Their frequencies are spaced evenly in the
    logarithm, and each has the power of its part of the band, so that every trial has the same rms
    value over a long time. Equal limits give a single frequency.

    Args:
        rms_m: Root mean square of the displacement within the band in metres.
        lowest_hz: Lower end of the band in hertz, None for one cycle in the recording.
        highest_hz: Upper end of the band in hertz.
        slope: Exponent p of the power spectral density, which is proportional to f^p.
        count: Number of sinusoids, fixed for all trials.

    Raises:
        ValueError: If the rms value is negative, the band is empty or the count is not positive.
    """

    rms_m: Tensor | float
    lowest_hz: Tensor | float | None
    highest_hz: Tensor | float
    slope: Tensor | float = 0.0
    count: int = 64


@dataclass(frozen=True)
class PathFluctuation(VibrationSpectrum):
    """Fluctuation of the optical path by turbulent air.

    >>> from torchsar import Draws, scene
    >>> drawn = scene.PathFluctuation(rms_m=1e-6).drawn(Draws(seed=1), span_s=1.0)
    >>> drawn.frequency_hz[[0, -1]].round().tolist()
    [1.0, 1885.0]

    By default the power spectral density follows f^(-8/3), as for a point receiver in Kolmogorov
    turbulence. The displacement is added to the range, that is, to the mean of the paths to and
    from the target. The motion is a sum of sinusoids as in `VibrationSpectrum`.

    Args:
        rms_m: Root mean square of the displacement within the band in metres.
        lowest_hz: Lower end of the band in hertz, None for one cycle in the recording.
        highest_hz: Upper end of the band in hertz; None for 2 kHz or ten times the lower end,
            whichever is higher.
        slope: Exponent p of the power spectral density, which is proportional to f^p.
        count: Number of sinusoids, fixed for all trials.

    Raises:
        ValueError: If the rms value is negative, the band is empty or the count is not positive.
    """

    lowest_hz: Tensor | float | None = None
    highest_hz: Tensor | float | None = None
    slope: Tensor | float = -8 / 3


@dataclass(frozen=True)
@finite_numbers("a log-amplitude", rms=0.0, lowest_hz=None, highest_hz=None, slope=None)
class LogAmplitude(_PowerLaw):
    """Scintillation: the echo amplitude is multiplied by exp(chi(t)), equally for all scatterers.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> drawn = scene.LogAmplitude(rms=0.2, lowest_hz=1.0).drawn(Draws(seed=1), span_s=10.0)
    >>> round(float(drawn.value(torch.arange(0, 10, 0.01)).std()), 1)
    0.2

    By default the power spectral density of the log-amplitude chi follows f^(-5/3).

    Args:
        rms: Root mean square of chi within the band.
        lowest_hz: Lower end of the band in hertz, None for one cycle in the recording.
        highest_hz: Upper end of the band in hertz; None for 2 kHz or ten times the lower end,
            whichever is higher.
        slope: Exponent p of the power spectral density, which is proportional to f^p.
        count: Number of sinusoids, fixed for all trials.

    Raises:
        ValueError: If the rms value is negative, the band is empty or the count is not positive.
    """

    rms: Tensor | float
    lowest_hz: Tensor | float | None = None
    highest_hz: Tensor | float | None = None
    slope: Tensor | float = -5 / 3
    count: int = 64


def random_tones(
    draws: Draws,
    rms: Tensor | float,
    lowest_hz: Tensor | float,
    highest_hz: Tensor | float,
    slope: Tensor | float,
    count: int,
) -> Tones:
    """Draw sinusoids whose powers follow a power law.

    Args:
        draws: Source of random numbers, from which the phases are drawn.
        rms: Root mean square of the sum, in the unit of its amplitudes.
        lowest_hz: Lower end of the band in hertz.
        highest_hz: Upper end of the band in hertz.
        slope: Exponent p of the power spectral density, which is proportional to f^p.
        count: Number of sinusoids.

    Returns:
        The sinusoids, shape (..., count).

    Raises:
        ValueError: If the band is empty.
    """
    refuse_unless(
        "highest_hz of a random motion must not be below lowest_hz, which is by default one cycle in the recording",
        highest_hz,
        lambda x: x >= lowest_hz,
        "give lowest_hz or a larger highest_hz",
    )
    angle = 2 * math.pi * draws.uniform("scene.tones.phase", (count,))
    lowest_hz, highest_hz, slope = (with_dims(v, 1, angle) for v in (lowest_hz, highest_hz, slope))
    edges = lowest_hz * (highest_hz / lowest_hz) ** (torch.arange(count + 1, dtype=torch.float64) / count)
    middle = torch.sqrt(edges[..., :-1] * edges[..., 1:])
    # power of an interval of the band: density times width, and the width is proportional to the
    # frequency
    power = (middle / lowest_hz) ** (slope + 1)
    amplitude = torch.sqrt(2 * power / power.sum(-1, keepdim=True))
    level = torch.as_tensor(rms, dtype=torch.float64)[..., None] * amplitude
    return Tones(middle, level * torch.cos(angle), level * torch.sin(angle))


@dataclass(frozen=True)
class MeasuredTrack(Motion):
    """Measured displacement at equally spaced times, interpolated by a cubic spline.

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    >>> track = scene.MeasuredTrack(time_s, displacement=time_s / 1000)
    >>> round(float(track.displacement_m(torch.tensor(0.5, dtype=torch.float64))), 6)
    0.0005

    Args:
        time_s: Times from the start of the recording in seconds, shape (n,), shared by all trials;
            equally spaced within a thousandth of a step.
        displacement: Displacement in metres, shape (..., n).

    Raises:
        ValueError: If the numbers of times and displacements differ, one is not finite, or the
            times are not equally spaced; when evaluated, if a time is more than one step beyond the
            ends.
    """

    time_s: Tensor
    displacement: Tensor

    def __post_init__(self) -> None:
        time, track = (torch.as_tensor(v, dtype=torch.float64) for v in (self.time_s, self.displacement))
        object.__setattr__(self, "time_s", time)
        object.__setattr__(self, "displacement", track)
        if time.ndim != 1 or len(time) < 2 or track.ndim < 1 or track.shape[-1] != len(time):
            raise ValueError(
                "a measured track needs as many displacements (..., n) as times (n,), at least two, "
                f"got {tuple(track.shape)} and {tuple(time.shape)}"
            )
        refuse_unless_finite("time of a measured track", time)
        refuse_unless_finite("displacement of a measured track", track)
        step = self.step_s
        off = float((time - time[0] - step * torch.arange(len(time), dtype=torch.float64)).abs().max())
        if not (step > 0 and off <= 1e-3 * step):
            raise ValueError(
                f"times of a measured track must rise evenly, got a mean step of {step:g} s and times up to "
                f"{off:.3g} s away from even spacing; resample the track first"
            )

    @property
    def step_s(self) -> float:
        """Return the time step in seconds."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        first, last = float(self.time_s[0]) - self.step_s, float(self.time_s[-1]) + self.step_s
        asked = time_s.detach()
        if asked.numel() and not (float(asked.min()) >= first and float(asked.max()) <= last):
            raise ValueError(
                f"times of a measured track must lie within {first:g} to {last:g} s, one step beyond its ends, got "
                f"{float(asked.min()):g} to {float(asked.max()):g} s; record fewer periods or measure a longer track"
            )
        return Spline(self.displacement.to(time_s.device), (float(self.time_s[0]), self.step_s)).at(time_s)
