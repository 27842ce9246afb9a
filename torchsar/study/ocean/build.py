"""From a checked config to the radar, the ships, and recordings of single scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal
from torchsar.echo import bistatic_echo, simulate_bistatic
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar
from torchsar.scene import BistaticWorld, Fleet, Movers, Sea, Ship
from torchsar.study.build import precision, refuse_oversize
from torchsar.study.cases import cases_of, check_judged
from torchsar.study.config import Loaded
from torchsar.study.geo.build import TOLD, build_radar
from torchsar.study.methods import build_chains
from torchsar.study.ocean.sections import OceanConfig, Vessel
from torchsar.study.registry import GATES, SEAS
from torchsar.study.settings.errors import ConfigError

SLOWEST_M_S = (0.3, 1.0)
_MOTION = ("u_r_m_s", "u_a_m_s", "azimuth_m", "range_m")


@dataclass(frozen=True)
class Vouched:
    """The truth of one ship: the motion of its middle, its scatterers, and its echo alone, with the
    transmit range, as recorded.
    """

    motion: PointMotion
    movers: Movers
    echo: Signal

    @property
    def moves(self) -> bool:
        return bool(self.motion.u_r_m_s.abs() > SLOWEST_M_S[0]) or bool(self.motion.u_a_m_s.abs() > SLOWEST_M_S[1])


@dataclass(frozen=True)
class Sighted:
    """One scene: the recording, with the motions of ships as aux `true_*` (ship,), the truth by
    ship, and what is recorded without those that move.
    """

    recording: Recording
    ships: Mapping[str, Vouched]
    still: Signal


@dataclass(frozen=True)
class Ocean:
    """All that simulates one case. The unit is the mean power of the sea; cnr_db: over the
    noise.
    """

    radar: BistaticRadar
    ships: Mapping[str, Vessel]
    gate: Any
    sea: Sea
    cnr_db: float
    pulses: int
    samples: int
    dtype: torch.dtype

    @staticmethod
    def of(loaded: Loaded) -> Ocean:
        """Raises ConfigError for what radar or world refuse."""
        config, file = loaded.config, loaded.file
        assert isinstance(config, OceanConfig) and config.world is not None
        world, radar = config.world, build_radar(loaded)
        refuse_oversize(world.pulses * radar.channels, world.samples, file, "world.pulses or world.samples")
        sea = SEAS.make(world.sea, "world.sea", file)
        for name, vessel in world.targets.items():
            if vessel.range_cells > vessel.count:
                raise ConfigError(
                    f"{file}: world.targets.{name}: {vessel.range_cells} range cells need as many "
                    f"scatterers, and count is {vessel.count}"
                )
        return Ocean(
            radar,
            world.targets,
            GATES.make(world.gate, "world.gate", file),
            replace(sea, power_db=0.0),
            float(sea.power_db),
            world.pulses,
            world.samples,
            precision(config),
        )

    def sighted(self, draws: Draws, dtype: torch.dtype | None = None) -> Sighted:
        """The scene of one trial, which stands in `draws` alone; noise and sea follow seed and
        trial, and each ship its name.
        """
        fleet = Fleet({name: _ship(vessel) for name, vessel in self.ships.items()})
        world = BistaticWorld(fleet, self.gate, self.sea, snr_db=self.cnr_db)
        recording, _ = simulate_bistatic(self.radar, world, self.pulses, self.samples, draws, dtype=dtype or self.dtype)
        ships = {name: self._vouched(name, part, draws, recording.signal) for name, part in fleet.parts.items()}
        moving = [ship.echo.data for ship in ships.values() if ship.moves]
        still = recording.signal.with_data(recording.signal.data - sum(moving)) if moving else recording.signal
        told = {
            f"{TOLD}{name}": torch.stack([getattr(ship.motion, name) for ship in ships.values()])
            for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
        }
        return Sighted(replace(recording, aux={**recording.aux, **told}), ships, still)

    def _vouched(self, name: str, ship: Any, draws: Draws, like: Signal) -> Vouched:
        movers = ship.movers(self.radar, draws.part(name))
        echo = bistatic_echo(movers, self.radar, self.pulses, self.samples, gate=self.gate, dtype=like.data.dtype)
        u_r, u_a, y0, beyond = (getattr(self.ships[name], key) for key in _MOTION)
        return Vouched(
            PointMotion.of(self.radar, like.data.real, u_r, u_a, y0, self.radar.reference_range_m + beyond),
            movers,
            like.with_data(echo),
        )


def _ship(vessel: Vessel) -> Ship:
    values = vessel.model_dump()
    return Ship(level_db=values.pop("scr_db"), **values)


def centroid(movers: Movers, radar: BistaticRadar) -> tuple[Tensor, Tensor]:
    """Along-track place and closest range of the middle of scatterers by their powers, () each."""
    power = movers.amplitude.abs().square()
    return (power * movers.y0_m).sum() / power.sum(), (power * movers.closest_m(radar)).sum() / power.sum()


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything. Raises ConfigError."""
    from torchsar.study.ocean.trials import Way

    for case in cases_of(loaded).values():
        check_judged(case)
        if case.config.metrics.reference is not None:
            raise ConfigError(f"{case.file}: metrics.reference: system geo_ocean judges by the truth; leave it out")
        for name, chain in build_chains(case, radar=Ocean.of(case).radar).items():
            Way.of(name, chain)
