"""The world of a triangular-sweep ladar: section `world` of a config, and its echoes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import Impairment, simulate_ladar, simulate_ladar_record
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    CalibrationFibre,
    Fidelity,
    LadarWorld,
    LinearInSweep,
    LogAmplitude,
    Motion,
    Points,
    RetroAndBrokenLine,
    Scene,
    Together,
)
from torchsar.scene.ladar import SweepError
from torchsar.study.names.registry import (
    CALIBRATIONS,
    LADAR_IMPAIRMENTS,
    LOG_AMPLITUDES,
    RADIAL_MOTIONS,
    SCENES,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
)
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.system import Noise, World


@dataclass(frozen=True)
class Record:
    """A continuous record of the detector, cut into blocks, instead of separated sweeps.

    Args:
        trigger_s: Time from the start of a block to the start of an up sweep in seconds.
        block_s: Length of a block in seconds; null for one period of the sweep if every period is
            kept, and else for two periods.
        trigger_known: Whether the recording contains the time of the trigger.
    """

    trigger_s: Tensor | float = 0.0
    block_s: float | None = None
    trigger_known: bool = True


@dataclass(frozen=True, kw_only=True)
class Ground(World):
    """True scene, motion of the line of sight, atmosphere, laser and noise.

    Args:
        periods: Number of recorded periods of the sweep.
        scene: Scenes by name; their echoes add up.
        motion: Radial motions of the line of sight by name; they add up.
        log_amplitude: Scintillation of the atmosphere; null for none.
        fidelity: Model of how the range changes inside a sweep.
        gate_m: Least and largest relative range in metres that is recorded; null for all ranges.
        sweep_error: Phase error of the laser's sweeps; null for none.
        calibration: Internal fibre by which the sweep error can be measured; null for none.
        record: Continuous record of the detector; null for sweeps that are separated ideally.
        noise: Receiver noise; its snr_db is the power of a scatterer of amplitude 1 over that of
            the noise in a sample before any compression.
        impairments: Impairments of the recording by name, applied in this order.
    """

    periods: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    motion: Sequence[Annotated[Motion, RADIAL_MOTIONS]] = ()
    log_amplitude: Annotated[LogAmplitude, LOG_AMPLITUDES] | None = None
    fidelity: Annotated[Fidelity, SWEEP_FIDELITIES] = field(default_factory=LinearInSweep)
    gate_m: Sequence[float] | None = None
    sweep_error: Annotated[SweepError, SWEEP_ERRORS] | None = None
    calibration: Annotated[CalibrationFibre, CALIBRATIONS] | None = None
    record: Record | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, LADAR_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        snr_db = self.noise.snr_db
        if self.periods < 1 or not self.scene:
            raise ValueError(
                f"world needs at least one scene and one period, got {len(self.scene)} scenes, {self.periods} periods"
            )
        if snr_db is not None and bool((torch.as_tensor(snr_db).abs() > 300).any()):
            raise ValueError(
                f"noise.snr_db is {snr_db}, outside the numerical range; give -300 to 300 dB, or null for no noise"
            )
        self.of()

    def of(self) -> LadarWorld:
        """The same world in the form of the echo simulation."""
        gate = None if self.gate_m is None else tuple(self.gate_m)
        scene, snr_db = Together(dict(self.scene)), self.noise.snr_db
        effects = (self.log_amplitude, snr_db, self.fidelity, gate, self.sweep_error, self.calibration)
        return LadarWorld(scene, self.motion, *effects)  # pyright: ignore[reportArgumentType]

    def trials_of(self, radar: TriangularLadar, draws: Draws, dtype: torch.dtype, device: str = "cpu") -> Trials:
        """Simulate recordings with and without motion, and the true values."""
        world, made = self.of(), (self.impairments, dtype, device)
        if self.record is None:
            recording, truth = simulate_ladar(radar, world, self.periods, draws, *made)
        else:
            how = (self.record.block_s, self.record.trigger_s, self.record.trigger_known)
            recording, truth = simulate_ladar_record(radar, world, self.periods, draws, *how, *made)
        assert truth.clean is not None
        return Trials(recording, truth.clean, truth.values, len(draws.trials or (0,)), world)

    @property
    def named_points(self) -> dict[str, int]:
        """Names `part.number` of point targets and retro-reflectors, whose responses are measured,
        and their indices among all scatterers.
        """
        names: dict[str, int] = {}
        first = 0
        for part, scene in self.scene.items():
            shown = len(scene.azimuth_m) if isinstance(scene, Points) else int(isinstance(scene, RetroAndBrokenLine))
            names.update({f"{part}.{i}": first + i for i in range(shown)})
            first += scene.scatterers(Draws(0)).range_m.shape[-1]
        return names
