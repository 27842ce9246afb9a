"""Moving ships on a sea, recorded by several channels (Remote Sens. 2020, 12, 1703, Figs 13
and 18).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from torchsar.core import Draws, Outcome, Signal, Trace
from torchsar.echo import Impairment, apply_impairments, bistatic_echo, simulate_bistatic
from torchsar.multichannel import (
    Extraction,
    LeastSquares,
    MoversImage,
    PointMotion,
    RemoveTransmitRange,
    StationaryImage,
    condition_number,
    noise_gain_db,
)
from torchsar.multichannel.reconstruct import Rebuild
from torchsar.radar import BistaticRadar
from torchsar.scene import BandLimited, BistaticWorld, Fleet, KSea
from torchsar.scene import Ship as ShipOfPoints
from torchsar.scene.bistatic import Gate
from torchsar.scene.movers import Movers
from torchsar.scene.sea import Sea
from torchsar.study.names.registry import GATES, MULTICHANNEL_IMPAIRMENTS, SEAS
from torchsar.study.output.report import Drawn, comparisons
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems.geo.judge import by_target
from torchsar.study.systems.geo.world import TRUTHS, bistatic_radar
from torchsar.study.systems.geo_ocean import choices
from torchsar.study.systems.geo_ocean.judge import (
    DRAW_CASE,
    FoundTarget,
    MadeScene,
    Ship,
    ShownShip,
    at_rest,
    made_scenes,
    matched,
    ship_metrics,
)
from torchsar.study.trials.batch import OK, Found, Judged, Processed, Result, Trials, image_of, last_stage, verdict
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.system import Column, System, World


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
        """Return the image of the scene at rest, made by the imaging stage of a method."""
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
        impairments: Impairments of the recording by name, applied in this order.
    """

    pulses: int
    samples: int
    targets: Mapping[str, Vessel]
    gate: Annotated[Gate, GATES] = field(default_factory=lambda: BandLimited(4.5))
    sea: Annotated[Sea, SEAS] = field(default_factory=lambda: KSea(power_db=30.0))
    impairments: Mapping[str, Annotated[Impairment, MULTICHANNEL_IMPAIRMENTS]] = field(default_factory=dict)

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
        # every trial is a case of its own, so that a scene has one address for all its random
        # numbers
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
        impaired, known = apply_impairments(recording, self.impairments, scenes)
        return Trials(impaired, recording, {**_truth(ships, frames), **known}, count, frames)


def _ship(radar: BistaticRadar, motion: PointMotion, movers: Movers, echo: Signal, i: int) -> Ship:
    """Ship of one trial, with the centroid of the powers of its scatterers."""
    power = movers.amplitude[i].abs().square()
    centre = [(power * x[i]).sum() / power.sum() for x in (movers.y0_m, movers.closest_m(radar))]
    return Ship(motion.each(lambda x: x[i]), (float(centre[0]), float(centre[1])), Signal(echo.data[i], echo.axes))


def _truth(ships: Mapping[str, list[Ship]], frames: list[Frame]) -> dict[str, Tensor]:
    """Motions of the middles of the ships (trial, ship), and motion of the intensity centroid of
    each ship, (trial,).
    """
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


@dataclass(frozen=True)
class Judging:
    """Settings of the metrics.

    Args:
        match_m: Largest distances in metres, along track and in range, at which a detected target
            counts as a ship. They are measured from the position of the ship in the image that is
            focused for a stationary scene.
        published_targets: Published values by metric, ship and method.
    """

    match_m: Sequence[float] = (150.0, 40.0)
    published_targets: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.match_m) != 2 or not all(x > 0 for x in self.match_m):
            raise ValueError(f"metrics.match_m needs two positive distances, got {list(self.match_m)}")


class View(NamedTuple):
    """Data of a method that pictures need.

    They are the images of every trial, the detected targets by ship, and the channels of the first
    trial after each stage that changes them, from the removal of the transmit range on.
    """

    made: Sequence[MadeScene]
    found: Sequence[Mapping[str, FoundTarget | None]]
    steps: Mapping[str, Signal]


