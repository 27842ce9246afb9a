"""Satellite model: its extents, parts, corners and draws."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Draws
from torchsar.echo import simulate_turntable
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

SETS = {
    "full": Satellite(),
    "mid": Satellite(300),
    "small": Satellite(120, 1.6),
    "upright": Satellite(200, 5.0, 2.0, 0.0),
    "leaning": Satellite(200, 5.0, 2.0, -0.7),
}


@pytest.mark.parametrize("satellite", SETS.values(), ids=list(SETS))
def test_extents_are_exact_in_every_trial(satellite: Satellite) -> None:
    s = satellite.scatterers(Draws(1, trials=range(4)))
    assert s.azimuth_m.shape == s.range_m.shape == s.amplitude.shape == (4, satellite.count)
    for positions, half in ((s.azimuth_m, satellite.half_width_m), (s.range_m, satellite.half_depth_m)):
        torch.testing.assert_close(positions.amax(-1), torch.full((4,), half, dtype=torch.float64), rtol=1e-14, atol=0)
        torch.testing.assert_close(positions.amin(-1), torch.full((4,), -half, dtype=torch.float64), rtol=1e-14, atol=0)


def test_parts_hold_their_shares_and_lie_where_they_should() -> None:
    satellite = Satellite()
    parts, s = satellite.parts(), satellite.scatterers(Draws(1))
    counts = {name: members.stop - members.start for name, members in parts.items()}
    assert counts == {"bus": 156, "panel_left": 174, "panel_right": 174, "dish": 48, "boom": 48}
    x, y = ({name: v[members] for name, members in parts.items()} for v in (s.azimuth_m, s.range_m))
    assert float(x["panel_left"].max()) < float(x["bus"].min()) and float(x["bus"].max()) < float(
        x["panel_right"].min()
    )
    assert float(y["boom"].max()) == 3.4 and float(y["dish"].min()) == -3.4
    assert float(y["boom"].min()) > 0 > float(y["dish"].mean())
    for count in (60, 61, 120, 299):
        assert sum(m.stop - m.start for m in Satellite(count).parts().values()) == count


def test_panels_are_grids() -> None:
    """Every point of a panel lies on one of its 5 ribs or 9 strings, with many on both."""
    satellite = Satellite()
    s = satellite.scatterers(Draws(2))
    members = satellite.parts()["panel_right"]
    x, y = s.azimuth_m[members], s.range_m[members]
    to_rib, to_string = ((v - v.min()) / (v.max() - v.min()) * cells for v, cells in ((x, 4), (y, 8)))
    on_rib, on_string = ((v - v.round()).abs() < 1e-9 for v in (to_rib, to_string))
    assert bool((on_rib | on_string).all()) and int(on_rib.sum()) > 30 and int(on_string.sum()) > 80


def test_corners_are_strong_and_shared_and_tips_are_at_the_ends() -> None:
    satellite = Satellite()
    s, corners = satellite.scatterers(Draws(3, trials=range(5))), satellite.corners()
    assert int(corners.sum()) == 20
    torch.testing.assert_close(s.amplitude.abs()[:, corners], torch.full((5, 20), 1.5, dtype=torch.float64))
    assert bool((s.azimuth_m[:, corners] == s.azimuth_m[:1, corners]).all()) and bool(
        (s.range_m[:, corners] == s.range_m[:1, corners]).all()
    )
    tips = corners & (s.azimuth_m[0].abs() == 6.43)
    assert int(tips.sum()) == 4
    others = ~corners
    assert float((s.azimuth_m[0, others] - s.azimuth_m[1, others]).abs().mean()) > 0.01


def test_amplitudes_follow_their_distribution() -> None:
    s, corners = Satellite().scatterers(Draws(4, trials=range(20))), Satellite().corners()
    level, phase = s.amplitude[:, ~corners].abs(), torch.angle(s.amplitude)
    assert float(level.min()) >= 0.4
    assert float(level.mean()) == pytest.approx(0.4 + 0.6 * math.sqrt(math.pi / 2), rel=0.02)
    assert float(level.var()) == pytest.approx(0.36 * (2 - math.pi / 2), rel=0.05)
    assert float(torch.polar(torch.ones_like(phase), phase).mean().abs()) < 0.03


def test_draws_depend_on_their_address_only() -> None:
    satellite = Satellite(120, 1.6)
    whole, part, alone, other = (
        satellite.scatterers(d) for d in (Draws(5, trials=range(4)), Draws(5, trials=[3, 1]), Draws(5), Draws(6))
    )
    for name in ("azimuth_m", "range_m", "amplitude"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[[3, 1]]) and torch.equal(
            getattr(alone, name), getattr(whole, name)[0]
        )
        assert not torch.equal(getattr(alone, name), getattr(other, name)) and not torch.equal(
            getattr(whole, name)[0], getattr(whole, name)[1]
        )


def test_the_small_set_is_simulated_as_a_batch() -> None:
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / 0.24, 5e3)
    world = TurntableWorld(Satellite(120, 1.6), rotation=PolynomialRotation(0.02, (10.0, 1000.0)), snr_db=0.0)
    recording, truth = simulate_turntable(radar, world, 100, 64, Draws(1, trials=range(3)))
    assert recording.signal.data.shape == (3, 100, 64) and truth.values["cross_range_m"].shape == (3, 120)
    assert not torch.equal(recording.signal.data[0], recording.signal.data[1])


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"count": 59}, "a satellite needs at least 60 scatterers to have all of its parts, got count=59"),
        ({"half_width_m": 0.0}, "half_width_m of a satellite must be a positive number, got 0"),
        ({"corner_level": math.nan}, "corner_level of a satellite must be a positive number"),
        ({"tilt_rad": math.inf}, "tilt_rad of a satellite must be a finite number"),
        ({"tilt_rad": 1.0}, r"tilt_rad of a satellite must lie within \+-pi/4, got 1.0"),
    ],
)
def test_impossible_satellites_are_refused(changes: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Satellite(**changes)
