"""Targets that move on their own are seen where they decide a value."""

from __future__ import annotations

import pytest
import torch

from torchsar import Draws, Outcome, Signal
from torchsar.compensate import DopplerCentroid, MirrorProduct, PhaseIncrement, RadialMotion, phase_increment
from torchsar.compensate.doppler import agreeing_cells
from torchsar.echo import simulate, simulate_ladar
from torchsar.scene import Dwell, LadarWorld, Points, Polynomial, RandomPoints, StripmapWorld
from torchsar.study.bench.ladars import MOTION, PERIODS
from torchsar.study.bench.ladars import RADAR as LADAR
from torchsar.study.bench.strips import CELLS, LINES, RADAR

TRIALS = 2
SHIP = Points([0.0, 6.0, -7.0, 12.0], [0.0, 4.0, -3.0, 8.0], random_phase=True)


def mixed(land: torch.Tensor, ship: torch.Tensor, over_db: float) -> torch.Tensor:
    """Sum of both, with the energy of the ship `over_db` above that of the land."""
    dims = tuple(range(1, land.ndim))
    energy = [x.abs().square().sum(dims, keepdim=True) for x in (land, ship)]
    return (land + ship * (energy[0] / energy[1]).sqrt() * 10 ** (over_db / 20)).to(torch.complex64)


def strip(over_db: float, across_hz: float) -> Signal:
    """Land of 200 points, and a ship that moves across the track."""

    def seen(scene, doppler_hz: float, velocity_m_s: float, seed: int, snr_db: float | None) -> Signal:
        world = StripmapWorld(scene, Dwell(1.0), velocity_m_s=velocity_m_s, doppler_hz=doppler_hz, snr_db=snr_db)
        return simulate(RADAR, world, LINES, CELLS, Draws(seed, trials=range(TRIALS)))[0].signal

    land = seen(RandomPoints(200, 330.0, 250.0), 5.0, 120.0, 1, 10.0)
    ship = seen(SHIP, 5.0 + across_hz, 120.0, 2, None)
    return land.with_data(mixed(land.data, ship.data, over_db))


@pytest.mark.parametrize("stage", [PhaseIncrement, DopplerCentroid])
def test_a_ship_that_moves_across_the_track_is_named(stage) -> None:
    ship, alone = (stage(RADAR)(strip(db, across_hz=110.0)) for db in (12.0, -60.0))
    assert bool((ship["doppler_baseband_hz"] > 90).all()) and not bool(ship.ok.any())
    assert stage is DopplerCentroid or bool((ship.outcome == Outcome.PARTS_DISAGREE).all())
    assert bool((alone.outcome == Outcome.OK).all())


def test_the_median_of_range_cells_resists_a_ship_and_a_hot_cell() -> None:
    both, alone = strip(0.0, across_hz=110.0), strip(-60.0, across_hz=110.0)
    mean, median = (DopplerCentroid(RADAR, over=over) for over in ("mean", "median"))
    assert bool((mean(both)["doppler_hz"] > 50).all())
    found = median(both)
    assert bool(((found["doppler_hz"] - 5).abs() < 6).all()) and not bool(found.ok.any())
    assert bool(median(alone).ok.all())
    turns = 0.1 * torch.arange(64)[:, None] + torch.rand(32, generator=torch.Generator().manual_seed(1))
    hot = torch.polar(torch.ones(64, 32), 2 * torch.pi * turns)
    hot[:, 5] = 100 * torch.polar(torch.ones(64), 2.0 * torch.arange(64))
    for cells, expected_hz in ((hot, 318.0), (agreeing_cells(hot), 100.0)):
        assert float(phase_increment(cells, 1000.0)["doppler_baseband_hz"]) == pytest.approx(expected_hz, abs=1.0)
    with pytest.raises(ValueError, match="over must be 'mean' or 'median' of the range cells, got 'sum'"):
        DopplerCentroid(RADAR, over="sum")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("stage", [MirrorProduct, RadialMotion])
@pytest.mark.parametrize("over_db", [-10.0, 10.0])
def test_two_velocities_in_one_beam_are_named(stage, over_db: float) -> None:
    def seen(points: Points, motion, seed: int, snr_db: float | None) -> Signal:
        world = LadarWorld(points, motion=motion, snr_db=snr_db)
        return simulate_ladar(LADAR, world, PERIODS, Draws(seed, trials=range(TRIALS)))[0].signal

    first = seen(Points([0.0, 0.03, -0.05], [0.4, 0.9, 1.3], random_phase=True), MOTION, 1, 10.0)
    other = seen(Points([0.0], [0.7], random_phase=True), (Polynomial([0.7, 20.0]), MOTION[1]), 2, None)
    both = first.with_data(mixed(first.data, other.data, over_db))
    assert bool((stage(LADAR)(both).outcome == Outcome.PARTS_DISAGREE).all())
    assert bool((stage(LADAR)(first).outcome == Outcome.OK).all())