class GeoOcean(System):
    """Ships on a sea."""

    name = "geo_ocean"
    about = "whole scenes of moving ships on a sea, recorded by several channels along track"
    Radar = staticmethod(bistatic_radar)
    World = Ocean
    Judging = Judging
    impairments = MULTICHANNEL_IMPAIRMENTS
    ending = "movers_image or stationary_image"
    truths = TRUTHS
    draw_case = DRAW_CASE
    peak = 12.0
    tolerance = {"image_error_db": -20.0, "position_error_m": 10.0, "sea_error_db": -10.0}
    exact = {"stationary_image.form": {"form": "stolt"}}
    definitions = {
        "snr": "the sea has unit mean power in a range-compressed sample of one channel; scr_db: mean power of "
        "a sample of a ship's lines over it; cnr_db: sea over noise",
        "velocities": "u_r: closing slant-range speed; u_a: along track, positive with the receiver; y0: "
        "position along track at t = 0, the middle pulse; range: closest one of the track at rest",
        "matching": "a detected target belongs to the nearest ship in the image focused for a stationary scene, within "
        "metrics.match_m; found: share of ships with one. A ship that is not found counts as at rest at its position "
        "in that image: its errors are minus its velocities and its displacement, and ok is False. false_targets: "
        "detected targets that belong to no ship",
        "u_r_error_m_s": "estimated minus true u_r; u_a_error_m_s likewise. Metrics of a method are means over ships",
        "position_error_m": "distance, along track and range together, of the position given to a ship from the "
        "intensity centroid of the ship's own echo, without sea and noise, imaged in the same way by its true "
        "velocities. Its scatterers have random phases and interfere, so that no image shows the centroid of their "
        "powers. along_error_m, range_error_m: its parts, signed",
        "scatterers_error_m": "the same distance from the centroid of the scatterers' powers",
        "image_position_m": "intensity centroid along x = V_R t, near the predicted position, of the image of "
        "the ship's own echo as if it were at rest; displacement_m: that minus the true y0; displacement_vt_m: "
        "what the motion predicts on the axis x = (V_R - u_a) t, which the source prints",
        "replica_distance_m": "distance on x = V_R t of the stronger first replica from the image itself, "
        "both centroids of the same image; replica_distance_vt_m: PRF lambda R0 / (V_R - u_a), on the axis of the "
        "source. A blurred ship that reaches beyond the rebuilt band loses one end to its replica: measured "
        "centroids then lie nearer than predicted",
        "replica_db": "mean power of the final image within 100 m along track and 40 m in range of the "
        "strongest replica one or two pulse rates away, over the sea's in the same lines; the sea itself has 0 "
        "dB, spread by its texture by about 1 dB. replica_before_db: of the image focused for a stationary scene; "
        "replica_left_db: of the difference from the image of what does not move",
        "sea_error_db": "power of the difference of the image without movers from the image of what does not "
        "move, over the power of the latter, within 400 m along track and 30 m in range of where the image at "
        "rest showed the ship; sea_error_before_db: the same without removal. Of ships that move",
        "hole_db": "power of the image without movers within 60 m and 12 m of where the image at rest showed "
        "the ship, over that of the sea there: 0 dB is untouched",
        "contrast_db": "mean power of the final image within 60 m and 12 m of the true position over the sea's "
        "in the same lines",
        "condition_number": "of the band matrix that rebuilds what is at rest (absent for mmse, which inverts no such "
        "matrix); noise_gain_db: noise of a rebuilt bin against ideal uniform sampling",
        "published": "values of Remote Sens. 2020, 12, 1703, Fig. 18, whose azimuth is x = (V_R - u_a) t",
    }
    target_columns = {
        "u_r_error_m_s": Column("error of the slant-range velocity", "m/s", drawn="rms"),
        "u_a_error_m_s": Column("error of the along-track velocity", "m/s", drawn="rms"),
        "position_error_m": Column("error of the position", "m", drawn="rms"),
        "along_error_m": Column("error of the position, along track", "m"),
        "range_error_m": Column("error of the position, in range", "m"),
        "scatterers_error_m": Column("error of the position from the centroid of powers", "m"),
        "displacement_vt_m": Column("displacement if imaged at rest, predicted, axis (V_R - u_a) t", "m"),
        "replica_distance_vt_m": Column("distance of the false target, predicted, axis (V_R - u_a) t", "m"),
        "displacement_m": Column("displacement if imaged at rest, measured, axis V_R t", "m"),
        "replica_distance_m": Column("distance of the false target, measured, axis V_R t", "m"),
        "replica_before_db": Column("false target over the sea, image focused for a stationary scene", "dB"),
        "replica_db": Column("false target over the sea, final image", "dB", drawn="mean"),
        "replica_left_db": Column("remaining false target over the sea", "dB"),
        "sea_error_db": Column("error of the sea near a removed ship", "dB", drawn="mean"),
        "sea_error_before_db": Column("error of the sea near a ship before removal", "dB"),
        "hole_db": Column("sea at a removed ship, relative to the true sea", "dB"),
        "contrast_db": Column("ship over the sea at its true position", "dB", drawn="mean"),
        "u_r_std_m_s": Column("predicted error of the slant-range velocity", "m/s"),
        "found": Column("share of ships found"),
    }
    columns = {
        **target_columns,
        "false_targets": Column("detected targets that belong to no ship"),
        "condition_number": Column("condition number of the reconstruction of what is at rest"),
        "noise_gain_db": Column("noise gain of the reconstruction of what is at rest", "dB"),
        "ok": Column("share of trials in which every ship is found and reliable, and every other estimate too"),
        "seconds": Column("time of a trial", "s"),
    }

    def samples(self, world: Ocean, radar: BistaticRadar) -> int:
        return radar.channels * world.pulses * world.samples

    def check(self, bench: Bench) -> None:
        for name, chain in bench.chains.items():
            last, stage = last_stage(chain)
            if not isinstance(stage, (StationaryImage, MoversImage)):
                raise ConfigError(
                    f"{bench.file}: processor.{name}: system geo_ocean makes images of scenes; end the chain with "
                    f"{self.ending}, not with {last!r}"
                )

    def may_differ(self, path: str, world: Mapping[str, Any]) -> bool:
        """Return whether a number of the world, by dotted key, may differ between trials.

        The illumination (`gate`) may not, because it determines the number of cells of the sea.
        """
        return not path.startswith("gate.") and super().may_differ(path, world)

    def simulate(self, bench: Bench, world: Ocean, draws: Draws) -> Trials:
        return world.trials_of(bench.radar, draws, _extraction(bench), bench.dtype, bench.device)

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        made, stage = made_scenes(trace, bench.radar.speed_m_s), at_rest(bench.chains[name])
        last, _ = last_stage(bench.chains[name])
        rows, views, reach = [], [], (float(bench.judging.match_m[0]), float(bench.judging.match_m[1]))
        for scene, frame in zip(made, trials.own, strict=True):
            still = frame.still_image(stage)
            found = matched([target for target in scene.targets or () if target.ok], frame.ships, reach)
            rows.append({ship: ship_metrics(shown, found[ship], scene, still) for ship, shown in frame.ships.items()})
            views.append(found)
        ships = {ship: _stacked([row[ship] for row in rows]) for ship in bench.world().targets}
        names = dict.fromkeys(key for of in ships.values() for key in of)
        whole = {k: torch.stack([of[k] for of in ships.values() if k in of]).nanmean(0) for k in names}
        whole |= _conditioning(bench.radar, stage)
        if any(scene.targets is not None for scene in made):
            counts = [len(s.targets or ()) - sum(t is not None for t in f.values()) for s, f in zip(made, views)]
            whole["false_targets"] = torch.tensor(counts, dtype=torch.float64)
            found = torch.stack([of[OK] > 0 for of in ships.values()]).all(0)
            others = {n: e.outcome.expand(trials.count) for n, e in trace.estimates.items() if n != last}
            whole |= verdict({"ships": Outcome.of(found, Outcome.NOISE), **others})
        if not detail:
            whole |= {f"{ship}.{key}": x for ship, of in ships.items() for key, x in of.items() if key != OK}
        changed = [n for n in trace.outputs if n != last and trace.outputs[n] is not trace.inputs[n]] if detail else []
        steps = {n: image_of(trace.outputs[n]) for n in changed}
        return Judged(whole, ships, view=View(made, views, steps))

    def found(self, bench: Bench, outcome: Processed, trials: Trials) -> dict[str, Found]:
        """Return the estimated motion of every ship; NaN in trials in which it was not found."""
        if outcome.failed or outcome.judged.view.made[0].targets is None:
            return {}
        rows = outcome.judged.view.found
        table: dict[str, Found] = {}
        for ship in bench.world().targets:
            codes = Outcome.of(torch.tensor([row[ship] is not None for row in rows]), Outcome.NOISE)
            for key in TRUTHS:
                values = [math.nan if row[ship] is None else float(getattr(row[ship].motion, key)) for row in rows]
                table[f"{ship}.{key}"] = Found(torch.tensor(values, dtype=torch.float64), None, codes)
        return table

    limits = staticmethod(choices.limits)  # pyright: ignore[reportAssignmentType]

    requirements = staticmethod(choices.requirements)  # pyright: ignore[reportAssignmentType]

    choices = staticmethod(choices.choices)  # pyright: ignore[reportAssignmentType]

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        yield from self.case_pictures(results)
        yield partial(comparisons, by_target(results), self.target_columns)

    def pictured(self, result: Result) -> dict[str, Signal]:
        images = {}
        for name, outcome in result.first.outcomes.items():
            if not outcome.failed:
                scene = outcome.judged.view.made[0]
                images |= {f"{name}/fused": scene.fused, **({f"{name}/rest": scene.rest} if scene.targets else {})}
        return images

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        yield (
            "Positions",
            "Errors of positions are relative to the position in the image of the ship's own echo. The scatterers of a "
            "ship interfere, so that no image shows the centroid of their powers.",
        )


def _extraction(bench: Bench) -> Extraction:
    """Settings of the extraction by the recommended method, which also images single ships."""
    _, last = last_stage(bench.chains["recommended"])
    return last.flow.extraction if isinstance(last, MoversImage) else Extraction()


def _stacked(rows: Sequence[Mapping[str, float]]) -> dict[str, Tensor]:
    """Metrics of several trials by name. They are NaN where a trial does not have a metric."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {n: torch.tensor([row.get(n, math.nan) for row in rows], dtype=torch.float64) for n in names}


def _conditioning(radar: BistaticRadar, stage: StationaryImage) -> dict[str, Tensor]:
    """Condition number and noise gain of the reconstruction of the scene at rest."""
    motion = PointMotion.of(radar, torch.zeros((), dtype=torch.float64))
    gain = {"noise_gain_db": noise_gain_db(radar, motion, stage.rebuild)}
    if not isinstance(stage.rebuild, LeastSquares):
        return gain
    return {"condition_number": condition_number(radar, motion, stage.rebuild.bands), **gain}


SYSTEM = GeoOcean
