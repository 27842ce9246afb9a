"""Scenes of ships on a sea: simulate, run every method on each, compare with the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core import Chain, Draws, Recording, Signal
from torchsar.multichannel.body import Extraction
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import LeastSquares, Rebuild, condition_number, noise_gain_db
from torchsar.multichannel.scene_image import SceneImage
from torchsar.multichannel.stationary import StationaryImage
from torchsar.multichannel.transmit import RemoveTransmitRange
from torchsar.study.benches import Benches
from torchsar.study.cases import check_sweep, refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.record import OK
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.ocean.build import Ocean, Sighted, check
from torchsar.study.ocean.judge import Judged, Reference, judged
from torchsar.study.ocean.sections import OceanConfig
from torchsar.study.ocean.stages import MoversImage
from torchsar.study.settings.errors import ConfigError

_COPIES = 40
ENDING = "movers_image or stationary_image"


@dataclass(frozen=True)
class Way:
    """A method: the stages before the image, and the last one, which makes it, with where it takes
    its values from.
    """

    before: Mapping[str, nn.Module]
    uses: Mapping[str, Mapping[str, str]]
    image: StationaryImage | MoversImage

    @staticmethod
    def of(name: str, chain: Chain) -> Way:
        """Raises ConfigError for a chain that does not end with a picture of a scene, or estimates
        something on the way there.
        """
        *before, last = chain.stages
        image = chain.stages[last]
        if not isinstance(image, (StationaryImage, MoversImage)):
            raise ConfigError(
                f"processor.{name}: system geo_ocean pictures scenes; end the chain with {ENDING}, not with {last!r}"
            )
        for stage in before:
            if chain.uses[stage] or getattr(chain.stages[stage], "provides", ()):
                raise ConfigError(
                    f"processor.{name}.stages.{stage}: stages before {last!r} may neither estimate nor "
                    "use values; leave it out"
                )
        wrong = [source for source in chain.uses[last].values() if not source.startswith("aux.")]
        if wrong:
            raise ConfigError(
                f"processor.{name}.stages.{last}.uses: {wrong[0]!r} is nothing recorded; there is "
                "aux.true_u_r_m_s, aux.true_u_a_m_s, aux.true_y0_m, aux.true_range_m"
            )
        return Way({stage: chain.stages[stage] for stage in before}, chain.uses, image)

    @property
    def estimates(self) -> bool:
        """Whether it finds movers, or is told of them."""
        return isinstance(self.image, MoversImage)

    @property
    def at_rest(self) -> StationaryImage:
        """How it pictures what is at rest."""
        return self.image.flow.image if isinstance(self.image, MoversImage) else self.image

    @property
    def rebuild(self) -> Rebuild:
        return self.at_rest.rebuild

    def channels(self, signal: Signal) -> Signal:
        for stage in self.before.values():
            signal = stage(signal)
        return signal

    def scene(self, recording: Recording) -> SceneImage:
        signal = self.channels(recording.signal)
        if not isinstance(self.image, MoversImage):
            image = self.image(signal)
            return SceneImage(image, image, image, data=signal)
        uses = list(self.uses.values())[-1]
        return self.image.scene(
            signal, **{parameter: recording.aux[source.removeprefix("aux.")] for parameter, source in uses.items()}
        )


@dataclass(frozen=True)
class Bench:
    """All that one case needs."""

    config: OceanConfig
    ocean: Ocean
    chains: Mapping[str, Chain]
    ways: Mapping[str, Way]

    @staticmethod
    def of(loaded: Loaded) -> Bench:
        assert isinstance(loaded.config, OceanConfig)
        ocean = Ocean.of(loaded)
        chains = build_chains(loaded, radar=ocean.radar)
        return Bench(loaded.config, ocean, chains, {name: Way.of(name, chain) for name, chain in chains.items()})

    @property
    def extraction(self) -> Extraction:
        """Of the recommended method, which also pictures the ships' own echoes."""
        image = self.ways["recommended"].image
        return image.flow.extraction if isinstance(image, MoversImage) else Extraction()


