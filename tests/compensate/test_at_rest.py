"""Estimates name what is at rest where it holds the energy, and are right once it is removed."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from tests.compensate.scenes import noisy, still, turned, white
from torchsar.compensate import DopplerCentroid, MirrorProduct, PhaseIncrement, SegmentedInterference, autofocus, sca
from torchsar.core import Draws, Outcome, Recording, Signal
from torchsar.echo import Leakage, apply_impairments, simulate_ladar
from torchsar.echo.receiver import GroundAtRest
from torchsar.metrics import phase_rmse
from torchsar.radar import TriangularLadar
from torchsar.repair import remove_constant, remove_tones
from torchsar.scene import LadarWorld, Points, Polynomial
from torchsar.study.bench import ladars, pulses, strips

TRIALS = 6


def impaired(signal: Signal, radar, impairment) -> torch.Tensor:
    draws = Draws(5, trials=range(len(signal.data)))
    return apply_impairments(Recording(signal, radar), {"it": impairment}, draws)[0].signal.data


def scene() -> tuple[Signal, torch.Tensor]:
    phase = white(TRIALS, pulses.PULSES, 4)
    return pulses.signal(turned(noisy(still(TRIALS, pulses.PULSES, 48, 1, 0.8, 3), 20.0, 5), phase)), phase


@pytest.mark.slow
@pytest.mark.parametrize("level_db", [3.0, 10.0, 30.0])
@pytest.mark.parametrize(
    ("effect", "remove"),
    [
        (lambda level: Leakage(level), remove_constant),
        (lambda level: Leakage(level, 0.15, 0.21), remove_tones),
        (lambda level: Leakage(level + 17, position=0.3), lambda x: remove_constant(x, "cell")),
        (lambda level: GroundAtRest(level), lambda x: remove_constant(x, "cell", 8)),
    ],
    ids=["constant", "spur", "one cell", "ground"],
)
def test_phases_of_pulses(effect: Callable, remove: Callable, level_db: float) -> None:
    signal, phase = scene()
    found = autofocus(signal.data)
    assert found.ok.all() and not (found.info["gain_of_rest"] > 1.5).any()
    data = impaired(signal, pulses.LADAR, effect(level_db))
    for method in (autofocus, sca):
        assert (method(data).outcome == Outcome.AT_REST).all()
    again = autofocus(remove(data))
    assert again.ok.all() and phase_rmse(again["phase_rad"], phase).max() < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("level_db", [-20.0, 0.0, 30.0])
@pytest.mark.parametrize(("spur", "remove"), [((0.0, 0.0), remove_constant), ((0.15, 0.21), remove_tones)])
def test_doppler(spur: tuple[float, float], remove: Callable, level_db: float) -> None:
    batch = strips.strip(doppler_hz=60.0)(TRIALS, 3)
    data = impaired(batch.data, strips.RADAR, Leakage(level_db, *spur))
    for stage in (PhaseIncrement(strips.RADAR), DopplerCentroid(strips.RADAR)):
        expected = Outcome.OK if level_db < -10 else Outcome.AT_REST
        assert (stage(batch.data.with_data(data)).outcome == expected).all()
        found = stage(batch.data.with_data(remove(data)))
        clean, name = stage(batch.data), "doppler_baseband_hz"
        assert found.ok.all() and (found[name] - clean[name]).abs().max() < 0.5


@pytest.mark.parametrize("spur_db", [0.0, 10.0, 30.0])
@pytest.mark.parametrize("constant_db", [-30.0, 0.0, 10.0])
def test_a_ladar_names_spurs_and_is_right_once_they_are_removed(spur_db: float, constant_db: float) -> None:
    batch = ladars.own()(TRIALS, 3)
    data = impaired(
        batch.data.with_data(impaired(batch.data, ladars.RADAR, Leakage(constant_db))),
        ladars.RADAR,
        Leakage(spur_db, 0.11, 0.23),
    )
    for stage in (MirrorProduct(ladars.RADAR), SegmentedInterference(ladars.RADAR)):
        assert (stage(batch.data.with_data(data)).outcome == Outcome.AT_REST).all()
        assert stage(batch.data.with_data(remove_tones(data))).ok.all()


@pytest.mark.parametrize("range_m", [0.0, 0.005, 0.1])
def test_a_target_of_uniform_motion_is_no_tone_of_the_receiver(range_m: float) -> None:
    sal = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    world = LadarWorld(Points([0.0], [range_m]), [Polynomial([0.2])], snr_db=10.0)
    signal = simulate_ladar(sal, world, 96, draws=Draws(1, trials=range(TRIALS)))[0].signal
    for stage in (MirrorProduct(sal), SegmentedInterference(sal)):
        assert stage(signal).ok.all()


@pytest.mark.parametrize("level_db", [-10.0, 0.0, 30.0])
def test_velocity_of_a_ladar(level_db: float) -> None:
    batch = ladars.own()(TRIALS, 3)
    data = impaired(batch.data, ladars.RADAR, Leakage(level_db))
    for stage in (MirrorProduct(ladars.RADAR), SegmentedInterference(ladars.RADAR)):
        expected = Outcome.OK if level_db < 0 else Outcome.AT_REST
        assert (stage(batch.data.with_data(data)).outcome == expected).all()
        clean, again = stage(batch.data), stage(batch.data.with_data(remove_constant(data)))
        errors = [ladars.slow(found["velocity_m_s"], batch.truth["velocity_m_s"]) for found in (clean, again)]
        assert again.ok.all() and (errors[1] < 1.1 * errors[0]).all()
