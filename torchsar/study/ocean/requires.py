"""`torchsar requires` for ships on a sea: limits of each method, and what the scene requires of its
model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchsar.focus.ladar_requirements import Limit
from torchsar.multichannel.requirements import MultichannelUse, multichannel_limits, multichannel_requirements
from torchsar.scene import BandLimited
from torchsar.study.cases import refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.geo.requires import Needs
from torchsar.study.limits import heed, write_needs
from torchsar.study.ocean.build import check
from torchsar.study.ocean.sections import OceanConfig
from torchsar.study.ocean.stages import MoversImage
from torchsar.study.ocean.trials import Bench, Way
from torchsar.study.settings.errors import ConfigError

_PATTERN_S = 4.5
# no keystone transform, and bands are told apart only of what is at rest: movers are pictured
# without
_NOT_HERE = (
    "tone left for the keystone transform",
    "condition number within the velocities",
    "singular speeds along track within the search",
)


def requires(loaded: Loaded, out: Path | None) -> str:
    """Both tables of every case of a simulation as text, predicted from the config alone.

    With `out`: config.yaml, requires.json and requires.txt there.
    """
    refuse_recordings(loaded)
    check(loaded)
    return write_needs(loaded, out, needs_of)


def heed_limits(loaded: Loaded, case: str) -> None:
    """Refuse or warn of what the case goes beyond, see `heed`."""
    needs = needs_of(loaded)
    assert isinstance(loaded.config, OceanConfig)
    shown = set(loaded.config.beyond_limits)
    heed(loaded, case, list(needs.limits), lambda limit: [name for name in needs.limits[limit] if name not in shown])


def needs_of(loaded: Loaded) -> Needs:
    """Limits of every method with those it concerns, and the rows of the recommended one.

    Raises ConfigError for what radar, world or stages refuse.
    """
    try:
        bench = Bench.of(loaded)
        limits: dict[Limit, list[str]] = {}
        for name, way in bench.ways.items():
            for limit in (*multichannel_limits(bench.ocean.radar, use_of(bench, way)), *_swath_limits(bench, way)):
                if limit.name not in _NOT_HERE:
                    limits.setdefault(limit, []).append(name)
        use = use_of(bench, bench.ways["recommended"])
        rows = multichannel_requirements(bench.ocean.radar, use) if bench.ocean.radar.speed_m_s > use.u_a_m_s[1] else ()
        return Needs(limits, rows)
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from None


def use_of(bench: Bench, way: Way) -> MultichannelUse:
    """How a method uses the radar: what is at rest it rebuilds as such, movers by their own
    velocities without any reconstruction.
    """
    ocean, ships = bench.ocean, list(bench.ocean.ships.values())
    gate = ocean.gate.duration_s if isinstance(ocean.gate, BandLimited) else None
    u_r = min(ship.u_r_m_s for ship in ships), max(ship.u_r_m_s for ship in ships)
    u_a = (min(ship.u_a_m_s for ship in ships), max(ship.u_a_m_s for ship in ships))
    scene: dict[str, Any] = {
        "y0_m": max(abs(ship.azimuth_m) for ship in ships),
        "swath_m": max(abs(ship.range_m) for ship in ships),
        "snr_db": ocean.cnr_db + max(ship.scr_db for ship in ships),
    }
    estimators = ("whitened",) if way.estimates else ()
    return MultichannelUse(
        ocean.pulses,
        gate or _PATTERN_S,
        way.rebuild,
        gate is None,
        u_r,
        u_a,
        clutter=True,
        dtype=ocean.dtype,
        estimators=estimators,
        **scene,
    )


def _swath_limits(bench: Bench, way: Way) -> list[Limit]:
    """A flow looks for movers only where they would lie in the swath whatever their velocity."""
    if not isinstance(way.image, MoversImage):
        return []
    ocean, radar, extraction = bench.ocean, bench.ocean.radar, way.image.flow.extraction
    need = 0.0
    for ship in ocean.ships.values():
        abeam_s = abs(ship.azimuth_m) / radar.speed_m_s
        walk = extraction.range_m + radar.ambiguous_velocity_m_s / 2 * (abeam_s + extraction.integration_s / 2)
        need = max(
            need,
            abs(ship.range_m)
            + walk
            + (extraction.integration_s * radar.speed_m_s) ** 2 / (8 * radar.reference_range_m),
        )
    half = ocean.samples / 2 * radar.range_step_m
    what = "ships beyond the part of the swath in which targets are looked for are not found"
    return [
        Limit(
            "half of the swath about the ships",
            half,
            need,
            "m",
            "warn",
            what,
            "record more range samples, or bring the ships nearer to the middle",
            at_least=True,
        )
    ]
