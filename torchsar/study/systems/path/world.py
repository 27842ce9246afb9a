"""The world of antennas on any path: section `world` of a config, and its echoes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import Impairment, simulate_path
from torchsar.radar import InverseRadar
from torchsar.scene import (
    Flight,
    Navigation,
    NominalPath,
    PathWorld,
    PlaneGround,
    Points,
    Scene,
    SideBeam,
    Sway,
    Together,
)
from torchsar.scene.path_world import Ground
from torchsar.study.names.registry import GROUNDS, NOMINAL_PATHS, PATH_IMPAIRMENTS, SCENES, AntennaMotions
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.system import Noise, World


def path_radar(carrier_hz: float, bandwidth_hz: float, prf_hz: float) -> InverseRadar:
    """Band and pulse rate of a radar whose pulses are compressed or dechirped.

    Args:
        carrier_hz: Middle of the band in Hz.
        bandwidth_hz: Bandwidth in Hz; a range cell is c / (2 bandwidth).
        prf_hz: Pulse repetition frequency in Hz.
    """
    return InverseRadar(carrier_hz, bandwidth_hz, prf_hz)


@dataclass(frozen=True)
class Track:
    """True path of an antenna.

    Args:
        nominal: Nominal path.
        x: Motions along axis x by name, which add up.
        y: Motions along axis y.
        z: Motions along axis z, which points up.
    """

    nominal: Annotated[NominalPath, NOMINAL_PATHS]
    x: AntennaMotions = ()
    y: AntennaMotions = ()
    z: AntennaMotions = ()

    def flight(self) -> Flight:
        return Flight(self.nominal, Sway(self.x, self.y, self.z))


@dataclass(frozen=True)
class Recorded:
    """What navigation records of a path.

    Args:
        x: Errors along axis x by name, which add up.
        y: Errors along axis y.
        z: Errors along axis z.
        latency_s: Age of a recorded position in seconds.
        step_m: Step in metres to which positions are rounded; 0 for none.
        rate_hz: Rate of the records in hertz, between which splines interpolate; null for a record
            at every pulse.
    """

    x: AntennaMotions = ()
    y: AntennaMotions = ()
    z: AntennaMotions = ()
    latency_s: Tensor | float = 0.0
    step_m: Tensor | float = 0.0
    rate_hz: float | None = None

    def navigation(self) -> Navigation:
        return Navigation(Sway(self.x, self.y, self.z), self.latency_s, self.step_m, self.rate_hz)


@dataclass(frozen=True, kw_only=True)
class Flown(World):
    """Section `world`: the scene and the true paths.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range cells of each pulse.
        scene: Parts of the scene by name; range is axis x, azimuth axis y.
        transmitter: True path of the transmitter.
        receiver: True path of the receiver; null if both share an antenna.
        navigation: What is recorded of the path of the transmitter; null for the true path.
        receiver_navigation: What is recorded of the path of the receiver; null for the true path.
        ground: Height of the ground.
        beam: Beam of the receiver, and of the transmitter if they share an antenna; null if the
            scene is always lit.
        window_range_m: Constant range of the middle of the range window in metres; null to follow
            the middle of the scene.
        noise: Receiver noise; the SNR is the mean over the samples of lit pulses.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    pulses: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    transmitter: Track
    receiver: Track | None = None
    navigation: Recorded | None = None
    receiver_navigation: Recorded | None = None
    ground: Annotated[Ground, GROUNDS] = field(default_factory=PlaneGround)
    beam: SideBeam | None = None
    window_range_m: float | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, PATH_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulses < 2 or self.samples < 2 or not self.scene:
            raise ValueError(
                "world needs at least one scene, two pulses and two samples, got "
                f"{len(self.scene)} scenes, {self.pulses} pulses and {self.samples} samples"
            )

    def of(self) -> PathWorld:
        """The parameters of the echo simulation."""
        receiver = None if self.receiver is None else self.receiver.flight()
        navigation = [(one or Recorded()).navigation() for one in (self.navigation, self.receiver_navigation)]
        paths = (self.transmitter.flight(), receiver, navigation[0], navigation[1])
        return PathWorld(Together(self.scene), *paths, self.ground, self.beam, self.window_range_m, self.noise.snr_db)

    def trials_of(self, radar: InverseRadar, draws: Draws, dtype: torch.dtype, device: str) -> Trials:
        """Simulate recordings, and recordings without impairments whose positions are true."""
        world, size = self.of(), (self.pulses, self.samples)
        recording, truth = simulate_path(radar, world, *size, draws, self.impairments, dtype, device)
        assert truth.clean is not None
        return Trials(recording, truth.clean, truth.values, len(draws.trials or (0,)), world)

    @property
    def named_points(self) -> dict[str, tuple[Tensor | float, Tensor | float]]:
        """Azimuth and range in metres of the points of the scene, by names such as `corners.0`."""
        return {
            f"{part}.{i}": place
            for part, scene in self.scene.items()
            if isinstance(scene, Points)
            for i, place in enumerate(zip(scene.azimuth_m, scene.range_m, strict=True))
        }
