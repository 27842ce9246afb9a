"""World of a scene seen by a triangular-sweep ladar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from torch import Tensor

from torchsar.scene.fluctuation import LogAmplitude, RandomMotion
from torchsar.scene.ladar_range import Fidelity, LinearInSweep
from torchsar.scene.targets import Scene
from torchsar.scene.trials import finite_numbers, refuse_unless
from torchsar.scene.vibration import Motion


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