@dataclass(frozen=True)
class Scene:
    """One scene by every method."""

    sighted: Sighted
    reference: Reference
    made: Mapping[str, SceneImage]
    judged: Mapping[str, Judged]


class OceanTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config: {method: {"SHIP.metric": (trial,)}} with ok,
    false_targets, condition_number, noise_gain_db and seconds of each scene. Scenes are worked on
    in turn.
    """

    batched = ()

    def check(self, grid: Mapping[str, Any]) -> None:
        """Raises ConfigError for what a sweep does not use."""
        refuse_recordings(self.loaded)
        check_sweep(self.loaded, grid, "world.targets.ship2.u_r_m_s")
        check(self.loaded)

    def build(self, loaded: Loaded) -> Bench:
        return Bench.of(loaded)

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        ocean = self.bench(fixed).ocean
        return _COPIES * ocean.dtype.itemsize * ocean.radar.channels * ocean.pulses * ocean.samples

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench(parameters)
        trials = list(draws.trials if draws.trials is not None else [0])
        cases = draws.case if isinstance(draws.case, tuple) else (draws.case,) * len(trials)
        scenes = [
            scene_of(bench, Draws(draws.seed, case, None), trial).judged
            for case, trial in zip(cases, trials, strict=True)
        ]
        return {
            **{name: stacked([flat(scene[name]) for scene in scenes]) for name in bench.ways},
            BOUNDS: {},
            SAVED: {},
        }


def flat(one: Judged) -> dict[str, float]:
    """Metrics of all ships and of the whole by one name each; ok: of all ships together."""
    verdicts = [of[OK] for of in one.ships.values() if OK in of]
    by_ship = {f"{ship}.{key}": value for ship, of in one.ships.items() for key, value in of.items() if key != OK}
    return {**by_ship, **one.whole, **({OK: min(verdicts)} if verdicts else {})}


def stacked(rows: list[dict[str, float]]) -> dict[str, Tensor]:
    """By name over rows; a verdict is bool, what a row lacks is NaN."""
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: torch.tensor([row.get(name, math.nan) for row in rows], dtype=torch.float64) for name in names}
    return {name: value > 0 if name == OK else value for name, value in values.items()}


@torch.no_grad()
def scene_of(bench: Bench, draws: Draws, trial: int) -> Scene:
    """One trial: its scene by every method."""
    sighted = bench.ocean.sighted(replace(draws, case=f"{draws.case}/{trial}"))
    reference = Reference.of(bench.ocean.radar, sighted, RemoveTransmitRange(bench.ocean.radar), bench.extraction)
    made, found = {}, {}
    still: dict[Rebuild, Signal] = {}
    for name, way in bench.ways.items():
        began = time.perf_counter()
        try:
            made[name] = way.scene(sighted.recording)
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"processor.{name}: {error}") from error
        seconds = time.perf_counter() - began
        if way.rebuild not in still:
            still[way.rebuild] = way.at_rest(way.channels(sighted.still))
        one = judged(made[name], still[way.rebuild], reference, bench.config.metrics.match_m, way.estimates)
        found[name] = replace(one, whole={**one.whole, **conditioning(bench, way), "seconds": seconds})
    return Scene(sighted, reference, made, found)


def conditioning(bench: Bench, way: Way) -> dict[str, float]:
    """Of the reconstruction of what is at rest."""
    radar = bench.ocean.radar
    motion = PointMotion.of(radar, torch.zeros((), dtype=torch.float64))
    gain = {"noise_gain_db": float(noise_gain_db(radar, motion, way.rebuild))}
    return (
        {"condition_number": float(condition_number(radar, motion, way.rebuild.bands)), **gain}
        if isinstance(way.rebuild, LeastSquares)
        else gain
    )
