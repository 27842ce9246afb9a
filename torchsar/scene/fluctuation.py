"""Random motions of the line of sight: turbulence, vibration spectra, scintillation, and motions
that were measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, UniformSpline
from torchsar.scene.vibration import Motion, refuse_unless_finite

_TIMES_AT_ONCE = 1 << 14
_HIGHEST_HZ = 2000.0
# departures from an even step that a measured track may show, in steps
_UNEVEN = 1e-3


@runtime_checkable
class RandomMotion(Protocol):
    """A motion that differs from trial to trial: draws, and the length of the recording (s), give
    the motion itself.
    """

    def drawn(self, draws: Draws, span_s: float) -> Motion: ...


def drawn_motion(motion: Sequence[Motion | RandomMotion], draws: Draws, span_s: float) -> list[Motion]:
    """A list of motions with the random ones drawn, each from an address of its own, its place in
    the list.
    """
    return [
        part.drawn(draws.part(f"motion.{place}"), span_s) if isinstance(part, RandomMotion) else part
        for place, part in enumerate(motion)
    ]


@dataclass(frozen=True)
class Tones:
    """Sum of sinusoids at frequencies that all trials share: sum_i cosine_i cos(2 pi f_i t) +
    sine_i sin(2 pi f_i t).

    frequency_hz: (tone,); cosine, sine: (..., tone), in m for a motion. float64.
    """

    frequency_hz: Tensor
    cosine: Tensor
    sine: Tensor

    def value(self, time_s: Tensor) -> Tensor:
        """The sum at float64 times of any shape, (*trials, *times): one table of the tones for all
        trials, in bounded memory.
        """
        parts = [self._block(block) for block in time_s.flatten().split(_TIMES_AT_ONCE)]
        return torch.cat(parts, -1).reshape((*self.cosine.shape[:-1], *time_s.shape))

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """The same, under the name that motions go by."""
        return self.value(time_s)

    def _block(self, time_s: Tensor) -> Tensor:
        turns = self.frequency_hz.to(time_s.device)[:, None] * time_s
        angle = 2 * math.pi * (turns - torch.round(turns.detach()))
        return self.cosine.to(time_s.device) @ torch.cos(angle) + self.sine.to(time_s.device) @ torch.sin(angle)


@dataclass(frozen=True)
class VibrationSpectrum:
    """Random vibration of power spectral density f^slope between two frequencies, as `count`
    sinusoids of random phases.

    rms_m: over a long time, a number or per-trial tensor (...,). lowest_hz: None for one turn in
    the recording. The sinusoids lie evenly in the logarithm of the frequency, each with the power
    of its share of the band, so that every trial has the same rms. A band of one frequency has
    lowest_hz = highest_hz. Raises ValueError for a band or count that is none.
    """

    rms_m: Tensor | float
    lowest_hz: float | None
    highest_hz: float
    slope: float = 0.0
    count: int = 64

    def __post_init__(self) -> None:
        refuse_unless_finite("rms_m of a random motion", self.rms_m, 0.0)
        _refuse_band(self.lowest_hz, self.highest_hz, self.slope, self.count)

    def drawn(self, draws: Draws, span_s: float) -> Tones:
        return random_tones(draws, self.rms_m, *_band(self.lowest_hz, self.highest_hz, span_s), self.slope, self.count)


@dataclass(frozen=True)
class PathFluctuation(VibrationSpectrum):
    """Fluctuation of the optical path by turbulent air: coloured, f^(-8/3) as of a point receiver
    in Kolmogorov turbulence (one way or two is the caller's).

    rms_m: within the band, a number or per-trial tensor (...,). highest_hz: None for 2 kHz, or ten
    turns in a recording so short. The rest as for `VibrationSpectrum`.
    """

    rms_m: Tensor | float
    lowest_hz: float | None = None
    highest_hz: float | None = None
    slope: float = -8 / 3
    count: int = 64


@dataclass(frozen=True)
class LogAmplitude:
    """Scintillation: the echo's amplitude times exp(chi(t)), chi of power spectral density
    f^(-5/3), all scatterers alike.

    rms: of chi, a number or per-trial tensor (...,); the rest as for `PathFluctuation`. `drawn`
    gives chi as `Tones`.
    """

    rms: Tensor | float
    lowest_hz: float | None = None
    highest_hz: float | None = None
    slope: float = -5 / 3
    count: int = 64

    def __post_init__(self) -> None:
        refuse_unless_finite("rms of a log-amplitude", self.rms, 0.0)
        _refuse_band(self.lowest_hz, self.highest_hz, self.slope, self.count)

    def drawn(self, draws: Draws, span_s: float) -> Tones:
        return random_tones(draws, self.rms, *_band(self.lowest_hz, self.highest_hz, span_s), self.slope, self.count)


def _band(lowest_hz: float | None, highest_hz: float | None, span_s: float) -> tuple[float, float]:
    """The band with its defaults: from one turn in the recording to 2 kHz, or ten turns in it where
    it is short.
    """
    lowest = 1 / span_s if lowest_hz is None else lowest_hz
    return lowest, max(_HIGHEST_HZ, 10 * lowest) if highest_hz is None else highest_hz


def random_tones(
    draws: Draws, rms: Tensor | float, lowest_hz: float, highest_hz: float, slope: float, count: int
) -> Tones:
    """Sinusoids of random phases whose powers follow f^slope from lowest_hz to highest_hz; the mean
    square of their sum is rms^2.
    """
    if not lowest_hz <= highest_hz:
        raise ValueError(
            f"a random motion from {lowest_hz:g} Hz, one turn in the recording, to {highest_hz:g} "
            "Hz has no band; give lowest_hz or a larger highest_hz"
        )
    edges = lowest_hz * (highest_hz / lowest_hz) ** (torch.arange(count + 1, dtype=torch.float64) / count)
    middle = torch.sqrt(edges[:-1] * edges[1:])
    # power of a share of the band: density times width, the width being proportional to the
    # frequency
    power = (middle / lowest_hz) ** (slope + 1)
    amplitude = torch.sqrt(2 * power / power.sum())
    angle = 2 * math.pi * draws.uniform("scene.tones.phase", (count,))
    level = torch.as_tensor(rms, dtype=torch.float64)[..., None] * amplitude
    return Tones(middle, level * torch.cos(angle), level * torch.sin(angle))


@dataclass(frozen=True)
class MeasuredTrack:
    """A displacement that was measured at even times, joined by a cubic spline.

    time_s: (n,) from the start of the recording, even to a thousandth of a step; displacement_m:
    (..., n). float64. Raises ValueError for uneven times, and when asked for times beyond the track
    by more than one step.
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
                f"times of a measured track must rise evenly, got steps of {step:g} s on the mean and "
                f"a time off by {off:.3g} s; resample the track first"
            )

    @property
    def step_s(self) -> float:
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)

    @classmethod
    def from_file(cls, path: str | Path) -> MeasuredTrack:
        """A track from two columns, time in s and displacement in m: text or .csv (commas or
        blanks, one line of names allowed), .npy (n, 2), or .npz with `time_s` (n,) and
        `displacement_m` (..., n). Raises ValueError, with the name of the file, for anything else.
        """
        path = Path(path)
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
        """d at float64 times of any shape, (*trials, *times)."""
        first, last = float(self.time_s[0]) - self.step_s, float(self.time_s[-1]) + self.step_s
        asked = time_s.detach()
        if asked.numel() and not (float(asked.min()) >= first and float(asked.max()) <= last):
            raise ValueError(
                f"the measured track reaches from {first:g} to {last:g} s, asked for "
                f"{float(asked.min()):g} to {float(asked.max()):g} s; record fewer periods or a "
                "longer track"
            )
        return UniformSpline(self.displacement.to(time_s.device), float(self.time_s[0]), self.step_s).at(time_s)


def _columns_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        if path.suffix == ".npz":
            with np.load(path) as held:
                return held["time_s"], held["displacement_m"]
        table = np.load(path) if path.suffix == ".npy" else _read_text(path)
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
    lines = [
        line.replace(",", " ").replace(";", " ")
        for line in path.read_text().splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    try:
        return np.loadtxt(lines, ndmin=2)
    except ValueError:  # a line of names
        return np.loadtxt(lines[1:], ndmin=2)


def _refuse_band(lowest_hz: float | None, highest_hz: float | None, slope: float, count: int) -> None:
    given = [f for f in (lowest_hz, highest_hz) if f is not None]
    if not (all(0 < f < math.inf for f in given) and given == sorted(given) and math.isfinite(slope)):
        raise ValueError(
            "a random motion needs 0 < lowest_hz <= highest_hz and a finite slope, got "
            f"{lowest_hz}, {highest_hz} and {slope}"
        )
    if not (isinstance(count, int) and count >= 1):
        raise ValueError(f"a random motion needs a count of sinusoids of 1 or more, got {count}")
