"""World of a scene seen by a triangular-sweep ladar.

Targets of the ladar experiments of Remote Sens. 2024, 16, 793.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Draws
from torchsar.scene.ladar_range import Fidelity, LinearInSweep
from torchsar.scene.motion import LogAmplitude, Motion, RandomMotion
from torchsar.scene.targets import Scatterers, Scene, unit_phases
from torchsar.scene.trials import finite, finite_numbers, refuse_unless, with_dims


@dataclass(frozen=True)
@finite_numbers("a letter")
class LetterE(Scene):
    """Letter E of 62 points of amplitude 1.

    >>> from torchsar import Draws, scene
    >>> points = scene.LetterE().scatterers(Draws(seed=1))
    >>> len(points.amplitude), round(float(points.range_m.max()), 2)
    (62, 0.4)

    A spine of 17 points lies along range, 5 cm apart. Three arms of 15 points each lie along
    azimuth, 1 cm apart, at the points 0, 8 and 16 of the spine; they begin 1 cm beside it, towards
    positive azimuth. The publication shows the letter without coordinates; the layout is chosen
    here.

    Args:
        first_range_m: Range of the first point of the spine relative to the reference range in
            metres.
        spine_azimuth_m: Azimuth of the spine in metres.
        random_phase: Whether each trial draws phases; otherwise all phases are zero. Equal phases
            mislead autofocus by minimum entropy: a wrong image, whose rows have collapsed, has a
            lower entropy than the correct image.

    Raises:
        ValueError: If a position is not finite.

    Reference:
        Remote Sens. 2024, 16, 793, section 3.2.1, Figure 10.
    """

    first_range_m: Tensor | float = -0.4
    spine_azimuth_m: Tensor | float = -0.075
    random_phase: bool = True

    def scatterers(self, draws: Draws) -> Scatterers:
        spine, along = torch.arange(17, dtype=torch.float64), torch.arange(1, 16, dtype=torch.float64)
        azimuth = torch.cat([torch.zeros(17, dtype=torch.float64), along, along, along])
        row = torch.cat([spine, *(torch.full((15,), float(at), dtype=torch.float64) for at in (0, 8, 16))])
        turns = draws.uniform("scene.letter.phase", (62,)) if self.random_phase else 0.0 * azimuth
        return Scatterers(
            with_dims(self.spine_azimuth_m, 1, azimuth) + 0.01 * azimuth,
            with_dims(self.first_range_m, 1, row) + 0.05 * row,
            unit_phases(turns),
        )


@dataclass(frozen=True)
@finite_numbers("a retro-reflector with a line", line_m=None)
class RetroAndBrokenLine(Scene):
    """Retro-reflector, and behind it a broken line of 9 points with random phases.

    >>> from torchsar import Draws, scene
    >>> points = scene.RetroAndBrokenLine(retro_db=20.0, line_db=-20.0).scatterers(Draws(seed=1))
    >>> points.amplitude.abs().round(decimals=2)[:3].tolist()
    [10.0, 1.0, 1.0]

    The target stands in for that of the ground experiment, whose layout is not published. The
    retro-reflector has the amplitude 10^(retro_db / 20); with a world of snr_db = 0 its
    signal-to-noise ratio per sample is retro_db. The line runs obliquely behind it, in three dashes
    of three points.

    Args:
        range_m: Range of the retro-reflector relative to the reference range in metres.
        azimuth_m: Azimuth of the retro-reflector in metres.
        retro_db: Power of the retro-reflector relative to a scatterer of amplitude 1 in decibels.
        line_db: Power of each point of the line relative to the retro-reflector in decibels.
        line_m: Distances of the first and the last point of the line behind the retro-reflector in
            metres.
        line_azimuth_m: Azimuth extent of the line, centred on the retro-reflector, in metres.

    Raises:
        ValueError: If a number is not finite.

    Reference:
        Remote Sens. 2024, 16, 793, section 3.3.1.
    """

    range_m: Tensor | float = 10.5
    azimuth_m: Tensor | float = 0.0
    retro_db: Tensor | float = 25.0
    line_db: Tensor | float = -18.0
    line_m: tuple[Tensor | float, Tensor | float] = (0.25, 0.55)
    line_azimuth_m: Tensor | float = 0.08

    def __post_init__(self) -> None:
        sentence = "line_m must be the distances (m) of the first and last point of the line behind the retro-reflector"
        if not isinstance(self.line_m, tuple | list) or len(self.line_m) != 2:
            raise ValueError(f"{sentence}, got {self.line_m}")
        for distance in self.line_m:
            refuse_unless(sentence, distance, finite)

    def scatterers(self, draws: Draws) -> Scatterers:
        along = torch.tensor([0, 1, 2, 4, 5, 6, 8, 9, 10], dtype=torch.float64) / 10
        first, last = (with_dims(v, 1, along) for v in self.line_m)
        x, r, width, retro_db, line_db = (
            with_dims(v, 1, along)
            for v in (self.azimuth_m, self.range_m, self.line_azimuth_m, self.retro_db, self.line_db)
        )
        turns = draws.uniform("scene.broken_line.phase", (9,))
        level = 10 ** (retro_db / 20)
        line = level * 10 ** (line_db / 20) * unit_phases(turns)
        retro = torch.zeros_like(line[..., :1]) + level
        across, beyond = width * (along - 0.5), first + (last - first) * along
        return Scatterers(x + pad(across, (1, 0)), r + pad(beyond, (1, 0)), torch.cat([retro, line], -1))


class SweepError(Protocol):
    """Phase error of the laser within its sweeps."""

    def turns(self, time_s: Tensor, ramp: int, dims: int | None = None) -> Tensor:
        """Evaluate the phase error.

        Args:
            time_s: Time u from the middle of a sweep in seconds, float64.
            ramp: 0 for the up-sweep, 1 for the down-sweep.
            dims: Number of trailing dimensions of time_s that index times; dimensions before them
                are trials. None if all dimensions index times.

        Returns:
            Phase error in cycles, shape (*trials, *times), float64.
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a calibration fibre", delay_s="positive")
class CalibrationFibre:
    """Internal channel that mixes the sweep with a copy of itself from a fibre of known delay.

    >>> from torchsar import radar, scene
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> fibre = scene.CalibrationFibre(delay_s=1e-9)
    >>> round(ladar.chirp_rate_hz_s * fibre.delay_s)  # beat frequency in Hz
    20000

    Args:
        delay_s: Delay of the fibre in seconds.
        snr_db: Signal-to-noise ratio per sample in decibels, None for no noise.
        every_period: Whether the channel is recorded in every period, or once for the whole
            recording.

    Raises:
        ValueError: If the delay is not positive or the ratio is not finite.
    """

    delay_s: Tensor | float
    snr_db: Tensor | float | None = None
    every_period: bool = False


