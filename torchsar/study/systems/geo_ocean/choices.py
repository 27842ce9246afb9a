"""Processing of ships on a sea: its limits, the errors of simplifications, and its alternatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Signal
from torchsar.echo import bistatic_echo
from torchsar.focus.requirements import Limit, Requirement
from torchsar.metrics import error_db
from torchsar.multichannel import (
    ImageMovers,
    MoversImage,
    MultichannelUse,
    RemoveTransmitRange,
    SceneImage,
    StationaryImage,
    multichannel_limits,
    multichannel_requirements,
)
from torchsar.multichannel.stationary import bulk_error_db, swath_limit
from torchsar.scene import BandLimited, MovingPoints
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems.geo_ocean.judge import FoundTarget, MadeScene, at_rest, matched, ship_metrics
from torchsar.study.trials.batch import last_stage
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.system import by_limit

# integration time (s) of the source, for scenes that are illuminated through an antenna pattern
_PATTERN_S = 4.5
# Pulses and range lines around one ship on which the settings of the recommended method are
# compared. They contain 1.8 apertures of 4.5 s at 180 Hz, and the range walk of a ship at 20 m/s.
_CROP = (1440, 128)
# segments (s) of slow time, and half extents (m) of the lines of a ship, that are compared
_SEGMENTS_S, _LINES_M = (0.3, 0.6, 1.2), (30.0, 60.0)
# limits that do not apply, because no keystone transform is used, and bands are separated only for
# the scene at rest
_NOT_HERE = (
    "tone left for the keystone transform",
    "condition number within the velocities",
    "singular speeds along track within the search",
)


def limits(bench: Bench) -> dict[Limit, list[str]]:
    """Return the limits of methods in this scene, with the methods that each concerns."""
    every = {n: [*multichannel_limits(bench.radar, _use_of(bench, n)), *_swath_limits(bench, n)] for n in bench.chains}
    return by_limit((one, name) for name, of in every.items() for one in of if one.name not in _NOT_HERE)


def requirements(bench: Bench) -> Sequence[Requirement]:
    """Return the errors of simplified processing; nothing if a target is as fast along track as the
    receiver, because no aperture forms then.
    """
    use = _use_of(bench, "recommended")
    return multichannel_requirements(bench.radar, use) if bench.radar.speed_m_s > use.u_a_m_s[1] else ()


def _last(bench: Bench, name: str) -> Any:
    return last_stage(bench.chains[name])[1]


def _integration_s(bench: Bench) -> float | None:
    gate = bench.world().gate
    return float(gate.duration_s) if isinstance(gate, BandLimited) else None


def _use_of(bench: Bench, name: str) -> MultichannelUse:
    """Use of the radar by a method.

    The scene at rest is reconstructed as such. Moving ships are imaged with their own velocities,
    without a reconstruction.
    """
    world, last, lit = bench.world(), _last(bench, name), _integration_s(bench)
    ships, moving = list(world.targets.values()), isinstance(last, MoversImage)
    spans = [[float(getattr(ship, key)) for ship in ships] for key in ("u_r_m_s", "u_a_m_s")]
    return MultichannelUse(
        world.pulses,
        lit or _PATTERN_S,
        (last.flow.image if moving else last).rebuild,
        lit is None,
        *((min(x), max(x)) for x in spans),
        y0_m=max(abs(float(ship.azimuth_m)) for ship in ships),
        swath_m=max(abs(float(ship.range_m)) for ship in ships),
        snr_db=float(world.sea.power_db) + max(float(ship.scr_db) for ship in ships),
        clutter=True,
        estimators=("whitened",) if moving else (),
        dtype=bench.dtype,
    )


def _swath_limits(bench: Bench, name: str) -> list[Limit]:
    """Limits of the swath. Moving ships are sought only where they lie in the swath at any
    velocity.
    """
    last, world = _last(bench, name), bench.world()
    if not isinstance(last, MoversImage):
        return []
    extraction, half = last.flow.extraction, world.samples / 2 * bench.radar.range_step_m
    ships = [(float(ship.azimuth_m), float(ship.range_m)) for ship in world.targets.values()]
    return [swath_limit(bench.radar, half, ships, extraction.range_m, extraction.integration_s)]


def choices(bench: Bench) -> list[Choice]:
    """Return the choices between alternatives: the form of focusing for the scene at rest, and the
    settings with which the recommended method images moving ships.
    """
    radar, world, lit = bench.radar, bench.world(), _integration_s(bench) or _PATTERN_S
    lost = bulk_error_db(
        radar, at_rest(bench.chains["recommended"]).rebuild.bands, world.samples / 2 * radar.range_step_m, lit
    )
    forms = [
        Alternative("bulk", {"form": "bulk"}, {"image_error_db": lost}, "change of migration over the swath"),
        Alternative("stolt", {"form": "stolt"}, {}),
    ]
    found = [Choice("image of what is at rest", "stationary_image.form", forms, partial(_forms, bench))]
    if isinstance(_last(bench, "recommended"), MoversImage):
        flow = _last(bench, "recommended").flow
        settings = {f"segments of {x:g} s": {"extraction": replace(flow.extraction, segment_s=x)} for x in _SEGMENTS_S}
        settings |= {f"lines within {x:g} m": {"extraction": replace(flow.extraction, range_m=x)} for x in _LINES_M}
        settings |= {"set to zero": {"removal": "zero"}, "double precision": {"dtype": torch.complex128}}
        flows = [Alternative(name, keys) for name, keys in {**settings, "as the config has it": {}}.items()]
        found.append(Choice("settings of the flow", "movers_image", flows, partial(_flows, bench)))
    return found


def _forms(bench: Bench) -> Measured:
    """Measure the error of images of points at rest at both edges of the swath by each form,
    relative to the exact one.
    """
    radar, world, rebuild = bench.radar, bench.world(), at_rest(bench.chains["recommended"]).rebuild
    axes = radar.axes(world.pulses, world.samples)
    edge = 0.9 * world.samples / 2 * radar.range_step_m
    points = MovingPoints([[0.0], [0.0]], [[0.0], [0.0]], [[0.0], [0.0]], [[-edge], [edge]])  # pyright: ignore
    echo = bistatic_echo(
        points.movers(radar, Draws(0)), radar, world.pulses, world.samples, gate=world.gate, dtype=torch.complex128
    )
    # the transmit range is common to all echoes, and is removed
    signal = RemoveTransmitRange(radar)(Signal(echo, axes))
    exact, used = StationaryImage(radar, rebuild)(signal).data, signal.to(bench.dtype)

    def run(one: Alternative) -> Tensor:
        return StationaryImage(radar, rebuild, one.keys["form"])(used).data

    return Measured(run, lambda one, image: {"image_error_db": float(error_db(image.to(exact), exact).max())})


def _flows(bench: Bench) -> Measured:
    """Measure the recommended method with one setting changed at a time, on the fastest ship only.

    The range of the swath around the ship is kept, so that the data are a part of those of the
    whole scene.
    """
    flow, world = _last(bench, "recommended").flow, bench.world()
    name, ship = max(world.targets.items(), key=lambda item: _speed_m_s(item[1]))
    if not _speed_m_s(ship):
        raise ConfigError(
            f"{bench.file}: world.targets: alternative settings are compared on a moving ship, and no ship moves; give "
            "a ship a speed u_r_m_s or u_a_m_s"
        )
    radar = replace(bench.radar, reference_range_m=bench.radar.reference_range_m + float(ship.range_m))
    pulses, samples = min(_CROP[0], world.pulses), min(_CROP[1], world.samples)
    alone = {name: replace(ship, range_m=0.0)}
    crop = replace(world, pulses=pulses, samples=samples, targets=alone, impairments={})
    trials = crop.trials_of(radar, bench.draws("trade", [0]), flow.extraction, bench.dtype, bench.device)
    (frame,), clean = trials.own, RemoveTransmitRange(radar)(trials.recording.signal)
    kept: Mapping[str, Any] = {
        "extraction": flow.extraction,
        "detector": flow.detector,
        "rebuild": flow.image.rebuild,
        "removal": flow.removal,
        "u_a_half_m_s": flow.u_a_half_m_s,
    }
    reach = (float(bench.judging.match_m[0]), float(bench.judging.match_m[1]))
    still = frame.still_image(StationaryImage(radar, flow.image.rebuild))

    def run(one: Alternative) -> SceneImage:
        keys = {**kept, **one.keys}
        signal = Signal(clean.data[0].to(keys.pop("dtype", bench.dtype)), clean.axes)
        return ImageMovers(radar, **keys)(signal)

    def loss(one: Alternative, made: SceneImage) -> dict[str, float]:
        targets = [FoundTarget(body.motion, float(body.u_r_std_m_s), bool(body.ok)) for body in made.bodies]
        found = matched([t for t in targets if t.ok], frame.ships, reach)
        scene = MadeScene(made.conventional, made.rest, made.fused, targets)
        row = ship_metrics(frame.ships[name], found[name], scene, still)
        return {key: row[key] for key in ("position_error_m", "sea_error_db")}

    return Measured(run, loss, lambda one: pulses * samples / world.pulses / world.samples)


def _speed_m_s(ship: Any) -> float:
    return abs(complex(float(ship.u_r_m_s), float(ship.u_a_m_s)))
