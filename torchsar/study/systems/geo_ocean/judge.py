"""Errors of the images of a sea with moving ships, and of the estimated motions of the ships.

Figures of the ocean simulation: steps of the processing, final images, and ships.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from torchsar import plot
from torchsar.core import Chain, Signal, Trace
from torchsar.multichannel import (
    Extraction,
    Frame,
    LeastSquares,
    MoversImage,
    PointMotion,
    RemoveTransmitRange,
    StationaryImage,
)
from torchsar.multichannel.body import centred_motion
from torchsar.multichannel.chip import chip_about
from torchsar.radar import BistaticRadar
from torchsar.study.output.report import Drawn
from torchsar.study.trials.batch import Result, last_stage

# Half extents in azimuth and range, in metres.
# NEAR_M, SHIP_M, REPLICA_M: areas in which the levels of the sea around a ship, of the ship itself,
# and of a replica are measured.
# _SHOWN_M, _SPREAD_M: areas in which a ship and its blurred replicas are sought.
NEAR_M, SHIP_M, REPLICA_M = (400.0, 30.0), (60.0, 12.0), (100.0, 40.0)
_SHOWN_M, _SPREAD_M = (250.0, 60.0), (150.0, 110.0)
# speeds |u_r| and |u_a| in m/s up to which a ship counts as at rest, as in `ImageMovers`
_SLOWEST_M_S = (0.3, 1.0)


@dataclass(frozen=True)
class ImagePosition:
    """A position in an image.

    Args:
        azimuth_m: Azimuth in metres: slow time multiplied by the speed of the receiver.
        range_m: Closest range in metres.
    """

    azimuth_m: float
    range_m: float

    @staticmethod
    def of(motion: PointMotion) -> ImagePosition:
        """Return where a moving target appears in the image focused for a stationary scene.

        Args:
            motion: Motion of the target.

        Returns:
            Position in that image.
        """
        return ImagePosition(motion.speed_m_s * float(motion.image_s), float(motion.closest_m))

    def window(self, image: Signal, reach_m: tuple[float, float]) -> tuple[slice, slice]:
        """Find the pixels of an image near the position.

        Args:
            image: Image (azimuth, range).
            reach_m: Largest distances in azimuth and range in metres.

        Returns:
            The rows and the columns.
        """
        places = zip(image.axes, (self.azimuth_m, self.range_m), reach_m, strict=True)
        near = [((axis.values() - at).abs() < reach).nonzero()[:, 0].tolist() for axis, at, reach in places]
        rows, columns = (slice(i[0], i[-1] + 1) if i else slice(0) for i in near)
        return rows, columns

    def power(self, image: Signal, reach_m: tuple[float, float]) -> float:
        """Compute the mean power of an image near the position.

        Args:
            image: Image (azimuth, range).
            reach_m: Largest distances in azimuth and range in metres.

        Returns:
            Mean power of the pixels; zero if none is near enough.
        """
        cut = image.data[self.window(image, reach_m)]
        return float(cut.abs().square().to(torch.float64).mean()) if cut.numel() else 0.0

    def centroid(self, image: Signal, reach_m: tuple[float, float]) -> ImagePosition:
        """Find the centre of power of an image near the position.

        Args:
            image: Image (azimuth, range).
            reach_m: Largest distances in azimuth and range in metres.

        Returns:
            Centre of power; the position itself if there is no power near it.
        """
        rows, columns = self.window(image, reach_m)
        power = image.data[rows, columns].abs().square().to(torch.float64)
        total = power.sum()
        if not float(total) > 0:
            return self
        azimuth, range_ = (axis.values(image.data.device) for axis in image.axes)
        along, across = (power.sum(1) * azimuth[rows]).sum(), (power.sum(0) * range_[columns]).sum()
        return ImagePosition(float(along / total), float(across / total))


@dataclass(frozen=True)
class Ship:
    """True motion and noise-free echo of a simulated ship.

    Args:
        motion: Motion of the middle of the ship; its tensors have the shape ().
        scatterers_m: Along-track position and closest range in metres of the scatterers' mean,
            weighted by their powers.
        echo: Echo of the ship alone (channel, pulse, range), with the transmit range removed from
            the phase.
    """

    motion: PointMotion
    scatterers_m: tuple[float, float]
    echo: Signal

    @property
    def moves(self) -> bool:
        """True if the ship moves at more than 0.3 m/s in range or 1 m/s along track."""
        fast = (self.motion.u_r_m_s.abs() > _SLOWEST_M_S[0], self.motion.u_a_m_s.abs() > _SLOWEST_M_S[1])
        return any(map(bool, fast))


@dataclass(frozen=True)
class ShownShip:
    """Where a simulated ship and its replicas appear in images without sea and noise.

    Args:
        ship: The ship.
        centre: True velocities of the ship, with the position of the intensity centroid of the ship
            in the image that is focused with these velocities.
        image: Position in the image focused for a stationary scene.
        replica: Position of the strongest replica of the ship in the image focused for a stationary
            scene. A replica is a false target, here one or two pulse rates away in Doppler.
        away_m: Measured and predicted azimuth distance in metres between the ship and its replica
            one pulse rate away. The measured one is slow time multiplied by the speed of the
            receiver, the predicted one slow time multiplied by the speed of the receiver relative
            to the ship.
    """

    ship: Ship
    centre: PointMotion
    image: ImagePosition
    replica: ImagePosition
    away_m: tuple[float, float]

    @staticmethod
    def of(radar: BistaticRadar, ship: Ship, data: Signal, extraction: Extraction) -> ShownShip:
        """Image the echo of a ship alone and find the positions of the ship and its replicas.

        Args:
            radar: Radar parameters.
            ship: The ship.
            data: The whole recording (channel, pulse, range), with the transmit range removed from
                the phase. The covariance of the sea in it sets the weights with which the channels
                are combined to focus the ship.
            extraction: Extent of a ship in the data.

        Returns:
            Positions and distances.
        """
        image, motion = StationaryImage(radar)(ship.echo), ship.motion
        shown = ImagePosition.of(motion).centroid(image, _SHOWN_M)
        predicted = radar.prf_hz * radar.wavelength_m * float(motion.range_m) / float(motion.along_m_s)
        off = predicted * radar.speed_m_s / float(motion.along_m_s)
        first, *_ = replicas = [_repeated(image, shown, order * off) for order in (1, 2)]
        strongest = max(replicas, key=lambda position: position.power(image, REPLICA_M))
        frame = Frame.of(radar, data)
        chip = chip_about(data.data, frame, motion, extraction)
        own = centred_motion(replace(chip, cells=chip_about(ship.echo.data, frame, motion, extraction).cells))
        return ShownShip(ship, own, shown, strongest, (abs(first.azimuth_m - shown.azimuth_m), predicted))

    def metrics(self) -> dict[str, float]:
        """Return the figures that do not depend on the imaging method.

        Returns:
            By name, in metres: azimuth of the ship in the image focused for a stationary scene, its
            displacement from the true position, and, for a moving ship, distances of the replica.
        """
        y0, along = float(self.centre.y0_m), float(self.centre.along_m_s)
        shown = {
            "image_position_m": self.image.azimuth_m,
            "displacement_m": self.image.azimuth_m - y0,
            "displacement_vt_m": along * float(self.centre.image_s) - y0,
        }
        away = {"replica_distance_m": self.away_m[0], "replica_distance_vt_m": self.away_m[1]}
        return {**shown, **away} if self.ship.moves else shown


def _repeated(image: Signal, shown: ImagePosition, off_m: float) -> ImagePosition:
    """Position of the replica off_m to the side of the ship on which it is stronger.

    A replica is wide in range, because its migration is that of another band.
    """
    sides = [replace(shown, azimuth_m=shown.azimuth_m + side * off_m) for side in (-1, 1)]
    return max(sides, key=lambda position: position.power(image, _SPREAD_M)).centroid(image, _SPREAD_M)


@dataclass(frozen=True)
class FoundTarget:
    """A moving target that an imaging method detected.

    Args:
        motion: Estimated motion of the target; its tensors have the shape ().
        u_r_std_m_s: Predicted standard deviation of the slant-range speed; 0 where there is none.
        ok: Whether the estimate is reliable.
    """

    motion: PointMotion
    u_r_std_m_s: float
    ok: bool


@dataclass(frozen=True)
class MadeScene:
    """Images that a method formed of a scene, and the moving targets that it detected.

    Args:
        conventional: Image (azimuth, range) that is focused as if everything were at rest.
        rest: Image after removal of the moving targets.
        fused: Image with every moving target focused and at its estimated position.
        targets: Detected targets; None for a method that does not detect targets.
    """

    conventional: Signal
    rest: Signal
    fused: Signal
    targets: Sequence[FoundTarget] | None = None


def at_rest(chain: Chain) -> StationaryImage:
    """Stage of a chain that images the scene at rest."""
    _, last = last_stage(chain)
    return last.flow.image if isinstance(last, MoversImage) else last


def made_scenes(trace: Trace, speed_m_s: float) -> list[MadeScene]:
    """Collect the images and detected targets of every trial from the run of a processing chain.

    Args:
        trace: Signals and estimates of the run. The chain ends with an image that is focused for a
            stationary scene, or with `MoversImage`.
        speed_m_s: Speed of the receiver along its track in m/s.

    Returns:
        One scene for each trial.
    """
    data, axes = trace.signal.data.reshape(-1, *trace.signal.data.shape[-2:]), trace.signal.axes
    estimate = next((e for e in trace.estimates.values() if "conventional" in e.info), None)
    if estimate is None:
        images = [Signal(image, axes) for image in data]
        return [MadeScene(image, image, image) for image in images]
    info = {name: x.reshape(len(data), *x.shape[len(trace.signal.trials) :]) for name, x in estimate.info.items()}
    values = [estimate.value[key].reshape(len(data), -1) for key in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")]
    std, ok = estimate.std["u_r_m_s"].reshape(len(data), -1), estimate.ok.reshape(len(data), -1)
    scenes = []
    for i, image in enumerate(data):
        there = (info["level"][i] > 0).nonzero()[:, 0].tolist()
        motions = [PointMotion(*[x[i, j] for x in values], speed_m_s) for j in there]  # pyright: ignore[reportCallIssue]
        targets = [FoundTarget(m, float(std[i, j]), bool(ok[i, j])) for m, j in zip(motions, there, strict=True)]
        conventional, rest = Signal(info["conventional"][i], axes), Signal(info["rest"][i], axes)
        scenes.append(MadeScene(conventional, rest, Signal(image, axes), targets))
    return scenes


def matched(
    targets: Sequence[FoundTarget], ships: Mapping[str, ShownShip], match_m: tuple[float, float]
) -> dict[str, FoundTarget | None]:
    """Assign detected targets to ships by position in the image focused for a stationary scene.

    Args:
        targets: Reliable detected targets.
        ships: The ships of the scene by name.
        match_m: Largest distances between target and ship in azimuth and range in metres.

    Returns:
        The nearest target of each ship, by the name of the ship; None if no target is within
        match_m. Distances are compared as fractions of match_m. No target is assigned twice.
    """
    pairs = []
    for name, shown in ships.items():
        own = ImagePosition.of(shown.centre)
        for i, target in enumerate(targets):
            at = ImagePosition.of(target.motion)
            away = max(abs(own.azimuth_m - at.azimuth_m) / match_m[0], abs(own.range_m - at.range_m) / match_m[1])
            pairs += [(away, name, i)] if away < 1 else []
    found: dict[str, FoundTarget | None] = dict.fromkeys(ships)
    taken = set()
    for _, name, i in sorted(pairs):
        if found[name] is None and i not in taken:
            found[name] = targets[i]
            taken.add(i)
    return found


def ship_metrics(shown: ShownShip, found: FoundTarget | None, made: MadeScene, still: Signal) -> dict[str, float]:
    """Compute the errors of motion and image of one ship.

    The motion of a ship that was not found is taken to be zero, and its position to be that in the
    image focused for a stationary scene.

    Args:
        shown: True motion and positions of the ship.
        found: Detected target that belongs to the ship; None if there is none.
        made: Images of the scene by the method.
        still: Image that the same method forms of the data without moving ships.

    Returns:
        Errors, levels and distances by name, in m/s, m and dB.
    """
    return {**shown.metrics(), **_errors(shown, found, made.targets is not None), **_levels(shown, made, still)}


def _errors(shown: ShownShip, found: FoundTarget | None, estimates: bool) -> dict[str, float]:
    true, scatterers = shown.centre, shown.ship.scatterers_m
    u_r, u_a, y0, near = 0.0, 0.0, shown.image.azimuth_m, shown.image.range_m
    if found is not None:
        names = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
        u_r, u_a, y0, near = (float(getattr(found.motion, name)) for name in names)
    along, across = y0 - float(true.y0_m), near - float(true.range_m)
    positions = {
        "position_error_m": math.hypot(along, across),
        "along_error_m": along,
        "range_error_m": across,
        "scatterers_error_m": math.hypot(y0 - scatterers[0], near - scatterers[1]),
    }
    if not estimates:
        return positions
    errors = {"u_r_error_m_s": u_r - float(true.u_r_m_s), "u_a_error_m_s": u_a - float(true.u_a_m_s)}
    std = {} if found is None or not found.u_r_std_m_s > 0 else {"u_r_std_m_s": found.u_r_std_m_s}
    return {
        **errors,
        **positions,
        **std,
        "found": float(found is not None),
        "ok": float(found is not None and found.ok),
    }


def _levels(shown: ShownShip, made: MadeScene, still: Signal) -> dict[str, float]:
    """Levels in dB of images at the true position of a ship; if it moves, also at its position in
    the stationary image and at its replica.
    """

    def of_lines(at: ImagePosition, reach_m: float) -> float:
        """Mean power in the image of the scene at rest, over all azimuths within reach_m
        in range.
        """
        return at.power(still, (math.inf, reach_m))

    true = ImagePosition(float(shown.centre.y0_m), float(shown.centre.range_m))
    levels = {"contrast_db": _db(true.power(made.fused, SHIP_M), of_lines(true, SHIP_M[1]))}
    if not shown.ship.moves:
        return levels
    left, before = (still.with_data(image.data - still.data) for image in (made.rest, made.conventional))
    at, again = ImagePosition.of(shown.centre), shown.replica
    sea, floor = at.power(still, NEAR_M), of_lines(again, REPLICA_M[1])
    levels |= {
        "sea_error_db": _db(at.power(left, NEAR_M), sea),
        "sea_error_before_db": _db(at.power(before, NEAR_M), sea),
    }
    levels |= {"hole_db": _db(at.power(made.rest, SHIP_M), at.power(still, SHIP_M))}
    replicas = {"replica_db": made.fused, "replica_before_db": made.conventional, "replica_left_db": left}
    return {**levels, **{name: _db(again.power(image, REPLICA_M), floor) for name, image in replicas.items()}}


def _db(power: float, reference: float) -> float:
    return 10 * math.log10(max(power, 1e-30) / max(reference, 1e-30))


# highest and lowest level (dB) of drawn scenes relative to the sea
_UP_DB, _DOWN_DB = 25.0, -10.0


def _made(result: Result) -> dict[str, MadeScene]:
    """Images of the first trial by every method."""
    return {n: outcome.judged.view.made[0] for n, outcome in result.first.outcomes.items() if not outcome.failed}


def _shown(result: Result) -> Mapping[str, ShownShip]:
    return result.first.trials.own[0].ships


def _true(shown: ShownShip) -> ImagePosition:
    return ImagePosition(float(shown.centre.y0_m), float(shown.centre.range_m))


def _over_sea(image: Signal) -> Signal:
    """Root mean square of blocks of pixels relative to the median block, limited to the drawn
    levels.
    """
    view = plot.quicklook(image, 300)
    level = view.data.abs().to(torch.float64)
    level = level / level.median().clamp_min(1e-300)
    return view.with_data(level.clamp(10 ** (_DOWN_DB / 20), 10 ** (_UP_DB / 20)).to(torch.complex64))


def _boxes(positions: Sequence[ImagePosition]) -> tuple[np.ndarray, np.ndarray]:
    """Outlines of +-60 m in range and +-120 m in azimuth around positions, as one broken line."""
    return plot.boxes([(p.range_m, p.azimuth_m) for p in positions], 60.0, 120.0)


def _marked(result: Result, title: str, image: Signal, apparent: bool) -> dict[str, Any]:
    """Image with outlines of ships.

    They mark true positions, and if `apparent` also positions and replicas in an image focused for
    a stationary scene.
    """
    ships = list(_shown(result).values())
    lines = {"true position": _boxes([_true(one) for one in ships])}
    if apparent:
        moving = [one for one in ships if one.ship.moves]
        lines["apparent position"] = _boxes([ImagePosition.of(one.centre) for one in moving])
        lines["false target"] = _boxes([one.replica for one in moving])
    return {"title": title, "signal": _over_sea(image), "lines": lines}


def _steps(result: Result) -> dict[str, Signal]:
    """Images after each step of the recommended method before the detection of ships.

    A step is a stage that changes the channels, from the removal of the transmit range on, because
    nothing is focused before. The last image is that of all channels. Before it is the image of a
    single channel, whose Doppler bands overlap.
    """
    chain, view = result.bench.chains["recommended"], result.first.outcomes["recommended"].judged.view
    stage, names = at_rest(chain), list(view.steps)
    first = next((i for i, name in enumerate(names) if isinstance(chain.stages[name], RemoveTransmitRange)), 0)
    images = {f"after {name}": stage(view.steps[name]) for name in names[first:-1]}
    middle = len(stage.radar.channel_m) // 2
    alone = StationaryImage(replace(stage.radar, channel_m=(0.0,)), LeastSquares(1), stage.form)
    images["one channel"] = alone(view.steps[names[-1]].isel(channel=slice(middle, middle + 1)))
    return images


def _flow(result: Result) -> Drawn:
    made = _made(result).get("recommended")
    if made is None:
        return
    steps = {**_steps(result), "everything at rest": made.conventional, "without moving ships": made.rest}
    parts = [_marked(result, title, image, True) for title, image in steps.items()]
    parts.append(_marked(result, "fused", made.fused, False))
    if made.targets is not None:
        found = {"found": _boxes([ImagePosition.of(target.motion) for target in made.targets if target.ok])}
        parts.insert(-2, {"title": "detected", "signal": _over_sea(made.conventional), "lines": found})
    caption = (
        "Root mean square of blocks; the scale ends 10 dB below the sea. What each stage leaves, focused as if "
        "everything were at rest: a single channel, whose Doppler bands overlap, and all channels, from which the "
        "bands are reconstructed. Ships with a radial velocity are displaced there and have false targets. Then the "
        "echoes of detected ships that move are subtracted, and every one is focused and inserted at its position."
    )
    yield "flow", "Steps of the recommended method", caption, plot.overlays(parts, _UP_DB - _DOWN_DB)


def _methods(result: Result) -> Drawn:
    parts = [_marked(result, name, made.fused, False) for name, made in _made(result).items()]
    if parts:
        caption = (
            "The final image of every method. The inverse of three bands amplifies false targets; setting the extent "
            "of moving ships to zero leaves holes in the sea."
        )
        figures = plot.overlays(parts, _UP_DB - _DOWN_DB)
        yield "methods", "Final images", caption, figures


def _ships(result: Result) -> Drawn:
    parts, made = [], _made(result)
    for name, shown in _shown(result).items():
        for method in (one for one in ("conventional", "recommended") if one in made):
            at = ImagePosition.of(shown.centre) if method == "conventional" else _true(shown)
            reach = zip(("azimuth", "range"), (at.azimuth_m, at.range_m), (150.0, 60.0), strict=True)
            spans = {axis: (middle - half, middle + half) for axis, middle, half in reach}
            parts.append({"title": f"{name}, {method}", "signal": plot.within(made[method].fused, spans), "lines": {}})
    if parts:
        caption = (
            "Each ship at its position in the image focused for a stationary scene (conventional) and at its "
            "true position (recommended), in dB relative to its own peak."
        )
        yield "ships", "Ships", caption, plot.overlays(parts)


DRAW_CASE = (_flow, _methods, _ships)
