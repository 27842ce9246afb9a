"""Random motions along the line of sight, scintillation, and measured motions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchsar.core import ArrayFile, Draws, Spline
from torchsar.scene.trials import finite, positive, refuse_unless, refuse_unless_finite, with_dims
from torchsar.scene.vibration import Motion

# times in a block: the phases of 64 tones then take 8 MB, about the cache of a processor
_TIMES_AT_ONCE = 1 << 14
# default upper end of a band, by choice
_HIGHEST_HZ = 2000.0
# largest departure from equal spacing of a measured track, in steps, by choice
_UNEVEN = 1e-3


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
class Tones:
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
        """Evaluate the sum in blocks of times, so that memory stays bounded.

        Args:
            time_s: Times in seconds, any shape, shared by all trials, float64.

        Returns:
            Sum in the unit of the amplitudes, shape (*trials, *times), float64.
        """
        times = max(1, _TIMES_AT_ONCE // self.frequency_hz.shape[:-1].numel())
        parts = [self._block(block) for block in time_s.flatten().split(times)]
        values = torch.cat(parts, -1)
        return values.reshape((*values.shape[:-1], *time_s.shape))

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Return the sum as a displacement; see `Motion`.

        Args:
            time_s: Times in seconds, any shape, float64.

        Returns:
            Displacement in metres, shape (*trials, *times).
        """
        return self.value(time_s)

    def _block(self, time_s: Tensor) -> Tensor:
        """The sum at times (time,), (*trials, time)."""
        turns = self.frequency_hz.to(time_s.device)[..., None] * time_s
        angle = 2 * math.pi * (turns - torch.round(turns.detach()))
        cosine, sine = self.cosine.to(time_s.device), self.sine.to(time_s.device)
        if angle.ndim == 2:
            return cosine @ torch.cos(angle) + sine @ torch.sin(angle)
        return (cosine[..., None, :] @ torch.cos(angle) + sine[..., None, :] @ torch.sin(angle))[..., 0, :]


@dataclass(frozen=True)
class VibrationSpectrum:
    """Random vibration whose power spectral density follows a power of the frequency.

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

    def __post_init__(self) -> None:
        refuse_unless_finite("rms_m of a random motion", self.rms_m, 0.0)
        _refuse_band(self.lowest_hz, self.highest_hz, self.slope, self.count)

    def drawn(self, draws: Draws, span_s: float) -> Tones:
        """Draw the phases of the sinusoids.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            The sinusoids, amplitudes in metres.

        Raises:
            ValueError: If the band is empty, because its upper end is below one cycle in the
                recording.
        """
        return random_tones(draws, self.rms_m, *_band(self.lowest_hz, self.highest_hz, span_s), self.slope, self.count)


@dataclass(frozen=True)
class PathFluctuation(VibrationSpectrum):
    """Fluctuation of the optical path by turbulent air.

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

    rms_m: Tensor | float
    lowest_hz: Tensor | float | None = None
    highest_hz: Tensor | float | None = None
    slope: Tensor | float = -8 / 3
    count: int = 64


