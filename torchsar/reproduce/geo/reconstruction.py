"""Reconstruction of the Doppler band of moving points from few channels: figures 10 to 12 and 17 of
Remote Sens. 2020, 12, 1703.

The data are azimuth-only and without noise. "Band-limited" means that the target is seen for 4.5 s.
"Pattern" means that it is seen through the pattern of the elements, in records of 20 s, so that
replicas up to three pulse rates away have their own positions. MFTA is the amplitude of the largest
false target relative to the peak. N is the number of Doppler bands that are reconstructed. No
number here is random.

Moving ships on a sea before a GEO spaceborne-airborne bistatic radar: figure 18 of Remote Sens.
2020, 12, 1703.

Ship 1 rests, ship 2 closes at 10 m/s, ship 3 closes at 10 m/s and moves along track at 10 m/s. In
an image focused for targets at rest, approaching ships are displaced and repeated; the method of
figure 13 detects moving targets, removes their echoes, and images them at their true positions. The
source prints azimuth on x = (V_R - u_a) t of each target.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_bistatic
from torchsar.metrics import replica_level, replica_zones
from torchsar.multichannel import (
    Detector,
    Extraction,
    FocusAzimuth,
    ImageMovers,
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    Reconstruct,
    RemoveTransmitRange,
    SceneImage,
)
from torchsar.multichannel.body import Body
from torchsar.multichannel.reconstruct import Rebuild
from torchsar.multichannel.velocity.sir import Intensity, signal_intensity
from torchsar.reproduce.geo.sensor import BANDWIDTH_HZ, INTEGRATION_S, RADAR, TRANSMIT_RANGE
from torchsar.reproduce.item import Check, Item, falling, misprint, number, seeds_of, statement
from torchsar.scene import BandLimited, BistaticWorld, Fleet, KSea, MovingPoints, Pattern, Ship
from torchsar.scene.bistatic import Gate

# length of a record (s) that contains all replicas
RECORD_S = 20.0
GATES: dict[str, Gate] = {"band-limited": BandLimited(INTEGRATION_S), "pattern": Pattern()}
# true and assumed velocities of figures 10 and 11
TRUE_M_S, GUESSES_M_S = 10.0, (5.0, 8.0, 10.0)
Closing = tuple[dict[str, Signal], Tensor]
# level (dB) below which the false targets are, according to the text
PUBLISHED_MFTA = {"band-limited": -60.0, "pattern": -25.0}


# reconstruction of the bands, and True if it uses the velocity of the target, False if zero in its
# place
METHODS: dict[str, tuple[Rebuild, bool]] = {
    "conventional, N = 3": (LeastSquares(3), False),
    "conventional, N = 2": (LeastSquares(2), False),
    "proposed, N = 3": (LeastSquares(3), True),
    "proposed, N = 2": (LeastSquares(2), True),
    "proposed, MMSE, N = 5": (MinimumMeanSquare(5), True),
}


def _simulated(u_r_m_s: Tensor, gate: Gate, seconds: float) -> Signal:
    """Simulate channels (trial, channel, pulse) of one target per trial."""
    at_rest = torch.zeros(len(u_r_m_s), 1, dtype=torch.float64)
    world = BistaticWorld(MovingPoints(u_r_m_s[:, None], at_rest, at_rest, at_rest), gate)
    draws = Draws(1, trials=range(len(u_r_m_s)))
    return simulate_bistatic(RADAR, world, round(seconds * RADAR.prf_hz), None, draws, dtype=torch.complex128)[0].signal


def _spectrum(data: Signal, rebuild: Rebuild, u_r_m_s: Tensor | float) -> Signal:
    with warnings.catch_warnings():
        # the effects of a poor condition are the subject of this module
        warnings.simplefilter("ignore")
        return Reconstruct(RADAR, rebuild)(data, u_r_m_s)


def _replicas_db(data: Signal, u_r_m_s: Tensor, rebuild: Rebuild, moving: bool, gate: Gate) -> Tensor:
    """Level of the largest false target (MFTA) within three pulse rates, (trial,)."""
    assumed = u_r_m_s if moving else torch.zeros_like(u_r_m_s)
    image = FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(_spectrum(data, rebuild, assumed), assumed)
    seen = INTEGRATION_S if isinstance(gate, BandLimited) else None
    zones = replica_zones(
        RADAR, rebuild.bands, u_r_m_s, integration_s=seen, focused_at=(assumed, 0.0), orders=(1, 2, 3)
    )
    return replica_level(image.data, image.axis("azimuth").step, zones)["mfta_db"]


def _draw_spectra(signal: Signal, path: Path) -> None:
    """Draw spectra of a target of 10 m/s that are reconstructed with assumed velocities, over
    Doppler from zero.

    Dashed lines mark the processed band around the assumed velocity.
    """
    parts = []
    for guess in GUESSES_M_S:
        rebuilt = _spectrum(signal, LeastSquares(3), guess)
        centre = guess / RADAR.wavelength_m
        curve = (plot.array(rebuilt.axis("doppler").values() + centre), plot.decibel(rebuilt.data[0]))
        parts.append(
            {
                "series": {"spectrum": curve},
                "xlabel": "Doppler (Hz)",
                "ylabel": "amplitude (dB)",
                "title": f"rebuilt with {guess:g} m/s",
                "marks": {"processed band": centre - BANDWIDTH_HZ / 2, "its end": centre + BANDWIDTH_HZ / 2},
                "ylim": (-60.0, 20.0),
            }
        )
    plot.save(plot.panels(parts), path, columns=3)


def _intensity(signal: Signal, guesses: Tensor) -> Intensity:
    """Intensities of the reconstructed signal of one trial for each assumed speed u_r."""
    data = signal.data[0, None, ..., None].expand(len(guesses), -1, -1, -1)
    return signal_intensity(data, RADAR, PointMotion.of(RADAR, data, guesses), LeastSquares(3), BANDWIDTH_HZ)


def _ratios_db(found: Intensity) -> dict[str, Tensor]:
    return {
        name: 10 * torch.log10(ratio)
        for name, ratio in (("Gamma1", found.power_ratio), ("Gamma2", found.amplitude_ratio), ("Gamma", found.ratio))
    }


def _closing(small: bool) -> Closing:
    """Channels of the target of figures 10 to 12 for each gate, and the velocities of figure 12."""
    moving = torch.tensor([TRUE_M_S], dtype=torch.float64)
    seconds = {"band-limited": 8.0, "pattern": RECORD_S}
    data = {name: _simulated(moving, gate, seconds[name]) for name, gate in GATES.items()}
    return data, (torch.linspace(0, 20, 41 if small else 201, dtype=torch.float64))


def _rebuilt(gate: str, seen: Closing, path: Path) -> list[Check]:
    """Make figure 10 or 11: the share of the power near the centroid for each assumed velocity."""
    _draw_spectra(seen[0][gate], path)
    ratios = _ratios_db(_intensity(seen[0][gate], torch.tensor(GUESSES_M_S, dtype=torch.float64)))["Gamma1"]
    levels = {f"{guess:g} m/s": float(ratio) for guess, ratio in zip(GUESSES_M_S, ratios, strict=True)}
    return [falling("power inside over outside the processed band (dB)", levels, rising=True)]


def _figure_12(seen: Closing, path: Path) -> list[Check]:
    parts, checks = [], []
    for gate, signal in seen[0].items():
        curves = _ratios_db(_intensity(signal, seen[1]))
        series = {name: (plot.array(seen[1]), plot.array(curve)) for name, curve in curves.items()}
        parts.append(
            {"series": series, "xlabel": "u_r of the reconstruction (m/s)", "ylabel": "ratio (dB)", "title": gate}
        )
        step = float(seen[1][1] - seen[1][0])
        peak = float(seen[1][curves["Gamma"].argmax()])
        checks.append(number(f"{gate}: velocity of the largest ratio (m/s)", TRUE_M_S, peak, step))
        over = {name: float(curves[name].max() - curves[name][0]) for name in ("Gamma2", "Gamma1", "Gamma")}
        ours = ", ".join(f"{name} {value:.1f} dB" for name, value in over.items()) + " above 0 m/s"
        steepest = max(over.values()) == over["Gamma"]
        checks.append(statement(f"{gate}: curves", "that of Gamma is the steepest", steepest, ours))
    plot.save(plot.panels(parts), path)
    return checks


def _over_velocity(small: bool) -> tuple[Tensor, dict[str, dict[str, Tensor]]]:
    """Velocities (m/s), and largest false targets (dB) by gate and method, (speed,)."""
    few = [-20.0, -10.0, -2.0, 0.0, 2.0, 10.0, 20.0]
    speeds = torch.tensor(few, dtype=torch.float64) if small else torch.linspace(-20, 20, 41, dtype=torch.float64)
    found = {}
    for name, gate in GATES.items():
        data = _simulated(speeds, gate, RECORD_S)
        found[name] = {label: _replicas_db(data, speeds, *method, gate) for label, method in METHODS.items()}
    return speeds, found


def _figure_17(seen: tuple[Tensor, dict[str, dict[str, Tensor]]], path: Path) -> list[Check]:
    speeds, found = seen
    parts = [
        {
            "series": {label: (plot.array(speeds), plot.array(levels)) for label, levels in methods.items()},
            "xlabel": "u_r (m/s)",
            "ylabel": "MFTA (dB)",
            "title": gate,
            "ylim": (-80.0, 45.0),
        }
        for gate, methods in found.items()
    ]
    plot.save(plot.panels(parts), path)
    shown = {
        "band-limited": ("proposed, N = 3", "proposed, N = 2"),
        "pattern": ("proposed, N = 3", "proposed, MMSE, N = 5"),
    }
    table_4_db = -47.56  # largest level in Table 4, by the method with three bands
    checks = []
    for gate, methods in shown.items():
        for method in methods:
            level, worst = PUBLISHED_MFTA[gate], float(found[gate][method].max())
            ours, claim = f"at most {worst:.1f} dB", f"below {level:g} dB at all speeds"
            if (gate, method) == ("band-limited", "proposed, N = 3"):
                ours = f"{ours}; Table 4 of the paper prints {table_4_db:g} dB"
                checks.append(misprint(f"{gate}, {method}", claim, worst > level and level < table_4_db, ours))
            else:
                checks.append(statement(f"{gate}, {method}", claim, worst < level, ours))
    return checks


# middle of the swath of figure 18; the echo contains the range to the satellite
OCEAN_RADAR = replace(RADAR, reference_range_m=5700.0, transmit_range=TRANSMIT_RANGE)
# published displacement and distance of the false target (m)
PUBLISHED_M = {"ship 2": (216.3, 934.58), "ship 3": (167.6, 723.99)}
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
    pulses, lines, gate_s, scr_db, ships, flow = 2160, 512, 4.5, SCR_DB, SHIPS, ImageMovers(OCEAN_RADAR)
    if small:
        extraction, detector = Extraction(60.0, 30.0, 2.0, 0.4), Detector(suppressed_m_s=())
        flow = ImageMovers(OCEAN_RADAR, extraction, detector, u_a_half_m_s=12.0)
        pulses, lines, gate_s, scr_db, ships = 540, 120, 2.0, 2 * SCR_DB, SMALL
    fleet = Fleet({name: replace(ship, level_db=scr_db) for name, ship in ships.items()})
    world = BistaticWorld(fleet, BandLimited(gate_s), KSea(shape=1.5), snr_db=CNR_DB)
    first, bodies = None, []
    for seed in seeds_of(small):
        recording, _ = simulate_bistatic(OCEAN_RADAR, world, pulses, lines, Draws(seed))
        made = flow(RemoveTransmitRange(OCEAN_RADAR)(recording.signal))
        first = first or made
        bodies.append(list(made.bodies))
    assert first is not None
    return _Seen(ships, first, bodies)


def _nearest(ship: Ship, bodies: list[Body]) -> Body | None:
    """Body that was found nearest to the middle of a ship, within 50 m."""
    middle_m = OCEAN_RADAR.reference_range_m + ship.range_m
    away = [float(torch.hypot(b.motion.y0_m - ship.azimuth_m, b.motion.range_m - middle_m)) for b in bodies]
    return bodies[away.index(min(away))] if away and min(away) < 50 else None


def _predicted(motion: PointMotion) -> tuple[float, float]:
    """Displacement and distance of the first false target of a motion, on the axis of the
    source.
    """
    v = float(motion.along_m_s)
    return v * float(motion.image_s) - float(motion.y0_m), OCEAN_RADAR.prf_hz * OCEAN_RADAR.wavelength_m * float(
        motion.range_m
    ) / v


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
    middles = [
        (float(ship.range_m) + OCEAN_RADAR.reference_range_m, float(ship.azimuth_m)) for ship in seen.ships.values()
    ]
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
            rows = zip(words, PUBLISHED_M[name], zip(*(_predicted(b.motion) for b in found), strict=True), strict=True)
            checks += [number(f"{name}: {what}", theirs, values, 0.02 * theirs) for what, theirs, values in rows]
    return checks


ITEMS = (
    Item(
        "Figure 10",
        "spectra rebuilt with wrong and right velocities",
        of=_closing,
        make=partial(_rebuilt, "band-limited"),
    ),
    Item("Figure 11", "the same through the antenna pattern", of=_closing, make=partial(_rebuilt, "pattern")),
    Item("Figure 12", "signal intensity ratios over the velocity", of=_closing, make=_figure_12),
    Item("Figure 17", "largest false target over the velocity", _over_velocity, _figure_17),
    Item("Figure 18", "moving ships on a sea", of=_sea, make=_figure_18),
)
