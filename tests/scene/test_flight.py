"""Flights of antennas and what navigation records of them."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Draws
from torchsar.scene import (
    CircularPath,
    Flight,
    Jitter,
    Navigation,
    Offset,
    Polynomial,
    RandomWalk,
    Sinusoid,
    StraightPath,
    Sway,
    VibrationSpectrum,
)

F64 = torch.float64
TIME = torch.arange(200, dtype=F64) / 100
SPAN_S = 1.99
DRAWS = Draws(3, trials=range(400))


def test_nominal_paths() -> None:
    straight = StraightPath((1.0, 2.0, 3.0), (10.0, 0.0, -1.0)).position_m(TIME)
    torch.testing.assert_close(straight[100], torch.tensor([11.0, 2.0, 2.0], dtype=F64))
    circle = CircularPath(500.0, 80.0, math.pi / 2, 0.1).position_m(TIME)
    torch.testing.assert_close(circle[:, :2].square().sum(-1), torch.full((200,), 500.0**2, dtype=F64))
    torch.testing.assert_close(circle[0], torch.tensor([0.0, 500.0, 80.0], dtype=F64))
    speed = (circle[1] - circle[0]) * 100
    assert speed[0] == pytest.approx(-50.0, rel=1e-4) and circle[0, 2] == 80


def test_a_flight_is_the_nominal_path_and_motions_per_axis_and_trial() -> None:
    amplitude = torch.linspace(0, 2, 400, dtype=F64)
    flight = Flight(
        StraightPath((0.0, 0.0, 100.0), (50.0, 0.0, 0.0)),
        Sway(y=[Sinusoid(amplitude, 0.5)], z=[VibrationSpectrum(1e-3, 5.0, 20.0), Polynomial([0.2])]),
    )
    place = flight.drawn(DRAWS, SPAN_S).position_m(TIME)
    assert place.shape == (400, 200, 3) and place.dtype == F64
    torch.testing.assert_close(place[:, :, 0], (50 * TIME).expand(400, -1))
    torch.testing.assert_close(place[:, 50, 1], amplitude)
    vibration = place[..., 2] - 100 - 0.2 * TIME
    assert float(vibration.square().mean().sqrt()) == pytest.approx(1e-3, rel=0.03)
    assert Flight(flight.nominal).position_m(TIME).shape == (200, 3)
    with pytest.raises(ValueError, match="pulses at two times or more, got a span of 0 s"):
        flight.drawn(Draws(3), 0.0)
    with pytest.raises(ValueError, match="a VibrationSpectrum is random; call drawn"):
        flight.position_m(TIME)


def test_axes_have_random_numbers_of_their_own() -> None:
    motion = [Jitter(1.0, 0.01)]
    moved = Sway(motion, motion, motion).drawn(DRAWS, SPAN_S).displacement_m(TIME).reshape(-1, 3)
    assert float((torch.corrcoef(moved.mT) - torch.eye(3)).abs().max()) < 0.02


def test_jitter_is_independent_from_pulse_to_pulse() -> None:
    moved = Sway(z=[Jitter(torch.tensor([0.3], dtype=F64), 0.01)]).drawn(DRAWS, SPAN_S).displacement_m(TIME)[..., 2]
    assert float(moved.square().mean().sqrt()) == pytest.approx(0.3, rel=0.02)
    assert abs(float((moved[:, 1:] * moved[:, :-1]).mean())) < 0.01 * 0.09


def test_a_random_walk_spreads_with_the_root_of_time() -> None:
    walk = Sway(x=[RandomWalk(0.1, 0.01)]).drawn(DRAWS, SPAN_S).displacement_m(TIME)[..., 0]
    assert float(walk[:, 0].abs().max()) == 0
    assert float(walk[:, 100].std()) == pytest.approx(0.1, rel=0.1)
    about_mean = walk - walk.mean(-1, keepdim=True)
    assert float(about_mean.square().mean().sqrt()) == pytest.approx(0.1 * math.sqrt(2 / 6), rel=0.1)


FLIGHT = Flight(StraightPath((0.0, 0.0, 100.0), (50.0, 0.0, 0.0)), Sway(y=[Sinusoid(1.0, 0.5)]))


def test_navigation_records_errors_latency_and_whole_steps() -> None:
    place = FLIGHT.position_m(TIME)
    assert torch.equal(Navigation().recorded_m(Draws(0), TIME, FLIGHT), place)
    bias = Navigation(Sway(z=[Offset(torch.tensor([0.5, -0.5], dtype=F64)), Polynomial([0.1])]))
    off = bias.recorded_m(Draws(0, trials=range(2)), TIME, FLIGHT) - place
    torch.testing.assert_close(off[:, 100, 2], torch.tensor([0.6, -0.4], dtype=F64))
    latencies = (0.0, 0.023, -0.01, 0.4)
    late = Navigation(latency_s=torch.tensor(latencies, dtype=F64)).recorded_m(Draws(0), TIME, FLIGHT)
    for i, latency in enumerate(latencies):
        torch.testing.assert_close(late[i], FLIGHT.position_m(TIME - latency), rtol=0, atol=1e-6)
        one = Navigation(latency_s=latency).recorded_m(Draws(0), TIME, FLIGHT)
        assert torch.equal(one, FLIGHT.position_m(TIME - latency))
    coarse = Navigation(step_m=0.25).recorded_m(Draws(0), TIME, FLIGHT)
    assert float((coarse - place).abs().max()) <= 0.125 and torch.equal(coarse, torch.round(4 * coarse) / 4)


@pytest.mark.parametrize("motion", [Jitter(1e-3, 0.01), RandomWalk(0.05, 0.01), VibrationSpectrum(1e-3, 12.0, 12.0)])
def test_late_records_of_rough_motion_are_those_of_earlier_times(motion) -> None:
    """Polynomials continued before the first pulse would grow with the third power."""
    flight = Flight(FLIGHT.nominal, Sway(z=[motion])).drawn(DRAWS.for_trials(range(3)), SPAN_S)
    late = Navigation(latency_s=torch.tensor([0.2, 0.0, -0.3], dtype=F64)).recorded_m(Draws(0), TIME, flight)
    place = flight.position_m(TIME)
    torch.testing.assert_close(late[0, 20:, 2], place[0, :-20, 2], rtol=0, atol=1e-9)
    torch.testing.assert_close(late[2, :-30, 2], place[2, 30:, 2], rtol=0, atol=1e-9)
    assert float((late[0] - flight.position_m(TIME - 0.2)[0]).abs().max()) < 1e-7
    assert float((late[..., 2] - 100).abs().max()) < 0.5


def test_records_at_a_low_rate_miss_vibration_but_not_the_flight() -> None:
    vibrating = Flight(FLIGHT.nominal, Sway(FLIGHT.motion.x, FLIGHT.motion.y, [Sinusoid(1e-3, 30.0)]))
    recorded = Navigation(rate_hz=20.0).recorded_m(Draws(0), TIME, vibrating)
    error = (recorded - vibrating.position_m(TIME)).abs().amax(0)
    assert float(error[:2].max()) < 1e-4 and 5e-4 < float(error[2]) < 3e-3
    walk = Navigation(Sway(x=[RandomWalk(0.05, 0.01)]), torch.tensor([0.1, 0.2], dtype=F64), rate_hz=20.0)
    assert walk.recorded_m(Draws(0, trials=range(2)), TIME, vibrating).shape == (2, 200, 3)
    with pytest.raises(ValueError, match="at least 5 records, got 4 at rate_hz=2 in 1.2 s"):
        Navigation(rate_hz=2.0).recorded_m(Draws(0), TIME[:121], FLIGHT)


@pytest.mark.parametrize(
    "build",
    [
        lambda: StraightPath((0.0, 1.0)),
        lambda: StraightPath((0.0, 1.0, math.nan)),
        lambda: CircularPath(-1.0, 0.0, 0.0, 0.0),
        lambda: Jitter(-1.0, 0.1),
        lambda: Jitter(1.0, 0.0),
        lambda: RandomWalk(1.0, math.inf),
        lambda: Offset(math.nan),
        lambda: Navigation(latency_s=math.nan),
        lambda: Navigation(latency_s=torch.tensor([0.0, 0.7])),
        lambda: Navigation(rate_hz=1.0),
        lambda: Navigation(step_m=-1.0),
    ],
)
def test_numbers_that_make_no_sense_are_refused(build) -> None:
    with pytest.raises(ValueError, match="must be"):
        build()