@dataclass(frozen=True)
class LogAmplitude:
    """Scintillation: the echo amplitude is multiplied by exp(chi(t)), equally for all scatterers.

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

    def __post_init__(self) -> None:
        refuse_unless_finite("rms of a log-amplitude", self.rms, 0.0)
        _refuse_band(self.lowest_hz, self.highest_hz, self.slope, self.count)

    def drawn(self, draws: Draws, span_s: float) -> Tones:
        """Draw the phases of the sinusoids.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            chi as a sum of sinusoids.

        Raises:
            ValueError: If the band is empty, because its upper end is below one cycle in the
                recording.
        """
        return random_tones(draws, self.rms, *_band(self.lowest_hz, self.highest_hz, span_s), self.slope, self.count)


def _band(
    lowest_hz: Tensor | float | None, highest_hz: Tensor | float | None, span_s: float
) -> tuple[Tensor | float, Tensor | float]:
    """Limits of the band with their defaults."""
    lowest = 1 / span_s if lowest_hz is None else lowest_hz
    if highest_hz is not None:
        return lowest, highest_hz
    if isinstance(lowest, Tensor):
        return lowest, (10 * lowest.to(torch.float64)).clamp_min(_HIGHEST_HZ)
    return lowest, max(_HIGHEST_HZ, 10 * lowest)


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
    _refuse_empty_band(lowest_hz, highest_hz)
    angle = 2 * math.pi * draws.uniform("scene.tones.phase", (count,))
    lowest_hz, highest_hz, slope = (with_dims(v, 1, angle) for v in (lowest_hz, highest_hz, slope))
    edges = lowest_hz * (highest_hz / lowest_hz) ** (torch.arange(count + 1, dtype=torch.float64) / count)
    middle = torch.sqrt(edges[..., :-1] * edges[..., 1:])
    # power of a part of the band: density times width, which is proportional to the frequency
    power = (middle / lowest_hz) ** (slope + 1)
    amplitude = torch.sqrt(2 * power / power.sum(-1, keepdim=True))
    level = torch.as_tensor(rms, dtype=torch.float64)[..., None] * amplitude
    return Tones(middle, level * torch.cos(angle), level * torch.sin(angle))


@dataclass(frozen=True)
class MeasuredTrack:
    """Measured displacement at equally spaced times, interpolated by a cubic spline.

    Args:
        time_s: Times from the start of the recording in seconds, shape (n,), shared by all trials;
            equally spaced within a thousandth of a step.
        displacement: Displacement in metres, shape (..., n).

    Raises:
        ValueError: If the numbers of times and displacements differ, one is not finite, or the
            times are not equally spaced.
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
        if not (step > 0 and off <= _UNEVEN * step):
            raise ValueError(
                f"times of a measured track must rise evenly, got a mean step of {step:g} s and times up to "
                f"{off:.3g} s away from even spacing; resample the track first"
            )

    @property
    def step_s(self) -> float:
        """Return the time step in seconds."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)

    @classmethod
    def from_file(cls, file: str | Path) -> MeasuredTrack:
        """Read a track of times in seconds and displacements in metres.

        Args:
            file: Text or .csv file of two columns (separated by commas or blanks, a line of names
                is allowed), .npy file of shape (n, 2), or .npz file with `time_s` (n,) and
                `displacement_m` (..., n).

        Returns:
            The track.

        Raises:
            ValueError: If the file does not exist or holds anything else; the message names the
                file.
        """
        path = Path(file)
        if not path.is_file():
            raise ValueError(
                f"{path}: no such file; a measured track is a text, .csv, .npy or .npz file of times "
                "(s) and displacements (m)"
            )
        time, track = _columns_of(path)
        try:
            return cls(torch.as_tensor(time, dtype=torch.float64), torch.as_tensor(track, dtype=torch.float64))
        except (TypeError, ValueError) as problem:
            raise ValueError(f"{path}: {problem}") from None

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Interpolate the displacement.

        Args:
            time_s: Times in seconds, any shape, shared by all trials, float64.

        Returns:
            Displacement in metres, shape (*trials, *times).

        Raises:
            ValueError: If a time lies more than one step beyond the track.
        """
        first, last = float(self.time_s[0]) - self.step_s, float(self.time_s[-1]) + self.step_s
        asked = time_s.detach()
        if asked.numel() and not (float(asked.min()) >= first and float(asked.max()) <= last):
            raise ValueError(
                f"times of a measured track must lie within {first:g} to {last:g} s, one step beyond its ends, got "
                f"{float(asked.min()):g} to {float(asked.max()):g} s; record fewer periods or measure a longer track"
            )
        return Spline(self.displacement.to(time_s.device), (float(self.time_s[0]), self.step_s)).at(time_s)


def _columns_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and displacements of a file."""
    try:
        if path.suffix not in (".npy", ".npz"):
            table = _read_text(path)
        else:
            stored = ArrayFile(path)
            if "" not in stored:
                return stored["time_s"].load("iuf"), stored["displacement_m"].load("iuf")
            table = stored[""].load("iuf")
    except (KeyError, OSError, ValueError) as problem:
        raise ValueError(
            f"{path}: expected two columns, time in s and displacement in m (.npz: time_s and "
            f"displacement_m), but {problem}"
        ) from None
    if table.ndim != 2 or table.shape[1] != 2:
        raise ValueError(
            f"{path}: expected two columns, time in s and displacement in m, got an array of shape {table.shape}"
        )
    return table[:, 0], table[:, 1]


def _read_text(path: Path) -> np.ndarray:
    """Numbers of a text file without its comments and its line of names."""
    lines = [
        line.replace(",", " ").replace(";", " ")
        for line in path.read_text().splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    try:
        return np.loadtxt(lines, ndmin=2)
    except ValueError:  # a line of names
        return np.loadtxt(lines[1:], ndmin=2)


def _refuse_empty_band(lowest_hz: Tensor | float, highest_hz: Tensor | float) -> None:
    """Raise ValueError if the lower end of the band exceeds the upper one in any trial."""
    if (lowest_hz <= highest_hz) is True:
        return
    lowest, highest = (torch.as_tensor(v, dtype=torch.float64).detach() for v in (lowest_hz, highest_hz))
    lowest, highest = torch.broadcast_tensors(lowest, highest)
    empty = ~(lowest <= highest)
    if bool(empty.any()):
        raise ValueError(
            "highest_hz of a random motion must not be below lowest_hz, which is by default one cycle in the "
            f"recording, got {float(highest[empty][0]):g} Hz below {float(lowest[empty][0]):g} Hz; give lowest_hz or "
            "a larger highest_hz"
        )


def _refuse_band(
    lowest_hz: Tensor | float | None, highest_hz: Tensor | float | None, slope: Tensor | float, count: int
) -> None:
    """Raise ValueError for an empty band, a slope that is not finite or a bad count."""
    expected = "a random motion needs 0 < lowest_hz <= highest_hz and a finite slope"
    refuse_unless(expected, slope, finite)
    for bound in (lowest_hz, highest_hz):
        if bound is not None:
            refuse_unless(expected, bound, positive)
    if lowest_hz is not None and highest_hz is not None:
        refuse_unless(expected, lowest_hz, lambda x: x <= highest_hz, f"highest_hz is {highest_hz}")
    if not (isinstance(count, int) and count >= 1):
        raise ValueError(f"count of sinusoids of a random motion must be a whole number of 1 or more, got {count}")
