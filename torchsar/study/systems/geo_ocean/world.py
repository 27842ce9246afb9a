"""The world of ships on a sea: section `world` of a config, and its echoes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from torch import Tensor

from torchsar.core import Draws, Signal
from torchsar.echo import bistatic_echo, simulate_bistatic
from torchsar.multichannel import Extraction, PointMotion, RemoveTransmitRange, StationaryImage
from torchsar.multichannel.reconstruct import Rebuild
from torchsar.radar import BistaticRadar
from torchsar.scene import BandLimited, BistaticWorld, Fleet, Gate, KSea, Movers, Sea
from torchsar.scene import Ship as ShipOfPoints
from torchsar.study.names.registry import GATES, SEAS
from torchsar.study.systems.geo_ocean.judge import Ship, ShownShip
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.system import World

# true values of the ships that processors may use
TRUTHS = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")


@dataclass(frozen=True)
class Vessel:
    """A ship of random scatterers.

    Args:
        u_r_m_s: Speed along the slant range in m/s, closing positive.
        u_a_m_s: Speed along the track in m/s, positive in the flight direction of the receiver.
        azimuth_m: Position of its middle along the track in metres at t = 0, the middle pulse.
        range_m: Closest range of its middle in metres beyond the reference range.
        scr_db: Signal-to-clutter ratio in dB: mean power of the ship over that of the sea, in a
            sample of a range line that the ship covers.
        length_m: Length along the track in metres.
        range_cells: Number of range lines that it covers.
        count: Number of its scatterers.
        cell_m: Distance between its range lines in metres.
    """

    u_r_m_s: Tensor | float = 0.0
    u_a_m_s: Tensor | float = 0.0
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0
    scr_db: Tensor | float = 10.0
    length_m: Tensor | float = 100.0
    range_cells: int = 4
    count: int = 15
    cell_m: Tensor | float = 6.0

    def __post_init__(self) -> None:
        self.points()

    def points(self) -> ShipOfPoints:
        """The same ship in the form of the echo simulation."""
        motion = (self.u_r_m_s, self.u_a_m_s, self.azimuth_m, self.range_m)
        return ShipOfPoints(*motion, self.length_m, self.range_cells, self.count, self.cell_m, self.scr_db)


@dataclass
class Frame:
    """One trial: reference images of the ships, and the recording without those that move.

    Args:
        ships: Ships by name.
        still: Recording without ships that move, shape (channel, pulse, range), without the phase
            of the path to the transmitter.
        images: Images of `still` by their reconstruction of Doppler bands and form of focusing;
            each is made when it is first needed.
    """

    ships: Mapping[str, ShownShip]
    still: Signal
    images: dict[tuple[Rebuild, str], Signal] = field(default_factory=dict)

    def still_image(self, stage: StationaryImage) -> Signal:
        """Return the image of what does not move, made by the imaging stage of a method."""
        kind = (stage.rebuild, stage.form)
        if kind not in self.images:
            self.images[kind] = stage(self.still)
        return self.images[kind]


@dataclass(frozen=True, kw_only=True)
class Ocean(World):
    """True ships on a sea, all in one scene. Powers are relative to the mean power of the sea.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range lines.
        targets: Ships by name.
        gate: Illumination of ships and sea over slow time.
        sea: Clutter of the sea; its cnr_db is its power over the noise in dB.
    """

    pulses: int
    samples: int
    targets: Mapping[str, Vessel]
    gate: Annotated[Gate, GATES] = field(default_factory=lambda: BandLimited(4.5))
    sea: Annotated[Sea, SEAS] = field(default_factory=lambda: KSea(power_db=30.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulses < 1 or self.samples < 1 or not self.targets:
            raise ValueError(
                "world needs at least one target, one pulse and one sample, got "
                f"{len(self.targets)} targets, {self.pulses} pulses and {self.samples} samples"
            )

    def trials_of(
        self, radar: BistaticRadar, draws: Draws, extraction: Extraction, dtype: torch.dtype, device: str = "cpu"
    ) -> Trials:
        """Simulate recordings of the whole scene, and the true values of every ship.

        Args:
            radar: Radar parameters.
            draws: Random numbers; those of a ship depend on its name.
            extraction: Extent of a ship in the data, for the reference image of this ship alone.
            dtype: Complex type of the recording.
            device: Device of the computation.

        Returns:
            Recordings and true values; `own` holds one `Frame` for each trial.
        """
        # every trial is a case of its own, so that a scene has one address for all that it draws
        cases = tuple(f"{case}/{trial}" for case, trial in draws.addresses)
        scenes = replace(draws, case=cases, trials=[0] * len(cases))
        fleet = Fleet({name: vessel.points() for name, vessel in self.targets.items()})
        world = BistaticWorld(fleet, self.gate, replace(self.sea, power_db=0.0), snr_db=self.sea.power_db)  # pyright: ignore
        size = (self.pulses, self.samples)
        recording, _ = simulate_bistatic(radar, world, *size, scenes, dtype=dtype, device=device)
        count, data, real = len(cases), recording.signal, recording.signal.data.real
        remove, ships, still = RemoveTransmitRange(radar), dict[str, list[Ship]](), data.data
        clean = remove(data)
        for name, part in fleet.parts.items():
            movers = part.movers(radar, scenes.part(name)).each(lambda x: x.to(real.device).expand(count, -1))
            vessel = self.targets[name]
            near = torch.as_tensor(vessel.range_m, dtype=torch.float64) + radar.reference_range_m
            motion = PointMotion.of(radar, real, vessel.u_r_m_s, vessel.u_a_m_s, vessel.azimuth_m, near)
            motion = motion.each(lambda x: x.expand(count))
            echo = data.with_data(
                bistatic_echo(movers, radar, *size, gate=self.gate, dtype=dtype).expand(data.data.shape)
            )
            removed = remove(echo)
            ships[name] = [_ship(radar, motion, movers, removed, i) for i in range(count)]
            moves = torch.tensor([ship.moves for ship in ships[name]], device=real.device)
            still = still - torch.where(moves[:, None, None, None], echo.data, 0)
        rest = remove(data.with_data(still))
        frames = [
            Frame(
                {
                    name: ShownShip.of(radar, of[i], Signal(clean.data[i], clean.axes), extraction)
                    for name, of in ships.items()
                },
                Signal(rest.data[i], rest.axes),
            )
            for i in range(count)
        ]
        return Trials(recording, recording, _truth(ships, frames), count, frames)


def _ship(radar: BistaticRadar, motion: PointMotion, movers: Movers, echo: Signal, i: int) -> Ship:
    """One ship of one trial, with the centre of its scatterers' powers."""
    power = movers.amplitude[i].abs().square()
    centre = [(power * x[i]).sum() / power.sum() for x in (movers.y0_m, movers.closest_m(radar))]
    return Ship(motion.each(lambda x: x[i]), (float(centre[0]), float(centre[1])), Signal(echo.data[i], echo.axes))


def _truth(ships: Mapping[str, list[Ship]], frames: list[Frame]) -> dict[str, Tensor]:
    """Motions of the middles (trial, ship), and of each ship's intensity centroid, (trial,)."""
    middles = {
        key: torch.stack([torch.stack([getattr(s.motion, key) for s in of]) for of in ships.values()], -1)
        for key in TRUTHS
    }
    own = {
        f"{name}.{key}": torch.stack([getattr(frame.ships[name].centre, key) for frame in frames])
        for name in ships
        for key in TRUTHS
    }
    return {**middles, **own}
