"""Slant-range velocities beyond the ambiguity of three channels.

    python scripts/geo_ambiguity.py [--seed 1]

Channels tell the velocity of a target modulo lambda PRF. The walk through range tells how often
that must be added.
"""

from __future__ import annotations

import argparse
import warnings

from torchsar.core import Chain, Draws, Signal, use
from torchsar.echo import simulate_bistatic
from torchsar.multichannel import (
    CorrectMigration,
    Dwell,
    Interferometry,
    Keystone,
    MovingPointVelocity,
    WalkAmbiguity,
)
from torchsar.radar import BistaticRadar
from torchsar.reproduce.geo.sensor import INTEGRATION_S, RADAR
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

RECORD_S = 5.0
AMBIGUOUS_M_S = (25.0, -35.0)


def simulated(radar: BistaticRadar, u_r_m_s: float, snr_db: float, draws: Draws, n_range: int | None = None) -> Signal:
    """Channels (trial, channel, pulse[, range]) of a target; snr_db: after range compression."""
    world = BistaticWorld(MovingPoints([u_r_m_s], [0.0], [0.0], [0.0]), BandLimited(INTEGRATION_S), snr_db=snr_db)
    return simulate_bistatic(radar, world, round(RECORD_S * radar.prf_hz), n_range, draws)[0].signal


def resolved_by_walk(u_r_m_s: float, draws: Draws) -> tuple[float, float]:
    """The walk through range tells how often lambda PRF must be added to what the channels tell:
    that number, and what interferometry finds from there.
    """
    aperture = Dwell(INTEGRATION_S)
    migrate = use(CorrectMigration(RADAR, Keystone(whole_swath=False)), ambiguity="walk")
    chain = Chain(walk=WalkAmbiguity(RADAR), migrate=migrate, velocity=Interferometry(RADAR, aperture))
    found = chain.trace(simulated(RADAR, u_r_m_s, 10.0, draws, n_range=96))
    number, seen = found.values["walk.ambiguity"], found.values["velocity.u_r_m_s"]
    again = Interferometry(RADAR, aperture)(found.signal, seen + number * RADAR.ambiguous_velocity_m_s)
    return float(number[0]), float(again["u_r_m_s"][0])


def beyond_ambiguity(draws: Draws) -> None:
    """Velocities beyond +-21.6 m/s, at 10 dB after range compression."""
    rows: dict[str, list[float]] = {
        "interferometry alone": [],
        "bank and likelihood": [],
        "range walk: pulse rates": [],
        "range walk, interferometry": [],
    }
    for u_r in AMBIGUOUS_M_S:
        here = draws.for_trials([0]).part(f"{u_r:g} m/s")
        line = simulated(RADAR, u_r, 10.0, here)
        alone, bank = (
            stage(line)["u_r_m_s"]
            for stage in (
                Interferometry(RADAR, Dwell(INTEGRATION_S)),
                MovingPointVelocity(RADAR, Dwell(INTEGRATION_S), u_a_m_s=0.0),
            )
        )
        for row, value in zip(
            rows.values(), (float(alone[0]), float(bank[0]), *resolved_by_walk(u_r, here)), strict=True
        ):
            row.append(value)
    print(
        f"{f'true u_r, known modulo {RADAR.ambiguous_velocity_m_s:.1f} m/s':34}"
        + "".join(f"{f'{u_r:g} m/s':>10}" for u_r in AMBIGUOUS_M_S)
    )
    for name, row in rows.items():
        print(f"{name:34}" + "".join(f"{x:>10.2f}" for x in row))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # interferometry sees that it is whole pulse rates off
        beyond_ambiguity(Draws(options.seed))


if __name__ == "__main__":
    main()
