"""Moving ships on a sea before a GEO spaceborne-airborne bistatic radar: figure 18 of Remote Sens.
2020, 12, 1703.

Ship 1 rests, ship 2 closes at 10 m/s, ship 3 closes at 10 m/s and moves along track at 10 m/s. In
an image focused for targets at rest, approaching ships are displaced and repeated; the method of
figure 13 detects moving targets, removes their echoes, and images them at their true positions. The
source prints azimuth on x = (V_R - u_a) t of each target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from torchsar import plot
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_bistatic
from torchsar.multichannel import Detector, Extraction, ImageMovers, PointMotion, RemoveTransmitRange, SceneImage
from torchsar.multichannel.body import Body
from torchsar.reproduce.geo.sensor import RADAR as SENSOR
from torchsar.reproduce.geo.sensor import TRANSMIT_RANGE
from torchsar.reproduce.item import Check, Item, number, seeds_of, statement
from torchsar.scene import BandLimited, BistaticWorld, Fleet, KSea, Ship

# middle of the swath of figure 18; the echo contains the range to the satellite
RADAR = replace(SENSOR, reference_range_m=5700.0, transmit_range=TRANSMIT_RANGE)
# published displacement and distance of the false target (m)
PUBLISHED = {"ship 2": (216.3, 934.58), "ship 3": (167.6, 723.99)}
# velocities and ranges are published; positions along track are chosen
SHIPS = {
    "ship 1": Ship(0.0, 0.0, -300.0, 0.0),
    "ship 2": Ship(10.0, 0.0, 0.0, 790.0),
    "ship 3": Ship(10.0, 10.0, 100.0, -840.0),
}
# ships of the reduced form
SMALL = {"ship 2": Ship(10.0, 0.0, 0.0, 0.0, length_m=40.0, range_cells=2, count=6)}
# powers of a ship in its range line, and of the sea, relative to noise, by choice
SCR_DB, CNR_DB = 10.0, 30.0
SPEEDS = ("u_r_m_s", "u_a_m_s")


class _Seen(NamedTuple):
    """True ships, the image of the first draw, and what was found in every draw."""

    ships: Mapping[str, Ship]
    made: SceneImage
    bodies: list[list[Body]]


def _sea(small: bool) -> _Seen:
    """Simulate and image the published scene; in the reduced form, one ship in a few seconds."""
    pulses, lines, gate_s, scr_db, ships, flow = 2160, 512, 4.5, SCR_DB, SHIPS, ImageMovers(RADAR)
    if small:
        extraction, detector = Extraction(60.0, 30.0, 2.0, 0.4), Detector(suppressed_m_s=())
        flow = ImageMovers(RADAR, extraction, detector, u_a_half_m_s=12.0)
        pulses, lines, gate_s, scr_db, ships = 540, 120, 2.0, 2 * SCR_DB, SMALL
    fleet = Fleet({name: replace(ship, level_db=scr_db) for name, ship in ships.items()})
    world = BistaticWorld(fleet, BandLimited(gate_s), KSea(shape=1.5), snr_db=CNR_DB)
    first, bodies = None, []
    for seed in seeds_of(small):
        recording, _ = simulate_bistatic(RADAR, world, pulses, lines, Draws(seed))
        made = flow(RemoveTransmitRange(RADAR)(recording.signal))
        first = first or made
        bodies.append(list(made.bodies))
    assert first is not None
    return _Seen(ships, first, bodies)


def _nearest(ship: Ship, bodies: list[Body]) -> Body | None:
    """Body that was found nearest to the middle of a ship, within 50 m."""
    middle_m = RADAR.reference_range_m + ship.range_m
    away = [float(torch.hypot(b.motion.y0_m - ship.azimuth_m, b.motion.range_m - middle_m)) for b in bodies]
    return bodies[away.index(min(away))] if away and min(away) < 50 else None


def _predicted(motion: PointMotion) -> tuple[float, float]:
    """Displacement and distance of the first false target of a motion, on the axis of the
    source.
    """
    v = float(motion.along_m_s)
    return v * float(motion.image_s) - float(motion.y0_m), RADAR.prf_hz * RADAR.wavelength_m * float(motion.range_m) / v


def _levelled(image: Signal) -> Signal:
    """Blocks of pixels relative to their median, limited to -10 to 25 dB."""
    view = plot.quicklook(image, 300)
    level = view.data.abs() / view.data.abs().median()
    return view.with_data(level.clamp(10**-0.5, 10**1.25).to(torch.complex64))


def _figure_18(seen: _Seen, path: Path) -> list[Check]:
    """Draw Figure 18, and check for each ship with a slant-range speed that its velocity is found.

    The displacement and the distance of the first false target, predicted from the velocity found,
    must agree with the published values.
    """
    middles = [(float(ship.range_m) + RADAR.reference_range_m, float(ship.azimuth_m)) for ship in seen.ships.values()]
    lines = {"true position": plot.boxes(middles, 60, 120)}
    named = {"everything at rest": seen.made.conventional, "without movers": seen.made.rest, "fused": seen.made.fused}
    parts = [{"title": title, "signal": _levelled(image), "lines": lines} for title, image in named.items()]
    plot.save(plot.overlays(parts, 35.0), path, columns=3)
    checks = []
    for name, ship in ((name, ship) for name, ship in seen.ships.items() if ship.u_r_m_s):
        found = [body for body in (_nearest(ship, bodies) for bodies in seen.bodies) if body is not None]
        off = [max(abs(float(getattr(b.motion, of) - getattr(ship, of))) for b in found) for of in SPEEDS if found]
        ours = f"in {len(found)} of {len(seen.bodies)} scenes" + (
            f", off by {off[0]:.2f}, {off[1]:.2f} m/s or less" if off else ""
        )
        close = len(found) == len(seen.bodies) and off[0] < 0.5
        claim = f"{name} at {ship.u_r_m_s:g}, {ship.u_a_m_s:g} m/s"
        checks.append(statement(claim, "focused", close, ours, len(seen.bodies)))
        if found and len(seen.ships) > 1:
            words = ("displacement (m)", "distance of the false target (m)")
            rows = zip(words, PUBLISHED[name], zip(*(_predicted(b.motion) for b in found), strict=True), strict=True)
            checks += [number(f"{name}: {what}", theirs, values, 0.02 * theirs) for what, theirs, values in rows]
    return checks


ITEMS = (Item("Figure 18", "moving ships on a sea", of=_sea, make=_figure_18),)
