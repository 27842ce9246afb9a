"""Figures of one scene: bodies against ships, the sea that is left, replicas, and where images of
everything at rest show ships.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Signal
from torchsar.multichannel.body import Body, Extraction, centred_motion, chip_about
from torchsar.multichannel.migration import Frame
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.scene_image import SceneImage
from torchsar.multichannel.stationary import StationaryImage
from torchsar.radar import BistaticRadar
from torchsar.study.ocean.build import Sighted, Vouched, centroid

DEFINITIONS: dict[str, Any] = {
    "snr": (
        "the sea has unit mean power in a range-compressed sample of one channel; scr_db: "
        "mean power of a sample of a ship's lines over it; cnr_db: sea over noise"
    ),
    "velocities": (
        "u_r: closing slant-range speed; u_a: along track, positive with the receiver; y0: "
        "place along track at t = 0, middle pulse; range: closest one of the track at rest"
    ),
    "matching": "a target that was found belongs to the nearest ship in the image of everything at rest, within "
    "metrics.match_m; found: share of ships with one. A ship that is not found "
    "counts as at rest where that image shows it: its errors are minus its velocities and its "
    "displacement, ok is False. false_targets: targets that belong to no ship",
    "u_r_error_m_s": "estimated minus true u_r; u_a_error_m_s alike",
    "position_error_m": "distance, along track and range together, of the place given to a ship from the intensity "
    "centroid of the ship's own echo, without sea and noise, pictured in the same way "
    "by its true velocities: its scatterers have random phases and interfere, and no image shows "
    "the centroid of their powers. along_error_m, range_error_m: its parts, signed",
    "scatterers_error_m": "the same distance from the centroid of the scatterers' powers",
    "image_position_m": "intensity centroid along x = V_R t, near the predicted place, of the image of the ship's own "
    "echo as if it were at rest; displacement_m: that minus the true place y0; "
    "displacement_vt_m: what the motion predicts on the axis x = (V_R - u_a) t, which the source prints",
    "replica_distance_m": "distance on x = V_R t of the stronger first replica from the image itself, centroids of the "
    "same image; replica_distance_vt_m: "
    "PRF lambda R0 / (V_R - u_a), on the axis of the source. A blurred ship that reaches beyond the "
    "rebuilt band loses one end to its replica: measured centroids then lie nearer than predicted",
    "replica_db": "mean power of the final image within 100 m along track and 40 m in range of the strongest "
    "replica one or two pulse rates away, over the sea's in the same lines; the sea "
    "itself has 0 dB, spread by its texture by about 1 dB. replica_before_db: of the image of "
    "everything at rest; replica_left_db: of the difference from the image of what does not move",
    "sea_error_db": "power of the difference of the image without movers from the image of what does not move, over "
    "the power of the latter, within 400 m along track and 30 m in range of where the "
    "image at rest showed the ship; sea_error_before_db: the same without removal. Of ships that move",
    "hole_db": (
        "power of the image without movers within 60 m and 12 m of where the image at rest "
        "showed the ship, over that of the sea there: 0 dB is untouched"
    ),
    "contrast_db": (
        "mean power of the final image within 60 m and 12 m of the true place over the sea's in the same lines"
    ),
    "condition_number": (
        "of the band matrix that rebuilds what is at rest (absent for mmse, which inverts no "
        "such matrix); noise_gain_db: noise of a rebuilt bin against ideal uniform sampling"
    ),
    "seconds": "wall time of the chain of the method a scene",
    "published": "figures of Remote Sens. 2020, 12, 1703, Fig. 18, whose azimuth is x = (V_R - u_a) t",
}
NEAR_M, GATE_M, REPLICA_M = (400.0, 30.0), (60.0, 12.0), (100.0, 40.0)
_SPREAD_M = (150.0, 110.0)


@dataclass(frozen=True)
class Place:
    """Where an image shows something: azimuth x = V_R t and range (m)."""

    azimuth_m: float
    range_m: float

    def window(self, image: Signal, reach_m: tuple[float, float]) -> tuple[Tensor, Tensor]:
        """Rows (row, 1) and columns of an image within reach_m."""
        azimuth, range_ = (axis.values(image.data.device) for axis in image.axes)
        rows, columns = (
            ((azimuth - self.azimuth_m).abs() < reach_m[0]).nonzero(),
            ((range_ - self.range_m).abs() < reach_m[1]).nonzero()[:, 0],
        )
        return rows, columns

    def power(self, image: Signal, reach_m: tuple[float, float]) -> float:
        """Mean power within reach_m, zero outside of the image."""
        cut = image.data[self.window(image, reach_m)]
        return float(cut.abs().square().to(torch.float64).mean()) if cut.numel() else 0.0

    def centroid(self, image: Signal, reach_m: tuple[float, float]) -> Place:
        """Centre of power within reach_m, itself where nothing is."""
        rows, columns = self.window(image, reach_m)
        power = image.data[rows, columns].abs().square().to(torch.float64)
        total = power.sum()
        if not float(total) > 0:
            return self
        azimuth, range_ = (axis.values(image.data.device) for axis in image.axes)
        return Place(
            float((power.sum(1) * azimuth[rows[:, 0]]).sum() / total),
            float((power.sum(0) * range_[columns]).sum() / total),
        )


def shown_at(motion: PointMotion) -> Place:
    """Where the image of everything at rest shows a motion."""
    return Place(motion.speed_m_s * float(motion.image_s), float(motion.closest_m))


@dataclass(frozen=True)
class Sight:
    """What a ship looks like without sea and noise.

    centre: motion of the centroid of its own picture; image, replica: places of the image at rest;
    replica: the strongest of one and two pulse rates; away_m: distance of that of one, measured on
    x = V_R t, and predicted on x = (V_R - u_a) t; scatterers: centroid of powers, y0 and range.
    """

    ship: Vouched
    centre: PointMotion
    image: Place
    replica: Place
    away_m: tuple[float, float]
    scatterers: tuple[float, float]

    def metrics(self) -> dict[str, float]:
        """What only the echo decides."""
        y0, along = float(self.centre.y0_m), float(self.centre.along_m_s)
        places = {
            "image_position_m": self.image.azimuth_m,
            "displacement_m": self.image.azimuth_m - y0,
            "displacement_vt_m": along * float(self.centre.image_s) - y0,
        }
        away = {"replica_distance_m": self.away_m[0], "replica_distance_vt_m": self.away_m[1]}
        return {**places, **away} if self.ship.moves else places


@dataclass(frozen=True)
class Reference:
    """What every method is compared with: images of what does not move, rebuilt by least squares of
    two bands, and what ships look like.
    """

    radar: BistaticRadar
    ships: Mapping[str, Sight]
    still: Signal

    @staticmethod
    def of(radar: BistaticRadar, sighted: Sighted, remove: Any, extraction: Extraction) -> Reference:
        """remove: takes the transmit range out of channels."""
        data = remove(sighted.recording.signal)
        sights = {
            name: _sight(radar, ship, data, remove(ship.echo), extraction) for name, ship in sighted.ships.items()
        }
        return Reference(radar, sights, remove(sighted.still))


def _sight(radar: BistaticRadar, ship: Vouched, data: Signal, echo: Signal, extraction: Extraction) -> Sight:
    image = StationaryImage(radar)(echo)
    shown = shown_at(ship.motion)
    shown = shown.centroid(image, (250.0, 60.0))
    off_vt = radar.prf_hz * radar.wavelength_m * float(ship.motion.range_m) / float(ship.motion.along_m_s)
    off = off_vt * radar.speed_m_s / float(ship.motion.along_m_s)
    first, *_ = places = [_repeated(image, shown, order * off) for order in (1, 2)]
    strongest = max(places, key=lambda place: place.power(image, REPLICA_M))
    away = abs(first.azimuth_m - shown.azimuth_m)
    y0, near = centroid(ship.movers, radar)
    return Sight(
        ship,
        _own_centre(radar, ship.motion, data, echo, extraction),
        shown,
        strongest,
        (away, off_vt),
        (float(y0), float(near)),
    )


def _repeated(image: Signal, shown: Place, off_m: float) -> Place:
    """Where a replica lies so far to either side of the image itself, on the side where it is
    stronger: it is wide in range, since its migration is that of another band.
    """
    sides = [replace(shown, azimuth_m=shown.azimuth_m + side * off_m) for side in (-1, 1)]
    return max(sides, key=lambda place: place.power(image, _SPREAD_M)).centroid(image, _SPREAD_M)


def _own_centre(
    radar: BistaticRadar, motion: PointMotion, data: Signal, echo: Signal, extraction: Extraction
) -> PointMotion:
    """By the picture of the echo alone, weighted against the sea that lies in the data."""
    frame = Frame.of(radar, data)
    chip = chip_about(data.data, frame, motion, extraction)
    return centred_motion(replace(chip, cells=chip_about(echo.data, frame, motion, extraction).cells))


@dataclass(frozen=True)
class Judged:
    """Metrics of one scene by one method: of each ship, and of the whole; and the body of each
    ship, None where it was not found.
    """

    ships: Mapping[str, Mapping[str, float]]
    whole: Mapping[str, float]
    bodies: Mapping[str, Body | None]


def judged(
    made: SceneImage, still: Signal, reference: Reference, match_m: tuple[float, float], estimates: bool
) -> Judged:
    """still: the image, rebuilt as the method rebuilds, of what does not move; estimates: whether
    the method looks for movers.
    """
    found = matched([body for body in made.bodies if bool(body.ok)], reference.ships, match_m)
    ships = {
        name: {**sight.metrics(), **_errors(sight, found[name], estimates), **_levels(sight, made, still)}
        for name, sight in reference.ships.items()
    }
    false = len(made.bodies) - sum(body is not None for body in found.values())
    return Judged(ships, {"false_targets": float(false)} if estimates else {}, found)


def matched(bodies: Sequence[Body], ships: Mapping[str, Sight], match_m: tuple[float, float]) -> dict[str, Body | None]:
    """By ship the body that appears nearest to where the ship does, in units of match_m; each body
    belongs to one ship.
    """
    pairs = []
    for name, sight in ships.items():
        for i, body in enumerate(bodies):
            ship, own = shown_at(sight.centre), shown_at(body.motion)
            away = max(abs(ship.azimuth_m - own.azimuth_m) / match_m[0], abs(ship.range_m - own.range_m) / match_m[1])
            pairs += [(away, name, i)] if away < 1 else []
    found: dict[str, Body | None] = dict.fromkeys(ships)
    taken = set()
    for _, name, i in sorted(pairs):
        if found[name] is None and i not in taken:
            found[name] = bodies[i]
            taken.add(i)
    return found


def _errors(sight: Sight, body: Body | None, estimates: bool) -> dict[str, float]:
    true = sight.centre
    if body is not None:
        u_r, u_a, y0, near = (float(getattr(body.motion, name)) for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m"))
    else:
        u_r, u_a, y0, near = 0.0, 0.0, sight.image.azimuth_m, sight.image.range_m
    along, across = y0 - float(true.y0_m), near - float(true.range_m)
    of_scatterers = math.hypot(y0 - sight.scatterers[0], near - sight.scatterers[1])
    places = {
        "position_error_m": math.hypot(along, across),
        "along_error_m": along,
        "range_error_m": across,
        "scatterers_error_m": of_scatterers,
    }
    if not estimates:
        return places
    errors = {"u_r_error_m_s": u_r - float(true.u_r_m_s), "u_a_error_m_s": u_a - float(true.u_a_m_s)}
    std = {} if body is None or not float(body.u_r_std_m_s) > 0 else {"u_r_std_m_s": float(body.u_r_std_m_s)}
    return {
        **errors,
        **places,
        **std,
        "found": float(body is not None),
        "ok": float(body is not None and bool(body.ok)),
    }


def _db(power: float, reference: float) -> float:
    return 10 * math.log10(max(power, 1e-30) / max(reference, 1e-30))


def _of_lines(place: Place, still: Signal, reach_m: float) -> float:
    """Mean power of what does not move in the lines within reach_m."""
    return place.power(still, (math.inf, reach_m))


def _levels(sight: Sight, made: SceneImage, still: Signal) -> dict[str, float]:
    """What images hold where a ship is, was shown, and repeats."""
    true = Place(float(sight.centre.y0_m), float(sight.centre.range_m))
    levels = {"contrast_db": _db(true.power(made.fused, GATE_M), _of_lines(true, still, GATE_M[1]))}
    if not sight.ship.moves:
        return levels
    left, before = (still.with_data(image.data - still.data) for image in (made.rest, made.conventional))
    shown, again = shown_at(sight.centre), sight.replica
    sea, floor = shown.power(still, NEAR_M), _of_lines(again, still, REPLICA_M[1])
    levels |= {
        "sea_error_db": _db(shown.power(left, NEAR_M), sea),
        "sea_error_before_db": _db(shown.power(before, NEAR_M), sea),
    }
    levels |= {"hole_db": _db(shown.power(made.rest, GATE_M), shown.power(still, GATE_M))}
    replicas = {"replica_db": made.fused, "replica_before_db": made.conventional, "replica_left_db": left}
    return {**levels, **{name: _db(again.power(image, REPLICA_M), floor) for name, image in replicas.items()}}
