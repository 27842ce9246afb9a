"""The world of a rotating target: section `world` of a config, and its echoes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import Impairment, simulate_turntable
from torchsar.focus import CompressDechirped
from torchsar.metrics import error_db
from torchsar.radar import InverseRadar
from torchsar.scene import Dechirped, Motion, PhaseOnly, Points, Scene, Together, TurntableWorld
from torchsar.scene.turntable import Fidelity
from torchsar.scene.vibration import PulsePhase
from torchsar.study.names.registry import FIDELITIES, MOTIONS, SCENES, START_PHASES, TARGET_IMPAIRMENTS
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.system import Noise, World


@dataclass(frozen=True, kw_only=True)
class Target(World):
    """Section `world`: the simulated target and its true parameters.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range cells of each pulse.
        scene: Parts of the target by name, which rotate together.
        motion: Motions along the line of sight by name, which add up.
        start_phase: Random phase errors of the pulses by name, which add up.
        fidelity: Model of the echo.
        rotation_rad_s: True rotation rate in rad/s; None for the rate that the radar assumes.
        noise: Receiver noise; the SNR is the mean over all range-compressed samples.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    pulses: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    motion: Sequence[Annotated[Motion, MOTIONS]] = ()
    start_phase: Sequence[Annotated[PulsePhase, START_PHASES]] = ()
    fidelity: Annotated[Fidelity, FIDELITIES] = field(default_factory=PhaseOnly)
    rotation_rad_s: Tensor | float | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, TARGET_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulses < 1 or self.samples < 1 or not self.scene:
            raise ValueError(
                "world needs at least one scene, one pulse and one sample, got "
                f"{len(self.scene)} scenes, {self.pulses} pulses and {self.samples} samples"
            )

    def of(self, radar: InverseRadar) -> TurntableWorld:
        """The parameters of the echo simulation."""
        scene, noise = Together(self.scene), self.noise.snr_db
        return TurntableWorld(scene, self.rotation_rad_s, self.motion, self.start_phase, noise, self.fidelity)

    def trials_of(self, radar: InverseRadar, draws: Draws, dtype: torch.dtype, device: str = "cpu") -> Trials:
        """Simulate recordings with and without phase errors and motion, and the true values."""
        world, size = self.of(radar), (self.pulses, self.samples)
        recording, truth = simulate_turntable(radar, world, *size, draws, self.impairments, dtype, device)
        assert truth.clean is not None
        return Trials(recording, truth.clean, truth.values, len(draws.trials or (0,)), world)

    def edge(self, draws: Draws) -> tuple[float, float]:
        """Return the largest magnitudes of cross range and range (m) of the scatterers."""
        scene = Together(self.scene).scatterers(draws)
        return tuple(float(x.abs().max()) for x in (scene.azimuth_m, scene.range_m))  # pyright: ignore[reportReturnType]


def echo_choices(bench: Bench) -> list[Choice]:
    """Return the choice of the echo model; nothing if the radar has no pulse length.

    The model `phase_only` changes the phases of range-compressed pulses; the model `dechirped`
    simulates dechirped pulses with the motion within each pulse.
    """
    world, radar = bench.world(), bench.radar
    if radar.pulse_s is None:
        return []
    edge = world.edge(bench.draws())
    lost = {"echo_error_db": PhaseOnly().neglected_db(radar, world.of(radar), world.pulses, *edge)}
    alternatives = [
        Alternative(
            "phase_only",
            {"kind": "phase_only"},
            lost,
            "migration, motion inside pulses",
            "fixed envelopes (phase_only)",
        ),
        Alternative("dechirped", {"kind": "dechirped"}, {}),
    ]

    def measured() -> Measured:
        own = world.fidelity if isinstance(world.fidelity, Dechirped) else Dechirped()
        levels = {"phase_only": PhaseOnly(), "dechirped": own}
        point = replace(
            world, scene={"edge": Points([edge[0]], [edge[1]])}, noise=Noise(), start_phase=(), impairments={}
        )
        # compression removes the velocity of the track that the receiver follows
        compress = CompressDechirped(
            radar,
            velocity_m_s=sum(m.coefficients_m[0] for m in own.track) if own.track else None,  # pyright: ignore
        )

        def made(name: str, of: Any, dtype: torch.dtype) -> Tensor:
            signal = replace(of, fidelity=levels[name]).trials_of(radar, Draws(0), dtype).recording.signal
            return (compress(signal) if "fast_time" in signal.names else signal).data

        exact = made("dechirped", point, torch.complex128)

        def loss(one: Alternative, _: Any) -> dict[str, float]:
            return {"echo_error_db": float(error_db(made(one.keys["kind"], point, torch.complex128), exact))}

        return Measured(lambda one: made(one.keys["kind"], world, bench.dtype), loss)

    return [Choice("echo model", "world.fidelity", alternatives, measured)]
