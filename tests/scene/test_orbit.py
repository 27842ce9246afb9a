"""Orbits against the laws of motion, range series against closed forms, and the timing diagram."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.radar import Orbit, range_coefficients, seen_point, timing_diagram
from torchsar.radar.orbit import (
    EARTH_GRAVITY_M3_S2,
    EARTH_RADIUS_M,
    earth_velocity_m_s,
    orbit_range,
    turned_with_earth,
)
from torchsar.radar.timing import ground_slant_m, off_nadir_ground_m
from torchsar.scene import OrbitTransmit, PolynomialTransmit

ELEMENTS = {"inclination_deg": 60.0, "raan_deg": 195.5, "argument_of_perigee_deg": 270.0}
PAPER = Orbit.at_height(36_500e3, **ELEMENTS)
ECCENTRIC = Orbit(42_164e3, 0.3, 50.0, 20.0, 80.0, 30.0)


def over_a_turn(orbit: Orbit, n: int = 181) -> torch.Tensor:
    return torch.linspace(
        0, 2 * math.pi * math.sqrt(float(orbit.semi_major_m) ** 3 / EARTH_GRAVITY_M3_S2), n, dtype=torch.float64
    )


def gravity_m_s2(position):
    return -EARTH_GRAVITY_M3_S2 * position / torch.linalg.vector_norm(position, dim=-1, keepdim=True) ** 3


@pytest.mark.parametrize("orbit", [PAPER, ECCENTRIC], ids=["paper", "eccentric"])
def test_orbits_obey_gravity(orbit):
    time = over_a_turn(orbit)
    position, velocity = orbit.state(time)
    (moved, changed) = torch.autograd.functional.jvp(orbit.state, time, torch.ones_like(time))[1]
    torch.testing.assert_close(moved, velocity, rtol=1e-10, atol=1e-6)
    torch.testing.assert_close(changed, gravity_m_s2(position), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(position[-1], position[0], rtol=1e-9, atol=1e-3)


def test_elements_have_their_usual_meaning():
    at_perigee = Orbit(1e7, 0.2, 90.0, 0.0, 90.0)
    position, velocity = (x[0] for x in at_perigee.state(torch.zeros(1, dtype=torch.float64)))
    torch.testing.assert_close(position, torch.tensor([0.0, 0.0, 8e6], dtype=torch.float64), rtol=0, atol=1e-6)
    assert float(velocity[0]) == pytest.approx(-math.sqrt(EARTH_GRAVITY_M3_S2 / 1e7 * 1.2 / 0.8))


def test_elements_have_gradients_and_trials():
    elements = [
        torch.tensor([a, b], dtype=torch.float64, requires_grad=True)
        for a, b in ((4.2e7, 3e7), (0.1, 0.3), (60.0, 30.0), (10.0, 0.0), (270.0, 4.0), (5.0, 90.0))
    ]
    time = torch.tensor([0.0, 3e3], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *e: Orbit(*e).state(time)[0] / 1e6, elements, eps=1e-4, atol=1e-4)
    alone = Orbit(*(float(e[1].detach()) for e in elements)).state(time)[1]
    torch.testing.assert_close(Orbit(*elements).state(time)[1][1], alone)


@pytest.mark.parametrize("orbit", [PAPER, ECCENTRIC], ids=["paper", "eccentric"])
def test_coefficients_are_the_corrected_equations_10_and_11(orbit):
    """Remote Sens. 2020, 12, 1703, Eqs. (10), (11), with signs and factors corrected."""
    time = over_a_turn(orbit, 13)
    position, velocity = orbit.state(time)
    point = seen_point(position, velocity, 5.0, 40.0)
    k = range_coefficients(orbit, point, time)
    dr, dv = position - point, velocity - earth_velocity_m_s(point)
    da = gravity_m_s2(position) - earth_velocity_m_s(earth_velocity_m_s(point))
    length = torch.linalg.vector_norm(dr, dim=-1)
    k1 = (dr * dv).sum(-1) / length
    torch.testing.assert_close(k[:, 0], k1)
    torch.testing.assert_close(k[:, 1], ((dv * dv).sum(-1) + (dr * da).sum(-1) - k1**2) / length / 2)


def test_higher_coefficients_follow_the_exact_range():
    epoch = 20_000.0
    at = torch.tensor([epoch], dtype=torch.float64)
    point = seen_point(*PAPER.state(at), 7.0, 30.0)[0]
    k = range_coefficients(PAPER, point, at, order=5)[0]
    time = torch.linspace(-300, 300, 21, dtype=torch.float64)
    exact = OrbitTransmit(PAPER, point.tolist(), epoch).range_m(time)
    lengths = torch.linalg.vector_norm(PAPER.state(epoch + time)[0] - turned_with_earth(point, time), dim=-1)
    torch.testing.assert_close(
        exact, lengths - torch.linalg.vector_norm(PAPER.state(at)[0][0] - point), rtol=0, atol=1e-6
    )
    misses = [float((exact - PolynomialTransmit(k[:n].tolist()).range_m(time)).abs().max()) for n in (2, 3, 4, 5)]
    assert misses[0] > 1 and misses[1] < 0.3 and misses[2] < 1e-3 and misses[3] < 4e-5


@pytest.mark.parametrize(("orbit", "greatest"), [(PAPER, 0.0208), (Orbit(42_164e3, **ELEMENTS), 0.0215)])
def test_published_sizes_of_the_transmit_range(orbit, greatest):
    """k2 lies in -0.0146..0.0208, or up to 0.0215 at the geosynchronous radius.

    k1 reaches 376 m/s off zero Doppler. The phase of the third power is below 1e-4 pi, as Remote
    Sens. 2020, 12, 1703 states.
    """
    time = over_a_turn(orbit)
    position, velocity = orbit.state(time)
    k = torch.stack(
        [
            range_coefficients(orbit, seen_point(position, velocity, 7.0, float(squint)), time, 3)
            for squint in range(0, 360, 10)
        ]
    )
    assert float(k[..., 1].max()) == pytest.approx(greatest, abs=6e-5) and float(k[..., 1].min()) == pytest.approx(
        -0.0146, abs=1e-4
    )
    assert float(k[..., 0].abs().max()) == pytest.approx(376, abs=2) and float(k[0, :, 0].abs().max()) < 1e-9
    assert float(k[..., 2].abs().max()) * 2.25**3 * 2 / 0.24 == pytest.approx(8.6e-5, abs=5e-6)


def test_the_seen_point_lies_on_the_ground_and_under_the_angle():
    position, velocity = PAPER.state(torch.tensor([0.0, 9e3], dtype=torch.float64))
    point = seen_point(position, velocity, 7.0, 25.0, side=-1.0)
    torch.testing.assert_close(
        torch.linalg.vector_norm(point, dim=-1), torch.full((2,), EARTH_RADIUS_M, dtype=torch.float64)
    )
    cosine = torch.nn.functional.cosine_similarity(point - position, -position, dim=-1)
    torch.testing.assert_close(cosine, torch.full((2,), math.cos(math.radians(7)), dtype=torch.float64))
    arc = EARTH_RADIUS_M * float(torch.arccos(torch.nn.functional.cosine_similarity(point, position, dim=-1))[0])
    assert arc == pytest.approx(off_nadir_ground_m(36_500e3, 7.0), abs=1e-3)
    assert float(ground_slant_m(36_500e3, torch.tensor(arc, dtype=torch.float64))) == pytest.approx(
        float(torch.linalg.vector_norm(point - position, dim=-1)[0]), abs=1e-3
    )


def test_orbit_range_starts_at_zero_in_every_trial():
    orbit = Orbit(torch.tensor([4.2e7, 3e7], dtype=torch.float64))
    point = torch.tensor([[EARTH_RADIUS_M, 0.0, 0.0]] * 2, dtype=torch.float64)
    ranges = orbit_range(orbit, point, 10.0, torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert ranges.shape == (2, 2) and bool((ranges[:, 0] == 0).all())


def diagram(pulse_s=20e-6, guard_s=50e-6, nadir_s=30e-6):
    middle = off_nadir_ground_m(36_500e3, 7.0)
    prf = torch.arange(150.0, 211.0, 2.0, dtype=torch.float64)
    return timing_diagram(
        36_500e3, prf, torch.arange(middle - 500e3, middle + 500e3, 4e3, dtype=torch.float64), pulse_s, guard_s, nadir_s
    )


def test_lost_ranges_are_those_where_echoes_meet_pulses():
    d = diagram()
    delay = 2 / 299_792_458.0 * ground_slant_m(36_500e3, d.ground_m)
    for row in (0, 15, 30):
        period = 1 / float(d.prf_hz[row])
        starts = torch.arange(0, 0.4, period, dtype=torch.float64)
        hit = ((delay[:, None] < starts + 20e-6 + 50e-6) & (delay[:, None] + 20e-6 > starts - 50e-6)).any(-1)
        assert torch.equal(d.transmit[row], hit)
        below = starts + 2 * 36_500e3 / 299_792_458.0 - 20 * period
        hit = ((delay[:, None] < below + 20e-6 + 30e-6 + 50e-6) & (delay[:, None] + 20e-6 > below - 50e-6)).any(-1)
        assert torch.equal(d.nadir[row], hit)
    assert bool(d.transmit.any()) and bool(d.nadir.any())


def test_swaths_fit_where_every_range_is_clear():
    d = diagram()
    fits = d.swath_fits(500e3)
    for row in range(0, 31, 7):
        expected = [start + 125 < 250 and bool(d.clear[row, start : start + 126].all()) for start in range(250)]
        assert fits[row].tolist() == expected
    rates = d.prf_hz[fits.any(-1)]
    assert 180.0 in rates and bool(
        ((rates >= 160) & (rates <= 200)).any()
    )  # Fig. 2 takes rates of 160 to 200 Hz for a swath of 500 km
    assert not bool(d.swath_fits(1e7).any())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Orbit(6e6), "meets the ground"),
        (lambda: Orbit(1e7, 0.95), "eccentricity"),
        (lambda: Orbit(1e7, inclination_deg=math.inf), "inclination_deg"),
        (lambda: seen_point(*PAPER.state(torch.zeros(1, dtype=torch.float64)), 9.0), "misses the Earth"),
        (lambda: off_nadir_ground_m(36_500e3, 9.0), "off_nadir_deg must lie in"),
        (lambda: diagram(pulse_s=3e-3), "leave nothing"),
        (lambda: timing_diagram(1e6, torch.tensor([100.0]), torch.tensor([0.0, 1e7]), 1e-5), "horizon"),
        (lambda: timing_diagram(1e6, torch.tensor([]), torch.tensor([0.0, 1e5]), 1e-5), "at least one pulse rate"),
        (lambda: timing_diagram(1e6, torch.tensor([100.0]), torch.tensor([]), 1e-5), "at least two positions"),
    ],
)
def test_impossible_orbits_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