@dataclass(frozen=True)
@finite_numbers(gate_m=None)
class LadarWorld:
    """Scene, motion, propagation, laser errors and noise of a ladar acquisition.

    >>> from torchsar import Draws, echo, radar, scene
    >>> ladar = radar.TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    >>> world = scene.LadarWorld(scene.LetterE(), motion=[scene.Polynomial([0.01])], snr_db=10.0)
    >>> recording, truth = echo.simulate_ladar(ladar, world, n_period=3, draws=Draws(seed=1))
    >>> recording.signal.data.shape, truth.values["velocity_m_s"].round(decimals=3).tolist()
    (torch.Size([2, 3, 128]), [0.01, 0.01, 0.01])

    An effect that is None is not simulated.

    Args:
        scene: Scatterers.
        motion: Motions along the line of sight, fixed or random; time counts from the start of the
            first recorded period.
        log_amplitude: Scintillation.
        snr_db: Power of a scatterer of amplitude 1 over the noise variance in decibels, PER SAMPLE
            before any compression; None for no noise.
        fidelity: Model of the range within a sweep.
        gate_m: Lower and upper limit of the range relative to the reference range in metres;
            scatterers outside are not recorded. None for no limits.
        sweep_error: Phase error of the sweeps of the laser.
        calibration: Internal fibre, which records the sweep error.

    Raises:
        TypeError: If the scene, the motion or the fidelity has the wrong type.
        ValueError: If snr_db is not finite or the gate is empty.
    """

    scene: Scene
    motion: Sequence[Motion | RandomMotion] = ()
    log_amplitude: LogAmplitude | None = None
    snr_db: Tensor | float | None = None
    fidelity: Fidelity = field(default_factory=LinearInSweep)
    gate_m: tuple[Tensor | float, Tensor | float] | None = None
    sweep_error: SweepError | None = None
    calibration: CalibrationFibre | None = None

    def __post_init__(self) -> None:
        if self.gate_m is not None:
            sentence = "gate_m must be a pair (low, high) of relative ranges (m) with low < high"
            if not (isinstance(self.gate_m, tuple | list) and len(self.gate_m) == 2):
                raise ValueError(f"{sentence}, got {self.gate_m}")
            low, high = self.gate_m
            refuse_unless(sentence, low, lambda x: x < high, f"high is {high}")
