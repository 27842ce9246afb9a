"""Moving targets: ranges against three-dimensional geometry, series, ships and fleets."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Draws
from torchsar.radar import BistaticRadar, LinearFM, Orbit
from torchsar.radar.bistatic import receive_range
from torchsar.scene import (
    AlwaysLit,
    BandLimited,
    BistaticWorld,
    ExactRange,
    Fleet,
    GroundMovers,
    MovingPoints,
    OrbitTransmit,
    Pattern,
    PolynomialTransmit,
    Ship,
    TaylorRange,
)
from torchsar.scene.movers import Movers

RADAR = BistaticRadar(
    1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0, channel_m=(-0.8, 0.1, 0.75), wave_speed_m_s=3e8
)
TIME = torch.linspace(-2.25, 2.25, 31, dtype=torch.float64)


def movers_of(scene, trials=None) -> Movers:
    return scene.movers(RADAR, Draws(1, trials=trials))


def test_ranges_of_points_are_those_of_the_slant_plane():
    movers = movers_of(MovingPoints([10.0, -3.0], [5.0, -7.0], [20.0, -150.0], [0.0, 60.0]))
    channel, t = RADAR.channels_at()[:, None, None], TIME[:, None]
    u_r, u_a, y0, closest = movers.u_r_m_s, movers.u_a_m_s, movers.y0_m, 5000 + movers.range_m
    direct = torch.sqrt((closest - u_r * t) ** 2 + ((300 - u_a) * t - y0 - channel) ** 2) - 5000
    torch.testing.assert_close(ExactRange().range_m(movers, TIME, RADAR), direct, rtol=0, atol=5e-12)


def ground_truth(w, a, along, along_a, y0, ground) -> torch.Tensor:
    """Distances in three dimensions, (channel, pulse)."""
    receiver = torch.stack(
        [
            300 * TIME - RADAR.channels_at()[:, None],
            torch.zeros(3, 31, dtype=torch.float64),
            torch.full((3, 31), 3000.0, dtype=torch.float64),
        ],
        -1,
    )
    target = torch.stack([y0 + along * TIME + along_a * TIME**2 / 2, ground + w * TIME + a * TIME**2 / 2, 0 * TIME], -1)
    return torch.linalg.vector_norm(receiver - target, dim=-1) - 5000


def test_ground_movers_follow_three_dimensions_exactly():
    scene = GroundMovers(
        [12.5, -8.0], [4.0, -6.0], [30.0, -90.0], [4000.0, 4100.0], outward_m_s2=[0.2, -0.1], along_m_s2=[-0.3, 0.1]
    )
    ranges = ExactRange().range_m(movers_of(scene), TIME, RADAR)
    for i, values in enumerate([(12.5, 0.2, 4.0, -0.3, 30.0, 4000.0), (-8.0, -0.1, -6.0, 0.1, -90.0, 4100.0)]):
        torch.testing.assert_close(ranges[..., i], ground_truth(*values), rtol=0, atol=1e-11)


def test_ground_motion_in_the_slant_plane_is_an_along_track_bias():
    """12.5 m/s on the ground at a height of 3 km curves the phase like 0.094 m/s along track."""
    movers = movers_of(GroundMovers([-12.5], [0.0], [0.0], [4000.0]))
    assert float(movers.u_r_m_s) == pytest.approx(10.0) and float(movers.range_m) == pytest.approx(0.0)
    exact = ExactRange().range_m(movers, TIME, RADAR)[1, :, 0]
    turns = [
        2 * math.pi / RADAR.wavelength_m * (exact - receive_range(TIME, 10.0, u_a, 0.0, 5000.0, 300.0, 0.1))
        for u_a in (0.0, -0.094)
    ]
    assert float(turns[0].abs().max()) == pytest.approx(0.745, abs=0.02)
    assert float(turns[1].abs().max()) < 0.02


def test_motion_towards_the_transmitter_shortens_its_range():
    movers = movers_of(GroundMovers([5.0], [2.0], [0.0], [4000.0], outward_m_s2=[1.0], towards_transmitter=(0.6, 0.5)))
    assert movers.bend is not None
    torch.testing.assert_close(movers.bend.transmit_m(TIME)[0, :, 0], -(4.0 * TIME + 0.3 * TIME**2))


@pytest.mark.parametrize(("u_r", "wrong"), [(0.0, 5.4), (10.0, 12.1)])
def test_the_parabola_errs_by_radians_and_higher_orders_do_not(u_r, wrong):
    """Remote Sens. 2020, 12, 1703, Eqs. (3), (5): the parabola at the aperture edge."""
    movers = movers_of(MovingPoints([u_r], [0.0], [0.0], [0.0]))
    assert float(TaylorRange(2).neglected_phase_rad(movers, TIME, RADAR)) == pytest.approx(wrong, abs=0.15)
    assert float(TaylorRange(4).neglected_phase_rad(movers, TIME, RADAR)) < 0.2
    assert float(TaylorRange(12).neglected_phase_rad(movers, TIME, RADAR)) < 1e-7
    assert float(ExactRange().neglected_phase_rad(movers, TIME, RADAR)) == 0


def test_order_two_is_equation_5():
    movers = movers_of(MovingPoints([10.0], [5.0], [0.0], [0.0]))
    dx, v, u, near = RADAR.channels_at()[:, None], 295.0, 10.0, 5000.0
    square = v**2 + u**2
    paper = (
        square / (2 * near) * (TIME - u * near / square - v * dx / square) ** 2
        - square / (2 * near) * ((near * u + v * dx) / square) ** 2
        + dx**2 / (2 * near)
    )
    torch.testing.assert_close(TaylorRange(2).range_m(movers, TIME, RADAR)[..., 0], paper, rtol=0, atol=1e-10)


def test_gates_by_time_and_by_direction():
    movers = movers_of(MovingPoints([0.0], [50.0], [100.0], [0.0]))
    lit = BandLimited(2.0).weight(movers, TIME, RADAR)[0, :, 0]
    torch.testing.assert_close(lit.bool(), (TIME - 0.4).abs() < 1.0)
    pattern = Pattern().weight(movers, TIME, RADAR)[..., 0]
    along = 250 * TIME - 100 - RADAR.channels_at()[:, None]
    q = math.pi * 0.8 / 0.24 * along / torch.sqrt(along**2 + 25e6)
    torch.testing.assert_close(pattern, torch.where(q == 0, 1.0, torch.sin(q) / q))


def test_ships_have_the_given_level_and_range_cells():
    ship = movers_of(Ship(10.0, torch.tensor([0.0, 5.0, 10.0]), 40.0, -30.0, count=14, level_db=6.0), range(3))
    assert ship.amplitude.shape == (3, 14) and ship.u_a_m_s[2, 0] == 10
    lines = {r: ship.range_m[0] == r for r in (-39.0, -33.0, -27.0, -21.0)}
    assert all(bool(at.any()) for at in lines.values()) and int(sum(at.sum() for at in lines.values())) == 14
    power = ship.amplitude.abs().square().sum(-1) / 4
    torch.testing.assert_close(power, torch.full((3,), 10**0.6, dtype=torch.float64))
    assert bool(((ship.y0_m - 40).abs() <= 50).all()) and not torch.equal(ship.y0_m[0], ship.y0_m[1])
    torch.testing.assert_close(movers_of(Ship(10.0, 0.0, 40.0, count=14), [2]).y0_m[0], ship.y0_m[2])


def test_fleets_join_uniform_and_accelerated_targets():
    points, ground = MovingPoints([1.0], [2.0], [3.0], [4.0]), GroundMovers([6.0], [0.0], [0.0], [4000.0])
    ship = Ship(0.0, 0.0, count=5)
    fleet = movers_of(Fleet({"point": points, "ground": ground, "ship": ship, "again": ship}), range(2))
    assert fleet.u_r_m_s.shape == (2, 12) and not torch.equal(fleet.y0_m[0, 2:7], fleet.y0_m[0, 7:])
    for i, scene in enumerate((points, ground)):
        torch.testing.assert_close(
            fleet.excess_m(TIME, RADAR)[0, ..., i], movers_of(scene).excess_m(TIME, RADAR)[..., 0], rtol=0, atol=1e-12
        )


def test_points_may_differ_between_trials_and_be_complex():
    speed = torch.tensor([[1.0], [2.0]], dtype=torch.float64, requires_grad=True)
    movers = movers_of(MovingPoints(speed, [0.0], [0.0], [0.0], torch.tensor([1j]), random_phase=True), range(2))
    assert movers.y0_m.shape == (2, 1) and movers.amplitude[0] != movers.amplitude[1]
    movers.excess_m(TIME, RADAR).sum().backward()
    assert speed.grad is not None and bool((speed.grad != 0).all())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: MovingPoints([1.0], [0.0, 1.0], [0.0], [0.0]), "one speed, position"),
        (lambda: MovingPoints([math.nan], [0.0], [0.0], [0.0]), "u_r_m_s of moving points must be a finite"),
        (lambda: Ship(0.0, 0.0, count=3, range_cells=4), "a scatterer for each"),
        (lambda: GroundMovers([1.0], [0.0], [0.0], [1.0], towards_transmitter=(1.0, 1.0)), "of a length of at most 1"),
        (lambda: TaylorRange(3), "2, 4, 6"),
        (lambda: BandLimited(0.0), "positive number"),
        (lambda: PolynomialTransmit([1.0], 2), "0..1"),
        (lambda: OrbitTransmit(Orbit(7e6), (1.0, 2.0)), "three coordinates"),
        (lambda: BistaticWorld(None, Pattern()), "empty"),
        (lambda: movers_of(Fleet({})), "at least one scene"),
    ],
)
def test_impossible_scenes_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("gate", [AlwaysLit(), BandLimited, None])
def test_a_gate_has_the_gain_of_gates(gate):
    with pytest.raises(TypeError, match=r"weight\(movers, time_s, radar\).*, got "):
        BistaticWorld(MovingPoints([0.0], [0.0], [0.0], [0.0]), gate)
